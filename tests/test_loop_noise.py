"""Noise from repeats: its size, what trials share, rows that stand out; and what may be said where nothing tells it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from loop_toy import Toy

from fingerjax.loop.noise import estimate, outliers
from fingerjax.loop.repeats import Recorded, from_repeats
from fingerjax.loop.whitening import Whitener

CONDITIONS, SETTINGS, TRIALS = 5, 20, 4


def traces(seed: int, *, sigma: float = 0.1, gain: float = 0.0, zero: float = 0.0, day: float = 0.0, wild: float = 0.0, near: float = 0.0):
    """`from_repeats` of made-up traces, and the exact values."""
    random = np.random.default_rng(seed)
    condition, trial, place = (one.ravel() for one in np.meshgrid(range(CONDITIONS), range(TRIALS), range(SETTINGS), indexing="ij"))
    exact = 1.0 + 3.0 * (place / SETTINGS) ** 2 + 0.5 * condition
    noise = random.standard_normal((CONDITIONS, TRIALS, SETTINGS))
    for k in range(1, SETTINGS):
        noise[:, :, k] = near * noise[:, :, k - 1] + math.sqrt(1 - near**2) * noise[:, :, k]
    gains = day * random.standard_normal(TRIALS)[trial] + (gain * random.standard_normal((CONDITIONS, TRIALS)))[condition, trial]
    y = exact * (1 + gains) + (zero * random.standard_normal((CONDITIONS, TRIALS)))[condition, trial] + sigma * noise.ravel()
    y += 8 * sigma * (random.random(len(y)) < wild) * random.choice([-1, 1], len(y))
    recorded = Recorded(y, condition * SETTINGS + place, condition, trial, place.astype(float))
    return from_repeats({"made up": recorded}, 2.0, False)["made up"], exact


def test_plain_noise_has_its_size_and_nothing_in_common() -> None:
    found = [traces(seed)[0] for seed in range(20)]
    # A little is taken for gains where chance looks like them.
    assert np.mean([np.sqrt(np.mean(one.sigma**2)) for one in found]) == pytest.approx(0.1, rel=0.03)
    assert np.mean([np.ptp(one.sigma) for one in found]) < 0.02
    assert np.mean([np.sqrt(one.trace[0, 0]) for one in found]) < 0.02
    # Of 5 x 20 settings three repeats each, less two for every trace beyond the first of its condition where traces have gains.
    for one in found:
        assert one.dof == pytest.approx(5 * 20 * 3 - 5 * 3 * 2 * bool(one.trial.any() or one.trace.any()))
    assert 0 < np.mean([one.dof > 290 for one in found]) < 1
    assert np.mean([one.neighbours > 0 for one in found]) < 0.2


def test_gains_and_zeros_of_traces_are_found_and_a_day_is_told_from_a_trace() -> None:
    alone = [traces(seed, gain=0.05, zero=0.2)[0] for seed in range(20)]
    assert np.sqrt(np.mean([np.diag(one.trial + one.trace) for one in alone], axis=0)) == pytest.approx([0.05, 0.2], rel=0.15)
    assert np.mean([one.trace[1, 1] for one in alone]) > 3 * np.mean([one.trial[1, 1] for one in alone])
    # Student's interval for 15 degrees of freedom over the normal one, squared.
    assert traces(0)[0].widening[1] == pytest.approx((2.947 / 2.576) ** 2, rel=1e-3)
    together = [traces(seed, day=0.05)[0] for seed in range(40)]
    assert np.mean([one.trial[0, 0] for one in together]) > 5 * np.mean([one.trace[0, 0] for one in together])
    assert np.mean([one.trial[0, 0] for one in together]) == pytest.approx(0.05**2, rel=0.4)


def test_an_outlier_is_weighed_down_and_does_not_inflate_the_noise() -> None:
    found = [traces(seed, wild=0.02)[0] for seed in range(10)]
    assert np.mean([one.sigma[0] for one in found]) == pytest.approx(0.1, rel=0.1)
    few = np.mean([np.mean(one.weights < 0.5) for one in found])
    assert 0.01 < few < 0.03
    assert all(one.weights.min() > 0 for one in found)


def test_neighbours_that_are_alike_are_noticed() -> None:
    found = [traces(seed, near=0.6)[0].neighbours for seed in range(10)]
    assert np.mean(found) == pytest.approx(0.6, abs=0.12)


def test_rates_are_noisier_where_they_are_high() -> None:
    toy = Toy(repeats=8, noise=0.05)
    noise, where = estimate(toy.rows), toy.rows.blocks["bar"]
    true = toy.sizes()[toy.index][where]
    assert noise.sigma[where] == pytest.approx(true, rel=0.25)
    assert np.ptp(noise.sigma[where]) > 0


def forces(seed: int, *, gain: float = 0.0) -> tuple[dict[str, Recorded], dict[str, np.ndarray]]:
    """Three force curves of one condition each, four trials, one of them of three readings, and the standard deviations of their noise:
    a floor and a share of the reading.
    """
    random, recorded, sizes = np.random.default_rng(seed), {}, {}
    for name, most, readings in (("probe", 0.1, 6), ("plate", 0.4, 6), ("tip", 0.1, 3)):
        trial, place = (one.ravel() for one in np.meshgrid(range(4), range(readings), indexing="ij"))
        exact = most * (1.0 + place) / readings
        sizes[name] = 0.02 * np.sqrt((0.4 * most) ** 2 + exact**2)
        y = exact * (1.0 + gain * random.standard_normal(4)[trial]) + sizes[name] * random.standard_normal(len(trial))
        recorded[name] = Recorded(y, place, np.zeros_like(trial), trial, exact)
    return recorded, sizes


def test_few_repeats_make_no_reading_many_times_surer_than_it_is() -> None:
    told = []
    for seed in range(100):
        recorded, sizes = forces(seed)
        found = from_repeats(recorded, 2.0, True)
        told.append([found["probe"].sigma[row] / sizes["probe"][row] for row in (0, 5)])
    least, most = np.array(told).T
    assert np.quantile(least, 0.02) > 0.6 and np.quantile(least, 0.98) < 2.5
    assert np.quantile(most, 0.02) > 0.5 and np.quantile(most, 0.98) < 1.5


def test_trials_of_one_condition_have_gains_which_all_blocks_of_one_kind_tell_together() -> None:
    found = [from_repeats(forces(seed, gain=0.06)[0], 2.0, True) for seed in range(100)]
    for name in ("probe", "plate", "tip"):
        assert np.sqrt(np.mean([one[name].trace[0, 0] for one in found])) == pytest.approx(0.06, rel=0.2)
        assert not np.any([one[name].trial for one in found])
    # A zero is a share of what a block reads: four times as large where the forces are.
    sizes = [np.sqrt(one["plate"].trace[1, 1] / one["probe"].trace[1, 1]) for one in found if one["probe"].trace[1, 1] > 0]
    assert np.mean(sizes) == pytest.approx(4.0, rel=0.1)
    # Six traces beyond the first of a condition, in two blocks of which traces are long enough.
    assert found[0]["tip"].widening[1] == pytest.approx((3.707 / 2.576) ** 2, rel=1e-3)
    plain = [from_repeats(forces(seed)[0], 2.0, True)["plate"].trace.any() for seed in range(100)]
    assert np.mean(plain) < 0.5


def test_what_tells_the_noise_decides_what_may_be_said() -> None:
    repeated, stated, silent = estimate(Toy().rows), estimate(Toy(stated=True).rows), estimate(Toy(silent=True).rows)
    assert (repeated.worst, stated.worst, silent.worst) == ("replicates", "stated", "assumed")
    assert repeated.repeated and repeated.known and repeated.nu > 200
    assert stated.known and not stated.repeated and stated.dof == math.inf and "cannot be called adequate" in stated.allows()
    assert not silent.known and "nothing is named" in silent.allows()
    assert not estimate(Toy(repeats=2).rows).repeated


def test_whitened_noise_is_white() -> None:
    toy = Toy(gain=0.05)
    squares = []
    for seed in range(10):
        one = Toy(gain=0.05, seed=seed)
        whitened = Whitener.of(estimate(one.rows).covariance())(one.rows.measured - one.exact[one.index])
        squares.append(float(whitened @ whitened))
    # Between the share that pure error leaves and all rows.
    assert 0.9 < np.mean(squares) / len(toy.rows) < 1.05


def test_without_repeats_an_outlier_is_one_among_its_own_block() -> None:
    toy = Toy(stated=True)
    noise = estimate(toy.rows)
    residual = np.zeros(len(toy.rows))
    residual[5] = 9 * noise.sigma[5]
    assert np.argmin(outliers(toy.rows, noise, residual).weights) == 5
    # A model that misses everywhere has none.
    assert outliers(toy.rows, noise, 20 * noise.sigma * np.sin(np.arange(len(residual)))).weights.min() > 0.9


def test_what_is_wrong_with_any_model_is_alike_in_all_repeats_of_a_setting() -> None:
    toy = Toy()
    plain = estimate(toy.rows)
    wrong = 0.01 * np.abs(toy.rows.measured)
    with_form = estimate(dataclasses.replace(toy.rows, form=wrong))
    added = with_form.covariance() - plain.covariance()
    assert np.sqrt(np.diag(added)) == pytest.approx(wrong, abs=1e-12)
    assert with_form.plausible() - plain.plausible() == pytest.approx(added, abs=1e-12)  # data that are made up have it too
    same = toy.rows.setting[:, None] == toy.rows.setting
    assert not added[~same].any() and added[same] == pytest.approx(np.outer(wrong, wrong)[same], abs=1e-12)
    assert np.linalg.eigvalsh(added).min() > -1e-9 * np.linalg.eigvalsh(added).max()
    assert with_form.nu == plain.nu  # repeats say nothing of it
    assert "model_error" in with_form.allows() and "model_error" not in plain.allows()
