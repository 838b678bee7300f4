"""Which explanations these data cannot tell apart, and the measurement that would.

    cos_kl between Q S_k and Q S_l;   one class where lambda (1 - cos^2) < 13   (95 % power)
    d^2_kl = min over theta, phi_l of |f_k - f_l|^2 = phi_k^2 (G_kk - G_kA G_AA^+ G_Ak),   A = theta and l,   G = [J S]' [J S]

A new measurement adds its own G. The best one makes the least d^2 of any pair largest (Atkinson & Fedorov 1975); among equals the one that
tells theta best is preferred.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from .adequacy import Look
from .record import Confusable, NextExperiment
from .refit import Optimum
from .score import Score
from .subject import Column, Proposal

APART = 13.0  # noncentrality at which two explanations are told apart with 95 % power
ALIKE = 0.7  # cosine from which on a pair is listed
MANY, BEST = 20, 3
REPEATS = (1, 2, 4, 8, 16)


def confusable(base: Look, members: Sequence[str] = ()) -> list[Confusable]:
    """Pairs that leave nearly the same residual, the likest first, and the excess misfit from which on they could be told apart. Pairs
    of `members` are always listed.
    """
    found = []
    for a, b in itertools.combinations(base.ranking.testable, 2):
        cos = alike(a, b)
        if abs(cos) >= ALIKE or {a.family.name, b.family.name} <= set(members):
            needed = APART / max(1.0 - cos**2, 1e-12)
            found.append(Confusable(a.family.name, b.family.name, cos, needed))
    found.sort(key=lambda pair: -abs(pair.cos))
    return found[:MANY] + [pair for pair in found[MANY:] if {pair.a, pair.b} <= set(members)]


def alike(a: Score, b: Score) -> float:
    """The cosine between what two effects leave, each in the direction in which it is expected to change."""
    return float(np.clip(a.direction @ b.direction, -1.0, 1.0))


@dataclass(frozen=True)
class Rival:
    """One effect that is still possible: its column and its size from null."""

    column: Column
    size: float

    @property
    def name(self) -> str:
        return self.column.family


def next_experiments(best: Optimum, rivals: Sequence[Rival], columns: Mapping[str, np.ndarray]) -> list[NextExperiment]:
    """The three measurements that would separate the rivals best, with the repeats that they need.

    **Arguments:** `best`: the base fit. `columns`: key -> (rows,) of the subject at its optimum. Repeats of conditions that were fitted
    are tried beside what the subject proposes. Base parameters at a limit stay there: they imitate nothing.
    """
    if len(rivals) < 2:
        return []
    now = _gram(best, rivals, columns)
    before = distances(now, rivals)
    found = []
    for proposal in (*best.sample.subject.proposals(best.raw), *repeated(best, columns)):
        added = _added(proposal, rivals, best.free[: len(best.raw)])
        repeats, after = _enough(now, added, rivals)
        tells = float(np.linalg.slogdet(_scaled(now + added)[: len(best.raw), : len(best.raw)])[1])
        record = NextExperiment(proposal.condition, repeats, min(before.values()), min(after.values()), after)
        found.append((record.d2_after < APART, repeats, -round(record.d2_after, 6), -tells, record))
    return [entry[-1] for entry in sorted(found, key=lambda entry: entry[:-1])[:BEST]]


def _enough(now: np.ndarray, added: np.ndarray, rivals: Sequence[Rival]) -> tuple[int, dict[str, float]]:
    """The fewest repeats that tell every pair apart, or the most that are tried, and the distances then."""
    tried = [(repeats, distances(now + repeats * added, rivals)) for repeats in REPEATS]
    return next((one for one in tried if min(one[1].values()) >= APART), tried[-1])


def distances(gram: Float[np.ndarray, "q q"], rivals: Sequence[Rival]) -> dict[str, float]:
    """`a | b` -> d^2, the smaller of the two ways round."""
    p = gram.shape[0] - len(rivals)

    def one_way(k: int, other: int) -> float:
        others = [*range(p), p + other]
        block, cross = gram[np.ix_(others, others)], gram[others, p + k]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(block), 1e-300))
        solved = np.linalg.lstsq(block * np.outer(scale, scale), cross * scale, rcond=1e-10)[0]
        return float(max(gram[p + k, p + k] - (cross * scale) @ solved, 0.0)) * rivals[k].size ** 2

    pairs = itertools.combinations(range(len(rivals)), 2)
    return {f"{rivals[a].name} | {rivals[b].name}": min(one_way(a, b), one_way(b, a)) for a, b in pairs}


def repeated(best: Optimum, columns: Mapping[str, np.ndarray]) -> list[Proposal]:
    """Every fitted condition once more: one row of each of its settings."""
    rows, chosen = best.sample.subject.rows, best.sample.chosen
    sd = np.sqrt(np.diag(best.sample.covariance))
    found = []
    for condition in dict.fromkeys(rows.condition[chosen].tolist()):
        inside = np.flatnonzero(chosen & (rows.condition == condition))
        once = inside[np.unique(rows.setting[inside], return_index=True)[1]]
        taken = {key: np.asarray(column, dtype=float)[once] for key, column in columns.items()}
        found.append(Proposal(f"{condition}, repeated", best.at.theta_jacobian[once], taken, sd[once]))
    return found


def _gram(best: Optimum, rivals: Sequence[Rival], columns: Mapping[str, np.ndarray]) -> Float[np.ndarray, "q q"]:
    effects = best.sample.columns(np.array([columns[rival.column.key] for rival in rivals], dtype=float).T)
    p = len(best.raw)
    whole = np.concatenate([np.where(best.free[:p], best.jacobian[:, :p], 0.0), effects], axis=1)
    return whole.T @ whole


def _added(proposal: Proposal, rivals: Sequence[Rival], free: Bool[np.ndarray, "p"]) -> Float[np.ndarray, "q q"]:
    effects = np.array([proposal.columns[rival.column.key] for rival in rivals], dtype=float).T
    whole = np.concatenate([np.where(free, proposal.theta_jacobian, 0.0), effects], axis=1) / proposal.sigma[:, None]
    return whole.T @ whole


def _scaled(gram: np.ndarray) -> np.ndarray:
    """The matrix with its smallest numbers kept from 0, so that its determinant can be compared."""
    return gram + 1e-12 * float(np.trace(gram)) / len(gram) * np.eye(len(gram)) if math.isfinite(float(np.trace(gram))) else gram
