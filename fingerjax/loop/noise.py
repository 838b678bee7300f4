"""How large the noise is, before anything is said of a misfit: from repeats, from what was stated, or not known.

    Sigma = diag(sigma^2 / weight) in traces whose neighbours may be correlated + what trials share + calibration + form

`form` is what no model of a finger comes nearer than, whatever its mesh: sections and layers are measured to some per cent, and laws of
tissue and of rates hold to some per cent. Repeats do not know of it; without it they would have every effect named that is larger than the
noise of their mean, and with enough repeats that is every effect (Kaipio & Somersalo 2007: approximation error as covariance). It is the
same in all repeats of a setting, and nothing is known of how it goes on from one setting to the next: a covariance that let readings be
wrong all together would have them fitted by a model that lies below all of them.

The verdict that a model is adequate needs repeats: three of each setting and 30 degrees of freedom. A stated standard deviation allows
effects to be named at that noise; where nothing is known nothing is named. It is never taken from the residuals of a model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from .repeats import Recorded, Repeats, from_repeats
from .subject import Rows

REPLICATES, STATED, ASSUMED = "replicates", "stated", "assumed"
FEWEST_REPEATS, FEWEST_DOF = 3, 30
LEAST_DOF = 6.0  # of one block, below which a stated standard deviation is preferred to its repeats
GUESS = 0.05  # share of a block's root mean square that stands in where nothing is known, so that a fit can be made at all
_POWER = {"spike_rate": 1.0}  # the variance of a count grows with its mean; of other readings, if at all, with the square
_GROWS = ("spike_rate", "force_displacement")  # a load cell has a floor and a share of what it reads; a camera is as good everywhere


@dataclass(frozen=True, eq=False)
class Noise:
    """The noise of all rows.

    - `sigma`, `weights` (rows,): standard deviation of a row, and how much it counts.
    - `shared` (rows, rows): covariance that rows of one trial or one instrument have in common, as wide as few trials demand;
      `likely` (rows, rows): the same as it is most likely, for making data up.
    - `correlation` (rows, rows): of what is left, 1 on the diagonal; None where it is the identity.
    - `source`: block -> `replicates`, `stated` or `assumed`; `repeats`: block -> the typical number of them.
    - `freedom`: block -> degrees of freedom of its pure error, inf where its noise is stated without saying from how many.
    - `beside`: block -> what any model may be wrong by and what calibration leaves open, root mean square in standard deviations of a row.
    - `terms`: block -> standard deviations of `trial gain`, `trial zero`, `trace gain`, `trace zero`, and `neighbours`.
    """

    sigma: Float[np.ndarray, "rows"]
    weights: Float[np.ndarray, "rows"]
    shared: Float[np.ndarray, "rows rows"]
    likely: Float[np.ndarray, "rows rows"]
    correlation: Float[np.ndarray, "rows rows"] | None
    source: Mapping[str, str]
    repeats: Mapping[str, float]
    freedom: Mapping[str, float]
    terms: Mapping[str, dict[str, float]]
    beside: Mapping[str, float] = field(default_factory=dict)

    def covariance(self) -> Float[np.ndarray, "rows rows"]:
        """Sigma without what the mesh leaves."""
        return self._own(self.sigma / np.sqrt(self.weights)) + self.shared

    def plausible(self) -> Float[np.ndarray, "rows rows"]:
        """The covariance by which data like these are made up: no outliers, and what trials share at its likeliest."""
        return self._own(self.sigma) + self.likely

    def _own(self, size: np.ndarray) -> np.ndarray:
        return np.diag(size**2) if self.correlation is None else np.outer(size, size) * self.correlation

    @property
    def worst(self) -> str:
        """The source that the whole rests on: that of the block of which least is known."""
        return max(self.source.values(), key=(REPLICATES, STATED, ASSUMED).index)

    @property
    def known(self) -> bool:
        """Whether effects may be named."""
        return self.worst != ASSUMED

    @property
    def repeated(self) -> bool:
        """Whether adequacy may be judged."""
        return self.known and self.nu >= FEWEST_DOF and min(self.repeats.values()) >= FEWEST_REPEATS

    @property
    def nu(self) -> float:
        """Degrees of freedom of pure error: those of all blocks that count any, 0 where none does."""
        return float(sum(dof for dof in self.freedom.values() if math.isfinite(dof)))

    @property
    def dof(self) -> float:
        """Degrees of freedom for intervals: `nu`, or inf where the noise is taken at its word."""
        return self.nu if self.nu > 0 else math.inf

    def allows(self) -> str:
        """What may be said with this noise, and what misfit is put down to the model as it is."""
        known = [f"{size:.2g} times the noise in {name}" for name, size in self.beside.items() if size > 0]
        return self._judged() + (f" Misfit of about {', '.join(known)} is no news (model_error, placement_mm)." if known else "")

    def _judged(self) -> str:
        if self.repeated:
            return "Repeats tell the noise: effects may be named, and the model may be called adequate."
        unknown = [name for name, source in self.source.items() if source == ASSUMED]
        if unknown:
            listed = ", ".join(unknown)
            return f"Nothing tells the noise of {listed}: nothing is named; record three repeats, or state a standard deviation."
        return (
            f"The noise is stated, without {FEWEST_REPEATS} repeats and {FEWEST_DOF} degrees of freedom behind it: effects may be named "
            "if it is right, but the model cannot be called adequate."
        )

    def weighed(self, rows: Float[np.ndarray, "rows"]) -> Noise:
        """The same with other weights."""
        return replace(self, weights=rows)


def estimate(rows: Rows, measured: Float[np.ndarray, "rows"] | None = None) -> Noise:
    """The noise of all rows, block by block; `measured` stands in for the rows' own where data are made up."""
    y = rows.measured if measured is None else measured
    n = len(rows)
    sigma, weights, shared, likely = np.ones(n), np.ones(n), np.zeros((n, n)), np.zeros((n, n))
    correlation, correlated = np.eye(n), False
    source, repeats, terms, freedom = {}, {}, {}, dict.fromkeys(rows.blocks, math.inf)
    recorded = {name: _recorded(rows, y, name) for name in rows.blocks}
    told = _told(rows, recorded)
    for name, where in rows.blocks.items():
        found = told.get(name)
        stated = None if rows.sigma is None or not np.isfinite(rows.sigma[where]).all() else rows.sigma[where]
        repeats[name] = float(np.median(np.bincount(np.unique(rows.setting[where], return_inverse=True)[1].reshape(-1))))
        if found is not None and (found.dof >= LEAST_DOF or stated is None):
            source[name], sigma[where], weights[where] = REPLICATES, found.sigma, found.weights
            shared[where, where] += _in_common(found, recorded[name], found.widening)
            likely[where, where] += _in_common(found, recorded[name], (1.0, 1.0))
            terms[name] = _said(found)
            freedom[name] = found.dof
            if found.neighbours > 0:
                correlation[where, where] = _along(found.neighbours, recorded[name])
                correlated = True
        elif stated is not None:
            source[name], sigma[where], terms[name] = STATED, stated, {}
            repeats[name] = max(repeats[name], float(rows.stated_repeats.get(name, 1)))
            counted = len(set(rows.setting[where].tolist())) * max(rows.stated_repeats.get(name, 1) - 1, 0)
            freedom[name] = float(counted) if counted else math.inf
        else:
            source[name], terms[name] = ASSUMED, {}
            sigma[where] = GUESS * max(float(np.sqrt(np.mean(y[where] ** 2))), 1e-300)
    for added in rows.calibration.values():
        shared += np.outer(added, added)
        likely += np.outer(added, added)
    if rows.form is not None:
        wrong = np.outer(rows.form, rows.form) * (rows.setting[:, None] == rows.setting)
        shared, likely = shared + wrong, likely + wrong
    more = sum((np.asarray(added) ** 2 for added in rows.calibration.values()), np.zeros(n) if rows.form is None else rows.form**2)
    beside = {name: float(np.sqrt(np.mean(more[where] / sigma[where] ** 2))) for name, where in rows.blocks.items()}
    return Noise(sigma, weights, shared, likely, correlation if correlated else None, source, repeats, freedom, terms, beside)


def _recorded(rows: Rows, y: Float[np.ndarray, "rows"], name: str) -> Recorded:
    where = rows.blocks[name]
    coded = (np.unique(values[where], return_inverse=True)[1].reshape(-1) for values in (rows.setting, rows.condition, rows.trial))
    setting, condition, trial = coded
    return Recorded(y[where], setting, condition, trial, rows.along(name))


def _told(rows: Rows, recorded: Mapping[str, Recorded]) -> dict[str, Repeats]:
    """What repeats tell, of all blocks of one kind together."""
    found: dict[str, Repeats] = {}
    for kind in dict.fromkeys(rows.kinds.get(name, "") for name in recorded):
        alike = {name: one for name, one in recorded.items() if rows.kinds.get(name, "") == kind}
        found |= from_repeats(alike, _POWER.get(kind, 2.0), kind in _GROWS)
    return found


def _in_common(found: Repeats, recorded: Recorded, widening: tuple[float, float]) -> Float[np.ndarray, "members members"]:
    """Covariance by the gains and zeros of trials and of traces."""
    trials, traces = widening[0] * found.trial, widening[1] * found.trace
    basis = np.stack([found.centre, np.ones_like(found.centre)], axis=1)
    return _alike(recorded.trial) * (basis @ trials @ basis.T) + _traced(recorded) * (basis @ traces @ basis.T)


def _along(neighbours: float, recorded: Recorded) -> Float[np.ndarray, "members members"]:
    """Correlation neighbours^|steps| within a trace, none between traces."""
    place, together = np.zeros(len(recorded.along)), _traced(recorded)
    for one in range(len(place)):
        inside = np.flatnonzero(together[one])
        place[inside] = np.argsort(np.argsort(recorded.along[inside], kind="stable"), kind="stable")
    return np.where(together, neighbours ** np.abs(place[:, None] - place), 0.0)


def _traced(recorded: Recorded) -> Bool[np.ndarray, "members members"]:
    """Whether two rows are of one trace."""
    return _alike(recorded.trial) & _alike(recorded.condition)


def _alike(numbers: Int[np.ndarray, "members"]) -> Bool[np.ndarray, "members members"]:
    return numbers[:, None] == numbers


def _said(found: Repeats) -> dict[str, float]:
    names = ("trial gain", "trial zero", "trace gain", "trace zero")
    sizes = np.sqrt(np.concatenate([np.diag(found.trial), np.diag(found.trace)]))
    return {**{name: float(size) for name, size in zip(names, sizes, strict=True)}, "neighbours": found.neighbours}


def outliers(rows: Rows, noise: Noise, residual: Float[np.ndarray, "rows"]) -> Noise:
    """The noise with rows that have no repeats weighed by how far they stand out from the residuals of their own block.

    **Arguments:** `residual`: data less model, in the units of the rows. The scale is the block's own (median absolute deviation, at least
    the stated noise), so that a model that misses everywhere weighs nothing down.
    """
    weights = np.array(noise.weights)
    alone = np.bincount(rows.setting)[rows.setting] < 2
    for where in rows.blocks.values():
        size = residual[where] / noise.sigma[where]
        scale = max(1.4826 * float(np.median(np.abs(size - np.median(size)))), 1.0)
        far = np.abs(size - np.median(size)) / scale
        weights[where] = np.where(alone[where], np.minimum(1.0, 3.0 / np.maximum(far, 1e-300)), weights[where])
    return noise.weighed(weights)
