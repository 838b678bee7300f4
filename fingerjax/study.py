"""The door for studies: `experiments.yaml` becomes checked `Study` records before anything is computed.

A study names a finger, a model, measurements, and what is to be done with them. Every name in it (a layer, a
parameter, a
column, a measurement) is checked here against what there is; what is wrong is refused with file, line and
the nearest name.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .csvfile import inline_table, read_table, same
from .errors import InputError
from .indenter_spec import IndenterSpec, read_indenter
from .layers import SOFT_LAYERS
from .measurements import Measurement, Receptor, read_measurement, receptor_from
from .parameters import Parameter
from .spelling import choose_from
from .strict import checked
from .study_keys import (
    DiagnoseKeys,
    Finger,
    FitKeys,
    LayerStudyKeys,
    Model,
    StudyKeys,
    TableKeys,
)
from .tidy import LABELS, QUANTITIES, Tidy
from .units import internal_unit, split_unit, to_internal
from .yamlfile import Document, Origin, located, read_yaml

VERSION = 1
SHARED = "data:"
"""A path that begins so is looked for in the data folder (`--data`, or the environment's FINGERJAX_DATA)."""


@dataclasses.dataclass(frozen=True)
class Prior:
    """A value measured elsewhere: normal about `value` (internal unit), standard deviation `sd` in the same
    unit.
    """

    value: float
    sd: float

    @property
    def relative_sd(self) -> float:
        """`sd` as a share of `value`."""
        return self.sd / self.value


@dataclasses.dataclass(frozen=True)
class Fit:
    """Which parameters move.

    - `free`: their names; every spike-rate file's scale and threshold are among them.
    - `tie`: groups that share one value, that of their first member.
    - `per`: name -> the label column (`subject`, ...) of which every value has its own; in a tie it holds
      for the group.
    - `priors`: name -> what was measured elsewhere.
    """

    free: tuple[str, ...] = ()
    tie: tuple[tuple[str, ...], ...] = ()
    per: dict[str, str] = dataclasses.field(default_factory=dict)
    priors: dict[str, Prior] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class HeldOut:
    """Rows kept from the fit: of one measurement, where every column has one of the values (internal
    units).
    """

    measurement: str
    where: dict[str, tuple[float | str, ...]]


@dataclasses.dataclass(frozen=True)
class Diagnose:
    """`effects`: `all`, `none`, or a tuple of names; `hold_out`: empty where whole conditions are held out
    in turn.
    """

    effects: str | tuple[str, ...] = "all"
    hold_out: tuple[HeldOut, ...] = ()


@dataclasses.dataclass(frozen=True)
class TableRow:
    """One line of a table of forces: `force` in N at `displacement` in mm, and the published `modulus` in
    MPa.
    """

    indenter: str
    subject: str
    force: float
    displacement: float
    modulus: float | None


@dataclasses.dataclass(frozen=True)
class ForceTable:
    """Options of `kind: table`: the rows, and the indenter of each name in them; `controlled` says what was
    imposed.
    """

    rows: tuple[TableRow, ...]
    indenters: dict[str, IndenterSpec]
    controlled: str


@dataclasses.dataclass(frozen=True)
class LayerStudy:
    """Options of `kind: layer_study`.

    - `models`: names such as `m43338`; the first is what the others are compared with.
    - `depth`: mm, of every profile; `span`, `spacing`: mm, the profile goes from -span to span.
    """

    models: tuple[str, ...]
    depth: float
    indenter: IndenterSpec
    span: float
    spacing: float


@dataclasses.dataclass(frozen=True, eq=False)
class Study:
    """One study, checked.

    - `kind`: `fit`, `table`, `layer_study` or `predict`.
    - `finger`, `model`: as written, see `study_keys`; `sections` is where the geometry's CSV is, None for a
      preset.
    - `missing_data`: files in the data folder that are not there; while there are any, `fallback` (if not
      None) is the name
      of the study to run instead, and `measurements` holds only what could be read.
    - `options`: of a `table` or a `layer_study`; None for the other kinds, and where its file is missing.
    """

    name: str
    kind: str
    file: Path
    finger: Finger
    sections: Path | None
    model: Model
    receptor: Receptor | None
    measurements: tuple[Measurement, ...]
    fit: Fit
    diagnose: Diagnose | None
    options: ForceTable | LayerStudy | None = None
    missing_data: tuple[str, ...] = ()
    fallback: str | None = None
    notes: str = ""
    written: dict[str, Any] = dataclasses.field(default_factory=dict)

    def measurement(self, name: str) -> Measurement:
        """One of the measurements. **Raises** `InputError` naming the nearest where there is none of that
        name.
        """
        by_name = {measurement.name: measurement for measurement in self.measurements}
        if name not in by_name:
            raise InputError(
                f"study {self.name!r} has no measurement {name!r}", remedy=choose_from(name, by_name)
            )
        return by_name[name]

    def parameters(self) -> tuple[Parameter, ...]:
        """Every number of the model that a fit may free, at its start value and with generous limits."""
        return base_parameters(self.model, self.measurements)


def base_parameters(model: Model, measurements: Sequence[Measurement] = ()) -> tuple[Parameter, ...]:
    """The parameters of a model and of the afferents that were recorded.

    `<layer>.modulus` (MPa), `poisson_ratio` or `<layer>.poisson_ratio`, and for every spike-rate measurement
    its `scale`
    (Hz/MPa) and `threshold` (MPa): rate = scale * max(quantity - threshold, 0). The bone's is there where it is elastic.
    """
    afferents = [one for one in measurements if one.kind == "spike_rate"]
    return (
        *_moduli(model),
        *_poisson_ratios(model),
        *(p for one in afferents for p in _afferent(model, one)),
    )


def _moduli(model: Model) -> list[Parameter]:
    moduli = model.moduli()
    soft = [Parameter(f"{layer}.modulus", moduli[layer], "MPa", "log", 1e-6, 1e4) for layer in SOFT_LAYERS]
    if model.bone_modulus() is None:
        return soft
    return [*soft, Parameter("bone.modulus", moduli["bone"], "MPa", "log", 1e-6, 1e12)]


def _poisson_ratios(model: Model) -> list[Parameter]:
    ratios = model.poisson_ratios()
    if not model.has_layered_poisson_ratio():
        return [Parameter("poisson_ratio", ratios["epidermis"], "1", "logit", 0.0, 0.5)]
    layers = SOFT_LAYERS if model.bone_modulus() is None else tuple(ratios)
    return [Parameter(f"{layer}.poisson_ratio", ratios[layer], "1", "logit", 0.0, 0.5) for layer in layers]


def _afferent(model: Model, measurement: Measurement) -> list[Parameter]:
    # Starts only. A quarter of strain in the dermis, where the ending lies, is taken to give the largest
    # rate seen.
    density = 0.5 * model.moduli()["dermis"] * 0.25**2
    scale = max(float(measurement.measured.max()), 1.0) / density
    return [
        Parameter(f"{measurement.name}.scale", scale, "Hz/MPa", "log", scale * 1e-9, scale * 1e9),
        Parameter(
            f"{measurement.name}.threshold", 0.1 * density, "MPa", "log", density * 1e-9, density * 1e9
        ),
    ]


def load_studies(path: Path | str, data: Path | str | None = None) -> dict[str, Study]:
    """Read a study, or several under `studies:`, with every file that they name.

    **Arguments:** the YAML file, and the data folder (the environment's FINGERJAX_DATA where None).

    **Returns** the studies by name; a single one is named after its file.

    **Raises** `InputError` for the first thing wrong. Data that should lie in the data folder and do not are
    no error: see
    `Study.missing_data`.
    """
    file = Path(path)
    folder = data if data is not None else os.environ.get("FINGERJAX_DATA") or None
    shared = Path(folder) if folder is not None else None
    document = read_yaml(file)
    sources = _split(document)
    studies = {
        name: _Reader(name, file, shared, origin).read(said) for name, (said, origin) in sources.items()
    }
    for name, study in studies.items():
        if study.fallback is not None and (study.fallback not in studies or study.fallback == name):
            others = [other for other in studies if other != name]
            at, where = sources[name][1](("fallback",))
            remedy = choose_from(study.fallback, others)
            raise InputError("no such study", file=at, place=where, seen=study.fallback, remedy=remedy)
    return studies


def _split(document: Document) -> dict[str, tuple[Any, Origin]]:
    content, file = document.content, document.file
    if not isinstance(content, Mapping):
        remedy = "write keys and values: version: 1, finger: ..., see DATA.md"
        raise InputError("the file holds no study", file=file, seen=content, remedy=remedy)
    origin = document.origin()
    if content.get("version", VERSION) != VERSION:
        at, where = origin(("version",))
        remedy = f"this program reads version {VERSION}"
        raise InputError("unknown version", file=at, place=where, seen=content["version"], remedy=remedy)
    if "studies" not in content:
        return {file.stem: (content, origin)}
    with located(origin):
        other = next((str(key) for key in content if key not in ("version", "studies")), None)
        if other is not None:
            remedy = choose_from(other, ["version", "studies"]) + "; write it inside each study"
            raise InputError("unknown key beside `studies`", place=other, remedy=remedy)
        if not isinstance(content["studies"], Mapping) or not content["studies"]:
            raise InputError("no studies are named", place="studies", remedy="write NAME: {finger: ..., ...}")
    return {str(name): (said, document.origin("studies", name)) for name, said in content["studies"].items()}


@dataclasses.dataclass
class _Reader:
    """Reads one study, collecting the data that are missing."""

    name: str
    file: Path
    shared: Path | None
    origin: Origin
    missing: list[str] = dataclasses.field(default_factory=list)

    def read(self, said: Any) -> Study:
        keys = checked(StudyKeys, said, self.origin)
        receptor = receptor_from(keys.model.receptor) if keys.model.receptor else None
        sections = self._path(keys.finger.sections, "finger", "sections") if keys.finger.sections else None
        measurements = self._measurements(keys, receptor)
        options = self._options(keys)
        parameters = base_parameters(keys.model, measurements)
        return Study(
            name=self.name,
            kind=keys.kind,
            file=self.file,
            finger=keys.finger,
            sections=sections,
            model=keys.model,
            receptor=receptor,
            measurements=measurements,
            fit=self._fit(keys, {one.name: one for one in parameters}, measurements),
            diagnose=self._diagnose(keys.diagnose, keys, measurements),
            options=options,
            missing_data=tuple(dict.fromkeys(self.missing)),
            fallback=keys.fallback,
            notes=keys.notes,
            written=dict(said),
        )

    def _path(self, text: str, *keys: str | int) -> Path | None:
        """The file meant by a path in the study, or None (and noted) where it should be in the data folder
        and is not.
        """
        if text.startswith(SHARED):
            relative = text.removeprefix(SHARED).lstrip("/")
            path = (self.shared / relative) if self.shared else None
            if path is None or not path.is_file():
                self.missing.append(relative)
                return None
            return path
        path = self.file.parent / text
        if not path.is_file():
            at, where = self.origin(keys)
            remedy = (
                "paths are relative to this file; one that begins with data: is looked for in the data folder"
            )
            raise InputError("no such file", file=at, place=where, seen=text, remedy=remedy)
        return path

    def _measurements(self, keys: StudyKeys, receptor: Receptor | None) -> tuple[Measurement, ...]:
        found = []
        for index, entry in enumerate(keys.measurements):
            path = self._path(entry.data, "measurements", index, "data")
            if path is not None:
                said = {key: value for key, value in entry.said.items() if key not in ("name", "data")}
                inner = self._below("measurements", index)
                found.append(read_measurement(path, said, name=entry.name, receptor=receptor, origin=inner))
        return tuple(found)

    def _below(self, *prefix: str | int) -> Origin:
        return lambda keys: self.origin((*prefix, *keys))

    def _names(self, keys: StudyKeys, parameters: Mapping[str, Parameter]) -> list[str]:
        """What may be freed; of a file that is missing nobody knows whether it holds rates."""
        read = {name.partition(".")[0] for name in parameters}
        absent = [entry.name for entry in keys.measurements if entry.name not in read] if self.missing else []
        return [*parameters, *(f"{name}.{part}" for name in absent for part in ("scale", "threshold"))]

    def _fit(
        self, keys: StudyKeys, parameters: Mapping[str, Parameter], measurements: Sequence[Measurement]
    ) -> Fit:
        said = keys.fit or FitKeys()
        names = self._names(keys, parameters)
        self._known(said.free, names, "fit", "free")
        rates = [name for name in parameters if name.endswith((".scale", ".threshold"))]
        free = tuple(dict.fromkeys([*said.free, *rates]))
        if keys.kind == "fit" and not free:
            at, where = self.origin(("fit",))
            remedy = f"write fit: {{free: [...]}} with some of {', '.join(names)}"
            raise InputError("nothing is free to be fitted", file=at, place=where, remedy=remedy)
        for index, group in enumerate(said.tie):
            self._known(group, free, "fit", "tie", index)
        self._known(list(said.per), free, "fit", "per")
        self._known(list(said.priors), free, "fit", "priors")
        self._check_ties(said, parameters)
        self._check_per(said, measurements)
        priors = {name: self._prior(name, value, parameters) for name, value in said.priors.items()}
        tie = tuple(tuple(group) for group in said.tie)
        return Fit(free=free, tie=tie, per=dict(said.per), priors=priors)

    def _known(self, names: Sequence[str], allowed: Sequence[str], *keys: str | int) -> None:
        for index, name in enumerate(names):
            if name not in allowed:
                at, where = self.origin(
                    (*keys, index) if keys[-1] not in ("per", "priors") else (*keys, name)
                )
                what = "unknown parameter" if keys[-1] == "free" else "this parameter is not free"
                raise InputError(what, file=at, place=where, seen=name, remedy=choose_from(name, allowed))
            if name in names[:index]:
                at, where = self.origin((*keys, index))
                raise InputError(
                    "a name is written twice", file=at, place=where, seen=name, remedy="keep one"
                )

    def _check_ties(self, said: FitKeys, parameters: Mapping[str, Parameter]) -> None:
        tied: list[str] = []
        for index, group in enumerate(said.tie):
            at, where = self.origin(("fit", "tie", index))
            units = {parameters[name].unit for name in group if name in parameters}
            columns = {said.per[name] for name in group if name in said.per}
            if len(group) < 2:
                raise InputError("a tie of one", file=at, place=where, seen=group, remedy="name two or more")
            if len(units) > 1:
                remedy = "tie what has one unit"
                raise InputError(
                    "a tie of different quantities", file=at, place=where, seen=group, remedy=remedy
                )
            if len(columns) > 1:
                problem, remedy = "one tie has two `per` columns", "keep one of them"
                raise InputError(problem, file=at, place=where, seen=sorted(columns), remedy=remedy)
            twice = next((name for name in group if name in tied), None)
            if twice is not None:
                problem, remedy = "a parameter is in two ties", "make one tie of them"
                raise InputError(problem, file=at, place=where, seen=twice, remedy=remedy)
            tied += group

    def _check_per(self, said: FitKeys, measurements: Sequence[Measurement]) -> None:
        columns = [label for label in LABELS if any(label in one.table for one in measurements)]
        for name, column in said.per.items():
            if column not in columns and not self.missing:
                at, where = self.origin(("fit", "per", name))
                problem = "no measurement has this column of words"
                raise InputError(
                    problem, file=at, place=where, seen=column, remedy=choose_from(column, columns)
                )

    def _prior(self, name: str, said: Mapping[str, Any], parameters: Mapping[str, Parameter]) -> Prior:
        dimension = {"MPa": "pressure", "Hz/MPa": "gain", "1": "number"}
        unit = parameters[name].unit if name in parameters else "1"
        with located(self.origin, "fit", "priors", name):
            return _read_prior(said, unit, dimension[unit])

    def _diagnose(
        self, said: DiagnoseKeys | None, keys: StudyKeys, measurements: Sequence[Measurement]
    ) -> Diagnose | None:
        if said is None:
            return None
        effects = said.effects if isinstance(said.effects, str) else tuple(said.effects)
        by_name = {one.name: one for one in measurements}
        held = []
        for index, one in enumerate(said.hold_out):
            with located(self.origin, "diagnose", "hold_out", index):
                names = [entry.name for entry in keys.measurements]
                if one.measurement not in names:
                    remedy = choose_from(one.measurement, names)
                    raise InputError(
                        "no such measurement", place="measurement", seen=one.measurement, remedy=remedy
                    )
            if one.measurement in by_name:
                with located(self.origin, "diagnose", "hold_out", index, "where"):
                    held.append(_held_out(by_name[one.measurement], one.where))
        return Diagnose(effects, tuple(held))

    def _options(self, keys: StudyKeys) -> ForceTable | LayerStudy | None:
        inner = self._below("options")
        if keys.kind == "table":
            return self._force_table(checked(TableKeys, keys.options or {}, inner))
        if keys.kind == "layer_study":
            said = checked(LayerStudyKeys, keys.options or {}, inner)
            with located(inner, "indenter"):
                indenter = read_indenter(said.indenter, folder=self.file.parent)
            return LayerStudy(tuple(said.models), said.depth_mm, indenter, said.span_mm, said.spacing_mm)
        return None

    def _force_table(self, said: TableKeys) -> ForceTable | None:
        inner = self._below("options")
        indenters = {}
        for name, one in said.indenters.items():
            with located(inner, "indenters", name):
                indenters[name] = read_indenter(one, folder=self.file.parent)
        if said.data is not None:
            path = self._path(said.data, "options", "data")
            if path is None:
                return None
            table = read_table(path)
        else:
            with located(inner, "rows"):
                table = inline_table(said.rows)
        with located(inner):
            return ForceTable(_table_rows(Tidy(table), indenters), indenters, said.controlled)


def _table_rows(tidy: Tidy, indenters: Mapping[str, IndenterSpec]) -> tuple[TableRow, ...]:
    force, displacement = tidy.needed("force", "force"), tidy.needed("displacement", "length")
    modulus = tidy.optional("epidermis_modulus", "pressure")
    names = tidy.table.column("indenter")
    subjects = tidy.table.column("subject")
    for index, name in enumerate(names):
        if name not in indenters:
            problem = "an indenter that is not described under options.indenters"
            raise tidy.table.refuse(index, "indenter", problem, choose_from(name, indenters))
        for column, values in (("force", force), ("displacement", displacement)):
            if values[index] <= 0:
                where = str(tidy.find(column))
                raise tidy.table.refuse(index, where, f"a {column} that is not positive", "correct it")
    return tuple(
        TableRow(
            names[index],
            subjects[index],
            float(force[index]),
            float(displacement[index]),
            None if modulus is None else float(modulus[index]),
        )
        for index in range(len(names))
    )


def _read_prior(said: Mapping[str, Any], unit: str, dimension: str) -> Prior:
    """`{value_MPa: 0.18, relative_sd: 0.04}` or `{value_kPa: 180, sd_kPa: 7}`; no unit for a number without
    one.
    """
    found: dict[str, float] = {}
    for key, value in said.items():
        base, written = split_unit(str(key))
        if base not in ("value", "sd", "relative_sd"):
            allowed = ["relative_sd", *(name if unit == "1" else f"{name}_MPa" for name in ("value", "sd"))]
            raise InputError("unknown key of a prior", place=str(key), remedy=choose_from(key, allowed))
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
            raise InputError(
                "a prior needs positive numbers", place=str(key), seen=value, remedy="correct it"
            )
        if base == "relative_sd" or (written is None and dimension in ("number", "gain")):
            found[base] = float(value)
        else:
            found[base] = float(to_internal(value, written, dimension, str(key)))
    if "value" not in found or ("sd" in found) == ("relative_sd" in found):
        key = "value" if unit == "1" else f"value_{unit}"
        remedy = f"write {{{key}: ..., relative_sd: ...}}, or sd_ with the unit of the value"
        raise InputError("a prior needs a value and one width", seen=dict(said), remedy=remedy)
    return Prior(found["value"], found.get("sd", found.get("relative_sd", 0.0) * found["value"]))


def _held_out(measurement: Measurement, where: Mapping[str, Any]) -> HeldOut:
    """The condition in internal units. **Raises** `InputError` for a column or a value that the measurement
    lacks.
    """
    taken = {}
    for key, wanted in where.items():
        base, unit = split_unit(key)
        if base not in measurement.table:
            known = [_with_unit(name) for name in measurement.table]
            raise InputError("no such column", place=key, remedy=choose_from(key, known))
        values = list(wanted) if isinstance(wanted, (list, tuple)) else [wanted]
        taken[base] = tuple(_value(measurement.table[base], base, unit, key, value) for value in values)
    return HeldOut(measurement.name, taken)


def _with_unit(name: str) -> str:
    dimension = QUANTITIES.get(name)
    return f"{name}_{internal_unit(dimension)}" if dimension else name


def _value(column: np.ndarray, base: str, unit: str | None, key: str, value: Any) -> float | str:
    present = dict.fromkeys(column.tolist())
    if column.dtype.kind != "f":
        found = next((str(cell) for cell in present if same(str(cell), value)), None)
        if found is None:
            raise InputError(
                "no row has this value", place=key, seen=value, remedy=choose_from(value, map(str, present))
            )
        return found
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError("not a number", place=key, seen=value, remedy="write a number")
    number = float(to_internal(value, unit, QUANTITIES[base], key))
    if not np.isclose(column, number, rtol=1e-6, atol=1e-9).any():
        shown = ", ".join(f"{cell:g}" for cell in sorted(present))
        raise InputError("no row has this value", place=key, seen=value, remedy=f"rows have: {shown}")
    return number
