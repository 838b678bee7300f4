"""What a laboratory says about its indenter: a shape, its dimensions in mm, and which way it lies.

| shape | dimensions (optional ones in brackets) |
|---|---|
| `line` | a sharp wedge: [`width_mm`, 0.05: the experiments' wedge] |
| `point` | a flat-ended probe: `radius_mm` [`edge_radius_mm`] |
| `flat_plate` | none: larger than the pad |
| `bar` | `width_mm` [`edge_radius_mm`] |
| `step` | two flats joined by half a sinusoid: `amplitude_mm`, `wavelength_mm` |
| `sphere` | `radius_mm` |
| `cylinder` | lying on its side: `radius_mm` |
| `flat_cylinder` | standing on its end: `radius_mm` [`edge_radius_mm`] |
| `grating` | `ridge_mm`, `groove_mm`: numbers if it repeats, or lists, grooves between [`edge_radius_mm`]; or ridge and `period_mm` |
| `profile` | `data`: a CSV of `height_mm` against `position_mm` |

Shapes that lie along an axis take `along: x` (across the finger) or `along: z`; `across:` a remark means
along x.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .csvfile import read_table
from .errors import InputError
from .spelling import choose_from
from .tidy import Tidy
from .units import split_unit, to_internal
from .yamlfile import Origin, located


@dataclasses.dataclass(frozen=True)
class _Shape:
    needed: tuple[str, ...] = ()
    optional: Mapping[str, float] = dataclasses.field(default_factory=dict)
    lists: tuple[str, ...] = ()  # needed too: a number, or a list
    lies_along: bool = False
    has_data: bool = False

    def keys(self) -> list[str]:
        lengths = [f"{name}_mm" for name in (*self.needed, *self.lists, *self.optional)]
        ways = ["along", "axis", "across"] if self.lies_along else []
        return ["shape", *lengths, *(["data"] if self.has_data else []), *ways]


SHAPES: dict[str, _Shape] = {
    "line": _Shape(optional={"width": 0.05}, lies_along=True),
    "point": _Shape(("radius",), {"edge_radius": 0.0}),
    "flat_plate": _Shape(),
    "bar": _Shape(("width",), {"edge_radius": 0.0}, lies_along=True),
    "step": _Shape(("amplitude", "wavelength"), lies_along=True),
    "sphere": _Shape(("radius",)),
    "cylinder": _Shape(("radius",), lies_along=True),
    "flat_cylinder": _Shape(("radius",), {"edge_radius": 0.0}),
    "grating": _Shape(optional={"edge_radius": 0.0}, lists=("ridge", "groove"), lies_along=True),
    "profile": _Shape(lies_along=True, has_data=True),
}
_CAN_BE_ZERO = ("edge_radius",)


@dataclasses.dataclass(frozen=True)
class IndenterSpec:
    """A rigid indenter as it was described.

    - `shape`: a key of `SHAPES`.
    - `dimensions`: mm, by name without unit: `radius`, `edge_radius`, `width`, ...; optional ones are filled
      in.
    - `along`: `x` or `z`, the axis that the shape is the same along; empty for a shape without one.
    - `lists`: mm; `ridge` and `groove` of a grating that does not repeat, its first ridge centred on the
      origin; `position` and `height` of a profile.
    """

    shape: str
    dimensions: dict[str, float] = dataclasses.field(default_factory=dict)
    along: str = ""
    lists: dict[str, tuple[float, ...]] = dataclasses.field(default_factory=dict)


def read_indenter(said: Any, *, direction: str = "z", folder: Path = Path(".")) -> IndenterSpec:
    """Check what was written under `indenter:`.

    **Arguments:**

    - `said`: the keys and values, or a shape's name alone.
    - `direction`: `x` or `z`, along which distances and shifts are counted; a shape lies along the other one
      unless it says so.
    - `folder`: what the path of a profile's CSV is relative to.

    **Raises** `InputError` naming the key: unknown shape or key (with the nearest), a dimension missing, not
    positive, or larger than it can be, a unit that is no length, a grating whose lists do not fit.
    """
    said = {"shape": said} if isinstance(said, str) else said
    if not isinstance(said, Mapping) or "shape" not in said:
        raise InputError(
            "the indenter has no shape", seen=said, remedy=f"write shape: one of {', '.join(SHAPES)}"
        )
    name = str(said["shape"])
    if name not in SHAPES:
        raise InputError("unknown indenter shape", place="shape", seen=name, remedy=choose_from(name, SHAPES))
    shape = SHAPES[name]
    said = _with_groove(said) if name == "grating" else said
    lengths = _lengths(name, shape, said)
    along = _along(said, direction) if shape.lies_along else ""
    lists = {key: _list(*lengths[key]) for key in shape.lists if key in lengths and _is_list(lengths[key][2])}
    spec = IndenterSpec(name, _dimensions(shape, lengths), along, lists)
    _check_complete(shape, spec)
    _check_fit(spec)
    return dataclasses.replace(spec, lists=_profile(said, folder)) if shape.has_data else spec


def read_indenters(
    said: Any, direction: str, table: Mapping[str, np.ndarray], tidy: Tidy, origin: Origin
) -> dict[str, IndenterSpec]:
    """What was written under `indenter:` of a measurement: one for all rows, under `""`, or one for each name in the column `stimulus`.

    **Raises** `InputError` as `read_indenter`, and where the names in the column are not those that are written.
    """
    if said is None:
        remedy = "write indenter: {shape: ...} in the sidecar or the entry"
        raise InputError("nothing says what the indenter is", file=tidy.table.file, remedy=remedy)
    folder = tidy.table.file.parent if tidy.table.file else Path(".")
    several = isinstance(said, Mapping) and "stimuli" in said
    if not several:
        _check_one_stimulus(table, tidy)
        with located(origin, "indenter"):
            return {"": read_indenter(said, direction=direction, folder=folder)}
    specs = {}
    for name, one in _stimuli(said, origin).items():
        with located(origin, "indenter", "stimuli", str(name)):
            specs[str(name)] = read_indenter(one, direction=direction, folder=folder)
    _check_stimuli(specs, table, tidy)
    return specs


def _stimuli(indenter: Mapping[str, Any], origin: Origin) -> Mapping[str, Any]:
    with located(origin, "indenter"):
        other = next((str(key) for key in indenter if key != "stimuli"), None)
        if other is not None:
            raise InputError("a key beside `stimuli`", place=other, remedy="write it inside each stimulus")
        stimuli = indenter["stimuli"]
        if not isinstance(stimuli, Mapping) or not stimuli:
            remedy = "write NAME: {shape: ...}, NAME as in the column stimulus"
            raise InputError("no stimuli are named", place="stimuli", seen=stimuli, remedy=remedy)
    return stimuli


def _check_one_stimulus(table: Mapping[str, np.ndarray], tidy: Tidy) -> None:
    names = list(dict.fromkeys(table.get("stimulus", np.array([], dtype=str)).tolist()))
    if len(names) > 1:
        remedy = "write indenter: {stimuli: {NAME: {shape: ...}}}, or take one of them with `where:`"
        problem = "the column stimulus has several names but there is one indenter"
        raise InputError(problem, file=tidy.table.file, seen=names, remedy=remedy)


def _check_stimuli(specs: Mapping[str, IndenterSpec], table: Mapping[str, np.ndarray], tidy: Tidy) -> None:
    if "stimulus" not in table:
        remedy = "name the column that holds them under `columns:`, as in stimulus: THEIR_NAME"
        raise InputError(
            "stimuli are named but there is no column stimulus", file=tidy.table.file, remedy=remedy
        )
    for index, name in enumerate(table["stimulus"].tolist()):
        if name not in specs:
            column = str(tidy.find("stimulus"))
            raise tidy.table.refuse(index, column, "a stimulus without an indenter", choose_from(name, specs))


def _lengths(name: str, shape: _Shape, said: Mapping[str, Any]) -> dict[str, tuple[str, str, Any]]:
    """Every dimension written: name -> (key as written, unit, value)."""
    found = {}
    dimensions = (*shape.needed, *shape.lists, *shape.optional)
    for key, value in said.items():
        base, unit = split_unit(str(key))
        if base in dimensions:
            to_internal(1.0, unit, "length", str(key))
            found[base] = (str(key), str(unit), value)
        elif key not in (allowed := shape.keys()):
            remedy = choose_from(key, allowed)
            raise InputError(f"unknown key for the indenter {name!r}", place=str(key), remedy=remedy)
    return found


def _with_groove(said: Mapping[str, Any]) -> Mapping[str, Any]:
    """A grating of which the period is given, said as ridge and groove. Both must be single lengths in one unit."""
    written = {split_unit(str(key))[0]: str(key) for key in said}
    if "period" not in written:
        return said
    key, ridge = written["period"], written.get("ridge", "")
    if "groove" in written:
        raise InputError("period and groove of a grating say the same", place=key, remedy=f"keep one of {key} and {written['groove']}")
    unit = split_unit(key)[1]
    if ridge and split_unit(ridge)[1] != unit:
        raise InputError("ridge and period have different units", place=key, remedy=f"write both in {unit}")
    period, width = _length(key, str(unit), said[key]), _length(ridge, str(unit), said[ridge]) if ridge else 0.0
    if width >= period:
        remedy = "write a ridge narrower than its period"
        raise InputError("the ridge is as wide as its period or wider", place=ridge, seen=said[ridge], remedy=remedy)
    return {**{name: value for name, value in said.items() if name != key}, f"groove_{unit}": said[key] - said.get(ridge, 0.0)}


def _length(key: str, unit: str, value: Any, *, zero: bool = False) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError("not a number", place=key, seen=value, remedy="write one number")
    if not (0 <= value < float("inf")) or (value == 0 and not zero):
        remedy = "write a length of 0 or more" if zero else "write a length above 0"
        raise InputError("an indenter cannot have this dimension", place=key, seen=value, remedy=remedy)
    return float(to_internal(value, unit, "length", key))


def _dimensions(shape: _Shape, lengths: Mapping[str, tuple[str, str, Any]]) -> dict[str, float]:
    values = dict(shape.optional)
    for name in (*shape.needed, *shape.lists, *shape.optional):
        if name in lengths and not (name in shape.lists and _is_list(lengths[name][2])):
            values[name] = _length(*lengths[name], zero=name in _CAN_BE_ZERO)
    return values


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str)


def _list(key: str, unit: str, values: Sequence[Any]) -> tuple[float, ...]:
    return tuple(_length(key, unit, value) for value in values)


def _along(said: Mapping[str, Any], direction: str) -> str:
    """The axis that a shape lies along, from what the laboratory wrote; any text under `across` means along
    x.
    """
    axes = {key: _axis(key, said[key]) for key in ("along", "axis", "across") if key in said}
    if len(set(axes.values())) > 1:
        raise InputError("the indenter lies along two axes", seen=axes, remedy="keep one of these keys")
    return next(iter(axes.values()), "x" if direction == "z" else "z")


def _axis(key: str, value: Any) -> str:
    text = str(value).strip()
    if text in ("x", "z"):
        return {"x": "z", "z": "x"}[text] if key == "across" else text
    named = re.search(r"\balong ([xz])\b", text)
    if named:
        return named.group(1)
    if key == "across":
        return "x"
    raise InputError(
        "unknown axis", place=key, seen=value, remedy="write x (across the finger) or z (along it)"
    )


def _check_complete(shape: _Shape, spec: IndenterSpec) -> None:
    for name in (*shape.needed, *shape.lists):
        if name not in spec.dimensions and name not in spec.lists:
            key = f"{name}_mm"
            remedy = f"write {key}: and its value"
            raise InputError(f"the indenter {spec.shape!r} needs this dimension", place=key, remedy=remedy)


def _check_fit(spec: IndenterSpec) -> None:
    edge = spec.dimensions.get("edge_radius", 0.0)
    ridge, groove = spec.lists.get("ridge", ()), spec.lists.get("groove", ())
    halves = (
        spec.dimensions.get("radius"),
        spec.dimensions.get("width", 0.0) / 2,
        min(ridge, default=spec.dimensions.get("ridge", 0.0)) / 2,
    )
    room = next((half for half in halves if half), edge)
    if edge > room:
        remedy = f"it can be {room:g} mm at most"
        raise InputError(
            "the edge radius is larger than the shape", place="edge_radius_mm", seen=edge, remedy=remedy
        )
    if (ridge or groove) and len(groove) != len(ridge) - 1:
        seen = f"{len(ridge)} ridges, {len(groove)} grooves"
        remedy = "write one groove fewer than ridges: they lie between them"
        raise InputError("ridges and grooves do not fit", place="groove_mm", seen=seen, remedy=remedy)


def _profile(said: Mapping[str, Any], folder: Path) -> dict[str, tuple[float, ...]]:
    if "data" not in said:
        remedy = "write data: a CSV of height_mm against position_mm"
        raise InputError("the indenter 'profile' needs its heights", place="data", remedy=remedy)
    table = read_table(folder / str(said["data"]))
    tidy = Tidy(table)
    position, height = tidy.needed("position", "length"), tidy.needed("height", "length")
    rising = position[1:] > position[:-1]
    if len(position) < 2 or not rising.all():
        row = table.rows[int(rising.argmin()) + 1] if len(position) > 1 else table.rows[0]
        remedy = "give two rows or more, sorted by position, each once"
        raise InputError("positions do not rise", file=table.file, place=f"row {row}", remedy=remedy)
    return {"position": tuple(position.tolist()), "height": tuple(height.tolist())}
