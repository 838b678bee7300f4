"""A study's readings with tissue of any law: the linear engine at null, Newton's equilibria, warm starts, slopes, and what is not found."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from fingerjax._results import RESULTS
from fingerjax.contact.chord import Chording
from fingerjax.contact.indentation import Contact
from fingerjax.contact.strained import Indenting
from fingerjax.fem.equilibrium import Newton, Tissue, find
from fingerjax.fem.multigrid import hierarchy
from fingerjax.fem.solver import MultigridCG, solver_for
from fingerjax.fem.tissue import AbstractTissue, Exponential, FiniteStrain, Linear
from fingerjax.forward import Assembled, assemble, load_path, rigs
from fingerjax.forward.strained import Strained, place_of, strained_readings
from fingerjax.forward.strained_slopes import law_tangent, strained_jacobian

from .helpers import DIFFERENCED, SOLVED, Grade
from .test_forward import OF, PLATE, at, imposing, study_of

B = jnp.asarray([6.0, 6.0, 0.0, 0.0, 0.0])
STIFFENING = Exponential(FiniteStrain(), B)
NULLS = {"linear": Linear(), "homotopy 0 and b 0": Exponential(FiniteStrain(0.0), 0.0 * B)}
TIGHT = Chording(tolerance=1e-10)
EXACT = Grade(1e-8, 1e-13, "the linear engine's own factorisation answers")
SAME_STATE = Grade(1e-6, 1e-12, "two searches for one equilibrium, each to 1e-8")


@pytest.fixture(scope="module", autouse=True)
def coarse_wedge() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rigs, "LINE_SPACING", 2.0)
        patch.setattr(rigs, "RECEPTOR_SPACING", 4.0)
        yield


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory) -> Assembled:
    return assemble(study_of(tmp_path_factory.mktemp("strained"), OF), solver="factorised")


@pytest.fixture(scope="module")
def strained(everything: Assembled) -> Strained:
    return strained_readings(everything.model, at(), STIFFENING, chording=TIGHT)


def rows(found: Strained) -> np.ndarray:
    return np.concatenate([np.asarray(each) for each in found.prediction.readings])


@pytest.mark.slow
@pytest.mark.parametrize("law", NULLS.values(), ids=NULLS)
def test_null_tissue_reads_what_the_linear_engine_reads(everything: Assembled, law: AbstractTissue) -> None:
    found, linear = strained_readings(everything.model, at(), law), everything.predict(at())
    assert found.prediction.health.converged and found.factorisations == 0
    assert all(ended.iterations == 2 for rig in found.cases for ended in rig)
    for mine, theirs in zip(found.prediction.readings, linear.readings, strict=True):
        EXACT.check(mine, theirs)
    for mine, theirs in zip(found.prediction.quantity, linear.quantity, strict=True):
        EXACT.check(mine, theirs)


@pytest.mark.slow
def test_every_case_rests_where_newton_finds_it_to(everything: Assembled, strained: Strained) -> None:
    """A plate, a wedge and a bar by travel, and a plate by force, each against Newton's method from rest with its own tangents."""
    assert strained.prediction.health.converged and strained.prediction.residual < TIGHT.tolerance
    model = everything.model
    tissue = Tissue(model.body, STIFFENING, model.instruments.materials(at())[0].lame(), model.solver)
    linear = np.concatenate([np.asarray(each) for each in everything.predict(at()).readings])
    assert np.abs(rows(strained) / linear - 1).max() > 0.05
    for rig, cases in zip(model.instruments.rigs, strained.cases, strict=True):
        case = int(np.argmax(rig.imposed))
        place, _ = place_of(model, rig, int(rig.pose[case]), tissue)
        control = {"force" if rig.forced else "travel": rig.imposed[case]}
        newton = find(tissue, Indenting(place.columns, place.interface, sharp=place.sharp, **control), Newton(1e-8))
        rest = cases[case].rest
        assert newton.result.ok and rest is not None
        SAME_STATE.check(rest.displacement, newton.state.displacement.ravel())
        SAME_STATE.check(rest.contact.nodal_forces, newton.state.detail.nodal_forces)
        SAME_STATE.check(rest.contact.travel, newton.state.travel)


@pytest.mark.slow
def test_a_case_that_is_far_from_the_one_before_is_reached_in_steps(everything: Assembled, monkeypatch: pytest.MonkeyPatch) -> None:
    """Searches that fail where the indenter goes more than 0.3 mm beyond the skin at once, and no Newton's method to stand in."""
    search, refused = load_path._by_chords, []

    def near_sighted(tissue, place, chord, imposed, begin, chording):  # type: ignore[no-untyped-def]
        if imposed.travel is not None and begin[0].any() and imposed.travel - np.abs(begin[0]).max() > 0.3:
            refused.append(imposed)
            return load_path.Ended(None, 1, 0, 0, False, RESULTS.no_equilibrium), chord
        return search(tissue, place, chord, imposed, begin, chording)

    whole = rows(strained_readings(everything.model, at(), STIFFENING, chording=TIGHT))
    monkeypatch.setattr(load_path, "_by_chords", near_sighted)
    monkeypatch.setattr(load_path, "_by_newton", lambda *given: given[-1])
    SAME_STATE.check(rows(strained_readings(everything.model, at(), STIFFENING, chording=TIGHT)), whole)
    assert refused


@pytest.mark.slow
def test_a_warm_start_saves_iterations_and_changes_nothing(everything: Assembled, strained: Strained) -> None:
    again = strained_readings(everything.model, at(), STIFFENING, start=strained)
    assert all(ended.iterations == 1 and ended.factorisations <= 1 for rig in again.cases for ended in rig)  # where one was needed
    SOLVED.check(rows(again), rows(strained))
    near = at(epidermis=1.02, dermis=0.97)
    warm, cold = (strained_readings(everything.model, near, STIFFENING, start=start) for start in (strained, None))
    assert warm.iterations < 0.8 * cold.iterations
    SAME_STATE.check(rows(warm), rows(cold))


def on_more_hats(contact: Contact) -> Contact:
    """As an indenter that leans or is wider would have left it: on a pad that is cut from the skin elsewhere."""
    return eqx.tree_at(lambda one: one.active, contact, jnp.concatenate([contact.active, jnp.ones(3, bool)]))


@pytest.mark.slow
def test_a_start_from_under_another_indenter_gives_no_hats(everything: Assembled, strained: Strained) -> None:
    cases = tuple(
        tuple(ended._replace(rest=ended.rest and ended.rest._replace(contact=on_more_hats(ended.rest.contact))) for ended in rig)
        for rig in strained.cases
    )
    again = strained_readings(everything.model, at(), STIFFENING, start=dataclasses.replace(strained, cases=cases))
    SAME_STATE.check(rows(again), rows(strained))


def law(phi: jnp.ndarray) -> AbstractTissue:
    """The homotopy, and the stiffening of the two outer layers."""
    return Exponential(FiniteStrain(phi[0]), jnp.zeros(5).at[:2].set(phi[1:]))


@pytest.mark.slow
def test_the_tangent_at_null_is_that_of_strained_readings(everything: Assembled) -> None:
    null, h = jnp.zeros(3), 2e-4
    columns = np.asarray(law_tangent(everything.model, at(), law, null))
    assert np.abs(columns).max(axis=0).min() > 0
    for parameter in range(3):
        up, down = (rows(strained_readings(everything.model, at(), law(null.at[parameter].set(s)), chording=TIGHT)) for s in (h, -h))
        DIFFERENCED.check(columns[:, parameter], (up - down) / (2 * h))
    with pytest.raises(ValueError, match="not linear"):
        law_tangent(everything.model, at(), law, null.at[0].set(1.0))


def of(vector: jnp.ndarray) -> tuple[dict, AbstractTissue]:
    """Logarithms of two moduli, a threshold, the homotopy and one stiffening for both outer layers."""
    values = {**at(), "bar.threshold": vector[2], "epidermis.modulus": jnp.exp(vector[0]), "adipose.modulus": jnp.exp(vector[1])}
    return values, law(jnp.stack([vector[3], vector[4], vector[4]]))


@pytest.mark.slow
def test_slopes_at_strained_states_match_differences(everything: Assembled) -> None:
    here = jnp.asarray([np.log(0.14), np.log(0.012), 2e-5, 0.9, 5.0])
    found = strained_readings(everything.model, *of(here), chording=TIGHT)
    slopes = np.asarray(strained_jacobian(everything.model, of, here, found))
    for parameter, h in enumerate((1e-4, 1e-4, 1e-7, 1e-4, 1e-3)):
        ends = (strained_readings(everything.model, *of(here.at[parameter].add(s)), start=found, chording=TIGHT) for s in (h, -h))
        up, down = (rows(each) for each in ends)
        DIFFERENCED.check(slopes[:, parameter], (up - down) / (2 * h))


@pytest.mark.slow
def test_fingers_in_proportion_share_their_shapes(tmp_path: Path) -> None:
    """One search and one tangent for both, with forces and slopes in proportion, as each by itself has them."""
    pressed = [{"subject": name, "displacement_mm": d, "force_N": 0.1} for name in "ab" for d in (0.3, 0.6)]
    study = study_of(tmp_path, {"plate": (PLATE, pressed)}, {"free": ["stiffness"], "per": {"stiffness": "subject"}})
    ready = assemble(study, solver="factorised")

    def given(vector: jnp.ndarray) -> tuple[dict, AbstractTissue]:
        return {"stiffness[a]": jnp.exp(vector[0]), "stiffness[b]": jnp.exp(vector[1])}, law(jnp.stack([vector[2], vector[3], vector[3]]))

    here = jnp.asarray([0.0, np.log(2.5), 0.9, 5.0])
    found = strained_readings(ready.model, *given(here), chording=TIGHT)
    force, iterations = rows(found), [ended.iterations for ended in found.cases[0]]
    SAME_STATE.check(force[2:], 2.5 * force[:2])
    assert max(iterations[2:]) <= 3 < min(iterations[:2]) and found.prediction.health.converged
    slopes = np.asarray(strained_jacobian(ready.model, given, here, found))
    SAME_STATE.check(slopes[2:, 1], force[2:])
    assert not slopes[:2, 1].any() and not slopes[2:, 0].any()
    SAME_STATE.check(slopes[2:, 2:], 2.5 * slopes[:2, 2:])
    up, down = (rows(strained_readings(ready.model, *given(here.at[3].add(s)), start=found, chording=TIGHT)) for s in (1e-3, -1e-3))
    DIFFERENCED.check(slopes[:, 3], (up - down) / 2e-3)


@pytest.mark.slow
def test_what_is_not_found_has_no_number(everything: Assembled, strained: Strained) -> None:
    """A plate that goes through the finger; and slopes there."""
    model = everything.model
    deep = imposing(everything, 0, [0.37, 9.0])
    found = strained_readings(deep.model, at(), STIFFENING)
    assert not found.prediction.health.converged and found.cases[0][1].result is not RESULTS.successful
    assert np.isnan(found.prediction.readings[0]).tolist() == [False, True]
    SAME_STATE.check(found.prediction.readings[0][0], strained.prediction.readings[0][0])
    cut = dataclasses.replace(model, solver=MultigridCG(hierarchy(model.body), max_steps=3))
    short = strained_readings(cut, at(), STIFFENING)
    assert not short.prediction.converged and np.isnan(rows(short)).all()


@pytest.mark.slow
def test_iterations_find_what_the_factorisation_finds(everything: Assembled, strained: Strained) -> None:
    multigrid = dataclasses.replace(everything.model, solver=solver_for(everything.model.body, "multigrid"))
    SAME_STATE.check(rows(strained_readings(multigrid, at(), STIFFENING)), rows(strained))
