"""The fitter against certified problems, and the ways in which a fit can end."""

from __future__ import annotations

import math
import os
import signal
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from nist import BOXBOD, CERTIFIED, MISRA1A, Certified

from fingerjax._results import RESULTS
from fingerjax.identify import Health, Problem, Step, fit, uncertainty
from fingerjax.parameters import Parameter
from fingerjax.report.words import warnings


def health(converged: Any = True, iterations: int = 12, residual: float = 1e-11) -> Health:
    return Health(jnp.asarray(converged), jnp.asarray(iterations), jnp.asarray(residual))


def problem(
    model: Callable[[Any, Any], Any],
    x: Sequence[float],
    y: Sequence[float],
    parameters: Sequence[Parameter],
    source: str = "assumed",
    well: Callable[[Any], Any] = lambda raw: True,
) -> Problem:
    def residuals(raw: jax.Array) -> tuple[jax.Array, Health]:
        values = [p.natural(raw[j]) for j, p in enumerate(parameters)]
        return model(jnp.asarray(x), values) - jnp.asarray(y), health(well(raw))

    return Problem(tuple(parameters), residuals, {"data": slice(0, len(y))}, {"data": source})


def certified(case: Certified, start: int, link: str) -> Problem:
    lower = 0.0 if link == "log" else -math.inf
    names = [f"b{j + 1}" for j in range(len(case.values))]
    parameters = [
        Parameter(name, value, "1", link, lower, math.inf)
        for name, value in zip(names, case.starts[start], strict=True)
    ]
    return problem(case.model, case.x, case.y, parameters)


def line(source: str = "assumed", **keys: Any) -> Problem:
    """y = slope x, from slope 1 towards 3."""
    limits = Parameter("slope", 1.0, "MPa", "log", keys.pop("lower", 0.0), keys.pop("upper", math.inf))
    x = [1.0, 2.0, 3.0, 4.0]
    return problem(lambda x, b: b[0] * x, x, [3.1, 5.9, 9.2, 11.9], [limits], source, **keys)


# BoxBOD from far runs to b2 = infinity, where nothing changes: test_a_fit_that_runs_away_says_so.
ROUTES = [
    pytest.param(case, start, link, id=f"{case.name}-{'near' if start else 'far'}-{link}")
    for case in CERTIFIED
    for start in (0, 1)
    for link in ("identity", "log")
    if (case, start, link) != (BOXBOD, 0, "identity")
]


@pytest.mark.parametrize(("case", "start", "link"), ROUTES)
def test_certified_values_and_deviations(case: Certified, start: int, link: str) -> None:
    found = fit(certified(case, start, link), max_steps=400, gradient_tolerance=1e-9)
    assert found.result is RESULTS.successful
    np.testing.assert_allclose(list(found.values.values()), case.values, rtol=5e-7)
    deviations = [estimate.standard_error for estimate in uncertainty(found).estimates]
    np.testing.assert_allclose(deviations, case.deviations, rtol=5e-5)
    assert found.chi2 == pytest.approx(case.rss, rel=1e-9)


@pytest.mark.parametrize("name", ["MGH09", "Thurber"])
def test_where_gauss_and_newton_are_slow_the_secant_takes_over(name: str) -> None:
    """By Levenberg and Marquardt alone, 21 and 22 evaluations."""
    case = next(one for one in CERTIFIED if one.name == name)
    found = fit(certified(case, 1, "identity"))
    assert found.result is RESULTS.successful and found.chi2 == pytest.approx(case.rss, rel=1e-9)
    assert found.evaluations <= 12


def test_a_fit_that_runs_away_says_so() -> None:
    found = fit(certified(BOXBOD, 0, "identity"))
    assert found.result is RESULTS.no_optimum
    assert all(math.isnan(value) for value in found.values.values())


def test_a_step_is_one_run_of_the_model() -> None:
    runs = []

    @jax.custom_jvp
    def slow(x: jax.Array) -> jax.Array:
        def host(x: Any) -> np.ndarray:
            runs.append(1)
            return np.exp(np.asarray(x))

        return jax.pure_callback(host, jax.ShapeDtypeStruct(x.shape, x.dtype), x, vmap_method="sequential")

    slow.defjvps(lambda dx, y, x: y * dx)
    parameters = [Parameter("rate", 0.2, "1", "identity", -5.0, 5.0), Parameter("scale", 2.0)]
    x = np.linspace(0.0, 2.0, 6)
    seen: list[Step] = []
    found = fit(
        problem(lambda x, b: b[1] * slow(b[0] * x), x, 3.0 * np.exp(0.7 * x), parameters),
        progress=seen.append,
    )
    assert found.result is RESULTS.successful
    assert found.values["rate"] == pytest.approx(0.7, rel=1e-8)
    assert len(runs) == found.evaluations == found.steps + 1 == len(seen)
    assert [step.step for step in seen] == list(range(len(seen)))


def test_the_gradient_at_the_end_is_what_it_says() -> None:
    found = fit(certified(MISRA1A, 1, "log"))
    r, jacobian = found.residual, found.jacobian
    cosines = np.abs(jacobian.T @ r) / np.linalg.norm(jacobian, axis=0) / np.linalg.norm(r)
    assert found.gradient == pytest.approx(cosines.max(), rel=1e-9)
    assert found.gradient <= 1e-6


def test_a_solve_cut_short_gives_no_value() -> None:
    found = fit(line(well=lambda raw: False))
    assert found.result is RESULTS.not_converged
    assert found.evaluations == 1
    assert math.isnan(found.values["slope"])
    assert "did not converge" in found.reason
    estimate = uncertainty(found)["slope"]
    assert math.isnan(estimate.value) and math.isnan(estimate.lower) and not estimate.identified


def test_a_trial_point_whose_solve_failed_is_refused() -> None:
    # The optimum, log 3 = 1.0986, lies where the solver fails: the fit may come near it and must not claim
    # it.
    found = fit(line(well=lambda raw: raw[0] < 1.05))
    assert found.result is RESULTS.not_converged
    assert found.raw[0] < 1.05
    assert "trial points" in found.reason
    # A failure on the way that a shorter step avoids does no harm.
    fine = fit(line(well=lambda raw: raw[0] < 1.2))
    assert fine.result is RESULTS.successful


def test_a_model_that_is_not_finite_stops_it() -> None:
    bad = problem(lambda x, b: x * b[0] * jnp.nan, [1.0, 2.0], [1.0, 2.0], [Parameter("slope", 1.0)])
    found = fit(bad)
    assert found.result is RESULTS.not_converged
    assert "not finite" in found.reason


@pytest.mark.parametrize(("pull", "ends"), [(0.05, True), (0.3, True), (2.0, False)])
def test_an_optimum_on_an_edge_is_one_where_its_sides_promise_little(pull: float, ends: bool) -> None:
    """Beyond 1.5 the prediction goes on in another direction, and the data pull towards that edge from both sides."""
    ways, _ = np.linalg.qr(np.random.default_rng(5).standard_normal((20, 20)))
    rest = ways[:, 3:] @ np.ones(17)
    y = 2.0 * ways[:, 0] + 1.5 * ways[:, 1] + pull * (ways[:, 1] - ways[:, 2]) + rest

    def model(x: Any, b: Any) -> Any:
        return b[0] * ways[:, 0] + jnp.minimum(b[1], 1.5) * ways[:, 1] + jnp.maximum(b[1] - 1.5, 0.0) * ways[:, 2]

    parameters = [Parameter(name, start, "1", "identity", -math.inf, math.inf) for name, start in (("a", 1.0), ("c", 0.3))]
    found = fit(problem(model, y, y, parameters))
    assert found.settled is ends
    assert found.raw[1] == pytest.approx(1.5, abs=1e-3)
    if ends:
        assert found.edge and "on an edge" in found.reason and found.gradient > 1e-6
        assert any("on an edge" in one for one in warnings(found, uncertainty(found)))
        assert not fit(line()).edge and found.evaluations < 40


def test_steps_that_run_out_are_no_optimum() -> None:
    found = fit(certified(MISRA1A, 0, "log"), max_steps=3)
    assert found.result is RESULTS.no_optimum
    assert found.evaluations == 4
    assert math.isnan(found.values["b1"])
    assert not math.isnan(found.best["b1"])


@pytest.mark.parametrize(
    ("side", "keys", "value"), [("upper", {"upper": 2.0}, 2.0), ("lower", {"lower": 0.5}, 0.5)]
)
def test_a_limit_holds_and_is_told(side: str, keys: dict[str, float], value: float) -> None:
    up = line(**keys)
    if side == "lower":
        x = [1.0, 2.0, 3.0]
        up = problem(lambda x, b: b[0] * x, x, [0.1, 0.2, 0.3], [Parameter("slope", 1.0, "MPa", "log", 0.5)])
    found = fit(up)
    assert found.result is RESULTS.at_limit
    assert found.limits == {"slope": side}
    assert found.values["slope"] == pytest.approx(value)
    estimate = uncertainty(found)["slope"]
    assert math.isnan(estimate.lower) and estimate.reason == f"ran towards its {side} limit"


def test_the_others_are_fitted_with_one_at_its_limit() -> None:
    x = np.linspace(0.0, 4.0, 9)
    parameters = [
        Parameter("slope", 1.0, "1", "log", 0.0, 2.0),
        Parameter("offset", 0.0, "1", "identity", -9.0, 9.0),
    ]
    found = fit(problem(lambda x, b: b[0] * x + b[1], x, 3.0 * x + 1.0, parameters))
    assert found.result is RESULTS.at_limit
    assert found.values["offset"] == pytest.approx(1.0 + x.mean(), rel=1e-6)
    assert found.gradient <= 1e-6


def test_an_exact_fit_ends() -> None:
    found = fit(problem(lambda x, b: b[0] * x, [2.0], [6.0], [Parameter("slope", 1.0)], "stated"))
    assert found.result is RESULTS.successful
    assert found.values["slope"] == pytest.approx(3.0, rel=1e-9)
    assert found.evaluations <= 9
    assert found.dof == 0


def test_a_logit_parameter_that_runs_to_its_end_stops_there() -> None:
    nu = Parameter("poisson", 0.3, "1", "logit", 0.0, 0.5)
    found = fit(problem(lambda x, b: b[0] * x, [1.0, 2.0], [0.7, 1.4], [nu]))
    assert found.result is RESULTS.at_limit
    assert found.limits == {"poisson": "upper"}


def test_ctrl_c_keeps_the_best_point_and_goes_on_from_it() -> None:
    def stop(step: Step) -> None:
        if step.step == 4:
            os.kill(os.getpid(), signal.SIGINT)

    task = certified(MISRA1A, 0, "log")
    before = signal.getsignal(signal.SIGINT)
    found = fit(task, progress=stop)
    assert signal.getsignal(signal.SIGINT) is before
    assert found.result is RESULTS.interrupted
    assert found.steps == 4
    assert found.chi2 == pytest.approx(min(step.chi2 for step in found.history))
    assert math.isnan(found.values["b1"])
    assert fit(task, start=found.raw).result is RESULTS.successful


def test_units_do_not_change_the_path() -> None:
    x, y = np.array(MISRA1A.x), np.array(MISRA1A.y)
    small = [Parameter("b1", 250.0, "N", "identity", -math.inf, math.inf), Parameter("b2", 0.0005)]
    large = [Parameter("b1", 250e3, "mN", "identity", -math.inf, math.inf), Parameter("b2", 0.0005)]
    one = fit(problem(MISRA1A.model, x, y, small))
    other = fit(problem(lambda x, b: MISRA1A.model(x, (b[0] / 1e3, b[1])), x, y, large))
    assert one.steps == other.steps
    assert other.values["b1"] == pytest.approx(1e3 * one.values["b1"], rel=1e-9)


def test_a_parameter_on_a_plateau_does_not_hold_up_the_fit() -> None:
    def saturating(x: jax.Array, b: jax.Array) -> jax.Array:
        return b[0] * x / (1.0 + x / b[1])

    x = np.linspace(0.5, 3.0, 8)
    y = 2.0 * x * (1.0 + 0.03 * x) + 0.05 * np.cos(7.0 * x)  # bends the other way, so that the second parameter runs off
    found = fit(problem(saturating, x, y, [Parameter("slope", 1.0), Parameter("plateau", 1.0)]))
    assert found.result is RESULTS.at_limit and found.limits == {"plateau": "upper"}
    straight = float(x @ y / (x @ x))
    assert found.values["slope"] == pytest.approx(straight, rel=1e-2)
    assert found.evaluations < 40


def test_a_wrong_model_with_large_residuals_is_fitted_in_few_steps() -> None:
    def wave(x: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.sin(b[0] * x) * b[1]

    x = np.linspace(0.1, 4.0, 30)
    y = np.sin(1.3 * x) + 0.8 * np.sign(np.sin(4.0 * x)) + 0.3 * x  # most of it is not in the model
    found = fit(problem(wave, x, y, [Parameter("rate", 1.0), Parameter("height", 1.0)]))
    assert found.result is RESULTS.successful and found.gradient <= 1e-6
    assert found.chi2 > 1.0 and found.evaluations <= 20
