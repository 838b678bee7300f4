"""The presets keep the dimensions that they state."""

from __future__ import annotations

import numpy as np
import pytest

from fingerjax.errors import InputError
from fingerjax.geometry.presets import HUMAN, MONKEY, PRESETS, preset
from fingerjax.layers import LAYERS
from fingerjax.mesh.columns import Rays


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_width_height_and_skin_are_the_stated_ones(name: str) -> None:
    solid, stated = preset(name), PRESETS[name]
    z = stated.pad_at * stated.length
    ring = solid.surface(np.full(720, z), np.linspace(0, 2 * np.pi, 720))
    assert np.ptp(ring[:, 0]) == pytest.approx(stated.width, rel=0.02)
    assert np.ptp(ring[:, 1]) == pytest.approx(stated.height, rel=0.005)
    pad = [solid.surface(np.array([z]), np.array([1.5 * np.pi]), layer)[0, 1] for layer in range(3)]
    assert pad[1] - pad[0] == pytest.approx(stated.epidermis, abs=1e-3)
    assert pad[2] - pad[1] == pytest.approx(stated.dermis, abs=1e-3)


def test_widths_lie_in_the_papers_ranges_and_monkey_skin_is_scaled() -> None:
    assert 16.0 <= HUMAN.width <= 20.0 and 8.0 <= MONKEY.width <= 10.0
    assert MONKEY.epidermis / HUMAN.epidermis == pytest.approx(MONKEY.height / HUMAN.height)
    assert HUMAN.epidermis == 0.5 and HUMAN.dermis == 1.0


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_layers_nest_and_end_one_inside_the_other(name: str) -> None:
    solid = preset(name)
    radii = solid.sections.radii
    assert (np.diff(radii[:-1, :, :3], axis=-1) < 0).any()
    ends = [solid.sections.z[(radii[:, :, layer] > 0).any(axis=1)].max() for layer in range(len(LAYERS))]
    assert (np.diff(ends) < 0).all()
    # The fibrous matrix is thinnest between the base of the bone and the nail; the mesher thickens what is below `thinnest`.
    assert (radii[0, :, 3] - radii[0, :, 4]).min() > 2.0 * Rays(solid).thinnest
    assert min(solid.volume(layer) for layer in range(len(LAYERS))) > 0


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_the_pad_is_fuller_than_the_dorsum_and_the_bone_nearer_to_the_nail(name: str) -> None:
    solid = preset(name)
    z = np.array([solid.pad_centre])
    top, bottom = (
        solid.radius(0, z, np.array([0.5 * np.pi]))[0],
        solid.radius(0, z, np.array([1.5 * np.pi]))[0],
    )
    assert bottom > 1.5 * top
    ring = solid.surface(np.full(720, z[0]), np.linspace(0, 2 * np.pi, 720))
    assert ring[np.argmax(ring[:, 0]), 1] < 0.0


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_the_surface_has_no_kinks(name: str) -> None:
    """Slopes of neighbouring pieces differ by little, along the pad and around a section."""
    solid = preset(name)
    z = np.linspace(0.02, 0.9, 600) * solid.length
    along = np.gradient(solid.pad_y(z), z)
    assert np.abs(np.diff(along)).max() < 0.05
    theta = np.linspace(0, 2 * np.pi, 1500)
    around = np.gradient(solid.radius(0, np.full(1500, solid.pad_centre), theta), theta)
    assert np.abs(np.diff(around)).max() < 0.02 * solid.largest_radius


def test_an_unknown_preset_is_refused() -> None:
    with pytest.raises(InputError, match="monkey or human"):
        preset("mouse")
