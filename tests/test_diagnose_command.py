"""`fingerjax diagnose` and `fingerjax effects`: what they print, keep and leave, and how they end."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnosis_records import record
from typer.testing import CliRunner, Result

from fingerjax.__main__ import app
from fingerjax.commands._parts import Parts
from fingerjax.report.records import RunFolder
from fingerjax.study import load_studies

diagnose_module = importlib.import_module("fingerjax.commands.diagnose")

STUDIES = """
version: 1
studies:
  nail:
    finger: {preset: human}
    model: {ratios: m43338}
    measurements: [{name: press, data: press.csv}]
    fit: {free: [epidermis.modulus]}
    diagnose: {effects: all}
  plain:
    finger: {preset: human}
    model: {ratios: m43338}
    measurements: [{name: press, data: press.csv}]
    fit: {free: [epidermis.modulus]}
  shown:
    kind: predict
    finger: {preset: monkey}
    model: {ratios: m43338}
    measurements: [{name: press, data: press.csv}]
"""
PRESS = "subject,displacement_mm,force_N\na,0.5,0.1\na,1.0,0.2\n"
SIDECAR = "kind: force_displacement\nindenter: {shape: flat_plate}\ncontrolled: displacement\n"
REFITS = ("base", "nail_compliance", "contact_offset")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "press.csv").write_text(PRESS)
    (tmp_path / "press.yaml").write_text(SIDECAR)
    path = tmp_path / "mine.yaml"
    path.write_text(STUDIES)
    return path


def small() -> dict[str, Any]:
    """A record that is quickly drawn: one measurement, two effects."""
    whole = record("attributed")
    return whole | {"rows": {"plate": whole["rows"]["plate"]}, "candidates": whole["candidates"][:2]}


@dataclass
class Diagnoses:
    """Stands where studies are diagnosed: keeps three parts, remembers what it was asked, and stops where it is told to."""

    asked: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    made: list[str] = field(default_factory=list)
    stop_at: str | None = None

    def __call__(self, study: Any, *, solver: str, seed: int, effects: Any, folder: Any, tell: Any, kept: Any) -> SimpleNamespace:
        self.asked.append((study.name, {"solver": solver, "seed": seed, "effects": effects, "folder": folder}))
        for number, name in enumerate(REFITS):
            tell(number / len(REFITS), name)
            kept(name, lambda name=name: self._make(name))
        return SimpleNamespace(record=small)

    def _make(self, name: str) -> dict[str, Any]:
        if name == self.stop_at:
            raise KeyboardInterrupt
        self.made.append(name)
        return {"x": [0.1, float("nan")]}


def size(name: str, unit: str, **more: Any) -> SimpleNamespace:
    return SimpleNamespace(**{"name": name, "unit": unit, "null": 0.0, "scale": 0.1, "lower": 0.0, "upper": 0.3, "sign": 1, **more})


CATALOGUE = (
    SimpleNamespace(
        name="nail_compliance", acts_on="support", parameters=(size("depth", "mm/N"),),
        leaves="forces too high [everywhere] near the nail", confused_with="bed_compliance",
    ),
    SimpleNamespace(
        name="contact_offset", acts_on="contact", parameters=(size("offset", "mm", sign=0, lower=-0.3),),
        leaves="curves slid along the depth axis", confused_with="apparatus_compliance",
    ),
)  # fmt: skip


@pytest.fixture
def diagnoses(monkeypatch: pytest.MonkeyPatch) -> Iterator[Diagnoses]:
    """A stub of the diagnosis and of the catalogue; no cache folder is touched."""
    stub = Diagnoses()
    effects, diagnosis = ModuleType("fingerjax.effects"), ModuleType("fingerjax.runners.diagnosing")
    effects.catalogue = lambda folder=None: CATALOGUE  # type: ignore[attr-defined]
    diagnosis.diagnose_study = stub  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "fingerjax.effects", effects)
    monkeypatch.setitem(sys.modules, "fingerjax.runners.diagnosing", diagnosis)
    monkeypatch.setattr(diagnose_module, "prepare", lambda: None)
    monkeypatch.setenv("COLUMNS", "160")
    yield stub


def call(*arguments: Any) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_help_teaches(diagnoses: Diagnoses) -> None:
    shown = " ".join(call("diagnose", "--help").stdout.split())
    assert "fingerjax diagnose mine.yaml" in shown and "Repeats matter more than anything" in shown
    assert "fingerjax effects nail_compliance" in call("effects", "--help").stdout


def test_a_diagnosis_leaves_its_folder(file: Path, tmp_path: Path, diagnoses: Diagnoses) -> None:
    shown = call("diagnose", file, "--out", tmp_path / "out", "--seed", 7)
    assert shown.exit_code == 0, shown.output
    assert diagnoses.asked == [("nail", {"solver": "auto", "seed": 7, "effects": "all", "folder": None})]
    assert "The nail gives way" in shown.stdout and "nail compliance" in " ".join(shown.stdout.split())
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert report["study"] == "nail" and report["loop"]["set"] == ["nail_compliance"]
    assert report["loop"]["base"]["theta"]["epidermis.modulus"]["link"] == "log"
    assert report["loop"]["base"]["theta"]["epidermis.modulus"]["raw"] == pytest.approx(np.log(0.121))
    assert report["fit"]["parameters"]["epidermis.modulus"]["value"] == 0.121
    assert "The nail gives way" in (tmp_path / "out/report.html").read_text()
    assert (tmp_path / "out/nail/figures/loop_effects.svg").is_file() and (tmp_path / "out/nail/figures/loop_effects.csv").is_file()
    assert "diagnosis: 7" in (tmp_path / "out/run.yaml").read_text()
    assert not list(tmp_path.glob(".out*"))


def test_ctrl_c_loses_nothing(file: Path, tmp_path: Path, diagnoses: Diagnoses) -> None:
    diagnoses.stop_at = "contact_offset"
    shown = call("diagnose", file, "--out", tmp_path / "out")
    assert shown.exit_code == 130
    assert "nail: 2 parts of its diagnosis kept" in shown.stderr and "goes on from there" in shown.stderr
    assert not (tmp_path / "out").exists()
    assert diagnoses.made == ["base", "nail_compliance"]
    diagnoses.stop_at = None
    assert call("diagnose", file, "--out", tmp_path / "out").exit_code == 0
    assert diagnoses.made == list(REFITS)
    assert not list(tmp_path.rglob("*.part*"))


@pytest.mark.parametrize("change", ["data", "seed", "effects", "solver", "fresh", "folder"])
def test_parts_of_other_inputs_are_not_used(file: Path, tmp_path: Path, diagnoses: Diagnoses, change: str) -> None:
    diagnoses.stop_at = "contact_offset"
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "swelling.py").write_text("size = 1\n")
    usual = ["--effects-folder", tmp_path / "own"]
    assert call("diagnose", file, "--out", tmp_path / "out", *usual).exit_code == 130
    diagnoses.stop_at = None
    if change == "data":
        (tmp_path / "press.csv").write_text(PRESS.replace("0.2", "0.3"))
    if change == "folder":
        (tmp_path / "own" / "swelling.py").write_text("size = 2\n")
    more = {"seed": ["--seed", 3], "effects": ["--effects", "contact_offset"], "solver": ["--solver", "multigrid"], "fresh": ["--fresh"]}
    assert call("diagnose", file, "--out", tmp_path / "out", *usual, *more.get(change, [])).exit_code == 0
    assert diagnoses.made == [*REFITS[:2], *REFITS]


def test_effects_of_the_command_line_replace_the_studys(file: Path, tmp_path: Path, diagnoses: Diagnoses) -> None:
    arguments = ("diagnose", file, "--study", "plain", "--effects", "contact_offset, nail_compliance", "--out", tmp_path / "out")
    assert call(*arguments).exit_code == 0
    assert diagnoses.asked[0][0] == "plain"
    assert diagnoses.asked[0][1]["effects"] == ("contact_offset", "nail_compliance")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--effects", "nail_complience"], ["--effects", "nail_complience", "did you mean 'nail_compliance'"]),
        (["--effects", "none"], ["--effects", "no effect is to be tried"]),
        (["--solver", "multigird"], ["--solver", "did you mean 'multigrid'"]),
        (["--study", "nale"], ["--study", "did you mean 'nail'"]),
        (["--study", "shown"], ["shown", "fits nothing", "name one of nail, plain"]),
        (["--effects-folder", "nowhere"], ["--effects-folder", "no such folder"]),
    ],
)
def test_wrong_input_is_one_line_that_says_what_to_write(
    file: Path, tmp_path: Path, diagnoses: Diagnoses, arguments: list[str], words: list[str]
) -> None:
    shown = call("diagnose", file, "--out", tmp_path / "out", *arguments)
    assert shown.exit_code == 2
    assert shown.stderr.startswith("fingerjax: ") and shown.stderr.count("\n") == 1
    assert all(word in shown.stderr for word in words), shown.stderr
    assert not diagnoses.asked and not (tmp_path / "out").exists()


def test_pardiso_is_asked_for_where_it_is_installed_only(
    file: Path, tmp_path: Path, diagnoses: Diagnoses, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(diagnose_module, "pardiso_available", lambda: False)
    shown = call("diagnose", file, "--out", tmp_path / "out", "--solver", "pardiso")
    assert shown.exit_code == 2 and "fingerjax[direct]" in shown.stderr and not diagnoses.asked


def test_an_effect_that_the_study_misspells_is_refused_with_its_key(file: Path, tmp_path: Path, diagnoses: Diagnoses) -> None:
    file.write_text(STUDIES.replace("effects: all", "effects: [nail_complience]"))
    shown = call("diagnose", file, "--out", tmp_path / "out")
    assert shown.exit_code == 2
    assert "mine.yaml, nail.diagnose.effects: no such effect" in shown.stderr and "nail_compliance" in shown.stderr


def test_several_studies_and_none_that_asks(file: Path, tmp_path: Path, diagnoses: Diagnoses) -> None:
    file.write_text(STUDIES.replace("    diagnose: {effects: all}\n", ""))
    shown = call("diagnose", file, "--out", tmp_path / "out")
    assert shown.exit_code == 2 and "name one of nail, plain" in shown.stderr


def test_what_did_not_converge_ends_with_code_1(file: Path, tmp_path: Path, diagnoses: Diagnoses, monkeypatch: pytest.MonkeyPatch) -> None:
    bad = record("adequate")
    bad["base"]["converged"] = False
    bad["verdict"] |= {"kind": "not converged", "text": ""}
    monkeypatch.setattr(sys.modules["fingerjax.runners.diagnosing"], "diagnose_study", lambda *a, **k: SimpleNamespace(record=lambda: bad))
    shown = call("diagnose", file, "--out", tmp_path / "out")
    assert shown.exit_code == 1
    assert json.loads((tmp_path / "out/report.json").read_text())["result"]["name"] == "no_optimum"


# ---- parts ----


def test_a_part_is_made_once_and_comes_back_to_the_last_bit(tmp_path: Path) -> None:
    made: list[int] = []

    def make() -> dict[str, Any]:
        made.append(1)
        return {"x": [0.1 + 0.2, float("nan"), float("inf")], "name": "µ"}

    first = Parts(tmp_path)("refit nail/1", make)
    second = Parts(tmp_path)("refit nail/1", make)
    assert made == [1] and len(Parts(tmp_path)) == 1
    assert second["x"][0] == first["x"][0] == 0.1 + 0.2
    assert np.isnan(second["x"][1]) and second["x"][2] == float("inf") and second["name"] == "µ"
    assert Parts(tmp_path)("refit nail/2", lambda: 5) == 5


def test_a_part_cut_off_is_made_again(tmp_path: Path) -> None:
    Parts(tmp_path)("base", lambda: {"x": [1.0]})
    (path,) = tmp_path.glob("*.json")
    path.write_text(path.read_text()[:-5])
    assert Parts(tmp_path)("base", lambda: {"x": [2.0]}) == {"x": [2.0]}


def test_parts_of_another_key_are_forgotten(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "out")
    first = folder.parts("nail", "a" * 64)
    Parts(first)("base", lambda: 1)
    assert RunFolder(tmp_path / "out").parts("nail", "a" * 64) == first and len(Parts(first)) == 1
    assert folder.parts("nail", "b" * 64) != first and not first.exists()


# ---- effects ----


def test_effects_are_listed(diagnoses: Diagnoses) -> None:
    shown = call("effects")
    assert shown.exit_code == 0
    for word in (
        "nail_compliance",
        "support",
        "depth: 0.1 mm/N (0 to 0.3)",
        "bed_compliance",
        "forces too high [everywhere] near the nail",
    ):
        assert word in shown.stdout
    one = call("effects", "contact_offset")
    assert "leaves behind: curves slid along the depth axis" in one.stdout and "either way" in one.stdout
    assert "nail" not in one.stdout


def test_an_unknown_effect_is_one_line(diagnoses: Diagnoses, tmp_path: Path) -> None:
    shown = call("effects", "nail")
    assert shown.exit_code == 2 and shown.stderr.count("\n") == 1
    assert "did you mean 'nail_compliance'" in shown.stderr
    assert "no such folder" in call("effects", "--effects-folder", tmp_path / "none").stderr


def test_a_study_is_diagnosed_as_it_was_read(file: Path, diagnoses: Diagnoses) -> None:
    parameters = load_studies(file)["nail"].parameters()
    said = {"base": {"theta": {"epidermis.modulus[subject a]": {"value": 0.2}, "strange": {"value": 1.0}}}, "after": {}}
    theta = diagnose_module.with_raw(said, parameters)["base"]["theta"]
    assert theta["epidermis.modulus[subject a]"] == {"value": 0.2, "link": "log", "raw": pytest.approx(np.log(0.2))}
    assert theta["strange"] == {"value": 1.0}
    assert "raw" not in said["base"]["theta"]["epidermis.modulus[subject a]"]
