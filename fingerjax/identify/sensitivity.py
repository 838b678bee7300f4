"""Which observation sees which parameter: the Jacobian in units that can be compared.

    S_ij = d prediction_i / d log parameter_j

is the change of a prediction for a change of the parameter by a factor e: of 0.01 S for one per cent.
Divided by the observation's sigma it says how many standard deviations that is, so that columns and
instruments can be compared.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fingerjax.identify.fit import Fit


@dataclass(frozen=True)
class Sensitivity:
    """The scaled Jacobian at the end of a fit.

    - `names`: parameters, one per column; `blocks`: measurement of each row.
    - `in_sigma` (rows, p): d prediction / d log parameter, over the sigma of the observation.
    - `in_units` (rows, p): the same in the unit of the measured value; NaN where no sigma was handed in.
    """

    names: tuple[str, ...]
    blocks: tuple[str, ...]
    in_sigma: np.ndarray
    in_units: np.ndarray

    def table(self) -> list[dict[str, object]]:
        """Tidy rows: measurement, observation, parameter, per_log (own unit), per_log_sigma (sigmas)."""
        count: dict[str, int] = {}
        rows: list[dict[str, object]] = []
        for i, block in enumerate(self.blocks):
            number = count[block] = count.get(block, 0) + 1
            rows += [
                {
                    "measurement": block,
                    "observation": number,
                    "parameter": name,
                    "per_log": float(self.in_units[i, j]),
                    "per_log_sigma": float(self.in_sigma[i, j]),
                }
                for j, name in enumerate(self.names)
            ]
        return rows

    def seen_by(self) -> dict[str, dict[str, float]]:
        """Of each parameter, the share of its information that each measurement holds."""
        information = self.in_sigma**2
        total = np.where(information.sum(axis=0) > 0, information.sum(axis=0), 1.0)
        owner = np.array(self.blocks)
        return {
            name: {
                block: float(information[owner == block, j].sum() / total[j])
                for block in dict.fromkeys(self.blocks)
            }
            for j, name in enumerate(self.names)
        }


def sensitivity(fit: Fit, sigma: Mapping[str, np.ndarray | float] | None = None) -> Sensitivity:
    """Scale the Jacobian of a fit.

    **Arguments:**

    - `fit`: its Jacobian at the best point is used, no model is run.
    - `sigma`: standard deviations that the residuals were whitened with, by measurement, (rows,) or one
      number, in the unit of the measured value. Without them only `in_sigma` is filled.
    """
    parameters = fit.problem.parameters
    natural = np.array([fit.best[name] for name in fit.problem.names])
    slope = np.array([float(p.slope(raw)) for p, raw in zip(parameters, fit.raw, strict=True)])
    per_log = fit.jacobian * np.where(slope != 0, natural / np.where(slope != 0, slope, 1.0), 0.0)
    owner, spread = np.full(per_log.shape[0], "", dtype=object), np.full(per_log.shape[0], np.nan)
    for block, rows in fit.problem.blocks.items():
        owner[rows] = block
        if sigma is not None and block in sigma:
            spread[rows] = sigma[block]
    measured = owner != "prior"
    return Sensitivity(
        fit.problem.names, tuple(owner[measured]), per_log[measured], (per_log * spread[:, None])[measured]
    )
