"""Studies of kind `table`: the epidermal modulus behind each measured force, as in Tables 1 and 2 of Dandekar et al. (2003).

With the ratios between the layers held, a linear body under frictionless contact at a given travel pushes back in proportion to its
modulus, so each row is answered in one reading of the model, and no start value or step matters:

    E = E_model * measured force / force of the model at the measured travel
"""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np

from .._results import RESULTS
from ..finger import Finger
from ..forward import assemble
from ..forward.shape import solid_of
from ..indenter_spec import IndenterSpec
from ..measurements import Measurement
from ..report import figures
from ..report.records import Context, Figure, Row, StudyResult, Table, mesh_record
from ..report.tables import beside_paper, mean_and_sd
from ..study import ForceTable, Study, TableRow
from .drivers import GRAM_FORCE, drivers
from .fitting import complaint

DRIVERS_FROM = 0.5  # share of the work that is done when the rows are
PAPER_POINT_SLOPE = 0.0523  # MPa/gf: epidermal modulus over force of every point row of the paper's Table 1
PAPER_PLATE_OVER_POINT = 5.7  # the plate's force over the point's for one modulus, from the same rows


def force_table(study: Study, context: Context) -> StudyResult:
    """Re-identify a table of forces row by row on this mesh, beside the published moduli."""
    table = study.options
    assert isinstance(table, ForceTable)
    fingers, forces, why = _pressed_all(study, table, context)
    title, verdict = study.notes.split(". ")[0] or "Moduli from forces", f"Not converged: {why.value} No modulus is reported."
    notes = [study.notes, *solid_of(study).notes]
    begun = StudyResult(study.name, title, verdict, RESULTS.not_converged, warnings=[why.value], notes=notes)
    begun = dataclasses.replace(begun, meshes={f"{one.name}, {name}": mesh_record(one) for name, one in fingers.items()})
    if why is not RESULTS.successful:
        return begun
    result = _result(begun, table, forces, study.model.moduli()["epidermis"])
    return _driven(result, study, table, context) if table.drivers else result


def _at(context: Context, begun: float, _: float, what: str) -> None:
    """Progress on the images of a finger, told where the bar stands."""
    context.tell(begun, what)


def _driven(result: StudyResult, study: Study, table: ForceTable, context: Context) -> StudyResult:
    """The result with the table of what drives its moduli, and what that table says."""
    driving, told = drivers(study, table, context.within(DRIVERS_FROM, 0.98).tell)
    return dataclasses.replace(result, tables=[*result.tables, driving], notes=[*result.notes, *told])


def _pressed_all(study: Study, table: ForceTable, context: Context) -> tuple[dict[str, Finger], dict[str, np.ndarray], RESULTS]:
    """Each indenter and each tip on a mesh of its own, fine where that one needs it: the meshes, the forces, and how it ended."""
    fingers: dict[str, Finger] = {}
    forces: dict[str, np.ndarray] = {}
    wanted, until = measurements_of(table), DRIVERS_FROM if table.drivers else 0.98
    for number, one in enumerate(wanted):
        begun = 0.02 + (until - 0.02) * number / len(wanted)
        context.tell(begun, one.name)
        assembled = assemble(dataclasses.replace(study, measurements=(one,)), tell=partial(_at, context, begun))
        fingers[one.name], prediction = assembled.finger, assembled.predict()
        why = complaint(prediction)
        if why is not RESULTS.successful:
            return fingers, forces, why
        forces[one.name] = np.asarray(prediction.readings[0])
    return fingers, forces, RESULTS.successful


def measurements_of(table: ForceTable) -> tuple[Measurement, ...]:
    """The indentations of every indenter, and those of each radius that is tried, at the travel of its indenter's first row."""
    found = []
    for name, spec in table.indenters.items():
        rows = [row for row in table.rows if row.indenter == name]
        radii = [radius for radius in table.radii.get(name, ()) if rows and radius != spec.dimensions["radius"]]
        found += [_pressed(name, spec, rows)] if rows else []
        found += [_pressed(_tip(name, radius), _with_radius(spec, radius), rows[:1]) for radius in radii]
    return tuple(found)


def _pressed(name: str, spec: IndenterSpec, rows: list[TableRow]) -> Measurement:
    columns = {"displacement": np.array([row.displacement for row in rows]), "force": np.array([row.force for row in rows])}
    return Measurement(name, "force_displacement", columns, "force", None, {"": spec}, "displacement", "z", None, None)


def _tip(name: str, radius: float) -> str:
    return f"{name}@{radius:g}"


def _with_radius(spec: IndenterSpec, radius: float) -> IndenterSpec:
    share = spec.dimensions.get("edge_radius", 0.0) / spec.dimensions["radius"]
    return dataclasses.replace(spec, dimensions={**spec.dimensions, "radius": radius, "edge_radius": share * radius})


def _result(begun: StudyResult, table: ForceTable, forces: dict[str, np.ndarray], modulus: float) -> StudyResult:
    ours, labels, slopes = [], [], []
    for name in table.indenters:
        rows = [row for row in table.rows if row.indenter == name]
        for row, force in zip(rows, forces.get(name, ()), strict=True):
            ours.append(modulus * row.force / float(force))
            slopes.append(modulus / float(force) * GRAM_FORCE)
            where = {"force_gf": row.force / GRAM_FORCE, "displacement_mm": row.displacement}
            labels.append({"indenter": name, "subject": row.subject, **where})
    paper = [row.modulus for name in table.indenters for row in table.rows if row.indenter == name]
    beside = beside_paper(labels, ours, paper)
    for line, slope in zip(beside, slopes, strict=True):
        line["our_slope_MPa_per_gf"] = slope
        theirs = line["paper_epidermis_modulus_MPa"]
        line["paper_slope_MPa_per_gf"] = None if theirs is None else theirs / line["force_gf"]
    means = mean_and_sd(beside, group="indenter")
    tips = _tips(table, forces, modulus)
    tables = [Table("moduli", "Epidermal modulus behind each force", beside), Table("means", "Mean and standard deviation", means)]
    growth = _growth(table, forces)
    tables += [Table("growth", "How the model's force grows with travel", growth)] if growth else []
    tables += [Table("tip_radius", "What the radius of the tip does", tips)] if tips else []
    return dataclasses.replace(
        begun,
        verdict=_verdict(means, beside),
        result=RESULTS.successful,
        warnings=[],
        tables=tables,
        figures=_figures(beside, tips),
        notes=[*begun.notes, *_tip_notes(tips)],
    )


def _tips(table: ForceTable, forces: dict[str, np.ndarray], modulus: float) -> list[Row]:
    """Modulus over force at each radius, and the plate's force over the tip's where a plate is pressed to the same travel."""
    found = []
    for name, radii in table.radii.items():
        first = next(row for row in table.rows if row.indenter == name)
        plate = _plate_force(table, forces, first.displacement)
        for radius in radii:
            force = float(forces.get(_tip(name, radius), forces[name])[0])
            row: Row = {"radius_mm": radius, "slope_MPa_per_gf": modulus / force * GRAM_FORCE}
            found.append(row if plate is None else {**row, "ratio": plate / force})
    return found


def _plate_force(table: ForceTable, forces: dict[str, np.ndarray], travel: float) -> float | None:
    for name, spec in table.indenters.items():
        rows = [row for row in table.rows if row.indenter == name]
        if spec.shape == "flat_plate":
            return next((float(f) for row, f in zip(rows, forces[name], strict=True) if row.displacement == travel), None)
    return None


def crossing(x: np.ndarray, y: np.ndarray, level: float) -> float | None:
    """Where a curve through points, straight in logarithms, crosses a level; None where it does not."""
    lx, ly = np.log(x), np.log(y) - np.log(level)
    change = np.flatnonzero(ly[:-1] * ly[1:] <= 0)
    if len(change) == 0:
        return None
    i = change[0]
    return float(np.exp(lx[i] - ly[i] * (lx[i + 1] - lx[i]) / (ly[i + 1] - ly[i])))


def _tip_notes(tips: list[Row]) -> list[str]:
    if not tips:
        return []
    radius = np.array([row["radius_mm"] for row in tips])
    slope = np.array([row["slope_MPa_per_gf"] for row in tips])
    found = [("the paper's 0.0523 MPa/gf", crossing(radius, slope, PAPER_POINT_SLOPE))]
    if "ratio" in tips[0]:
        ratio = np.array([row["ratio"] for row in tips])
        found.append(("a plate:point force ratio of 5.7", crossing(radius, ratio, PAPER_PLATE_OVER_POINT)))
    span = f"{radius.min():g} to {radius.max():g} mm"
    return [f"A tip of radius {at:.2f} mm gives {what}." if at else f"No radius from {span} gives {what}." for what, at in found]


def _growth(table: ForceTable, forces: dict[str, np.ndarray]) -> list[Row]:
    """Exponent of the model's force in travel between the smallest and the largest travel of an indenter."""
    found = []
    for name in table.indenters:
        travel = np.array([row.displacement for row in table.rows if row.indenter == name])
        if len(travel) and np.ptp(travel) > 0.05 * travel.max():
            low, high = np.argmin(travel), np.argmax(travel)
            exponent = np.log(forces[name][high] / forces[name][low]) / np.log(travel[high] / travel[low])
            found.append({"indenter": name, "from_mm": float(travel[low]), "to_mm": float(travel[high]), "exponent": float(exponent)})
    return found


def _verdict(means: list[Row], beside: list[Row]) -> str:
    all_rows = means[0]
    ours, spread = all_rows["our_mean_epidermis_modulus_MPa"], all_rows["our_sd_epidermis_modulus_MPa"]
    told = f"Epidermal modulus {ours:.3g} MPa (SD {spread:.2g}, {len(beside)} rows)"
    theirs = all_rows["paper_mean_epidermis_modulus_MPa"]
    if theirs is None:
        return f"{told}."
    about = f"(SD {all_rows['paper_sd_epidermis_modulus_MPa']:.2g})"
    return f"{told}; the paper found {theirs:.3g} {about}: ours is {ours / theirs:.2f} times that."


def _figures(beside: list[Row], tips: list[Row]) -> list[Figure]:
    bars = [
        {
            "name": f"{row['indenter']} {row['subject']}",
            "value_MPa": row["our_epidermis_modulus_MPa"],
            "paper_MPa": row["paper_epidermis_modulus_MPa"],
        }
        for row in beside
    ]
    drawn = [figures.moduli(bars, caption="Epidermal modulus of each row, ours beside the paper's.")]
    if tips and "ratio" in tips[0]:
        drawn.append(figures.tip_radius(tips, PAPER_POINT_SLOPE, PAPER_PLATE_OVER_POINT))
    return drawn
