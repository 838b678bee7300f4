"""What a diagnosis takes: a laboratory with four instruments, all effects, at the paper's resolution.

`python -m benchmarks.diagnosis [--quick] [--json FILE]`

The data are the model's own on a mesh finer than any that the loop looks at, with one effect in them and noise; whether the loop is right
about fingers that are not its own is for `benchmarks.blind` to say. The command is timed as a process of its own, from its start to its
report. A solve is one answer of the model to all of the indentations at new moduli, without derivatives, compiled already. `--quick`: a
coarse mesh, data of a little finer one, and few effects.
"""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks._record import Figure, at_most, run
from fingerjax.commands.run import prepare
from fingerjax.effects import catalogue, chosen
from fingerjax.forward import assemble
from fingerjax.runners.diagnosing import subject_of
from fingerjax.runners.subject import FingerSubject
from fingerjax.study import load_studies

MODULI = {"epidermis": 0.14, "dermis": 0.02, "adipose": 0.012, "fibrous": 0.03}
SITE = {"z_mm": 8.7, "theta_deg": 270.0}
MISSING, SIZE = "contact_offset", 0.08  # mm
NOISE, TRIALS, QUICKLY = 0.02, 3, 0.8  # share of a measurement's largest reading; repeats; element size where quick data come from
MINUTES, SOLVES = 10.0, 20.0
ROUNDS = 3  # rankings that are timed
QUICK = ("contact_offset", "camera_scale", "force_offset", "nail_compliance")

Grid = Mapping[str, Sequence[float]]
LABORATORY: Mapping[str, tuple[dict[str, Any], Grid, str]] = {
    "wedge": (
        {"kind": "deflection_profile", "indenter": {"shape": "line", "width_mm": 0.05, "along": "x"}, "site": SITE},
        {"depth_mm": (0.5, 1.0, 1.5), "distance_mm": tuple(np.linspace(-4.0, 4.0, 13))},
        "deflection_mm",
    ),
    "plate": (
        {"kind": "force_displacement", "indenter": {"shape": "flat_plate"}, "site": SITE},
        {"displacement_mm": (0.25, 0.5, 0.75, 1.0, 1.25, 1.5)},
        "force_N",
    ),
    "ball": (
        {"kind": "force_displacement", "indenter": {"shape": "sphere", "radius_mm": 2.0}, "site": SITE},
        {"displacement_mm": (0.25, 0.5, 0.75, 1.0, 1.25, 1.5)},
        "force_N",
    ),
    "bar": (
        {
            "kind": "spike_rate",
            "indenter": {"shape": "bar", "width_mm": 3.0, "edge_radius_mm": 0.3},
            "receptor": {"afferent": "SA-I", "depth_mm": 0.75, **SITE},
        },
        {"depth_mm": (0.6, 1.0), "position_mm": tuple(np.linspace(-4.0, 4.0, 17))},
        "rate_Hz",
    ),
}


def laboratory(folder: Path, quick: bool) -> Path:
    """A study with its four tables, written into a folder; its file."""
    for name, (sidecar, grid, value) in LABORATORY.items():
        _write(folder / f"{name}.csv", _rows(grid, value, np.zeros(0)))
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(sidecar))
    mesh = {"pad_mm": 1.2, "proximal_mm": 2.4} if quick else {"pad_mm": 0.75, "proximal_mm": 2.0}
    said = {
        "version": 1,
        "finger": {"preset": "monkey", "resolution": mesh},
        "model": {"moduli_MPa": MODULI, "bone": "rigid", "poisson_ratio": 0.48},
        "measurements": [{"name": name, "data": f"{name}.csv"} for name in LABORATORY],
        "fit": {"free": [*(f"{layer}.modulus" for layer in MODULI), "bar.scale", "bar.threshold"]},
        "diagnose": {"effects": list(QUICK) if quick else "all"},
    }
    file = folder / "experiments.yaml"
    file.write_text(yaml.safe_dump(said))
    (study,) = load_studies(file).values()
    # an even mesh is as fine by the nail as by the pad: forces depend on both
    finer = FingerSubject(assemble(study, size=QUICKLY if quick else 1.0, even=not quick), chosen((MISSING,), catalogue()))
    raw, key = np.array([one.raw() for one in finer.parameters]), next(column.key for column in finer.families[0].columns)
    truth, noise = finer.evaluate(raw, {key: SIZE}, ()).prediction, np.random.default_rng(11)
    for name, where in finer.rows.blocks.items():
        _, grid, value = LABORATORY[name]
        exact = truth[where]
        _write(folder / f"{name}.csv", _rows(grid, value, exact + NOISE * np.abs(exact).max() * noise.normal(size=len(exact))))
    return file


def _rows(grid: Grid, value: str, read: np.ndarray) -> list[dict[str, float]]:
    """Every combination of a grid, once in each trial."""
    names = list(grid)
    every = np.stack(np.meshgrid(*grid.values(), indexing="ij"), axis=-1).reshape(-1, len(names))
    read = read if len(read) else np.full(TRIALS * len(every), 0.1)
    rows = [dict(zip(names, at, strict=True)) | {"trial": trial} for trial in range(TRIALS) for at in every.tolist()]
    return [row | {value: float(one)} for row, one in zip(rows, read, strict=True)]


def _write(file: Path, rows: Sequence[Mapping[str, float]]) -> None:
    with file.open("w", newline="") as out:
        writer = csv.DictWriter(out, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _seconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def main(quick: bool) -> Iterator[Figure]:
    """The command as a process; then one solve and the ranking, in this one."""
    prepare()
    with tempfile.TemporaryDirectory() as place:
        file = laboratory(Path(place), quick)
        command = [sys.executable, "-m", "fingerjax", "diagnose", str(file), "--out", str(Path(place) / "out"), "--fresh"]
        with (Path(place) / "log").open("w") as log:
            spent = _seconds(lambda: subprocess.run(command, check=True, stdout=log, stderr=subprocess.STDOUT))
        report = json.loads((Path(place) / "out" / "report.json").read_text())["loop"]
        (study,) = load_studies(file).values()
        assert study.diagnose is not None
        subject = subject_of(study, study.diagnose.effects)
    verdict, mesh = report["verdict"], report["model"]["mesh"]
    said = f"{mesh['nodes']} nodes, checked on {mesh['finer_nodes']}; {verdict['kind']}: {', '.join(verdict['families']) or 'nothing'}"
    yield at_most("diagnose, four instruments, from start to report", spent / 60, "min", MINUTES, said)
    solves, shares = ranked(subject)
    yield Figure("one solve: all indentations at new moduli", float(np.median(solves)), "s", note=f"{len(subject.base.mesh.nodes)} nodes")
    spread = f"{len(subject.families)} effects; {min(shares):.1f} to {max(shares):.1f}"
    yield at_most("what every effect would leave", float(np.median(shares)), "solves", SOLVES, spread)


def ranked(subject: FingerSubject) -> tuple[list[float], list[float]]:
    """Times of solves, s, and of rankings, each in medians of the solves just before and after it: machines change their pace."""
    raw = np.array([one.raw() for one in subject.parameters])
    # not in proportion: that would be the same body on another scale, which is not factorised again
    away = iter(0.003 * np.outer(np.arange(1, 100), np.cos(np.arange(len(raw)))))

    def solved() -> list[float]:
        return [_seconds(partial(subject.base.model.predict, subject.named(raw + next(away)))) for _ in range(5)]

    subject.columns(raw)
    solved()  # compiles what is not yet
    around, shares = [solved()], []
    for _ in range(ROUNDS):
        ranking = _seconds(lambda: subject.columns(raw + next(away)))
        around.append(solved())
        shares.append(ranking / float(np.median(around[-2:])))
    return [one for each in around for one in each], shares


if __name__ == "__main__":
    run(main)
