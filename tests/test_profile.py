"""Profiles, directions and bootstraps: against exact answers of linear problems, and in words where the data see too little."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from nist import MISRA1A, RAT42
from scipy.optimize import least_squares

from fingerjax.identify import Fit, Health, Problem, bootstrap, directions, fit, profile, profiles, uncertainty
from fingerjax.identify.bootstrap import agreement, labels_of
from fingerjax.identify.directions import how_a_pair_enters, sentences
from fingerjax.parameters import Parameter

X = np.linspace(0.2, 3.0, 12)


def problem(
    model: Callable[[Any], Any], y: np.ndarray, parameters: list[Parameter], sigma: float = 1.0, source: str = "stated", **keys: Any
) -> Problem:
    def residuals(raw: jax.Array) -> tuple[jax.Array, Health]:
        values = [p.natural(raw[j]) for j, p in enumerate(parameters)]
        return (model(values) - jnp.asarray(y)) / sigma, Health(jnp.array(True), jnp.array(1), jnp.array(0.0))

    return Problem(tuple(parameters), residuals, {"data": slice(0, len(y))}, {"data": source}, **keys)


def straight(source: str = "stated") -> Fit:
    parameters = [Parameter(name, 1.0, "1", "identity", -math.inf, math.inf) for name in ("slope", "offset")]
    y = 2.0 * X + 1.0 + 0.1 * np.cos(9 * X)
    return fit(problem(lambda b: b[0] * X + b[1], y, parameters, 0.1, source))


def layers(combine: Callable[[Any, Any], Any], noise: float = 0.02, second: float = 1.0, trace: float = 1e-5) -> Fit:
    """Two moduli that enter through one combination only, but for a trace of the second."""
    parameters = [Parameter("dermis.modulus", 1.0, "MPa", "log", 1e-6, 1e6), Parameter("adipose.modulus", second, "MPa", "log", 1e-6, 1e6)]
    y = float(combine(jnp.array(1.0), jnp.array(second))) * X + noise * np.cos(9 * X)
    return fit(problem(lambda b: combine(b[0], b[1]) * X + trace * b[1], y, parameters, noise))


@pytest.mark.parametrize("source", ["stated", "assumed"])
def test_the_profile_of_a_linear_model_is_its_linearised_interval(source: str) -> None:
    found = straight(source)
    known = uncertainty(found)
    for one in profiles(found):
        assert one.identified and one.verdict().endswith("is identified")
        assert one.lower == pytest.approx(known[one.parameter.name].lower, rel=1e-6)
        assert one.upper == pytest.approx(known[one.parameter.name].upper, rel=1e-6)
        assert one.evaluations <= 12
    # The slope of others along a profile is that of the covariance.
    along = profile(found, "slope").follows(0.0)["offset"]
    assert along == pytest.approx(known.covariance[0, 1] / known.covariance[0, 0], rel=1e-6)


@pytest.mark.parametrize("case", [MISRA1A, RAT42])
def test_at_the_end_of_a_profile_chi_square_has_risen_as_asked(case: Any) -> None:
    names = [f"b{j}" for j in range(len(case.values))]
    parameters = [Parameter(name, value) for name, value in zip(names, case.starts[1], strict=True)]
    task = problem(lambda b: case.model(jnp.asarray(case.x), b), np.array(case.y), parameters, source="assumed")
    found = fit(task)
    known = uncertainty(found)
    one = profile(found, names[-1])
    for end in (one.lower, one.upper):
        held = fit(task, start=found.raw, hold={names[-1]: parameters[-1].raw(end)})
        rise = (held.chi2 - found.chi2) / (found.chi2 / found.dof)
        assert rise == pytest.approx(known.t**2, rel=2e-2)
        assert held.raw[-1] == parameters[-1].raw(end)


def test_what_only_enters_as_a_sum_is_called_so_and_has_no_lower_end() -> None:
    found = layers(lambda a, b: a + b)
    assert how_a_pair_enters(found, 0, 1) == "sum"
    assert sentences(found) == ["these data see only the sum of dermis.modulus and adipose.modulus, not the two one by one"]
    one = profile(found, "dermis.modulus")
    assert one.ends[0] == "open" and math.isnan(one.lower)
    assert "practically not identifiable" in one.verdict() and "at most" in one.verdict() and "adipose.modulus" in one.verdict()
    assert 0.9 < one.upper < 2.2  # the whole sum


def test_products_and_ratios_are_told_from_sums() -> None:
    assert how_a_pair_enters(layers(lambda a, b: a * b), 0, 1) == "product"
    assert how_a_pair_enters(layers(lambda a, b: a / b), 0, 1) == "ratio"
    assert how_a_pair_enters(layers(lambda a, b: a + b, second=3.0), 0, 1) == "sum"
    assert how_a_pair_enters(straight(), 0, 1) is None


def test_what_no_reading_sees_is_not_identifiable_on_either_side() -> None:
    found = layers(lambda a, b: a + 0 * b, trace=0.0)
    one = profile(found, "adipose.modulus")
    assert one.ends == ("open", "open") and "no value is ruled out" in one.verdict()
    assert any(said.startswith("adipose.modulus is not seen by these data") for said in sentences(found))
    sharp, loose = directions(found)
    assert sharp.words == "dermis.modulus" and not sharp.sloppy
    assert loose.words == "adipose.modulus" and loose.known == "not seen"


def test_an_interval_of_decades_is_no_identification() -> None:
    found = fit(problem(lambda b: jnp.log(b[0]) * X, np.zeros(len(X)), [Parameter("slope", 1.2, "MPa")], 10.0))
    one = profile(found, "slope")
    assert one.ends == ("found", "found") and one.bounded and not one.identified
    assert one.verdict().startswith("slope is practically not identifiable: anything from")


def test_from_a_plateau_the_end_is_found_however_far() -> None:
    tiny = Parameter("threshold", 1e-3, "MPa", "log", 1e-9, 1e9)
    found = fit(problem(lambda b: X - 0.01 * b[0], X + 0.01, [tiny], 0.1))
    one = profile(found, "threshold")
    assert found.limits == {"threshold": "lower"} and one.ends == ("limit", "found")
    rise = np.sum((0.1 * one.upper + 0.1) ** 2 * np.ones(len(X))) - found.chi2
    assert rise == pytest.approx(1.96**2, rel=5e-2) and "at most" in one.verdict()


def test_a_limit_ends_a_profile() -> None:
    tight = [Parameter("slope", 1.0, "1", "log", 0.5, 2.001), Parameter("offset", 1.0, "1", "identity", -9.0, 9.0)]
    found = fit(problem(lambda b: b[0] * X + b[1], 1.99 * X + 1.0, tight, 0.5))
    one = profile(found, "slope")
    assert one.ends[1] == "limit" and one.upper == pytest.approx(2.001) and one.ends[0] == "found"
    assert not one.identified


@pytest.mark.parametrize("kind", ["parametric", "case"])
def test_a_bootstrap_agrees_with_the_linearised_interval(kind: str) -> None:
    found = straight("assumed")
    known, repeats = uncertainty(found), bootstrap(found, kind=kind, repeats=300, seed=4)
    assert repeats.failed == 0 and len(repeats.raw) == 300
    deviation = np.sqrt(np.diag(repeats.covariance()) / np.diag(known.covariance))
    low, high = (0.88, 1.12) if kind == "parametric" else (0.6, 1.3)  # 300 repeats: 4 %; twelve cases: far from their limit
    assert np.all((low < deviation) & (deviation < high))
    assert low < agreement(known, "slope", *repeats.interval("slope")) * known.t / 1.96 < high
    again = bootstrap(found, kind=kind, repeats=20, seed=4)
    np.testing.assert_array_equal(again.raw, repeats.raw[:20])


def test_cases_are_drawn_whole_where_there_are_enough() -> None:
    np.testing.assert_array_equal(labels_of(np.array(["a", "a", "b"]), 3), [0, 1, 2])
    np.testing.assert_array_equal(labels_of(np.arange(6).repeat(2), 12), np.arange(6).repeat(2))


@pytest.mark.parametrize("loss", ["huber", "soft_l1", "cauchy"])
def test_a_robust_loss_is_not_drawn_by_an_outlier(loss: str) -> None:
    y = 2.0 * X + 1.0 + 0.1 * np.random.default_rng(3).standard_normal(X.size)
    y[5] += 40.0
    parameters = [Parameter(name, 1.0, "1", "identity", -math.inf, math.inf) for name in ("slope", "offset")]
    drawn = fit(problem(lambda b: b[0] * X + b[1], y, parameters, 0.1))
    found = fit(problem(lambda b: b[0] * X + b[1], y, parameters, 0.1, loss=loss))
    assert found.settled and abs(drawn.values["offset"] - 1.0) > 1.0
    assert abs(found.values["slope"] - 2.0) < 0.15 and abs(found.values["offset"] - 1.0) < 0.3
    assert found.chi2 < 0.1 * float(found.residual @ found.residual)
    known = uncertainty(found)
    assert known.sigma == "robust" and known["slope"].lower < 2.0 < known["slope"].upper
    assert profile(found, "slope").identified


@pytest.mark.parametrize("upper", [math.inf, 1.9])
def test_scipys_bounded_solver_ends_at_the_same_place(upper: float) -> None:
    y = 2.0 * X + 1.0 + 0.1 * np.cos(9 * X)
    parameters = [Parameter("slope", 1.0, "1", "identity", 0.0, upper), Parameter("offset", 0.5, "1", "identity", -math.inf, math.inf)]
    task = problem(lambda b: b[0] * X + b[1] ** 3, y, parameters, 0.1)
    ours = fit(task)
    bounds = ([0, -np.inf], [upper, np.inf])
    theirs = least_squares(lambda raw: np.asarray(task.residuals(jnp.asarray(raw))[0]), task.start(), bounds=bounds)
    np.testing.assert_allclose(ours.raw, theirs.x, rtol=1e-5)
    assert ours.chi2 == pytest.approx(2 * theirs.cost, rel=1e-8)
    assert (ours.limits == {"slope": "upper"}) == math.isfinite(upper)


@pytest.mark.filterwarnings("ignore:JAXopt is no longer maintained:DeprecationWarning")
@pytest.mark.parametrize("highest", [math.inf, 0.5])
@pytest.mark.parametrize("case", [MISRA1A, RAT42], ids=lambda case: case.name)
def test_jaxopts_bounded_solver_ends_at_the_same_place(case: Any, highest: float) -> None:
    """L-BFGS-B, which knows nothing of residuals; `highest`: share of its certified value that the last parameter may reach."""
    from jaxopt import LBFGSB

    limits = [1e3 * abs(value) for value in case.values]
    limits[-1] = min(limits[-1], highest * case.values[-1])
    starts = [min(value, 0.9 * limit) for value, limit in zip(case.starts[1], limits, strict=True)]
    parameters = [Parameter(f"b{j}", start, upper=limit, lower=1e-9) for j, (start, limit) in enumerate(zip(starts, limits, strict=True))]
    task = problem(lambda b: case.model(jnp.asarray(case.x), b), np.asarray(case.y), parameters)
    ours = fit(task)
    lower, upper = (jnp.asarray(sides) for sides in zip(*(one.raw_limits() for one in parameters), strict=True))
    solver = LBFGSB(fun=lambda raw: 0.5 * jnp.sum(task.residuals(raw)[0] ** 2), maxiter=5000, tol=1e-9, history_size=20)
    theirs = solver.run(jnp.asarray(task.start()), bounds=(lower, upper)).params
    np.testing.assert_allclose(ours.raw, theirs, rtol=1e-5)
    assert (ours.limits == {f"b{len(parameters) - 1}": "upper"}) == math.isfinite(highest)


def test_a_loss_of_no_name_is_refused() -> None:
    with pytest.raises(ValueError, match="unknown loss 'squares'; choose one of linear"):
        fit(problem(lambda b: b[0] * X, X, [Parameter("slope", 1.0)], loss="squares"))
