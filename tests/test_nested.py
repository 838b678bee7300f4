"""Nested shells, and meshes made elsewhere: what every mesh of a finger must be, bounded as pytetwild's meshes are random."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import meshio
import numpy as np
import pytest
from test_columns import check, skin
from test_sections import NAIL, SHARES, ellipsoid

from fingerjax.errors import InputError
from fingerjax.finger import Finger
from fingerjax.geometry.presets import preset
from fingerjax.geometry.sections import LayeredSolid, solid_from_sections
from fingerjax.layers import BONE, SOFT_LAYERS
from fingerjax.mesh import Resolution, build_finger, finger_from_columns
from fingerjax.mesh.columns import columns
from fingerjax.mesh.files import export_vtu
from fingerjax.mesh.imported import read_mesh
from fingerjax.mesh.jacobian import volumes
from fingerjax.mesh.nested import layer_surface
from fingerjax.mesh.quality import dihedral_angles
from fingerjax.mesh.topology import boundary, divided


@cache
def half_ellipsoids() -> tuple[LayeredSolid, Finger]:
    s = ellipsoid()
    shares = np.array([1.0, 0.8, 0.6, 0.45, 0.3])
    square = shares**2 - (s.z[:, None] / 10.0) ** 2
    radii = np.sqrt(np.maximum(square[:, None, :], 0.0)) * (s.radii[0, :, 0] / SHARES[0])[None, :, None]
    solid = solid_from_sections(dataclasses.replace(s, radii=radii), NAIL)
    return solid, build_finger(solid, Resolution(pad=2.0), mesher="nested")


def test_nested_shells_mesh_within_the_bars() -> None:
    """Volumes, orientation, conformity, skin on the true surface, cut flat."""
    solid, finger = half_ellipsoids()
    off = finger.quality["off_surface"] + finger.quality["straightened"]
    assert off < 0.02 * len(finger.nodes)
    if not off:
        check(solid, finger)
    errors = finger.quality["volume_error"]
    assert max(abs(errors[name]) for name in SOFT_LAYERS) < 0.01 and abs(errors["bone"]) < 0.03
    assert finger.quality["straddling"] <= 0.005
    assert dihedral_angles(finger.nodes, finger.tets[:, :4]).min() > 1.0


def test_tags_of_nested_shells() -> None:
    _, finger = half_ellipsoids()
    np.testing.assert_array_equal(np.flatnonzero(finger.bone), np.unique(finger.tets[finger.layer == BONE]))
    assert finger.nail.sum() > 5 and np.isin(np.flatnonzero(finger.nail), finger.skin).all()
    assert finger.nodes[finger.proximal, 2].max() == 0.0
    soft = finger.without_bone()
    assert set(np.unique(soft.layer)) == {0, 1, 2, 3}


def test_the_surface_of_each_layer_is_closed() -> None:
    solid, _ = half_ellipsoids()
    for layer in range(5):
        made = layer_surface(solid, layer, 0.8)
        assert made is not None
        points, triangles = made
        pairs = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        assert (np.unique(pairs, axis=0, return_counts=True)[1] == 2).all()
        a, b, c = (points[triangles[:, i]] for i in range(3))
        enclosed = np.einsum("fi,fi->", np.cross(a, b), c) / 6.0
        assert enclosed == pytest.approx(sum(solid.volume(inner) for inner in range(layer, 5)), rel=0.05)


def test_triangles_are_divided_conformingly() -> None:
    points, triangles = skin(preset("monkey"), 8, 12)
    rim = len(boundary_edges(triangles))
    for times in (2, 3):
        more, cut = divided(points, triangles, times)
        assert len(cut) == times**2 * len(triangles) and len(boundary_edges(cut)) == times * rim
        np.testing.assert_array_equal(more[: len(points)], points)
        old, new = (np.cross(p[t[:, 1]] - p[t[:, 0]], p[t[:, 2]] - p[t[:, 0]]) for p, t in ((points, triangles), (more, cut)))
        np.testing.assert_allclose(new.sum(axis=0), old.sum(axis=0), atol=1e-9)
        assert np.linalg.norm(new, axis=1).sum() == pytest.approx(np.linalg.norm(old, axis=1).sum())


def boundary_edges(triangles: np.ndarray) -> np.ndarray:
    pairs = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, times = np.unique(pairs, axis=0, return_counts=True)
    assert times.max() == 2
    return unique[times == 1]


def test_several_elements_through_each_layer() -> None:
    solid = preset("monkey")
    one, two = (finger_from_columns(columns(solid, *skin(solid), through=through), "") for through in (1, 2))
    soft = [np.sum(each.layer < BONE) for each in (one, two)]
    assert soft[1] == 2 * soft[0]
    for layer in range(BONE):
        volume = [volumes(each.nodes, each.tets)[each.layer == layer].sum() for each in (one, two)]
        assert volume[1] == pytest.approx(volume[0], rel=0.01)


@cache
def small() -> Finger:
    solid = preset("monkey")
    return finger_from_columns(columns(solid, *skin(solid)), "")


@pytest.mark.parametrize("suffix", ["vtu", "vtk"])
def test_a_mesh_from_elsewhere_keeps_its_tags(tmp_path: Path, suffix: str) -> None:
    made = small()
    export_vtu(made, tmp_path / f"finger.{suffix}")
    read, solid = read_mesh(tmp_path / f"finger.{suffix}")
    assert len(read.nodes) == len(made.nodes) and len(read.tets) == len(made.tets)
    for name in ("nail", "bone", "proximal"):
        assert getattr(read, name).sum() == getattr(made, name).sum(), name
    np.testing.assert_array_equal(np.bincount(read.layer), np.bincount(made.layer))
    assert len(read.skin) == len(made.skin)
    assert volumes(read.nodes, read.tets).sum() == pytest.approx(volumes(made.nodes, made.tets).sum())
    known = preset("monkey")
    for layer in range(5):
        assert solid.volume(layer) == pytest.approx(known.volume(layer), rel=0.06)
    assert solid.pad_centre == pytest.approx(known.pad_centre, abs=1.0)


def test_straight_tetrahedra_and_a_bone_left_out_are_taken(tmp_path: Path) -> None:
    made = small().without_bone()
    corners = np.unique(made.tets[:, :4])
    number = np.full(len(made.nodes), -1)
    number[corners] = np.arange(len(corners))
    marks = {"bone": made.bone[corners].astype(np.int8)}
    cells = number[made.tets[:, :4]][:, [1, 0, 2, 3]]  # turned inside out, as some programs write them
    meshio.Mesh(made.nodes[corners] / 10, [("tetra", cells)], marks, {"gmsh:physical": [made.layer + 1]}).write(tmp_path / "soft.vtu")
    read, solid = read_mesh(tmp_path / "soft.vtu", preset("monkey").nail, "cm")
    assert volumes(read.nodes, read.tets).min() > 0
    assert len(read.skin) == len(made.skin) and read.bone.sum() == made.bone.sum()
    assert read.nail.any() and solid.length == pytest.approx(preset("monkey").length, rel=1e-6)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"cell_data": {}}, "does not say the layer"),
        ({"cell_data": {"layer": [small().layer + 3]}}, "unknown layer"),
        ({"points": small().nodes + np.array([0.0, 0.0, 4.0])}, "not at z = 0"),
        ({"point_data": {}}, "no node is nail"),
        ({"cells": [("triangle", small().skin[:, :3])], "cell_data": {}}, "no tetrahedra"),
    ],
)
def test_what_is_missing_in_a_mesh_is_named(tmp_path: Path, change: dict, says: str) -> None:
    made = small()
    parts = {
        "points": made.nodes,
        "cells": [("tetra10", made.tets)],
        "point_data": {"nail": made.nail.astype(np.int8)},
        "cell_data": {"layer": [made.layer + 1]},
    }
    meshio.Mesh(**(parts | change)).write(tmp_path / "odd.vtu")
    with pytest.raises(InputError, match=says) as caught:
        read_mesh(tmp_path / "odd.vtu")
    assert "odd.vtu" in str(caught.value)
    (tmp_path / "no.vtu").write_text("nothing")
    with pytest.raises(InputError, match="cannot be read as a mesh"):
        read_mesh(tmp_path / "no.vtu")


def test_layers_lost_in_the_envelope_are_refused() -> None:
    solid, _ = half_ellipsoids()
    radii = solid.sections.radii.copy()
    radii[..., 1:] = radii[..., :1] * np.array([1.0, 1.0, 1.0, 1.0])
    flat = dataclasses.replace(solid, sections=dataclasses.replace(solid.sections, radii=np.where(radii > 0, radii, 0.0)))
    with pytest.raises(InputError, match="no layer has a thickness"):
        build_finger(flat, Resolution(pad=1.2), mesher="nested")


def test_boundary_of_a_finger_is_skin_and_cut() -> None:
    _, finger = half_ellipsoids()
    outer = boundary(finger.tets[:, :4])
    cut = finger.proximal[outer].all(axis=1)
    assert len(finger.skin) + cut.sum() == len(outer)
