"""A study diagnosed from its files to its verdict: a planted effect, one of a laboratory's own, and data that say too little.

The data are the model's own readings with an effect in them and noise, so that what is tested here is that every part is joined to the
next; whether the method names what a finger of other make lacks is for the blind laboratories to say.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fingerjax.effects import catalogue, chosen
from fingerjax.errors import InputError
from fingerjax.forward import assemble, rigs
from fingerjax.forward.strained import Strained
from fingerjax.layers import SOFT_LAYERS
from fingerjax.loop.diagnosis import diagnose
from fingerjax.runners import diagnosing
from fingerjax.runners.diagnosing import diagnose_study, parted, refinement, subject_of
from fingerjax.runners.subject import FingerSubject
from fingerjax.study import Diagnose, Study

from .test_effects import OWN
from .test_forward import COARSE, MODULI, OF, PLATE, Rows, study_of

TRIED = ("contact_offset", "camera_scale", "force_offset", "force_gain", "nail_compliance")
TRIALS, NOISE = 4, {"plate": 0.002, "wedge": 0.01}


@pytest.fixture(scope="module", autouse=True)
def coarse() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rigs, "LINE_SPACING", 2.0)
        patch.setattr(diagnosing, "CLOSE", 0.0)  # no finer mesh: the data come from this one
        yield


def laboratory(folder: Path, effect: str, size: float, *, trials: int = TRIALS, own: Path | None = None) -> Study:
    """A study whose data are readings of its own model with one effect in it."""
    plate: Rows = [{"trial": k, "displacement_mm": d, "force_N": 0.1} for k in range(trials) for d in (0.2, 0.35, 0.5, 0.65, 0.8, 0.95)]
    wedge: Rows = [
        {"trial": k, "depth_mm": d, "distance_mm": s, "deflection_mm": 0.3}
        for k in range(trials)
        for d in (0.4, 0.7, 1.0)
        for s in (-3.1, -2.0, -1.2, -0.5, 0.4, 1.1, 2.2, 3.0)
    ]
    sidecar = {key: said for key, said in PLATE.items() if key != "noise"}
    profile = {key: said for key, said in OF["wedge"][0].items() if key != "noise"}
    free = {"free": ["epidermis.modulus", "adipose.modulus"]}
    measured = {"plate": (sidecar, plate), "wedge": (profile, wedge)}
    study = study_of(folder, measured, free, finger={"preset": "monkey", "resolution": COARSE}, diagnose={"effects": list(TRIED)})
    subject = FingerSubject(assemble(study), chosen((effect,), catalogue(own)))
    raw = np.log([MODULI["epidermis"], MODULI["adipose"]])
    key = next(column.key for family in subject.families for column in family.columns)
    value = subject.evaluate(raw, {key: size}, ()).prediction
    noise = np.random.default_rng(5).normal(size=len(value))
    measurements = []
    for one, where in zip(study.measurements, subject.rows.blocks.values(), strict=True):
        table = dict(one.table) | {one.value: value[where] + NOISE[one.name] * noise[where]}
        measurements.append(dataclasses.replace(one, table=table))
    return dataclasses.replace(study, measurements=tuple(measurements))


def test_a_planted_offset_is_found_added_and_reported(tmp_path: Path) -> None:
    subject, parts = subject_of(laboratory(tmp_path, "contact_offset", 0.08), TRIED), {}

    def kept(name: str, make):  # type: ignore[no-untyped-def]
        return parts.setdefault(name, make())

    found = diagnose(subject, sets=20, kept=kept)
    record = found.record()
    assert record["verdict"]["kind"] == "attributed" and record["set"] == ["contact_offset"], record["verdict"]
    assert record["after"]["phi"]["contact_offset.offset"]["value"] == pytest.approx(0.08, abs=0.02)
    assert record["after"]["error"]["fit"] < 0.5 * record["base"]["error"]["fit"]
    low, high = record["after"]["theta"]["epidermis.modulus"]["ci"]
    assert low < MODULI["epidermis"] < high
    searches = len(parts)
    again = diagnose(subject, sets=20, kept=lambda name, make: parts[name])
    assert len(parts) == searches and again.verdict.text == found.verdict.text


def _of(record: dict, family: str) -> dict:
    return next(one for one in record["candidates"] if one["family"] == family)


def test_an_effect_of_ones_own_is_ranked_refitted_and_reported(tmp_path: Path) -> None:
    folder = tmp_path / "own"
    folder.mkdir()
    (folder / "glove.py").write_text(OWN)
    study = laboratory(tmp_path, "damp_glove", 0.02, own=folder)
    told: list[float] = []
    asked = ("damp_glove", "camera_scale", "tip_radius")
    record = diagnose_study(study, effects=asked, folder=folder, sets=20, tell=lambda share, what: told.append(share)).record()
    assert _of(record, "damp_glove")["refit"]["phi"]["damp_glove.more"] == pytest.approx(0.02, abs=0.004)
    assert record["set"] == ["damp_glove"] and record["verdict"]["families"] == ["damp_glove"]
    assert told == sorted(told) and told[0] >= 0.0 and told[-1] <= 1.0


def test_without_repeats_nothing_is_named(tmp_path: Path) -> None:
    study = laboratory(tmp_path, "contact_offset", 0.08, trials=1)
    verdict = diagnose_study(study, effects=("contact_offset", "camera_scale")).record()["verdict"]
    assert verdict["kind"] == "noise unknown" and verdict["families"] == []


def test_a_load_cells_gain_is_absorbed_by_the_moduli(tmp_path: Path) -> None:
    study = laboratory(tmp_path, "contact_offset", 0.0)
    every = dataclasses.replace(study.fit, free=tuple(f"{layer}.modulus" for layer in SOFT_LAYERS))
    subject = FingerSubject(assemble(dataclasses.replace(study, fit=every)), chosen(("force_gain",), catalogue()))
    raw = np.array([one.raw() for one in subject.parameters])
    J, gain = subject.evaluate(raw, {}, ()).theta_jacobian, subject.columns(raw)["force_gain.gain"]
    left = gain - J @ np.linalg.lstsq(J, gain)[0]
    assert np.linalg.norm(left) < 1e-6 * np.linalg.norm(gain)


def test_what_a_law_adds_is_checked_on_the_finer_mesh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    subject = FingerSubject(assemble(laboratory(tmp_path, "contact_offset", 0.0)), chosen(("strain_stiffening",), catalogue()))
    subject.refine(subject.base, 0.5)
    raw = np.array([one.raw() for one in subject.parameters])
    law, answers = {"strain_stiffening.skin": 5.0, "strain_stiffening.deep": 0.0}, {True: 2.0, False: 1.0}

    def added(raw, amounts, *, finely=False):  # type: ignore[no-untyped-def]
        return None if finely not in answers else (np.full(len(subject.rows), answers[finely]), None, None)

    monkeypatch.setattr(subject._beyond, "added", added)
    linear = subject.finer(raw, {})
    assert linear is not None
    np.testing.assert_allclose(subject.finer(raw, law), linear + 2.0)
    answers |= {True: 99.0, False: 1.1}  # not asked again for nearly the same: what it adds has grown by a tenth
    np.testing.assert_allclose(subject.finer(raw, law), linear + 1.1 + 1.1)
    answers |= {True: 5.0, False: 3.0}
    np.testing.assert_allclose(subject.finer(raw, law), linear + 5.0)
    del answers[True]  # no equilibrium was found there
    answers[False] = 1.0
    np.testing.assert_allclose(subject.finer(raw, law), linear + 1.0)
    del answers[False]
    assert subject.finer(raw, law) is None


@pytest.mark.slow
def test_a_law_that_moves_has_its_slope_at_the_null_too(tmp_path: Path) -> None:
    """A search that comes to the null of a law would else end there, as if more of it changed nothing."""
    subject = FingerSubject(assemble(laboratory(tmp_path, "contact_offset", 0.0)), chosen(("strain_stiffening",), catalogue()))
    raw = np.array([one.raw() for one in subject.parameters])
    keys = ("strain_stiffening.skin", "strain_stiffening.deep")
    at, alone = subject.evaluate(raw, dict.fromkeys(keys, 0.0), keys), subject.evaluate(raw, {}, ())
    np.testing.assert_allclose(at.prediction, alone.prediction, rtol=0, atol=1e-5 * np.abs(alone.prediction).max())
    np.testing.assert_allclose(at.theta_jacobian, alone.theta_jacobian, rtol=0, atol=1e-5 * np.abs(alone.theta_jacobian).max())
    for number, key in enumerate(keys):
        left = subject.columns(raw)[key]
        assert np.abs(left).max() > 0
        np.testing.assert_allclose(at.phi_jacobian[:, number], left, rtol=0, atol=1e-4 * np.abs(left).max())


def test_softer_elements_are_asked_beside_the_finer_mesh_and_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    subject = FingerSubject(assemble(laboratory(tmp_path, "contact_offset", 0.0)), chosen(("contact_offset",), catalogue()))
    subject.refine(subject.base, 0.5)
    raw, phi = np.array([one.raw() for one in subject.parameters]), {"contact_offset.offset": 0.05}
    value, asked = subject.elastic.value, []

    def counted(on, *given):  # type: ignore[no-untyped-def]
        asked.append(on.model.body.dilatation)
        return value(on, *given)

    monkeypatch.setattr(subject.elastic, "value", counted)
    fine = subject.finer(raw, phi)
    half = subject.softness(raw, phi)
    assert sorted(asked) == ["mean", "pointwise"]
    soft = value(subject._soft, raw, subject.elastic.amounts(phi))
    np.testing.assert_allclose(half, (soft - fine) / 2, rtol=0, atol=1e-9 * np.abs(fine).max())
    assert np.abs(half).max() > 1e-4 * np.abs(fine).max()
    elsewhere = subject.softness(raw + 0.1, {})  # asked by itself
    assert sorted(asked) == ["mean"] * 2 + ["pointwise"] * 2
    moved = [value(on, raw + 0.1, {}) for on in (subject._soft, subject._fine)]
    np.testing.assert_allclose(elsewhere, (moved[0] - moved[1]) / 2, rtol=0, atol=1e-9 * np.abs(fine).max())


def test_what_a_law_adds_at_either_of_two_steps_is_found_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    subject = FingerSubject(assemble(laboratory(tmp_path, "contact_offset", 0.0)), chosen(("strain_stiffening",), catalogue()))
    followed: list[float] = []

    def follow(raw, amounts, finely):  # type: ignore[no-untyped-def]
        followed.append(amounts["strain_stiffening"]["skin"])
        return np.full(len(subject.rows), followed[-1]), nothing, subject.base

    nothing = Strained(subject.base.model.predict(subject.named(np.array([one.raw() for one in subject.parameters]))), ())
    monkeypatch.setattr(subject._beyond, "_followed", follow)
    raw = np.array([one.raw() for one in subject.parameters])
    there = {size: subject.glance(raw, {"strain_stiffening.skin": size, "strain_stiffening.deep": 0.0}) for size in (5.0, 6.0, 5.0)}
    assert followed == [5.0, 6.0]
    np.testing.assert_allclose(there[6.0].prediction - there[5.0].prediction, 1.0)


@pytest.mark.parametrize("effect", ["epidermis_thickness", "tip_radius", "contact_offset"])
def test_an_effect_compiles_no_contact_anew_and_another_amount_of_it_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, effect: str
) -> None:
    """Compiled programs are kept: thousands of them end a process where the system allows no more mappings of memory."""
    study = laboratory(tmp_path, "contact_offset", 0.0, trials=1)
    subject = FingerSubject(assemble(study), chosen((effect,), catalogue()))
    raw, way = np.array([one.raw() for one in subject.parameters]), subject.families[0].columns[0]
    answers, compiled = [], []
    for share in (0.0, 0.2, 0.25):
        phi = {way.key: way.null + share * way.scale} if share else {}
        caplog.clear()
        with jax.log_compiles():
            answers.append(subject.evaluate(raw, phi, tuple(phi)).prediction)
        compiled.append([said.getMessage() for said in caplog.records if said.getMessage().startswith("Compiling")])
    asleep, woken, again = compiled
    assert any("_settle" in said for said in asleep) or any("_sensitive" in said for said in asleep)
    assert not any("_settle" in said or "_sensitive" in said for said in woken)
    assert not again
    assert np.ptp(answers, axis=0).max() > 0


def test_a_study_without_a_fit_has_no_residual(tmp_path: Path) -> None:
    study = laboratory(tmp_path, "contact_offset", 0.0)
    with pytest.raises(InputError, match="leaves no residual"):
        diagnose_study(dataclasses.replace(study, fit=dataclasses.replace(study.fit, free=())), effects=TRIED)


def test_a_study_says_how_many_nodes_its_working_mesh_may_have(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnosing, "CLOSE", 0.0)  # no finer mesh
    study = laboratory(tmp_path, "contact_offset", 0.0)
    own = len(subject_of(study, TRIED).base.mesh.nodes)
    fewer = subject_of(dataclasses.replace(study, diagnose=Diagnose(nodes=int(0.7 * own))), TRIED)
    assert len(fewer.base.mesh.nodes) < 0.85 * own and fewer.size > 1.0


def test_how_much_finer_a_mesh_is_is_told_by_its_nodes_where_they_say_less(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert refinement(0.35, 1000, 10_000) == 0.35  # nodes say 0.22
    assert refinement(0.35, 2490, 4568) == pytest.approx(0.667, abs=1e-3)
    monkeypatch.setattr(diagnosing, "CLOSE", 0.8)
    monkeypatch.setattr(diagnosing, "FINER", 0.7)
    monkeypatch.setattr(diagnosing, "GROWTH", 3.0)  # nodes say more than 0.7
    subject = subject_of(laboratory(tmp_path, "contact_offset", 0.0), TRIED)
    mesh = subject.account()["mesh"]
    assert isinstance(mesh, dict) and mesh["finer_nodes"] > mesh["nodes"]
    assert subject.refinement == pytest.approx((mesh["nodes"] / mesh["finer_nodes"]) ** (1 / 3)) and subject.refinement > 0.75


def test_units_of_readings_are_those_of_the_study(tmp_path: Path) -> None:
    subject = FingerSubject(assemble(laboratory(tmp_path, "contact_offset", 0.0)), chosen(TRIED, catalogue()))
    assert subject.rows.units == {"plate": "N", "wedge": "mm"}
    assert subject.rows.conditions == ("plate", "wedge, 0.4 mm", "wedge, 0.7 mm", "wedge, 1 mm")
    assert bool(jnp.isfinite(jnp.asarray(subject.rows.measured)).all())


def test_instruments_that_each_begin_too_early_have_offsets_of_their_own(tmp_path: Path) -> None:
    offsets = {"plate": 0.08, "wedge": -0.05}
    made = {name: laboratory(tmp_path, "contact_offset", size) for name, size in offsets.items()}
    study = dataclasses.replace(
        made["plate"],
        measurements=tuple(made[name].measurement(name) for name in offsets),
        diagnose=dataclasses.replace(made["plate"].diagnose or Diagnose(), per={"contact_offset": "measurement"}),
    )
    found = diagnose_study(study, effects=("contact_offset", "camera_scale"), sets=0)
    assert (found.verdict.kind, list(found.verdict.families)) == ("attributed", ["contact_offset"])
    for name, size in offsets.items():
        low, high = found.record()["after"]["phi"][f"contact_offset.offset[{name}]"]["ci"]
        assert low <= size <= high and low * high > 0


def test_an_effect_that_differs_has_to_be_in_the_catalogue(tmp_path: Path) -> None:
    study = laboratory(tmp_path, "contact_offset", 0.0)
    wrong = dataclasses.replace(study, diagnose=dataclasses.replace(study.diagnose or Diagnose(), per={"contact_ofset": "measurement"}))
    with pytest.raises(InputError, match="contact_ofset.*contact_offset"):
        diagnose_study(wrong, effects=TRIED, sets=0)
    other = dataclasses.replace(study, diagnose=dataclasses.replace(study.diagnose or Diagnose(), per={"nail_compliance": "measurement"}))
    subject = subject_of(other, ("contact_offset",))
    assert parted(subject, other) is subject  # one that is not asked for this time is no error


def test_a_study_may_leave_effects_out_of_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnosing, "CLOSE", 0.0)  # no finer mesh
    study = laboratory(tmp_path, "contact_offset", 0.0)
    less = dataclasses.replace(study, diagnose=dataclasses.replace(study.diagnose or Diagnose(), without=("strain_stiffening",)))
    there = set(subject_of(study).effects)
    assert "strain_stiffening" in there and set(subject_of(less).effects) == there - {"strain_stiffening"}
    assert set(subject_of(less, ("strain_stiffening",)).effects) == {"strain_stiffening"}  # asked for by name
    wrong = dataclasses.replace(study, diagnose=dataclasses.replace(study.diagnose or Diagnose(), without=("strain_stifening",)))
    with pytest.raises(InputError, match="diagnose.without.*strain_stifening|strain_stifening.*strain_stiffening"):
        subject_of(wrong)
