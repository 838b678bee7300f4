"""Friction to first order: a cylinder between rough plates against its closed form, and in searches, alone and beside a law."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from fingerjax.effects import catalogue, chosen
from fingerjax.runners.subject import FingerSubject

from .helpers import DIFFERENCED
from .test_bodies import NU, cylinder, forces

KEY, LAW = "friction.coefficient", "finite_strain.homotopy"


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> FingerSubject:
    ready = cylinder(tmp_path_factory.mktemp("rough"), "sliding", "sliding", pad=8.0)
    return FingerSubject(ready, chosen(("friction", "finite_strain", "indenter_tilt", "contact_offset"), catalogue()))


def start(subject: FingerSubject) -> np.ndarray:
    return np.array([one.raw() for one in subject.parameters])


def value(subject: FingerSubject, raw: np.ndarray, phi: Mapping[str, float]) -> np.ndarray:
    return subject.evaluate(raw, phi, ()).prediction


def test_rough_plates_stiffen_a_cylinder_by_the_work_of_sliding(tmp_path: Path) -> None:
    """Uniaxial stress slides outwards by u_r = nu e r on both plates: dF = 2 mu F (2 nu / 3) R / h."""
    ready = cylinder(tmp_path, "sliding", "sliding", pad=3.75)
    rough = FingerSubject(ready, chosen(("friction",), catalogue()))
    expected = 2 * forces(ready) * (2 * NU / 3) * 25.0 / 30.0
    np.testing.assert_allclose(rough.columns(start(rough))[KEY], expected, rtol=0.005)


def test_without_friction_nothing_changes_and_with_it_all_grows_in_proportion(subject: FingerSubject) -> None:
    raw = start(subject)
    smooth, none, some, more = (value(subject, raw, phi) for phi in ({}, {KEY: 0.0}, {KEY: 0.1}, {KEY: 0.3}))
    np.testing.assert_array_equal(smooth, none)
    assert np.all(some > smooth)
    np.testing.assert_allclose(more - smooth, 3 * (some - smooth), rtol=1e-9)


@pytest.mark.parametrize("beside", [{"contact_offset.offset": 0.02}, {LAW: 0.5}], ids=["an offset", "a law"])
def test_slopes_with_friction_are_those_of_differences(subject: FingerSubject, beside: dict[str, float]) -> None:
    raw, phi = start(subject), {KEY: 0.2, **beside}
    found = subject.evaluate(raw, phi, tuple(phi))
    assert found.usable
    for number, (key, at) in enumerate(phi.items()):
        ends = [value(subject, raw, phi | {key: at + step}) for step in (1e-3, -1e-3)]
        DIFFERENCED.check(found.phi_jacobian[:, number], (ends[0] - ends[1]) / 2e-3)
    ends = [value(subject, raw + step, phi) for step in (1e-3, -1e-3)]
    DIFFERENCED.check(found.theta_jacobian[:, 0], (ends[0] - ends[1]) / 2e-3)
