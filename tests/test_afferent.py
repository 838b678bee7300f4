"""Rates from quantities: the threshold law and where a fit of it should start."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brute

from fingerjax.errors import InputError
from fingerjax.measure.afferent import Threshold, rate, start


def test_threshold_law():
    assert np.asarray(Threshold(10.0, 0.2)(jnp.array([0.0, 0.2, 0.7]))) == pytest.approx([0.0, 0.0, 5.0])


def test_slope_on_both_sides_and_at_the_kink():
    slope = jax.vmap(jax.grad(lambda q: rate(q, 10.0, 0.2)))(jnp.array([0.1, 0.2, 0.3]))
    assert list(np.asarray(slope)) == [0.0, 10.0, 10.0]


def test_start_recovers_an_exact_law():
    q = np.random.default_rng(3).uniform(0, 2, 40)
    assert start(q, np.asarray(rate(q, 25.0, 0.6))) == pytest.approx((25.0, 0.6))
    assert start(q, 25.0 * (q + 0.3)) == pytest.approx((25.0, -0.3))


@pytest.mark.parametrize("seed", range(5))
def test_start_is_the_best_of_all(seed):
    random = np.random.default_rng(seed)
    q = random.uniform(0, 1, 15)
    observed, weight = np.maximum(30 * (q - 0.4), 0) + random.normal(0, 4, 15), random.uniform(0.5, 2, 15)

    def misfit(p):
        return np.sum(weight * (observed - np.asarray(rate(q, float(p[0]), float(p[1])))) ** 2)

    searched = brute(misfit, ((1, 120), (-1.0, 1.0)), Ns=60, full_output=True)[1]
    assert misfit(start(q, observed, weight)) <= searched * (1 + 1e-9)


def test_start_says_when_it_cannot_be_found():
    with pytest.raises(InputError, match="two or more positions"):
        start(np.ones(4), np.arange(4.0))
