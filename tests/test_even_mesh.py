"""Meshes of the loop: fine along the rim of a nail from which the bone hangs, and of about as many nodes as are allowed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fingerjax.forward import meshed, model
from fingerjax.forward.shape import RIM
from fingerjax.layers import SOFT_LAYERS
from fingerjax.mesh.contour import beyond
from fingerjax.runners import diagnosing
from fingerjax.study import Study

from .test_forward import PLATE, study_of

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


def test_the_rim_is_fine_where_the_bone_hangs_from_the_nail(tmp_path: Path) -> None:
    for bone in ("rigid", "held"):
        (tmp_path / bone).mkdir()
    coarser = {"pad_mm": 0.9, "proximal_mm": 2.4}
    hung, held = study(tmp_path / "rigid", "rigid", coarser), study(tmp_path / "held", "held", coarser)
    fine = longest_at_rim(hung, True)
    assert fine <= 2 * 0.8 * coarser["pad_mm"] * (1 + 1e-9)
    assert longest_at_rim(held, True) > fine and longest_at_rim(hung, False) > fine


def test_any_mesh_is_finer_along_the_rim_from_which_the_bone_hangs(tmp_path: Path) -> None:
    coarsest = {"pad_mm": 0.5, "proximal_mm": 1.5}
    for bone in ("rigid", "held"):
        (tmp_path / bone).mkdir()
    hung, held = (longest_at_rim(study(tmp_path / bone, bone, coarsest), False) for bone in ("rigid", "held"))
    assert hung <= 2 * RIM * coarsest["proximal_mm"] * (1 + 1e-9) < held


def test_elements_are_as_small_as_the_nodes_allow(tmp_path: Path) -> None:
    one = study(tmp_path, "rigid")
    whole = diagnosing._nodes(one, 1.0, True)
    size = diagnosing._size(one, int(0.5 * whole), 1.0, whole)
    assert size > 1.0 and 0.25 * whole < diagnosing._nodes(one, size, True) < 0.65 * whole


def test_a_mesh_whose_layers_are_too_large_or_small_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, heard = study(tmp_path, "rigid", {"pad_mm": 0.9, "proximal_mm": 1.8}), []
    _, finger = meshed(one, tell=lambda _, what: heard.append(what))
    assert heard == ["meshing"]
    off = finger.quality["volume_error"]
    worst = max(SOFT_LAYERS, key=lambda layer: abs(off[layer]))
    monkeypatch.setattr(model, "VOLUME", 0.5 * abs(off[worst]))
    meshed(one, tell=lambda _, what: heard.append(what))
    assert f"its {worst} is {100 * abs(off[worst]):.1f} %" in heard[-1] and "proximal_mm" in heard[-1]
