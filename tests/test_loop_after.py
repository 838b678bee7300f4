"""What comes after the fit: held-out conditions, look-alikes, the next experiment, curves, false alarms, and the record."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from loop_toy import GRID, TRUE, Toy
from scipy import stats

from fingerjax.loop import heldout, intervals
from fingerjax.loop.adequacy import Look, look
from fingerjax.loop.calibrate import Machine, false_alarms, planted
from fingerjax.loop.diagnosis import diagnose, investigate
from fingerjax.loop.meshguard import Correction, correction, drift, guard
from fingerjax.loop.noise import estimate
from fingerjax.loop.refit import Optimum, forget, optimum
from fingerjax.loop.sample import Sample
from fingerjax.loop.separate import Rival, confusable, distances, next_experiments
from fingerjax.loop.subject import NONE, LogPrior, Proposal, Rows
from fingerjax.loop.unexplained import curves, spectrum, symmetry
from fingerjax.loop.writing import written
from fingerjax.study_records import Prior

TRUTH = {"contact_offset.offset": 0.04}


def based(toy: Toy, mask: np.ndarray | None = None) -> Optimum:
    chosen = np.ones(len(toy.rows), dtype=bool) if mask is None else mask
    return optimum(Sample.of(toy, estimate(toy.rows), chosen), (), np.array([one.raw() for one in toy.parameters]), NONE)


def seen(toy: Toy) -> Look:
    return look(based(toy), toy.families, alpha=0.05, seed=0)


def test_whole_conditions_are_held_out_and_the_report_is_not_the_veto() -> None:
    toy = Toy()
    roles = heldout.roles(toy.rows)
    assert roles["line 1.5"] == "report" and list(roles.values()).count("report") == 1
    named = heldout.roles(dataclasses.replace(toy.rows, roles={"line 2": "veto", "plate 1": "report"}))
    assert named["line 2"] == "veto" and named["plate 1"] == "report" and list(named.values()).count("fit") == len(named) - 2
    masks = [heldout.in_role(toy.rows, named, role) for role in ("fit", "veto", "report")]
    assert (np.sum(masks, axis=0) == 1).all()
    for mask in masks:
        for condition in toy.rows.conditions:
            assert len(set(mask[toy.rows.condition == condition].tolist())) == 1


def test_what_may_come_with_an_effect_moves_the_ends_as_a_fit_with_it_moves_the_parameters() -> None:
    toy = Toy()
    there = seen(toy)
    score = there.ranking["camera_scale"]
    (column,) = score.family.columns
    less, more = intervals.moved_by(there, ("camera_scale",), 2.0)
    allowed = np.clip(score.change[column.key] + np.array([-2.0, 2.0]) / score.length, column.lower, column.upper)
    assert np.isfinite([*less, *more]).all() and (less <= 0).all() and (more >= 0).all()

    def fitted(size: float) -> np.ndarray:
        changed, plain = (toy.evaluate(there.best.raw, phi, ()).prediction for phi in ({column.key: size}, NONE))
        return optimum(there.best.sample.corrected(changed - plain), (), there.best.raw, NONE).raw

    moved = np.stack([fitted(size) - there.best.raw for size in allowed])
    assert less == pytest.approx(np.minimum(moved.min(axis=0), 0.0), rel=0.05, abs=1e-3)
    assert more == pytest.approx(np.maximum(moved.max(axis=0), 0.0), rel=0.05, abs=1e-3)


def test_intervals_count_what_may_come_with_an_effect_that_was_found() -> None:
    toy = Toy(truth=TRUTH)
    found = investigate(toy, seed=0, effects="all", alpha=0.05, sets=0, tell=lambda *_: None, kept=forget)
    assert found.verdict.names[0] == "contact_offset" and written(found).after.alongside == []
    company = {"contact_offset": ("camera_scale", "contact_offset", "of another catalogue")}
    families = tuple(dataclasses.replace(one, comes_with=company.get(one.name, ())) for one in found.families)
    before, after = written(found).after, written(dataclasses.replace(found, families=families)).after
    assert after.alongside == ["camera_scale"]
    wider = {name: (one.ci[0] - after.theta[name].ci[0], after.theta[name].ci[1] - one.ci[1]) for name, one in before.theta.items()}
    assert min(min(ends) for ends in wider.values()) >= -1e-12 and max(max(ends) for ends in wider.values()) > 1e-4
    assert {name: one.value for name, one in after.theta.items()} == {name: one.value for name, one in before.theta.items()}


def test_a_condition_left_out_is_predicted_as_by_a_fit_without_it() -> None:
    toy = Toy()
    whole, turn = based(toy), toy.rows.condition == "plate 1.5"
    without = based(toy, ~turn)
    error, _, spread = heldout.leave_out(whole, turn)
    assert error == pytest.approx(toy.rows.measured - without.at.prediction, abs=2e-2 * float(np.std(toy.rows.measured[turn])))
    assert np.sqrt(np.diag(spread)) == pytest.approx(np.sqrt(np.diag(without.covariance())), rel=0.05)


def test_a_veto_falls_on_what_predicts_badly_not_on_what_knows_little() -> None:
    toy = Toy(truth=TRUTH)
    base = based(toy)
    right = optimum(base.sample, toy.families[0].columns, base.raw, TRUTH)
    nobody = np.zeros(len(toy.rows), dtype=bool)
    assert heldout.veto(base, right, nobody) < -9
    # The wrong way round: the base is the truth and the offset is forced on it.
    clean = Toy()
    best = based(clean)
    forced = dataclasses.replace(based(clean), at=clean.evaluate(best.raw, TRUTH, ()))
    assert heldout.veto(best, forced, clean.rows.condition == "line 2") > heldout.WORSE


def test_priors_are_rows_of_their_own() -> None:
    toy = Toy()
    toy.priors = {"skin.modulus": Prior(0.3, 0.0002)}  # far narrower than the 0.002 or so that the data alone leave, which pull towards 0.2
    best = based(toy)
    assert best.settled and float(np.exp(best.raw[0])) == pytest.approx(0.3, rel=0.02)
    assert best.residual.size == len(toy.rows) + 1
    toy.priors = {"skin.modulus": Prior(0.2, 100.0)}
    assert float(np.exp(based(toy).raw[0])) == pytest.approx(TRUE["skin.modulus"], rel=0.05)


def test_a_prior_on_a_logarithm_pulls_by_ratios() -> None:
    toy = Toy()
    toy.priors = {"skin.modulus": LogPrior(0.3, 0.001)}
    best = based(toy)
    assert best.settled and float(np.exp(best.raw[0])) == pytest.approx(0.3, rel=0.02)
    sample, raw = best.sample, best.raw
    ahead = [sample.residual(best.at, raw + step * np.eye(len(raw))[0])[-1] for step in (1e-4, -1e-4)]
    assert sample.jacobian(best.at, raw)[-1, 0] == pytest.approx(-(ahead[0] - ahead[1]) / 2e-4)
    toy.priors = {"skin.modulus": LogPrior(0.3, 10.0)}
    assert float(np.exp(based(toy).raw[0])) == pytest.approx(TRUE["skin.modulus"], rel=0.05)


@pytest.mark.parametrize("step", [0.02, 0.1, -0.3])
def test_by_how_much_a_correction_differs_elsewhere_is_foretold(step: float) -> None:
    toy = Toy(mesh=0.03)
    best = based(toy)
    known, there = correction(toy, best.raw, NONE), correction(toy, best.raw + step, NONE)
    assert known is not None and there is not None
    differs = float(np.linalg.norm(best.sample.columns((there.offset - known.offset)[:, None])))
    foretold = drift(known, best.sample, best.at, toy.evaluate(best.raw + step, NONE, ()))
    assert 0.3 * differs < foretold < 3 * differs
    assert drift(known, best.sample, best.at, best.at) == 0.0


def test_the_mesh_error_is_measured_and_its_leftover_is_a_covariance() -> None:
    toy = Toy(mesh=0.03)
    best = based(toy)
    found = correction(toy, best.raw, NONE)
    assert found is not None and np.linalg.norm(found.offset) > 0 and not found.softness.any()
    offset, left = found.offset, found.left(toy.rows)
    assert np.linalg.eigvalsh(left).min() > -1e-9 * np.linalg.eigvalsh(left).max()
    assert np.sqrt(np.diag(left)) == pytest.approx(0.25 * np.abs(offset))
    line, bar = (toy.rows.blocks[name] for name in ("line", "bar"))
    assert not left[line, bar].any()
    again = optimum(best.sample.corrected(offset, left), (), best.raw, NONE)
    known = guard(again, found)
    assert known.excess <= len(GRID) and not known.passed
    # What may be left asks for more of an effect that looks like it than of one that does not, and of none where the gate is passed.
    assert known.remainder is not None
    alike = known.remainder[:, 0] / np.linalg.norm(known.remainder[:, 0])
    other = np.linalg.qr(np.column_stack([known.remainder[:, 0], np.arange(len(alike))]))[0][:, 1]
    assert known.margin(alike) ** 2 == pytest.approx(known.excess) and known.margin(other) < 1e-6
    assert dataclasses.replace(known, checked=False).margin(alike) == 0.0
    # An offset twice as large reaches four times as far in the noise alone.
    twice = dataclasses.replace(found, offset=2 * offset)
    other = optimum(best.sample.corrected(twice.offset, twice.left(toy.rows)), (), best.raw, NONE)
    assert guard(other, twice).reach == pytest.approx(4 * known.reach, rel=0.2)


class Softer(Toy):
    """A toy whose finer mesh is too stiff by a share of its prediction, and by as much too soft with other elements."""

    share = -0.01

    def softness(self, raw: np.ndarray, phi: Mapping[str, float]) -> np.ndarray | None:
        finer = self.finer(raw, phi)
        return None if finer is None else self.share * np.linspace(0.5, 1.5, len(finer)) * finer


def test_softer_elements_move_the_correction_half_way_and_widen_what_it_leaves() -> None:
    stiff, both = Toy(mesh=0.03), Softer(mesh=0.03)
    best = based(stiff)
    alone, found = (correction(toy, best.raw, NONE) for toy in (stiff, both))
    assert alone is not None and found is not None
    half = both.softness(best.raw, NONE)
    np.testing.assert_allclose(found.offset, alone.offset + half, rtol=1e-12)
    assert np.sqrt(np.diag(found.left(both.rows))) == pytest.approx(np.hypot(0.25 * np.abs(found.offset), np.abs(half) / math.sqrt(3)))
    ends = [optimum(best.sample.corrected(each.offset, each.left(stiff.rows)), (), best.raw, NONE) for each in (alone, found)]
    before, after = (guard(end, each) for end, each in zip(ends, (alone, found), strict=True))
    assert after.excess > before.excess
    only = dataclasses.replace(found, offset=np.zeros(len(half)))
    end = optimum(best.sample.corrected(only.offset, only.left(stiff.rows)), (), best.raw, NONE)
    moved = end.projection.inverse @ end.sample.columns(half[:, None])[:, 0]
    np.testing.assert_allclose(guard(end, only).raw_shift, moved[: len(end.raw)] / math.sqrt(3), rtol=1e-9)


def likeness(depths: Iterable[float], condition: Sequence[str], setup: Sequence[str] | None = None) -> np.ndarray:
    """(rows, rows) correlation of what the mesh leaves of readings at these depths, one second after the other."""
    at = {"block": {"depth": np.array(depths), "time": np.arange(len(condition), dtype=float)}}
    rows = Rows(
        {"block": slice(0, len(condition))}, np.array(condition), np.zeros(len(condition)), at, {}, np.full(len(condition), "1"),
        setup=None if setup is None else np.array(setup),
    )  # fmt: skip
    return Correction(np.full(len(condition), 4.0), np.zeros(len(condition))).left(rows)


def test_what_the_mesh_leaves_does_not_change_while_a_depth_is_held():
    np.testing.assert_allclose(likeness((1.0, 1.0, 1.0), ("hold",) * 3), 1.0, rtol=1e-12)


def test_what_the_mesh_leaves_does_not_change_where_a_stage_creeps():
    creeping = likeness((1.0, 1.001, 1.002), ("1 mm", "1.001 mm", "1.002 mm"), ("hold",) * 3)
    np.testing.assert_allclose(creeping, 1.0, atol=1e-4)


def test_what_the_mesh_leaves_is_half_as_alike_in_another_set_up_and_less_at_another_depth():
    found = likeness((1.0, 1.0, 0.5), ("wedge, 1 mm", "plate, 1 mm", "wedge, 0.5 mm"), ("wedge", "plate", "wedge"))
    assert found[0, 1] == pytest.approx(0.5)
    assert found[0, 2] == pytest.approx(np.exp(-0.5 * 1.5**2))


def test_look_alikes_are_listed_with_the_misfit_that_would_tell_them_apart() -> None:
    found = confusable(seen(Toy(truth=TRUTH)), ("contact_offset", "force_offset"))
    assert all(pair.lambda_needed == pytest.approx(13 / (1 - pair.cos**2)) for pair in found)
    assert any({pair.a, pair.b} == {"contact_offset", "force_offset"} for pair in found)


def test_distance_of_two_explanations_is_what_a_fit_of_the_other_leaves() -> None:
    random = np.random.default_rng(0)
    base, s = random.standard_normal((30, 3)), random.standard_normal((30, 2))
    whole = np.concatenate([base, s], axis=1)
    rivals = [Rival(Toy().families[k].columns[0], size) for k, size in ((0, 2.0), (1, 0.5))]
    left = []
    for k, other in ((0, 1), (1, 0)):
        design = np.column_stack([base, s[:, other]])
        target = s[:, k] * rivals[k].size
        left.append(float(np.sum((target - design @ np.linalg.lstsq(design, target, rcond=None)[0]) ** 2)))
    assert next(iter(distances(whole.T @ whole, rivals).values())) == pytest.approx(min(left))


class _Proposing(Toy):
    """Offers one measurement that tells an offset from a camera's scale, and one that tells nothing."""

    def proposals(self, raw: np.ndarray) -> tuple[Proposal, ...]:
        keys = [column.key for family in self.families for column in (*family.columns, *family.second)]
        nothing = {key: np.zeros(3) for key in keys}
        scale = next(key for key in keys if key.startswith("camera_scale."))
        telling = nothing | {"contact_offset.offset": np.array([3000.0, -3000.0, 500.0]), scale: np.array([2000.0, 2000.0, -1000.0])}
        return tuple(Proposal(name, np.zeros((3, 5)), columns, np.ones(3)) for name, columns in (("idle", nothing), ("telling", telling)))


def test_the_next_experiment_is_the_one_that_tells_rivals_apart() -> None:
    toy = _Proposing(truth=TRUTH)
    best = based(toy)
    rivals = [
        Rival(next(one for one in toy.families if one.name == name).columns[0], size)
        for name, size in (("contact_offset", 0.01), ("camera_scale", 0.01))
    ]
    columns = toy.columns(best.raw)
    found = next_experiments(best, rivals, columns)
    assert found[0].condition == "telling" and len(found) == 3
    assert found[0].d2_after >= 13 > found[0].d2_now and found[0].replicates < found[1].replicates
    assert next_experiments(best, rivals[:1], columns) == []
    # A threshold that ended at nothing would have to grow a trillionfold to look like a rival; it stays where it is.
    jacobian = best.jacobian.copy()
    jacobian[:, 0] = 1e-13 * best.sample.columns(columns[rivals[0].column.key][:, None])[:, 0]
    imitating = dataclasses.replace(best, jacobian=jacobian)
    held = dataclasses.replace(imitating, free=np.arange(len(best.free)) > 0)
    assert next_experiments(imitating, rivals, columns)[0].d2_now < 1e-6 < next_experiments(held, rivals, columns)[0].d2_now


def test_the_curve_through_a_residual_leaves_the_parameters_where_they_are() -> None:
    bump = 0.03 * np.exp(-((GRID["line"][1]["distance"] - 1.0) ** 2))
    toy = Toy(outside=lambda: np.concatenate([bump, np.zeros(62)]))
    best = based(toy)
    found = curves(best)
    mean = np.concatenate([found[name]["mean"] for name in toy.rows.blocks])
    moved = best.projection.inverse @ best.sample.columns(mean[:, None])[:, 0]
    sd = np.sqrt(np.diag(best.covariance()))
    assert np.abs(moved / sd).max() < 1e-6
    assert found["line"]["amplitude"] > 0 and found["bar"]["amplitude"] == 0.0
    assert np.corrcoef(found["line"]["mean"], (bump - bump.mean())[toy.index[toy.rows.blocks["line"]]])[0, 1] > 0.7
    assert (found["line"]["band"] > 0).all()


def test_an_odd_residual_is_seen_to_be_odd_and_a_wave_to_be_a_wave() -> None:
    x = GRID["line"][1]["distance"]
    odd = symmetry(based(Toy(outside=lambda: np.concatenate([0.03 * np.sin(x), np.zeros(62)]))))["line"]
    even = symmetry(based(Toy(outside=lambda: np.concatenate([0.03 * np.cos(2 * x), np.zeros(62)]))))["line"]
    assert odd > 0.9 and even < 0.3
    position = GRID["bar"][1]["position"]
    wave = spectrum(based(Toy(outside=lambda: np.concatenate([np.zeros(76), 6 * np.sin(2 * np.pi * position / 2.0)]))))["bar"]
    assert wave["wavelength"] == pytest.approx(2.0, rel=0.15) and wave["share"] > 0.5


def _machine(toy: Toy, base: Look) -> Machine:
    return Machine(base, toy.families, toy.columns(base.best.raw), estimate(toy.rows).plausible(), np.zeros((len(toy.rows), len(toy.rows))))


def test_false_alarms_come_as_often_as_stated() -> None:
    toy = Toy()
    base = seen(toy)
    machine = _machine(toy, base)
    sets = 200  # with 120 none at all would pass as well
    found = false_alarms(machine, seed=0, sets=sets)
    low, high = stats.binom.ppf([0.001, 0.999], sets, 0.05) / sets
    assert low > 0
    assert low <= found.rejected <= high
    assert low <= found.flagged <= high
    grown = planted(machine, seed=0)
    assert len(grown) == 3 and sum(one.found for one in grown) >= 2
    assert all(one.rank <= 5 for one in grown if one.found)


def test_planted_effects_are_missed_where_they_are_too_small() -> None:
    toy = Toy()
    base = seen(toy)
    machine = _machine(toy, base)
    ranking, _ = machine.look(np.random.default_rng(0), np.zeros(len(toy.rows)))
    assert ranking.largest < base.critical.value


SECTIONS = {
    "data": {"id", "hash", "kind", "conditions", "noise"},
    "model": {"version", "mesh", "contact"},
    "base": {"theta", "rss", "df", "grad_rel", "lof", "error"},
    "critical": {"alpha", "maxT", "n_columns", "effective_tests", "null_fp_measured", "n_boot"},
    "verdict": {"kind", "families", "share_explained", "remainder_p", "absorbed", "text", "held_out_p"},
    "after": {"theta", "phi", "error", "theta_change_sd", "interval_kind", "alongside"},
    "unexplained": {"gp", "symmetry", "spectrum"},
}
CANDIDATE = {
    *(
        "family",
        "columns",
        "null",
        "bound",
        "prior_sd",
        "fraction_left",
        "mde",
        "z",
        "p_adj",
        "epc",
        "theta_shift",
        "testable",
        "reason",
        "refit",
    ),
}
REFIT = {"phi", "ci", "rss", "delta", "bic", "log_evidence", "lof", "best_rival", "veto_dchi2", "eta", "converged"}


def test_the_record_has_every_key_and_is_json() -> None:
    said = diagnose(Toy(truth=TRUTH), sets=2).record()
    json.loads(json.dumps(said, allow_nan=False))
    for section, keys in SECTIONS.items():
        assert keys <= set(said[section]), section
    assert {"candidates", "set", "confusable", "next_experiment", "planted", "seed", "runtime_s", "rows"} <= set(said)
    assert all(set(one) >= CANDIDATE for one in said["candidates"])
    assert all(set(one["refit"]) >= REFIT for one in said["candidates"] if one["refit"])
    assert said["set"] == ["contact_offset"] == said["verdict"]["families"]
    bar = said["rows"]["bar"]
    assert {len(bar[key]) for key in ("measured", "sigma", "before", "after", "condition", "role")} == {88}
    assert said["critical"]["n_boot"] == 2


def test_a_second_run_takes_what_was_kept_and_says_the_same() -> None:
    store: dict[str, Any] = {}

    def kept(name: str, make: Any) -> dict[str, Any]:
        if name not in store:
            store[name] = json.loads(json.dumps(make()))
        return store[name]

    first = Toy(truth=TRUTH)
    before = diagnose(first, sets=0, kept=kept)
    again = Toy(truth=TRUTH)
    after = diagnose(again, sets=0, kept=kept)
    assert again.evaluations < first.evaluations / 2
    ours, theirs = before.record(), after.record()
    for said in (ours, theirs):
        said.pop("runtime_s")
    assert ours == theirs


def test_progress_is_told_and_rises() -> None:
    heard: list[float] = []
    diagnose(Toy(truth=TRUTH), sets=3, tell=lambda share, what: heard.append(share))
    assert heard == sorted(heard) and heard[0] == 0.0 and heard[-1] < 1.0


def test_a_model_that_is_never_wrong_has_intervals_that_hold_the_truth() -> None:
    inside = 0
    for seed in range(30):
        toy = Toy(seed=300 + seed, repeats=3)
        best = based(toy)
        sd = np.sqrt(np.diag(best.covariance()))
        inside += int(np.sum(np.abs(best.raw - np.log(list(TRUE.values()))) < 1.97 * sd))
    low, high = stats.binom.ppf([0.001, 0.999], 150, 0.95)
    assert low <= inside <= high + math.ceil(150 - high)
