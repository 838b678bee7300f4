"""Conditions that a fit does not see: some decide whether an effect is kept, some are touched by nothing until the end.

Whole conditions are held out, never points of one: neighbours of a fitted point say nothing that the fit did not know.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float

from .refit import Optimum
from .subject import Rows
from .whitening import Projection, Whitener

ENOUGH = 4  # conditions of a block from which on one of them can be spared
WORSE = 9.0  # chi-square by which an effect may make held-out conditions worse


def roles(rows: Rows) -> dict[str, str]:
    """Condition -> role: as the study says, or else the middle condition of each block of four or more is kept for the report, and
    `leave_out` stands for a veto.
    """
    chosen = {condition: rows.roles.get(condition, "fit") for condition in rows.conditions}
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
    """
    if held.any():
        return _chi2(other, other.sample.error(other.at), held) - _chi2(base, base.sample.error(base.at), held)
    names = base.sample.subject.rows.condition
    turns = [base.sample.chosen & (names == name) for name in dict.fromkeys(names[base.sample.chosen].tolist())]
    if len(turns) < 2:
        return math.nan
    return sum(_chi2(other, leave_out(other, turn), turn) - _chi2(base, leave_out(base, turn), turn) for turn in turns)


def _chi2(at: Optimum, error: Float[np.ndarray, "rows"], where: Bool[np.ndarray, "rows"]) -> float:
    return float(np.sum(Whitener.of(at.sample.covariance[np.ix_(where, where)])(error[where]) ** 2))


def leave_out(best: Optimum, turn: Bool[np.ndarray, "rows"]) -> Float[np.ndarray, "rows"]:
    """(rows,) data less prediction of a fit that did not see some of its rows: one Gauss-Newton step away, exact for a linear model."""
    sample, p = best.sample, len(best.raw)
    rest = sample.chosen & ~turn
    scales = np.array([column.scale for column in best.columns])
    slopes = np.concatenate([best.at.theta_jacobian, best.at.phi_jacobian * scales], axis=1)
    whiten = Whitener.of(sample.covariance[np.ix_(rest, rest)])
    error = sample.error(best.at)
    priors = len(sample.subject.priors)
    sizes = np.array([(best.phi[column.key] - column.null) / column.scale for column in best.columns])
    below = np.concatenate([np.zeros((len(sizes), p)), np.eye(len(sizes))], axis=1)
    jacobian = np.concatenate([whiten(slopes[rest]), best.jacobian[best.jacobian.shape[0] - priors :], below])
    residual = np.concatenate([whiten(error[rest]), best.residual[best.residual.size - priors :], -sizes])
    step = np.where(best.free, Projection.of(np.where(best.free, jacobian, 0.0)).inverse @ residual, 0.0)
    return error - slopes @ step
