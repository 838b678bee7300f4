"""Measured fingertips, skin and silicone: how far a layered linear body explains them, and what it lacks.

`python -m benchmarks.measured [--quick] [--part NAME] [--workers N] [--json FILE] [--write]`, with FINGERJAX_DATA set to the folder of
measured data, or with that folder beside the repository as `shared/data`.

Every study in `fits/measured` is a part: it is diagnosed as `fingerjax diagnose` does it, and then asked what it is there for (`FURTHER`).
What a part found is kept under `build/measured`, from where `--write` renews its section of docs/measured.md; others stand as an earlier
run left them, and a study that was never run is named there. A part that was stopped goes on from the searches that it had
finished, as long as neither the program nor its study nor the data have changed since. `--quick` takes coarser meshes, fewer readings and a
few effects.
"""

from __future__ import annotations

import dataclasses
import datetime
import hashlib
import json
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks import _afferents, _fingerpad, _table1
from benchmarks._fingerpad import models
from benchmarks._measured_page import page
from benchmarks._parts import program, run_parts
from benchmarks._record import Figure
from benchmarks._sections import last_number, rows
from fingerjax.commands._parts import Parts
from fingerjax.commands.run import prepare
from fingerjax.loop.diagnosis import investigate
from fingerjax.loop.findings import Findings
from fingerjax.loop.verdict import sizes
from fingerjax.loop.writing import error, written
from fingerjax.measurements import Measurement
from fingerjax.report.records import Row, Table, plain
from fingerjax.runners.diagnosing import parted, subject_of
from fingerjax.study import Diagnose, Study, load_studies

ROOT = Path(__file__).resolve().parents[1]
STUDIES, PAGE, KEPT = ROOT / "fits" / "measured", ROOT / "docs" / "measured.md", ROOT / "build" / "measured"
More = Callable[[Study, Findings], Iterator[Figure | Table]]
FURTHER: Mapping[str, More] = {
    "fingerpad": _fingerpad.more,
    "table1": _table1.more,
    "bar": _afferents.more,
    "spheres": _afferents.more,
}
"""Study -> what it is there for, beyond the diagnosis."""

SETS, FEW_SETS = 200, 20
COARSER, EVERY = 1.6, 3
LEAST = 2.0  # mm: a spacing with which a point still touches a node of a thinned study's skin
FEW = ("contact_offset", "tip_radius", "rate_saturation", "receptive_field_pooling", "relaxation", "force_lag")
"""Effects that `--quick` asks for, of those that a study's data can show."""


def studies() -> dict[str, Path]:
    """The studies there are, and the file of each."""
    found: dict[str, Path] = {}
    for file in sorted(STUDIES.glob("*.yaml")):
        said = yaml.safe_load(file.read_text(encoding="utf-8"))
        found |= dict.fromkeys(said.get("studies", {file.stem: None}), file)
    return found


def data() -> Path:
    """The folder of measured data."""
    named = os.environ.get("FINGERJAX_DATA")
    return Path(named) if named else ROOT.parent / "shared" / "data"


def loaded(name: str, quick: bool = False) -> Study:
    """A study with its data. **Raises** `SystemExit` with one line where these are not there."""
    study = load_studies(studies()[name], data())[name]
    if study.missing_data:
        sys.exit(f"{study.name}: {', '.join(study.missing_data)} not in {data()}; set FINGERJAX_DATA to the folder that holds them")
    return thinned(study) if quick else study


def thinned(study: Study) -> Study:
    """The same on a coarser mesh, no finer under probes and at receptors, with every third reading of each condition and few effects."""
    mesh = study.finger.resolution
    sizes = {name: COARSER * size for name, size in mesh if name in ("pad_mm", "proximal_mm") and size is not None}
    coarser = mesh.model_copy(update=sizes | {"least_mm": min(sizes["pad_mm"], LEAST)})
    asked = study.diagnose or Diagnose()
    names = FEW if asked.effects == "all" else tuple(name for name in FEW if name in asked.effects)
    return dataclasses.replace(
        study,
        finger=study.finger.model_copy(update={"resolution": coarser}),
        measurements=tuple(_fewer(one) for one in study.measurements),
        diagnose=dataclasses.replace(asked, effects=names),
    )


def _fewer(one: Measurement) -> Measurement:
    apart = [one.table[name].astype(str) for name in ("subject", "condition", "trial", "stimulus", "depth") if name in one.table]
    group = np.unique(np.column_stack([*apart, np.zeros(len(one), str)]), axis=0, return_inverse=True)[1].reshape(-1)
    rank = np.array([int(np.sum(group[:row] == group[row])) for row in range(len(one))])
    kept = (rank % EVERY == EVERY - 1) | (np.bincount(group)[group] < 2 * EVERY)  # a few readings are all needed
    table = {name: column[kept] for name, column in one.table.items()}
    return dataclasses.replace(one, table=table, sigma=None if one.sigma is None else one.sigma[kept], rows=one.rows[kept])


def part(name: str, quick: bool) -> Iterator[Figure]:
    """One study from its numbers to its figures; its record is kept for the page."""
    began = time.perf_counter()
    prepare()
    study = loaded(name, quick)
    asked = study.diagnose or Diagnose()
    subject = parted(subject_of(study, asked.effects, tell=_teller(name)), study)
    findings = investigate(
        subject, seed=0, effects="all", alpha=0.05, sets=FEW_SETS if quick else SETS, tell=_teller(name), kept=_parts(name, study, quick),
        reach=asked.reach,
    )  # fmt: skip
    record = plain(written(findings).record())
    tables = [tried(findings)]
    figures = list(_figures(name, record))
    for found in FURTHER[name](study, findings) if name in FURTHER else ():
        (tables if isinstance(found, Table) else figures).append(found)  # type: ignore[arg-type]
    seconds = time.perf_counter() - began
    figures.append(Figure(f"{name}: whole study", seconds, "s"))
    made = f"program {program()[:8]}, {datetime.date.today():%Y-%m-%d}"
    keep(name, quick, {"notes": study.notes, "made": made, "record": record, "tables": [dataclasses.asdict(one) for one in tables]})
    yield from figures


def _figures(name: str, record: Mapping[str, Any]) -> Iterator[Figure]:
    """The errors of a diagnosis before and after, as shares of the data's root mean square."""
    mesh = record["model"]["mesh"]
    note = f"{mesh['nodes']} nodes, verdict {record['verdict']['kind']}"
    for when, said in (("before", record["base"]), ("after", (record["nearest"] or record)["after"])):
        for role in ("fit", "report"):
            value = said["error"][role]
            yield Figure(f"{name}: error {when}, {role}", math.nan if value is None else value, "1", note=note)


def tried(findings: Findings) -> Table:
    """Every model that was fitted, with its errors on what was fitted and on what was held out."""
    base = error(findings, findings.base.best)
    rows: list[Row] = [
        {"added": "nothing", "size": "", "explained": 0.0, "error_fitted": base.fit, "error_held_out": base.report, "remark": ""}
    ]
    for one in models(findings):
        left = error(findings, one.best)
        rows.append(
            {
                "added": one.name.replace("_", " "),
                "size": sizes(one),
                "explained": one.eta,
                "error_fitted": left.fit,
                "error_held_out": left.report,
                "remark": one.reason,
            }
        )
    note = "Explained: share of the squared misfit beyond the noise that is gone. Errors over the root mean square of the data."
    return Table("tried", "Models that were fitted", rows, note)


def _teller(name: str) -> Callable[[float, str], None]:
    def tell(share: float, what: str) -> None:
        print(f"{name} {share:4.0%} {what}", file=sys.stderr, flush=True)

    return tell


def _parts(name: str, study: Study, quick: bool) -> Parts:
    """Finished searches of a study: they belong to this program, this study and these data."""
    hashed = hashlib.sha256(studies()[name].read_bytes() + program().encode())
    for one in study.measurements:
        hashed.update(repr([(column, values.tolist()) for column, values in one.table.items()]).encode())
    folder = KEPT / ("quick" if quick else "full") / f"{name}-{hashed.hexdigest()[:16]}"
    folder.mkdir(parents=True, exist_ok=True)
    return Parts(folder)


def _file(name: str, quick: bool) -> Path:
    return KEPT / ("quick" if quick else "full") / f"{name}.json"


def keep(name: str, quick: bool, found: Mapping[str, Any]) -> None:
    """Write what a part found to where the page looks for it."""
    file = _file(name, quick)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(plain(dict(found)), indent=1, allow_nan=False) + "\n")


def told(figures: Sequence[Figure], began: float = math.inf) -> str:
    """The page, from the figures and from what the parts kept that have any; of the others what stands there.

    **Arguments:** `began`: when the run began, s since 1970. Where it found all of them itself the page says how long it took.
    """
    there = {figure.figure.split(":")[0] for figure in figures}
    at_once = all(name in there and _file(name, False).stat().st_mtime >= began for name in studies())
    took = time.time() - began if at_once else math.nan
    found = {name: json.loads(_file(name, False).read_text()) for name in studies() if name in there}
    before = PAGE.read_text(encoding="utf-8") if PAGE.is_file() else ""
    return page(found, figures, [name for name in studies() if name not in there], before, took)


def longest_first(names: Iterable[str], before: str) -> list[str]:
    """Studies in the order in which several at a time take least: those first that the page says took long, before these what it lacks."""
    took = {name: last_number(row) for name, row in rows(before).items()}
    return sorted(names, key=lambda name: -took.get(name, math.inf))


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    order = longest_first(studies(), PAGE.read_text(encoding="utf-8") if PAGE.is_file() else "")
    now = partial(told, began=time.time())
    run_parts({name: partial(part, name) for name in order}, __doc__, (PAGE, now), arguments, partial=True)


if __name__ == "__main__":
    main()
