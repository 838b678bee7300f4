"""Touch, in figures: contact against theory and against another program, the paper's bar and steps, measured rates, derivatives, time.

`--quick` takes coarser meshes and fewer bootstrap repeats. Claims of Dandekar, Raju & Srinivasan (2003) stand beside what was found:
`NOT MET` there means that the measured data contradict the claim, or that it is not told from its opposite with 95 % confidence.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from benchmarks import _theory
from benchmarks._bars import WINDOWS, Bars, measured_bar, sweep, tables
from benchmarks._parts import run_parts
from benchmarks._penalty import Penalty, Rested, straightened
from benchmarks._record import Figure, at_least, at_most, listed
from fingerjax.contact.footprint import first_contact
from fingerjax.contact.indenter import Bar, FlatPlate, Tilted, from_spec
from fingerjax.contact.pad import pad
from fingerjax.contact.shape import AbstractIndenter
from fingerjax.fem.body import Material, material
from fingerjax.fem.pardiso import pardiso_available
from fingerjax.fem.solver import MultigridCG, solver_for
from fingerjax.finger import Finger
from fingerjax.forward.sequence import HELD_AT, Pushed, Sequence, check, prepare
from fingerjax.geometry.presets import preset
from fingerjax.layers import SOFT_LAYERS
from fingerjax.measure.afferent import rate, start
from fingerjax.measure.receptor import strain_energy_density
from fingerjax.measure.sites import below
from fingerjax.mesh import Resolution, build_finger

SOLID = preset("monkey")
MIDDLE = SOLID.pad_centre
DEPTH = 0.75  # mm of the receptor
FINE_PAD, FINE_PROXIMAL = 0.17, 1.0  # mm: the paper's 29,000 nodes
FINE = Resolution(FINE_PAD, FINE_PROXIMAL)
ALIKE = (1.0, 1.01, 0.99, 1.02, 0.98)  # times that: as many meshes, whose scatter is in the intervals of what bar_A says
LAYERED = material(dict(zip(SOFT_LAYERS, (0.14, 0.014, 0.014, 0.014), strict=True)))
HOMOGENEOUS = material(dict.fromkeys(SOFT_LAYERS, 0.14))
ROUNDED = from_spec("bar", {"width": 3.0, "edge_radius": 0.3})
MEANS = "means over hats are held at 0, and a node between them may lie deeper; with contact held at nodes, none does"
PATCH = 1.0  # mm: the radius over which the largest pressure is read
FORCE = 0.2  # N, 20 gram-force, of the steps
STEPS = {"step 1": 0.45, "step 3": 1.55, "step 5": 3.13}  # mm: half wavelengths, from steep to gradual; the paper gives none


def other_program(quick: bool) -> Iterator[Figure]:
    """Forces of a plate and a bar on one finger of straight elements, here and by scikit-fem with a penalty, on finer and finer meshes."""
    for resolution in (Resolution(0.7, 2.1),) if quick else (Resolution(0.7, 2.1), Resolution(0.35, 1.2), FINE):
        finger = straightened(build_finger(SOLID, resolution))
        other = Penalty(finger, np.asarray(LAYERED.youngs_modulus), np.asarray(LAYERED.poisson_ratio))
        for name, shape in {"plate": FlatPlate(), "bar, 0.3 mm edges": ROUNDED}.items():
            yield from compared(f"{name}, 0.8 mm deep, {len(finger.nodes)} nodes", other, shape, goal=resolution == FINE)


def compared(name: str, other: Penalty, shape: AbstractIndenter, goal: bool) -> Iterator[Figure]:
    """On the same averages of the gap, which is the same contact problem; and at points, which is another discretisation of it."""
    origin, travel = (0.0, MIDDLE), 0.8
    lowest = float(first_contact(pad(other.finger.without_bone()), shape, origin))
    same, points = (other.press(shape, origin, travel, lowest, averaged) for averaged in (True, False))
    for held in HELD_AT:
        sequence = prepare(other.finger, shape, np.array([origin]), 1.0, bone="held", held_at=held)
        pushed = sequence.press(sequence.condense(LAYERED).held.matrix, shape, travel=travel)
        check(sequence, pushed)
        force, told = float(pushed.contact.force[0]), f"{name}, held at {held}"
        if held == "hats":
            yield _beside(f"{told}: force against scikit-fem's penalty on the gap averaged alike", force, same, True)
        yield _beside(f"{told}: force against scikit-fem's penalty on the gap at points", force, points, goal)
        yield at_most(f"{told}: largest tension", -float(pushed.contact.pressure.min()), "MPa", 0.0)
        yield at_most(f"{told}: deepest penetration where it is held", -float(pushed.contact.gap.min()), "mm", 1e-9)
        sunk = deepest_node(sequence, pushed, shape, lowest + travel)
        deepest = f"{told}: deepest penetration of a node"
        yield at_most(deepest, sunk, "mm", 1e-9) if held == "nodes" else Figure(deepest, sunk, "mm", note=MEANS)
        yield elsewhere(told, sequence, pushed, points)


def deepest_node(sequence: Sequence, pushed: Pushed, shape: AbstractIndenter, at: float) -> float:
    """How far the deepest node of the moved skin lies behind the surface of a shape whose origin is at y = `at`; mm."""
    x, y, z = np.asarray(sequence.cut.points[0]).T
    moved = y + np.asarray(pushed.readings[0, sequence.cut.columns[0]])
    above = np.asarray(shape.surface(x, z - MIDDLE)) + at - moved
    return float(np.where(shape.covers(x, z - MIDDLE), above, -np.inf).max())


def _beside(told: str, force: float, other: Rested, goal: bool) -> Figure:
    error, note = 100 * abs(force / other.force - 1), f"here {force:.5f} N, there {other.force:.5f} N"
    return at_most(told, error, "%", 1.0, note) if goal else Figure(told, error, "%", note=note)


def elsewhere(name: str, sequence: Sequence, pushed: Pushed, rested: Rested) -> Figure:
    """The pattern of pressure along the finger, here and at the other program's points."""
    here, z = np.asarray(pushed.contact.nodal_forces[0]), np.asarray(sequence.cut.points[0, :, 2])
    rows = np.arange(math.floor(z.min()), math.ceil(z.max()) + 1)  # mm along the finger
    ours = np.histogram(z, rows, weights=here)[0] / here.sum()
    theirs = np.histogram(rested.at[2], rows, weights=rested.forces)[0] / rested.force
    told = ", ".join(f"{100 * a:.0f}/{100 * b:.0f}" for a, b in zip(ours, theirs, strict=True) if a > 0.005 or b > 0.005)
    note = f"here/at points there in each millimetre along the finger: {told} %"
    return Figure(f"{name}: force that lies in another millimetre", 50 * float(np.abs(ours - theirs).sum()), "%", note=note)


def bars(quick: bool) -> Iterator[Figure]:
    """The bar at every measured position on the fine monkey, layered and homogeneous, and the rates that were measured."""
    began, found = time.perf_counter(), []
    for share in ALIKE[: 1 if quick else None]:
        finger = build_finger(SOLID, Resolution(0.5, 1.5) if quick else Resolution(share * FINE_PAD, share * FINE_PROXIMAL))
        found.append(sweep(finger, SOLID, {"layered": LAYERED, "homogeneous": HOMOGENEOUS}, DEPTH))
        if len(found) == 1:
            yield Figure("bar: nodes", len(finger.nodes), "1", note=f"meshed and pressed in {time.perf_counter() - began:.0f} s")
            yield Figure("bar: positions", len(found[0].position), "1")
            yield from speed(found[0])
    folder = _data()
    if folder is None:
        yield Figure("bar_A: measured rates", math.nan, "1", note="set FINGERJAX_DATA to the folder of measured data")
        return
    for window in WINDOWS:
        yield from tables(found, *measured_bar(folder, window), window, repeats=100 if quick else 400)


def _data() -> Path | None:
    named = os.environ.get("FINGERJAX_DATA")
    folder = Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "data"
    return folder if folder.is_dir() else None


def speed(found: Bars) -> Iterator[Figure]:
    """What a whole sweep costs, beside one linear solve and one factorisation of the same body."""
    solve, factor = one_solve(found.sequence), one_factorisation(found.sequence)
    for name, seconds in found.seconds.items():
        note = f"{seconds:.1f} s over {solve:.2f} s, warm"
        yield at_most(f"bar, {name}: sweep over one multigrid solve", seconds / solve, "1", 10.0, note)
        if not math.isnan(factor):
            yield at_most(f"bar, {name}: sweep over one factorisation", seconds / factor, "1", 3.0, f"{seconds:.1f} s over {factor:.2f} s")


def one_solve(sequence: Sequence) -> float:
    """Seconds of one solve by multigrid, compiled before: the shortest of three."""
    solver = solver_for(sequence.body, "multigrid")
    assert isinstance(solver, MultigridCG)
    load = sequence.columns.load(jnp.zeros(sequence.columns.count).at[0].set(1.0))[None]
    taken = []
    for _ in range(4):
        began = time.perf_counter()
        solver.solve(sequence.body, LAYERED.lame(), load).displacement.block_until_ready()
        taken.append(time.perf_counter() - began)
    return min(taken[1:])


def one_factorisation(sequence: Sequence) -> float:
    """Seconds of one factorisation and one answer."""
    if not pardiso_available():
        return math.nan
    solver = solver_for(sequence.body, "pardiso")
    load = sequence.columns.load(jnp.zeros(sequence.columns.count).at[0].set(1.0))[None]
    began = time.perf_counter()
    solver.solve(sequence.body, LAYERED.lame(), load).displacement.block_until_ready()
    return time.perf_counter() - began


def steps(quick: bool) -> Iterator[Figure]:
    """Figs. 12 and 13: area and pressure under step 5, and rates under steps 3 and 5 told from step 1."""
    finger = build_finger(SOLID, Resolution(*((0.7, 2.1) if quick else (0.35, 1.2))))
    shifts = np.arange(-4.0, 4.01, 0.8 if quick else 0.2)
    felt = {}
    for name, half in STEPS.items():
        pushed, sequence = step_sweep(finger, from_spec("step", {"amplitude": 0.5, "wavelength": 2 * half}), shifts)
        felt[name] = np.asarray(strain_energy_density(sequence.feel(pushed, LAYERED)))[:, 0]
        if name == "step 5":
            yield from opposed(shifts, pushed, np.asarray(sequence.pressure_over(pushed, PATCH)), felt[name])
    yield from predicted(felt)


def step_sweep(finger: Finger, step: AbstractIndenter, shifts: np.ndarray) -> tuple[Pushed, Sequence]:
    """A step pressed with constant force, its origin `shifts` mm from the receptor."""
    origins = np.column_stack([np.zeros(len(shifts)), MIDDLE + shifts])
    sequence = prepare(finger, step, origins, 2.0, below(SOLID, DEPTH, MIDDLE))
    pushed = sequence.press(sequence.condense(LAYERED).held.matrix, step, force=FORCE)
    check(sequence, pushed)
    return pushed, sequence


def opposed(shifts: np.ndarray, pushed: Pushed, largest: np.ndarray, energy: np.ndarray) -> Iterator[Figure]:
    """Least area and most pressure on the convex part; the receptor, too, feels most there."""
    area, peak = np.asarray(pushed.contact.area), np.asarray(pushed.contact.peak_pressure)
    mean = np.asarray(pushed.mean_pressure)
    yield at_most("step 5: correlation of area and mean pressure", float(np.corrcoef(area, mean)[0, 1]), "1", -0.9)
    note = f"largest over patches of {PATCH:g} mm radius"
    yield at_most("step 5: correlation of area and largest pressure", float(np.corrcoef(area, largest)[0, 1]), "1", -0.5, note)
    single = float(np.corrcoef(area, peak)[0, 1])
    yield Figure("step 5: correlation of area and largest pressure of a hat", single, "1", note="the mesh's own: its facets are uneven")
    convex = shifts > 0  # the origin, where the slope is steepest, lies distal of the receptor, which is under the rounded top
    at = float(shifts[np.argmax(energy)])
    note = f"half a wavelength is {STEPS['step 5']:g} mm"
    yield at_least("step 5: receptor feels most on the convex part, origin at", at, "mm", 0.0, note)
    yield at_most("step 5: least area on the convex part over that elsewhere", float(area[convex].min() / area[~convex].min()), "1", 1.0)


def predicted(felt: dict[str, np.ndarray]) -> Iterator[Figure]:
    """Scale and threshold fitted to rates under step 1 predict steps 3 and 5; simulated rates with noise, since none were published."""
    random, scale, threshold = np.random.default_rng(0), 1e5, 0.3 * float(felt["step 1"].max())
    clean = {name: np.asarray(rate(energy, scale, threshold)) for name, energy in felt.items()}
    sigma = 0.05 * max(float(each.max()) for each in clean.values())
    seen = np.maximum(clean["step 1"] + sigma * random.normal(size=len(clean["step 1"])), 0.0)
    fitted = start(felt["step 1"], seen)
    for name in ("step 3", "step 5"):
        left = np.asarray(rate(felt[name], *fitted)) - clean[name]
        note = "scale and threshold from step 1; simulated rates, 5 % noise"
        yield at_most(f"{name}: error of predicted rates over noise", float(np.sqrt(np.mean(left**2)) / sigma), "1", 1.0, note)


def derivatives(quick: bool) -> Iterator[Figure]:
    """Slopes against differences of force, mean pressure and rate in all that can be chosen, on the monkey; largest relative error."""
    finger = build_finger(SOLID, Resolution(*((0.9, 2.7) if quick else (0.7, 2.1))))
    few = prepare(finger, ROUNDED, np.array([[0.0, MIDDLE - 1.0]]), 0.8, below(SOLID, DEPTH, MIDDLE), bone="held")
    C = few.compliance(LAYERED)

    def read(pushed: Pushed, tissue: Material, deeper: Array) -> Array:
        felt = strain_energy_density(few.feel(pushed, tissue, deeper))[0, 0]
        return jnp.stack([pushed.contact.force[0], pushed.mean_pressure[0], rate(felt, 1e5, 1e-6)])

    def posed(v: Array) -> Array:
        pushed = few.press(C, Tilted(Bar(v[4], v[5]), v[3]), travel=v[0], offset=v[1:3])
        return read(pushed, LAYERED, v[6])

    def softened(v: Array) -> Array:
        layers = jnp.concatenate([v, jnp.ones(1)])
        tissue = Material(LAYERED.youngs_modulus * layers, LAYERED.poisson_ratio)
        return read(few.press(few.compliance(tissue), ROUNDED, travel=0.6), tissue, jnp.zeros(()))

    names = ("depth", "place across", "place along", "pitch", "width", "edge radius", "receptor depth")
    yield from slopes(posed, jnp.array([0.6, 0.02, 0.03, 0.02, 2.95, 0.3, 0.0]), 2e-6, names)
    yield from slopes(softened, jnp.ones(len(SOFT_LAYERS)), 1e-4, tuple(f"{layer}'s modulus" for layer in SOFT_LAYERS))


def slopes(read: Callable[[Array], Array], at: Array, step: float, names: tuple[str, ...]) -> Iterator[Figure]:
    for name, way in zip(names, np.eye(len(at)), strict=True):
        slope = np.asarray(jax.jvp(read, (at,), (jnp.asarray(way),))[1])
        other = np.asarray(read(at + step * way) - read(at - step * way)) / (2 * step)
        worst = np.abs(slope - other) / np.maximum(np.abs(other), 1e-6 * np.abs(np.asarray(read(at))))
        seen = ("force", "mean pressure", "rate")
        moved = [i for i in range(3) if abs(other[i]) > 1e-9]
        note = ", ".join(f"{seen[i]} {worst[i]:.1e}" for i in moved)
        yield at_most(f"derivative in {name}: relative error", max((float(worst[i]) for i in moved), default=0.0), "1", 1e-4, note)


PARTS = {"theory": _theory.main, "program": other_program, "bar": bars, "steps": steps, "derivatives": derivatives}
TEXT = """Contact against theory and against another program, the paper's bar and steps, measured rates, derivatives and time, on the
monkey preset with layers in the ratios of m43338. Claims of Dandekar, Raju & Srinivasan (2003) stand among the goals: NOT MET there means
that the recording of one afferent contradicts the claim, or does not tell it from its opposite with 95 % confidence. Written by
`python -m benchmarks.contact --write` with the measured data at hand. Measured on"""
PAGE = Path(__file__).resolve().parent.parent / "docs" / "contact.md"

if __name__ == "__main__":
    run_parts(PARTS, __doc__, (PAGE, listed("Contact, and what a receptor feels", TEXT)))
