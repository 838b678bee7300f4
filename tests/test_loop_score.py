"""Scores against refits: what a linear model makes exact, and what a careless index gets wrong."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np
import pytest
from loop_toy import FAMILIES, TRUE, Toy
from scipy import stats

from fingerjax.loop.adequacy import look
from fingerjax.loop.critical import Critical, critical
from fingerjax.loop.noise import estimate
from fingerjax.loop.refit import Optimum, optimum
from fingerjax.loop.sample import Sample
from fingerjax.loop.score import Ranking, imitation, rank, statistics
from fingerjax.loop.subject import NONE, AbstractSubject, Column, Evaluation, Family, Rows
from fingerjax.parameters import Parameter

X = np.linspace(-1.0, 1.0, 40)


def column(name: str, **more: object) -> Column:
    return Column(name, "size", "mm", **{"scale": 1e3, "lower": -3e3, "upper": 3e3, **more})  # type: ignore[arg-type]


class Straight(AbstractSubject):
    """y = a + b x + sum of phi_k s_k(x): everything is linear, so that a score is a refit."""

    def __init__(self, families: tuple[Family, ...], curves: Mapping[str, np.ndarray], *, truth: np.ndarray | float = 0.0, seed: int = 0):
        self.name, self.families, self.curves, self.priors = "straight", families, curves, {}
        self.parameters = tuple(Parameter(name, 0.0, "mm", "identity", -math.inf, math.inf) for name in ("a", "b"))
        measured = 1.0 + 2.0 * X + truth + 0.1 * np.random.default_rng(seed).standard_normal(len(X))
        everywhere = np.full(len(X), "all")
        self.rows = Rows(
            {"data": slice(0, len(X))}, everywhere, measured, {"data": {"x": X}}, {"data": "mm"}, everywhere, sigma=np.full(len(X), 0.1)
        )

    def evaluate(self, raw: np.ndarray, phi: Mapping[str, float], moving: tuple[str, ...]) -> Evaluation:
        value = raw[0] + raw[1] * X + sum((size * self.curves[key] for key, size in phi.items()), np.zeros(len(X)))
        block = np.stack([self.curves[key] for key in moving], axis=1) if moving else np.zeros((len(X), 0))
        return Evaluation(value, np.stack([np.ones_like(X), X], axis=1), block)

    def columns(self, raw: np.ndarray, phi: Mapping[str, float] = NONE) -> Mapping[str, np.ndarray]:
        return self.curves


def based(subject: AbstractSubject) -> Optimum:
    sample = Sample.of(subject, estimate(subject.rows), np.ones(len(subject.rows), dtype=bool))
    return optimum(sample, (), np.array([one.raw() for one in subject.parameters]), NONE)


def law(best: Optimum, ranking: Ranking, dof: float = math.inf, seed: int = 0) -> Critical:
    nothing = np.zeros((best.sample.size, 0))
    return critical(dataclasses.replace(best.sample, freedom={"data": dof}), ranking, nothing, nothing, seed=seed)


def curve(name: str, values: np.ndarray, **more: object) -> tuple[Family, dict[str, np.ndarray]]:
    one = column(name, **more)
    return Family(name, (one,)), {one.key: values}


def test_of_a_linear_model_the_score_is_the_refit() -> None:
    bent, curves = curve("bent", X**2 + 0.8 * X + 0.5)
    best = based(Straight((bent,), curves, truth=0.3 * X**2))
    score = rank(best, (bent,), curves).scores[0]
    fitted = optimum(best.sample, bent.columns, best.raw, {"bent.size": 0.1})
    assert fitted.settled and best.settled
    assert best.rss - fitted.rss == pytest.approx(score.z**2, rel=1e-6)
    assert fitted.phi["bent.size"] == pytest.approx(score.change["bent.size"], rel=1e-5)
    assert fitted.raw - best.raw == pytest.approx(score.theta_shift, rel=1e-4)
    # The index that does not let the old parameters move is wrong by much here.
    whole = best.sample.columns(curves["bent.size"][:, None])[:, 0]
    fixed = float(whole @ best.residual) / float(whole @ whole)
    assert abs(fixed) < 0.3 * score.change["bent.size"]


def test_where_the_model_is_known_a_search_does_not_ask_again(monkeypatch: pytest.MonkeyPatch) -> None:
    bent, curves = curve("bent", X**2)
    best = based(Straight((bent,), curves, truth=0.3 * X**2))
    fitted = optimum(best.sample, bent.columns, best.raw, {"bent.size": 0.1})
    subject, asked = best.sample.subject, []
    evaluate = subject.evaluate

    def counted(raw: np.ndarray, phi: Mapping[str, float], moving: tuple[str, ...]) -> Evaluation:
        asked.append((raw.tolist(), dict(phi)))
        return evaluate(raw, phi, moving)

    monkeypatch.setattr(subject, "evaluate", counted)
    moved = best.sample.corrected(0.01 * X**3)
    anew = optimum(moved, bent.columns, fitted.raw, fitted.phi)
    begun = (fitted.raw.tolist(), dict(fitted.phi))
    assert begun in asked
    asked.clear()
    again = optimum(moved, bent.columns, fitted.raw, fitted.phi, at=fitted.at)
    assert begun not in asked and asked
    np.testing.assert_array_equal(again.raw, anew.raw)
    assert again.phi == anew.phi and again.settled


def test_before_the_fit_has_converged_scores_are_refused() -> None:
    subject = Straight((), {})
    start = optimum(Sample.of(subject, estimate(subject.rows), np.ones(40, dtype=bool)), (), np.zeros(2), NONE)
    assert start.settled and start.gradient < 1e-6
    far = dataclasses.replace(start, residual=start.residual + 1.0, settled=False)
    # And the projection makes a score indifferent to a step that a base parameter has left to do.
    bent, curves = curve("bent", X**2)
    assert rank(far, (bent,), curves).scores[0].z == pytest.approx(rank(start, (bent,), curves).scores[0].z, abs=1e-9)


def test_an_absorbed_effect_is_listed_with_what_absorbs_it_and_a_dead_one_apart() -> None:
    gain, curves = curve("gain", 1.0 + 2.0 * X)
    dead, none = curve("dead", np.zeros_like(X))
    ranking = rank(based(Straight((gain, dead), curves | none)), (gain, dead), curves | none)
    assert not ranking["gain"].testable and not ranking["dead"].testable
    assert "absorbed" in ranking["gain"].reason and "a " in ranking["gain"].imitation and "b " in ranking["gain"].imitation
    assert "does not move" in ranking["dead"].reason and not ranking["dead"].imitation
    assert [score.family.name for score in ranking.absorbed] == ["gain"]
    assert ranking["gain"].smallest(3.0) == math.inf


def test_one_sided_effects_count_on_their_own_side_only() -> None:
    up, curves = curve("up", X**2, sign=1, lower=0.0)
    down, more = curve("down", X**2, sign=-1, upper=0.0)
    ranking = rank(based(Straight((up, down), curves | more, truth=0.5 * X**2)), (up, down), curves | more)
    assert ranking["up"].statistic == pytest.approx(ranking["up"].z) and ranking["up"].z > 5
    assert ranking["down"].statistic == 0.0 and ranking["down"].z > 5


def test_of_what_cannot_be_plausible_only_the_plausible_part_is_promised() -> None:
    """The truth's own curve, of which there can be a tenth of what the residual asks for, comes behind a poorer one of any size."""
    little, curves = curve("little", X**2, scale=0.05 / 3, lower=-0.05, upper=0.05)
    poorer, more = curve("poorer", X**2 + 0.3 * np.sin(9 * X))
    best = based(Straight((little, poorer), curves | more, truth=0.5 * X**2))
    ranking = rank(best, (little, poorer), curves | more)
    assert [score.family.name for score in ranking.testable] == ["little", "poorer"]
    assert [score.family.name for score in ranking.promising] == ["poorer", "little"]
    for name in ("little", "poorer"):
        fitted = optimum(best.sample, ranking[name].nodes[0].columns, best.raw, {f"{name}.size": 0.01})
        assert best.rss - fitted.rss == pytest.approx(ranking[name].nodes[0].promise, rel=1e-3)


def test_a_block_of_one_direction_twice_counts_as_little_more_than_once() -> None:
    random = np.random.default_rng(0)
    noise = random.standard_normal((40, 20000))
    single, twice = random.standard_normal((40, 1)), random.standard_normal((40, 2))
    columns = (column("a"), dataclasses.replace(column("a"), name="other"))
    one, two = (
        statistics(columns[:k], normal.T @ noise, normal.T @ normal)
        for k, block in ((1, single), (2, twice))
        if (normal := block / np.linalg.norm(block, axis=0)) is not None
    )
    assert np.quantile(one, 0.998) == pytest.approx(np.quantile(two, 0.998), rel=0.06)


def test_the_critical_value_lies_between_one_test_and_bonferroni() -> None:
    curves, families = {}, []
    for k in range(12):
        family, more = curve(f"c{k}", np.cos((2 + 0.3 * k) * X * math.pi))
        families.append(family)
        curves |= more
    best = based(Straight(tuple(families), curves))
    ranking = rank(best, tuple(families), curves)
    value = law(best, ranking, seed=1)
    assert stats.norm.isf(0.025) < value.value < stats.norm.isf(0.025 / 12)
    assert 1.0 < value.effective < 12.0
    assert value.largest.p(value.value) == pytest.approx(0.05, abs=0.002)
    # Little is known of the noise: the law widens.
    assert law(best, ranking, 6, seed=1).value > law(best, ranking, 30, seed=1).value > value.value + 0.05
    # Independent columns need Bonferroni's.
    free = [curve(f"i{k}", np.linalg.qr(np.random.default_rng(3).standard_normal((40, 12)))[0][:, k]) for k in range(12)]
    base = based(Straight((), {}))
    base = dataclasses.replace(base, jacobian=np.zeros_like(base.jacobian))
    alone = law(base, rank(base, [one for one, _ in free], {key: c for _, more in free for key, c in more.items()}))
    assert alone.value == pytest.approx(stats.norm.isf(0.025 / 12), abs=0.06)
    assert alone.effective == pytest.approx(12, rel=0.2)


def test_of_a_grid_the_best_node_counts_and_the_critical_value_knows_it() -> None:
    nodes = tuple(column("relaxation", fixed={"tau_s": tau}) for tau in (0.1, 1.0, 10.0))
    curves = {one.key: np.exp(-(X + 1) / one.fixed["tau_s"]) for one in nodes}
    family = Family("relaxation", nodes)
    best = based(Straight((family,), curves, truth=0.5 * curves[nodes[0].key]))
    score = rank(best, (family,), curves).scores[0]
    assert score.nodes[0].columns == (nodes[0],) and score.nodes[0].statistic == score.statistic
    whole, alone = (law(best, rank(best, (one,), curves)).value for one in (family, Family("relaxation", nodes[:1])))
    assert whole > alone + 0.1


def test_names_and_order_change_nothing_but_names() -> None:
    toy, turned = Toy(truth={"contact_offset.offset": 0.04}), Toy(truth={"contact_offset.offset": 0.04})
    turned.families = FAMILIES[::-1]
    looks = [look(based(one), one.families, alpha=0.05, seed=3) for one in (toy, turned)]
    assert looks[0].critical.value == looks[1].critical.value
    assert [score.family.name for score in looks[0].ranking.testable] == [score.family.name for score in looks[1].ranking.testable]


def test_derivatives_of_the_toy_are_those_of_its_formula() -> None:
    toy = Toy()
    raw = np.log(np.array(list(TRUE.values())))
    at = toy.evaluate(raw, {"contact_offset.offset": 0.02}, ("contact_offset.offset",))
    step = 1e-4
    after = toy.evaluate(raw, {"contact_offset.offset": 0.02 + step}, ()).prediction
    assert (after - at.prediction) / step == pytest.approx(at.phi_jacobian[:, 0], rel=1e-2, abs=1e-2 * np.abs(at.phi_jacobian).max())


class Edged(Straight):
    """y = a + |b| x: slopes of either sign lead to the edge at b = 0, as where skin begins to touch."""

    def evaluate(self, raw: np.ndarray, phi: Mapping[str, float], moving: tuple[str, ...]) -> Evaluation:
        a, b = raw
        slope = self.rise if b >= 0 else -self.rise
        jacobian = np.stack([np.ones(len(X)), slope * X], axis=1)
        return Evaluation(a + abs(b) * self.rise * X, jacobian, np.zeros((len(X), 0)))

    rise = 1.0


@pytest.mark.parametrize(("wanted", "settled"), [(-0.01, True), (-0.02, True), (-0.03, False), (-0.4, False)])
def test_an_edge_is_an_optimum_where_it_promises_little(wanted: float, settled: bool) -> None:
    """Data that ask for a slope which the model can only come near to, b >= 0 in effect: by 0.4, 0.75, 1.1 standard errors, or by many."""
    subject = Edged((), {})
    subject.rows = dataclasses.replace(subject.rows, measured=1.0 + wanted * X)
    found = optimum(Sample.of(subject, estimate(subject.rows), np.ones(len(X), dtype=bool)), (), np.array([1.0, 0.3]), NONE)
    assert abs(found.raw[1]) < 1e-3 and found.settled is settled


def test_what_would_move_a_modulus_beyond_all_measure_is_told_at_a_smaller_size() -> None:
    modulus, column = Parameter("a.modulus", 0.1, "MPa", "log"), Column("gain", "gain", "mm", 0.5, 0.0, 1.0)
    assert imitation((modulus,), np.array([0.1]), column) == "0.5 mm would pass for a.modulus +10.5%"
    assert imitation((modulus,), np.array([-900.0]), column) == "0.00128 mm would pass for a.modulus -90.0%"
