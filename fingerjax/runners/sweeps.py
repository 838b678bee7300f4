"""Studies of kind `sweep`: shapes moved over a receptor, and what it feels; the paper's Figs. 11 and 12 without a neuron.

Dandekar et al. (2003), section 5: under a step at constant force contact area and pressure are opposed, and the receptor feels most where
the step is convex.
"""

from __future__ import annotations

import numpy as np

from .._results import RESULTS
from ..contact.shape import AbstractIndenter
from ..errors import InputError
from ..fem.body import Material, material
from ..finger import Finger
from ..forward.rigs import LARGEST_STRAIN_SHARE, indenter_from, skin_point
from ..forward.sequence import Pushed, Sequence, check, prepare
from ..forward.shape import mesh_of, solid_of
from ..geometry.solid import AbstractSolid
from ..measure.receptor import PAPER_QUANTITIES, QUANTITIES, UNITS
from ..measure.sites import below
from ..measurements import Receptor
from ..mesh import Focus
from ..report.records import Context, Row, StudyResult, Table, mesh_record
from ..report.sweep_figures import sweeps
from ..study import Study, Sweep

WIDE = 1.0  # mm: radius of the patches over which pressure is read as well
SPACING, PATCH = 0.25, 1.4  # of the receptor's depth: node spacing around it, and how far that goes


def sweep(study: Study, context: Context) -> StudyResult:
    """Press every indenter at every position, and read contact and receptor."""
    options, receptor = study.options, study.receptor
    assert isinstance(options, Sweep)
    if receptor is None:
        remedy = "write receptor: {depth_mm: ..., z_mm: ..., theta_deg: ...} under model:"
        raise InputError("a sweep needs the place of its receptor", file=study.file, place="model, receptor", remedy=remedy)
    solid = solid_of(study, lambda share, what: context.tell(0.1 * share, what))
    context.tell(0.1, "meshing")
    focus = Focus("point", receptor.z, receptor.theta, SPACING * receptor.depth, PATCH * receptor.depth, growth=0.8)
    finger = mesh_of(study, solid, (focus,) if focus.size < study.finger.resolution.pad_mm else ())
    rows: list[Row] = []
    for number, (name, spec) in enumerate(options.indenters.items()):
        context.tell(0.3 + 0.65 * number / len(options.indenters), name)
        rows += _swept(study, options, receptor, solid, finger, name, indenter_from(spec))
    load = f"{options.force:g} N" if options.force is not None else f"{options.depth:g} mm deep"
    summary = [_summary(name, [row for row in rows if row["indenter"] == name]) for name in options.indenters]
    return StudyResult(
        study.name,
        study.notes.split(". ")[0] or "Sweep",
        _verdict(summary),
        RESULTS.successful,
        notes=[study.notes, *solid.notes],
        meshes={solid.name: mesh_record(finger)},
        tables=[Table("summary", "Contact and receptor over the sweep", summary), Table("sweep", "Every position", rows)],
        figures=[sweeps(rows, caption=f"Contact and strain energy density {receptor.depth:g} mm below the skin; {load}.")],
    )


def _swept(
    study: Study, options: Sweep, receptor: Receptor, solid: AbstractSolid, finger: Finger, name: str, shape: AbstractIndenter
) -> list[Row]:
    tissue = material(study.model.moduli(), study.model.poisson_ratios())
    pushed, sequence = pressed(study, options, receptor, solid, finger, shape, tissue)
    state = sequence.feel(pushed, tissue)
    felt = {quantity: np.asarray(QUANTITIES[quantity](state))[:, 0] for quantity in PAPER_QUANTITIES}
    contact, over = pushed.contact, sequence.pressure_over(pushed, WIDE)
    return [
        {
            "indenter": name,
            "position_mm": place,
            "force_N": float(contact.force[i]),
            "travel_mm": float(contact.travel[i]),
            "area_mm2": float(contact.area[i]),
            "mean_pressure_kPa": 1e3 * float(pushed.mean_pressure[i]),
            "largest_pressure_kPa": 1e3 * float(contact.peak_pressure[i]),
            f"largest_pressure_over_{WIDE:g}_mm_kPa": 1e3 * float(over[i]),
            **{_column(quantity): (1e3 if UNITS[quantity] == "MPa" else 1.0) * float(felt[quantity][i]) for quantity in felt},
        }
        for i, place in enumerate(options.positions)
    ]


def _column(quantity: str) -> str:
    return f"{quantity}_kPa" if UNITS[quantity] == "MPa" else quantity


def pressed(
    study: Study, options: Sweep, receptor: Receptor, solid: AbstractSolid, finger: Finger, shape: AbstractIndenter, tissue: Material
) -> tuple[Pushed, Sequence]:
    """One shape at every position. **Raises** `InputError` where it does not touch, or where the force cannot be reached."""
    origins = np.tile(skin_point(solid, receptor.z, receptor.theta), (len(options.positions), 1))
    origins[:, "xz".index(options.direction)] += options.positions
    deepest = LARGEST_STRAIN_SHARE * float(np.ptp(finger.nodes[:, 1])) if options.depth is None else options.depth
    listener = below(solid, receptor.depth, receptor.z, receptor.theta)
    sequence = prepare(finger, shape, origins, deepest, listener, bone=study.model.bone_kind())
    pushed = sequence.press(sequence.condense(tissue).held.matrix, shape, travel=options.depth, force=options.force, material=tissue)
    check(sequence, pushed)
    return pushed, sequence


def _summary(name: str, rows: list[Row]) -> Row:
    """How area and pressure go together, and where each is largest."""
    columns = ("position_mm", "area_mm2", "mean_pressure_kPa", "strain_energy_density_kPa")
    place, area, mean, felt = (np.array([row[column] for row in rows], float) for column in columns)
    flat = np.ptp(area) == 0 or np.ptp(mean) == 0
    return {
        "indenter": name,
        "correlation_of_area_and_mean_pressure": float("nan") if flat else float(np.corrcoef(area, mean)[0, 1]),
        "least_area_at_mm": float(place[area.argmin()]),
        "most_pressure_at_mm": float(place[mean.argmax()]),
        "most_energy_at_mm": float(place[felt.argmax()]),
        "most_energy_kPa": float(felt.max()),
    }


def _verdict(summary: list[Row]) -> str:
    told = [f"{row['indenter']} where its origin is {row['most_energy_at_mm']:+.2g} mm from it" for row in summary]
    return f"The receptor feels most under {', '.join(told)}."
