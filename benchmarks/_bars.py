"""The paper's bar (Fig. 11): one sweep over the finger, four quantities, two models, and the rates of a measured afferent."""

from __future__ import annotations

import csv
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks._record import Figure, at_least
from fingerjax.contact.indenter import from_spec
from fingerjax.fem.body import Material
from fingerjax.finger import Finger
from fingerjax.forward.sequence import Sequence, check, prepare
from fingerjax.geometry.sections import LayeredSolid
from fingerjax.measure.afferent import rate, start
from fingerjax.measure.receptor import PAPER_QUANTITIES, QUANTITIES
from fingerjax.measure.sites import below

BAR = from_spec("bar", {"width": 3.0})
TRAVEL = 1.0  # mm
POSITIONS = np.round(np.arange(-3.5, 3.51, 0.2), 3)  # mm: those of recording bar_A, one more than the paper's 35
WINDOWS = ("static", "dynamic")
POOR = ("mean_normal_stress", "vertical_compressive_stress")


@dataclass
class Bars:
    """What the receptor felt: `quantity` model -> name -> (positions,), and the seconds that each model's sweep took, without compiling."""

    position: np.ndarray
    quantity: dict[str, dict[str, np.ndarray]]
    seconds: dict[str, float]
    sequence: Sequence


def sweep(finger: Finger, solid: LayeredSolid, models: Mapping[str, Material], depth: float) -> Bars:
    """Press the bar at every position, the receptor in the middle of the pad."""
    middle = solid.pad_centre
    origins = np.column_stack([np.zeros(len(POSITIONS)), middle - POSITIONS])  # a position is that of the receptor on the bar
    sequence = prepare(finger, BAR, origins, TRAVEL, below(solid, depth, middle))
    felt: dict[str, dict[str, np.ndarray]] = {}
    seconds: dict[str, float] = {}
    names = list(models)
    for name in (names[0], *names[::-1]):  # the first compiles for all; the last factorisation is kept, so no model comes twice in a row
        began = time.perf_counter()
        pushed = sequence.press(sequence.condense(models[name]).held.matrix, BAR, travel=TRAVEL)
        state = sequence.feel(pushed, models[name])
        felt[name] = {each: np.asarray(QUANTITIES[each](state))[:, 0] for each in PAPER_QUANTITIES}
        seconds[name] = time.perf_counter() - began
        check(sequence, pushed)
    return Bars(POSITIONS, felt, seconds, sequence)


def measured_bar(folder: Path, window: str) -> tuple[np.ndarray, np.ndarray]:
    """Positions, mm, and rates, Hz, of recording bar_A."""
    with (folder / "monkey-sa1-bars-and-grating" / "rates.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["recording"] == "bar_A" and row["window"] == window]
    return np.array([float(row["x_mm"]) for row in rows]), np.array([float(row["rate_ips"]) for row in rows])


def correlation(quantity: np.ndarray, rates: np.ndarray) -> float:
    """Of measured rates with those of the best scale and threshold."""
    predicted = np.asarray(rate(quantity, *start(quantity, rates)))
    return float(np.corrcoef(predicted, rates)[0, 1]) if np.ptp(predicted) > 0 else 0.0


def tables(meshes: list[Bars], position: np.ndarray, rates: np.ndarray, window: str, repeats: int) -> Iterator[Figure]:
    """Every correlation with its 95 % interval, and each of the paper's claims with that of the difference it speaks of.

    Quantities are means over some meshes of one size, because under the bar's edges they differ from mesh to mesh by more than a rate does.
    """
    pairs = [(model, name) for model in meshes[0].quantity for name in PAPER_QUANTITIES]
    at = {
        (model, name): np.stack([np.interp(position, one.position, one.quantity[model][name]) for one in meshes]) for model, name in pairs
    }
    here = {key: correlation(values.mean(axis=0), rates) for key, values in at.items()}
    drawn = _bootstrap(at, rates, repeats)
    told = f"{repeats} bootstrap repeats of positions and of {len(meshes)} meshes" if len(meshes) > 1 else f"{repeats} bootstrap repeats"
    for (model, name), value in here.items():
        low, high = np.quantile(drawn[model, name], [0.025, 0.975])
        apart = [correlation(values, rates) for values in at[model, name]]
        note = f"95 % {low:.3f} to {high:.3f}, {told}; each mesh {min(apart):.3f} to {max(apart):.3f}"
        yield Figure(f"bar_A {window}: {model}, {name}", value, "1", note=note)
    for name in PAPER_QUANTITIES:
        yield _claim(f"bar_A {window}: layered better, {name}", here, drawn, ("layered", name), ("homogeneous", name))
    for name in PAPER_QUANTITIES[1:]:
        yield _claim(f"bar_A {window}: energy density better than {name}", here, drawn, ("layered", PAPER_QUANTITIES[0]), ("layered", name))


def _bootstrap(at: dict[tuple[str, str], np.ndarray], rates: np.ndarray, repeats: int) -> dict[tuple[str, str], np.ndarray]:
    """Correlations of positions and meshes drawn anew, the same draws for all; `at` holds (meshes, positions)."""
    random, meshes = np.random.default_rng(0), len(next(iter(at.values())))
    draws = [(random.integers(0, meshes, meshes), random.integers(0, len(rates), len(rates))) for _ in range(repeats)]

    def repeated(values: np.ndarray) -> np.ndarray:
        return np.array([correlation(values[some].mean(axis=0)[draw], rates[draw]) for some, draw in draws])

    return {key: repeated(values) for key, values in at.items()}


def _claim(text: str, here: dict, drawn: dict, one: tuple[str, str], other: tuple[str, str]) -> Figure:
    """Confirmed where the lower end of the difference's 95 % interval is above zero."""
    low, high = np.quantile(drawn[one] - drawn[other], [0.025, 0.975])
    difference = here[one] - here[other]
    verdict = "confirmed" if low > 0 else "contradicted" if high < 0 else "not told apart"
    return at_least(text, float(low), "1", 0.0, f"{verdict}: difference {difference:+.3f}, 95 % {low:+.3f} to {high:+.3f}")
