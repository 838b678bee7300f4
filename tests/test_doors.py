"""Every geometry door from experiments.yaml to a solid and a mesh; images are SYNTHETIC."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_nested import small
from test_scan import surface

from fingerjax.commands._resume import named_files
from fingerjax.errors import InputError
from fingerjax.forward.shape import mesh_of, solid_of
from fingerjax.geometry.presets import preset
from fingerjax.geometry.replica import Camera, write_views
from fingerjax.mesh.files import export_vtu
from fingerjax.report.mesh_picture import draw_mesh
from fingerjax.study import Study, load_studies

NAIL = "nail: {z_mm: [6.93, 14.52], theta_deg: [50, 130]}"


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FINGERJAX_CACHE", str(tmp_path / "cache"))


def study(folder: Path, finger: str) -> Study:
    (folder / "press.csv").write_text("displacement_mm,force_N\n0.5,0.1\n")
    (folder / "press.yaml").write_text("kind: force_displacement\nindenter: {shape: flat_plate}\n")
    text = f"version: 1\nkind: predict\nfinger: {finger}\nmodel: {{ratios: m43338}}\nmeasurements: [{{name: press, data: press.csv}}]\n"
    (folder / "experiments.yaml").write_text(text)
    return load_studies(folder / "experiments.yaml")["experiments"]


def test_images_become_a_layered_finger_once(tmp_path: Path) -> None:
    write_views(tmp_path / "replica", preset("monkey"), 30, Camera(pixel=0.1))
    said = study(tmp_path, "{images: replica, layers: {like: monkey, epidermis_mm: 0.3}}")
    heard: list[str] = []
    solid = solid_of(said, lambda share, what: heard.append(what))
    assert len(heard) == 30 and "view_007.png" in heard[7]
    known = preset("monkey")
    assert solid.volume(4) == pytest.approx(known.volume(4), rel=0.05)
    assert sum(solid.volume(k) for k in range(5)) == pytest.approx(sum(known.volume(k) for k in range(5)), rel=0.01)
    assert any("turning axis" in note for note in solid.notes) and any("nail assumed" in note for note in solid.notes)
    again: list[str] = []
    assert solid_of(said, lambda share, what: again.append(what)).digest == solid.digest and not again
    assert len({path.name for path in named_files(said, None)} & {f"view_{k:03d}.png" for k in range(30)}) == 30
    assert {"views.yaml", "press.csv", "press.yaml"} <= {path.name for path in named_files(said, None)}


def test_a_scan_becomes_a_layered_finger(tmp_path: Path) -> None:
    surface().export(tmp_path / "finger.ply")
    said = study(tmp_path, f"{{scan: {{file: finger.ply, nail: [0, 1, 0]}}, layers: {{like: monkey}}, {NAIL}}}")
    solid = solid_of(said)
    known = preset("monkey")
    assert sum(solid.volume(k) for k in range(5)) == pytest.approx(sum(known.volume(k) for k in range(5)), rel=0.01)
    assert solid.nail == known.nail or np.allclose(solid.nail.z, known.nail.z)
    assert "nail side given" in solid.notes


def test_a_mesh_from_elsewhere_is_taken_as_it_is(tmp_path: Path) -> None:
    export_vtu(small(), tmp_path / "finger.vtu")
    said = study(tmp_path, "{mesh: finger.vtu}")
    solid = solid_of(said)
    finger = mesh_of(said, solid)
    assert len(finger.nodes) == len(small().nodes) and finger.nail.sum() == small().nail.sum()
    shorter = study(tmp_path, "{mesh: finger.vtu, nail: {z_mm: [8.0, 12.0], theta_deg: [60, 120]}}")
    assert 0 < mesh_of(shorter, solid).nail.sum() < finger.nail.sum()


def test_a_file_of_the_data_folder_that_is_not_there_is_said_when_it_is_needed(tmp_path: Path) -> None:
    said = study(tmp_path, "{scan: 'data:scans/finger.stl'}")
    assert said.missing_data == ("scans/finger.stl",)
    with pytest.raises(InputError, match="name the data folder"):
        solid_of(said)


def test_a_mesh_is_drawn(tmp_path: Path) -> None:
    draw_mesh(tmp_path / "finger.png", small())
    assert (tmp_path / "finger.png").stat().st_size > 20_000
