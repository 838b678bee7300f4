"""The score of diagnoses is right about made-up reports, whose score is known."""

from __future__ import annotations

import copy
import dataclasses
import json

import numpy as np
import pytest

from benchmarks import blind
from benchmarks._record import table as printed
from tests.blind import score

TRUTH = {
    "case": "contact_offset",
    "kind": "single",
    "families": ["contact_offset"],
    "lambda": 150.0,
    "lambda_of_each": {},
    "moduli_MPa": {"epidermis": 0.16, "dermis": 0.02},
    "moduli_scored": True,
    "rows": {
        "plate": {
            "coordinates": {"displacement": [0.5, 1.0, 1.5], "time": [1.0, 2.0, 3.0], "condition": ["plate"] * 3},
            "clean": [0.1, 0.2, 0.4],
            "sigma": [0.01] * 3,
            "held_out": [False, True, True],
        }
    },
}


def report(kind: str = "attributed", families: tuple[str, ...] = ("contact_offset",), **verdict) -> dict:
    """A diagnosis of which the plain model was rejected; two trials in its rows, the second one backwards."""
    travel, before, after = [0.5, 1.0, 1.5], [0.1, 0.24, 0.44], [0.1, 0.21, 0.41]
    loop = {
        "base": {
            "theta": {"epidermis.modulus": {"value": 0.2, "sd": 0.01}, "dermis.modulus": {"value": 0.02, "sd": 0.001}},
            "lof": {"omnibus_p": 0.2, "smooth_p": 0.001, "maxT_p": 1e-6},
        },
        "critical": {"alpha": 0.05},
        "set": list(families),
        "verdict": {"kind": kind, "families": list(families), "absorbed": [], **verdict},
        "after": {
            "theta": {"epidermis.modulus": {"value": 0.16, "ci": [0.15, 0.17]}, "dermis.modulus": {"value": 0.021, "ci": [0.0205, 0.0215]}}
        },
        "rows": {
            "plate": {
                "coordinates": {"displacement": travel + travel[::-1]},
                "role": ["fit", "veto", "report", "report", "veto", "fit"],
                "before": before + before[::-1],
                "after": after + after[::-1],
            }
        },
    }
    return {"loop": loop}


def truth(**changes) -> dict:
    return {**copy.deepcopy(TRUTH), **changes}


def test_wilson_is_the_published_interval():
    """Newcombe 1998, table I: 81 of 263 is 0.2553 to 0.3662, 0 of 20 is 0 to 0.1611, 1 of 29 is 0.0061 to 0.1718."""
    assert score.wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert score.wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert score.wilson(1, 29) == pytest.approx((0.0061, 0.1718), abs=5e-5)
    assert score.wilson(0, 0) == (0.0, 1.0)


def test_an_attribution_is_judged():
    one = score.judge(report(), truth())
    assert one.found and not one.wrong and one.rejected
    assert one.named == ("contact_offset",) and one.verdict == "attributed"
    assert one.covered == ((False, True), (True, False))
    sd = np.log(0.0215 / 0.0205) / 3.92
    assert one.off == pytest.approx((0.0, np.log(1.05) / sd))


def test_held_out_error_is_against_noise_free_truth():
    """Errors of 0.04 and 0.01 N in every kept row, over the largest reading of 0.4 N."""
    assert score.judge(report(), truth()).held_out == pytest.approx((0.1, 0.025))


def test_held_out_rows_are_found_by_role_where_the_study_kept_none():
    right = truth()
    right["rows"]["plate"]["held_out"] = [False] * 3
    assert score.judge(report(), right).held_out == pytest.approx((0.1, 0.025))
    said = report()
    said["loop"]["rows"]["plate"]["role"] = "fit"
    assert score.judge(said, right).held_out is None


def test_rows_in_the_order_of_the_file_need_no_more_to_be_known():
    """Two shapes of indenter at the same places, whose names the report leaves out."""
    right, said = truth(), report()
    said["loop"]["rows"]["plate"] |= {"before": [0.1, 0.24, 0.44] * 2, "after": [0.1, 0.21, 0.41] * 2, "role": "fit"}
    said["loop"]["rows"]["plate"]["coordinates"] = {"travel": [0.5, 1.0, 1.5] * 2}
    assert score.judge(said, right).held_out == pytest.approx((0.1, 0.025))
    right["rows"]["plate"]["coordinates"]["displacement"] = [0.5, 1.0, 1.0]
    said["loop"]["rows"]["plate"]["coordinates"] = {"travel": [1.0, 0.5, 1.0] * 2}
    with pytest.raises(ValueError, match="share displacement"):
        score.judge(said, right)


def test_undefined_predictions_are_not_scored():
    said = report()
    said["loop"]["rows"]["plate"]["after"] = [None] * 6
    assert score.judge(said, truth()).held_out is None


def test_rows_that_the_truth_does_not_know_are_refused():
    said = report()
    said["loop"]["rows"]["plate"]["coordinates"]["displacement"][0] = 0.6
    with pytest.raises(ValueError, match="does not know"):
        score.judge(said, truth())


@pytest.mark.parametrize(
    ("kind", "families", "found", "wrong", "first"),
    [
        ("attributed", ("nail_compliance",), False, True, False),
        ("ambiguous", ("nail_compliance", "contact_offset"), True, False, False),
        ("mainly contact_offset", ("contact_offset",), True, False, True),
        ("unexplained", (), False, False, False),
        ("adequate", (), False, False, False),
    ],
)
def test_verdicts_are_told_apart(kind, families, found, wrong, first):
    one = score.judge(report(kind, families), truth())
    assert (one.found, one.wrong, score._first(one)) == (found, wrong, first)


def test_a_set_beside_an_unexplained_verdict_names_nothing():
    said = report("unexplained", ())
    said["loop"]["set"] = ["contact_offset"]
    assert not score.judge(said, truth()).found


@pytest.mark.parametrize(
    "families", [("relaxation", "nail_compliance"), ("nail_compliance+relaxation",), (["relaxation", "nail_compliance"],)]
)
def test_two_effects_are_both_found(families):
    both = truth(kind="double", families=["nail_compliance", "relaxation"], lambda_of_each={"nail_compliance": 50.0, "relaxation": 90.0})
    one = score.judge(report("two effects", families), both)
    assert one.found
    lines = {line.name: line for line in score.table([one])}
    assert lines["two effects, lambda of each >= 40: both in one set"].count == 1
    half = score.judge(report("attributed", ("relaxation",)), both)
    assert not half.found and not half.wrong


def test_traps_need_the_right_words():
    gain = truth(kind="absorbed", families=["force_gain"])
    listed = score.judge(report("adequate", (), absorbed=[{"family": "force_gain", "combination": "all moduli"}]), gain)
    silent = score.judge(report("adequate", ()), gain)
    coarse = score.judge(report("mesh-limited", ()), truth(kind="mesh_limited", families=[]))
    lines = {line.name: line for line in score.table([listed, silent, coarse])}
    assert lines["taken up by the moduli: listed as absorbed, nothing named"].value == 0.5
    assert lines["mesh too coarse: said to be"].value == 1.0


def test_a_null_is_rejected_where_a_test_is_below_its_share_of_the_level():
    null = truth(kind="none", families=[], **{"lambda": 0.0})
    said = report("adequate", ())
    for omnibus, largest, rejected in ((0.021, None, False), (0.019, None, True), (0.5, 0.011, False), (0.5, 0.009, True)):
        said["loop"]["base"]["lof"] = {"omnibus_p": omnibus, "smooth_p": 0.5, "maxT_p": largest}
        assert score.judge(said, null).rejected is rejected
    said["loop"]["base"]["lof"] = None
    assert not score.judge(said, null).rejected


def test_the_table_counts():
    right, wrong = score.judge(report(), truth()), score.judge(report("attributed", ("adhesion",)), truth())
    missed = score.judge(report("adequate", ()), truth(**{"lambda": 7.0}))
    stranger = score.judge(report("unexplained", ()), truth(kind="outside", families=[]))
    lines = {line.name: line for line in score.table([right, right, right, wrong, missed, stranger])}
    strong = lines["one effect, lambda >= 40: among the explanations"]
    assert (strong.value, strong.count) == (0.75, 4)
    assert (strong.low, strong.high) == pytest.approx(score.wilson(3, 4))
    assert lines["one effect, lambda >= 20: another named, the right one nowhere"].value == 0.25
    assert lines["one effect, lambda 5-10: among the explanations"].value == 0.0
    assert lines["outside the catalogue, detected: unexplained"].value == 1.0
    assert lines["held-out error removed"].value == pytest.approx(0.75)
    assert lines["moduli within their intervals after"].value == 0.5
    assert np.isnan(lines["no effect: an effect named"].value)


def test_what_is_foretold_better_is_also_counted_for_single_effects_alone():
    one = score.judge(report(), truth())
    two = dataclasses.replace(one, kind="double", held_out=(0.3, 0.3))
    unnamed = dataclasses.replace(one, named=(), held_out=(0.9, 0.9))
    lines = {line.name: line for line in score.table([one, two, unnamed])}
    assert lines["one effect: held-out error removed"].value == pytest.approx(0.75)
    assert lines["held-out error removed"].value == pytest.approx(1 - 0.325 / 0.4)


def test_figures_say_goals_and_leave_out_what_was_not_seen():
    right, wrong = score.judge(report(), truth()), score.judge(report("attributed", ("adhesion",)), truth())
    figures = {one.figure: one for one in blind.figures([right, wrong], ["lost-0.02-1"])}
    assert figures["diagnoses that broke off"].met is False
    assert figures["one effect, lambda >= 40: named first"].met is False
    assert figures["held-out error removed"].goal == ">= 0.9"
    assert "no effect: an effect named" not in figures
    assert "95 % interval" in printed(list(figures.values()))


def test_finished_diagnoses_are_kept_and_other_laboratories_or_programs_are_diagnosed_again(tmp_path, monkeypatch):
    lab, runs = tmp_path / "lab", []
    lab.mkdir()
    (lab / "experiments.yaml").write_text("version: 1")

    def ended(command, log) -> bool:
        runs.append(command)
        (tmp_path / "report").mkdir(exist_ok=True)
        (tmp_path / "report" / "report.json").write_text(json.dumps({"run": len(runs)}))
        return True

    monkeypatch.setattr(blind, "_ended", ended)
    assert blind.diagnosed(tmp_path) == blind.diagnosed(tmp_path) == {"run": 1}
    (lab / "experiments.yaml").write_text("version: 1 ")
    assert blind.diagnosed(tmp_path) == {"run": 2}
    assert runs[0][1:4] == ["-m", "fingerjax", "diagnose"]
    monkeypatch.setattr(blind, "program", lambda: "another program")
    assert blind.diagnosed(tmp_path) == blind.diagnosed(tmp_path) == {"run": 3}
    monkeypatch.setattr(blind, "_ended", lambda command, log: False)
    (lab / "experiments.yaml").write_text("version: 2")
    assert blind.diagnosed(tmp_path) is None


def test_the_page_tells_every_laboratory():
    """A row each, with what is behind it, the verdict, and whether that is among the explanations."""
    other = truth(case="hysteresis", families=["hysteresis"])
    first, second = (score.judge(report(), one) for one in (truth(), other))
    kept = {"full": {"a": score.Scored(first, "01234567", 12.0, "aa00"), "b": score.Scored(second, "89abcdef", 3.04, "bb11")}, "thin": {}}
    told = blind.page(kept)
    assert "| contact_offset | single: contact_offset | 150 | rejected | attributed | contact_offset | yes |" in told
    assert "| hysteresis | single: hysteresis | 150 | rejected | attributed | contact_offset | no |" in told
    assert "| 12.0 | 01234567 | aa00 |" in told and "2 draws of 2 of the" in told
    assert "by 2 states of the program: 01234567, 89abcdef; 2 states of the truths' numerics: aa00, bb11." in told
    assert "## Meshes and rows in full" in told and "## Coarse studies" not in told


def test_what_one_run_scored_stands_beside_what_the_next_one_does(tmp_path):
    """Outcomes are written down whole; a section of another heading stays."""
    file = tmp_path / "blind.json"
    one = score.Scored(score.judge(report(), truth()), "01234567", 12.0, "aa00")
    assert blind.remembered(file) == {"full": {}, "thin": {}}
    blind.remember(file, {"full": {"a": one}, "thin": {}})
    kept = blind.remembered(file)
    assert kept["full"] == {"a": one}
    kept["thin"]["b"] = one
    blind.remember(file, kept)
    told = blind.page(blind.remembered(file), "# Old\n\n## Coarse studies with few rows\n\nold\n\n## By hand\n\nstays\n")
    assert told.index("## Meshes") < told.index("## Coarse") < told.index("## By hand\n\nstays") and "old" not in told
