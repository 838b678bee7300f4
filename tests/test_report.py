"""Records, tables, figures and the page, made from a small fit."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from fingerjax._results import RESULTS
from fingerjax.errors import InputError
from fingerjax.identify import Fit, Health, Problem, fit, sensitivity, uncertainty
from fingerjax.parameters import Parameter
from fingerjax.report import Context, Figure, StudyResult, Table, figures, tables, words
from fingerjax.report.page import page
from fingerjax.report.records import RunFolder, fit_record, misfit, plain, run_record

X = np.linspace(0.2, 3.0, 12)
Y = 4.0 * np.exp(-0.6 * X) + 0.01 * np.cos(9 * X)
MESH = {"hash": "abc123", "nodes": 8512, "elements": 40100, "quality": {"minimum_dihedral_deg": 12.3}}


def decay(source: str = "stated", converged: bool = True, sigma: float = 0.01) -> Fit:
    parameters = (Parameter("epidermis.modulus", 2.0, "MPa"), Parameter("rate", 1.0, "1"))

    def residuals(raw: Any) -> Any:
        prediction = jnp.exp(raw[0]) * jnp.exp(-jnp.exp(raw[1]) * X)
        return (prediction - Y) / sigma, Health(jnp.array(converged), jnp.array(7), jnp.array(1e-3))

    return fit(Problem(parameters, residuals, {"line": slice(0, X.size)}, {"line": source}))


def study_result(name: str = "line", **changes: Any) -> StudyResult:
    done = decay()
    known = uncertainty(done)
    record = fit_record(done, known, misfit(done, {"line": 0.01}, {"line": "mm"}))
    rows = [
        {"depth_mm": 1.0, "distance_mm": float(x), "measured_mm": float(y)} for x, y in zip(X, Y, strict=True)
    ]
    predicted = Y + 0.01 * done.rows("line")
    rows = [
        {**row, "sigma_mm": 0.01, "predicted_mm": float(p)} for row, p in zip(rows, predicted, strict=True)
    ]
    made = StudyResult(
        name=name,
        title="Layer ratios from <profiles>",
        verdict=words.verdict(done, known),
        tables=[tables.parameter_table(known, sensitivity(done)), tables.residual_table(record)],
        figures=[figures.profiles(rows), figures.correlations(record["correlations"])],
        fit=record,
        warnings=words.warnings(done, known),
        meshes={"human": MESH},
        resolved={"finger": {"preset": "human"}},
        seeds={"noise": 3},
        created="2026-01-01T00:00:00+00:00",
    )
    return dataclasses.replace(made, **changes)


# ---- records ----


def test_the_record_of_a_fit_has_the_agreed_keys() -> None:
    report = json.loads(json.dumps(study_result().report(), allow_nan=False))
    assert {"version", "study", "provenance", "fit", "tables", "loop"} <= set(report)
    assert {"fingerjax", "jax", "mesh", "created"} <= set(report["provenance"])
    assert report["provenance"]["mesh"] == MESH
    found = report["fit"]
    assert {"parameters", "correlations", "chi2", "dof", "rms", "held_out", "solver"} <= set(found)
    modulus = found["parameters"]["epidermis.modulus"]
    assert {"value", "unit", "ci95", "at_limit", "identified"} <= set(modulus)
    assert modulus["ci95"][0] < modulus["value"] < modulus["ci95"][1]
    assert (modulus["unit"], modulus["at_limit"], modulus["identified"]) == ("MPa", None, True)
    assert found["dof"] == 10
    assert found["solver"]["converged"] is True and found["solver"]["iterations"] == 7
    assert found["rms"]["line"]["unit"] == "mm"
    assert found["rms"]["line"]["value"] == pytest.approx(0.01 * math.sqrt(found["chi2"] / 12))
    assert found["rms"]["line"]["noise"] == pytest.approx(0.01)


def test_of_a_fit_that_did_not_converge_no_value_is_written_anywhere() -> None:
    bad = decay(converged=False)
    known = uncertainty(bad)
    record = fit_record(bad, known)
    assert record["solver"]["converged"] is False
    assert record["parameters"]["epidermis.modulus"]["value"] is None
    assert record["parameters"]["epidermis.modulus"]["ci95"] == [None, None]
    shown = tables.as_html(tables.parameter_table(known))
    assert shown.count("undefined") == 6  # value and both ends, of two parameters
    assert words.verdict(bad, known).startswith("Not converged: a solve inside the model did not converge")
    assert words.warnings(bad, known)[0].startswith(RESULTS.not_converged.value)


def test_a_result_survives_being_written_and_read() -> None:
    before = study_result()
    after = StudyResult.from_json(json.loads(json.dumps(before.to_json())))
    assert after == dataclasses.replace(before, tables=after.tables)
    assert plain(before.tables[0].rows) == after.tables[0].rows
    assert after.report() == before.report()


def test_plain_data_hold_no_numbers_that_json_lacks() -> None:
    said = {
        "a": np.array([1.0, np.nan]),
        "b": (np.float64(2.0), np.int64(3), True),
        "c": Path("x"),
        4: math.inf,
    }
    assert plain(said) == {"a": [1.0, None], "b": [2.0, 3, True], "c": "x", "4": None}
    assert plain(jnp.asarray([1.5])) == [1.5]


# ---- the folder ----


def test_a_run_is_written_whole(tmp_path: Path) -> None:
    out, result = tmp_path / "results", study_result()
    folder = RunFolder(out)
    (folder.begin("line") / "field.vtu").write_text("field")
    folder.keep("key", result)
    assert not out.exists()
    folder.put_in_place([result], "<html>", run_record([result], "fingerjax run x.yaml"))
    assert sorted(str(p.relative_to(out)) for p in out.rglob("*") if p.is_file()) == [
        "line/field.vtu",
        "line/figures/correlations.csv",
        "line/figures/correlations.svg",
        "line/figures/profiles.csv",
        "line/figures/profiles.svg",
        "line/report.json",
        "line/tables/parameters.csv",
        "line/tables/residuals.csv",
        "report.html",
        "report.json",
        "run.yaml",
    ]
    assert [path.name for path in tmp_path.iterdir()] == ["results"]
    assert json.loads((out / "report.json").read_text())["fit"]["dof"] == 10
    with (out / "line/figures/profiles.csv").open() as file:
        drawn = list(csv.DictReader(file))
    assert [float(row["measured_mm"]) for row in drawn] == pytest.approx(list(Y), rel=1e-9)
    assert "seeds:\n      noise: 3" in (out / "run.yaml").read_text()


def test_a_killed_run_keeps_what_it_had_finished(tmp_path: Path) -> None:
    result = study_result()
    RunFolder(tmp_path / "results").keep("key", result)
    again = RunFolder(tmp_path / "results")
    found = again.finished("line", "key")
    assert found is not None and found.report() == result.report()
    assert again.finished("line", "another key") is None
    assert again.finished("another", "key") is None
    assert RunFolder(tmp_path / "results", fresh=True).finished("line", "key") is None


def test_a_study_cut_off_while_it_was_written_is_not_taken_for_finished(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "results")
    (folder.begin("line") / "half.csv").write_text("half")
    again = RunFolder(tmp_path / "results")
    assert again.finished("line", "key") is None
    assert not list(again.partial.rglob("half.csv"))


def test_a_new_run_takes_the_place_of_the_old_one_and_nothing_else(tmp_path: Path) -> None:
    out = tmp_path / "results"
    for name in ("first", "second"):
        result = study_result(name)
        folder = RunFolder(out)
        folder.keep("key", result)
        folder.put_in_place([result], "<html>", run_record([result], ""))
    assert sorted(p.name for p in out.iterdir()) == ["report.html", "report.json", "run.yaml", "second"]
    assert [p.name for p in tmp_path.iterdir()] == ["results"]
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.tex").write_text("text")
    with pytest.raises(InputError, match="will not be replaced"):
        RunFolder(mine)
    assert (mine / "thesis.tex").read_text() == "text"


def test_several_studies_share_one_record(tmp_path: Path) -> None:
    folder, results = RunFolder(tmp_path / "results"), [study_result("one"), study_result("two")]
    for result in results:
        folder.keep("key", result)
    folder.put_in_place(results, page(results), run_record(results, ""))
    whole = json.loads((tmp_path / "results" / "report.json").read_text())
    assert list(whole["studies"]) == ["one", "two"]
    assert whole["studies"]["two"] == json.loads((tmp_path / "results/two/report.json").read_text())


def test_progress_of_a_part_is_a_part_of_the_progress(tmp_path: Path) -> None:
    said: list[tuple[float, str]] = []
    context = Context(tmp_path, tell=lambda share, doing: said.append((share, doing)))
    context.within(0.5, 1.0).within(0.0, 0.5).at(1.0, "solving")
    assert said == [(0.75, "solving")]
    fitted = decay()
    for step in fitted.history:
        context.listener("fit")(step)
    assert said[-1][0] == pytest.approx(1.0)
    assert re.fullmatch(r"fit: step \d+, chi2 [\d.e+-]+", said[-1][1])


# ---- tables ----


@pytest.mark.parametrize(
    ("column", "text"),
    [
        ("modulus_MPa", "modulus, MPa"),
        ("force_gf", "force, gf"),
        ("slope_MPa_per_gf", "slope, MPa/gf"),
        ("share_per_trial", "share per trial"),
        ("seen_by_the_data", "seen by the data"),
    ],
)
def test_headings_carry_their_unit(column: str, text: str) -> None:
    assert tables.heading(column) == text


@pytest.mark.parametrize(
    ("entry", "text"),
    [
        (0.0523049, "0.0523"),
        (23591.4, "23591"),
        (8512.0, "8512"),
        (1.5e-7, "1.500e-07"),
        (math.nan, "undefined"),
        (None, ""),
        (np.bool_(True), "yes"),
        (4, "4"),
        (0.0, "0"),
    ],
)
def test_cells_for_people(entry: Any, text: str) -> None:
    assert tables.shown(entry) == text


def test_the_parameter_table_says_where_each_value_came_from() -> None:
    done = decay()
    table = tables.parameter_table(uncertainty(done), sensitivity(done))
    row = table.rows[0]
    assert (row["parameter"], row["unit"], row["start"]) == ("epidermis.modulus", "MPa", 2.0)
    assert (row["limit"], row["seen_by_the_data"], row["seen_most_by"]) == ("", "yes", "line (100%)")
    assert "stated noise" in table.note
    assert "degrees of freedom" in tables.parameter_table(uncertainty(decay("assumed"))).note


def test_ours_beside_the_papers() -> None:
    labels = [{"indenter": "point", "subject": 1}, {"indenter": "plate", "subject": 1}]
    rows = tables.beside_paper(labels, [0.30, 0.21], [0.28, None], intervals=[(0.2, 0.4), (0.1, 0.3)])
    assert rows[0]["ratio"] == pytest.approx(0.30 / 0.28)
    assert rows[0]["lower_epidermis_modulus_MPa"] == 0.2
    assert rows[1]["paper_epidermis_modulus_MPa"] is None and rows[1]["ratio"] is None
    summary = tables.mean_and_sd(rows, group="indenter")
    assert [row["rows"] for row in summary] == ["all", "point", "plate"]
    assert summary[0]["our_mean_epidermis_modulus_MPa"] == pytest.approx(0.255)
    assert summary[0]["our_sd_epidermis_modulus_MPa"] == pytest.approx(0.0636396, rel=1e-5)
    assert summary[0]["paper_mean_epidermis_modulus_MPa"] == pytest.approx(0.28)
    assert summary[1]["our_sd_epidermis_modulus_MPa"] is None


# ---- figures ----


def every_figure() -> list[Figure]:
    z = np.linspace(-3.0, 3.0, 7)
    bell = np.exp(-(z**2))
    profile = [
        {
            "depth_mm": d,
            "distance_mm": float(x),
            "measured_mm": d * float(b),
            "predicted_mm": d * float(b) + 0.01,
        }
        for d in (0.5, 1.0)
        for x, b in zip(z, bell, strict=True)
    ]
    force = [
        {"series": "a", "displacement_mm": d, "measured_N": d**1.4, "predicted_N": d} for d in (0.5, 1.0)
    ]
    rate = [{"stimulus": "bar", "position_mm": float(x), "measured_Hz": 9.0, "predicted_Hz": 8.0} for x in z]
    layer = [
        {"panel": panel, "model": model, "distance_mm": float(x), "deflection": float(b)}
        for panel, model in (("", "m43338"), ("layer 1", "m53338"), ("layer 2", "m44338"))
        for x, b in zip(z, bell, strict=True)
    ]
    modulus = [{"name": "point 1", "value_MPa": 0.3, "lower_MPa": None, "upper_MPa": None, "paper_MPa": 0.28}]
    tip = [{"radius_mm": r, "slope_MPa_per_gf": 0.05 / r, "ratio": 6.0} for r in (0.1, 0.5)]
    path = [{"step": k, "chi2": 9.0, "gradient": 10.0**-k, "accepted": True} for k in range(3)]
    seen = [
        {"measurement": "line", "observation": k, "parameter": "rate", "per_log_sigma": 1.0 * k}
        for k in (1, 2)
    ]
    return [
        figures.profiles(profile),
        figures.force_displacement(force),
        figures.rates(rate),
        figures.moduli(modulus),
        figures.layer_study(layer),
        figures.tip_radius(tip, 0.0523, 5.7),
        figures.correlations({"a": {"a": 1.0, "b": None}, "b": {"a": None, "b": 1.0}}),
        figures.sensitivities(seen),
        figures.fit_path(path),
    ]


def test_every_figure_is_drawn_from_its_rows_and_the_same_each_time() -> None:
    first, second = every_figure(), every_figure()
    assert len({figure.name for figure in first}) == len(first)
    for one, other in zip(first, second, strict=True):
        assert one.svg == other.svg
        assert one.svg.lstrip().startswith("<?xml") and "</svg>" in one.svg
        assert one.caption.endswith(".")
        assert one.rows


# ---- the page ----


class Fetched(HTMLParser):
    """Collects every address that a browser would fetch, and every visible text."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attributes if name in ("src", "href")]

    def handle_data(self, data: str) -> None:
        self.text += data


def test_the_page_is_self_contained_and_says_the_verdict_first() -> None:
    results = [study_result("one"), study_result("two", warnings=["The noise was <assumed>."])]
    text = page(results, "A run")
    seen = Fetched()
    seen.feed(text)
    assert seen.addresses and all(a.startswith(("data:image/svg+xml;base64,", "#")) for a in seen.addresses)
    assert "url(" not in text and "@import" not in text and "<script" not in text
    section = seen.text[seen.text.index("study two") :]
    verdict = section.index("epidermis.modulus = 4")
    assert (
        verdict < section.index("The noise was <assumed>.") < section.index("Parameters, with 95 % intervals")
    )
    assert "8512 nodes, 40100 elements; minimum dihedral deg 12.3" in section
    assert "Layer ratios from <profiles>" in seen.text


def test_a_page_without_a_fit() -> None:
    bare = StudyResult("layers", "Layer study", "All three findings hold.", created="now")
    text = page([bare])
    assert "All three findings hold." in text and "<nav>" not in text


def test_what_a_reader_must_know_first() -> None:
    told = words.warnings(decay("assumed"), uncertainty(decay("assumed")))
    assert "was assumed, not measured" in told[0]
    poor = decay(sigma=0.001)
    assert "times the stated noise" in words.warnings(poor, uncertainty(poor))[0]
    fine = decay(sigma=0.02)
    assert words.warnings(fine, uncertainty(fine)) == []


def test_columns_keep_the_order_in_which_they_come() -> None:
    assert Table("t", "T", [{"b": 1}, {"a": 2, "b": 3}]).columns == ["b", "a"]
