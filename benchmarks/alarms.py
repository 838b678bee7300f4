"""How often an effect is named where nothing is missed: hundreds of draws of noise, diagnosed with a model that is linearised.

`python -m benchmarks.alarms [--quick] [--draws N] [--out FOLDER] [--json FILE]`

A laboratory of `benchmarks.blind` without an effect is fitted once. Around that fit the model, its effects and what finer meshes add are
straight lines, which cost nothing, so that the noise of the readings can be drawn anew as often as wanted: each draw is diagnosed from its
repeats to its verdict by the code that users run. The noise-free readings are those of the other finite-element program, or of the model
itself, with which only chance is left. `--quick`: a coarse mesh, few rows and few draws.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks._record import Figure, at_most, record, shown, table, use_float64, write
from fingerjax.loop.diagnosis import investigate
from fingerjax.loop.meshguard import Correction, correction
from fingerjax.loop.refit import forget
from fingerjax.loop.subject import NONE, AbstractSubject, Evaluation
from fingerjax.runners.diagnosing import parted, subject_of
from fingerjax.study import load_studies
from tests.blind import folders
from tests.blind.scenarios import SCENARIOS, Scenario
from tests.blind.score import wilson
from tests.blind.truths import Readings, Truths, deviation

NULLS = ("none_human", "none_monkey", "trial_gain")
DRAWS, FEW = 300, 30
NOISE = 0.02  # of the largest reading
NAMED = 0.02
FIRST = 1001  # seed of the first draw: none that a laboratory of benchmarks.blind has


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

    @property
    def own(self) -> np.ndarray:
        """(rows,) what the model says, corrected for its mesh."""
        return self.at.prediction if self.known is None else self.at.prediction + self.known.offset

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


def alarms(straight: Straight, scenario: Scenario, clean: Readings, *, draws: int, thin: bool, own: bool) -> Iterator[Figure]:
    """Shares of draws that reject the plain model, and that name an effect."""
    exact = np.concatenate([np.broadcast_to(clean[one.name], (folders.TRIALS, *clean[one.name].shape)).ravel()
                            for one in scenario.world(thin=thin).records])  # fmt: skip
    rejected, named = 0, Counter[str]()
    for seed in range(FIRST, FIRST + draws):
        read = drawn(scenario, clean, thin=thin, seed=seed)
        straight.rows = replace(straight.model.rows, measured=read - exact + straight.own if own else read)
        found = investigate(straight, seed=0, effects="all", alpha=0.05, sets=0, tell=lambda *_: None, kept=forget)
        rejected += found.base.adequacy.rejected
        named.update([" or ".join(sorted(found.verdict.names))] if found.verdict.names else [])
        if sys.stderr.isatty():
            print(f"\r{scenario.name}: {seed - FIRST + 1} of {draws}", end="", file=sys.stderr, flush=True)
    behind = "its own readings" if own else "the other program's readings"
    yield Figure(f"{scenario.name}, {behind}: plain model rejected", rejected / draws, "1", note=f"{draws} draws")
    low, high = wilson(named.total(), draws)
    what = "; ".join(f"{name} {count}" for name, count in named.most_common())
    note = f"{draws} draws, 95 % interval {low:.3f} to {high:.3f}" + (f": {what}" if what else "")
    yield at_most(f"{scenario.name}, {behind}: an effect named", named.total() / draws, "1", NAMED, note)


def main(folder: Path, draws: int, *, thin: bool) -> Iterator[Figure]:
    """Of every laboratory without an effect."""
    truths = Truths(folder / "mechanics", thin, tell=lambda text: print(text, file=sys.stderr, flush=True))
    for name in NULLS:
        scenario, clean = SCENARIOS[name], truths.clean(SCENARIOS[name])
        with tempfile.TemporaryDirectory() as place:
            folders.write(scenario, truths, Path(place) / "lab", Path(place) / "truth.yaml", noise=NOISE, seed=1)
            (study,) = load_studies(Path(place) / "lab" / "experiments.yaml").values()
            straight = Straight.of(parted(subject_of(study), study))
        for own in (False, True):
            yield from alarms(straight, scenario, clean, draws=draws, thin=thin, own=own)


def command(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.alarms", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="coarse mesh, few rows, few draws")
    parser.add_argument("--draws", type=int, default=None, metavar="N", help=f"of noise, of each laboratory ({DRAWS}; {FEW} with --quick)")
    parser.add_argument("--out", type=Path, default=Path("build/blind"), metavar="FOLDER", help="where benchmarks.blind keeps its truths")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there as well")
    said = parser.parse_args(arguments)
    use_float64()
    draws = said.draws or (FEW if said.quick else DRAWS)
    figures = [shown(figure) for figure in main(said.out / ("thin" if said.quick else "full"), draws, thin=said.quick)]
    print(table(figures))
    if said.json is not None:
        write(said.json, record(figures, quick=said.quick))


if __name__ == "__main__":
    command()
