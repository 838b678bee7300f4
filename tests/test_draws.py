"""Verdicts counted with a straight model: it is the model's tangent, and is diagnosed as the model is."""

from __future__ import annotations

import numpy as np
import pytest
from loop_toy import Toy

from benchmarks.draws import Straight
from fingerjax.loop.diagnosis import investigate
from fingerjax.loop.meshguard import correction
from fingerjax.loop.refit import forget
from fingerjax.loop.subject import NONE


def diagnosed(subject):
    return investigate(subject, seed=0, effects="all", alpha=0.05, sets=0, tell=lambda *_: None, kept=forget)


def test_it_is_the_tangent_of_the_model_and_of_its_effects_and_what_the_mesh_adds_is_the_same() -> None:
    toy = Toy(mesh=0.02)
    straight, step, key = Straight.of(toy), 1e-4 * np.array([1.0, -1.0, 0.5, 1.0, -0.5]), "force_offset.offset"
    here, there = (straight.model.evaluate(straight.raw + moved, NONE, ()).prediction for moved in (0.0, step))
    assert np.linalg.norm(there - here) > 1e-5
    np.testing.assert_allclose(straight.evaluate(straight.raw + step, NONE, ()).prediction - here, there - here, rtol=1e-2, atol=1e-8)
    awake = straight.evaluate(straight.raw, {key: 0.003}, (key,))
    np.testing.assert_allclose(awake.prediction - here, 0.003 * toy.columns(straight.raw)[key], atol=1e-12)
    np.testing.assert_array_equal(awake.phi_jacobian[:, 0], toy.columns(straight.raw)[key])
    own, of_toy = correction(straight, straight.raw + step, NONE), correction(toy, straight.raw, NONE)
    assert own is not None and of_toy is not None and np.abs(of_toy.offset).max() > 1e-4
    np.testing.assert_allclose(own.offset, of_toy.offset, atol=1e-10)


@pytest.mark.parametrize("truth", [{}, {"force_offset.offset": 0.004}])
def test_its_verdict_is_that_of_the_model(truth: dict[str, float]) -> None:
    toy = Toy(truth=truth)
    straight = Straight.of(toy)
    same, wanted = diagnosed(straight), diagnosed(toy)
    assert (same.verdict.kind, same.verdict.names) == (wanted.verdict.kind, wanted.verdict.names)
    assert same.base.adequacy.misfit == pytest.approx(wanted.base.adequacy.misfit, rel=1e-3)
    assert bool(same.verdict.names) == bool(truth)
