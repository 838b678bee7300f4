"""Intervals as often right as stated, and sentences about what the data cannot tell."""

from __future__ import annotations

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fingerjax.identify import Health, Problem, fit, sensitivity, uncertainty
from fingerjax.parameters import Parameter

X = np.linspace(0.2, 3.0, 12)
TRUTH = {"scale": 4.0, "rate": 0.6}
PARAMETERS = (Parameter("scale", 2.0, "MPa"), Parameter("rate", 1.0, "1"))


class Decay(eqx.Module):
    """scale exp(-rate x), its data among the leaves so that repeats share one compilation."""

    y: jax.Array
    sigma: jax.Array

    def __call__(self, raw: jax.Array) -> tuple[jax.Array, Health]:
        prediction = jnp.exp(raw[0]) * jnp.exp(-jnp.exp(raw[1]) * X)
        return (prediction - self.y) / self.sigma, Health(jnp.array(True), jnp.array(1), jnp.array(0.0))


def decay(y: np.ndarray, sigma: float, source: str) -> Problem:
    model = Decay(jnp.asarray(y), jnp.asarray(sigma))
    return Problem(PARAMETERS, model, {"data": slice(0, X.size)}, {"data": source})


def linear(columns: dict[str, Any], y: Any, links: dict[str, str] | None = None, prior: int = 0) -> Problem:
    """r = sum of columns times raw parameters, less y."""
    matrix, target = (
        jnp.stack([jnp.asarray(c, float) for c in columns.values()], axis=1),
        jnp.asarray(y, float),
    )
    links = links or {}
    parameters = tuple(
        Parameter(name, 1.0, "1", links.get(name, "log"), -math.inf if links.get(name) == "identity" else 0.0)
        for name in columns
    )
    rows = matrix.shape[0]
    blocks = {"data": slice(0, rows - prior)} | ({"prior": slice(rows - prior, rows)} if prior else {})
    return Problem(
        parameters,
        lambda raw: (matrix @ raw - target, Health(jnp.array(True), jnp.array(1), jnp.array(0.0))),
        blocks,
        {"data": "stated"},
    )


@pytest.mark.parametrize(("source", "stated"), [("stated", 0.1), ("assumed", 0.7)])
def test_the_interval_holds_the_truth_as_often_as_it_says(source: str, stated: float) -> None:
    random = np.random.default_rng(20030)
    clean = TRUTH["scale"] * np.exp(-TRUTH["rate"] * X)
    inside = dict.fromkeys(TRUTH, 0)
    repeats = 200
    for _ in range(repeats):
        found = fit(decay(clean + random.normal(0.0, 0.1, X.size), stated, source))
        told = uncertainty(found)
        for name, truth in TRUTH.items():
            inside[name] += told[name].lower <= truth <= told[name].upper
    # 0.95 +- 2.6 binomial standard deviations of 200 repeats
    for name, count in inside.items():
        assert 0.91 <= count / repeats <= 0.99, name


def test_stated_noise_is_taken_at_its_word_and_assumed_noise_is_not() -> None:
    y = TRUTH["scale"] * np.exp(-TRUTH["rate"] * X) + np.random.default_rng(1).normal(0.0, 0.1, X.size)
    stated, doubled = (uncertainty(fit(decay(y, sigma, "stated"))) for sigma in (0.1, 0.2))
    assert doubled["scale"].standard_error == pytest.approx(2 * stated["scale"].standard_error, rel=1e-5)
    assert stated.sigma == "stated" and stated.t == pytest.approx(1.959964, rel=1e-6)
    one, two = (uncertainty(fit(decay(y, sigma, "assumed"))) for sigma in (0.1, 0.2))
    assert one["scale"].standard_error == pytest.approx(two["scale"].standard_error, rel=1e-5)
    assert one.sigma == "estimated" and one.noise_dof == pytest.approx(10.0)
    assert one.variance == pytest.approx(4 * two.variance, rel=1e-6)
    assert one.t == pytest.approx(2.228139, rel=1e-6)  # Student's t, 10 degrees of freedom


def test_the_interval_goes_through_the_link() -> None:
    told = uncertainty(fit(decay(4.0 * np.exp(-0.6 * X) + 0.01 * np.cos(9 * X), 0.5, "stated")))["scale"]
    half = 1.959964 * told.standard_error / told.value
    assert told.lower == pytest.approx(told.value * math.exp(-half), rel=1e-6)
    assert told.upper == pytest.approx(told.value * math.exp(half), rel=1e-6)


def test_a_pair_that_only_enters_as_a_product_is_named() -> None:
    a = np.array([1.0, 2.0, 3.0, 5.0])
    found = fit(linear({"dermis.modulus": a, "adipose.modulus": 0.8 * a, "fibrous.modulus": a**2}, 1.3 * a))
    told = uncertainty(found)
    assert told.sentences == (
        "these data see only dermis.modulus x adipose.modulus^0.8, not dermis.modulus and adipose.modulus "
        "one by one: fix one, tie them, or measure something that tells them apart",
    )
    assert [estimate.identified for estimate in told.estimates] == [False, False, True]
    assert math.isnan(told["dermis.modulus"].lower)
    assert told["dermis.modulus"].reason == "not seen by these data"
    assert told["fibrous.modulus"].standard_error > 0


def test_what_nothing_depends_on_is_named() -> None:
    a = np.array([1.0, 2.0, 3.0])
    told = uncertainty(fit(linear({"epidermis.modulus": a, "bone.modulus": 0 * a}, a)))
    assert told.sentences == ("no observation depends on bone.modulus",)
    assert told["epidermis.modulus"].identified and not told["bone.modulus"].identified


def test_three_parameters_seen_as_two_combinations() -> None:
    a, b = np.array([1.0, 2.0, 3.0, 4.0]), np.array([1.0, -1.0, 1.0, -1.0])
    told = uncertainty(fit(linear({"p": a, "q": b, "s": a + b}, a)))
    assert len(told.sentences) == 1
    assert "of p, q and s these data see 2 combinations" in told.sentences[0]
    assert "changes nothing" in told.sentences[0]


def test_a_sum_is_said_as_a_sum() -> None:
    a = np.array([1.0, 2.0, 3.0])
    links = {"offset": "identity", "tilt": "identity"}
    told = uncertainty(fit(linear({"offset": a, "tilt": -0.5 * a}, a, links)))
    assert "these data see only offset + (-0.5) tilt" in told.sentences[0]


def test_a_prior_repairs_it_and_is_not_scaled() -> None:
    columns = {"p": [1.0, 2.0, 3.0, 10.0], "q": [1.0, 2.0, 3.0, 0.0]}
    told = uncertainty(fit(linear(columns, [1.0, 2.0, 3.0, 0.0], prior=1)))
    assert told.identified
    assert told.covariance[0, 0] == pytest.approx(0.01, rel=1e-9)


def test_a_vague_parameter_is_not_identified() -> None:
    a = np.array([1.0, 2.0, 3.0])
    told = uncertainty(fit(linear({"p": a, "q": 0.1 * np.array([1.0, -2.0, 1.0])}, a)))
    assert told["p"].identified
    assert not told["q"].identified
    assert "factor of ten" in told["q"].reason


def test_assumed_noise_without_observations_to_spare_is_undefined() -> None:
    found = fit(decay(4.0 * np.exp(-0.6 * X), 0.1, "assumed"))
    assert math.isfinite(uncertainty(found)["scale"].lower)
    one = Problem(
        (Parameter("slope", 1.0),),
        lambda raw: (2.0 * jnp.exp(raw) - 6.0, Health(jnp.array(True), jnp.array(1), jnp.array(0.0))),
        {"data": slice(0, 1)},
        {"data": "assumed"},
    )
    told = uncertainty(fit(one))["slope"]
    assert told.value == pytest.approx(3.0)
    assert math.isnan(told.lower) and "noise was assumed" in told.reason


def test_correlations_are_those_of_the_covariance() -> None:
    told = uncertainty(fit(decay(4.0 * np.exp(-0.6 * X) + 0.01 * np.cos(9 * X), 0.1, "stated")))
    deviation = np.sqrt(np.diag(told.covariance))
    np.testing.assert_allclose(told.correlations, told.covariance / np.outer(deviation, deviation))
    assert told.strongest(least=0.0)[0][:2] == ("scale", "rate")


def test_sensitivity_is_the_slope_against_a_difference_quotient() -> None:
    found = fit(decay(4.0 * np.exp(-0.6 * X) + 0.01 * np.cos(9 * X), 0.1, "stated"))
    table = sensitivity(found, {"data": 0.1})
    value, step = found.values, 1e-5

    def predict(scale: float, rate: float) -> np.ndarray:
        return scale * np.exp(-rate * X)

    for j, name in enumerate(("scale", "rate")):
        up, down = ({**value, name: value[name] * math.exp(side * step)} for side in (1, -1))
        np.testing.assert_allclose(
            table.in_units[:, j], (predict(**up) - predict(**down)) / (2 * step), rtol=1e-8, atol=1e-9
        )
    np.testing.assert_allclose(table.in_sigma, table.in_units / 0.1)
    assert len(table.table()) == 2 * X.size
    assert table.seen_by()["scale"] == {"data": pytest.approx(1.0)}
