"""Bisection about a focus: fine where asked, conforming, and layers keep volume, surface and label."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from test_columns import check, skin

from fingerjax.errors import InputError
from fingerjax.finger import Finger
from fingerjax.forward.shape import nail_rim
from fingerjax.geometry.presets import preset
from fingerjax.geometry.sections import LayeredSolid
from fingerjax.layers import SOFT_LAYERS
from fingerjax.mesh import Focus, Resolution, build_finger, finger_from_columns
from fingerjax.mesh.columns import Columns, columns
from fingerjax.mesh.refine import allowed_edge, refine
from fingerjax.mesh.topology import edges

POINT = Focus("point", z=8.5, size=0.15)
LINE = Focus("line", z=8.5, size=0.25, extent=1.5)
ALONG = Focus("line", z=8.5, size=0.3, extent=2.0, along="z")


@cache
def coarse() -> tuple[LayeredSolid, Columns]:
    solid = preset("monkey")
    return solid, columns(solid, *skin(solid))


@cache
def refined(focus: Focus) -> Columns:
    return refine(coarse()[1], (focus,))


def surface_edges(finger: Finger) -> tuple[np.ndarray, np.ndarray]:
    corners = finger.nodes[finger.skin[:, :3]]
    return corners.mean(axis=1), np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=-1).max(axis=1)


@pytest.mark.parametrize("focus", [POINT, LINE, ALONG], ids=["point", "line across", "line along"])
def test_a_refined_mesh_is_still_a_mesh_of_the_solid(focus: Focus) -> None:
    solid, mesh = coarse()
    finer = refined(focus)
    assert len(finer.tets) > len(mesh.tets)
    check(solid, finger_from_columns(finer, "refined"))


@pytest.mark.parametrize("focus", [POINT, LINE, ALONG], ids=["point", "line across", "line along"])
def test_edges_at_the_focus_are_short_enough_and_far_ones_are_left(focus: Focus) -> None:
    solid, mesh = coarse()
    finger = finger_from_columns(refined(focus), "refined")
    middle, longest = surface_edges(finger)
    sites = focus.sites(solid)
    distance = np.linalg.norm(middle[:, None] - sites[None], axis=-1).min(axis=1)
    near = distance < 2 * focus.size
    assert near.sum() >= 8 and longest[near].max() <= 2 * focus.size * (1 + 1e-6)
    before, _ = surface_edges(finger_from_columns(mesh, "coarse"))
    far = before[before[:, 1] > 2.5]
    assert all(np.linalg.norm(middle - one, axis=1).min() < 1e-9 for one in far)


def test_elements_are_short_in_depth_too() -> None:
    solid, _ = coarse()
    mesh = refined(POINT)
    pairs, of = edges(mesh.tets, len(mesh.vertices))
    length = np.linalg.norm(np.diff(mesh.vertices[pairs], axis=1)[:, 0], axis=1)[of].max(axis=1)
    allowed = allowed_edge(solid, (POINT,), mesh.vertices[mesh.tets].mean(axis=1))
    soft = mesh.layer < 4
    assert (length[soft] <= allowed[soft] * (1 + 1e-6)).all()
    # a node spacing or two under the focus the mesh is still nearly as fine
    site = POINT.sites(solid)[0]
    below = site + np.array([0.0, 0.5, 0.0])
    nearest = np.argmin(np.linalg.norm(mesh.vertices[mesh.tets].mean(axis=1) - below, axis=1))
    assert length[nearest] < 4 * POINT.size


@pytest.mark.parametrize(("resolution", "rim"), [(Resolution(), 1.0), (Resolution(1.2, 1.8), 1.2)])
def test_vertices_that_had_to_wait_are_put_onto_their_interface(resolution: Resolution, rim: float) -> None:
    """Along the nail's rim edges are so long that one cut alone would fold the thin layer below it."""
    solid = preset("monkey")
    finger = build_finger(solid, resolution, nail_rim(solid, rim))
    assert finger.quality["on_chord"] <= 2  # of the bone, whose inside would fold
    assert all(abs(finger.quality["volume_error"][layer]) < 0.003 for layer in SOFT_LAYERS)


def test_no_focus_changes_nothing() -> None:
    _, mesh = coarse()
    same = refine(mesh, ())
    np.testing.assert_array_equal(same.tets, mesh.tets)
    assert len(same.skin) == len(mesh.skin)


def test_several_focuses_are_the_finest_of_each() -> None:
    solid, _ = coarse()
    points = solid.surface(np.array([8.5, 8.5]), np.array([1.5 * math.pi, 1.4 * math.pi]))
    both = allowed_edge(solid, (POINT, LINE), points)
    np.testing.assert_allclose(
        both, np.minimum(allowed_edge(solid, (POINT,), points), allowed_edge(solid, (LINE,), points))
    )


def test_a_line_lies_on_the_skin_within_its_extent() -> None:
    solid, _ = coarse()
    across = LINE.sites(solid)
    assert np.abs(solid.level(0, across)).max() < 1e-9
    assert 1.3 < across[:, 0].max() <= 1.5 and np.ptp(across[:, 2]) == 0.0
    assert np.linalg.norm(np.diff(across, axis=0), axis=1).max() <= 1.2 * LINE.size
    along = ALONG.sites(solid)
    assert along[:, 2].min() == pytest.approx(6.5) and along[:, 2].max() == pytest.approx(10.5)


@pytest.mark.parametrize("wrong", [{"kind": "disc"}, {"along": "y"}, {"size": 0.0}, {"extent": -1.0}])
def test_a_wrong_focus_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(InputError, match="focus"):
        Focus(**{"kind": "point", "z": 8.0, **wrong})  # type: ignore[arg-type]


def test_a_focus_off_the_finger_is_refused() -> None:
    with pytest.raises(InputError, match="not on the finger"):
        refine(coarse()[1], (Focus("point", z=40.0),))
