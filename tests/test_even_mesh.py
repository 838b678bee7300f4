"""Meshes of the loop: fine along the rim of a nail from which the bone hangs, and of about as many nodes as are allowed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fingerjax.forward import meshed, model
from fingerjax.forward.model import SHARP
from fingerjax.forward.rigs import PROBE_SPACING, SPHERE_SPACING
from fingerjax.forward.shape import RIM
from fingerjax.layers import SOFT_LAYERS
from fingerjax.mesh.contour import beyond
from fingerjax.runners import diagnosing
from fingerjax.study import Study

from .test_forward import PLATE, SITE, study_of

COARSE = {"pad_mm": 0.6, "proximal_mm": 2.4}


def study(folder: Path, bone: str, resolution: dict[str, float] = COARSE) -> Study:
    rows = [{"displacement_mm": 0.4, "force_N": 0.1}, {"displacement_mm": 0.8, "force_N": 0.2}]
    files, free = {"plate": (PLATE, rows)}, {"free": ["epidermis.modulus"]}
    model = {"ratios": "m43338", "epidermis_MPa": 0.14, "bone": bone}
    return study_of(folder, files, free, finger={"preset": "monkey", "resolution": resolution}, model=model)


def longest_at_rim(one: Study, even: bool) -> float:
    """Longest edge, mm, of the skin's triangles that have a corner on the rim of the nail."""
    solid, mesh = meshed(one, even=even)
    corners = mesh.nodes[mesh.skin[:, :3]]
    near = (np.abs(beyond(solid, corners.reshape(-1, 3))).reshape(-1, 3).min(axis=1) < 0.2) & (corners[:, :, 1].mean(axis=1) > 0)
    return float(np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2)[near].max())


@pytest.mark.parametrize(("even", "allowed"), [(True, 0.8 * 0.9), (False, RIM * 2.4)], ids=["even", "as asked"])
def test_the_rim_is_fine_where_the_bone_hangs_from_the_nail(tmp_path: Path, even: bool, allowed: float) -> None:
    coarser = {"pad_mm": 0.9, "proximal_mm": 2.4}
    for bone in ("rigid", "held"):
        (tmp_path / bone).mkdir()
    hung, held = (longest_at_rim(study(tmp_path / bone, bone, coarser), even) for bone in ("rigid", "held"))
    assert hung <= 2 * allowed * (1 + 1e-9) < held


def test_an_even_mesh_is_fine_where_a_ball_touches(tmp_path: Path) -> None:
    radius = 3.0
    ball = PLATE | {"indenter": {"shape": "sphere", "radius_mm": radius}}
    rows = [{"displacement_mm": 0.3, "force_N": 0.1}, {"displacement_mm": 1.2, "force_N": 0.2}]
    model = {"ratios": "m43338", "epidermis_MPa": 0.14, "bone": "held"}
    finger = {"preset": "monkey", "resolution": COARSE}
    one = study_of(tmp_path, {"ball": (ball, rows)}, {"free": ["epidermis.modulus"]}, finger=finger, model=model)
    touching = np.sqrt(radius * min(1.2, radius))
    for size in (3.0, 5.0):
        solid, mesh = meshed(one, size=size, even=True)
        corners = mesh.nodes[mesh.skin[:, :3]]
        under = solid.surface(np.array([SITE["z_mm"]]), np.array([1.5 * np.pi]))
        near = np.linalg.norm(corners.mean(axis=1) - under, axis=1) < 0.8 * touching
        edges = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2)
        assert edges[near].max() <= 2 * size * SPHERE_SPACING * touching * (1 + 1e-9) < 0.5 * edges.max()


def test_a_small_probe_touches_nodes_of_an_even_mesh_however_coarse(tmp_path: Path) -> None:
    probe = PLATE | {"indenter": {"shape": "point", "radius_mm": 0.25}}
    rows = [{"displacement_mm": 0.3, "force_N": 0.1}, {"displacement_mm": 1.2, "force_N": 0.2}]
    finger = {"preset": "human", "resolution": {"pad_mm": 2.0, "proximal_mm": 5.0, "least_mm": 0.35}}
    one = study_of(tmp_path, {"probe": (probe, rows)}, {"free": ["epidermis.modulus"]}, finger=finger)
    solid, mesh = meshed(one, size=5.3, even=True)
    under = solid.surface(np.array([SITE["z_mm"]]), np.array([1.5 * np.pi]))
    assert np.linalg.norm(mesh.nodes - under, axis=1).min() < 0.25
    faces = mesh.nodes[mesh.skin[:, :3]]
    edges = np.linalg.norm(faces - faces[:, [1, 2, 0]], axis=2).max(axis=1)
    assert edges[np.linalg.norm(faces.mean(axis=1) - under, axis=1).argmin()] <= 2 * 0.35 * (1 + 1e-9)


def longest_under_probe(one: Study, size: float, radius: float, *, sharp: bool) -> float:
    """Longest edge, mm, of the skin's triangles in the middle of the probe's foot."""
    solid, mesh = meshed(one, size=size, even=True, sharp=sharp)
    corners = mesh.nodes[mesh.skin[:, :3]]
    under = solid.surface(np.array([SITE["z_mm"]]), np.array([1.5 * np.pi]))
    edges = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2)
    return float(edges[np.linalg.norm(corners.mean(axis=1) - under, axis=1) < 0.7 * radius].max())


def test_a_finer_mesh_is_as_fine_under_a_probe_as_that_needs_whatever_its_size(tmp_path: Path) -> None:
    radius = 1.0
    probe = PLATE | {"indenter": {"shape": "point", "radius_mm": radius, "edge_radius_mm": 0.5}}
    rows = [{"displacement_mm": 0.25, "force_N": 0.1}, {"displacement_mm": 1.0, "force_N": 0.2}]
    model = {"ratios": "m43338", "epidermis_MPa": 0.14, "bone": "held"}
    finger = {"preset": "monkey", "resolution": COARSE}
    one = study_of(tmp_path, {"probe": (probe, rows)}, {"free": ["epidermis.modulus"]}, finger=finger, model=model)
    size = 3.0
    longest = {sharp: longest_under_probe(one, size, radius, sharp=sharp) for sharp in (True, False)}
    assert longest[True] <= 2 * SHARP * radius * (1 + 1e-9) < longest[False] <= 2 * size * PROBE_SPACING * radius * (1 + 1e-9)


@pytest.mark.slow  # a diagnosis that is told its nodes looks for them too
def test_elements_are_as_small_as_the_nodes_allow(tmp_path: Path) -> None:
    one = study(tmp_path, "rigid")
    whole = diagnosing._nodes(one, 1.0, True)
    size = diagnosing._size(one, int(0.5 * whole), 1.0, whole)
    assert size > 1.0 and 0.25 * whole < diagnosing._nodes(one, size, True) < 0.65 * whole


def test_where_fewer_nodes_are_asked_for_than_a_mesh_can_have_the_finer_one_is_finer_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, least = study(tmp_path, "rigid"), 2_400

    def nodes(_: Study, size: float, even: bool, *, sharp: bool = False) -> int:
        return max(round(66_000 / size**1.5), least)

    monkeypatch.setattr(diagnosing, "_nodes", nodes)
    size = diagnosing._size(one, 1_500, 1.0, nodes(one, 1.0, True))
    assert nodes(one, size, True) == least
    assert nodes(one, diagnosing._finer(one, size, True), True) > 2 * least


def test_a_mesh_whose_layers_are_too_large_or_small_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, heard = study(tmp_path, "rigid", {"pad_mm": 0.9, "proximal_mm": 1.8}), []
    off = meshed(one)[1].quality["volume_error"]
    worst = max(SOFT_LAYERS, key=lambda layer: abs(off[layer]))
    for allowed in (1.01, 0.99):
        monkeypatch.setattr(model, "VOLUME", allowed * abs(off[worst]))
        assert len(heard) < 2  # what is allowed is not told
        meshed(one, tell=lambda _, what: heard.append(what))
    assert f"its {worst} is {100 * abs(off[worst]):.1f} %" in heard[-1] and "proximal_mm" in heard[-1]
