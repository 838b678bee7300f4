"""The scan door, on surfaces made from a preset and torn, turned or scaled; and on a surface from elsewhere where there is one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from fingerjax.errors import InputError
from fingerjax.geometry.layers import LayerPlan, layered
from fingerjax.geometry.presets import preset
from fingerjax.geometry.scan import Frame, outline_from_scan, read_surface
from fingerjax.mesh.surface import closed_surface

TURN = trimesh.transformations.rotation_matrix(1.1, [0.3, -0.5, 0.8])
GIVEN = Frame(axis=(0.0, 0.0, 1.0), nail=(0.0, 1.0, 0.0))


def surface(spacing: float = 0.35) -> trimesh.Trimesh:
    points, faces = closed_surface(preset("monkey"), spacing)
    return trimesh.Trimesh(points, faces, process=False)


def written(mesh: trimesh.Trimesh, folder: Path, name: str = "finger.stl") -> Path:
    mesh.export(folder / name)
    return folder / name


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply"])
def test_sections_of_a_known_surface(tmp_path: Path, suffix: str) -> None:
    found = outline_from_scan(written(surface(), tmp_path, f"finger.{suffix}"), GIVEN)
    solid = preset("monkey")
    assert found.length == pytest.approx(solid.length, abs=1e-3)
    assert "watertight" in found.notes[0]
    theta = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    shift = -surface().vertices.mean(axis=0)[:2]  # a scan is moved to the middle of its points
    radii = found.radii(solid.centre(found.z) + shift, theta)
    miss = radii - solid.radius(0, found.z[:, None], theta[None, :])
    assert np.sqrt(np.mean(miss[found.z < 15.0] ** 2)) < 0.05


def test_axis_and_nail_side_are_found_in_a_turned_scan(tmp_path: Path) -> None:
    """The monkey's preset is fuller towards its pad, and cut square: both directions are found to within a degree or two."""
    mesh = surface()
    mesh.apply_transform(TURN)
    mesh.apply_translation([10.0, -40.0, 7.0])
    found = outline_from_scan(written(mesh, tmp_path), Frame())
    known = outline_from_scan(written(surface(), tmp_path, "straight.stl"), GIVEN)
    assert "found square to the flat cut" in found.notes[1] and "bulges" in found.notes[2]
    np.testing.assert_allclose(found.high - found.low, known.high - known.low, atol=0.05)
    middle = 0.5 * (found.high + found.low)[:, 1]
    np.testing.assert_allclose(middle - middle[0], (0.5 * (known.high + known.low))[:, 1] - 0.5 * (known.high + known.low)[0, 1], atol=0.05)


def test_an_open_end_is_taken_and_a_torn_side_is_refused(tmp_path: Path) -> None:
    mesh = surface()
    height = mesh.triangles_center[:, 2]
    mesh.update_faces(height > 1e-9)
    found = outline_from_scan(written(mesh, tmp_path), Frame(nail=(0, 1, 0)))
    assert "open along" in found.notes[0] and "open end" in found.notes[1]
    torn = surface()
    middle = torn.triangles_center
    torn.update_faces(~((np.abs(middle[:, 2] - 9.0) < 3.0) & (middle[:, 0] > 2.0)))
    with pytest.raises(InputError, match="not closed over the length"):
        outline_from_scan(written(torn, tmp_path), Frame(axis=(0, 0, 1), nail=(0, 1, 0), length=16.0))


def test_what_was_mended_is_said(tmp_path: Path) -> None:
    mesh = surface()
    crumb = trimesh.creation.icosphere(subdivisions=1, radius=0.3)
    crumb.apply_translation([20.0, 0.0, 5.0])
    faces = mesh.faces.copy()
    faces[::7] = faces[::7, ::-1]  # some triangles look inwards
    keep = np.ones(len(faces), bool)
    keep[600] = False  # a small hole
    broken = trimesh.util.concatenate([trimesh.Trimesh(mesh.vertices, faces[keep], process=False), crumb])
    points, triangles, repair = read_surface(written(broken, tmp_path, "broken.ply"))
    assert repair.watertight and repair.pieces == 2 and repair.filled >= 1 and repair.turned
    for word in ("watertight", "loose pieces", "put into holes", "turned outwards"):
        assert word in repair.note
    mended = trimesh.Trimesh(points, triangles)
    assert mended.volume == pytest.approx(surface().volume, rel=1e-3)


def test_what_is_no_finger_is_refused(tmp_path: Path) -> None:
    (tmp_path / "finger.step").write_text("x")
    (tmp_path / "finger.stl").write_bytes(b"solid nothing")
    small = surface()
    small.apply_scale(0.001)
    for path, says in (
        (tmp_path / "finger.step", "not a surface format"),
        (tmp_path / "finger.stl", "cannot be read|too few triangles"),
        (written(small, tmp_path, "metres.stl"), "give unit"),
    ):
        with pytest.raises(InputError, match=says):
            read_surface(path)
    assert np.ptp(read_surface(tmp_path / "metres.stl", "m")[0][:, 2]) == pytest.approx(preset("monkey").length, rel=1e-3)
    with pytest.raises(InputError, match="not a direction"):
        outline_from_scan(written(surface(), tmp_path, "a.stl"), Frame(axis=(0, 0, 1), nail=(0, 0, 2)))


def test_a_surface_from_elsewhere(measured: Path) -> None:
    """Its frame is known, and found: z to the tip, nail at +y."""
    path = measured / "scans" / "index_fingertip_template.stl"
    if not path.exists():
        pytest.skip(f"no scan at {path}")
    found, given = outline_from_scan(path, Frame()), outline_from_scan(path, GIVEN)
    np.testing.assert_allclose(found.high, given.high, atol=0.02)
    solid = layered(found, LayerPlan())
    assert solid.length == pytest.approx(25.0, abs=0.01)
    assert all(solid.volume(layer) > 0 for layer in range(5))
