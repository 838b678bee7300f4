"""Noise-free readings of the scenarios, computed once and kept in a folder, and how much misfit each leaves to a plain model.

The excess misfit is that of the best plain model, linearised about the truth: lambda = |Q W (y - y0)|^2, with y the readings, y0 those of
the laboratory without the effect, W one over what a reading may be off by (the noise of the mean of all trials, and what the laboratory
says that any model and the place of its afferent are wrong by), and Q what the moduli (and the afferent's scale and threshold) cannot take
up. A log-modulus may move far where the effect is large; then the figure is a guide.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import orth, solve_triangular

from .bricks import Array
from .instruments import readings
from .laboratory import Profiles
from .protocol import Elastic, Record, Trace, elastic
from .scenarios import HELD_OUT, SCENARIOS, Scenario, World
from .shapes import Divisions

MODEL_ERROR = {"profile": 0.01, "force": 0.01, "rate": 0.1}
"""Share of the largest reading of its curve (a force: of each reading) that a laboratory says even the right model is wrong by."""
PLACED = 0.05
"""mm: how well these laboratories know the place of their afferent."""
STEP = 0.04
"""Change of a log-modulus, for difference quotients."""
Readings = dict[str, Array]


def coordinates(record: Record) -> dict[str, list[Any]]:
    """Where every reading of a record was taken, by name, mm and s, in the order of its rows."""
    if isinstance(record, Profiles):
        pairs = [(depth, at) for depth in record.depths for at in record.distances]
        return {"depth": [p[0] for p in pairs], "distance": [p[1] for p in pairs], "condition": [f"{p[0]:g} mm" for p in pairs]}
    if isinstance(record, Trace):
        travel = record.travel(np.array(record.times)).tolist()
        return {"time": [round(t, 6) for t in record.times], "displacement": travel, "condition": [record.name] * len(travel)}
    rows = [(name, at, time) for name, _, _ in record.stimuli for at in record.positions for time in record.times]
    names = [row[0] for row in rows]
    places = {"position": [row[1] for row in rows], "time": [row[2] for row in rows]}
    return {
        "stimulus": names,
        **places,
        "depth": [record.depth] * len(rows),
        "condition": [f"{name} {row[2]:g} s" for name, row in zip(names, rows, strict=True)],
    }


def deviation(record: Record, clean: Array, noise: float) -> Array:
    """Standard deviation of every reading, same shape as `clean`.

    Of a profile: 0.4 `noise` times its largest deflection. Of a force f: noise x sqrt((0.4 max f)^2 + f^2). Of a rate r: noise x
    sqrt(r max r), as of a count, and no less than at a fiftieth of the peak.
    """
    most = float(np.abs(clean).max())
    if isinstance(record, Profiles):
        return np.full(clean.shape, 0.4 * noise * most)
    if isinstance(record, Trace):
        return noise * np.sqrt((0.4 * most) ** 2 + clean**2)
    return noise * most * np.sqrt(np.maximum(clean / most, 0.02))


def no_news(record: Record, clean: Array) -> tuple[Array, Array]:
    """What the right model may be wrong by: in every reading for itself (n,), and in all, were the afferent beside its place (n,)."""
    size, where = np.abs(clean).ravel(), coordinates(record)
    if isinstance(record, Trace):
        return MODEL_ERROR["force"] * size, np.zeros(len(size))
    curve = np.unique(where["condition"], return_inverse=True)[1].reshape(-1)
    greatest = np.zeros(curve.max() + 1)
    np.maximum.at(greatest, curve, size)
    if isinstance(record, Profiles):
        return MODEL_ERROR["profile"] * greatest[curve], np.zeros(len(size))
    slope, place = np.zeros(len(size)), np.array(where["position"])
    for one in range(len(greatest)):
        inside = np.flatnonzero(curve == one)
        slope[inside] = np.gradient(clean.ravel()[inside], place[inside]) if len(inside) > 2 else 0.0
    return MODEL_ERROR["rate"] * greatest[curve], PLACED * slope


def held_out(scenario: Scenario, record: Record) -> Array:
    """Which readings (n,) the study keeps from the fit."""
    where = coordinates(record)
    out = np.zeros(len(where["condition"]), bool)
    for one in HELD_OUT[scenario.finger] if scenario.hold_out else ():
        if one["measurement"] == record.name:
            out |= np.all(
                [
                    np.isin(where[key.split("_")[0]], wanted) if key != "condition" else np.isin(where["condition"], [wanted])
                    for key, wanted in one["where"].items()
                ],
                axis=0,
            )
    return out


@dataclass
class Truths:
    """Noise-free readings of scenarios.

    What fingers and rigs do is kept under `folder` for as long as the program is the same; scenarios that differ in their instruments alone
    share it.
    """

    folder: Path
    thin: bool = False
    tell: Callable[[str], None] = lambda text: None

    def clean(self, scenario: Scenario) -> Readings:
        """What noiseless instruments read, by record."""
        return self._readings(scenario.world(thin=self.thin), scenario.name)

    def excess(self, scenario: Scenario, noise: float, trials: int) -> float:
        """lambda of all fitted rows of all trials at this noise."""
        return self._left(scenario, SCENARIOS[f"none_{scenario.finger}"], (), noise, trials)

    def excess_of_each(self, scenario: Scenario, noise: float, trials: int) -> dict[str, float]:
        """lambda of each family of a double that a model with the other leaves; the other may take a value of its own."""
        others = [replace(SCENARIOS[name], finger=scenario.finger) for name in reversed(scenario.families)]
        pairs = zip(scenario.families, others, strict=True)
        return {name: self._left(scenario, other, (other,), noise, trials) for name, other in pairs}

    def _left(self, scenario: Scenario, simpler: Scenario, allowed: tuple[Scenario, ...], noise: float, trials: int) -> float:
        """lambda of `scenario` against `simpler`, when what sets each of `allowed` apart from the plain world may be taken up too."""
        clean, other, plain = self.clean(scenario), self.clean(simpler), self.clean(SCENARIOS[f"none_{scenario.finger}"])
        if all(np.array_equal(clean[name], other[name]) for name in plain):
            return 0.0
        more = [{name: self.clean(one)[name] - plain[name] for name in plain} for one in allowed]
        slopes = [*self.slopes(scenario.finger), *more]
        change, columns, variance, together = [], [], [], []
        for record in scenario.plain(thin=self.thin).records:
            fitted = ~held_out(scenario, record)
            read = clean[record.name]
            each, all_of_them = no_news(record, read)
            variance.append((deviation(record, read, noise).ravel() ** 2 / trials + each**2)[fitted])
            together.append(all_of_them[fitted])
            change.append((read - other[record.name]).ravel()[fitted])
            columns.append(np.stack([slope[record.name].ravel()[fitted] for slope in slopes], 1))
        shared = np.concatenate(together)
        factor = np.linalg.cholesky(np.diag(np.concatenate(variance)) + np.outer(shared, shared))
        whitened = solve_triangular(factor, np.column_stack([np.concatenate(change), np.concatenate(columns)]), lower=True)
        left, basis = whitened[:, 0], orth(whitened[:, 1:], rcond=1e-9)
        return float(((left - basis @ (basis.T @ left)) ** 2).sum())

    def slopes(self, finger: str) -> list[Readings]:
        """Derivatives of the plain readings in the four log-moduli, and in the afferent's log-scale and log-threshold where it is there."""
        plain = SCENARIOS[f"none_{finger}"]
        world, base = plain.world(thin=self.thin), self.clean(plain)
        worlds = [replace(world, flesh=replace(world.flesh, moduli=_stiffer(world.flesh.moduli, layer))) for layer in range(4)]
        if "bar_rates" in base:
            values = {name: getattr(world.instruments, name) * float(np.exp(STEP)) for name in ("scale", "threshold")}
            worlds += [replace(world, instruments=replace(world.instruments, **{name: value})) for name, value in values.items()]
        moved = [self._readings(one, f"slope {n} of {finger}") for n, one in enumerate(worlds)]
        return [{name: (one[name] - base[name]) / STEP for name in base} for one in moved]

    def recut(self, finger: str, cut: Callable[[Divisions], Divisions], name: str) -> dict[str, tuple[float, float]]:
        """How much the plain readings change on bricks cut otherwise, which are `name`: largest and root mean square, as shares of each
        file's largest."""
        plain = SCENARIOS[f"none_{finger}"]
        world, fine = plain.world(thin=self.thin), self.clean(plain)
        flesh = replace(world.flesh, divisions=cut(world.flesh.divisions))
        rough = self._readings(replace(world, flesh=flesh), f"{plain.name} on {name}")
        change = {name: (rough[name] - fine[name]) / np.abs(fine[name]).max() for name in fine}
        return {name: (float(np.abs(one).max()), float(np.sqrt((one**2).mean()))) for name, one in change.items()}

    def _readings(self, world: World, name: str) -> Readings:
        return readings(self._elastic(world, name), world.instruments, world.records)

    def _elastic(self, world: World, name: str) -> Elastic:
        said = repr((program_hash(), self.thin, world.flesh, world.rig))
        file = self.folder / f"{hashlib.sha256(said.encode()).hexdigest()[:16]}.npz"
        if not file.exists():
            self.tell(f"computing {name}")
            self.folder.mkdir(parents=True, exist_ok=True)
            unfinished = self.folder / f"part-{file.name}"
            elastic(world.flesh, world.rig, world.records).save(unfinished)
            unfinished.replace(file)
        return Elastic.load(file)


def _stiffer(moduli: tuple[float, float, float, float], layer: int) -> tuple[float, float, float, float]:
    a, b, c, d = (value * float(np.exp(STEP)) if n == layer else value for n, value in enumerate(moduli))
    return a, b, c, d


def in_order(names: Iterable[str]) -> list[str]:
    """The scenarios so that those that share a finger's mechanics follow each other."""
    return sorted(names, key=lambda name: (SCENARIOS[name].finger, hash(SCENARIOS[name].world().flesh)))


@cache
def program_hash() -> str:
    """Of the files that the mechanics depends on."""
    here = Path(__file__).parent
    files = ("bricks", "shapes", "touch", "laboratory", "flesh", "pressing", "stiffening", "friction", "protocol")
    return hashlib.sha256(b"".join((here / f"{name}.py").read_bytes() for name in files)).hexdigest()[:16]
