"""Simulated laboratories: which finger, which indenters, what was recorded, and how noisy it is.

A case is data: its numbers are the truth that a fit is asked to find again.  `observe` computes what
noiseless instruments would read; `generate` adds noise and writes files.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .bricks import Array, strain_energy_density
from .shapes import HUMAN, MONKEY, Divisions, FingerShape, finger_bricks
from .touch import (
    Body,
    Indenter,
    Press,
    bar,
    condense,
    cylinder,
    deflection,
    flat_plate,
    press,
    receptor_strain,
)

POISSON = 0.48


@dataclass(frozen=True)
class Profiles:
    """Skin deflection along the midline of the pad, at `distances` mm from the site, for each depth."""

    name: str
    indenter: Indenter
    shape: dict[str, object]
    depths: tuple[float, ...]
    distances: tuple[float, ...]


@dataclass(frozen=True)
class Forces:
    """Normal force at each travel from first contact."""

    name: str
    indenter: Indenter
    shape: dict[str, object]
    travels: tuple[float, ...]


@dataclass(frozen=True)
class Rates:
    """Mean rate of one afferent for each position of the indenter: scale (Hz/MPa) times strain energy
    density over a threshold (MPa)."""

    name: str
    stimulus: str
    indenter: Indenter
    shape: dict[str, object]
    depth: float
    positions: tuple[float, ...]
    scale: float
    threshold: float


@dataclass(frozen=True)
class Case:
    """One laboratory; `moduli` in MPa from the epidermis inwards; `reach` mm of z about the site that may
    be touched."""

    name: str
    title: str
    finger: FingerShape
    moduli: tuple[float, float, float, float]
    start: tuple[float, float, float, float]
    divisions: Divisions
    reach: float
    records: tuple[Profiles | Forces | Rates, ...]
    seed: int
    trials: int = 3
    receptor_depth: float | None = None

    @property
    def receptor(self) -> tuple[float, float, float] | None:
        """Place of the receptor: its depth is measured along y from the skin at the site."""
        if self.receptor_depth is None:
            return None
        skin = self.finger.centre_y - float(
            self.finger.radius(0, np.array(self.finger.site), np.array(270.0))
        )
        return (0.0, skin + self.receptor_depth, self.finger.site)


@dataclass(frozen=True)
class Observation:
    """Noiseless readings by record name, and what the computation was like (nodes, residual, largest drift
    with the penalty)."""

    clean: dict[str, Array]
    figures: dict[str, float]


def build(case: Case, divisions: Divisions | None = None) -> Body:
    """Mesh and condense the case's finger; the midline of the skin is watched."""
    mesh = finger_bricks(case.finger, divisions or case.divisions)
    midline = mesh.number[-1, 0]

    def touchable(centre: Array) -> Array:
        angle = np.degrees(np.arctan2(centre[:, 1] - case.finger.centre_y, centre[:, 0]))
        return (angle < -12.0) & (np.abs(centre[:, 2] - case.finger.site) < case.reach)

    receptors = () if case.receptor is None else (case.receptor,)
    return condense(
        mesh, np.array(case.moduli), POISSON, touchable, watched=midline[midline >= 0], receptors=receptors
    )


def observe(case: Case, divisions: Divisions | None = None, body: Body | None = None) -> Observation:
    """What noiseless instruments would read, record by record."""
    body = body or build(case, divisions)
    clean, drift = {}, 0.0
    for record in case.records:
        clean[record.name], worst = _read(case, body, record)
        drift = max(drift, worst)
    figures = {
        "nodes": len(body.mesh.nodes),
        "bricks": len(body.mesh.bricks),
        "linear_residual": body.residual,
        "penalty_drift": drift,
    }
    return Observation(clean, figures)


def _read(case: Case, body: Body, record: Profiles | Forces | Rates) -> tuple[Array, float]:
    def press_at(z: float, travel: float) -> Press:
        return press(body, record.indenter, at=z, travel=travel)

    site = case.finger.site
    if isinstance(record, Profiles):
        presses = [press_at(site, d) for d in record.depths]
        values = np.array(
            [_along(body, deflection(body, p), site + np.array(record.distances)) for p in presses]
        )
    elif isinstance(record, Forces):
        presses = [press_at(site, d) for d in record.travels]
        values = np.array([p.force for p in presses])
    else:
        presses = [press_at(site + s, record.depth) for s in record.positions]
        energy = np.array([energy_at_receptor(case, body, p) for p in presses])
        values = record.scale * np.maximum(energy - record.threshold, 0.0)
    return values, max(p.drift for p in presses)


def energy_at_receptor(case: Case, body: Body, contact: Press) -> float:
    """Strain energy density, MPa, at the case's receptor."""
    modulus = case.moduli[body.receptor_layers[0]]
    return float(strain_energy_density(receptor_strain(body, contact), modulus, POISSON))


def _along(body: Body, deflections: Array, z: Array) -> Array:
    """Midline deflection at heights z: the element's own quadratic through three successive nodes."""
    nodes = body.mesh.nodes[body.watched, 2]
    start = 2 * np.clip(np.searchsorted(nodes[::2], z) - 1, 0, (len(nodes) - 3) // 2)
    at, value = (np.stack([v[start + n] for n in range(3)]) for v in (nodes, deflections))
    total = np.zeros(len(z))
    for n in range(3):
        others = [m for m in range(3) if m != n]
        total += value[n] * np.prod([(z - at[m]) / (at[n] - at[m]) for m in others], axis=0)
    return total


def _steps(first: float, last: float, step: float) -> tuple[float, ...]:
    return tuple(float(v) + 0.0 for v in np.round(np.arange(first, last + 0.5 * step, step), 6))


def _cylinder(diameter: float) -> dict[str, object]:
    return {
        "shape": "cylinder",
        "radius_mm": diameter / 2,
        "across": "the cylinder lies across the finger (along x)",
    }


_DEPTHS = (0.5, 1.0, 1.5, 2.0)
_PLATE = Forces("plate_force", flat_plate(), {"shape": "flat_plate"}, _steps(0.25, 1.5, 0.25))
_ALONG = _steps(-9.0, 9.0, 0.5)

LAYER_RATIOS = Case(
    name="layer_ratios",
    title="Index finger, nail glued: skin deflection under two cylinders laid across it, and plate force.",
    finger=HUMAN,
    moduli=(0.18, 0.018, 0.012, 0.02),
    start=(0.18, 0.018, 0.018, 0.018),
    divisions=Divisions(pad=0.4, flank=0.8, palmar=6.0),
    reach=11.5,
    records=(
        Profiles("cylinder_3_profile", cylinder(1.585), _cylinder(3.17), _DEPTHS, _ALONG),
        Profiles("cylinder_9_profile", cylinder(4.76), _cylinder(9.52), _DEPTHS, _ALONG),
        _PLATE,
    ),
    seed=311,
)

SA1_BAR = Case(
    name="sa1_bar",
    title="Macaque finger, nail glued down: SA-I afferent under a bar swept along it, and plate force.",
    finger=MONKEY,
    moduli=(0.14, 0.014, 0.010, 0.016),
    start=(0.14, 0.014, 0.014, 0.014),
    divisions=Divisions(pad=0.15, reach=1.2, flank=0.3, span=6.8, rest=1.2),
    reach=8.3,
    records=(
        Rates(
            "bar_rates",
            "bar_3mm",
            bar(3.0, 0.3),
            {"shape": "bar", "width_mm": 3.0, "edge_radius_mm": 0.3},
            1.0,
            _steps(-5.1, 5.1, 0.3),
            scale=133300.0,
            threshold=6.0e-5,
        ),
        _PLATE,
    ),
    seed=312,
    receptor_depth=0.75,
)

CASES: dict[str, Case] = {case.name: case for case in (LAYER_RATIOS, SA1_BAR)}


def noise_sigma(record: Profiles | Forces | Rates, clean: Array, fraction: float) -> Array:
    """Standard deviation of every reading.

    A profile's is `fraction` of its largest depth throughout; a rate's 1.5 `fraction` of its peak; a
    force's has a floor and a share of the force itself, f = 2 `fraction`: sqrt((0.4 f max)^2 + (f
    value)^2).
    """
    if isinstance(record, Profiles):
        return np.full(clean.shape, fraction * max(record.depths))
    if isinstance(record, Rates):
        return np.full(clean.shape, np.round(1.5 * fraction * clean.max(), 2))
    share = 2.0 * fraction
    return np.sqrt((0.4 * share * clean.max()) ** 2 + (share * clean) ** 2)
