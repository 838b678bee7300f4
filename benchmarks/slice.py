"""The chain from measured tables to moduli, in figures: forces, layers, meshes, fits, contact, derivatives, speed.

Everything is read from what the studies of experiments.yaml report, or measured here on small bodies. `--quick` leaves out the fits.
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import yaml

from benchmarks._record import Figure, at_least, at_most, between, run
from fingerjax.commands.mesh import finger_of
from fingerjax.contact.footprint import Interface, interface
from fingerjax.contact.indentation import press
from fingerjax.contact.indenter import Sphere
from fingerjax.contact.pad import functionals
from fingerjax.contact.reach import Indentation, pad_for
from fingerjax.fem.body import Body, Material, assemble_body, body, material
from fingerjax.fem.columns import Columns, columns_from_matrix
from fingerjax.fem.operator import internal_force
from fingerjax.fem.pardiso import pardiso_available
from fingerjax.fem.solver import AbstractSolver, solver_for
from fingerjax.finger import Finger
from fingerjax.finger_keys import MeshResolution
from fingerjax.forward import assemble
from fingerjax.layers import SOFT_LAYERS
from fingerjax.mesh.bodies import block
from fingerjax.report.records import Context, Row, StudyResult
from fingerjax.runners import RUNNERS
from fingerjax.runners.drivers import plate_at
from fingerjax.runners.force_table import PAPER_PLATE_OVER_POINT, PAPER_POINT_SLOPE, crossing
from fingerjax.study import Fit, ForceTable, Study, load_studies

ROOT = Path(__file__).resolve().parent.parent
EXPERIMENTS = ROOT / "experiments.yaml"
TRUTHS = ROOT / "fits" / "synthetic"
FACTOR = 1.5
PAPER_PLATE = {"human": 0.0091, "monkey": 1 / 50.5}  # MPa/gf: Tables 1 and 2
MEAN_MODULUS = {"human": (0.12, 0.27), "monkey": (0.09, 0.21)}  # MPa
MONKEY_TRAVEL = 0.79  # mm: finger C of Table 2


def main(quick: bool) -> Iterator[Figure]:
    """The figures of every part, in order."""
    studies = load_studies(EXPERIMENTS)
    yield from human(studies["table1"])
    yield from monkey(studies["table2"])
    yield from layers(studies["layer_study"])
    yield from meshes({"human": studies["table1"], "monkey": studies["table2"]})
    if not quick:
        yield from layer_ratios(studies["layer_ratios_simulated"])
        yield from afferent(studies["sa1_bar"])
    yield patch_test()
    yield hertz(10 if quick else 16)
    yield derivative(studies["table2"])
    yield from condensation(studies["table2"], 4 if quick else 8)


def answer(study: Study) -> StudyResult:
    """What a study's runner makes of it; tables leave out their drivers, which have a report of their own."""
    if isinstance(study.options, ForceTable):
        study = dataclasses.replace(study, options=dataclasses.replace(study.options, drivers=False))
    with tempfile.TemporaryDirectory() as folder:
        return RUNNERS[study.kind](study, Context(Path(folder)))


def rows(result: StudyResult, name: str) -> list[Row]:
    """The rows of one table of a result; none where the study ended before it had one."""
    return next((table.rows for table in result.tables if table.name == name), [])


def one(found: Sequence[Row], column: str, **wanted: Any) -> float:
    """The value of a column in the first row that has all the values wanted; NaN where there is none."""
    values = (row[column] for row in found if all(row.get(key) == value for key, value in wanted.items()))
    value = next(values, None)
    return math.nan if value is None else float(value)


def near(figure: str, value: float, unit: str, target: float, note: str = "") -> Figure:
    """A figure whose goal is to lie within a factor of 1.5 of the paper's."""
    return between(figure, value, unit, target / FACTOR, target * FACTOR, note or f"{value / target:.2f} times the paper's {target:.4g}")


def mean(name: str, result: StudyResult) -> Figure:
    found = rows(result, "means")
    theirs = one(found, "paper_mean_epidermis_modulus_MPa", rows="all")
    ours = one(found, "our_mean_epidermis_modulus_MPa", rows="all")
    return between(f"{name} epidermis, mean", ours, "MPa", *MEAN_MODULUS[name], note=f"paper {theirs:.3g}")


def human(study: Study) -> Iterator[Figure]:
    """Table 1: the plate, the tip that would give the paper's point, and the mean."""
    result = answer(study)
    slope = one(rows(result, "moduli"), "our_slope_MPa_per_gf", indenter="flat_plate")
    yield near("human flat plate, 1.0 mm: modulus per force", slope, "MPa/gf", PAPER_PLATE["human"])
    tips = rows(result, "tip_radius")
    yield tip(tips, "slope_MPa_per_gf", PAPER_POINT_SLOPE, f"tip radius that gives {PAPER_POINT_SLOPE:g} MPa/gf")
    yield tip(tips, "ratio", PAPER_PLATE_OVER_POINT, f"tip radius that gives plate:point {PAPER_PLATE_OVER_POINT:g}")
    yield mean("human", result)


def tip(tips: Sequence[Row], column: str, level: float, figure: str) -> Figure:
    """The radius at which a column of the table of tips crosses a level."""
    radius = np.array([row["radius_mm"] for row in tips])
    found = crossing(radius, np.array([row[column] for row in tips]), level) if len(tips) else None
    tried = f"{radius.min():g} to {radius.max():g} mm tried" if len(tips) else "not converged"
    return Figure(figure, math.nan if found is None else found, "mm", note=tried)


def monkey(study: Study) -> Iterator[Figure]:
    """Table 2: the plate, the three line rows beside the paper's, how the line's force grows, and the mean."""
    result = answer(study)
    found = rows(result, "moduli")
    slope = one(found, "our_slope_MPa_per_gf", indenter="flat_plate", displacement_mm=MONKEY_TRAVEL)
    yield near(f"monkey flat plate, {MONKEY_TRAVEL:g} mm: modulus per force", slope, "MPa/gf", PAPER_PLATE["monkey"])
    lines = [row for row in found if row["indenter"] == "line"]
    for row in lines:
        beside = f"paper 1/{1 / row['paper_slope_MPa_per_gf']:.1f}, ours 1/{1 / row['our_slope_MPa_per_gf']:.1f}"
        yield Figure(f"monkey line, {row['displacement_mm']:g} mm: modulus per force", row["our_slope_MPa_per_gf"], "MPa/gf", note=beside)
    exponent = one(rows(result, "growth"), "exponent", indenter="line")
    yield Figure("line's force grows with travel to the power", exponent, "1", note=f"paper's rows {growth(lines):.2f}")
    yield mean("monkey", result)


def growth(lines: Sequence[Row]) -> float:
    """The exponent that the paper's own line rows imply, between the smallest and the largest travel."""
    ends = sorted((row["displacement_mm"], 1 / row["paper_slope_MPa_per_gf"]) for row in lines)
    if len(ends) < 2:
        return math.nan
    return math.log(ends[-1][1] / ends[0][1]) / math.log(ends[-1][0] / ends[0][0])


def layers(study: Study) -> Iterator[Figure]:
    """How many of the paper's findings about layers hold."""
    found = rows(answer(study), "findings")
    failing = "; ".join(row["finding"] for row in found if row["holds"] != "yes")
    holding = sum(row["holds"] == "yes" for row in found) if found else math.nan
    yield at_least("findings about layers that hold", holding, "1", max(len(found), 1), f"not: {failing}" if failing else "")


def meshes(studies: dict[str, Study]) -> Iterator[Figure]:
    """Size and quality of the meshes of both presets, without the refinement that an indenter asks for."""
    for name, study in studies.items():
        quality = finger_of(study).quality
        yield between(f"{name} mesh, quadratic nodes", quality["nodes"], "1", 7500, 9500, f"{quality['tets']} elements")
        note = f"1 % of elements below {quality['p1_dihedral_deg']:.1f}"
        yield Figure(f"{name} mesh, smallest dihedral angle", quality["min_dihedral_deg"], "deg", note=note)
        worst = max(quality["volume_error"].items(), key=lambda each: abs(each[1]))
        yield at_most(f"{name} mesh, worst layer volume", 100 * abs(worst[1]), "%", 2.0, worst[0])


def truth(case: str) -> dict[str, Any]:
    """What a simulated laboratory was made with."""
    said: dict[str, Any] = yaml.safe_load((TRUTHS / case / "truth.yaml").read_text(encoding="utf-8"))
    return said


def misfit(name: str, result: StudyResult) -> Figure:
    """chi-square over its degrees of freedom; NaN where the fit did not settle."""
    fitted = result.fit or {}
    settled = bool(fitted.get("solver", {}).get("converged"))
    value = fitted["chi2"] / fitted["dof"] if settled else math.nan
    note = f"chi2 {fitted['chi2']:.4g}, {fitted['dof']} dof" if settled else "not converged"
    return Figure(f"{name}: chi2 over degrees of freedom", value, "1", note=note)


def layer_ratios(study: Study) -> Iterator[Figure]:
    """Layer ratios recovered from profiles made by other code, beside the ratios they were made with."""
    result, moduli = answer(study), truth("layer_ratios")["moduli_MPa"]
    found = {row["layer"]: row for row in rows(result, "layer_ratios")}
    covered = 0
    for layer in SOFT_LAYERS[1:]:
        true, row = moduli[layer] / moduli["epidermis"], found.get(layer)
        covered += row is not None and row["lower"] <= true <= row["upper"]
        error = math.nan if row is None else 100 * (row["ratio_to_epidermis"] / true - 1)
        beside = "" if row is None else f"{row['ratio_to_epidermis']:.4g}, 95 % {row['lower']:.4g} to {row['upper']:.4g}; truth {true:.4g}"
        yield Figure(f"layer ratios: {layer} over epidermis, error", error, "%", note=beside)
    yield at_least("layer ratios: 95 % intervals that hold the truth", covered, "1", len(SOFT_LAYERS) - 1)
    yield misfit("layer ratios", result)


def afferent(study: Study) -> Iterator[Figure]:
    """Scale and threshold of an SA-I afferent beside those that its rates were made with."""
    result, receptor = answer(study), truth("sa1_bar")["receptor"]
    yield misfit("SA-I bar", result)
    known = (result.fit or {}).get("parameters", {})
    for part, true in (("scale", receptor["scale_Hz_per_MPa"]), ("threshold", receptor["threshold_MPa"])):
        estimate = known.get(f"bar_rates.{part}", {})
        value, interval = estimate.get("value"), estimate.get("ci95", [None, None])
        error = math.nan if value is None else 100 * (value / true - 1)
        note = "" if value is None else f"95 % {interval[0]:.4g} to {interval[1]:.4g}; truth {true:.4g}"
        yield Figure(f"SA-I bar: {part}, error", error, "%", note=note)


def patch_test() -> Figure:
    """Largest force inside a graded block under constant strain, over the largest force on it."""
    shape = block((2.0, 1.0, 2.0), (4, 3, 4), grading=1.4)
    nobody = np.zeros(len(shape.nodes), bool)
    free = assemble_body(shape.nodes, shape.tets, shape.layer, nobody)
    skin = material(dict.fromkeys(SOFT_LAYERS, 1.0), 0.48)
    strain = np.array([[0.01, 0.004, -0.002], [0.003, -0.02, 0.006], [0.001, 0.005, 0.015]])
    force = np.abs(np.asarray(internal_force(free, skin.lame(), jnp.asarray(shape.nodes @ strain.T))))
    low, high = shape.nodes.min(axis=0), shape.nodes.max(axis=0)
    inside = np.all((shape.nodes > low + 1e-9) & (shape.nodes < high - 1e-9), axis=1)
    share = force[inside].max() / force.max()
    return at_most("patch test: force inside under constant strain", share, "1", 1e-10, f"{inside.sum()} nodes inside")


@dataclasses.dataclass(frozen=True)
class Pressed:
    """A block with a sphere on the middle of its skin: body, columns of the skin that is reached, contact geometry."""

    solid: Body
    columns: Columns
    face: Interface
    travel: float

    @classmethod
    def by(cls, sphere: Sphere, finger: Finger, travel: float) -> Pressed:
        at = (0.0, 0.5 * float(np.ptp(finger.nodes[:, 2])))
        skin = pad_for(finger, [Indentation(sphere, at, travel)])
        columns = columns_from_matrix(functionals(skin, len(finger.nodes)))
        return cls(body(finger, bone="held"), columns, interface(skin, sphere, at), travel)

    def force(self, matrix: jax.Array) -> jax.Array:
        """N, where readings per unit load are `matrix`."""
        return press(matrix, self.face, travel=jnp.asarray(self.travel)).force


def condensed(solid: Body, solver: AbstractSolver, skin: Material, columns: Columns) -> np.ndarray:
    """Readings per unit load (m, m); NaN where the solves did not converge."""
    held = solver.condense(solid, skin.lame(), columns).held
    return np.asarray(held.matrix) if bool(held.converged) else np.full((columns.count,) * 2, math.nan)


def bonded(ratio: float, poisson_ratio: float) -> float:
    """How many times larger the force on a layer bonded below is than on a half-space, with ratio = sqrt(R d) / thickness.

    Dimitriadis, Horkay, Maresca, Kachar & Chadwick, Biophys. J. 82 (2002), eq. 12.
    """
    nu, pi = poisson_ratio, math.pi
    a = -(1.2876 - 1.4678 * nu + 1.3442 * nu**2) / (1 - nu)
    b = (0.6387 - 1.0277 * nu + 1.5164 * nu**2) / (1 - nu)
    cubic, quartic = a**3 + 4 * pi**2 / 15 * b, a * (a**3 + 3 * pi**2 / 5 * b)
    terms = (1.0, -2 * a / pi, 4 * a**2 / pi**2, -8 * cubic / pi**3, 16 * quartic / pi**4)
    return sum(term * ratio**power for power, term in enumerate(terms))


def hertz(divisions: int) -> Figure:
    """Force of a sphere on a block, bonded below, against F = 4/3 E* R^(1/2) d^(3/2) (Hertz 1882) and what the bottom adds to it."""
    radius, travel, nu, thickness = 20.0, 0.05, 0.3, 10.0
    shape = block((24.0, thickness, 24.0), (divisions, 6, divisions), grading=2.2)
    touch, skin = Pressed.by(Sphere(jnp.asarray(radius)), shape, travel), material(dict.fromkeys(SOFT_LAYERS, 1.0), nu)
    force = float(touch.force(jnp.asarray(condensed(touch.solid, solver_for(touch.solid), skin, touch.columns))))
    reach = math.sqrt(radius * travel)
    exact = 4 / 3 / (1 - nu**2) * reach * travel * bonded(reach / thickness, nu)
    note = f"{len(shape.nodes)} nodes; contact radius {reach:g} mm on a layer of {thickness:g} mm"
    return at_most("Hertz: error of the force", 100 * abs(force / exact - 1), "%", 3.0, note)


def derivative(study: Study) -> Figure:
    """Slopes that a fit would use, of a plate's force in the logarithm of every soft modulus, against central differences."""
    assert isinstance(study.options, ForceTable)
    coarse = study.finger.model_copy(update={"resolution": MeshResolution(pad_mm=1.0, proximal_mm=3.0)})
    plate, free = (plate_at(study.options),), Fit(free=tuple(f"{layer}.modulus" for layer in SOFT_LAYERS))
    ready = assemble(dataclasses.replace(study, finger=coarse, measurements=plate, fit=free))
    problem, h = ready.problem(), 3e-4
    assert problem.prepare is not None
    at = jnp.asarray(problem.start())
    exact = np.asarray(jax.jacfwd(lambda raw, held: held(raw)[0])(at, problem.prepare(at)))
    ends = [[problem.prepare(at + way * h * step)(at + way * h * step)[0] for way in (1, -1)] for step in jnp.eye(len(at))]
    differences = np.stack([np.asarray(up - down) / (2 * h) for up, down in ends], axis=1)
    worst = np.abs(exact - differences).max() / np.abs(exact).max()
    return at_most("derivative of a force in every modulus, against differences", worst, "1", 1e-5, f"{len(ready.finger.nodes)} nodes")


def condensation(study: Study, count: int) -> Iterator[Figure]:
    """Time to condense the monkey to a few columns by every solver; no time is told where they disagree."""
    assert isinstance(study.options, ForceTable)
    plate = dataclasses.replace(study, measurements=(plate_at(study.options),))
    model = assemble(plate).model
    columns = columns_from_matrix(model.columns.matrix().tocsc()[:, :count])
    kinds = ["multigrid", "frontal", *(["pardiso"] if pardiso_available() else [])]
    found = {kind: timed(model.body, solver_for(model.body, kind), model.instruments.materials({})[0], columns) for kind in kinds}
    matrices = np.stack([matrix for matrix, _ in found.values()])
    apart = float(np.abs(matrices - matrices[0]).max() / np.abs(matrices[0]).max())
    yield at_most("condensation: solvers apart", apart, "1", 1e-6)
    for kind in kinds if apart <= 1e-6 else []:
        note = f"{len(model.body.free)} nodes, {count} columns, compile time apart"
        yield Figure(f"condensation, {kind}", found[kind][1], "s", note=note)


def timed(solid: Body, solver: AbstractSolver, skin: Material, columns: Columns) -> tuple[np.ndarray, float]:
    """The compliance matrix, and the seconds that a compiled call takes; the first is made at other moduli, which nothing remembers."""
    condensed(solid, solver, Material(1.1 * skin.youngs_modulus, skin.poisson_ratio), columns)
    began = time.perf_counter()
    matrix = condensed(solid, solver, skin, columns)
    return matrix, time.perf_counter() - began


if __name__ == "__main__":
    run(main)
