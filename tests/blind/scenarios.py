"""The scenarios of the blind laboratory: which effect each hides, of what size, and what a diagnosis of it should end with.

A scenario changes a plain `World` by a few alterations, so that two of them in a row make a double. Names of families are those of the
residual loop; the forms are our own on purpose (see `flesh`, `stiffening`, `friction`, `pressing`, `protocol` and `instruments`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from . import instruments as made
from .flesh import FineMiddle, Flesh, OffsetBone
from .instruments import Instruments
from .protocol import AFFERENT, PAD, THIN_AFFERENT, THIN_PAD, Record, Rig
from .shapes import HUMAN, MONKEY, Divisions, FingerShape

KINDS = ("none", "single", "double", "outside", "absorbed", "mesh_limited")
"""What a truth can be: no effect; one or two of the catalogue; one that is not in it; one that the moduli take up; none, but too coarse a
mesh asked for."""


PLAIN_RIG, PLAIN_INSTRUMENTS = Rig(), Instruments()


@dataclass(frozen=True)
class World:
    """Everything that makes the data. `nominal` is the finger that is written down; `trial_gain`: every trial's forces and rates are
    multiplied by 1 + a normal number of this standard deviation; `resolution` mm, what the study asks for on the pad and elsewhere, and
    `nodes` how many it asks for, where it does."""

    nominal: FingerShape
    flesh: Flesh
    records: tuple[Record, ...]
    rig: Rig = PLAIN_RIG
    instruments: Instruments = PLAIN_INSTRUMENTS
    trial_gain: float = 0.0
    resolution: tuple[float, float] = (0.5, 2.0)
    nodes: int | None = None


Alteration = Callable[[World], World]


@dataclass(frozen=True)
class Scenario:
    """`families` are the effects behind the data; `hidden` what is behind them where no family of the catalogue is."""

    name: str
    kind: str
    families: tuple[str, ...]
    finger: str
    alterations: tuple[Alteration, ...]
    hidden: str = ""
    hold_out: bool = False

    def world(self, *, thin: bool = False) -> World:
        """The plain world of its finger, altered."""
        world = (_THIN if thin else _PLAIN)[self.finger]
        for alter in self.alterations:
            world = alter(world)
        return world

    def plain(self, *, thin: bool = False) -> World:
        """The same laboratory without the effect."""
        return (_THIN if thin else _PLAIN)[self.finger]


HELD_OUT: dict[str, list[dict[str, Any]]] = {
    "human": [
        {"measurement": "wedge_profile", "where": {"depth_mm": [1.5]}},
        {"measurement": "sphere_force", "where": {"condition": "sphere_force"}},
    ],
    "monkey": [
        {"measurement": "wedge_profile", "where": {"depth_mm": [1.2]}},
        {"measurement": "bar_rates", "where": {"stimulus": "bar_1mm", "time_s": [3.0]}},
    ],
}

_SITES = tuple((along, 0.75) for along in (0.0, -0.9, -0.6, -0.3, 0.3, 0.6, 0.9, 1.8))
_SHALLOWER = len(_SITES)


def _world(
    finger: FingerShape, moduli: tuple[float, float, float, float], divisions: Divisions, reach: float, records: tuple[Record, ...]
) -> World:
    receptors = (*_SITES, (0.0, 0.58)) if finger is MONKEY else ()
    return World(finger, Flesh(finger, moduli, divisions, reach, receptors=receptors), records)


_HUMAN_MODULI, _MONKEY_MODULI = (0.16, 0.022, 0.013, 0.019), (0.14, 0.016, 0.010, 0.015)
_UNDER_WEDGES: dict[str, Any] = {"sharp": 0.05, "under": (0.4, 0.76, 1.0), "epidermis": (0.45, 0.75, 0.9, 0.97, 1.0)}
_HUMAN_CUT = FineMiddle(pad=0.4, reach=6.5, flank=1.0, rest=2.5, palmar=10.0, **_UNDER_WEDGES)
_MONKEY_CUT = FineMiddle(pad=0.25, reach=1.8, flank=0.6, span=6.8, rest=1.5, palmar=10.0, width=18.0, **_UNDER_WEDGES)
_PLAIN = {
    "human": _world(HUMAN, _HUMAN_MODULI, _HUMAN_CUT, 11.5, PAD),
    "monkey": _world(MONKEY, _MONKEY_MODULI, _MONKEY_CUT, 8.3, AFFERENT),
}
_THIN = {
    "human": _world(HUMAN, _HUMAN_MODULI, replace(_HUMAN_CUT, reach=2.5).blunted().scaled(1.8, (1, 2, 1, 1)), 11.5, THIN_PAD),
    "monkey": _world(MONKEY, _MONKEY_MODULI, _MONKEY_CUT.blunted().scaled(1.8, (1, 2, 1, 1)), 8.3, THIN_AFFERENT),
}
_THIN = {name: replace(world, resolution=(1.6, 4.0)) for name, world in _THIN.items()}


def _flesh(**changes: Any) -> Alteration:
    return lambda world: replace(world, flesh=replace(world.flesh, **changes))


def _stiffening(size: float) -> Alteration:
    """With one brick under the tip of the wedge: at its edges strain grows without bound, and on shorter bricks skin that stiffens with
    strain comes to no rest."""

    def alter(world: World) -> World:
        cut = world.flesh.divisions
        assert isinstance(cut, FineMiddle)
        return _flesh(stiffening=size, divisions=cut.undivided() if cut.sharp else cut)(world)

    return alter


def _finger(**changes: Any) -> Alteration:
    return lambda world: replace(world, flesh=replace(world.flesh, finger=replace(world.flesh.finger, **changes)))


def _bone(rise: float) -> Alteration:
    def alter(world: World) -> World:
        finger = OffsetBone(**vars(world.flesh.finger), bone_rise=rise)
        return replace(world, flesh=replace(world.flesh, finger=finger))

    return alter


def _rig(**changes: Any) -> Alteration:
    return lambda world: replace(world, rig=replace(world.rig, **changes))


def _leaning(degrees: float) -> Alteration:
    """Plates lean, and so touch the skin farther from the site."""
    return lambda world: _rig(tilt=degrees)(_flesh(reach=world.flesh.reach + 1.5)(world))


def _instruments(**changes: Any) -> Alteration:
    return lambda world: replace(world, instruments=replace(world.instruments, **changes))


def _cell(cell: made.Cell) -> Alteration:
    return lambda world: _instruments(cells=(*world.instruments.cells, cell))(world)


def _camera(camera: made.Camera) -> Alteration:
    return lambda world: _instruments(cameras=(*world.instruments.cameras, camera))(world)


def _nerve(nerve: made.Nerve) -> Alteration:
    return lambda world: _instruments(nerves=(*world.instruments.nerves, nerve))(world)


def _other(**changes: Any) -> Alteration:
    return lambda world: replace(world, **changes)


_POISSON = {"skin": (0.40, 0.40, 0.48, 0.48), "deep": (0.48, 0.48, 0.42, 0.42)}
_POOL = ((0, 0.3), (1, 0.05), (2, 0.1), (3, 0.2), (4, 0.2), (5, 0.1), (6, 0.05))

EFFECTS: dict[str, tuple[str, Alteration]] = {
    "nail_compliance": ("human", _flesh(bed=0.004)),
    "strain_stiffening": ("human", _stiffening(12.0)),
    "skin_poisson": ("human", _flesh(poisson=_POISSON["skin"])),
    "deep_poisson": ("human", _flesh(poisson=_POISSON["deep"])),
    "epidermis_thickness": ("human", _finger(epidermis=0.8)),
    "dermis_thickness": ("human", _finger(dermis=1.8)),
    "bone_offset": ("human", _bone(-1.2)),
    "stratum_corneum": ("human", _flesh(film=0.15)),
    "depth_gradient": ("human", _flesh(graded=0.7)),
    "contact_offset": ("human", _rig(late=0.05)),
    "apparatus_compliance": ("human", _rig(frame=0.8)),
    "indenter_shift": ("human", _rig(slide=0.12, slide_per_mm=0.03)),
    "indenter_tilt": ("human", _leaning(5.0)),
    "tip_radius": ("human", _rig(blunt=0.5)),
    "friction": ("human", _rig(friction=0.8)),
    "adhesion": ("human", _rig(sticky=(1.2e-3, 0.05))),
    "relaxation": ("human", _cell(made.relaxing(0.2, 0.8))),
    "hysteresis": ("human", _cell(made.lossy(0.15))),
    "force_lag": ("human", _cell(made.lagging(0.05))),
    "force_offset": ("human", _cell(made.offset(0.004))),
    "force_drift": ("human", _cell(made.drifting(0.0015))),
    "camera_scale": ("human", _camera(made.enlarging(0.04))),
    "profile_tilt": ("human", _camera(made.turned(0.5))),
    "rate_saturation": ("monkey", _nerve(made.saturating(90.0))),
    "rate_power_law": ("monkey", _nerve(made.bending(0.7))),
    "spontaneous_rate": ("monkey", _nerve(made.humming(10.0))),
    "rate_adaptation": ("monkey", _nerve(made.tiring(0.12))),
    "receptive_field_pooling": ("monkey", _instruments(sites=_POOL)),
    "receptor_depth": ("monkey", _instruments(sites=((_SHALLOWER, 1.0),))),
    "receptor_position": ("monkey", _instruments(sites=((4, 1.0),))),
}
"""One effect of the catalogue each: on which finger it is shown, and what it does to the world."""

_PAIRS = (
    ("nail_compliance", "relaxation", "human"),
    ("contact_offset", "camera_scale", "human"),
    ("epidermis_thickness", "hysteresis", "human"),
    ("stratum_corneum", "force_drift", "human"),
    ("rate_saturation", "force_offset", "monkey"),
    ("receptor_position", "force_lag", "monkey"),
)

_STRANGERS = (
    ("callus", "a callus: the epidermis is hard in one place", "human", _flesh(callus=5.0)),
    ("periodic_drift", "the load cell's zero swings", "human", _cell(made.swinging(0.006, 3.1))),
    ("barrel_distortion", "the camera's lens shrinks the rim of the picture", "human", _camera(made.barrel(0.15, 6.0))),
    ("second_spot", "the afferent has a second ending 1.8 mm away", "monkey", _instruments(sites=((0, 1.0), (7, 0.4)))),
    ("screw_error", "the spindle's travel is off by a wave of its pitch", "human", _rig(screw=0.04)),
)


def _all() -> tuple[Scenario, ...]:
    plain = [Scenario(f"none_{finger}", "none", (), finger, (), hold_out=True) for finger in _PLAIN]
    single = [
        Scenario(name, "single", (name,), finger, (alter,), hold_out=n % 2 == 0)
        for n, (name, (finger, alter)) in enumerate(EFFECTS.items())
    ]
    double = [Scenario(f"{a}+{b}", "double", (a, b), finger, (EFFECTS[a][1], EFFECTS[b][1]), hold_out=True) for a, b, finger in _PAIRS]
    outside = [Scenario(name, "outside", (), finger, (alter,), hidden, hold_out=True) for name, hidden, finger, alter in _STRANGERS]
    gain = Scenario("load_cell_gain", "absorbed", ("force_gain",), "human", (_cell(made.gaining(1.1)),))
    too_coarse = _other(resolution=(2.5, 5.0), nodes=1500)
    coarse = Scenario("coarse_mesh", "mesh_limited", (), "human", (too_coarse,), "the study asks for too coarse a mesh")
    trials = Scenario("trial_gain", "none", (), "human", (_other(trial_gain=0.03),), "forces of each trial have a gain of their own", True)
    return (*plain, *single, *double, *outside, gain, coarse, trials)


SCENARIOS: dict[str, Scenario] = {scenario.name: scenario for scenario in _all()}
