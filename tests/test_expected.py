"""Where equilibria are expected after a small change of the parameters: their displacements follow their slopes."""

from __future__ import annotations

import dataclasses
import gc
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from fingerjax.contact.chord import Chording, Chords, tangent_chord
from fingerjax.effects import catalogue, chosen
from fingerjax.errors import InputError
from fingerjax.fem.cholesky import AbstractCholesky
from fingerjax.fem.equilibrium import Tissue
from fingerjax.fem.tissue import Exponential, FiniteStrain
from fingerjax.forward import Assembled
from fingerjax.forward.strained import FARTHEST, Strained, place_of, strained_readings
from fingerjax.forward.strained_slopes import strained_jacobian, strained_slopes
from fingerjax.runners import elastic, variants
from fingerjax.runners.beyond import Beyond
from fingerjax.runners.subject import FingerSubject

from .test_bodies import cylinder

HERE, CHANGE = jnp.array([0.07, 0.6, 2.0]), np.array([0.002, 0.05, 0.3])
TIGHT = Chording(tolerance=1e-10)


def of(at):
    """Modulus, MPa, homotopy and stiffening."""
    return {"epidermis.modulus": at[0]}, Exponential(FiniteStrain(at[1]), jnp.full(5, at[2]))


@pytest.fixture(scope="module")
def ready(tmp_path_factory: pytest.TempPathFactory) -> Assembled:
    return cylinder(tmp_path_factory.mktemp("cylinder"), "held", "held", pad=8.0)


@pytest.fixture(scope="module")
def known(ready: Assembled) -> Strained:
    return strained_slopes(ready.model, of, HERE, strained_readings(ready.model, *of(HERE), chording=TIGHT))[1]


def there(ready: Assembled, change: np.ndarray, start: Strained | None = None) -> Strained:
    return strained_readings(ready.model, *of(HERE + change), start=start, chording=TIGHT)


def displacements(found: Strained) -> np.ndarray:
    return np.stack([ended.rest.displacement for rig in found.cases for ended in rig])


def test_slopes_of_displacements_are_differences(ready: Assembled, known: Strained) -> None:
    for number, step in enumerate(1e-3 * np.diag(CHANGE)):
        up, down = (displacements(there(ready, sign * step, known)) for sign in (1, -1))
        expected = (up - down) / (2 * step[number])
        slopes = np.stack([slope[number] for rig in known.slopes for slope in rig])
        np.testing.assert_allclose(slopes, expected, rtol=0, atol=1e-5 * np.abs(expected).max() + 1e-9)


def test_an_expected_start_saves_iterations_and_changes_nothing(ready: Assembled, known: Strained) -> None:
    expected, plain, cold = (there(ready, CHANGE, start) for start in (known.after(CHANGE), known, None))
    assert expected.iterations < plain.iterations <= cold.iterations
    for found in (expected, plain):
        np.testing.assert_allclose(found.prediction.readings[0], cold.prediction.readings[0], rtol=1e-8)


def test_what_is_expected_is_not_far_and_nothing_moves_without_a_change(known: Strained) -> None:
    assert known.after(np.zeros(3)) is known
    far, here = displacements(known.after(1e3 * CHANGE)), displacements(known)
    np.testing.assert_allclose(np.linalg.norm(far - here, axis=1), FARTHEST * np.linalg.norm(here, axis=1), rtol=1e-9)


def test_kept_tangents_save_factorisations_and_change_nothing(ready: Assembled) -> None:
    chords, none = Chords(), Chords(room=0)
    far, change = jnp.array([0.07, 1.0, 30.0]), jnp.array([0.0, 0.0, 1.0])
    first = strained_readings(ready.model, *of(far), chording=TIGHT, chords=chords)
    strained_slopes(ready.model, of, far, first, chords=chords)
    strained_slopes(ready.model, of, far, first, chords=none)
    assert first.factorisations > 0
    kept, anew = (strained_readings(ready.model, *of(far + change), start=first, chording=TIGHT, chords=one) for one in (chords, none))
    assert kept.factorisations == 0 < anew.factorisations
    np.testing.assert_allclose(kept.prediction.readings[0], anew.prediction.readings[0], rtol=1e-8)


def test_a_new_tangent_of_a_case_takes_up_the_analysis_of_its_last_one(ready: Assembled, known: Strained) -> None:
    chords, held = Chords(), []
    for _ in range(3):
        strained_slopes(ready.model, of, HERE, known, chords=chords)
        gc.collect()
        held.append(sum(isinstance(one, AbstractCholesky) for one in gc.get_objects()))
    assert held[0] == held[1] == held[2]


def test_a_tangent_serves_bodies_that_move_alike_only(ready: Assembled) -> None:
    model, chords = ready.model, Chords()
    tissue = Tissue(model.body, of(HERE)[1], model.instruments.materials(of(HERE)[0])[0].lame(), model.solver)
    place, _ = place_of(model, model.instruments.rigs[0], 0, tissue)
    chord = tangent_chord(tissue, place, np.zeros(model.body.nodes.size))
    assert chord is not None and chord.condensed.memory > 0
    chords.keep(0, model.body, place, chord)
    assert chords.find(0, model.body, place) is chord and chords.find(1, model.body, place) is None
    freed = eqx.tree_at(lambda one: one.free, model.body, jnp.ones_like(model.body.free))
    assert chords.find(0, freed, place) is None
    full = Chords(room=int(1.5 * chord.condensed.memory))
    for case in (0, 1):
        full.keep(case, model.body, place, chord)
    assert full.find(0, model.body, place) is chord and full.find(1, model.body, place) is None


def test_both_ways_of_asking_for_slopes_agree(ready: Assembled, known: Strained) -> None:
    rows, again = strained_slopes(ready.model, of, HERE, known)
    np.testing.assert_array_equal(rows, strained_jacobian(ready.model, of, HERE, known))
    assert again.cases is known.cases


def test_new_equilibria_take_over_slopes_of_the_same_parameters_alone(known: Strained) -> None:
    beyond = object.__new__(Beyond)
    beyond._last = {False: (known, {"modulus": 0.07})}
    found = dataclasses.replace(known, slopes=None)
    sloped, numbers = beyond._still_sloped(found, {"modulus": 0.08, "law.b": 2.0}, False)
    assert sloped.slopes is known.slopes and sloped.cases is found.cases and numbers == {"modulus": 0.08}
    lost = tuple(tuple(ended._replace(rest=None) for ended in rig) for rig in known.cases)
    elsewhere = dataclasses.replace(found, cases=lost)
    for other, named, finely in ((found, {"law.b": 2.0}, False), (found, {"modulus": 0.08}, True), (elsewhere, {"modulus": 0.08}, False)):
        assert beyond._still_sloped(other, named, finely) == (other, named)


def test_what_moves_nothing_has_no_slopes_and_asks_for_no_tangent(ready: Assembled, known: Strained) -> None:
    model, chords = ready.model, Chords()
    rows, found = strained_slopes(model, lambda at: of(HERE), jnp.ones(2), known, chords=chords)
    assert rows.shape == (len(known.prediction.readings[0]), 2) and not np.any(rows)
    assert all(slope.shape == (2, model.body.nodes.size) and not np.any(slope) for rig in found.slopes for slope in rig)
    tissue = Tissue(model.body, of(HERE)[1], model.instruments.materials(of(HERE)[0])[0].lame(), model.solver)
    assert chords.find(0, model.body, place_of(model, model.instruments.rigs[0], 0, tissue)[0]) is None


@pytest.mark.slow
def test_a_glance_is_an_evaluation_without_derivatives(ready: Assembled) -> None:
    subject = FingerSubject(ready, chosen(("finite_strain",), catalogue()))
    raw, phi = np.array([one.raw() for one in subject.parameters]), {"finite_strain.homotopy": 0.6}
    glanced, whole = subject.glance(raw, phi), subject.evaluate(raw, phi, tuple(phi))
    assert glanced.usable and whole.usable and glanced.theta_jacobian.shape == (len(subject.rows), 0)
    np.testing.assert_allclose(glanced.prediction, whole.prediction, rtol=1e-5)
    assert subject.glance(raw, {}) is None and subject.glance(raw, {"finite_strain.homotopy": 0.0}) is None


@pytest.mark.parametrize(("size", "own"), [(1.0, True), (1.6, False)])
def test_laws_are_followed_on_a_mesh_with_fewer_nodes_or_on_the_models_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: float, own: bool
) -> None:
    monkeypatch.setattr(variants, "ROUGH", size)
    made = variants.Variants(cylinder(tmp_path, "held", "held", pad=5.0), {}, "auto", 1.0)
    rough = made.rough({})
    assert (rough is made.base) is own
    assert own or len(rough.mesh.nodes) < len(made.base.mesh.nodes)


@pytest.mark.parametrize(("like", "own"), [(0.5, False), (1e-6, True)])
def test_laws_are_followed_on_the_models_own_mesh_where_a_coarser_one_reads_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, like: float, own: bool
) -> None:
    monkeypatch.setattr(variants, "ROUGH", 1.6)
    monkeypatch.setattr(elastic, "LIKE", like)
    subject = FingerSubject(cylinder(tmp_path, "held", "held", pad=5.0), chosen(("finite_strain",), catalogue()))
    assert (subject.elastic.variants.rough({}) is subject.base) is own


def test_laws_are_followed_on_the_models_own_mesh_where_a_coarser_one_cannot_be_laid_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = variants.Variants(cylinder(tmp_path, "held", "held", pad=5.0), {}, "auto", 1.0)

    def broken(*_: object, **__: object) -> Assembled:
        raise InputError("no skin faces -y at this (x, z)", remedy="a finer mesh")

    monkeypatch.setattr(variants, "assemble", broken)
    assert made.rough({}) is made.base
