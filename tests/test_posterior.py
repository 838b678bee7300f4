"""Samples against exact answers: normal and Student's intervals of straight models, bent ones by quadrature, and chains that do not mix."""

from __future__ import annotations

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
import pytest

from fingerjax.identify import Posterior, fit, sample, uncertainty
from fingerjax.identify.bootstrap import agreement
from fingerjax.identify.posterior import effective, log_posterior, split_ratio
from fingerjax.parameters import Parameter

from .test_profile import problem, straight


@pytest.mark.parametrize("source", ["stated", "assumed"])
def test_samples_of_a_straight_model_give_its_linearised_interval(source: str) -> None:
    found = straight(source)
    known, drawn = uncertainty(found), sample(found, steps=1500, seed=4)
    assert drawn.mixed and drawn.apart < 1.02 and drawn.effective > 1500
    for name in found.problem.names:
        # Six per cent is three standard deviations of a width told from some two thousand samples.
        assert agreement(known, name, *drawn.interval(name)) == pytest.approx(1.0, abs=0.06)
    # Of Student's distribution with n - p degrees of freedom, not of a normal one, where the noise was assumed.
    widening = known.noise_dof / (known.noise_dof - 2) if source == "assumed" else 1.0
    assert np.diag(drawn.covariance()) == pytest.approx(widening * np.diag(known.covariance), rel=0.15)
    assert drawn.evaluations <= 4 * 1500 + 20 and 0.4 < drawn.accepted[0] <= 1.0


def test_samples_follow_a_bent_model_where_the_linearised_interval_does_not() -> None:
    x = np.array([0.5, 1.0, 2.0])
    found = fit(problem(lambda b: jnp.exp(-b[0] * x), np.exp(-1.0 * x), [Parameter("rate", 0.8, "1", "log", 1e-4, 1e4)], 0.25))
    drawn = sample(found, steps=3000, seed=1)
    grid = np.linspace(-6.0, 5.0, 4001)
    weight = np.exp([log_posterior((np.exp(-math.exp(raw) * x) - np.exp(-x)) / 0.25, np.zeros(3, bool)) for raw in grid])
    # The tail towards no rate and that towards an endless one carry weight for ever: compare inside.
    inside = (grid > -1.5) & (grid < 1.2)
    share = np.cumsum(weight * inside) / np.sum(weight * inside)
    ends = [float(grid[np.searchsorted(share, level)]) for level in (0.1, 0.9)]
    kept = drawn.raw[..., 0][(drawn.raw[..., 0] > -1.5) & (drawn.raw[..., 0] < 1.2)]
    assert np.quantile(kept, [0.1, 0.9]) == pytest.approx(ends, abs=0.08)


def test_what_cannot_be_sampled_is_refused_in_words() -> None:
    found = straight()
    with pytest.raises(ValueError, match="no interval for slope"):
        sample(dataclasses.replace(found, jacobian=found.jacobian * np.array([0.0, 1.0])))
    with pytest.raises(ValueError, match="not settled"):
        sample(dataclasses.replace(found, result=type(found.result).no_optimum))
    with pytest.raises(ValueError, match="huber"):
        sample(dataclasses.replace(found, problem=dataclasses.replace(found.problem, loss="huber")))


def test_a_place_beyond_the_limits_is_never_taken() -> None:
    y = 2.0 + 0.1 * np.cos(np.arange(9))
    found = fit(problem(lambda b: b[0] * np.ones(9), y, [Parameter("level", 2.1, "1", "identity", 1.97, math.inf)], 0.1))
    drawn = sample(found, steps=300)
    assert found.settled and drawn.raw.min() >= 1.97


def test_chains_that_stand_apart_or_crawl_have_no_interval() -> None:
    random, found = np.random.default_rng(0), straight()
    good = random.standard_normal((4, 400, 2))
    whole = Posterior(found, good, (1.0, 1.0), 0, 0)
    assert whole.mixed and effective(good[..., 0]) > 1000 and split_ratio(good[..., 0]) < 1.01
    apart = Posterior(found, good + 3.0 * np.arange(4)[:, None, None], (1.0, 1.0), 0, 0)
    assert not apart.mixed and math.isnan(apart.interval("slope")[0])
    crawling = np.cumsum(0.01 * good, axis=1)
    assert effective(crawling[..., 0]) < 60
    # An autoregressive chain has (1 - a)/(1 + a) times as many samples that count.
    chain = np.zeros((8, 4000))
    for step in range(1, 4000):
        chain[:, step] = 0.6 * chain[:, step - 1] + random.standard_normal(8)
    assert effective(chain) == pytest.approx(8 * 4000 * 0.25, rel=0.15)
