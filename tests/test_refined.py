"""Correcting a fit to finer meshes: the finer optimum is found exactly, and what is left is told as a covariance."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from fingerjax.forward.problem import Problem
from fingerjax.identify import Refined, bootstrap, fit, refined, uncertainty
from fingerjax.parameters import Parameter

from .test_profile import problem

X = np.linspace(0.2, 3.0, 24)
PARAMETERS = [Parameter("scale", 2.0, "MPa"), Parameter("rate", 1.0, "1")]
NOISE = 0.02 * np.random.default_rng(3).standard_normal(X.size)


def on(h: float, order: float = 2.0, rough: float = 0.08) -> Problem:
    """A decay read on a mesh of size h, whose readings are too large by a share of h^order that grows with the rate."""
    y = 4.0 * np.exp(-0.6 * X) + NOISE
    return problem(lambda b: b[0] * jnp.exp(-b[1] * X) * (1 + rough * h**order * (1 + b[1] * X)), y, PARAMETERS, 0.02)


def test_the_corrected_fit_is_that_of_the_finer_mesh() -> None:
    coarse, fine = fit(on(1.0)), fit(on(0.5))
    found = refined(coarse, [on(0.5)])
    assert np.abs(coarse.raw - fine.raw).max() > 3 * np.sqrt(np.diag(uncertainty(fine).covariance)).max()
    assert found.best.raw == pytest.approx(fine.raw, abs=0.05 * np.sqrt(np.diag(uncertainty(fine).covariance)).min())
    assert found.best.chi2 == pytest.approx(fine.chi2, rel=1e-2)
    assert found.shifts.sum(axis=0) == pytest.approx(found.best.raw - coarse.raw)
    assert found.best.problem.names == coarse.problem.names
    again = bootstrap(found.best, repeats=30)
    assert again.raw.mean(axis=0) == pytest.approx(found.best.raw, abs=0.02)


@pytest.mark.parametrize("order", [2.0, 1.5])
def test_what_two_corrections_leave_is_about_the_distance_to_the_limit(order: float) -> None:
    found = refined(fit(on(1.0, order)), [on(0.5, order), on(0.25, order)])
    limit = fit(on(0.0))
    left, told = np.abs(found.best.raw - limit.raw), np.sqrt(np.diag(found.spread))
    assert np.all(told > 0.6 * left) and np.all(told < 2.5 * left)
    known, wider = uncertainty(found.best), uncertainty(found.best, spread=found.spread)
    assert np.diag(wider.covariance) == pytest.approx(np.diag(known.covariance) + told**2)
    assert wider["rate"].upper > known["rate"].upper and wider["rate"].value == known["rate"].value


def test_one_correction_leaves_as_much_as_it_moved_and_one_that_does_not_fall_no_less() -> None:
    shifts = np.array([[0.1, -0.2], [0.09, -0.2]])
    fits = (fit(on(1.0)),) * 3
    assert Refined(fits[:2], shifts[:1]).spread == pytest.approx(np.outer(shifts[0], shifts[0]))
    assert Refined(fits, shifts).spread == pytest.approx(np.outer(shifts[1], shifts[1]))


def test_softer_elements_bring_the_fit_half_way_to_them_and_widen_what_is_left() -> None:
    """One kind of element is as much too stiff as the other is too soft: what lies in the middle is the limit."""
    stiff, soft = on(0.5), on(0.5, rough=-0.08)
    alone, found, limit = refined(fit(on(1.0)), [stiff]), refined(fit(on(1.0)), [stiff], softer=soft), fit(on(0.0))
    assert found.softened is not None and len(found.shifts) == 1 and len(found.fits) == 3
    assert np.all(np.abs(found.best.raw - limit.raw) < 0.2 * np.abs(alone.best.raw - limit.raw))
    assert found.softened == pytest.approx(limit.raw - alone.best.raw, rel=0.25)
    assert found.spread == pytest.approx(alone.spread + np.outer(found.softened, found.softened) / 3)


def test_other_parameters_or_no_optimum_are_refused() -> None:
    coarse = fit(on(1.0))
    other = problem(lambda b: b[0] * X, X, [Parameter("scale", 1.0)], 0.1)
    with pytest.raises(ValueError, match="finer problem fits scale, not scale, rate"):
        refined(coarse, [other])
    with pytest.raises(ValueError, match="not settled"):
        refined(fit(on(1.0), max_steps=0), [on(0.5)])
