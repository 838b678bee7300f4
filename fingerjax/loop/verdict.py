"""What may be said at the end, of nine kinds, and in one or two sentences that a biomechanician can use."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from .adequacy import Look
from .explanations import Explanation, ahead_of, main, remaining
from .heldout import Foretold
from .meshguard import MeshGuard
from .noise import Noise
from .score import Score

ADEQUATE, ATTRIBUTED, AMBIGUOUS, MAINLY = "adequate", "attributed", "ambiguous", "mainly"
TWO, UNEXPLAINED, NOT_TESTABLE, MESH_LIMITED, NOISE_UNKNOWN = "two effects", "unexplained", "not testable", "mesh-limited", "noise unknown"
KINDS = (ADEQUATE, ATTRIBUTED, AMBIGUOUS, MAINLY, TWO, UNEXPLAINED, NOT_TESTABLE, MESH_LIMITED, NOISE_UNKNOWN)
LISTED = 4  # conditions that are named, at most
FEWEST = 3.0  # settings more than parameters, below which nothing can be tested


@dataclass(frozen=True, eq=False)
class Verdict:
    """The end of a diagnosis.

    - `kind`: one of `KINDS`. `members`: the explanations that remain, best first; none where nothing is named.
    - `share`: of the excess misfit that the first of them removes; `remainder_p`: least p value of what is left.
    - `absorbed`: effects that these data could not show. `held_out_p`: of what was held out and touched by nothing, under the first of
      them, or under the base; None where nothing was.
    """

    kind: str
    members: tuple[Explanation, ...]
    share: float
    remainder_p: float
    absorbed: tuple[Score, ...]
    text: str
    held_out_p: float | None = None

    @property
    def names(self) -> list[str]:
        """Every family named, once."""
        return list(dict.fromkeys(name for member in self.members for name in member.families))


def asks_for_effects(noise: Noise, base: Look) -> bool:
    """Whether effects are looked into at all: the base is an optimum, its misfit is real, and the noise is known."""
    return _cannot(noise, base) is None and base.adequacy.rejected


def is_adequate(noise: Noise, base: Look) -> bool:
    """Whether the base is an optimum whose tests see no misfit, in data whose noise is known."""
    return _cannot(noise, base) is None and not base.adequacy.rejected


def out_of_the_mesh(mesh: MeshGuard, base: Look) -> bool:
    """Whether a rejected base misses more than the mesh could have made: then effects are worth refitting, which may take minutes each."""
    worth = (score for score in base.ranking.testable if score.matters)
    return base.adequacy.bends or any(score.statistic > base.critical.value + mesh.margin(score.direction) for score in worth)


def decide(
    noise: Noise, mesh: MeshGuard, base: Look, singles: list[Explanation], pairs: list[Explanation], absorbed: tuple[Score, ...]
) -> Verdict:
    """The verdict. `singles` and `pairs` are best first; empty where the base was not rejected."""
    kind, members = _judge(noise, mesh, base, singles, pairs)
    last = members[0].look.adequacy if members else base.adequacy
    share = members[0].eta if members else 0.0
    parts = _text(kind, members, noise, mesh, base, singles), _too_small(base, kind), _said_of(absorbed, kind)
    text = " ".join(part for part in parts if part)
    return Verdict(kind, members, share, last.least_p, absorbed, text)


def with_nearest(verdict: Verdict, nearest: Explanation | None) -> Verdict:
    """Where nothing is named: how near the catalogue comes, and with what."""
    if nearest is None or len(nearest.families) < 2:
        return verdict
    comes = f"The catalogue comes nearest with {' and '.join(nearest.families)} ({sizes(nearest)})"
    how_far = f"which remove {min(nearest.eta, 1.0):.1%} of the misfit beyond the noise"
    return replace(verdict, text=f"{verdict.text} {comes}, {how_far}{_against(nearest)}. That does not make them the missing effects.")


def with_held_out(verdict: Verdict, seen: Foretold | None, conditions: Sequence[str]) -> Verdict:
    """With what `conditions` that nothing has seen say of a model that is found to be enough; they choose nothing."""
    if seen is None:
        return verdict
    if not seen.contradicted or verdict.kind not in (ADEQUATE, ATTRIBUTED, AMBIGUOUS, MAINLY, TWO):
        return replace(verdict, held_out_p=seen.p)
    listed = ", ".join(conditions[:LISTED]) + (f" and {len(conditions) - LISTED} more" if len(conditions) > LISTED else "")
    says = (
        f"But what was held out ({listed}) speaks against it: it is missed by {seen.times:.2g} times what noise and the fit allow. "
        "Something is missing, or is another effect than this, that the fitted conditions do not show."
    )
    return replace(verdict, text=f"{verdict.text} {says}", held_out_p=seen.p)


def _against(nearest: Explanation) -> str:
    """Why a model that comes near is not named: what its own residual says against it."""
    if nearest.reason == "":
        return ""
    said = [nearest.reason, *_looks_like(nearest)]
    return f"; but the model with them {': '.join(said)}"


def _looks_like(one: Explanation) -> list[str]:
    """What an explanation leaves looks like, in words, where it looks like an effect more than chance would."""
    tests = one.look.adequacy
    if not tests.resembles:
        return []
    rival = one.look.ranking.scores[0]
    return [f"what remains looks most like {rival.family.name} (score {rival.z:.1f}, {one.look.critical.value:.1f} by chance)"]


def _judge(
    noise: Noise, mesh: MeshGuard, base: Look, singles: list[Explanation], pairs: list[Explanation]
) -> tuple[str, tuple[Explanation, ...]]:
    cannot = _cannot(noise, base)
    if cannot is not None:
        return cannot, ()
    if not base.adequacy.rejected:
        if mesh.hides(base.critical.value):
            return MESH_LIMITED, ()
        return (ADEQUATE if noise.repeated else NOISE_UNKNOWN), ()
    alone, below = remaining(singles), ahead_of(singles)
    both = tuple(one for one in remaining(pairs) if one.best.rss < below)
    if alone:
        members = (*both, *alone)
        return (ATTRIBUTED if len(members) == 1 else AMBIGUOUS), members
    mainly = main(singles)
    if mainly is not None:
        return MAINLY, (mainly,)
    if both:
        return (TWO if len(both) == 1 else AMBIGUOUS), both
    beyond = any(one.significant for one in singles) or base.adequacy.bends
    return (MESH_LIMITED if mesh.guilty(base.critical.value) or not (mesh.passed or beyond) else UNEXPLAINED), ()


def _cannot(noise: Noise, base: Look) -> str | None:
    """The verdict where nothing can be tested; None where it can."""
    if not base.best.settled or base.adequacy.df < FEWEST:
        return NOT_TESTABLE
    if not noise.known:
        return NOISE_UNKNOWN
    return None


def _text(
    kind: str, members: tuple[Explanation, ...], noise: Noise, mesh: MeshGuard, base: Look, singles: list[Explanation]
) -> str:  # fmt: skip
    if kind == NOT_TESTABLE:
        return _untested(base)
    if kind == NOISE_UNKNOWN:
        found = "" if not noise.known else "At the stated noise no effect is missed. "
        return found + noise.allows()
    if kind == ADEQUATE:
        moved = "" if mesh.passed else f" What the mesh leaves moves a parameter by {_largest(mesh):.2g} standard errors at most."
        return "The model fits these data to within their noise: no effect that they could show is missing." + moved
    if kind == MESH_LIMITED:
        return (
            "The mesh limits what can be said: what may be left of its error could look like a missing effect "
            f"(it would add {mesh.drowned:.3g} to the squared misfit, and move a parameter by up to {_largest(mesh):.2g} standard errors). "
            "Nothing is named; refine the mesh."
        )
    if kind == UNEXPLAINED:
        return _unexplained(base, singles)
    return _named(kind, members)


def _untested(base: Look) -> str:
    if not base.best.settled:
        return f"The fit of the model did not settle ({base.best.reason or 'no optimum'}): nothing was tested and nothing is named."
    return (
        f"There are too few data: {base.adequacy.df:.0f} measured settings more than parameters. Nothing was tested and nothing is named."
    )


def _unexplained(base: Look, singles: list[Explanation]) -> str:
    excess = base.adequacy.misfit / max(base.adequacy.df, 1.0)
    first = next((one for one in singles if one.best.settled), None)
    why = f" Of single effects {first.name} removes most, but it {first.reason}." if first is not None and first.reason else ""
    return (
        f"The model misses something (misfit {excess:.1f} times the noise) that no effect of the catalogue explains.{why} "
        "The fitted values hold only for this model, which these data contradict."
    )


def _named(kind: str, members: tuple[Explanation, ...]) -> str:
    first = members[0]
    sized = f"{first.name} ({sizes(first)})"
    removes = f"removes {min(first.eta, 1.0):.0%} of the misfit beyond the noise"
    if first.eta == 0.0:  # the misfit is no larger than the noise; its shape gave it away
        removes = f"lowers the squared misfit by {first.delta:.3g} where chance would by {max(first.needed.values()):.3g}"
    if kind == ATTRIBUTED:
        return f"The model lacks {sized}: with it alone nothing is left to be explained, and it {removes}."
    if kind == MAINLY:
        remainder = "".join(f" ({looks})" for looks in _looks_like(first))
        return (
            f"The model lacks mainly {sized}: it {removes} and leads every other effect by far, "
            f"but a remainder is left that has no name{remainder}."
        )
    if kind == TWO:
        return f"The model lacks two effects, {sized}: neither is enough without the other, and together nothing is left to be explained."
    listed = "; ".join(f"{one.name} ({sizes(one)})" for one in members)
    return f"These data are explained by each of {len(members)}: {listed}. They cannot tell them apart; the next experiment would."


def sizes(one: Explanation) -> str:
    """`share = 0.21 at tau_s = 1`, for every effect that is awake."""
    said = []
    for column in one.best.columns:
        grid = "".join(f" at {name} = {value:g}" for name, value in column.fixed.items())
        unit = "" if column.unit in ("", "1") else f" {column.unit}"
        said.append(f"{column.name} = {one.best.phi[column.key]:.3g}{unit}{grid}")
    return ", ".join(said)


def _too_small(base: Look, kind: str) -> str:
    """What is seen in data that a model fits, and is no larger than what any model is wrong by."""
    small = [score.family.name for score in base.ranking.testable if score.statistic > base.critical.value and not score.matters]
    if kind != ADEQUATE or not small:
        return ""
    return (
        f"More than chance, but in no measurement more than what any model is wrong by (model_error), could be {' or '.join(small)}: "
        "not named."
    )


def _said_of(absorbed: tuple[Score, ...], kind: str) -> str:
    if not absorbed or kind in (NOT_TESTABLE, NOISE_UNKNOWN):
        return ""
    names = ", ".join(score.family.name for score in absorbed)
    return f"The fitted values are right only without what these data cannot show and the parameters would hide: {names}."


def _largest(mesh: MeshGuard) -> float:
    return max((abs(float(shift)) for shift in mesh.shift), default=math.nan)
