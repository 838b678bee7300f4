"""Parameters before and after: values, and intervals that own up to which effect was chosen, to the mesh, and to what is unexplained.

The interval after is the hull of those of every explanation that is still possible, each widened by the share of the mesh:

    sd^2 -> sd^2 max(1, misfit / df) + mesh^2,        value +- t_nu sd in the raw number, through the link

An effect may come with one that was found, as finite strain does with tissue that stiffens: too little of it to be named, and yet enough to
move the parameters. Each end is moved out by what as much of it would do as is plausible and the residual allows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy import stats

from ..parameters import Parameter
from .adequacy import Adequacy, Look
from .meshguard import MeshGuard
from .record import EffectRecord, ParameterRecord
from .refit import Optimum
from .subject import Family

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


def parameters(seen: Look, mesh: MeshGuard, nu: float, beside: Sequence[str] = ()) -> dict[str, ParameterRecord]:
    """Base parameters of one fit. `beside`: families that may come with it, see `alongside`."""
    best, tests = seen.best, seen.adequacy
    sd, t, limits = deviations(best, tests, mesh), quantile(nu), best.limits()
    less, more = moved_by(seen, beside, t)
    found = {}
    for number, parameter in enumerate(best.sample.subject.parameters):
        raw, slope = float(best.raw[number]), float(parameter.slope(best.raw[number]))
        ends = (_natural(parameter, raw - t * sd[number] + less[number]), _natural(parameter, raw + t * sd[number] + more[number]))
        shift = slope * abs(float(mesh.raw_shift[number]))
        value, error = float(parameter.natural(raw)), slope * float(sd[number])
        found[parameter.name] = ParameterRecord(
            value, parameter.unit, error, (math.nan, math.nan), shift, ends, limits.get(parameter.name)
        )  # fmt: skip
    return found


def alongside(families: Sequence[Family], seen: Look) -> tuple[str, ...]:
    """What may come with effects that were found, of what was asked for and is not awake itself."""
    awake, asked = {family.name for family in families}, {score.family.name for score in seen.ranking.scores}
    wanted = (name for family in families for name in family.comes_with)
    return tuple(dict.fromkeys(name for name in wanted if name in asked - awake))


def moved_by(seen: Look, beside: Sequence[str], t: float) -> tuple[Float[np.ndarray, "p"], Float[np.ndarray, "p"]]:
    """How far effects that were not fitted may move the raw parameters, down and up: each by as much as is plausible and, where it can be
    told from the parameters, within `t` standard deviations of what the residual asks for.
    """
    less, more = np.zeros(len(seen.best.raw)), np.zeros(len(seen.best.raw))
    for name in beside:
        score = seen.ranking[name]
        if score.shift_of_unit is None:
            continue
        column = score.family.columns[0]
        wanted, half = (score.change.get(column.key, 0.0), t / score.length) if score.length > 0 else (0.0, math.inf)
        sizes = np.clip([wanted - half, wanted + half], column.lower - column.null, column.upper - column.null)
        moved = np.outer(sizes, score.shift_of_unit)
        less, more = less + np.minimum(moved.min(axis=0), 0.0), more + np.maximum(moved.max(axis=0), 0.0)
    return less, more


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
