"""What a laboratory does with one finger: profiles under a wedge, forces against travel and against time, an afferent under bars.

`elastic` computes what the finger itself does in each of these; cameras, load cells and nerves come after, in `instruments.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import brentq

from .bricks import Array, strain_energy_density
from .flesh import Flesh, body_of
from .friction import Rubbing
from .laboratory import Profiles
from .pressing import Felt, Plain, Pressing, Sticky
from .stiffening import Stiffening
from .touch import Indenter, bar, cylinder, flat_plate, line, probe, sphere

FINE = 0.02
"""Spacing in s at which a force trace is followed between its readings."""


@dataclass(frozen=True)
class Trace:
    """Normal force at `times` s while the indenter follows `path`, ((s, mm of travel), ...), straight between these; `along` mm
    of z from the site."""

    name: str
    indenter: Indenter
    shape: tuple[tuple[str, object], ...]
    path: tuple[tuple[float, float], ...]
    times: tuple[float, ...]
    along: float = 0.0

    def travel(self, time: Array) -> Array:
        """Travel commanded at `time`, mm."""
        times, travels = np.array(self.path).T
        return np.round(np.interp(time, times, travels), 9)

    @property
    def fine(self) -> Array:
        """Times from start to end at which the trace is followed, s."""
        return np.arange(0.0, self.path[-1][0] + 0.5 * FINE, FINE)


@dataclass(frozen=True)
class Sweep:
    """Rates of one afferent under bars at `positions` mm from the receptor, `depth` mm deep, `times` s after each was put down."""

    name: str
    stimuli: tuple[tuple[str, Indenter, tuple[tuple[str, object], ...]], ...]
    depth: float
    positions: tuple[float, ...]
    times: tuple[float, ...]


Record = Profiles | Trace | Sweep


@dataclass(frozen=True)
class Rig:
    """How the indenters really met the finger; nulls are those of the plain model.

    - `late` mm: the depth gauge read zero this much before the skin was reached, times a share of each instrument's own (`SHARES`).
    - `frame` mm/N: the frame gives way by frame x `FRAME_TURN` log(1 + F / FRAME_TURN): less and less.
    - `slide` mm and `slide_per_mm`: the contact lies further along z, and more so the deeper.
    - `tilt` deg: plates fall away from the skin towards the tip. `blunt` mm: the wedge is a cylinder of this radius.
    - `screw` mm: the spindle goes too far by screw x sin(2 pi travel / 0.8 mm).
    - `friction`: Coulomb's coefficient. `sticky`: traction MPa and range mm, see `pressing.Sticky`.
    """

    late: float = 0.0
    frame: float = 0.0
    slide: float = 0.0
    slide_per_mm: float = 0.0
    tilt: float = 0.0
    blunt: float = 0.0
    screw: float = 0.0
    friction: float = 0.0
    sticky: tuple[float, float] | None = None


FRAME_TURN, PITCH = 0.15, 0.8
SHARES = {"line": 1.0, "flat_plate": 1.1, "point": 0.9, "sphere": 1.0, "bar": 1.0}


def felt(rig: Rig, finger: Pressing, indenter: Indenter, at: float, travel: float) -> Felt:
    """A press as the rig really made it, its origin meant to be at z = `at` and its travel to be `travel` mm."""
    at = round(at + rig.slide + rig.slide_per_mm * travel, 9)
    travel = travel - rig.late * SHARES[indenter.name] + rig.screw * np.sin(2 * np.pi * travel / PITCH)
    if travel <= 0.0:
        return Felt.none(finger.body)
    indenter = _real(rig, indenter)
    if not rig.frame:
        return finger.press(indenter, at, travel)

    def missing(depth: float) -> float:
        force = finger.press(indenter, at, depth).force if depth > 0 else 0.0
        return depth + rig.frame * FRAME_TURN * np.log1p(force / FRAME_TURN) - travel

    return finger.press(indenter, at, float(brentq(missing, 0.0, travel, xtol=1e-4)))


@lru_cache(maxsize=32)
def _blunt(radius: float) -> Indenter:
    return Indenter("line", cylinder(radius).height)


@lru_cache(maxsize=32)
def _tilted(degrees: float) -> Indenter:
    slope = np.tan(np.radians(degrees))
    return Indenter("flat_plate", lambda x, z: -slope * z + 0.0 * x)


def _real(rig: Rig, indenter: Indenter) -> Indenter:
    if rig.blunt and indenter.name == "line":
        return _blunt(rig.blunt)
    if rig.tilt and indenter.name == "flat_plate":
        return _tilted(rig.tilt)
    return indenter


def finger_of(flesh: Flesh, rig: Rig) -> Pressing:
    """The way of pressing that a flesh and a rig ask for. Raises ValueError where they ask for two that do not go together."""
    special = [bool(flesh.stiffening), bool(rig.friction), rig.sticky is not None]
    if sum(special) > 1:
        raise ValueError("stiffening, friction and adhesion come one at a time")
    if rig.friction and rig.frame:
        raise ValueError("friction remembers its path, so the travel of a giving frame cannot be searched for")
    if flesh.stiffening:
        return Stiffening(flesh)
    if rig.friction:
        return Rubbing(flesh, rig.friction)
    return Sticky(body_of(flesh), *rig.sticky) if rig.sticky else Plain(body_of(flesh))


@dataclass(frozen=True)
class Elastic:
    """What the finger does, by record name: `lines` u_y mm on the midline at each depth (depths, w) and its z (w,) about the site;
    `curves` travel mm and force N, (2, n), from the travel at which the indenter meets the skin; `energy` MPa at the receptors, (stimuli,
    positions, receptors)."""

    lines: dict[str, Array]
    z: Array
    curves: dict[str, Array]
    energy: dict[str, Array]

    def force(self, name: str, travel: Array) -> Array:
        """Force N at `travel` mm: exact where it was computed and monotone between, through its 2/3 power, which is nearly straight."""
        known, force = self.curves[name]
        root = PchipInterpolator(known, np.sign(force) * np.abs(force) ** (2 / 3))(np.maximum(travel, known[0]))
        return np.sign(root) * np.abs(root) ** 1.5

    def save(self, file: Path) -> None:
        """Write everything to an .npz."""
        parts = {"lines": self.lines, "curves": self.curves, "energy": self.energy}
        arrays = {f"{part}/{name}": value for part, held in parts.items() for name, value in held.items()}
        np.savez(file, allow_pickle=False, z=self.z, **arrays)

    @classmethod
    def load(cls, file: Path) -> Elastic:
        """What `save` wrote."""
        with np.load(file) as kept:
            held = {
                part: {key.split("/")[1]: kept[key] for key in kept if key.startswith(f"{part}/")} for part in ("lines", "curves", "energy")
            }
            return cls(held["lines"], kept["z"], held["curves"], held["energy"])


def elastic(flesh: Flesh, rig: Rig, records: tuple[Record, ...]) -> Elastic:
    """Press a finger as `records` ask."""
    finger = finger_of(flesh, rig)
    site, body = flesh.finger.site, finger.body
    found = Elastic({}, body.mesh.nodes[body.watched, 2] - site, {}, {})
    for record in records:
        finger.rest()
        if isinstance(record, Profiles):
            found.lines[record.name] = np.stack([felt(rig, finger, record.indenter, site, d).deflection for d in record.depths])
        elif isinstance(record, Trace):
            found.curves[record.name] = _curve(rig, finger, record, site + record.along)
        else:
            found.energy[record.name] = _energies(flesh, rig, finger, record)
    return found


def _curve(rig: Rig, finger: Pressing, record: Trace, site: float) -> Array:
    """Travels mm and forces N, (2, n), wherever the trace is read, and where it begins."""
    travels = np.unique(record.travel(np.array(record.times)))
    travels = travels[travels > 0.0]
    force = [felt(rig, finger, record.indenter, site, float(t)).force for t in travels]
    start = min(max(rig.late * SHARES[record.indenter.name], 0.0), 0.5 * travels[0])
    return np.array([[start, *travels], [0.0, *force]])


def _energies(flesh: Flesh, rig: Rig, finger: Pressing, record: Sweep) -> Array:
    layers = list(finger.body.receptor_layers)
    modulus, poisson = np.asarray(flesh.moduli)[layers], np.asarray(flesh.poisson)[layers]
    out = np.zeros((len(record.stimuli), len(record.positions), len(layers)))
    for a, (_, indenter, _) in enumerate(record.stimuli):
        for b, position in enumerate(record.positions):
            strain = felt(rig, finger, indenter, flesh.finger.site + position, record.depth).strain
            for n in range(len(layers)):
                out[a, b, n] = strain_energy_density(strain[n], modulus[n], poisson[n])
    return out


def _steps(first: float, last: float, step: float) -> tuple[float, ...]:
    return tuple(float(v) + 0.0 for v in np.round(np.arange(first, last + 0.5 * step, step), 6))


def _slow(name: str, indenter: Indenter, shape: dict[str, object], travels: tuple[float, ...], along: float = 0.0) -> Trace:
    """Slow loading at a quarter of a millimetre a second."""
    end = travels[-1]
    return Trace(name, indenter, tuple(shape.items()), ((0.0, 0.0), (4.0 * end, end)), tuple(4.0 * t for t in travels), along)


def _hold(indenter: Indenter, deep: float) -> Trace:
    """Down in a second, held for six, up again to a third in two thirds of a second."""
    path = ((0.0, 0.0), (1.0, deep), (7.0, deep), (7.0 + 2 / 3, deep / 3))
    times = (1 / 6, 1 / 3, 1 / 2, 2 / 3, 5 / 6, 1.0, 1.1, 1.25, 1.5, 2.0, 3.0, 4.5, 7.0, 7 + 1 / 6, 7 + 1 / 3, 7.5, 7 + 2 / 3)
    return Trace("plate_hold", indenter, (("shape", "flat_plate"),), path, times)


_ACROSS = {"across": "it lies across the finger (along x)"}
_PLATE, _LINE, _PROBE, _BALL = flat_plate(), line(), probe(1.0, 0.5), sphere(3.0)
_LINE_SHAPE = {"shape": "line", "width_mm": 0.05, **_ACROSS}
_PROBE_SHAPE: dict[str, object] = {"shape": "point", "radius_mm": 1.0, "edge_radius_mm": 0.5}
_TRAVELS = _steps(0.25, 1.5, 0.25)

PAD: tuple[Record, ...] = (
    Profiles("wedge_profile", _LINE, _LINE_SHAPE, (0.5, 1.0, 1.5, 2.0), _steps(-6.0, 6.0, 0.5)),
    _slow("plate_force", _PLATE, {"shape": "flat_plate"}, _TRAVELS),
    _slow("probe_force", _PROBE, _PROBE_SHAPE, _TRAVELS),
    _slow("probe_force_tip", _PROBE, _PROBE_SHAPE, _TRAVELS[1::2], 3.0),
    _slow("probe_force_base", _PROBE, _PROBE_SHAPE, _TRAVELS[1::2], -5.0),
    _slow("sphere_force", _BALL, {"shape": "sphere", "radius_mm": 3.0}, _TRAVELS),
    _hold(_PLATE, 1.2),
)
"""Profiles and forces of a fingertip."""

BARS = Sweep(
    "bar_rates",
    (
        ("bar_3mm", bar(3.0, 0.3), (("shape", "bar"), ("width_mm", 3.0), ("edge_radius_mm", 0.3))),
        ("bar_1mm", bar(1.0, 0.2), (("shape", "bar"), ("width_mm", 1.0), ("edge_radius_mm", 0.2))),
    ),
    0.8,
    _steps(-3.0, 3.0, 0.5),
    (0.3, 3.0),
)
AFFERENT: tuple[Record, ...] = (
    Profiles("wedge_profile", _LINE, _LINE_SHAPE, (0.4, 0.8, 1.2, 1.6), _steps(-4.0, 4.0, 0.5)),
    _slow("plate_force", _PLATE, {"shape": "flat_plate"}, _steps(0.2, 1.2, 0.2)),
    _hold(_PLATE, 0.9),
    BARS,
)
"""Profiles and forces of a small fingertip, and the rates of an afferent in it."""

_FEW = _steps(-4.0, 4.0, 1.0)
THIN_PAD: tuple[Record, ...] = (
    Profiles("wedge_profile", _LINE, _LINE_SHAPE, (0.5, 1.0, 1.5, 2.0), _FEW),
    _slow("plate_force", _PLATE, {"shape": "flat_plate"}, _steps(0.5, 1.5, 0.5)),
    _slow("sphere_force", _BALL, {"shape": "sphere", "radius_mm": 3.0}, _steps(0.5, 1.5, 0.5)),
    _hold(_PLATE, 1.2),
)
THIN_AFFERENT: tuple[Record, ...] = (
    Profiles("wedge_profile", _LINE, _LINE_SHAPE, (0.4, 0.8, 1.2, 1.6), _FEW),
    _hold(_PLATE, 0.9),
    Sweep("bar_rates", BARS.stimuli, 0.8, _steps(-2.0, 2.0, 1.0), (0.3, 3.0)),
)
"""The same with few readings, for tests."""
