"""Conditions that a fit does not see: some decide whether an effect is kept, some are touched by nothing until the end.

Whole conditions are held out, never points of one: neighbours of a fitted point say nothing that the fit did not know.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from ..errors import InputError
from .refit import Optimum
from .subject import Rows
from .whitening import Projection, Whitener

ALPHA = 1e-3  # probability by chance below which conditions that nothing has seen speak against a model
CERTAIN = 1e9  # degrees of freedom of a noise that is taken at its word
ENOUGH = 4  # conditions of a block from which on one of them can be spared
WORSE = 9.0  # chi-square by which an effect may make held-out conditions worse


def roles(rows: Rows) -> dict[str, str]:
    """Condition -> role: as the study says, or else the middle condition of each block of four or more is kept for the report, and
    `leave_out` stands for a veto.
    """
    chosen = {condition: rows.roles.get(condition, "fit") for condition in rows.conditions}
    if "fit" not in chosen.values():
        raise InputError("every condition is held out", seen=list(chosen), remedy="leave one at least to be fitted")
    if rows.roles:
        return chosen
    for where in rows.blocks.values():
        here = list(dict.fromkeys(rows.condition[where].tolist()))
        if len(here) >= ENOUGH:
            chosen[here[len(here) // 2]] = "report"
    return chosen


def in_role(rows: Rows, roles: dict[str, str], role: str) -> Bool[np.ndarray, "rows"]:
    """The rows whose condition has this role."""
    return np.array([roles[condition] == role for condition in rows.condition.tolist()], dtype=bool)


def veto(base: Optimum, other: Optimum, held: Bool[np.ndarray, "rows"]) -> float:
    """By how much chi-square of held-out conditions grows from the base to an explanation: of `held`, or where that is empty of the
    conditions that were fitted, left out in turn. NaN where there is only one of them.

    What a prediction does not know of its own parameters counts as noise, so that only what is wrong and sure of itself is worse.
    """
    names, chosen = base.sample.subject.rows.condition, base.sample.chosen
    turns = [held] if held.any() else [chosen & (names == name) for name in dict.fromkeys(names[chosen].tolist())]
    if len(turns) < 2 and not held.any():
        return math.nan
    return sum(surprise(other, turn) - surprise(base, turn) for turn in turns)


@dataclass(frozen=True)
class Foretold:
    """How well conditions that nothing has seen are foretold.

    - `times`: root mean square of their misfit over what noise and the fit's own uncertainty allow; `p`: of so much by chance.
    """

    times: float
    p: float

    @property
    def contradicted(self) -> bool:
        """Whether they speak against the model."""
        return self.p < ALPHA


def foretold(best: Optimum, held: Bool[np.ndarray, "rows"]) -> Foretold | None:
    """A fit against rows that it did not see: of each setting the mean of its repeats. None where there are no such rows.

    The noise counts as known no better than that of the block of which least is known.
    """
    if not held.any():
        return None
    error, slopes, spread = leave_out(best, held)
    whiten = Whitener.of(best.sample.covariance[np.ix_(held, held)] + slopes[held] @ spread @ slopes[held].T)
    numbers = np.unique(best.sample.subject.rows.setting[held], return_inverse=True)[1].reshape(-1)
    means, _ = np.linalg.qr(whiten(np.eye(numbers.max() + 1)[numbers]))
    times = float(np.mean((means.T @ whiten(error[held])) ** 2))
    dof = min(best.sample.freedom[name] for name in set(best.sample.subject.rows.block[held].tolist()))
    return Foretold(math.sqrt(times), float(stats.f.sf(times, means.shape[1], min(dof, CERTAIN))))


def surprise(best: Optimum, turn: Bool[np.ndarray, "rows"]) -> float:
    """Chi-square of rows as predicted without them: one Gauss-Newton step away, exact for a linear model."""
    error, slopes, spread = leave_out(best, turn)
    known = best.sample.covariance[np.ix_(turn, turn)] + slopes[turn] @ spread @ slopes[turn].T
    return float(np.sum(Whitener.of(known)(error[turn]) ** 2))


def leave_out(
    best: Optimum, turn: Bool[np.ndarray, "rows"]
) -> tuple[Float[np.ndarray, "rows"], Float[np.ndarray, "rows q"], Float[np.ndarray, "q q"]]:
    """(data less prediction of a fit that did not see some of its rows, derivative of the prediction, covariance of that fit)."""
    sample, p = best.sample, len(best.raw)
    scales = np.array([column.scale for column in best.columns])
    slopes = np.where(best.free, np.concatenate([best.at.theta_jacobian, best.at.phi_jacobian * scales], axis=1), 0.0)
    error, rest = sample.error(best.at), sample.chosen & ~turn
    whiten = Whitener.of(sample.covariance[np.ix_(rest, rest)])
    priors = len(sample.subject.priors)
    sizes = np.array([(best.phi[column.key] - column.null) / column.scale for column in best.columns])
    below = np.where(best.free, np.concatenate([np.zeros((len(sizes), p)), np.eye(len(sizes))], axis=1), 0.0)
    jacobian = np.concatenate([whiten(slopes[rest]), best.jacobian[best.jacobian.shape[0] - priors :] * best.free, below])
    residual = np.concatenate([whiten(error[rest]), best.residual[best.residual.size - priors :], -sizes])
    projection = Projection.of(jacobian)
    return error - slopes @ (projection.inverse @ residual), slopes, projection.covariance()
