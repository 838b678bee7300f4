"""What a study hands in, and how a run is written: a folder that is whole or not there at all.

    results/
      report.html  report.json  run.yaml
      STUDY/report.json  STUDY/tables/NAME.csv  STUDY/figures/NAME.svg  STUDY/figures/NAME.csv  STUDY/...

While a run is under way its finished studies wait in a hidden sibling, `.results.partial`. A run that is
killed finds them there when it is started again; a run that ends takes the hidden folder's place in one
rename.
"""

from __future__ import annotations

import csv
import dataclasses
import datetime
import json
import math
import os
import platform
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np
import yaml

from fingerjax import __version__
from fingerjax._results import RESULTS
from fingerjax.errors import InputError
from fingerjax.identify import Fit, Step, Uncertainty

Row = dict[str, Any]
SCHEMA = 1


@dataclass(frozen=True)
class Table:
    """Tidy rows under a title. Units stand at the end of the columns' names, as in a measurement file.

    `chapter`: the chapter of the page that it is shown in; empty for the study's own list.
    """

    name: str
    title: str
    rows: list[Row]
    note: str = ""
    chapter: str = ""

    @property
    def columns(self) -> list[str]:
        return list(dict.fromkeys(column for row in self.rows for column in row))


@dataclass(frozen=True)
class Figure:
    """A drawing (`svg` text) with the rows that it was drawn from; `caption` says what to look at, `chapter` is as a table's."""

    name: str
    caption: str
    svg: str
    rows: list[Row]
    chapter: str = ""


@dataclass(frozen=True)
class StudyResult:
    """Everything a study leaves behind.

    - `verdict`: the sentence to read first. `result`: how it ended; it is complete unless `interrupted`.
    - `fit`: as `fit_record` makes it; None where nothing was fitted. `loop`: the object of the diagnosis.
    - `warnings`: what a reader must know before using a number; `notes`: what explains one.
    - `meshes`: by finger, as `mesh_record` makes them.
    - `resolved`: the study with every default filled in; `seeds`: of every random draw.
    """

    name: str
    title: str
    verdict: str
    result: RESULTS = RESULTS.successful
    tables: list[Table] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)
    fit: dict[str, Any] | None = None
    loop: dict[str, Any] | None = None
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    meshes: dict[str, dict[str, Any]] = field(default_factory=dict)
    resolved: dict[str, Any] = field(default_factory=dict)
    seeds: dict[str, int] = field(default_factory=dict)
    created: str = field(default_factory=lambda: now())
    seconds: float = 0.0

    @property
    def converged(self) -> bool:
        return self.result not in (RESULTS.not_converged, RESULTS.no_optimum)

    def to_json(self) -> dict[str, Any]:
        """Plain data from which `from_json` makes the same record."""
        said = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        said["result"] = self.result.name
        said["tables"] = [dataclasses.asdict(table) for table in self.tables]
        said["figures"] = [dataclasses.asdict(figure) for figure in self.figures]
        return plain(said)

    @classmethod
    def from_json(cls, said: Mapping[str, Any]) -> StudyResult:
        kept = dict(said)
        kept["result"] = RESULTS[kept["result"]]
        kept["tables"] = [Table(**table) for table in kept["tables"]]
        kept["figures"] = [Figure(**figure) for figure in kept["figures"]]
        return cls(**kept)

    def report(self) -> dict[str, Any]:
        """The object of `report.json`."""
        return plain(
            {
                "version": SCHEMA,
                "study": self.name,
                "title": self.title,
                "verdict": self.verdict,
                "result": {"name": self.result.name, "text": self.result.value},
                "provenance": self.provenance(),
                "fit": self.fit,
                "tables": {table.name: table.rows for table in self.tables},
                "figures": {figure.name: figure.caption for figure in self.figures},
                "warnings": self.warnings,
                "notes": self.notes,
                "loop": self.loop,
            }
        )

    def provenance(self) -> dict[str, Any]:
        none: dict[str, Any] = {"hash": None, "nodes": 0, "elements": 0, "quality": {}}
        first = next(iter(self.meshes.values()), none)
        more = {"meshes": self.meshes} if len(self.meshes) > 1 else {}
        return {**versions(), "mesh": first, **more, "created": self.created, "seconds": self.seconds}


@dataclass(frozen=True)
class Context:
    """What a study is given besides its own description.

    - `folder`: an empty folder for files of its own (fields as `.vtu`, pictures); they are kept with the
      study.
    - `data`: the data folder, or None.
    - `tell`: called with the share done, 0 to 1, and what is being done.
    """

    folder: Path
    data: Path | None = None
    tell: Callable[[float, str], object] = lambda share, doing: None

    def at(self, share: float, doing: str) -> None:
        """Say how much of the study is done, and what it does now."""
        self.tell(min(max(share, 0.0), 1.0), doing)

    def within(self, start: float, end: float) -> Context:
        """A context for a part of the study, whose 0 to 1 is `start` to `end` of this one."""
        outer = self.tell
        return dataclasses.replace(
            self, tell=lambda share, doing: outer(start + (end - start) * share, doing)
        )

    def listener(self, doing: str, tolerance: float = 1e-6) -> Callable[[Step], None]:
        """A progress callback for `identify.fit`: shows step and chi2, and counts decades of the gradient."""
        best = 0.0

        def listen(step: Step) -> None:
            nonlocal best
            steepness = math.log10(max(step.gradient, tolerance)) if math.isfinite(step.gradient) else 0.0
            best = max(best, steepness / math.log10(tolerance))
            self.at(best, f"{doing}: step {step.step}, chi2 {step.chi2:.4g}")

        return listen


# ---- records ----


def now() -> str:
    """The time in UTC, to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def versions() -> dict[str, str]:
    return {"fingerjax": __version__, "jax": jax.__version__}


def mesh_record(finger: Any) -> dict[str, Any]:
    """Hash, node count, element count and quality figures of a `Finger`."""
    return plain(
        {
            "hash": finger.key,
            "nodes": len(finger.nodes),
            "elements": len(finger.tets),
            "quality": dict(finger.quality),
        }
    )


def fit_record(
    fit: Fit,
    known: Uncertainty,
    rms: Mapping[str, Row] | None = None,
    held_out: Mapping[str, Row] | None = None,
) -> dict[str, Any]:
    """The object `fit` of `report.json`. Of a fit that is not settled every value and interval is null."""
    return plain(
        {
            "parameters": {one.name: _parameter(one) for one in known.estimates},
            "correlations": _correlations(known),
            "chi2": fit.chi2,
            "dof": fit.dof,
            "variance": known.variance,
            "sigma": {"kind": known.sigma, "by_measurement": dict(fit.problem.sigma_source)},
            "not_seen": list(known.sentences),
            "rms": dict(rms or {}),
            "held_out": dict(held_out or {}),
            "solver": {
                "iterations": fit.iterations,
                "residual": fit.solve_residual,
                "converged": fit.converged and fit.settled,
                "result": fit.result.name,
                "reason": fit.reason,
                "gradient": fit.gradient,
                "steps": fit.steps,
                "evaluations": fit.evaluations,
            },
        }
    )


def _parameter(one: Any) -> Row:
    return {
        "value": one.value,
        "unit": one.unit,
        "ci95": [one.lower, one.upper],
        "at_limit": one.at_limit,
        "identified": one.identified,
        "standard_error": one.standard_error,
        "start": one.start,
        "reason": one.reason,
    }


def _correlations(known: Uncertainty) -> dict[str, dict[str, float]]:
    names = [one.name for one in known.estimates]
    rows = zip(names, known.correlations, strict=True)
    return {name: dict(zip(names, (float(c) for c in row), strict=True)) for name, row in rows}


def misfit(
    fit: Fit, sigma: Mapping[str, np.ndarray | float], units: Mapping[str, str]
) -> dict[str, dict[str, Any]]:
    """Root mean square residual of each measurement in its own unit, beside the noise it was weighted with.

    **Arguments:** `sigma` by measurement, (rows,) or one number, and `units` of the measured values.
    """
    found = {}
    for name in sigma:
        spread = np.broadcast_to(np.asarray(sigma[name], float), fit.rows(name).shape)
        found[name] = {
            "value": float(np.sqrt(np.mean((fit.rows(name) * spread) ** 2))),
            "unit": units[name],
            "noise": float(np.sqrt(np.mean(spread**2))),
        }
    return found


def plain(value: Any) -> Any:
    """The same in the types that JSON knows; a number that is not finite becomes null."""
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, str) or value is None or isinstance(value, bool):
        return value
    if isinstance(value, (np.ndarray, jax.Array)):
        return plain(np.asarray(value).tolist())
    if isinstance(value, Iterable):
        return [plain(entry) for entry in value]
    if hasattr(value, "item"):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, int) else str(value)


# ---- files ----


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Tidy rows as UTF-8 CSV; what is missing is empty, what is undefined is `nan`."""
    columns = list(dict.fromkeys(column for row in rows for column in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: _cell(entry) for key, entry in row.items()} for row in rows)


def _cell(entry: Any) -> Any:
    if entry is None:
        return ""
    if isinstance(entry, (float, np.floating)):
        return f"{float(entry):.10g}"
    return entry


def write_json(path: Path, content: Any) -> None:
    path.write_text(json.dumps(plain(content), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def write_study(folder: Path, result: StudyResult) -> None:
    """Report, tables and figures of one study into an existing folder."""
    write_json(folder / "report.json", result.report())
    for name in ("tables", "figures"):
        (folder / name).mkdir(exist_ok=True)
    for table in result.tables:
        write_csv(folder / "tables" / f"{table.name}.csv", table.rows)
    for figure in result.figures:
        (folder / "figures" / f"{figure.name}.svg").write_text(figure.svg, encoding="utf-8")
        write_csv(folder / "figures" / f"{figure.name}.csv", figure.rows)


class RunFolder:
    """The folder of a run: finished studies are kept as they come, and the whole is put in place at the end.

    **Arguments:** `out`, the folder to be; `fresh`, forget the finished studies of a run that was killed.

    **Raises** `InputError` where `out` is something that no run has written, which is never replaced.
    """

    def __init__(self, out: Path, *, fresh: bool = False):
        self.out = out.absolute()
        self.partial = self.out.with_name(f".{self.out.name}.partial")
        self._refuse_foreign()
        if fresh:
            shutil.rmtree(self.partial, ignore_errors=True)
        (self.partial / ".kept").mkdir(parents=True, exist_ok=True)
        for left in self.partial.glob(".writing-*"):
            shutil.rmtree(left)

    def _refuse_foreign(self) -> None:
        if not self.out.exists() or (self.out.is_dir() and not any(self.out.iterdir())):
            return
        if not (self.out / "run.yaml").is_file():
            raise InputError(
                "the output folder holds something else and will not be replaced",
                file=self.out,
                remedy="choose another --out, or remove it",
            )

    def finished(self, name: str, key: str) -> StudyResult | None:
        """What a killed run had finished of a study with the same key, or None."""
        kept = self.partial / ".kept" / f"{name}.json"
        if not kept.is_file() or not (self.partial / name).is_dir():
            return None
        said = json.loads(kept.read_text(encoding="utf-8"))
        return StudyResult.from_json(said["result"]) if said["key"] == key else None

    def begin(self, name: str) -> Path:
        """An empty folder in which a study may leave files of its own."""
        folder = self.partial / f".writing-{name}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        return folder

    def parts(self, name: str, key: str) -> Path:
        """A folder for what is finished of a study that is not, by a key of all that it is made from; parts of other keys are forgotten."""
        folder = self.partial / ".kept" / f"{name}.parts" / key[:32]
        for other in folder.parent.glob("*"):
            if other != folder:
                shutil.rmtree(other)
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def keep(self, key: str, result: StudyResult) -> None:
        """Write a finished study; from here on it survives a kill."""
        folder = self.partial / f".writing-{result.name}"
        folder.mkdir(exist_ok=True)
        write_study(folder, result)
        shutil.rmtree(self.partial / result.name, ignore_errors=True)
        folder.rename(self.partial / result.name)
        waiting = self.partial / ".kept" / f"{result.name}.writing"
        write_json(waiting, {"key": key, "result": result.to_json()})
        waiting.rename(waiting.with_suffix(".json"))

    def put_in_place(self, results: Sequence[StudyResult], page: str, run: Mapping[str, Any]) -> None:
        """Write the page, the record and `run.yaml`, and let the whole take the place of an earlier run."""
        (self.partial / "report.html").write_text(page, encoding="utf-8")
        write_json(self.partial / "report.json", _whole(results))
        text = yaml.safe_dump(plain(run), sort_keys=False, allow_unicode=True, width=110)
        (self.partial / "run.yaml").write_text(text, encoding="utf-8")
        shutil.rmtree(self.partial / ".kept")
        for left in {p.name for p in self.partial.iterdir() if p.is_dir()} - {r.name for r in results}:
            shutil.rmtree(self.partial / left)
        self._swap()

    def _swap(self) -> None:
        old = self.out.with_name(f".{self.out.name}.old")
        shutil.rmtree(old, ignore_errors=True)
        if self.out.exists():
            self.out.rename(old)
        os.replace(self.partial, self.out)
        shutil.rmtree(old, ignore_errors=True)


def _whole(results: Sequence[StudyResult]) -> dict[str, Any]:
    """The record of a run: the study's own where there is one, else all of them by name."""
    if len(results) == 1:
        return results[0].report()
    return {
        "version": SCHEMA,
        "study": None,
        "provenance": {**versions(), "created": now()},
        "studies": {result.name: result.report() for result in results},
    }


def run_record(results: Sequence[StudyResult], command: str) -> dict[str, Any]:
    """The content of `run.yaml`: what was run, with what, on which meshes, from which seeds."""
    return {
        "version": SCHEMA,
        "command": command,
        "created": now(),
        "versions": {**versions(), "numpy": np.__version__, "python": platform.python_version()},
        "machine": {"system": platform.platform(), "processors": os.cpu_count(), "devices": _devices()},
        "studies": {
            result.name: {
                "result": result.result.name,
                "seconds": round(result.seconds, 1),
                "mesh": {name: mesh["hash"] for name, mesh in result.meshes.items()},
                "seeds": result.seeds,
                "study": result.resolved,
            }
            for result in results
        },
    }


def _devices() -> list[str]:
    return [str(device) for device in jax.devices()]
