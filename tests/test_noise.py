"""Noise that nobody stated, told from the residuals of each instrument: against known noise, in turn with the fit."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fingerjax.identify import Fit, Health, Problem, fit, uncertainty, with_own_noise
from fingerjax.identify.noise import own_noise, weighed
from fingerjax.parameters import Parameter

X = np.linspace(0.1, 4.0, 60)
PARAMETERS = tuple(Parameter(name, value, "1", "identity", -math.inf, math.inf) for name, value in (("slope", 1.0), ("offset", 0.0)))


def two(loud: float, quiet: float, source: str = "assumed", seed: int = 0) -> Problem:
    """One line read by two instruments, each assumed to have a noise of 1."""
    random = np.random.default_rng(seed)
    noise = np.concatenate([loud * random.standard_normal(X.size), quiet * random.standard_normal(X.size)])
    x = np.concatenate([X, X])
    y = 2.0 * x + 1.0 + noise

    def residuals(raw: jax.Array) -> tuple[jax.Array, Health]:
        return raw[0] * jnp.asarray(x) + raw[1] - jnp.asarray(y), Health(jnp.array(True), jnp.array(1), jnp.array(0.0))

    blocks = {"loud": slice(0, X.size), "quiet": slice(X.size, 2 * X.size)}
    return Problem(PARAMETERS, residuals, blocks, {"loud": "assumed", "quiet": source})


def error(found: Fit) -> float:
    return uncertainty(found)["slope"].standard_error


def test_each_instrument_is_given_its_own_noise() -> None:
    loud, quiet = [], []
    for seed in range(40):
        found, sizes = with_own_noise(fit(two(0.5, 0.02, seed=seed)))
        assert found.settled and own_noise(found) == pytest.approx({"loud": 1.0, "quiet": 1.0}, abs=0.02)
        loud.append(sizes["loud"] / 0.5)
        quiet.append(sizes["quiet"] / 0.02)
    # Unbiased although two parameters were taken from the same rows: three standard errors of the mean of 40 sizes from 59 rows.
    assert np.mean(np.square(loud)) == pytest.approx(1.0, abs=0.09) and np.mean(np.square(quiet)) == pytest.approx(1.0, abs=0.09)


def test_a_quiet_instrument_is_no_longer_drowned_by_a_loud_one() -> None:
    shared = fit(two(0.5, 0.02))
    alone, _ = with_own_noise(shared)
    assert error(alone) < 0.1 * error(shared)
    known = uncertainty(alone)
    assert (
        known.sigma == "estimated" and known.variance == pytest.approx(1.0, abs=0.03) and known["slope"].lower < 2.0 < known["slope"].upper
    )


def test_stated_noise_is_left_alone() -> None:
    found, sizes = with_own_noise(fit(two(0.5, 0.02, source="stated")))
    assert set(sizes) == {"loud"} and sizes["loud"] == pytest.approx(0.5, rel=0.4)
    assert np.abs(found.rows("quiet")).max() < 0.2  # of what was stated: noise of its own would make it 1
    nothing, none = with_own_noise(fit(dataclasses.replace(two(0.5, 0.02), sigma_source={"loud": "stated", "quiet": "replicates"})))
    assert none == {} and nothing.settled


def test_a_fit_that_is_no_optimum_is_handed_back() -> None:
    begun = fit(two(0.5, 0.02), max_steps=0)
    found, _ = with_own_noise(begun)
    assert found is begun and not found.settled


def test_weights_stand_before_their_own_rows_alone() -> None:
    problem = two(0.5, 0.02)
    plain, other = (np.asarray(one.residuals(jnp.array([1.0, 0.0]))[0]) for one in (problem, weighed(problem, {"quiet": 4.0}, 2 * X.size)))
    assert other[: X.size] == pytest.approx(plain[: X.size]) and other[X.size :] == pytest.approx(plain[X.size :] / 4.0)
