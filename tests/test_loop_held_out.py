"""What conditions that nothing has seen say of the model that was found to be enough."""

from __future__ import annotations

import numpy as np
from loop_toy import FAMILIES, GRID, Toy

from fingerjax.loop.diagnosis import diagnose

UNSEEN = {"plate 1.5": "report", "line 1.5": "report"}
FEW = tuple(family for family in FAMILIES if family.name in ("contact_offset", "force_offset"))


def found(effects="all", **more):
    return diagnose(Toy(roles=UNSEEN, families=FEW, **more), effects=effects, sets=0).verdict


def stiffer_where_nobody_looked():
    parts = [np.where(np.array(condition) == "plate 1.5", 0.03, 0.0) for condition, _ in GRID.values()]
    return np.concatenate(parts)


def test_by_chance_they_speak_against_a_right_model_as_seldom_as_they_should():
    p = np.array([found("none", seed=seed).held_out_p for seed in range(12)])
    assert p.min() > 1e-3
    assert 0.3 < p.mean() < 0.7  # by a uniform law 0.5


def test_a_model_that_fits_but_does_not_foretell_is_told_to_be_contradicted():
    verdict = found(outside=stiffer_where_nobody_looked)
    assert verdict.kind == "adequate" and verdict.held_out_p < 1e-6
    assert "plate 1.5" in verdict.text and "speaks against it" in verdict.text
    right = found()
    assert right.held_out_p > 1e-3 and "speaks against it" not in right.text


def test_they_choose_nothing():
    """An effect that the fitted conditions ask for is named although what was held out contradicts it, and that is said."""
    verdict = found(truth={"contact_offset.offset": 0.08}, outside=stiffer_where_nobody_looked)
    assert list(verdict.families) == ["contact_offset"] and "speaks against it" in verdict.text


def test_where_nothing_was_held_out_nothing_is_said():
    every = {"point 1": "fit"}
    verdict = diagnose(Toy(roles=every, families=FEW), sets=0).verdict
    assert verdict.held_out_p is None
