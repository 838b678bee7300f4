"""The slice's benchmark reads its figures from what studies report; the README's first fit runs as it is written there."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from benchmarks import slice as chain
from benchmarks._record import Figure, record
from fingerjax.__main__ import app
from fingerjax._results import RESULTS
from fingerjax.report.records import Context, StudyResult, Table
from fingerjax.study import ForceTable, Study, load_studies

README = (Path(__file__).resolve().parent.parent / "README.md").read_text(encoding="utf-8")
STUDIES = load_studies(chain.EXPERIMENTS)
MODULI = "our_epidermis_modulus_MPa", "paper_epidermis_modulus_MPa"


def line(travel: float, ours: float, paper: float) -> dict:
    return {"indenter": "line", "displacement_mm": travel, "our_slope_MPa_per_gf": ours, "paper_slope_MPa_per_gf": paper}


def made_up(study: Study, context: Context) -> StudyResult:
    """What a runner could have answered: every number here is a round one."""
    assert context.folder.is_dir()
    if isinstance(study.options, ForceTable):
        assert not study.options.drivers
    plate = {"indenter": "flat_plate", "displacement_mm": 0.79, "our_slope_MPa_per_gf": 0.01}
    tips = [{"radius_mm": r, "slope_MPa_per_gf": 0.0523 * s, "ratio": 5.7 * s} for r, s in ((0.1, 2.0), (0.4, 0.5))]
    mean = {"rows": "all", **{f"{who}_mean_epidermis_modulus_MPa": 0.15 for who in ("our", "paper")}}
    ratio = {"layer": "dermis", "ratio_to_epidermis": 0.11, "lower": 0.09, "upper": 0.13}
    tables = {
        "moduli": [plate, line(1.0, 0.04, 0.04), line(2.0, 0.01, 0.02)],
        "tip_radius": tips,
        "means": [mean],
        "growth": [{"indenter": "line", "exponent": 2.0}],
        "findings": [{"finding": "one", "holds": "yes"}, {"finding": "two", "holds": "no"}],
        "layer_ratios": [ratio],
    }
    parameters = {"bar_rates.scale": {"value": 133300.0, "ci95": [1.0e5, 2.0e5]}}
    fit = {"chi2": 20.0, "dof": 10, "solver": {"converged": True}, "parameters": parameters}
    return StudyResult(study.name, study.name, "", tables=[Table(name, name, rows) for name, rows in tables.items()], fit=fit)


def broken(study: Study, context: Context) -> StudyResult:
    return StudyResult(study.name, study.name, "Not converged", RESULTS.not_converged)


def figures(monkeypatch: pytest.MonkeyPatch, answered: object) -> dict[str, Figure]:
    for kind in chain.RUNNERS:
        monkeypatch.setitem(chain.RUNNERS, kind, answered)
    parts = [chain.human(STUDIES["table1"]), chain.monkey(STUDIES["table2"]), chain.layers(STUDIES["layer_study"])]
    parts += [chain.layer_ratios(STUDIES["layer_ratios_simulated"]), chain.afferent(STUDIES["sa1_bar"])]
    return {figure.figure: figure for part in parts for figure in part}


def test_figures_are_read_from_the_studies_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    found = figures(monkeypatch, made_up)
    assert found["human flat plate, 1.0 mm: modulus per force"].met is True
    assert found["monkey flat plate, 0.79 mm: modulus per force"].met is False  # 0.01 is less than 1/50.5/1.5
    assert found["tip radius that gives 0.0523 MPa/gf"].value == pytest.approx(0.2)
    assert found["line's force grows with travel to the power"].note == "paper's rows 1.00"
    assert (found["findings about layers that hold"].value, found["findings about layers that hold"].met) == (1, False)
    assert found["layer ratios: dermis over epidermis, error"].value == pytest.approx(10.0)
    assert math.isnan(found["layer ratios: adipose over epidermis, error"].value)
    assert found["layer ratios: chi2 over degrees of freedom"].value == pytest.approx(2.0)
    assert found["SA-I bar: scale, error"].value == pytest.approx(0.0)


def test_the_record_is_plain_json_with_the_machine_beside_it(monkeypatch: pytest.MonkeyPatch) -> None:
    records = json.loads(json.dumps(record(figures(monkeypatch, made_up).values(), quick=True), allow_nan=False))
    assert all({"figure", "value", "unit", "goal", "met", "note", "machine", "versions"} <= set(one) for one in records)
    assert [one for one in records if one["value"] is None]


def test_a_study_that_did_not_converge_meets_no_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    found = figures(monkeypatch, broken)
    assert not any(figure.met for figure in found.values())
    assert math.isnan(found["human epidermis, mean"].value)
    assert math.isnan(found["SA-I bar: chi2 over degrees of freedom"].value)


def test_constant_strain_leaves_no_force_inside() -> None:
    assert chain.patch_test().met


def test_a_deep_layer_is_a_half_space_and_a_thin_one_is_stiffer() -> None:
    assert chain.bonded(1e-9, 0.3) == pytest.approx(1.0)
    assert 1.05 < chain.bonded(0.1, 0.3) < 1.15


def blocks() -> dict[str, str]:
    """The files of the README's first fit: name, as it stands before each block, and text."""
    found = re.findall(r"`([\w.]+)`:\n\n```\w+\n(.*?)```", README, flags=re.DOTALL)
    return dict(found)


def test_the_first_fit_of_the_readme_runs_as_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = blocks()
    assert list(files) == ["plate.csv", "plate.yaml", "mine.yaml"]
    assert sum(len(text.splitlines()) for name, text in files.items() if name != "plate.csv") <= 10
    for name, text in files.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    command = re.search(r"^    fingerjax (run mine\.yaml.*)$", README, flags=re.MULTILINE)
    assert command is not None
    monkeypatch.chdir(tmp_path)
    ended = CliRunner().invoke(app, command[1].split())
    assert ended.exit_code == 0, ended.output
    fitted = json.loads((tmp_path / "results/mine/mine/report.json").read_text(encoding="utf-8"))["fit"]
    modulus = fitted["parameters"]["epidermis.modulus"]
    assert modulus["ci95"][0] < modulus["value"] < modulus["ci95"][1]
    assert 0.05 < modulus["value"] < 1.0
    assert (tmp_path / "results/mine/report.html").is_file()


def test_every_option_that_the_readme_names_exists() -> None:
    group: Any = typer.main.get_command(app)
    told = re.findall(r"fingerjax (run|mesh|studies)\b([^\n`]*)", README)
    assert {name for name, _ in told} == {"run", "mesh", "studies"}
    for name, rest in told:
        known = {option for parameter in group.commands[name].params for option in parameter.opts}
        assert set(re.findall(r"--\w+", rest)) <= known, name
