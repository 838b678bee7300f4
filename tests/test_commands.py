"""The command line: what it prints, what it leaves, how it ends."""

from __future__ import annotations

import dataclasses
import importlib
import io
import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner, Result

from fingerjax.__main__ import app
from fingerjax._results import RESULTS
from fingerjax.commands import _progress, _resume
from fingerjax.errors import InputError
from fingerjax.report import Context, StudyResult, Table
from fingerjax.study import Study, load_studies

run_module = importlib.import_module("fingerjax.commands.run")
mesh_module = importlib.import_module("fingerjax.commands.mesh")
picture_module = importlib.import_module("fingerjax.report.mesh_picture")

STUDIES = """
version: 1
studies:
  plate:
    kind: predict
    finger: {preset: human}
    model: {ratios: m43338}
    measurements:
      - {name: press, data: press.csv}
  line:
    kind: predict
    finger: {preset: monkey}
    model: {ratios: m43338}
    measurements:
      - {name: press, data: press.csv}
"""
PRESS = "subject,displacement_mm,force_N\na,0.5,0.1\na,1.0,0.2\n"
SIDECAR = "kind: force_displacement\nindenter: {shape: flat_plate}\ncontrolled: displacement\n"


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "press.csv").write_text(PRESS)
    (tmp_path / "press.yaml").write_text(SIDECAR)
    path = tmp_path / "mine.yaml"
    path.write_text(STUDIES)
    return path


class Runs:
    """Stands where studies are really run; counts, and ends as it is told to."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.ending: dict[str, RESULTS | type[BaseException]] = {}

    def __call__(self, study: Study, context: Context) -> StudyResult:
        self.names.append(study.name)
        context.at(0.5, "solving")
        (context.folder / "field.vtu").write_text(study.name)
        ending = self.ending.get(study.name, RESULTS.successful)
        if not isinstance(ending, RESULTS):
            raise ending
        rows = [{"indenter": "plate", "modulus_MPa": 0.21}]
        verdict = f"{study.name} was run. {study.notes}".strip()
        return StudyResult(
            study.name, f"Study {study.name}", verdict, ending, [Table("moduli", "Moduli", rows)]
        )


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> Iterator[Runs]:
    """A runner for every kind; and no cache folder is touched."""
    stand_in = Runs()
    for kind in ("predict", "fit", "table", "layer_study", "sweep"):
        monkeypatch.setitem(run_module.RUNNERS, kind, stand_in)
    monkeypatch.setattr(run_module, "prepare", lambda: None)
    yield stand_in


def call(*arguments: Any) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_help_teaches_with_an_example() -> None:
    shown = call("run", "--help")
    assert shown.exit_code == 0
    assert "fingerjax run experiments.yaml" in shown.stdout
    assert "fingerjax run" in call("--help").stdout
    assert "--picture human.png" in call("mesh", "--help").stdout


def test_studies_are_listed(file: Path) -> None:
    shown = call("studies", file)
    assert shown.exit_code == 0
    assert "plate" in shown.stdout and "monkey" in shown.stdout


def test_a_run_leaves_its_folder_and_ends_well(file: Path, tmp_path: Path, runs: Runs) -> None:
    shown = call("run", file, "--out", tmp_path / "out")
    assert shown.exit_code == 0, shown.output
    assert runs.names == ["plate", "line"]
    assert "0.21" in shown.stdout and str(tmp_path / "out" / "report.html") in shown.stdout
    assert "line was run." in shown.stderr
    assert (tmp_path / "out/plate/tables/moduli.csv").read_text() == "indenter,modulus_MPa\nplate,0.21\n"
    assert (tmp_path / "out/line/field.vtu").read_text() == "line"
    assert list(json.loads((tmp_path / "out/report.json").read_text())["studies"]) == ["plate", "line"]
    # A run that ended starts anew when it is asked for again.
    assert call("run", file, "--out", tmp_path / "out").exit_code == 0
    assert len(runs.names) == 4


def test_one_study_is_run_by_name(file: Path, tmp_path: Path, runs: Runs) -> None:
    assert call("run", file, "--study", "line", "--out", tmp_path / "out").exit_code == 0
    assert runs.names == ["line"]
    assert json.loads((tmp_path / "out/report.json").read_text())["study"] == "line"


def test_an_unknown_study_is_one_line_that_names_the_nearest(file: Path, tmp_path: Path, runs: Runs) -> None:
    shown = call("run", file, "--study", "lime", "--out", tmp_path / "out")
    assert shown.exit_code == 2
    assert shown.stderr.count("\n") == 1
    assert "lime" in shown.stderr and "line" in shown.stderr
    assert not runs.names


def test_wrong_input_is_one_line_and_code_2(file: Path, tmp_path: Path, runs: Runs) -> None:
    (tmp_path / "press.csv").write_text("subject,displacement_mm\na,0.5\n")
    shown = call("run", file, "--out", tmp_path / "out")
    assert shown.exit_code == 2
    assert shown.stderr.startswith("fingerjax: ") and shown.stderr.count("\n") == 1
    assert "press" in shown.stderr
    assert not runs.names and not (tmp_path / "out").exists()


def test_what_did_not_converge_is_written_and_ends_with_code_1(
    file: Path, tmp_path: Path, runs: Runs
) -> None:
    runs.ending["plate"] = RESULTS.not_converged
    shown = call("run", file, "--out", tmp_path / "out")
    assert shown.exit_code == 1
    assert runs.names == ["plate", "line"]
    report = json.loads((tmp_path / "out/plate/report.json").read_text())
    assert report["result"]["name"] == "not_converged"


@pytest.mark.parametrize("ending", [KeyboardInterrupt, RESULTS.interrupted])
def test_ctrl_c_says_what_is_kept_and_the_next_run_goes_on(
    file: Path, tmp_path: Path, runs: Runs, ending: Any
) -> None:
    runs.ending["line"] = ending
    shown = call("run", file, "--out", tmp_path / "out")
    assert shown.exit_code == 130
    assert "kept: plate" in shown.stderr
    assert not (tmp_path / "out").exists()
    runs.ending.clear()
    again = call("run", file, "--out", tmp_path / "out")
    assert again.exit_code == 0
    assert runs.names == ["plate", "line", "line"]
    assert "plate: finished before." in again.stderr
    assert (tmp_path / "out/plate/field.vtu").read_text() == "plate"


@pytest.mark.parametrize("change", ["data", "sidecar", "study", "fresh"])
def test_a_changed_input_is_run_again(file: Path, tmp_path: Path, runs: Runs, change: str) -> None:
    runs.ending["line"] = KeyboardInterrupt
    assert call("run", file, "--out", tmp_path / "out").exit_code == 130
    runs.ending.clear()
    if change == "data":
        (tmp_path / "press.csv").write_text(PRESS.replace("0.2", "0.3"))
    elif change == "sidecar":
        (tmp_path / "press.yaml").write_text(SIDECAR + "notes: corrected\n")
    elif change == "study":
        file.write_text(STUDIES.replace("preset: human", "preset: monkey"))
    more = ["--fresh"] if change == "fresh" else []
    assert call("run", file, "--out", tmp_path / "out", *more).exit_code == 0
    assert runs.names == ["plate", "line", "plate", "line"]


def test_data_that_are_not_there(file: Path, tmp_path: Path, runs: Runs) -> None:
    file.write_text(STUDIES.replace("data: press.csv", "data: 'data:lab/press.csv'", 1))
    shown = call("run", file, "--out", tmp_path / "out")
    assert shown.exit_code == 0
    assert runs.names == ["line"]
    assert "plate: Not run: measured data are not there (lab/press.csv)" in shown.stderr
    assert "Not run" in (tmp_path / "out/report.html").read_text()
    named = call("run", file, "--study", "plate", "--out", tmp_path / "out")
    assert named.exit_code == 2
    assert "--data" in named.stderr
    (tmp_path / "shared" / "lab").mkdir(parents=True)
    (tmp_path / "shared/lab/press.csv").write_text(PRESS)
    (tmp_path / "shared/lab/press.yaml").write_text(SIDECAR)
    found = call("run", file, "--study", "plate", "--data", tmp_path / "shared", "--out", tmp_path / "out")
    assert found.exit_code == 0, found.output


def test_a_fallback_stands_in_under_the_name_of_what_it_replaces(
    file: Path, tmp_path: Path, runs: Runs
) -> None:
    text = STUDIES.replace("data: press.csv", "data: 'data:lab/press.csv'", 1)
    file.write_text(text.replace("  plate:\n", "  plate:\n    fallback: line\n"))
    shown = call("run", file, "--out", tmp_path / "out")
    assert shown.exit_code == 0, shown.output
    assert runs.names == ["plate"]
    report = json.loads((tmp_path / "out/plate/report.json").read_text())
    assert "Run as line, because measured data are not there: lab/press.csv" in report["verdict"]


def test_a_kind_that_nothing_runs_is_refused(file: Path, runs: Runs, monkeypatch: pytest.MonkeyPatch) -> None:
    study = load_studies(file)["plate"]
    monkeypatch.delitem(run_module.RUNNERS, "predict")
    with pytest.raises(InputError, match="no such kind of study"):
        run_module.runner(study)


def test_the_key_knows_the_file_beside_the_file(file: Path) -> None:
    study = load_studies(file)["plate"]
    assert {path.name for path in _resume.named_files(study, None)} == {"press.csv", "press.yaml"}
    assert _resume.study_key(study, None) == _resume.study_key(study, None)
    assert _resume.study_key(study, None) != _resume.study_key(dataclasses.replace(study, name="b"), None)


def test_a_long_note_names_no_file(file: Path) -> None:
    study = load_studies(file)["plate"]
    noted = dataclasses.replace(study, written={**study.written, "notes": "The place of the receptor is not known. " * 10})
    assert list(_resume.named_files(noted, None)) == list(_resume.named_files(study, None))


def test_the_bar_counts_a_study_by_what_it_took_before() -> None:
    board = _progress.Board(
        ["short", "long", "new"], {"short": 10.0, "long": 30.0}, Console(file=None, quiet=True)
    )
    assert board.share == pytest.approx({"short": 1 / 6, "long": 1 / 2, "new": 1 / 3})
    board.teller("long")(0.5, "solving")
    assert board.progress.tasks[0].completed == pytest.approx(1 / 6 + 1 / 4)
    assert _progress.remaining(30.0, 0.25) == pytest.approx(90.0)
    assert _progress.remaining(1.0, 0.0) is None
    assert _progress.clock(75.2) == "1:15"


def test_without_a_terminal_what_is_done_is_said_in_lines_that_do_not_crowd(monkeypatch: pytest.MonkeyPatch) -> None:
    now, screen = [0.0], io.StringIO()
    monkeypatch.setattr(_progress.time, "perf_counter", lambda: now[0])
    tell = _progress.Board(["a"], {}, Console(file=screen, force_terminal=False)).teller("a")
    steps = [(1.0, "meshing"), (12.0, "solving"), (15.0, "fitting"), (30.0, "solving"), (75.0, "drawing")]
    for now[0], doing in steps:
        tell(now[0] / 150, doing)
    assert screen.getvalue().splitlines() == ["0:12    8 %  a: solving", "1:15   50 %  a: drawing"]


def test_a_cut_through_tetrahedra_has_the_area_of_the_body() -> None:
    # the unit cube as six tetrahedra around its diagonal
    corners = np.array([(x, y, z) for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
    paths = [(1, 3), (1, 5), (2, 3), (2, 6), (4, 5), (4, 6)]
    tets = np.array([(0, a, b, 7) for a, b in paths])
    finger = SimpleNamespace(nodes=corners, tets=tets, layer=np.zeros(6, int))
    for normal in range(3):
        polygons = picture_module.cut(finger, normal, 0.3)[0]
        area = 0.0
        for polygon in polygons:
            np.testing.assert_allclose(polygon[:, normal], 0.3)
            x, y = np.delete(polygon, normal, axis=1).T
            area += 0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))
        assert area == pytest.approx(1.0)
