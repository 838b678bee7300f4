"""Does the model fit? Tests that see different misfits, three of the plain model, at levels that sum to alpha: two fifths, two fifths,
and one fifth.

The last is the strictest there, since what it sees is named: where nothing is missed and the model is rejected all the same, nothing is
named then as a rule. What an explanation leaves is held against all of alpha by it, and where there are several kinds of measurement
these must agree on it: to that test the first two give half of theirs. The levels sum to 9/5 of alpha then, and by chance the right
explanation is refused in up to nine of a hundred where alpha is 0.05.

    omnibus     |r|^2 along what can be predicted at all, J apart                         any misfit, weakly
    smooth      the same on the lowest cosines of every condition, made orthogonal to J       what bends slowly, well
    max-T       the largest score of the catalogue                            what the catalogue knows, best
    agreement   the same on what lets kinds of measurement differ (`agreement`)   what is in one kind, and passes for an effect in all

Where none of them rejects, effects that base parameters imitate nearly are refitted, and the largest fall is held against the third
(`inquiry.Inquiry.bent`).

The plain model is not rejected for an effect that is smaller than what any model is wrong by. An explanation is: an effect that takes the
place of another leaves as a rule a little of that one, and what speaks against it need be neither large nor rarer than alpha.

The noise is whitened by what repeats say; that they say it with few degrees of freedom, block by block, is in the laws (`critical`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from .agreement import splits
from .critical import Critical, critical
from .refit import Optimum
from .sample import Sample
from .score import Ranking, rank
from .subject import Family

MODES = 30
# Shares of alpha: what leads to a name must be rarer by chance than what says that something is missed.
OMNIBUS, SMOOTH, LARGEST = 0.4, 0.4, 0.2
AGREEMENT, BESIDE_IT = 0.4, 0.5  # of alpha, and what is left of the first two
AGAINST = 1.0  # of alpha, what leads away from a name: an effect is enough only if it leaves no other one a significant score


@dataclass(frozen=True)
class Adequacy:
    """p values; `df` and `misfit`: degrees of freedom and sum of squares of what could have been predicted; `share`: of alpha, for the
    largest score. `agreement_p` is NaN where it is not asked: of the plain model, and of one kind of measurement.
    """

    omnibus_p: float
    smooth_p: float
    largest_p: float
    df: float
    misfit: float
    alpha: float = 0.05
    share: float = LARGEST
    agreement_p: float = math.nan

    @property
    def rejected(self) -> bool:
        return self.bends or self.resembles or self.disagrees

    @property
    def bends(self) -> bool:
        """Whether one of the two tests that know no effect rejects."""
        level = self.alpha * (BESIDE_IT if math.isfinite(self.agreement_p) else 1.0)
        return self.omnibus_p < OMNIBUS * level or self.smooth_p < SMOOTH * level

    @property
    def disagrees(self) -> bool:
        """Whether kinds of measurement ask for different sizes of what explains them, or for different parameters beside it."""
        return self.agreement_p < AGREEMENT * self.alpha

    @property
    def hardly(self) -> bool:
        """Whether it is rejected for nothing but a likeness to some effect, and no rarer one by chance than the plain model may leave."""
        return self.resembles and self.largest_p >= LARGEST * self.alpha and not self.bends and not self.disagrees

    @property
    def least_p(self) -> float:
        """The smallest p value."""
        return min(p for p in (self.omnibus_p, self.smooth_p, self.largest_p, self.agreement_p) if not math.isnan(p))

    @property
    def resembles(self) -> bool:
        """Whether what is left looks like an effect of the catalogue more than chance would."""
        return self.largest_p < self.share * self.alpha


@dataclass(frozen=True, eq=False)
class Look:
    """All that one optimum shows: what is left, and what could explain it."""

    best: Optimum
    ranking: Ranking
    critical: Critical
    adequacy: Adequacy


def look(best: Optimum, families: Sequence[Family], *, alpha: float, seed: int, explains: bool = False) -> Look:
    """Rank the families at an optimum and test it. Effects that are awake there are part of the model that the others must leave.

    **Arguments:** `explains`: the optimum claims to explain a misfit, so that what is left may look like no effect, however small.
    """
    ranking = rank(best, families, best.sample.subject.columns(best.raw, best.phi))
    predictable, smooth = bases(best)
    apart = tuple(_orthonormal(columns) for columns in splits(best)) if explains else ()
    law = critical(best.sample, ranking, predictable, smooth, apart, alpha=alpha, seed=seed)
    seen = adequacy(best, ranking, law, predictable, smooth, explains)
    return Look(best, ranking, law, replace(seen, agreement_p=law.agreement.p([_square(best, basis) for basis in apart])))


def bases(best: Optimum) -> tuple[Float[np.ndarray, "sample a"], Float[np.ndarray, "sample b"]]:
    """Orthonormal columns, orthogonal to J, of what can be predicted at all, and of what bends slowly."""
    return _orthonormal(best.projection(best.sample.settings())), _orthonormal(best.projection(modes(best.sample)))


def adequacy(
    best: Optimum,
    ranking: Ranking,
    law: Critical,
    predictable: Float[np.ndarray, "sample a"],
    smooth: Float[np.ndarray, "sample b"],
    explains: bool = False,
) -> Adequacy:
    """The tests that a plain model must pass, at an optimum, by a law that need not be its own."""
    misfit, bends = (_square(best, basis) for basis in (predictable, smooth))
    largest = law.largest.p(ranking.largest_of_all if explains else ranking.largest) if ranking.blocks else 1.0
    share = AGAINST if explains else LARGEST
    return Adequacy(law.omnibus.p(misfit), law.smooth.p(bends), largest, float(predictable.shape[1]), misfit, law.alpha, share)


def modes(sample: Sample, count: int = MODES) -> Float[np.ndarray, "sample modes"]:
    """The lowest cosines along every condition of every block, whitened: all constants, all slopes, and so on up to `count`."""
    rows, found = sample.subject.rows, []
    for degree in range(4):
        for name, where in rows.blocks.items():
            along, inside = rows.along(name), np.arange(len(rows))[where]
            for condition in dict.fromkeys(rows.condition[where].tolist()):
                here = (rows.condition[where] == condition) & sample.chosen[where]
                if len(set(along[here].tolist())) > degree:
                    place = (along[here] - along[here].min()) / max(float(np.ptp(along[here])), 1e-300)
                    column = np.zeros(len(rows))
                    column[inside[here]] = np.cos(math.pi * degree * place)
                    found.append(column)
    return sample.columns(np.stack(found[:count], axis=1)) if found else np.zeros((sample.size, 0))


def _square(best: Optimum, basis: Float[np.ndarray, "sample k"]) -> float:
    return float(np.sum((basis.T @ best.residual) ** 2))


def _orthonormal(columns: np.ndarray) -> np.ndarray:
    """A basis of what is left of columns that were projected; those that vanished count for nothing."""
    if columns.shape[1] == 0:
        return columns
    left, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, singular > 1e-7 * max(singular[0], 1e-300)]
