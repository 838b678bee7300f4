"""What a diagnosis looks like: the page, its pictures and tables say what the record says, for each kind of verdict."""

from __future__ import annotations

import csv
import json
import math
import re
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnosis_records import ACTS_ON, KINDS, NAMED, TEXT, record

from fingerjax._results import RESULTS
from fingerjax.report import StudyResult, loop_figures, loop_tables, loop_words
from fingerjax.report.loop_page import PLANS, chapters, result
from fingerjax.report.loop_record import NORMAL, blocks, candidates, error_rows, interval, kind, number
from fingerjax.report.loop_residuals import remainder, residuals
from fingerjax.report.loop_words import spoken
from fingerjax.report.page import page
from fingerjax.report.records import RunFolder, plain, run_record
from fingerjax.report.tables import shown


class Seen(HTMLParser):
    """The visible text of a page, and every address in it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.text, self.addresses, self.anchors = "", [], []
        self.feed(text)
        self.text = " ".join(self.text.split())

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attributes if name in ("src", "href")]
        self.anchors += [value or "" for name, value in attributes if name == "id"]

    def handle_data(self, data: str) -> None:
        self.text += data + " "


def seen(said: dict[str, Any]) -> Seen:
    return Seen(page([result(said, "mine", "What the model of mine lacks", created="now")]))


@cache
def done(what: str) -> StudyResult:
    """The result of a kind of record, drawn once for all tests that change nothing in it."""
    return result(record(what), "mine", "What the model of mine lacks", created="now")


@cache
def text_of(what: str) -> Seen:
    return Seen(page([done(what)]))


# ---- the verdict ----

SENTENCES = {
    "attributed": TEXT["attributed"],
    "ambiguous": TEXT["ambiguous"],
    "two effects": "The model lacks both nail compliance and contact offset, which explains 98.1 % of the misfit beyond noise.",
    "mainly": "The model mainly lacks nail compliance, which explains 98.1 % of the misfit beyond noise; a small part remains",
    "unexplained": "The model misses something that no effect in the catalogue explains.",
    "adequate": "The model as it stands explains these measurements to within their noise.",
    "not testable": "These measurements cannot test any of the effects",
    "mesh-limited": "The mesh is too coarse for this question",
    "noise unknown": "The noise of these measurements is not known well enough",
}
ADVICE = {
    "attributed": "Use the parameters after the effect was added.",
    "ambiguous": "make the next experiment before choosing",
    "two effects": "harder to be sure of two effects",
    "mainly": "what remains is drawn below",
    "unexplained": "Do not take the parameters for properties of the tissue",
    "adequate": "What could have hidden from these measurements is listed below.",
    "not testable": "Measure under other conditions",
    "mesh-limited": "Make the mesh finer",
    "noise unknown": "Repeat each condition at least three times",
}


@pytest.mark.parametrize("what", KINDS)
def test_each_verdict_is_one_sentence_at_the_top_and_what_to_do(what: str) -> None:
    told = text_of(what).text
    assert SENTENCES[what] in told
    assert ADVICE[what] in told
    first = told.index(SENTENCES[what])
    assert first < told.index(ADVICE[what]) < told.index(PLANS["errors"].title + " Error is")


@pytest.mark.parametrize("what", KINDS)
def test_the_page_of_each_verdict_needs_no_other_file(what: str) -> None:
    found = text_of(what)
    inside = [address for address in found.addresses if address.startswith("#")]
    assert all(address.removeprefix("#") in found.anchors for address in inside)
    assert len(inside) == len(PLANS)
    assert all(address.startswith(("data:image/svg+xml;base64,", "#")) for address in found.addresses)
    assert "None" not in found.text and "nan" not in re.findall(r"\w+", found.text)


def test_nothing_is_named_where_nothing_may_be() -> None:
    for what in ("unexplained", "adequate", "not testable", "mesh-limited", "noise unknown"):
        said = record(what)
        assert not any(row["in_the_set"] for row in loop_tables.effects(said).rows)
        assert "nail compliance" not in loop_words.verdict(said)


def test_the_page_says_how_much_of_the_misfit_looks_like_the_mesh() -> None:
    said = record("mesh-limited")
    (line,) = (line for line in loop_words.about_mesh(said) if "looks like it" in line)
    assert "misfit beyond the noise is 210" in line and "would make 400" in line and "62 % of the misfit" in line
    assert "first order" not in line
    hardly = {**said["model"]["mesh"], "as_first_order": 1600.0}
    assert any("would make 400 (1600 if the mesh" in line for line in loop_words.about_mesh({"model": {"mesh": hardly}}))
    for missing in ("misfit", "as_corrected"):
        mesh = {**said["model"]["mesh"], missing: None}
        assert not any("looks like it" in line for line in loop_words.about_mesh({"model": {"mesh": mesh}}))


def test_absorbed_effects_stand_beside_the_moduli() -> None:
    tables = [table for table in done("adequate").tables if table.chapter == "parameters"]
    assert [table.name for table in tables] == ["loop_parameters", "loop_absorbed"]
    assert tables[1].rows == [{"effect": "force gain", "hidden_by_a_change_of": "all moduli +10 %"}]
    warned = loop_words.warnings(record("adequate"))
    assert any("cannot see force gain" in one for one in warned)
    assert loop_words.warnings(record("adequate", verdict={"kind": "adequate", "families": [], "absorbed": []})) == []


def test_a_fit_that_did_not_converge_shows_no_value() -> None:
    said = record("adequate")
    said["base"] |= {"converged": False, "reason": "stuck"}
    said["verdict"] |= {"kind": "not converged", "text": ""}
    found = result(said, "mine", "Mine")
    assert found.result is RESULTS.no_optimum and not found.converged
    assert found.fit is not None and found.fit["solver"]["reason"] == "stuck"
    assert all(one["value"] is None and one["ci95"] == [None, None] for one in found.fit["parameters"].values())
    assert "did not converge" in found.verdict
    assert {table.chapter for table in found.tables} == {"mesh", "noise"} and not found.figures
    assert "0.121" not in seen(said).text


def test_what_a_record_lacks_is_left_out() -> None:
    bare = {"verdict": {"kind": "noise unknown", "families": [], "text": "Nothing is known."}, "base": {}, "set": []}
    text = seen(bare).text
    assert "Nothing is known." in text
    assert [len(one.figures) + len(one.tables) for one in chapters(bare)] == [0] * len(PLANS)


# ---- numbers ----


def test_errors_are_those_of_the_rows() -> None:
    said = record("attributed")
    rows = {(row["measurement"], row["used"]): row for row in error_rows(said)}
    line = {key: np.array(value) for key, value in said["rows"]["line"].items() if key not in ("unit", "coordinates")}
    held = line["role"] == "veto"
    after = (line["measured"] - line["after"])[held]
    row = rows["line", "held out, as a check"]
    assert row["rows"] == held.sum() == 45
    assert row["after_share_of_data"] == pytest.approx(np.sqrt(np.mean(after**2) / np.mean(line["measured"] ** 2)))
    assert row["after_over_noise"] == pytest.approx(np.sqrt(np.mean((after / 0.01) ** 2)))
    assert row["after_over_noise"] == pytest.approx(1.0, abs=0.3) and row["before_over_noise"] > 1.5
    assert set(rows) == {
        ("line", "fitted"), ("line", "held out, as a check"), ("plate", "fitted"), ("hold", "fitted"), ("bar", "held out, untouched"),
    }  # fmt: skip


def test_every_number_of_the_ranking_is_on_the_page() -> None:
    said = record("attributed")
    text = text_of("attributed").text
    for one in said["candidates"]:
        assert one["family"].replace("_", " ") in text
        assert shown(one["z"]) in text and shown(one["mde"]) in text
    nail = said["candidates"][0]["refit"]
    assert shown(nail["delta"]) in text and "0.21 (0.17 to 0.25)" in text
    assert "leaves a trace of nail_compliance" in text
    assert "absorbed: every modulus 10 % higher does the same" in text
    assert "(2.82)" in text and "In 200 simulated data sets from which nothing is missing" in text


def test_parameters_have_units_intervals_and_what_the_fit_moves() -> None:
    said = record("two effects")
    rows = {row["parameter"]: row for row in loop_tables.parameters(said).rows}
    modulus, base = rows["epidermis.modulus"], said["base"]["theta"]["epidermis.modulus"]
    later = said["after"]["theta"]["epidermis.modulus"]
    assert (modulus["before"], modulus["after"], modulus["unit"]) == (base["value"], later["value"], "MPa")
    assert [modulus["after_lower"], modulus["after_upper"]] == later["ci"]
    assert modulus["raw_before"] == pytest.approx(math.log(base["value"]))
    assert modulus["change_over_sd"] == 3.1 and modulus["mesh"] == base["mesh_sd"]
    nail = rows["nail compliance: depth"]
    assert (nail["before"], nail["after"], nail["unit"]) == (None, 0.21, "mm/N")
    assert [nail["after_lower"], nail["after_upper"]] == pytest.approx([0.168, 0.252])
    assert "contact offset: offset" in rows


def test_an_interval_is_the_stated_one_or_comes_from_the_sd() -> None:
    assert interval({"value": 1.0, "sd": 0.1, "ci": [0.7, 1.2]}) == (0.7, 1.2)
    assert interval({"value": 1.0, "sd": 0.1}) == pytest.approx((0.804, 1.196), abs=1e-3)
    assert all(math.isnan(end) for end in interval({"value": 1.0, "sd": None}))
    assert all(math.isnan(end) for end in interval({"value": 1.0, "sd": 0.1, "ci": [None, None]}))


def test_a_family_of_several_columns_is_told_by_the_one_that_stands_out() -> None:
    one = {"family": "friction", "epc": {"friction.mu": -0.2, "friction.rate": 1.0}, "prior_sd": {"friction.mu": 0.1, "friction.rate": 4.0}}
    assert loop_tables.size_of(one) == (-0.2, 0.1)
    told = loop_tables.fitted_sizes(one, {"phi": {"friction.mu": 0.3, "friction.rate": 1.0}, "ci": {"friction.mu": [0.1, 0.5]}})
    assert told == "mu 0.3 (0.1 to 0.5), rate 1"


def test_both_of_a_pair_are_marked() -> None:
    rows = {row["effect"]: row for row in loop_tables.effects(record("two effects", set=["nail_compliance + contact_offset"])).rows}
    assert rows["nail compliance"]["in_the_set"] and rows["contact offset"]["in_the_set"] and not rows["tip radius"]["in_the_set"]


def test_a_terminal_shows_what_explains_the_data_first_with_its_fitted_size() -> None:
    said = record("attributed")
    fitted, beside, slight = (said["candidates"][number] for number in (0, 1, 3))
    fitted["z"], beside["refit"]["reason"] = 3.6, "was given up: it promised no more than chance explains"
    table = loop_tables.outlook(said, 4)
    assert table.rows[0]["effect"] == spoken("nail_compliance") and len(table.rows) == 4
    assert table.rows[0]["size"] == "0.21 (0.17 to 0.25) mm/N" and table.rows[0]["remark"] == "explains these data"
    rows = {row["effect"]: row["remark"] for row in loop_tables.outlook(said, 99).rows}
    assert rows[spoken(beside["family"])] == "far behind: given up"
    assert rows[spoken(slight["family"])] == "no more than chance"
    assert rows["force gain"].startswith("absorbed")
    assert table.note == f"{len(said['candidates']) - 4} more in the report"


def test_a_trace_that_fits_the_wrong_way_round_speaks_for_nothing() -> None:
    said = record("attributed")
    said["candidates"][1] |= {"z": -9.8, "epc": {"bed_compliance.size": -0.07}, "bound": {"bed_compliance.size": [0.0, 0.3]}}
    rows = loop_figures.effect_rows(said)
    assert [row["effect"] for row in rows][-2:] == ["bed compliance", "force gain"]
    assert [row["effect"] for row in rows if not row["possible"]] == ["bed compliance"]
    assert rows[-2]["score"] == -9.8 and rows[-2]["remark"].startswith("the wrong way round")


def test_experiments_that_tell_nothing_apart_are_called_so() -> None:
    said = record("ambiguous")
    assert not any("None of those" in one for one in loop_words.about_alike(said))
    said["next_experiment"] = said["next_experiment"][:1]
    said["next_experiment"][0]["d2_after"] = 0.5
    assert "None of those considered gets there: the best reaches 0.5." in " ".join(loop_words.about_alike(said))


def test_the_ranking_puts_what_could_not_be_tested_last() -> None:
    said = record("attributed")
    names = [one["family"] for one in candidates(said)]
    assert names[0] == "nail_compliance" and names[-1] == "force_gain"
    scores = [abs(number(one["z"])) for one in candidates(said)][:-1]
    assert scores == sorted(scores, reverse=True)


def test_the_record_of_the_fit_is_that_of_the_model_before() -> None:
    said = record("attributed")
    fit = result(said, "mine", "Mine").fit
    assert fit is not None
    modulus = fit["parameters"]["epidermis.modulus"]
    assert modulus["value"] == said["base"]["theta"]["epidermis.modulus"]["value"] and modulus["unit"] == "MPa"
    assert modulus["ci95"] == said["base"]["theta"]["epidermis.modulus"]["ci"]
    assert (fit["chi2"], fit["dof"]) == (1412.5, 318.0)
    assert set(fit["rms"]) == {"line", "plate", "hold"} and set(fit["held_out"]) == {"line", "bar"}
    assert fit["rms"]["plate"]["noise"] == pytest.approx(0.004)


# ---- words ----


def test_text_is_escaped() -> None:
    said = record("attributed")
    said["verdict"]["text"] = "<script>alert('x')</script> & more"
    said["candidates"][3]["reason"], said["candidates"][3]["testable"] = "<b>not $here$</b>", False
    said["rows"]["<i>plate</i> $x$"] = said["rows"].pop("plate")
    text = page([result(said, "mine", "<u>Mine</u>", created="now")])
    for foreign in ("<script", "<b>not", "<i>plate", "<u>Mine"):
        assert foreign not in text
    told = Seen(text).text
    assert "<script>alert('x')</script> & more" in told and "<b>not $here$</b>" in told and "<i>plate</i> $x$" in told


def test_noise_and_mesh_say_what_they_allow() -> None:
    text = text_of("noise unknown").text
    assert "The noise was assumed; whether the model is adequate cannot be said." in text
    stated = record("adequate")
    stated["data"]["noise"] |= {"source": "stated", "allows": ""}
    assert "stands and falls with what was stated" in loop_words.about_noise(stated)[0]
    assert "Noise was measured from repeated readings; 212 degrees of freedom" in text_of("adequate").text
    coarse = text_of("mesh-limited").text
    assert "Mesh guard: not passed, so no small effect is named." in coarse and "has strength 7.4" in coarse
    assert "Mesh guard: passed." in text_of("adequate").text
    assert "9512 -> 61230 nodes" in coarse


def test_planted_effects_and_false_positives_are_told() -> None:
    text = text_of("adequate").text
    assert "Of 3 effects planted in simulated data, 2 were found" in text
    assert "the model was called wrong in 4.5 % (meant: 5 %)" in text


@pytest.mark.parametrize(
    ("said", "means"),
    [("mesh_limited", "mesh limited"), ("Two-effects", "two effects"), ("mainly nail_compliance", "mainly"), (None, "")],
)
def test_a_kind_is_known_however_it_is_spelled(said: Any, means: str) -> None:
    assert kind({"verdict": {"kind": said}}) == means


def test_no_sentence_is_left_half_said() -> None:
    for what in KINDS:
        for plan in PLANS.values():
            for sentence in plan.text(record(what)):
                assert sentence[-1] in ".:" and "unknown" not in sentence, sentence
        assert all(figure.caption.endswith(".") for figure in done(what).figures)


# ---- pictures ----


def test_residuals_are_drawn_where_they_live() -> None:
    found = {block.name: block for block in blocks(record("attributed"))}
    assert {name: block.along for name, block in found.items()} == {
        "line": "distance", "plate": "displacement", "hold": "time", "bar": "position",
    }  # fmt: skip
    assert len(found["line"].series) == 4
    assert list(found["plate"].series) == ["plate"]  # each travel is a condition of one place: joined
    assert len(found["plate"].conditions) == 8


def test_a_measurement_without_coordinates_is_drawn_by_row() -> None:
    said = {"rows": {"odd": {"measured": [1.0, 2.0], "before": [1.0, 1.5], "unit": "N"}}}
    (block,) = blocks(said)
    assert block.along is None and not block.has_after
    assert [row["left_before_N"] for row in residuals(block).rows] == [0.0, 0.5]
    assert residuals(block).rows[0]["left_after_N"] is None


@pytest.mark.parametrize("what", KINDS)
def test_the_rows_of_every_figure_are_the_records(what: str, tmp_path: Path) -> None:
    said = record(what)
    folder = RunFolder(tmp_path / "out")
    folder.keep("key", done(what))
    folder.put_in_place([done(what)], "<html>", run_record([done(what)], ""))
    drawn = {path.stem: list(csv.DictReader(path.read_text().splitlines())) for path in (tmp_path / "out/mine/figures").glob("*.csv")}
    assert {path.stem for path in (tmp_path / "out/mine/figures").glob("*.svg")} == set(drawn)
    line, rows = said["rows"]["line"], drawn["loop_residual_line"]
    assert [float(row["measured_mm"]) for row in rows] == pytest.approx(line["measured"], rel=1e-9)
    assert [float(row["distance_mm"]) for row in rows] == pytest.approx(line["coordinates"]["distance"], rel=1e-9)
    left = np.array(line["measured"]) - np.array(line["after"])
    assert [float(row["left_after_mm"]) for row in rows] == pytest.approx(left, rel=1e-8, abs=1e-12)
    assert [row["condition"] for row in rows] == line["condition"]
    ranked = {row["effect"]: row for row in drawn["loop_effects"]}
    for one in said["candidates"]:
        row = ranked[one["family"].replace("_", " ")]
        assert float(row["score"]) == pytest.approx(one["z"]) and float(row["smallest_visible"]) == pytest.approx(one["mde"])
        assert row["acts_on"] == ACTS_ON[one["family"]] and row["testable"] == str(one["testable"])
        assert row["in_the_set"] == str(one["family"] in NAMED.get(what, []))
    if what == "unexplained":
        smooth = said["unexplained"]["gp"]["bar"]
        assert [float(row["smooth_Hz"]) for row in drawn["loop_remainder_bar"]] == pytest.approx(smooth["mean"], rel=1e-9, abs=1e-12)
        assert float(drawn["loop_remainder_bar"][0]["upper_Hz"]) == pytest.approx(smooth["mean"][0] + NORMAL * smooth["band"][0])
    else:
        assert not [name for name in drawn if name.startswith("loop_remainder")]
    whole = json.loads((tmp_path / "out/report.json").read_text())
    assert whole["loop"] == plain(said)
    assert {"version", "study", "provenance", "fit", "loop"} <= set(whole)
    assert whole["provenance"]["mesh"]["nodes"] == 9512


def test_pictures_are_the_same_each_time() -> None:
    first, second = done("unexplained"), result(record("unexplained"), "mine", "Mine", created="now")
    assert [one.svg for one in first.figures] == [one.svg for one in second.figures]
    assert len({one.name for one in first.figures}) == len(first.figures)


def test_the_smooth_part_lies_on_the_rows_that_were_fitted() -> None:
    said = record("unexplained")
    block = blocks(said)[0]
    smooth = said["unexplained"]["gp"]["line"]
    drawn = remainder(block, smooth)
    assert drawn is not None
    known = [row for row in drawn.rows if row["smooth_mm"] is not None]
    assert [row["smooth_mm"] for row in known] == smooth["mean"] and {row["used"] for row in known} == {"fitted"}
    assert known[0]["upper_mm"] == pytest.approx(smooth["mean"][0] + NORMAL * smooth["band"][0])
    assert remainder(block, {"amplitude": 0.0, "mean": [0.0] * len(known), "band": [0.0] * len(known)}) is None
    assert remainder(block, {"amplitude": 1.0}) is None


def test_a_picture_of_next_experiments_only_where_there_are_any() -> None:
    figure = loop_figures.next_experiments(record("ambiguous"))
    assert figure is not None
    assert [row["apart_after"] for row in figure.rows] == [41.0, 15.5]
    assert loop_figures.next_experiments(record("attributed")) is None


def test_a_page_can_be_made_again_from_what_was_kept() -> None:
    before = done("unexplained")
    again = StudyResult.from_json(json.loads(json.dumps(before.to_json())))
    strip = re.compile(r"\d{4}-\d\d-\d\dT[\d:+]+")
    assert strip.sub("", page([again])) == strip.sub("", page([before]))
