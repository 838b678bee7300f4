"""An explanation must be the same to all kinds of measurement: what is in one alone may pass for an effect in all."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from loop_toy import GRID, KINDS, TRUE, Toy, predicted

from fingerjax.loop.adequacy import AGREEMENT, Adequacy
from fingerjax.loop.agreement import splits
from fingerjax.loop.critical import Rarest
from fingerjax.loop.diagnosis import investigate
from fingerjax.loop.explanations import Explanation
from fingerjax.loop.findings import Findings
from fingerjax.loop.refit import forget
from fingerjax.loop.writing import written

KEY, SIZE = "contact_offset.offset", 0.06
TRIED = ("contact_offset", "profile_tilt", "spontaneous_rate")


def found_in(toy: Toy) -> Findings:
    return investigate(toy, seed=0, effects=TRIED, alpha=0.05, sets=0, tell=lambda share, what: None, kept=forget)


def with_offset(found: Findings) -> Explanation:
    return next(one for one in found.explanations if one.families == ("contact_offset",))


def in_profiles_alone() -> np.ndarray:
    """What an offset changes in one repeat, where forces and rates know nothing of it."""
    true, profiles = np.array(list(TRUE.values())), len(GRID["line"][0])
    changed = predicted(true, {KEY: SIZE}) - predicted(true, {})
    return np.where(np.arange(changed.size) < profiles, changed, 0.0)


@pytest.fixture(scope="module")
def everywhere() -> Findings:
    return found_in(Toy(truth={KEY: SIZE}))


@pytest.fixture(scope="module")
def alone() -> Findings:
    return found_in(Toy(outside=in_profiles_alone))


def test_what_lets_kinds_differ_is_what_acts_in_several_and_leaves_nothing_that_is_free(everywhere: Findings) -> None:
    best = with_offset(everywhere).best
    sizes, all_ = splits(best)
    assert sizes.shape[1] == 2  # of three kinds of measurement
    assert all_.shape[1] == 4  # skin and deep, which profiles and forces know, and the offset; the rest acts in one kind
    scale = np.linalg.norm(best.jacobian, axis=0)
    for columns in (sizes, all_):
        assert np.abs(best.jacobian.T @ columns / scale[:, None]).max() < 1e-6 * np.linalg.norm(columns)
    one_kind = dataclasses.replace(best.sample.subject.rows, kinds=dict.fromkeys(KINDS, "force_displacement"))
    subject = Toy(truth={KEY: SIZE})
    subject.rows = one_kind
    assert splits(dataclasses.replace(best, sample=dataclasses.replace(best.sample, subject=subject))) == ()


def test_an_effect_that_is_there_is_the_same_to_all_kinds(everywhere: Findings) -> None:
    named = with_offset(everywhere)
    assert everywhere.verdict.members == (named,) and named.look.adequacy.agreement_p > AGREEMENT * 0.05
    assert math.isnan(everywhere.base.adequacy.agreement_p)  # the plain model explains nothing


def test_an_effect_that_one_kind_asks_for_alone_is_not_named(alone: Findings) -> None:
    seen = with_offset(alone)
    tests = seen.look.adequacy
    assert tests.disagrees and tests.rejected and not seen.in_set and "is not the same to all kinds of measurement" in seen.reason
    assert "contact_offset" not in alone.verdict.names
    refit = next(one for one in written(alone).candidates if one.family == "contact_offset").refit
    assert refit is not None and refit.lof.agreement_p == tests.agreement_p


def test_that_test_alone_is_enough_to_refuse_and_takes_half_of_two_others_levels() -> None:
    passes = Adequacy(0.015, 0.9, 0.9, 10.0, 10.0, agreement_p=0.5)
    assert not passes.rejected
    assert dataclasses.replace(passes, agreement_p=0.019).rejected and not dataclasses.replace(passes, agreement_p=0.021).rejected
    assert dataclasses.replace(passes, agreement_p=math.nan).rejected  # 0.015 is below two fifths of 0.05, and not below one
    assert dataclasses.replace(passes, omnibus_p=0.009).rejected
    assert passes.least_p == 0.015


def test_the_rarest_of_several_statistics_is_as_rare_as_it_says() -> None:
    random = np.random.default_rng(3)

    def drawn(count: int) -> list[np.ndarray]:
        common, own = random.standard_normal((2, count))
        return [common**2, (common + own) ** 2 / 2 + random.standard_normal(count) ** 2]

    law = Rarest.of(drawn(20_000))
    p = np.array([law.p(one.tolist()) for one in np.transpose(drawn(4_000))])
    for level in (0.02, 0.1, 0.5):
        assert np.mean(p < level) == pytest.approx(level, abs=4 * math.sqrt(level * (1 - level) / 4_000))
    assert math.isnan(Rarest.of([]).p([]))


def test_the_right_effect_is_rarely_refused_by_it() -> None:
    refused = [with_offset(found_in(Toy(truth={KEY: SIZE}, seed=seed))).look.adequacy.disagrees for seed in range(20)]
    assert sum(refused) <= 3  # at a level of 0.02, by chance in one of 200
