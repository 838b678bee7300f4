"""From what was written in a study to its records: every name is checked against what there is, every file
is read.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .csvfile import inline_table, read_table
from .errors import InputError
from .finger_keys import Finger
from .geometry.views import NAME as VIEWS
from .indenter_spec import IndenterSpec, read_indenter
from .measurements import Measurement, Receptor, read_measurement, receptor_from
from .parameters import Parameter
from .spelling import choose_from
from .strict import checked
from .study_design import Design, read_design
from .study_diagnose import read_diagnose
from .study_keys import FitKeys, LayerStudyKeys, StudyKeys, TableKeys
from .study_records import (
    Diagnose,
    Fit,
    ForceTable,
    LayerStudy,
    Prior,
    Study,
    TableRow,
    base_parameters,
)
from .study_sweep import Sweep, SweepKeys, read_sweep
from .tidy import LABELS, Tidy
from .units import split_unit, to_internal
from .yamlfile import Origin, located

SHARED = "data:"
"""A path that begins so is looked for in the data folder (`--data`, or the environment's FINGERJAX_DATA)."""


@dataclasses.dataclass
class StudyReader:
    """Reads one study; `missing` collects what should lie in the data folder and does not."""

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
        fit = self._fit(keys, {one.name: one for one in parameters}, measurements)
        return Study(
            name=self.name,
            kind=keys.kind,
            file=self.file,
            finger=keys.finger,
            sections=sections,
            shape=self._shape(keys.finger),
            bone=self._bone(keys.finger),
            model=keys.model,
            receptor=receptor,
            measurements=measurements,
            fit=fit,
            diagnose=self._diagnose(keys, measurements),
            design=self._design(keys, fit),
            options=options,
            missing_data=tuple(dict.fromkeys(self.missing)),
            fallback=keys.fallback,
            notes=keys.notes,
            written=dict(said),
        )

    def _shape(self, finger: Finger) -> Path | None:
        """The file of images, scan or mesh; of a folder of images, the YAML file in it."""
        if finger.images is not None:
            inside = finger.images.rstrip("/") + f"/{VIEWS}"
            folder = not finger.images.startswith(SHARED) and (self.file.parent / finger.images).is_dir()
            return self._path(inside if folder else finger.images, "finger", "images")
        if finger.scan is not None:
            return self._path(finger.scan.file, "finger", "scan")
        return self._path(finger.mesh.file, "finger", "mesh") if finger.mesh is not None else None

    def _bone(self, finger: Finger) -> Path | None:
        said = finger.layers.bone.sections if finger.layers is not None else None
        return self._path(said, "finger", "layers", "bone", "sections") if said is not None else None

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
        rates = [name for name in names if name.endswith((".scale", ".threshold"))] if self.missing else []
        rates = rates or [name for name in parameters if name.endswith((".scale", ".threshold"))]
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
        asked = said.profile if isinstance(said.profile, list) else list(free) if said.profile else []
        self._known(asked, free, "fit", "profile")
        self._check_finer(said, keys.finger.resolution.pad_mm)
        again, drawn = said.bootstrap, said.sample
        return Fit(
            free=free, tie=tie, per=dict(said.per), priors=priors, loss=said.loss, starts=said.starts, workers=said.workers,
            profile=tuple(asked),
            bootstrap=None if again is None else (again.kind, again.repeats, again.seed),
            sample=None if drawn is None else (drawn.steps, drawn.chains, drawn.seed),
            own_noise=said.noise == "each", finer=tuple(said.finer_mm),
        )  # fmt: skip

    def _check_finer(self, said: FitKeys, pad: float) -> None:
        sizes = [pad, *said.finer_mm]
        for index, (before, size) in enumerate(itertools.pairwise(sizes)):
            if size >= before:
                at, where = self.origin(("fit", "finer_mm", index))
                remedy = f"write spacings below {before:g} mm, each smaller than the one before"
                raise InputError("a mesh that is not finer", file=at, place=where, seen=size, remedy=remedy)
        if said.sample is not None and said.loss != "linear":
            at, where = self.origin(("fit", "sample"))
            remedy = "take it out, or write loss: linear"
            raise InputError("samples need a fit by squares", file=at, place=where, seen=said.loss, remedy=remedy)

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

    def _diagnose(self, keys: StudyKeys, measurements: Sequence[Measurement]) -> Diagnose | None:
        if keys.diagnose is None:
            return None
        return read_diagnose(keys.diagnose, [entry.name for entry in keys.measurements], measurements, self._below("diagnose"))

    def _design(self, keys: StudyKeys, fit: Fit) -> Design | None:
        if keys.design is None:
            return None
        taken = [entry.name for entry in keys.measurements]
        return read_design(keys.design, fit.free, taken, self.file.parent, self._below("design"))

    def _options(self, keys: StudyKeys) -> ForceTable | LayerStudy | Sweep | None:
        inner = self._below("options")
        if keys.kind == "table":
            return self._force_table(checked(TableKeys, keys.options or {}, inner), keys.finger.preset)
        if keys.kind == "layer_study":
            said = checked(LayerStudyKeys, keys.options or {}, inner)
            with located(inner, "indenter"):
                indenter = read_indenter(said.indenter, folder=self.file.parent)
            return LayerStudy(tuple(said.models), said.depth_mm, indenter, said.span_mm, said.spacing_mm)
        if keys.kind == "sweep":
            return read_sweep(checked(SweepKeys, keys.options or {}, inner), self.file.parent, inner)
        return None

    def _force_table(self, said: TableKeys, preset: str | None) -> ForceTable | None:
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
            radii = {name: tuple(values) for name, values in said.radii_mm.items()}
            rows = _table_rows(Tidy(table), indenters)
            if said.drivers:
                _check_drivers(preset, {indenters[row.indenter].shape for row in rows})
            return ForceTable(rows, indenters, said.controlled, radii, said.drivers)


def _check_drivers(preset: str | None, shapes: set[str]) -> None:
    if preset is None:
        remedy = "take it out, or write finger: {preset: ...}, whose dimensions can be changed one at a time"
        raise InputError("drivers need a preset finger", place="drivers", seen=True, remedy=remedy)
    if "flat_plate" not in shapes:
        remedy = "take it out, or add a row pressed by a flat plate"
        raise InputError("drivers are told under a flat plate", place="drivers", seen=True, remedy=remedy)


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
