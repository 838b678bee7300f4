"""Starts that agree and starts that do not; leverage, reach and finite changes against what they must be."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from nist import RAT42

from fingerjax.identify import Fit, Problem, fit, multistart
from fingerjax.identify.informs import finite, leverage, leverage_rows, stations
from fingerjax.measurements import Measurement
from fingerjax.parameters import Parameter
from fingerjax.report import figures

from .test_profile import X, problem, straight


def certified() -> Problem:
    parameters = [Parameter(f"b{j}", value, "1", "log", 1e-3, 1e4) for j, value in enumerate((75.0, 2.5, 0.07))]
    return problem(lambda b: RAT42.model(jnp.asarray(RAT42.x), b), np.array(RAT42.y), parameters)


def test_starts_of_a_certified_problem_agree() -> None:
    many = multistart(certified(), 6, spread=0.7)
    assert many.agree and many.best.chi2 == pytest.approx(RAT42.rss, rel=1e-8)
    assert "end at one optimum" in many.verdict()
    assert len(many.rows()) == 6 and np.ptp(many.starts[:, 0]) > 0.7


def test_starts_fitted_at_once_end_where_they_do_in_turn() -> None:
    told: list[float] = []
    once = multistart(certified(), 3, spread=0.7, remake=certified, workers=2, tell=lambda share, doing: told.append(share))
    turn = multistart(certified(), 3, spread=0.7)
    assert told == pytest.approx([1 / 3, 2 / 3, 1.0])
    for one, other in zip(once.fits, turn.fits, strict=True):
        assert one.raw == pytest.approx(other.raw, rel=1e-10) and one.evaluations == other.evaluations and one.settled
    assert once.agree and once.verdict() == turn.verdict()


def test_two_optima_are_told_with_their_starts() -> None:
    def valley(b: list[jax.Array]) -> jax.Array:
        x = jnp.log(b[0])
        return jnp.stack([x**2 - 1.0, 0.1 * (x - 1.0)])

    many = multistart(problem(valley, np.zeros(2), [Parameter("rate", 1.3)]), 8, spread=2.0)
    assert not many.agree and len(many.basins) == 2
    assert many.best.values["rate"] == pytest.approx(math.e, rel=1e-6)
    assert sorted(start for one in many.basins for start in one.starts) == list(range(8))
    low = [row for row in many.rows() if row["basin"] == 1]
    assert all(row["from rate"] > 0.9 for row in low) and "starts disagree: 2 optima" in many.verdict()
    rows = [{**row, "from other": 1.0, "to other": 1.0} for row in many.rows()]
    assert "chi-square" not in figures.basins(rows, "rate", "other").caption


def profile_of(found: Fit) -> Measurement:
    columns = {"depth": np.full(len(X), 1.0), "distance": X, "deflection": np.zeros(len(X))}
    return Measurement("data", "deflection_profile", columns, "deflection", None, {}, "displacement", "z", None, None)


def test_leverage_adds_up_to_the_parameters_and_is_largest_at_the_ends() -> None:
    found = straight()
    each = leverage(found)
    assert each.sum() == pytest.approx(2.0) and np.all((each > 0) & (each < 1))
    assert set(np.argsort(each)[-2:]) == {0, len(X) - 1}
    rows = leverage_rows(found, (profile_of(found),))
    assert rows[-1]["distance"] == pytest.approx(3.0) and rows[-1]["informs_most"] == "slope"
    blind = dataclasses.replace(found, jacobian=found.jacobian * np.array([1.0, 0.0]))
    assert leverage(blind).sum() == pytest.approx(1.0)


def test_the_slope_is_informed_from_afar() -> None:
    found = straight()
    slope, offset = stations(found, profile_of(found))
    assert slope["mean_distance_mm"] == pytest.approx(np.sum(X**3) / np.sum(X**2)) and slope["seen_best_at_mm"] == 3.0
    assert offset["mean_distance_mm"] == pytest.approx(X.mean())


def test_finite_changes_are_those_of_the_model() -> None:
    found = fit(problem(lambda b: b[0] * X, 2.0 * X, [Parameter("slope", 1.0)]))
    down, up = finite(found)
    size = np.sqrt(np.mean(X**2))
    assert up["finite"] == pytest.approx(18.0 * size) and up["local"] == pytest.approx(2.0 * math.log(10.0) * size)
    assert down["finite"] == pytest.approx(1.8 * size) and up["alike"] == pytest.approx(1.0)
