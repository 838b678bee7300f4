"""Layers inside a measured skin: stated thickness, nesting, shortening, clamping, crossing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fingerjax.errors import InputError
from fingerjax.geometry.account import account, told
from fingerjax.geometry.layers import LayerPlan, layered
from fingerjax.geometry.outline import Outline
from fingerjax.geometry.presets import preset
from fingerjax.geometry.sections import Patch
from fingerjax.layers import BONE, LAYERS


def outline(name: str = "human") -> Outline:
    """The skin of a preset alone, cut at 60 heights."""
    solid = preset(name)
    u = np.linspace(1.0, 0.0, 61)[:-1]
    z = solid.length * (1.0 - 0.4 * u - 0.6 * u**2)
    theta = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    curves = tuple(solid.surface(np.full(360, level), theta)[:, :2] for level in z)
    return Outline(z, curves, np.array([*solid.centre(np.array([solid.length]))[0], solid.length]))


@pytest.mark.parametrize("name", ["human", "monkey"])
def test_a_presets_skin_gets_the_presets_layers_back(name: str) -> None:
    solid, known = layered(outline(name), LayerPlan(like=name)), preset(name)
    for layer, what in enumerate(LAYERS):
        assert solid.volume(layer) == pytest.approx(known.volume(layer), rel=0.001), what
    z = np.linspace(0.0, 0.97 * known.length, 60)[:, None]
    theta = np.linspace(0, 2 * np.pi, 60)[None, :]
    for layer in range(len(LAYERS)):
        bar = 0.1 if layer == BONE else 0.01  # mm; the bone ends bluntly between two sections
        assert np.abs(solid.radius(layer, z, theta) - known.radius(layer, z, theta)).max() < bar


@pytest.mark.parametrize("varies", ["scaled", "even"])
def test_thickness_at_the_centre_of_the_pad_is_the_stated_one(varies: str) -> None:
    solid = layered(outline(), LayerPlan(epidermis=0.4, dermis=0.8, varies=varies))
    pad = account(solid)["pad"]
    assert pad["epidermis"] == pytest.approx(0.4, abs=0.01) and pad["dermis"] == pytest.approx(0.8, abs=0.02)
    at, back = np.array([solid.pad_centre]), np.array([0.5 * np.pi])
    dorsal = float(solid.radius(0, at, back)[0] - solid.radius(1, at, back)[0])
    assert dorsal == pytest.approx(0.4, abs=0.01) if varies == "even" else dorsal < 0.3


def test_layers_end_one_inside_the_other_before_the_tip() -> None:
    solid = layered(outline(), LayerPlan())
    radii = solid.sections.radii
    ends = [solid.sections.z[(radii[:, :, layer] > 0).any(axis=1)].max() for layer in range(len(LAYERS))]
    assert (np.diff(ends) < 0).all()
    assert solid.length - ends[1] == pytest.approx(0.5, abs=0.1)
    assert (np.diff(radii, axis=2) <= 1e-9).all()


def test_skin_that_reaches_into_the_fibrous_matrix_is_refused() -> None:
    with pytest.raises(InputError, match="layers cross") as caught:
        layered(outline(), LayerPlan(epidermis=2.0, dermis=4.0))
    assert "theta" in str(caught.value) and "at most" in str(caught.value)


def test_a_bone_that_pierces_the_fibrous_matrix_is_clamped_and_said() -> None:
    solid = layered(outline(), LayerPlan(bone_height=(9.0, 8.0, 5.0)))
    assert any("bone clamped" in note and "deg" in note for note in solid.notes)
    assert (solid.sections.radii[:, :, BONE] <= solid.sections.radii[:, :, BONE - 1] + 1e-12).all()
    assert not any("clamped" in note for note in layered(outline(), LayerPlan()).notes)


def test_a_bone_of_its_own_sections(tmp_path: Path) -> None:
    rows = ["z_mm,theta_deg,r_mm"]
    for z, r in ((0.0, 2.0), (6.0, 1.8), (12.0, 1.6), (18.0, 1.5), (20.0, 0.0)):
        rows += [f"{z},{angle},{r}" for angle in range(0, 360, 30)]
    (tmp_path / "bone.csv").write_text("\n".join(rows))
    solid = layered(outline(), LayerPlan(bone_sections=tmp_path / "bone.csv"))
    assert solid.radius(BONE, np.array([6.0]), np.array([1.0]))[0] == pytest.approx(1.8, abs=0.02)
    (tmp_path / "bone.csv").write_text("\n".join(rows[:13]))
    with pytest.raises(InputError, match="too few sections of the bone"):
        layered(outline(), LayerPlan(bone_sections=tmp_path / "bone.csv"))


def test_a_centre_outside_the_skin_is_refused() -> None:
    with pytest.raises(InputError, match="outside the skin"):
        layered(outline(), LayerPlan(rise=0.55))


def test_nail_is_the_given_one_or_assumed_and_said() -> None:
    given = Patch(z=(10.0, 20.0), theta=(1.0, 2.0))
    assert layered(outline(), LayerPlan(), given).nail == given
    assumed = layered(outline(), LayerPlan())
    assert any("nail assumed" in note for note in assumed.notes) and assumed.nail.z[0] == pytest.approx(10.5)


def test_volumes_and_thicknesses_are_told_before_meshing() -> None:
    text = "\n".join(told(layered(outline(), LayerPlan())))
    for name in LAYERS:
        assert name in text
    assert "mm3" in text and "at the centre of the pad" in text and "note: nail assumed" in text
