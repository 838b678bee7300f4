"""One indentation that several measurements read is found once, and its slopes too."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from fingerjax.contact.chord import Chording
from fingerjax.effects import catalogue
from fingerjax.effects.added import Effects
from fingerjax.fem.tissue import AbstractTissue, Exponential, FiniteStrain
from fingerjax.forward import Assembled, assemble, echoes, rigs, strained, strained_slopes
from fingerjax.forward.model import changed
from fingerjax.forward.strained import impositions, strained_readings
from fingerjax.forward.strained_slopes import strained_jacobian

from .helpers import Grade
from .test_forward import BAR, PLATE, at, study_of

TIGHT = Chording(tolerance=1e-10)
SAME = Grade(1e-9, 1e-13, "the very same equilibrium, or one searched for in the same way")
MOVED = [{"position_mm": s, "depth_mm": 0.8, "rate_Hz": 40.0 - 5 * abs(s)} for s in (-2.0, 1.9)]
PRESSED = [{"displacement_mm": d, "force_N": 0.1 * d} for d in (0.4, 0.8)]


@pytest.fixture(scope="module", autouse=True)
def coarse() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rigs, "RECEPTOR_SPACING", 4.0)
        yield


@pytest.fixture(scope="module")
def twice(tmp_path_factory: pytest.TempPathFactory) -> Assembled:
    """A bar in two windows of time; a plate whose force is read in two sessions, in the second once more and deeper."""
    deeper = [*PRESSED, {"displacement_mm": 0.9, "force_N": 0.1}]
    measured = {"ramp": (BAR, MOVED), "hold": (BAR, MOVED), "plate": (PLATE, PRESSED), "again": (PLATE, PRESSED), "deeper": (PLATE, deeper)}
    return assemble(study_of(tmp_path_factory.mktemp("twice"), measured), solver="factorised")


def of(vector: jnp.ndarray) -> tuple[dict, AbstractTissue]:
    values = {**at(), "ramp.threshold": 2e-5, "hold.threshold": 3e-5, "epidermis.modulus": jnp.exp(vector[0])}
    return values, Exponential(FiniteStrain(), vector[1] * jnp.asarray([1.0, 1.0, 0.0, 0.0, 0.0]))


HERE = jnp.asarray([np.log(0.14), 5.0])


def test_what_is_pressed_twice_is_known_and_what_is_not_is_new(twice: Assembled) -> None:
    model = twice.model
    found = echoes.firsts(model, [impositions(model.instruments.added, rig, of(HERE)[0]) for rig in model.instruments.rigs])
    assert found[0] == [(0, 0), (0, 1)] and found[1] == [(0, 0), (0, 1)]
    assert found[2] == [(2, 0), (2, 1)] and found[3] == [(2, 0), (2, 1)]
    assert found[4][2] == (4, 2)  # nobody was there before


def test_a_force_that_is_read_twice_takes_one_equilibrium(tmp_path: Path) -> None:
    model = assemble(study_of(tmp_path, dict.fromkeys(("plate", "again"), (PLATE, PRESSED[:1]))), solver="factorised").model
    found = strained_readings(model, *of(HERE), chording=TIGHT)
    slopes = np.asarray(strained_jacobian(model, of, HERE, found))
    first, second = (rig[0] for rig in found.cases)
    assert first.iterations > 0 and second.iterations == second.factorisations == 0
    assert float(found.prediction.readings[0][0]) == float(found.prediction.readings[1][0]) > 0
    assert np.array_equal(slopes[0], slopes[1]) and np.all(slopes != 0)


@pytest.mark.slow
def test_equilibria_and_slopes_are_found_once_and_are_the_same(twice: Assembled, monkeypatch: pytest.MonkeyPatch) -> None:
    once = strained_readings(twice.model, *of(HERE), chording=TIGHT)
    slopes = np.asarray(strained_jacobian(twice.model, of, HERE, once))
    assert once.prediction.health.converged
    assert all(ended.iterations > 0 for number in (0, 2) for ended in once.cases[number])
    assert all(ended.iterations == 0 and ended.rest is not None for number in (1, 3) for ended in once.cases[number])
    for module in (strained, strained_slopes):
        monkeypatch.setattr(module, "firsts", lambda model, imposed: [[(n, c) for c in range(len(each))] for n, each in enumerate(imposed)])
    each = strained_readings(twice.model, *of(HERE), chording=TIGHT)
    assert all(ended.iterations > 0 for rig in each.cases for ended in rig)
    for one, other in zip(once.prediction.readings, each.prediction.readings, strict=True):
        SAME.check(np.asarray(one), np.asarray(other))
    SAME.check(slopes, np.asarray(strained_jacobian(twice.model, of, HERE, each)))


def test_an_effect_on_one_of_two_measurements_tells_them_apart(twice: Assembled) -> None:
    """A contact offset is for all measurements; an offset that is put into one push alone makes it a case of its own."""
    model = twice.model
    loads = [impositions(model.instruments.added, rig, of(HERE)[0]) for rig in model.instruments.rigs]
    loads[3] = [load._replace(travel=load.travel + 0.01) for load in loads[3]]
    assert echoes.firsts(model, loads)[3] == [(3, 0), (3, 1)]
    offset = next(effect for effect in catalogue(None) if effect.name == "contact_offset")
    shifted = changed(twice, Effects((offset,)))
    both = [impositions(shifted.model.instruments.added, rig, {"contact_offset.offset": 0.05}) for rig in shifted.model.instruments.rigs]
    assert echoes.firsts(shifted.model, both)[3] == [(2, 0), (2, 1)]
