"""What drives a modulus read from a force: the slope MPa/gf under a flat plate when one thing of a preset finger changes.

Every variant is pressed anew at the travel of the plate's first row. The base and its variants share one triangulated skin, coarser than
the study's own, because only their ratios are told and two meshes of one solid differ by some per cent.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._results import RESULTS
from ..forward import Assembled
from ..forward.model import lay_out
from ..forward.wiring import wiring
from ..geometry.presets import PRESETS, Dimensions, solid_from_dimensions
from ..geometry.sections import LayeredSolid, Patch
from ..layers import SOFT_LAYERS
from ..measurements import Measurement
from ..mesh import Resolution, build_like
from ..report.records import Row, Table
from ..study import ForceTable, Study
from ..units import to_internal
from .fitting import complaint

GRAM_FORCE = float(to_internal([1.0], "gf", "force")[0])  # N
COARSER = 1.3  # spacing of the base over the study's own
STIFF_BONE = 1e3  # bone over epidermis; the paper's range begins here
NOT_HERE = (
    "Strains under these indenters are not small, and the model is one of small strain: what finite strain and stiffening tissue would "
    "change is not in this table."
)


def _same(value: Any) -> Any:
    return value


@dataclass(frozen=True)
class Change:
    """One thing that differs from the base: its dimensions, the solid made of them, the tissue, or the mesh spacing."""

    what: str
    dimensions: Callable[[Dimensions], Dimensions] = _same
    solid: Callable[[LayeredSolid], LayeredSolid] = _same
    model: dict[str, Any] = dataclasses.field(default_factory=dict)
    spacing: float = 1.0


def _grown(*names: str, by: float) -> Callable[[Dimensions], Dimensions]:
    """These dimensions, multiplied; a triple is multiplied throughout."""

    def change(d: Dimensions) -> Dimensions:
        values: dict[str, Any] = {name: np.multiply(getattr(d, name), by) for name in names}
        grown: dict[str, Any] = {name: float(v) if v.ndim == 0 else tuple(v.tolist()) for name, v in values.items()}
        return dataclasses.replace(d, **grown)

    return change


def _short_nail(solid: LayeredSolid) -> LayeredSolid:
    low, high = solid.nail.z
    quarter = 0.25 * (high - low)
    return dataclasses.replace(solid, nail=Patch((low + quarter, high - quarter), solid.nail.theta))


def changes(epidermis: float) -> tuple[Change, ...]:
    """What is tried, for an epidermis of this modulus in MPa; the base comes first."""
    return (
        Change("nothing (base)"),
        Change("finger 10 % wider", _grown("width", by=1.1)),
        Change("finger 10 % higher", _grown("height", by=1.1)),
        Change("epidermis 20 % thicker", _grown("epidermis", by=1.2)),
        Change("dermis 20 % thicker", _grown("dermis", by=1.2)),
        Change("bone 20 % higher", _grown("bone_height", by=1.2)),
        Change("Poisson's ratio 0.49", model={"poisson_ratio": 0.49}),
        Change("bone elastic, 1000 times the epidermis", model={"bone": STIFF_BONE * epidermis}),
        Change("bone held where it is", model={"bone": "held"}),
        Change("nail half as long", solid=_short_nail),
        Change("mesh finer, spacing times 0.75", spacing=0.75),
    )


def drivers(study: Study, table: ForceTable, tell: Callable[[float, str], object]) -> tuple[Table, list[str]]:
    """The table `drivers` and the notes on it. `tell(share, what)` hears of the progress.

    A variant whose reading did not converge has no number; the note names it.
    """
    tried = changes(study.model.moduli()[SOFT_LAYERS[0]])
    slopes: list[float | None] = []
    for number, change in enumerate(tried):
        tell(number / len(tried), change.what)
        slopes.append(slope(study, plate_at(table), change))
    base = slopes[0]
    tidy: list[Row] = [
        {"changed": change.what, "slope_MPa_per_gf": value, "ratio_to_base": value / base if value and base else None}
        for change, value in zip(tried, slopes, strict=True)
    ]
    travel = plate_at(table).table["displacement"][0]
    title = f"What drives the modulus: flat plate, {travel:g} mm, one change at a time"
    note = f"One mesh, {COARSER:g} times as coarse as the study's own, deformed to each variant."
    return Table("drivers", title, tidy, note=note), notes(tidy)


def plate_at(table: ForceTable) -> Measurement:
    """The first indentation of the table by a flat plate, as one under given travel."""
    row = next(row for row in table.rows if table.indenters[row.indenter].shape == "flat_plate")
    columns = {"displacement": np.array([row.displacement]), "force": np.array([row.force])}
    return Measurement(
        row.indenter, "force_displacement", columns, "force", None, {"": table.indenters[row.indenter]}, "displacement", "z", None, None
    )


def slope(study: Study, plate: Measurement, change: Change) -> float | None:
    """Epidermal modulus over force, MPa/gf, with one thing changed; None where the reading did not converge."""
    assembled = _assembled(study, plate, change)
    prediction = assembled.predict()
    if complaint(prediction) is not RESULTS.successful:
        return None
    return float(assembled.model.wired.fixed["epidermis.modulus"] / prediction.readings[0][0]) * GRAM_FORCE


def _assembled(study: Study, plate: Measurement, change: Change) -> Assembled:
    model = study.model.model_copy(update=change.model)
    varied = dataclasses.replace(study, measurements=(plate,), model=model)
    solid = change.solid(_solid(study, change.dimensions))
    said, factor = study.finger.resolution, COARSER * change.spacing
    finger = build_like(solid, _solid(study), Resolution(factor * said.pad_mm, factor * said.proximal_mm))
    return lay_out(varied, solid, finger, wiring(varied))


def _solid(study: Study, dimensions: Callable[[Dimensions], Dimensions] = _same) -> LayeredSolid:
    assert study.finger.preset is not None  # the door has checked
    solid, nail = solid_from_dimensions(dimensions(PRESETS[study.finger.preset])), study.finger.nail
    return solid if nail is None else dataclasses.replace(solid, nail=Patch(nail.z, nail.theta))


def notes(tidy: list[Row]) -> list[str]:
    """The two changes that matter most, what did not converge, and what could not be tried."""
    known = [row for row in tidy[1:] if row["ratio_to_base"] is not None]
    largest = sorted(known, key=lambda row: -abs(np.log(row["ratio_to_base"])))[:2]
    told = " and ".join(f"{row['changed']} ({100 * (row['ratio_to_base'] - 1):+.1f} %)" for row in largest)
    absent = ", ".join(row["changed"] for row in tidy if row["slope_MPa_per_gf"] is None)
    return [
        *([f"Of the changes tried, two move MPa/gf under the flat plate most: {told}."] if told else []),
        *([f"Not converged, and so without a number in the table of drivers: {absent}."] if absent else []),
        NOT_HERE,
    ]
