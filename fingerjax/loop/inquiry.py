"""The search for explanations: effects refitted one by one, then two together, and kept only where nothing speaks against them.

A second term of the same effect is tried before another effect is. Where the set of explanations is empty two effects are tried together,
each of which must explain more than chance given the other. Where it is not, two together join it only where they are far ahead of every
one in it: an effect that is not there may imitate two that are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import zip_longest

import numpy as np
from jaxtyping import Bool, Float

from ..study_records import Reach
from . import heldout, material
from .adequacy import Look, look
from .explanations import SURELY, Explanation, ahead_of, gain, passed_over
from .meshguard import correction, drift
from .refit import Keep, Optimum, forget, optimum
from .sample import Sample
from .score import Node, Ranking, combined
from .subject import Column, Family

FAMILIES, NODES = 7, 2  # refitted, best first
NEARLY, MOST = 0.7, 0.5  # of the leader's fall of RSS, and of what RSS has too much, from which on the mesh is asked again
BEHIND = 10.0  # critical values by which an explanation may be behind the leader and still be followed to its end
ASKED, SAME = 2, 0.5  # times that the mesh is asked, and change of what it says, in standard errors, that is none
ASTRAY = 5.0  # misfit over degrees of freedom from which on the end of a fit is no place to begin
REMOTE = 0.25  # of the fall of RSS that an effect needs: one that promises less is not refitted where another is enough
DEAR = 0.5  # of the leader's fall of RSS: an effect that is dear to refit and promises less is asked for beside another, but not alone
CLOSE = 0.8  # share of the best node's statistic from which on another is refitted too
SHARES = (1.0, 0.5, 0.25)  # of the change that a score expects, or of what is plausible: the first with which the model has an answer
LEADS, RIVALS = 4, 3  # singles, and what each may be paired with
PARTLY = 1 / 3  # of what is left of the excess misfit: a second effect that promises less will not make a model with which nothing is left
FAINT = 0.15  # share of a column that the base parameters leave, below which a fit may have bent them so far that a score tells nothing

Tell = Callable[[float, str], object]


@dataclass(eq=False)
class Inquiry:
    """A base fit, and what is asked of it.

    - `early`: the families ranked where the study began, where the base fit ended far from there: a fit that bends its parameters to
      imitate an effect hides that effect from a score at its end.
    - `held` (rows,): conditions with a veto. `margins`: family -> what the mesh asks on top of the critical value.
    - `blamed`: whether the mesh could have made all of the misfit: then neither what is dear nor two effects at once are tried.
    - `kept`: stores finished searches by name. `tell(share, what)` hears of the progress. `reach`: how far the search goes.
    """

    base: Look
    families: tuple[Family, ...]
    held: Bool[np.ndarray, "rows"]
    alpha: float
    seed: int
    margins: Mapping[str, float] = field(default_factory=dict)
    kept: Keep = forget
    tell: Tell = lambda share, what: None
    early: Ranking | None = None
    blamed: bool = False
    reach: Reach = field(default_factory=Reach)
    found: dict[str, Explanation] = field(default_factory=dict)
    paired: set[frozenset[str]] = field(default_factory=set)  # families that were tried together
    leading: float = 0.0  # the largest fall of RSS so far

    @property
    def enough(self) -> float:
        """Sum of squares above which an explanation is no better than chance, or far behind the leader: one that does not promise to come
        below is given up.

        While none leaves nothing to be explained, all that get half of the way are followed, as partners of a second effect.
        """
        alone = any(one.in_set for one in self.found.values())
        behind = BEHIND * self.chance if alone else max(BEHIND * self.chance, 0.5 * self.base.best.rss)
        return self.base.best.rss - max(self.leading - behind, self.chance)

    @property
    def chance(self) -> float:
        """Delta that chance does not reach."""
        return self.base.critical.value**2

    def needed(self, family: str) -> float:
        """Delta that chance and what the mesh leaves do not reach."""
        return (self.base.critical.value + self.margins.get(family, 0.0)) ** 2

    def single(self, family: str) -> Explanation:
        """The best explanation by one family, refitted once: its best nodes, and a second term where one is not enough."""
        if family not in self.found:
            fits = [self._fitted(node) for node in _worth_fitting(self.base.ranking[family].nodes)]
            first = self._explained((family,), min(fits, key=_misfit), {family: self.base.best.rss})
            self.found[family] = self._second(first) or first
        return self.found[family]

    def _fitted(self, node: Node) -> Optimum:
        sample, begun = self.base.best.sample, list(starts(node, self.base.best))
        if self.early is not None:
            family = self.early[node.columns[0].family]
            same = [one for one in family.nodes if one.columns == node.columns]
            wanted = {one.key: same[0].change[one.key] if same else begun[-1][1][one.key] - one.null for one in node.columns}
            likely = {one.key: float(np.clip(wanted[one.key], -one.scale, one.scale)) for one in node.columns}
            begun = [(first(sample), {one.key: _towards(one, share * likely[one.key]) for one in node.columns}) for share in SHARES]
            begun = [next((start for start in begun if _answers(sample, *start)), begun[-1])]
        fits = [
            optimum(sample, node.columns, raw, start, name=_label(node.columns, number), kept=self.kept, enough=self.enough)
            for number, (raw, start) in enumerate(begun)
        ]
        return min(fits, key=_misfit)

    def _explained(
        self, families: tuple[str, ...], best: Optimum, without: Mapping[str, float], beside: Optimum | None = None
    ) -> Explanation:
        """**Arguments:** `without`: family -> RSS of the fit that lacks it. `beside`: the fit that the last family was added to, else the
        base. The mesh's correction is made anew for what was found.
        """
        best = self._on_its_own_mesh(best)
        others = [family for family in self.families if family.name not in families]
        needed = {family: self.needed(family) for family in families}
        if not best.settled:
            nothing = dict.fromkeys(families, math.nan)
            return Explanation(families, self._blank(best), math.nan, math.nan, nothing, math.nan, needed)
        seen = look(best, others, alpha=self.alpha, seed=self.seed, explains=True)
        base = self.base.adequacy
        excess = base.misfit - base.df
        eta = 1.0 - (seen.adequacy.misfit - seen.adequacy.df) / excess if excess > 0 else 0.0
        drops = {family: rss - best.rss for family, rss in without.items()}
        worse = heldout.veto(self.base.best, best, self.held)
        before = self.base.best if beside is None else beside
        change = (best.at.prediction + best.sample.offset) - (before.at.prediction + before.sample.offset)
        times = material.times_form(best.sample.subject.rows, best.sample.chosen, change)
        left_out = passed_over(self.base.best, best, self.chance)
        return Explanation(families, seen, self.base.best.rss - best.rss, eta, drops, worse, needed, times, left_out)

    def _least(self, single: Explanation) -> float:
        """Its sum of squares, or where the search was given up what it did not promise to come below."""
        return single.best.rss if single.best.settled else min(single.best.rss, self.enough)

    def _blank(self, best: Optimum) -> Look:
        return Look(best, self.base.ranking, self.base.critical, self.base.adequacy)

    def _on_its_own_mesh(self, best: Optimum) -> Optimum:
        """With the mesh's correction made anew where the effect led, for those that are near the leader and do not surely leave most."""
        base = self.base.best
        delta = base.rss - best.rss
        self.leading = max(self.leading, delta if best.settled else 0.0)
        far = delta < MOST * (base.rss - base.df) and best.rss > best.df + SURELY * math.sqrt(2 * best.df)
        if not best.settled or far or delta < max(self.chance, NEARLY * self.leading) or not best.sample.offset.any():
            return best
        for number in range(ASKED):
            asked = best.at
            known = correction(best.sample.subject, best.raw, best.phi, asked)
            if known is None or np.linalg.norm(best.sample.columns((known.offset - best.sample.offset)[:, None])) < SAME:
                break
            name = f"{_label(best.columns)} on its own mesh {number}"
            corrected = best.sample.corrected(known.offset)
            again = optimum(corrected, best.columns, best.raw, best.phi, name=name, kept=self.kept, at=best.at)
            if not again.settled:
                break
            best = again
            if drift(known, best.sample, asked, best.at) < SAME:
                break
        return best

    def _second(self, first: Explanation) -> Explanation | None:
        """With a second term of the same family, where the first is sound but not enough and the second explains more than chance."""
        family = next(one for one in self.families if one.name == first.families[0])
        if not (family.second and first.significant and first.look.adequacy.rejected):
            return None
        base = self.base.best
        nodes = combined(base, family.columns, family.second, base.sample.subject.columns(base.raw))[: NODES + 1]
        if not nodes:
            return None
        both = self._explained(first.families, min((self._fitted(node) for node in nodes), key=_misfit), {family.name: base.rss})
        return both if both.best.settled and first.best.rss - both.best.rss > self.needed(family.name) else None

    def _added(self, first: Explanation, node: Node) -> Optimum:
        """An explanation with one effect more; given up where that does not promise to explain more than chance beside it."""
        sample, columns = first.best.sample, (*first.best.columns, *node.columns)
        enough = min(self.enough, first.best.rss - self.needed(node.columns[0].family))
        begun = [(raw, {**first.best.phi, **start}) for raw, start in starts(node, first.best)]
        fits = [
            optimum(sample, columns, raw, start, name=_label(columns, number), kept=self.kept, enough=enough)
            for number, (raw, start) in enumerate(begun)
        ]
        return min(fits, key=_misfit)

    def bent(self) -> Look:
        """The base, tested by refits too of what base parameters imitate nearly: a fit without the effect goes so far to do so that at its
        end a score, which is of first order, no longer shows it.

        By chance alone the fall of the sum of squares is the square of the score, to first order, and the law of the largest holds for it.
        """
        faint = [score for score in self.base.ranking.testable if score.left < FAINT and len(score.nodes[0].columns) == 1]
        asked = [score.family.name for score in faint if not score.family.dear]
        for number, name in enumerate(asked):
            self.tell(number / len(asked), f"refit with {name}")
            self.single(name)
        fall = max((self.found[name].delta for name in asked if self.found[name].significant and self.found[name].matters), default=0.0)
        tests = self.base.adequacy
        p = min(tests.largest_p, self.base.critical.largest.p(math.sqrt(max(fall, 0.0))))
        self.base = replace(self.base, adequacy=replace(tests, largest_p=p))
        return self.base

    def singles(self) -> list[Explanation]:
        """The families that promise most, refitted, best first; where there are two rankings, by turns. Those that are dear come last.

        A refit finds more than a score expects where an effect is large and bends, but that is of a large misfit: where one effect is
        enough, those of which the score expects next to nothing are left out, and those that are dear where it expects far less than the
        leader brought.
        """
        late = [score.family.name for score in self.base.ranking.promising]
        early = [] if self.early is None else [score.family.name for score in self.early.promising if score.family.name in late]
        turns = [name for pair in zip_longest(early, late) for name in pair if name is not None]
        dear = {family.name for family in self.families if family.dear}
        ranked = sorted(list(dict.fromkeys(turns))[:FAMILIES], key=lambda name: name in dear)
        for number, name in enumerate(ranked):
            if self._remote(name, name in dear) or (self.blamed and name in dear):
                continue
            self.tell(number / len(ranked), f"refit with {name}")
            self.single(name)
        return sorted(self.found.values(), key=lambda one: -gain(one.delta))

    def _remote(self, family: str, dear: bool) -> bool:
        """Whether an effect promises next to nothing beside one that is enough, or is dear and promises far less than another brought.

        Where the base fit was driven far away its residual tells less: there another must be enough, and the effect must promise far less
        than others where the study began as well.
        """
        promise, alone = self.base.ranking[family].promising.promise, any(one.in_set for one in self.found.values())
        far_less = dear and promise < DEAR * self.leading
        if self.early is None:
            return far_less or (alone and promise < REMOTE * self.needed(family))
        begun = {score.family.name: score.promising.promise for score in self.early.promising}
        return alone and far_less and begun.get(family, 0.0) < DEAR * max(begun.values(), default=0.0)

    def pairs(self, singles: list[Explanation]) -> list[Explanation]:
        """Two effects at once: the leading singles, each with what its own residual asks for, where that explains more than chance.

        Those are tried that promise the least sum of squares. A score is no more than linear, so that one is asked for which promises a
        third of what is left; where one effect is enough only those are that promise to be ahead of it. Pairs with what is dear to refit
        come last, and there two that are enough count as one effect that is.
        """
        if self.blamed:
            return []
        leads, below = [one for one in singles if one.significant][:LEADS], ahead_of(singles)
        asked = [(lead, node) for lead in leads for node in self._rivals(lead, PARTLY * lead.left) if lead.best.rss - node.promise < below]
        asked.sort(key=lambda pair: pair[0].best.rss - pair[1].promise)
        pairs: dict[frozenset[str], tuple[Explanation, Node]] = {}
        for lead, node in asked:
            pairs.setdefault(frozenset((lead.families[0], node.columns[0].family)), (lead, node))
        dear = {family.name for family in self.families if family.dear}
        first = list(pairs.items())[: self.reach.pairs]
        found: list[Explanation] = []
        for number, (names, (lead, node)) in enumerate(sorted(first, key=lambda one: bool(one[0] & dear))):
            if names & dear and lead.best.rss - node.promise >= ahead_of(found):
                continue
            family = node.columns[0].family
            self.tell(number / self.reach.pairs, f"refit with {lead.families[0]} and {family}")
            self.paired.add(names)
            fit = self._added(lead, node)
            if fit.settled and lead.best.rss - fit.rss > self.needed(family):
                without = {family: lead.best.rss, lead.families[0]: self._least(self.single(family))}
                found.append(self._explained((lead.families[0], family), fit, without, lead.best))
        return sorted(found, key=lambda one: -gain(one.delta))

    def enlarged(self, lead: Explanation, worth: float) -> Iterator[Explanation]:
        """An explanation with each of the effects that its own residual asks for most and that promise a fall of RSS of `worth`, but for
        those that were tried with it already.
        """
        for node in self._rivals(lead, worth):
            family = node.columns[0].family
            if frozenset((*lead.families, family)) in self.paired:
                continue
            fit = self._added(lead, node)
            if fit.settled:
                yield self._explained((*lead.families, family), fit, {family: lead.best.rss}, lead.best)

    def _rivals(self, lead: Explanation, least: float) -> list[Node]:
        """What promises most beside a lead, and no less than a fall of RSS of `least`, of what could be told from the base parameters at
        all.
        """
        scores = [score for score in lead.look.ranking.promising if self.base.ranking[score.family.name].testable]
        return [node for score in scores[:RIVALS] if (node := score.promising).promise >= least]


def starts(node: Node, best: Optimum) -> Iterator[tuple[Float[np.ndarray, "p"], dict[str, float]]]:
    """Where a search begins, raw parameters and effects: where the fit without the effect ended, with the expected change.

    Where that change is larger than plausible its end tells little: then from where the study began as well, with half a plausible size;
    and from there alone where the fit was driven to a limit, or far from the data, for want of the effect.
    """
    astray = bool(best.limits()) or best.rss > ASTRAY * best.df
    if not astray:
        yield best.raw, {one.key: _towards(one, node.change[one.key]) for one in node.columns}
    if astray or any(abs(node.change[one.key]) > one.scale for one in node.columns):
        yield first(best.sample), {one.key: _towards(one, math.copysign(0.5 * one.scale, node.change[one.key])) for one in node.columns}


def first(sample: Sample) -> Float[np.ndarray, "p"]:
    """Where the study began, raw."""
    return np.array([parameter.raw() for parameter in sample.subject.parameters])


def _answers(sample: Sample, raw: Float[np.ndarray, "p"], phi: Mapping[str, float]) -> bool:
    """Whether the model has an answer there."""
    return sample.subject.value(raw, phi).usable


def _towards(column: Column, change: float) -> float:
    """A start inside the bounds and away from null, where a secant's tangent would vanish."""
    least = 0.05 * column.scale
    if column.sign and change * column.sign < least:
        change = column.sign * least
    change = math.copysign(max(abs(change), least), change)
    return column.clipped(column.null + change)


def _worth_fitting(nodes: tuple[Node, ...]) -> list[Node]:
    """The best nodes of a grid, as long as the score hardly tells them apart."""
    return [node for node in nodes[:NODES] if node.statistic >= CLOSE * nodes[0].statistic]


def _label(columns: tuple[Column, ...], number: int = 0) -> str:
    return "refit " + " ".join(column.key for column in columns) + (f" again {number}" if number else "")


def _misfit(best: Optimum) -> float:
    return best.rss + best.penalty if best.settled else math.inf
