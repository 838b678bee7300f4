"""How often a verdict is right when the noise is drawn again and again, with a model that is linearised.

`python -m benchmarks.draws [--quick] [--draws N] [--scenarios a,b] [--out FOLDER] [--json FILE]`

`benchmarks.blind` diagnoses a laboratory as a user would, which takes minutes, so that it has one draw of noise of each. Here the
laboratory without an effect is fitted once, with and without conditions held out. Around that fit the model, its effects and what finer
meshes add are taken to be straight lines, which cost nothing: every draw of the readings of the other finite-element program goes from its
repeats to its verdict through the code that users run. What bends is missing, so that this tells how much of a verdict is luck, and what
noise names where nothing is missed; whether large effects are told apart is for `benchmarks.blind` to say. `--quick`: coarse meshes, few
rows, two laboratories.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks._record import Figure, at_least, at_most, record, shown, table, use_float64, write
from fingerjax.loop.diagnosis import investigate
from fingerjax.loop.meshguard import Correction, correction
from fingerjax.loop.refit import forget
from fingerjax.loop.subject import NONE, AbstractSubject, Evaluation
from fingerjax.runners.diagnosing import parted, subject_of
from fingerjax.study import load_studies
from tests.blind import folders
from tests.blind.scenarios import SCENARIOS, Scenario
from tests.blind.truths import Readings, Truths, coordinates, deviation, in_order

QUICK = ("none_monkey", "rate_saturation")
DRAWS, FEW = 20, 5
OF_NULLS = 5  # times as many draws where nothing is missed: what is to be rare is counted there
NOISE = 0.02  # of the largest reading


@dataclass(eq=False)
class Straight(AbstractSubject):
    """A model along the tangents at a point: `at` the model at raw parameters `raw`, `known` what finer meshes add there, `slopes` key ->
    (rows,) of every effect.
    """

    model: AbstractSubject
    raw: np.ndarray
    at: Evaluation
    known: Correction | None
    slopes: Mapping[str, np.ndarray]

    def __post_init__(self) -> None:
        for name in ("name", "parameters", "families", "priors", "kind", "refinement", "rows"):
            setattr(self, name, getattr(self.model, name))

    @classmethod
    def of(cls, model: AbstractSubject) -> Straight:
        """About the fit of the model's own data."""
        best = investigate(model, seed=0, effects="none", alpha=0.05, sets=0, tell=lambda *_: None, kept=forget).base.best
        return cls(model, best.raw, best.at, correction(model, best.raw, NONE, best.at), model.columns(best.raw))

    def evaluate(self, raw: np.ndarray, phi: Mapping[str, float], moving: tuple[str, ...]) -> Evaluation:
        """Along the tangents."""
        columns = {one.key: one for family in self.families for one in (*family.columns, *family.second)}
        said = self.at.prediction + self.at.theta_jacobian @ (raw - self.raw)
        said = said + sum((self.slopes[key] * (value - columns[key].null) for key, value in phi.items()), np.zeros(len(said)))
        moved = np.stack([self.slopes[key] for key in moving], axis=1) if moving else np.zeros((len(said), 0))
        return replace(self.at, prediction=said, phi_jacobian=moved)

    def columns(self, raw: np.ndarray, phi: Mapping[str, float] = NONE) -> Mapping[str, np.ndarray]:
        """Of every effect."""
        return self.slopes

    def finer(self, raw: np.ndarray, phi: Mapping[str, float]) -> np.ndarray | None:
        """Always as much more."""
        return None if self.known is None else self.evaluate(raw, phi, ()).prediction + self.known.offset - self.known.softness

    def softness(self, raw: np.ndarray, phi: Mapping[str, float]) -> np.ndarray | None:
        """The same everywhere."""
        return None if self.known is None or not self.known.softness.any() else self.known.softness


def drawn(scenario: Scenario, clean: Readings, *, thin: bool, seed: int) -> np.ndarray:
    """(rows,) readings of all trials as the files of a laboratory have them."""
    world = scenario.world(thin=thin)
    sizes = {record.name: deviation(record, clean[record.name], NOISE) for record in world.records}
    read = [folders.measured(world, one, clean[one.name], sizes[one.name], seed, scenario.name).ravel() for one in world.records]
    return np.array([float(f"{value:.6g}") for value in np.concatenate(read)])


@dataclass(frozen=True)
class Drawn:
    """What was said of one draw."""

    scenario: Scenario
    rejected: bool
    verdict: str
    named: frozenset[str]

    @property
    def said(self) -> str:
        """In words, for counting."""
        return f"{self.verdict} {', '.join(sorted(self.named))}" if self.named else self.verdict


def _found(one: Drawn) -> bool:
    """Whether an effect that is there is among the explanations."""
    return bool(one.named & set(one.scenario.families))


def _wrong(one: Drawn) -> bool:
    """Whether effects are named, and none that is there."""
    return bool(one.named) and not _found(one)


def verdicts(straight: Straight, scenario: Scenario, clean: Readings, *, draws: int, thin: bool) -> list[Drawn]:
    """Of every draw."""
    found = []
    for seed in range(1, draws + 1):
        straight.rows = replace(straight.model.rows, measured=drawn(scenario, clean, thin=thin, seed=seed))
        seen = investigate(straight, seed=0, effects="all", alpha=0.05, sets=0, tell=lambda *_: None, kept=forget)
        named = frozenset(family for member in seen.verdict.members for family in member.families)
        found.append(Drawn(scenario, seen.base.adequacy.rejected, seen.verdict.kind, named))
    return found


def fitted(plain: Scenario, truths: Truths) -> Straight:
    """A laboratory without an effect, fitted to its first draw."""
    with tempfile.TemporaryDirectory() as place:
        folders.write(plain, truths, Path(place) / "lab", Path(place) / "truth.yaml", noise=NOISE, seed=1)
        (study,) = load_studies(Path(place) / "lab" / "experiments.yaml").values()
        return Straight.of(parted(subject_of(study), study))


def alike(scenario: Scenario, *, thin: bool) -> bool:
    """Whether a laboratory records what the one without an effect does, on meshes as fine."""
    plain = SCENARIOS[f"none_{scenario.finger}"]
    world, other = scenario.world(thin=thin), plain.world(thin=thin)
    same = [(one.name, coordinates(one)) for one in world.records] == [(one.name, coordinates(one)) for one in other.records]
    return same and world.nodes == other.nodes and world.resolution == other.resolution


def main(names: Iterable[str], folder: Path, draws: int, *, thin: bool) -> Iterator[Figure]:
    """Each laboratory, then all of a kind together."""
    truths = Truths(folder / "mechanics", thin, tell=_say)
    straight: dict[tuple[str, bool], Straight] = {}
    every: list[Drawn] = []
    for name in in_order(names):
        scenario = SCENARIOS[name]
        if not alike(scenario, thin=thin):
            _say(f"{name}: left out, its rows or meshes are others")
            continue
        plain = replace(SCENARIOS[f"none_{scenario.finger}"], hold_out=scenario.hold_out)
        kind = (scenario.finger, scenario.hold_out)
        straight[kind] = straight.get(kind) or fitted(plain, truths)
        count = draws * (OF_NULLS if scenario.kind == "none" else 1)
        found = verdicts(straight[kind], scenario, truths.clean(scenario), draws=count, thin=thin)
        said = "; ".join(f"{what} {number}" for what, number in Counter(one.said for one in found).most_common(4))
        what, holds = ("found", _found) if scenario.families else ("an effect named", _wrong)
        yield Figure(f"{name}: {what}", float(np.mean([holds(one) for one in found])), "1", note=f"{count} draws: {said}")
        every += found
    yield from together(every)


def together(every: Sequence[Drawn]) -> Iterator[Figure]:
    """All laboratories of a kind, beside the least that the loop is to reach."""
    none, outside = ([one for one in every if one.scenario.kind == kind] for kind in ("none", "outside"))
    singles = [one for one in every if one.scenario.kind == "single" and one.rejected]
    for name, of, holds, limit in (
        ("no effect: an effect named", none, _wrong, 0.02),
        ("one effect, plain model rejected: another named, the right one nowhere", singles, _wrong, 0.015),
        ("outside the catalogue: an effect named", outside, _wrong, 0.05),
    ):
        if of:
            yield at_most(name, float(np.mean([holds(one) for one in of])), "1", limit, _among(of))
    if singles:
        share = float(np.mean([_found(one) for one in singles]))
        yield at_least("one effect, plain model rejected: among the explanations", share, "1", 0.95, _among(singles))


def _among(of: Sequence[Drawn]) -> str:
    return f"{len(of)} draws of {len({one.scenario.name for one in of})} laboratories"


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def command(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.draws", description=__doc__)
    parser.add_argument("--quick", action="store_true", help=f"coarse meshes, few rows, few draws, of {' and '.join(QUICK)}")
    parser.add_argument("--draws", type=int, default=None, metavar="N", help=f"of noise, of each laboratory ({DRAWS}; {FEW} with --quick)")
    parser.add_argument("--scenarios", default="", metavar="a,b", help="laboratories, by their names in benchmarks.blind; else all")
    parser.add_argument("--out", type=Path, default=Path("build/blind"), metavar="FOLDER", help="where benchmarks.blind keeps its truths")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there as well")
    said = parser.parse_args(arguments)
    names = [name for name in said.scenarios.split(",") if name] or list(QUICK if said.quick else SCENARIOS)
    if unknown := sorted(set(names) - set(SCENARIOS)):
        parser.error(f"no scenario is called {', '.join(unknown)}")
    use_float64()
    draws = said.draws or (FEW if said.quick else DRAWS)
    figures = [shown(figure) for figure in main(names, said.out / ("thin" if said.quick else "full"), draws, thin=said.quick)]
    print(table(figures))
    if said.json is not None:
        write(said.json, record(figures, quick=said.quick))


if __name__ == "__main__":
    command()
