"""A finger that is a formula: five base parameters, four measurements, some twenty effects, so that the loop's statistics run in seconds.

Profiles fall off exponentially, forces grow as powers of the travel, rates are bells. Nothing in it is physics; what matters is that
effects leave different residuals, that one is absorbed, one vanishes to first order, one is a grid and one has two columns.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from fingerjax.loop.subject import NONE, AbstractSubject, Column, Evaluation, Family, Rows
from fingerjax.parameters import Parameter

TRUE = {"skin.modulus": 0.2, "deep.modulus": 0.03, "bed.modulus": 0.05, "rate.scale": 60.0, "rate.threshold": 8.0}
UNITS = {"line": "mm", "point": "N", "plate": "N", "bar": "Hz"}
KINDS = {"line": "deflection_profile", "point": "force_displacement", "plate": "force_displacement", "bar": "spike_rate"}
TAUS = (0.1, 0.3, 1.0, 3.0, 10.0)


def _grid() -> dict[str, tuple[list[str], dict[str, np.ndarray]]]:
    """Block -> conditions and coordinates of one repeat."""

    def block(name: str, levels: list[float], level: str, places: np.ndarray, place: str) -> tuple[list[str], dict[str, np.ndarray]]:
        one = [(f"{name} {value:g}", value, x) for value in levels for x in places]
        return [o[0] for o in one], {place: np.array([o[2] for o in one]), level: np.array([o[1] for o in one])}

    return {
        "line": block("line", [0.5, 1.0, 1.5, 2.0], "depth", np.linspace(-4.0, 4.0, 9), "distance"),
        "point": block("point", [1.0, 2.0], "run", np.linspace(0.25, 2.0, 8), "displacement"),
        "plate": block("plate", [0.5, 1.0, 1.5], "displacement", np.array([0.05, 0.2, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0]), "time"),
        "bar": block("bar", [0.5, 1.0], "depth", np.linspace(-3.0, 3.0, 11), "position"),
    }


GRID = _grid()


def _soft(x: np.ndarray) -> np.ndarray:
    return np.logaddexp(0.0, x / 4.0) * 4.0


def predicted(theta: np.ndarray, e: Mapping[str, float]) -> np.ndarray:
    """One repeat of every block, one after the other. `e`: effect -> size from null; relaxation by `relaxation.share@tau_s=1`."""
    skin, deep, bed, scale, threshold = theta

    def size(key: str) -> float:
        return e.get(key, 0.0)

    offset, compliance = size("contact_offset.offset"), size("apparatus_compliance.compliance")
    at = {name: columns for name, (_, columns) in GRID.items()}
    # line
    x, d = at["line"]["distance"] - size("indenter_shift.shift"), at["line"]["depth"] - offset
    reach = 1.5 * (skin / deep) ** 0.3 * (1 + size("epidermis_thickness.change"))
    far = np.sqrt(x**2 + 0.09)
    reach = reach * (1 + size("anisotropy.along") * np.tanh(x)) * (1 + size("depth_gradient.slope") * d)
    line = d * np.exp(-far / reach) * (1 + size("camera_scale.scale")) + size("profile_tilt.tilt") * x
    line = line + d * size("friction.coefficient") * x**2 * np.exp(-(x**2)) + 0.5 * d * (size("indenter_tilt.tilt") * x) ** 2 * np.exp(-far)
    # point
    d = at["point"]["displacement"] - offset
    point = deep**0.7 * skin**0.3 * np.maximum(d, 1e-3) ** 1.5
    point = point * np.exp(size("strain_stiffening.rate") * d**2 / 4) + size("tip_radius.change") * deep * np.sqrt(np.maximum(d, 1e-3))
    point = point * (1 - compliance * point * 40 / (1 + d))
    # plate
    d, t = at["plate"]["displacement"] - offset, at["plate"]["time"]
    plate = (deep * d + bed * d**2) * np.exp(size("strain_stiffening.rate") * d**2 / 4) * (1 + size("anisotropy.across") * d**3 / 3)
    shares = [(tau, size(f"relaxation.{name}@tau_s={tau:g}")) for tau in TAUS for name in ("share", "share_2")]
    plate = plate * (1 - sum(share * (1 - np.exp(-t / tau)) for tau, share in shares))
    plate = plate / (1 + size("nail_compliance.compliance") * plate * 10 / (1 + d)) * (1 - compliance * plate * 40 / (1 + d))
    plate = plate + size("force_drift.rate") * t
    gain = 1 + size("force_gain.gain")
    point, plate = gain * point + size("force_offset.offset"), gain * plate + size("force_offset.offset")
    # bar
    x, d = at["bar"]["position"] - size("receptor_position.position"), at["bar"]["depth"] - offset
    width = 1.0 + size("receptor_depth.change")
    bell = sum(
        weight * np.exp(-((x - shift) ** 2) / (2 * width**2)) / width
        for weight, shift in ((1 - size("pooling.share"), 0.0), (size("pooling.share") / 2, -1.2), (size("pooling.share") / 2, 1.2))
    )
    rate = _soft(scale * bell * d * (1 - 0.4 * size("epidermis_thickness.change")) - threshold)
    rate = rate / (1 + size("rate_saturation.inverse") * rate) * np.maximum(rate / 40, 1e-6) ** size("rate_power_law.exponent")
    rate = rate + size("spontaneous_rate.rate")
    return np.concatenate([line, point, plate, rate])


def _one(family: str, name: str, unit: str, scale: float, sign: int = 0, **more: Any) -> Column:
    lower, upper = (0.0 if sign > 0 else -3 * scale), (0.0 if sign < 0 else 3 * scale)
    return Column(family, name, unit, scale, lower, upper, sign=sign, **more)


def _relaxation() -> Family:
    columns = [tuple(_one("relaxation", name, "1", 0.15, 1, fixed={"tau_s": tau}) for tau in TAUS) for name in ("share", "share_2")]
    return Family("relaxation", columns[0], "time", second=columns[1])


FAMILIES: tuple[Family, ...] = (
    *(
        Family(one.family, (one,), acts)
        for one, acts in (
            (_one("contact_offset", "offset", "mm", 0.05), "contact"),
            (_one("apparatus_compliance", "compliance", "mm/N", 0.05, 1), "contact"),
            (_one("indenter_shift", "shift", "mm", 0.2), "contact"),
            (_one("indenter_tilt", "tilt", "rad", 0.2, step=0.2), "contact"),
            (_one("tip_radius", "change", "mm", 0.2), "contact"),
            (_one("friction", "coefficient", "1", 0.05, 1), "contact"),
            (_one("adhesion", "pressure", "MPa", 0.01, 1), "contact"),
            (_one("epidermis_thickness", "change", "1", 0.2), "finger"),
            (_one("receptor_depth", "change", "1", 0.2), "finger"),
            (_one("receptor_position", "position", "mm", 0.2), "finger"),
            (_one("strain_stiffening", "rate", "1", 0.3, 1), "tissue"),
            (_one("depth_gradient", "slope", "1/mm", 0.1), "tissue"),
            (_one("nail_compliance", "compliance", "mm/N", 0.3, 1), "support"),
            (_one("force_gain", "gain", "1", 0.1), "instrument"),
            (_one("force_offset", "offset", "N", 0.005), "instrument"),
            (_one("force_drift", "rate", "N/s", 0.0005), "instrument"),
            (_one("camera_scale", "scale", "1", 0.05), "instrument"),
            (_one("profile_tilt", "tilt", "1", 0.02), "instrument"),
            (_one("rate_saturation", "inverse", "s", 0.02, 1), "afferent"),
            (_one("rate_power_law", "exponent", "1", 0.3), "afferent"),
            (_one("spontaneous_rate", "rate", "Hz", 5.0, 1), "afferent"),
            (_one("pooling", "share", "1", 0.3, 1), "afferent"),
        )
    ),
    _relaxation(),
    Family("anisotropy", (_one("anisotropy", "along", "1", 0.1), _one("anisotropy", "across", "1", 0.1)), "tissue"),
)

PARAMETERS = tuple(
    Parameter(name, 1.3 * value, unit, "log", 1e-3 * value, 1e3 * value)
    for (name, value), unit in zip(TRUE.items(), ("MPa", "MPa", "MPa", "1", "Hz"), strict=True)
)


def _repeated(count: int) -> tuple[dict[str, slice], dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """(blocks, index of every row in one repeat by block, condition, trial)."""
    blocks, index, conditions, trials, start, base = {}, [], [], [], 0, 0
    for name, (condition, _) in GRID.items():
        blocks[name] = slice(start, start + count * len(condition))
        for trial in range(count):
            index += list(range(base, base + len(condition)))
            conditions += condition
            trials += [str(trial)] * len(condition)
        start, base = start + count * len(condition), base + len(condition)
    return blocks, {"rows": np.array(index)}, np.array(conditions), np.array(trials)


@dataclasses.dataclass(eq=False)
class Toy(AbstractSubject):
    """The formula with data made from it.

    - `truth`: key -> size of effects that the data have. `outside`: added to them, of one repeat, by no effect of the catalogue.
    - `noise`: share of each block's root mean square; rates have 1 + 0.02 rate. `repeats` of every setting.
    - `gain`: standard deviation of a gain of each trial that nobody was told of. `wild`: share of rows that are 8 sd off.
    - `mesh`: size of the error of the model's own mesh; a finer one has a quarter of it, or `finer_has` of it.
    - `stated`: repeats are dropped but the first, and the noise is stated; `silent`: and not stated either.
    """

    truth: Mapping[str, float] = dataclasses.field(default_factory=dict)
    seed: int = 0
    noise: float = 0.02
    repeats: int = 4
    outside: Callable[[], np.ndarray] | None = None
    gain: float = 0.0
    wild: float = 0.0
    mesh: float = 0.0
    finer_has: float = 0.25
    stated: bool = False
    silent: bool = False
    roles: Mapping[str, str] = dataclasses.field(default_factory=dict)
    families: tuple[Family, ...] = FAMILIES
    breaks: Callable[[Mapping[str, float]], bool] = lambda phi: False
    evaluations: int = 0

    def __post_init__(self) -> None:
        self.name, self.kind, self.priors, self.parameters = "toy", "synthetic", {}, PARAMETERS
        count = 1 if self.stated or self.silent else self.repeats
        blocks, found, condition, trial = _repeated(count)
        self.index = found["rows"]
        self.exact = self._truth()
        sizes = self.sizes()
        random = np.random.default_rng(self.seed)
        measured = self.exact[self.index] + sizes[self.index] * random.standard_normal(len(self.index))
        for block in blocks.values():
            for one in sorted(set(trial[block].tolist())):
                measured[block][trial[block] == one] *= 1 + self.gain * random.standard_normal()
        off = random.random(len(self.index)) < self.wild
        measured = measured + off * 8 * sizes[self.index] * random.choice([-1.0, 1.0], len(self.index))
        coordinates = {
            name: {key: np.tile(values, count) for key, values in columns.items()} for name, (_, columns) in GRID.items()
        }  # fmt: skip
        sigma = sizes[self.index] if self.stated else None
        self.rows = Rows(blocks, condition, measured, coordinates, UNITS, trial, KINDS, sigma, roles=self.roles)

    def _truth(self) -> np.ndarray:
        exact = predicted(np.array(list(TRUE.values())), self.truth)
        return exact if self.outside is None else exact + self.outside()

    def sizes(self) -> np.ndarray:
        """(rows of one repeat,) standard deviation of a row."""
        parts, start = [], 0
        for name, (condition, _) in GRID.items():
            values = self.exact[start : start + len(condition)]
            flat = np.full(len(values), self.noise * math.sqrt(float(np.mean(values**2))))
            parts.append(np.sqrt(50 * self.noise * (1 + 0.02 * np.maximum(values, 0.0))) if name == "bar" else flat)
            start += len(condition)
        return np.concatenate(parts)

    def _mesh(self, raw: np.ndarray, share: float) -> np.ndarray:
        """What a mesh adds: too stiff in every block, by a share that varies along it."""
        exact = predicted(np.exp(raw), {})
        return share * self.mesh * exact * (1 + 0.5 * np.sin(np.arange(len(exact))))

    def _plain(self, raw: np.ndarray, phi: Mapping[str, float]) -> np.ndarray:
        return predicted(np.exp(raw), phi) + self._mesh(raw, 1.0)

    def evaluate(self, raw: np.ndarray, phi: Mapping[str, float], moving: tuple[str, ...]) -> Evaluation:
        self.evaluations += 1
        here = self._plain(raw, phi)
        theta = np.stack([_slope(lambda x, j=j: self._plain(_at(raw, j, x), phi), raw[j], 1e-5) for j in range(len(raw))], axis=1)
        effects = [_slope(lambda x, key=key: self._plain(raw, {**phi, key: x}), phi.get(key, 0.0), 1e-5) for key in moving]
        block = np.stack(effects, axis=1) if effects else np.zeros((len(here), 0))
        return Evaluation(here[self.index], theta[self.index], block[self.index], not self.breaks(phi))

    def columns(self, raw: np.ndarray, phi: Mapping[str, float] = NONE) -> Mapping[str, np.ndarray]:
        found = {}
        for column in (one for family in self.families for one in (*family.columns, *family.second)):
            if column.step is not None:
                step = predicted(np.exp(raw), {**phi, column.key: column.step}) - predicted(np.exp(raw), {**phi, column.key: 0.0})
                found[column.key] = (step / column.step)[self.index]
            else:
                at = phi.get(column.key, 0.0)
                found[column.key] = _slope(lambda x, k=column.key: predicted(np.exp(raw), {**phi, k: x}), at, 1e-5 * column.scale)[
                    self.index
                ]
        return found

    def finer(self, raw: np.ndarray, phi: Mapping[str, float]) -> np.ndarray | None:
        if not self.mesh:
            return None
        return (predicted(np.exp(raw), phi) + self._mesh(raw, self.finer_has))[self.index]


def _at(raw: np.ndarray, number: int, value: float) -> np.ndarray:
    moved = raw.copy()
    moved[number] = value
    return moved


def _slope(function: Callable[[float], np.ndarray], at: float, step: float) -> np.ndarray:
    return (function(at + step) - function(at - step)) / (2 * step)
