"""Studies of measured data: they are read, say what they need, and on a thinned set go all the way to the page."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import time
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import _measured_page
from benchmarks import measured as studies_of
from benchmarks._measured_page import markdown, page
from benchmarks._record import Figure
from benchmarks._sections import rows, sections
from benchmarks._table1 import crossing, ratios
from fingerjax.__main__ import app
from fingerjax.report.records import Table
from fingerjax.runners import diagnosing
from fingerjax.study import load_studies

from .diagnosis_records import record

NAMES = tuple(studies_of.studies())
FINGERS = ("fingerpad", "table1", "bar", "spheres")
"""Those of them that are tried here; of the others another file says how far they go."""
ONE_OF_EACH = ("bar", "silicone")
"""A finger and silicone: tried each time, and all others with the slow tests."""
SHARED = tuple(name for name in FINGERS if name != "table1")
"""Those whose data are not beside them."""


@pytest.fixture(autouse=True)
def apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a part finds is kept where no other run looks."""
    monkeypatch.setattr(studies_of, "KEPT", tmp_path / "kept")


@pytest.mark.parametrize("name", SHARED)
@pytest.mark.parametrize("command", ["run", "diagnose"])
def test_without_its_data_every_study_ends_with_one_line(name: str, command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FINGERJAX_DATA", raising=False)
    ended = CliRunner().invoke(app, [command, str(studies_of.studies()[name]), "--out", str(tmp_path / "out")])
    said = [line for line in ended.stderr.splitlines() if "measured data are not there" in line]
    assert len(said) == 1 or len({line.split(":")[0] for line in said}) == len(said), ended.stderr
    assert all(".csv" in line and "--data" in line and "your own table" in line for line in said), ended.stderr


@pytest.mark.parametrize("name", FINGERS)
def test_a_study_reads_its_data(name: str, measured: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FINGERJAX_DATA", str(measured))
    whole = studies_of.loaded(name)
    assert whole.kind == "fit" and whole.notes and whole.diagnose is not None
    assert all(one.sigma is not None or "trial" in one.table for one in whole.measurements), "nothing tells the noise"
    few = studies_of.thinned(whole)
    assert [one.name for one in few.measurements] == [one.name for one in whole.measurements]
    for one, fewer in zip(whole.measurements, few.measurements, strict=True):
        assert 0 < len(fewer) <= len(one)
        for label in {"subject", "stimulus"} & set(one.table):
            assert set(fewer.table[label].tolist()) == set(one.table[label].tolist())


def test_every_study_of_every_file_is_a_part() -> None:
    assert {*FINGERS, *ONE_OF_EACH} <= set(NAMES)


def test_ratios_of_table_1_are_the_published_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    study = next(iter(load_studies(studies_of.studies()["table1"]).values()))
    assert ratios(study) == pytest.approx({"1": 23.59 / 5.29, "2": 24.73 / 2.74, "3": 11.82 / 3.34, "4": 17.46 / 2.65, "5": 13.35 / 4.55})


def test_a_curve_is_crossed_where_it_is() -> None:
    curve = [(-1.0, 8.0), (0.0, 6.0), (2.0, 2.0)]
    assert crossing(curve, 7.0) == pytest.approx(-0.5) and crossing(curve, 3.0) == pytest.approx(1.5)
    assert crossing(curve, 1.0) is None and crossing(curve, 9.0) is None


def test_a_table_in_markdown_leaves_out_empty_columns() -> None:
    table = Table("t", "T", [{"a_mm": 1.23456, "b": None, "c": "x|y"}, {"a_mm": None, "b": None, "c": True}])
    assert markdown(table).splitlines() == ["| a, mm | c |", "| ---: | --- |", "| 1.23 | x/y |", "|  | yes |"]


def test_the_page_is_made_from_records_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_measured_page, "PICTURES", tmp_path / "pictures")
    more = Table("own", "A question of its own", [{"subject": "1", "needed": 0.25}], "How much it would take.")
    kept = {"record": record("unexplained"), "tables": [dataclasses.asdict(more)], "made": "program 0123, 2026-01-02"}
    found = {name: {"notes": f"About {name}.", **kept} for name in ("lab", "other")}
    text = page(found, [Figure(f"{name}: whole study", 90.0, "s") for name in found])
    assert text.count("## A question of its own") == 2 and "About lab." in text and "\n3 min together" in text
    assert "nail compliance" in text and "pictures/measured_lab_conditions.svg" in text
    drawn = set(re.findall(r"\((pictures/.*?\.svg)\)", text))
    assert any("measured_lab_remainder" in name for name in drawn)
    assert all((tmp_path / name).read_text().lstrip().startswith("<?xml") for name in drawn)
    assert text.count("Made by program 0123, 2026-01-02.") == 2 and "not all run at once" in text


@pytest.mark.parametrize(("minutes", "verdict"), [(50.0, "met"), (70.0, "NOT MET")])
def test_the_page_says_how_long_one_run_of_all_studies_took(
    minutes: float, verdict: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_measured_page, "PICTURES", tmp_path / "pictures")
    monkeypatch.setattr(studies_of, "studies", lambda: {"lab": tmp_path / "lab.yaml"})
    monkeypatch.setattr(studies_of, "PAGE", tmp_path / "page.md")
    studies_of.keep("lab", False, {"notes": "", "record": record("unexplained"), "tables": []})
    figures = [Figure("lab: whole study", 90.0, "s")]
    text = studies_of.told(figures, time.time() - 60 * minutes)
    assert f"took {minutes:.0f} min, and should\ntake 60 ({verdict})." in text
    os.utime(studies_of._file("lab", False), (0, 0))  # of an earlier run
    assert "not all run at once" in studies_of.told(figures, time.time() - 60 * minutes)


def test_a_run_renews_its_own_section_and_leaves_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_measured_page, "PICTURES", tmp_path / "pictures")
    names = ("mouse_relaxation", "lab", "silicone")
    kept = {"notes": "Old.", "record": record("unexplained"), "tables": [], "made": "program 0"}
    before = page(dict.fromkeys(names[:2], kept), [Figure(f"{name}: whole study", 120.0, "s") for name in names[:2]], ["silicone"])
    assert "Not run, and so without a result: silicone." in before
    after = page({"lab": {**kept, "notes": "New."}}, [Figure("lab: whole study", 60.0, "s")], ["mouse_relaxation", "silicone"], before)
    assert sections(after)["mouse_relaxation"] == sections(before)["mouse_relaxation"] and "New." in sections(after)["lab"]
    assert list(rows(after)) == ["mouse_relaxation", "lab"]
    assert rows(after)["mouse_relaxation"] == rows(before)["mouse_relaxation"]
    assert "\n3 min together" in after and "Not run, and so without a result: silicone." in after
    again = page({"silicone": kept}, [Figure("silicone: whole study", 60.0, "s")], ["mouse_relaxation", "lab"], after)
    assert list(sections(again)) == ["mouse_relaxation", "silicone", "lab"] and "Not run" not in again


@pytest.mark.parametrize("name", [name if name in ONE_OF_EACH else pytest.param(name, marks=pytest.mark.slow) for name in NAMES])
def test_a_thinned_study_goes_all_the_way_to_the_page(name: str, measured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FINGERJAX_DATA", str(measured))
    monkeypatch.setattr(studies_of, "FEW", ("contact_offset", "rate_adaptation", "rate_saturation"))
    monkeypatch.setattr(studies_of, "FEW_SETS", 0)
    monkeypatch.setattr(diagnosing, "CLOSE", 0.0)  # no finer mesh
    monkeypatch.setattr(_measured_page, "PICTURES", tmp_path / "pictures")
    figures = list(studies_of.part(name, True))
    kept = json.loads((studies_of.KEPT / "quick" / f"{name}.json").read_text())
    before = next(one.value for one in figures if one.figure == f"{name}: error before, fit")
    assert np.isfinite(before) and kept["record"]["base"]["converged"]
    text = page({name: kept}, figures)
    assert f"## {name}" in text and kept["record"]["verdict"]["kind"].replace("_", " ") in text.replace("_", " ")


def test_what_took_longest_starts_first() -> None:
    before = "| [a](#a) | adequate | 3 |\n| [b](#b) | adequate | 40 |\n"
    assert studies_of.longest_first(["a", "b", "new"], before) == ["new", "b", "a"]
    assert studies_of.longest_first(["a", "b"], "") == ["a", "b"]


@pytest.mark.slow
@pytest.mark.parametrize("name", FINGERS)
def test_a_thinned_study_is_checked_on_a_finer_mesh(name: str, measured: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FINGERJAX_DATA", str(measured))
    figures = {one.figure: one.value for one in studies_of.part(name, True)}
    kept = json.loads((studies_of.KEPT / "quick" / f"{name}.json").read_text())
    assert kept["record"]["base"]["converged"] and kept["record"]["model"]["mesh"]["finer_nodes"]
    assert np.isfinite(figures[f"{name}: error before, fit"]) and figures[f"{name}: whole study"] > 0


def test_finished_searches_belong_to_a_study_and_its_data() -> None:
    study = studies_of.loaded("table1")
    kept = studies_of._parts("table1", study, False)
    assert kept("base", lambda: {"x": [1.0]}) == studies_of._parts("table1", study, False)("base", lambda: {}) == {"x": [1.0]}
    point = study.measurements[0]
    moved = dataclasses.replace(point, table=point.table | {point.value: point.table[point.value] * 1.01})
    other = dataclasses.replace(study, measurements=(moved, *study.measurements[1:]))
    folders = [studies_of._parts("table1", one, quick).folder for one, quick in ((study, False), (other, False), (study, True))]
    assert len(set(folders)) == 3
