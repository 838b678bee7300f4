"""Which observation informs which parameter: leverage of rows, reach of layers along the skin, and finite against local change.

    H = J (J'J)^-1 J'         the leverage H_ii of a row, 0 to 1; their sum is the number of parameters that the data see

A row of leverage near 1 is fitted whatever it says. The distance at which a profile informs a layer is the mean of |distance| weighted by
the square of the scaled Jacobian's column. Dandekar et al. (2003), section 3.1: the deeper the layer, the farther from the load.
"""

from __future__ import annotations

import math

import numpy as np

from ..measurements import Measurement
from .box import Box
from .evaluation import evaluator
from .fit import Fit

Row = dict[str, object]
FACTORS = (0.1, 10.0)  # as the paper changed its layers


def leverage(fit: Fit) -> np.ndarray:
    """(rows,): how much of each row's own reading its fitted value follows."""
    lengths = np.linalg.norm(fit.jacobian, axis=0)
    scaled = fit.jacobian[:, lengths > 0] / lengths[lengths > 0]
    basis, size, _ = np.linalg.svd(scaled, full_matrices=False)
    return np.sum(basis[:, size > 1e-9 * size.max(initial=0.0)] ** 2, axis=1)


def leverage_rows(fit: Fit, measurements: tuple[Measurement, ...]) -> list[Row]:
    """One tidy row for each observation: where it was made, its leverage, its residual in sigmas, and the parameter it informs most."""
    each = leverage(fit)
    share = fit.jacobian**2 / np.maximum(np.sum(fit.jacobian**2, axis=0), 1e-300)
    found: list[Row] = []
    for one in measurements:
        for i in range(len(one)):
            row = fit.problem.blocks[one.name].start + i
            where = {name: one.table[name][i] for name in (one.imposed, "distance", "position") if name in one.table}
            most = fit.problem.names[int(np.argmax(share[row]))]
            residual = float(fit.residual[row])
            head: Row = {"measurement": one.name, "observation": i + 1, **{name: float(value) for name, value in where.items()}}
            found.append({**head, "leverage": float(each[row]), "residual_in_sigmas": residual, "informs_most": most})
    return found


def stations(fit: Fit, measurement: Measurement) -> list[Row]:
    """Of each parameter: how far from the load a profile informs it, mm on average, and the distance at which it is seen best."""
    distance = np.abs(measurement.table["distance"])
    there = fit.jacobian[fit.problem.blocks[measurement.name]]
    found: list[Row] = []
    for j, name in enumerate(fit.problem.names):
        weight = there[:, j] ** 2
        total = float(weight.sum())
        mean = float(weight @ distance) / total if total > 0 else math.nan
        best = float(distance[int(np.argmax(weight))]) if total > 0 else math.nan
        row: Row = {"measurement": measurement.name, "parameter": name, "mean_distance_mm": mean, "seen_best_at_mm": best}
        found.append({**row, "information": total})
    return found


def finite(fit: Fit, factors: tuple[float, ...] = FACTORS) -> list[Row]:
    """Local slopes against what the model does when a log parameter is multiplied: size and shape of both changes of the residuals.

    **Returns** rows with `finite` and `local` (rms over the observations, in sigmas), and `alike`, the cosine between the two. A change
    whose solves failed has no number. Costs one run of the model for each parameter and factor.
    """
    evaluate, box = evaluator(fit.problem), Box.around(fit.problem.parameters)
    found: list[Row] = []
    for j, parameter in enumerate(fit.problem.parameters):
        if parameter.link != "log":
            continue
        for factor in factors:
            raw = fit.raw.copy()
            raw[j] = np.clip(raw[j] + math.log(factor), box.lower[j], box.upper[j])
            point = evaluate(raw)
            local = fit.jacobian[:, j] * (raw[j] - fit.raw[j])
            moved = point.residual - fit.residual if point.usable else np.full_like(local, np.nan)
            size = float(np.linalg.norm(moved) * np.linalg.norm(local))
            row: Row = {"parameter": parameter.name, "times": factor, "finite": _rms(moved), "local": _rms(local)}
            found.append({**row, "alike": float(moved @ local) / size if size > 0 else math.nan})
    return found


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
