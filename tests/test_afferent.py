"""Rates from quantities: the threshold law, where a fit of it should start, that it arrives, and how sure it then is."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brute

from fingerjax.errors import InputError
from fingerjax.forward.problem import Health, Problem
from fingerjax.identify import fit
from fingerjax.measure.afferent import Threshold, rate, start
from fingerjax.parameters import Parameter


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


S = np.linspace(-3.5, 3.5, 36)
FELT = 0.3 * (np.exp(-((S - 1.5) ** 2) / 0.3) + np.exp(-((S + 1.5) ** 2) / 0.3) + 0.3 * np.exp(-(S**2) / 1.5)) + 0.002
SCALE, THRESHOLD, SIGMA = 200.0, 0.05, 2.5
LAW = (Parameter("scale", 100.0, "1", "log", 1e-6, 1e9), Parameter("threshold", 0.03, "1", "log", 1e-9, 1e6))


def measured(seed: int) -> np.ndarray:
    """Rates of a bar under which the afferent has two peaks, with noise; none below zero."""
    clean = np.asarray(rate(FELT, SCALE, THRESHOLD))
    return np.maximum(clean + SIGMA * np.random.default_rng(seed).normal(size=len(S)), 0.0)


class Misfit(eqx.Module):
    observed: jax.Array

    def __call__(self, raw):
        scale, threshold = (one.natural(raw[i]) for i, one in enumerate(LAW))
        return (rate(jnp.asarray(FELT), scale, threshold) - self.observed) / SIGMA, Health(*map(jnp.asarray, (True, 1, 0.0)))


def raw_of(values) -> np.ndarray:
    return np.array([dataclasses.replace(one, value=float(value)).raw() for one, value in zip(LAW, values, strict=True)])


def problem(observed: np.ndarray, seated: bool = True) -> Problem:
    reseat = (lambda raw: raw_of(start(FELT, observed))) if seated else None
    return Problem(LAW, Misfit(jnp.asarray(observed)), {"bar": slice(0, len(S))}, {"bar": "stated"}, reseat=reseat)


@pytest.mark.parametrize("share", [0.001, 0.1, 0.5, 0.9, 0.99, 1.05])
@pytest.mark.parametrize("factor", [0.1, 1.0, 10.0])
def test_a_fit_arrives_from_any_start_in_the_range_of_the_data(share, factor):
    observed = measured(0)
    found = fit(problem(observed), start=raw_of((factor * SCALE, share * FELT.max())))
    assert found.settled
    assert (found.best["scale"], found.best["threshold"]) == pytest.approx(start(FELT, observed), rel=1e-4)


def test_a_silent_start_would_not_arrive_by_its_slopes_alone():
    """What reseating is for: with a threshold above all that is felt, chi2 is level, and level counts as an optimum."""
    found = fit(problem(measured(0), seated=False), start=raw_of((SCALE, 1.05 * FELT.max())))
    assert found.best["threshold"] > FELT.max()


def test_standard_errors_hold_what_they_say():
    """Of many repeats, about 95 % have the truth within 1.96 standard errors, although rows come and go at the kink."""
    held = []
    for seed in range(300):
        scale, threshold = start(FELT, measured(seed))
        on = threshold < FELT
        slope = np.stack([np.maximum(FELT - threshold, 0.0), -scale * on]) / SIGMA
        spread = np.sqrt(np.diag(np.linalg.inv(slope @ slope.T)))
        held.append(np.abs([scale - SCALE, threshold - THRESHOLD]) < 1.96 * spread)
    share = np.mean(held, axis=0)
    assert np.all(share > 0.90) and np.all(share < 0.99)
