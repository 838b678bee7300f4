"""What is no larger than any model's own error is not named, however many readings speak for it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np
import pytest
from loop_toy import Toy

from fingerjax.loop.adequacy import look
from fingerjax.loop.diagnosis import diagnose, investigate
from fingerjax.loop.findings import Findings
from fingerjax.loop.material import times_form
from fingerjax.loop.refit import forget
from fingerjax.loop.subject import NONE
from fingerjax.loop.writing import written
from fingerjax.report.loop_tables import remark

NOISE = 0.004  # next to nothing beside what models are wrong by


TRIED = ("camera_scale", "profile_tilt", "contact_offset", "friction")


def toy_wrong_by(share: float, size: float, more: Mapping[str, float] = NONE) -> Toy:
    """A camera whose scale is off by `size`, where models are said to be wrong by a share of each reading. `more`: other effects."""
    toy = Toy(truth={"camera_scale.scale": size, **more}, noise=NOISE)
    toy.rows = dataclasses.replace(toy.rows, form=share * np.abs(toy.exact[toy.index]))
    return toy


@pytest.fixture(scope="module")
def better() -> Findings:
    """Of models that are said to be right to one per cent."""
    silent = {"tell": lambda share, what: None, "kept": forget}
    return investigate(toy_wrong_by(0.01, 0.026), seed=0, effects=TRIED, alpha=0.05, sets=0, **silent)  # type: ignore[arg-type]


def test_a_change_is_measured_on_the_trace_where_it_is_largest() -> None:
    toy = Toy(repeats=1)
    chosen = np.ones(len(toy.rows), dtype=bool)
    trace = toy.rows.condition == "bar 1"
    change = np.where(trace, 3.0, 0.2)
    one = np.ones(len(toy.rows))
    assert times_form(toy.rows, chosen, change) == math.inf
    rows = dataclasses.replace(toy.rows, form=2 * one)
    assert times_form(rows, chosen, change) == pytest.approx(1.5)
    assert times_form(rows, ~trace, change) == pytest.approx(0.1)
    assert times_form(rows, chosen, 0 * one) == 0.0
    assert times_form(dataclasses.replace(rows, form=np.where(trace, 0.0, 2.0)), chosen, change) == math.inf


def test_an_effect_within_what_models_are_wrong_by_is_seen_but_not_named() -> None:
    found = diagnose(toy_wrong_by(0.02, 0.026), effects=TRIED, sets=0)
    first = found.candidates[0]
    assert first.family == "camera_scale" and first.z > found.critical.maxT and 0.5 < first.times_form < 1.0
    assert found.verdict.kind == "adequate" and not found.verdict.families and first.refit is None
    assert "could be camera_scale: not named" in found.verdict.text
    assert remark(dataclasses.asdict(first)) == "smaller than what any model is wrong by"
    assert first.mde > 0.026  # what could not be named was not visible


def test_the_same_effect_is_named_where_models_are_said_to_be_better(better: Findings) -> None:
    found = written(better)
    first = found.candidates[0]
    assert first.times_form > 1.0 and found.verdict.kind == "attributed" and found.verdict.families == ["camera_scale"]
    assert remark(dataclasses.asdict(first)) == "" and first.mde < 0.026


def test_a_refit_that_changes_no_measurement_enough_is_no_explanation(better: Findings) -> None:
    (named,) = better.verdict.members
    assert named.sound and named.times_form > 1.0 and named.reason == ""
    smaller = dataclasses.replace(named, times_form=0.9)
    assert not smaller.sound and not smaller.in_set and smaller.reason == "changes no measurement by more than any model is wrong by"


def test_an_explanation_must_leave_nothing_that_looks_like_an_effect_however_small() -> None:
    toy = toy_wrong_by(0.02, 0.03, {"contact_offset.offset": 0.06})
    found = investigate(toy, seed=0, effects=TRIED, alpha=0.05, sets=0, tell=lambda share, what: None, kept=forget)
    alone = next(one for one in found.explanations if one.families == ("contact_offset",))
    left = alone.look.ranking["camera_scale"]
    assert left.statistic == alone.look.ranking.largest_of_all > alone.look.critical.value and not left.matters
    others = [family for family in found.families if family.name != "contact_offset"]
    as_base = look(alone.best, others, alpha=0.05, seed=0)
    assert not as_base.adequacy.resembles and alone.look.adequacy.resembles
    assert alone.sound and not alone.in_set and alone.reason == "leaves something to be explained"


def test_an_explanation_leaves_no_significant_score_though_a_model_is_rejected_for_rarer_ones_only() -> None:
    toy = toy_wrong_by(0.02, 0.024, {"contact_offset.offset": 0.06})
    found = investigate(toy, seed=0, effects=TRIED, alpha=0.05, sets=0, tell=lambda share, what: None, kept=forget)
    first = found.explanations[0]
    left = first.look.adequacy
    assert first.families == ("contact_offset",) and 0.01 < left.largest_p < 0.05
    assert first.look.ranking["camera_scale"].statistic > first.look.critical.value and not left.bends
    assert left.rejected and first.sound and not first.in_set and first.reason == "leaves something to be explained"
    assert found.verdict.kind == "mainly" and found.verdict.members == (first,)
    assert not dataclasses.replace(found.base.adequacy, omnibus_p=1.0, smooth_p=1.0, largest_p=left.largest_p).rejected
