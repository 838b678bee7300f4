"""Parameters before and after: values, and intervals that own up to which effect was chosen, to the mesh, and to what is unexplained.

The interval after is the hull of those of every explanation that is still possible, each widened by the share of the mesh:

    sd^2 -> sd^2 max(1, misfit / df) + mesh^2,        value +- t_nu sd in the raw number, through the link
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy import stats

from ..parameters import Parameter
from .adequacy import Adequacy
from .meshguard import MeshGuard
from .record import EffectRecord, ParameterRecord
from .refit import Optimum

LEVEL = 0.95


def quantile(nu: float) -> float:
    """Half-width of a 95 % interval in standard deviations."""
    return float(stats.t.ppf(0.5 + LEVEL / 2, nu) if math.isfinite(nu) else stats.norm.ppf(0.5 + LEVEL / 2))


def deviations(best: Optimum, tests: Adequacy, mesh: MeshGuard) -> Float[np.ndarray, "q"]:
    """Standard deviations of the raw parameters and of the effects (in units of `scale`); NaN for what is held at a bound."""
    inflated = max(1.0, tests.misfit / max(tests.df, 1.0)) if tests.rejected else 1.0
    variance = np.diag(best.covariance()) * inflated
    variance[: len(best.raw)] += np.nan_to_num(mesh.raw_shift) ** 2
    return np.where(best.free & (variance > 0), np.sqrt(variance), np.nan)


def parameters(best: Optimum, tests: Adequacy, mesh: MeshGuard, nu: float) -> dict[str, ParameterRecord]:
    """Base parameters of one fit."""
    sd, t, limits = deviations(best, tests, mesh), quantile(nu), best.limits()
    found = {}
    for number, parameter in enumerate(best.sample.subject.parameters):
        raw, slope = float(best.raw[number]), float(parameter.slope(best.raw[number]))
        ends = (_natural(parameter, raw - t * sd[number]), _natural(parameter, raw + t * sd[number]))
        shift = slope * abs(float(mesh.raw_shift[number]))
        value, error = float(parameter.natural(raw)), slope * float(sd[number])
        found[parameter.name] = ParameterRecord(
            value, parameter.unit, error, (math.nan, math.nan), shift, ends, limits.get(parameter.name)
        )  # fmt: skip
    return found


def _natural(parameter: Parameter, raw: float) -> float:
    return float(parameter.natural(raw)) if math.isfinite(raw) else math.nan


def hull(fits: Sequence[dict[str, ParameterRecord]]) -> dict[str, ParameterRecord]:
    """The first fit's values with intervals that hold those of all."""
    found = {}
    for name, first in fits[0].items():
        low, high = ([fit[name].ci[side] for fit in fits] for side in (0, 1))
        ends = (float(np.min(low)), float(np.max(high)))
        found[name] = ParameterRecord(first.value, first.unit, first.sd, first.profile_ci, first.mesh_sd, ends, first.at_limit)
    return found


def effects(best: Optimum, tests: Adequacy, mesh: MeshGuard, nu: float) -> dict[str, EffectRecord]:
    """The effects that are awake, each in its own unit, its interval cut at its bounds."""
    sd, t = deviations(best, tests, mesh)[len(best.raw) :], quantile(nu)
    found = {}
    for column, size in zip(best.columns, sd, strict=True):
        value, half = best.phi[column.key], t * float(size) * column.scale
        ends = (column.clipped(value - half), column.clipped(value + half)) if math.isfinite(half) else (math.nan, math.nan)
        found[column.key] = EffectRecord(value, column.unit, ends, column.family)
    return found


def change(before: Optimum, after: Optimum, tests: Adequacy, mesh: MeshGuard) -> dict[str, float]:
    """How far every base parameter moved, in standard deviations that it had before."""
    sd = deviations(before, tests, mesh)[: len(before.raw)]
    moved = (after.raw - before.raw) / sd
    return {parameter.name: float(size) for parameter, size in zip(before.sample.subject.parameters, moved, strict=True)}
