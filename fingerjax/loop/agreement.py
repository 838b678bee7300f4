"""Whether all kinds of measurement agree on an explanation.

An effect on the finger or on the rig shows in profiles, forces and rates at once, and so do the moduli; what an instrument does shows in
its own readings alone. An effect that takes the place of another, as a frame that gives takes that of a lens that distorts, suits one kind
of measurement where another would have had it smaller, or would have had other moduli:

    E = Q [S in each kind of measurement but one]           every kind may choose its own size of the effect
    E = Q [J and S in each kind of measurement but one]     and its own parameters
    |P_E r|^2                                               the fall of the sum of squares, if it could

A test of specification by two estimates that agree only where the model is right (Hausman 1978, Econometrica 46, 1251).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from .refit import Optimum

ACTS = 0.03  # share of a column's length from which on it acts in a kind of measurement
LEFT = 1e-3  # share of a split column's length that must be left beside all that is free


def splits(best: Optimum) -> tuple[Float[np.ndarray, "sample _"], ...]:
    """Columns, orthogonal to all that is free, by which kinds of measurement may differ: in the sizes of the effects, and in everything.

    None where there is one kind, or where an effect acts in one alone and nothing else is free.
    """
    kinds, free = _kinds(best), np.where(best.free, best.jacobian, 0.0)
    found = (_split(best, columns, kinds) for columns in (free[:, len(best.raw) :], free))
    return tuple(columns for columns in found if columns.shape[1])


def _split(best: Optimum, columns: Float[np.ndarray, "sample q"], kinds: list[Bool[np.ndarray, "sample"]]) -> Float[np.ndarray, "sample _"]:
    parts = [part for column in columns.T for part in _by_kind(column, kinds)]
    if not parts:
        return np.zeros((best.sample.size, 0))
    whole = np.stack(parts, axis=1)
    left, lengths = best.projection(whole), np.linalg.norm(whole, axis=0)
    return left[:, np.linalg.norm(left, axis=0) > LEFT * lengths]


def _by_kind(column: Float[np.ndarray, "sample"], kinds: list[Bool[np.ndarray, "sample"]]) -> list[Float[np.ndarray, "sample"]]:
    """A column in each kind of measurement in which it acts, but for the last."""
    parts = [np.where(kind, column, 0.0) for kind in kinds]
    return [part for part in parts if np.linalg.norm(part) > ACTS * np.linalg.norm(column)][:-1]


def _kinds(best: Optimum) -> list[Bool[np.ndarray, "sample"]]:
    """The fitted rows of each kind of measurement; priors are of none."""
    rows, sample = best.sample.subject.rows, best.sample
    kinds = [rows.kinds.get(block, block) for block in rows.block[sample.chosen].tolist()]
    named = np.array([*kinds, *[""] * (sample.size - len(kinds))])
    return [named == kind for kind in dict.fromkeys(kinds)]
