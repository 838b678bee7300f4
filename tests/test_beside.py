"""Slopes towards another body, and of whatever a law of the tissue adds: each is the difference between two whole models."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from fingerjax.contact.chord import Chording
from fingerjax.effects import catalogue, chosen
from fingerjax.effects.records import Push
from fingerjax.fem.tissue import Linear
from fingerjax.forward import Assembled, assemble, rigs
from fingerjax.forward.strained import strained_readings
from fingerjax.runners import beyond
from fingerjax.runners.subject import FingerSubject

from .helpers import Grade
from .test_forward import BAR, FORCED, HELD, PLATE, PRESSED, RATES, at, study_of

SIZES = {
    "dermis_thickness.share": 0.2,
    "bone_offset.dorsal": 0.1,
    "bed_compliance.stiffness": 0.005,
    "contact_offset.offset": 0.05,
    "apparatus_compliance.compliance": 0.3,
}
LAW = {"strain_stiffening.skin": 4.0, "strain_stiffening.deep": 2.0}
SAME = Grade(1e-3, 1e-9, "the reference is a difference of two models, of a step that meshes and tips feel to second order")


@pytest.fixture(scope="module", autouse=True)
def coarse_wedge() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rigs, "LINE_SPACING", 2.0)
        patch.setattr(rigs, "RECEPTOR_SPACING", 4.0)
        patch.setattr(beyond, "SEARCHED", Chording(tolerance=1e-10))
        yield


@pytest.fixture(scope="module")
def ready(tmp_path_factory: pytest.TempPathFactory) -> Assembled:
    measured = {"plate": (PLATE, PRESSED[-2:]), "bar": (BAR, RATES[:2]), "held": (HELD, FORCED[:1])}
    return assemble(study_of(tmp_path_factory.mktemp("beside"), measured, {"free": ["epidermis.modulus", "adipose.modulus"]}))


def subject_with(ready: Assembled, *keys: str) -> FingerSubject:
    return FingerSubject(ready, chosen(tuple({key.split(".")[0]: None for key in keys}), catalogue()))


def check(subject: FingerSubject, phi: dict[str, float], keys: tuple[str, ...]) -> None:
    """Slopes at `phi` in some effects and in the first modulus against central differences, of each instrument by itself."""
    raw = np.array([one.raw() for one in subject.parameters])
    here = subject.evaluate(raw, phi, keys)
    assert here.usable
    scale = {column.key: column.scale for family in subject.families for column in family.columns}
    ways = [(key, here.phi_jacobian[:, number], 1e-3 * scale[key]) for number, key in enumerate(keys)]
    ways.append((subject.parameters[0].name, here.theta_jacobian[:, 0], 1e-4))

    def at_step(name: str, h: float) -> np.ndarray:
        if name in phi:
            return subject._value(raw, phi | {name: phi[name] + h})
        return subject._value(raw + h * np.array([one.name == name for one in subject.parameters]), phi)

    for name, found, h in ways:
        expected = (at_step(name, h) - at_step(name, -h)) / (2 * h)
        assert np.abs(expected).max() > 0, name
        for rows in subject.rows.blocks.values():
            SAME.check(found[rows], expected[rows])


def test_slopes_towards_another_body_are_differences_of_models(ready: Assembled) -> None:
    """Also of what a receptor reads whose element moves, and of a finger whose bone is carried and moves."""
    keys = ("dermis_thickness.share", "bone_offset.dorsal", "bed_compliance.stiffness")
    subject = subject_with(ready, *keys)
    assert subject.base.model.body.modes.shape[0] == 6
    check(subject, {key: SIZES[key] for key in keys}, keys)


def test_at_the_null_of_a_shape_its_column_is_the_tangent(ready: Assembled) -> None:
    keys = ("dermis_thickness.share", "bone_offset.dorsal")
    subject = subject_with(ready, *keys)
    raw = np.array([one.raw() for one in subject.parameters])
    columns = subject.columns(raw)
    for key in keys:
        up, down = (subject._value(raw, {key: sign * 1e-3}) for sign in (1, -1))
        expected = (up - down) / 2e-3
        assert np.linalg.norm(columns[key] - expected) < 2e-3 * np.linalg.norm(expected), key


def test_slopes_of_what_a_law_adds_are_differences_in_what_moves(ready: Assembled) -> None:
    """Of another body, and of what the indenter does."""
    keys = ("dermis_thickness.share", "contact_offset.offset")
    check(subject_with(ready, *keys, *LAW), LAW | {key: SIZES[key] for key in keys}, keys)


@pytest.mark.slow
def test_slopes_of_what_a_law_adds_are_differences_in_all_that_moves(ready: Assembled) -> None:
    keys = tuple(SIZES)
    check(subject_with(ready, *keys, *LAW), LAW | SIZES, keys)


def test_an_effect_on_what_skin_is_in_the_way_is_refused_under_a_law(ready: Assembled, monkeypatch: pytest.MonkeyPatch) -> None:
    offset = chosen(("contact_offset",), catalogue())[0]

    def push(self, push: Push, amount) -> Push:  # type: ignore[no-untyped-def]
        return Push(push.imposed, push.overlap + 1.0, push.area, push.series, push.forced, push.measurement)

    monkeypatch.setattr(type(offset), "push", push)
    subject = subject_with(ready, "contact_offset.offset", *LAW)
    law = subject.elastic.variants.together(subject.elastic.amounts(LAW)).law(Linear())
    with pytest.raises(ValueError, match="in the way"):
        strained_readings(subject.base.model, at(), law)
