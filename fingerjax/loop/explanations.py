"""An explanation of a misfit: one or two effects, refitted, and what speaks for and against them.

An explanation stays in the set where

    a  Delta = RSS_0 - RSS_k > c_k^2                  it explains more than chance would, and what the mesh leaves
    b  the tests of adequacy pass with it             leaves nothing to be explained, however small, and suits all kinds of measurement
    c  held-out conditions are not worse by 9         it predicts what it has not seen
    d  it lies inside what is plausible
    e  somewhere it is larger than what any model is wrong by

The right one fails b for what else its residual happens to look like in one of twenty diagnoses, and a wrong one may pass. To name that
one alone while another fits better would say more than is known: beside explanations that stay, those of as many effects stay too that
leave a smaller sum of squares than the best of them, unless b fails by what less than one in a hundred would leave by chance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from . import heldout, material
from .adequacy import Look
from .refit import Optimum

MATERIAL, AHEAD = 0.97, 13.0  # share of the excess misfit, and lead in RSS, from which on one effect is the main one
SURELY, OVER = 3.0, 0.5  # a misfit, in its standard deviations by chance, and the share that is left of one that is passed over


@dataclass(frozen=True, eq=False)
class Explanation:
    """One or two families, refitted.

    - `families`, `look`: who, and what is left with them. `delta`: RSS_0 - RSS_k.
    - `eta`: share of the excess misfit that is gone, 0 where there was none.
    - `drops`: family -> rise of RSS without it. `veto`: rise of chi-square on held-out conditions. `needed`: family -> what its drop must
      exceed.
    - `times_form`: how many times what any model is wrong by the prediction changes, from the base or from the first of two alone.
    - `passed_over`: measurements whose misfit is left as it was, or more than half of it.
    """

    families: tuple[str, ...]
    look: Look
    delta: float
    eta: float
    drops: Mapping[str, float]
    veto: float
    needed: Mapping[str, float]
    times_form: float = math.inf
    passed_over: tuple[str, ...] = ()

    @property
    def best(self) -> Optimum:
        return self.look.best

    @property
    def name(self) -> str:
        return " + ".join(self.families)

    @property
    def significant(self) -> bool:
        return self.best.settled and all(drop > self.needed[family] for family, drop in self.drops.items())

    @property
    def holds(self) -> bool:
        """Whether held-out conditions do not object; where there are none they cannot."""
        return not self.veto > heldout.WORSE

    @property
    def matters(self) -> bool:
        """Whether it is larger than what any model is wrong by."""
        return self.times_form >= material.ENOUGH

    @property
    def left(self) -> float:
        """The excess misfit that is left."""
        return self.look.adequacy.misfit - self.look.adequacy.df

    @property
    def helps(self) -> bool:
        """Significant, large enough to matter, and no veto: a better model within what is plausible, were it at the very end of that."""
        return self.significant and self.matters and self.holds

    @property
    def sound(self) -> bool:
        """All but that nothing is left: it helps, and does not ask for more than is plausible."""
        return self.helps and self.best.plausible

    @property
    def in_set(self) -> bool:
        return self.sound and not self.look.adequacy.rejected

    @property
    def reason(self) -> str:
        """Why it is not in the set; nothing where it is."""
        if not self.best.settled:
            return self.best.reason
        tests = self.look.adequacy
        said = [
            (not self.significant, "explains no more than chance would"),
            (not self.best.plausible, "runs to the end of what is plausible"),
            (not self.matters, "changes no measurement by more than any model is wrong by"),
            (tests.bends or tests.resembles, "leaves something to be explained"),
            (tests.disagrees, "is not the same to all kinds of measurement"),
            (not self.holds, "makes held-out conditions worse"),
        ]
        return "; ".join(why for true, why in said if true)

    def bic(self, settings: int) -> float:
        return self.best.rss + self.best.jacobian.shape[1] * math.log(max(settings, 2))


def remaining(those: list[Explanation]) -> tuple[Explanation, ...]:
    """Of explanations by as many effects each, in their order, those that are enough, and those that fit better than each of these and
    are refused by hardly anything.
    """
    least = min((one.best.rss for one in those if one.in_set), default=-math.inf)
    better = [one.sound and one.look.adequacy.hardly and one.best.rss < least for one in those]
    return tuple(one for one, fits in zip(those, better, strict=True) if one.in_set or fits)


def ahead_of(others: list[Explanation]) -> float:
    """The sum of squares below which an explanation is far ahead of each of the others that is enough; inf where none is."""
    return min((one.best.rss for one in others if one.in_set), default=math.inf) - AHEAD


def passed_over(base: Optimum, best: Optimum, chance: float) -> tuple[str, ...]:
    """Measurements that miss more than chance would and keep more than half of that: an effect on a precise one may remove nearly all
    of the misfit, and say nothing of another that is known less well.
    """
    rows, chosen = base.sample.subject.rows, base.sample.chosen
    squares = [one.sample.error(one.at) ** 2 / np.diag(base.sample.covariance) for one in (base, best)]
    found = []
    for name, where in rows.blocks.items():
        count = int(np.sum(chosen[where]))
        before, after = (float(np.sum(each[where][chosen[where]])) - count for each in squares)
        if before > max(chance, SURELY * math.sqrt(2 * count)) and after > OVER * before:
            found.append(name)
    return tuple(found)


def main(singles: list[Explanation]) -> Explanation | None:
    """The effect that explains nearly all of the misfit, passes no measurement over and leads every other family by far, though something
    is left.
    """
    sound = [one for one in singles if one.sound]
    if not sound or sound[0].eta < MATERIAL or sound[0].passed_over:
        return None
    others = [gain(one.delta) for one in singles if one is not sound[0]]
    return sound[0] if sound[0].delta - max(others, default=0.0) >= AHEAD else None


def gain(value: float) -> float:
    """A fall of the sum of squares as a number to sort by: of a search that did not settle none is known."""
    return value if math.isfinite(value) else -math.inf
