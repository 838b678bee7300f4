"""Sections: what is refused and how it is said; the solid through them against known radii and volumes."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from fingerjax.errors import InputError
from fingerjax.geometry.sections import Patch, Sections, solid_from_sections
from fingerjax.layers import LAYERS

NAIL = Patch(z=(2.0, 6.0), theta=(math.radians(50), math.radians(130)))
SHARES = np.array([1.0, 0.9, 0.75, 0.6, 0.4])
HEADER = "z_mm,theta_deg,cx_mm,cy_mm," + ",".join(f"r_{name}_mm" for name in LAYERS)


def ellipsoid(sections: int = 60, angles: int = 36) -> Sections:
    """Half of a nest of similar ellipsoids, half-axes (4, 5, 10) mm times a layer's share, cut at z = 0."""
    u = np.linspace(1.0, 0.0, sections)
    z = 10.0 * (1.0 - u**2)
    theta = 2 * np.pi * np.arange(angles) / angles
    polar = 1.0 / ((np.cos(theta) / 4.0) ** 2 + (np.sin(theta) / 5.0) ** 2)
    square = SHARES**2 - (z[:, None] / 10.0) ** 2
    radii = np.sqrt(np.maximum(square[:, None, :] * polar[None, :, None], 0.0))
    return Sections(z=z, theta=theta, centre=np.zeros((sections, 2)), radii=radii)


def lines(s: Sections) -> list[str]:
    out = ["# a comment", HEADER]
    for i, z in enumerate(s.z):
        for j, theta in enumerate(s.theta):
            numbers = [z, math.degrees(theta), *s.centre[i], *s.radii[i, j]]
            out.append(",".join(f"{number:.6f}" for number in numbers))
    return out


def written(tmp_path: Path, text: list[str]) -> Path:
    path = tmp_path / "sections.csv"
    path.write_text("\n".join(text) + "\n", encoding="utf-8")
    return path


def test_the_table_is_read_as_it_was_written(tmp_path: Path) -> None:
    s = ellipsoid(12, 24)
    read = Sections.from_csv(written(tmp_path, lines(s)))
    np.testing.assert_allclose(read.z, s.z, atol=1e-6)
    np.testing.assert_allclose(read.theta, s.theta, atol=1e-7)
    np.testing.assert_allclose(read.radii, s.radii, atol=1e-6)


def test_units_in_column_names_are_converted(tmp_path: Path) -> None:
    text = lines(ellipsoid(6, 12))
    in_cm = [text[1].replace("z_mm", "z_cm")]
    for row in text[2:]:
        cells = row.split(",")
        in_cm.append(",".join([f"{float(cells[0]) / 10:.8f}", *cells[1:]]))
    assert Sections.from_csv(written(tmp_path, in_cm)).z[-1] == pytest.approx(10.0)


def edited(row: int, column: int, value: str) -> list[str]:
    text = lines(ellipsoid(6, 12))
    cells = text[row].split(",")
    cells[column] = value
    text[row] = ",".join(cells)
    return text


def without_angle(degrees: str) -> list[str]:
    return [row for row in lines(ellipsoid(6, 12)) if row.split(",")[1:2] != [degrees]]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (edited(5, 4, "wide"), ["row 6", "r_epidermis", "wide"]),
        (edited(5, 4, ""), ["row 6", "r_epidermis"]),
        (edited(5, 4, "nan"), ["row 6", "finite"]),
        (edited(5, 1, "31"), ["row 6", "theta", "31 deg"]),
        (edited(5, 5, "9.0"), ["r_dermis", "increase inwards", "at most"]),
        (edited(5, 8, "-0.1"), ["r_bone", "negative", "-0.1"]),
        (edited(5, 2, "0.3"), ["row 6", "cx", "two centres"]),
        ([HEADER.replace("r_bone_mm", "r_bone")], ["no rows"]),
        ([HEADER.replace("r_bone_mm", "r_bone"), "0,0,0,0,1,1,1,1,1"], ["r_bone_mm"]),
        ([HEADER.replace("z_mm", "z_kg"), "0,0,0,0,1,1,1,1,1"], ["z_mm"]),
        (lines(ellipsoid(6, 12))[:-1], ["does not close", "11 angles, not 12"]),
        (without_angle("90.000000"), ["a gap of 60 deg", "missing"]),
        (lines(ellipsoid(6, 12))[:2] + lines(ellipsoid(6, 12))[14:], ["proximal cut"]),
        (lines(ellipsoid(6, 12))[:-24], ["cut open at the tip", "r_dermis"]),
    ],
)  # fmt: skip
def test_what_does_not_close_nest_or_read_is_refused_with_its_place(
    tmp_path: Path, text: list[str], says: list[str]
) -> None:
    path = written(tmp_path, text)
    with pytest.raises(InputError) as caught:
        Sections.from_csv(path)
    for words in [*says, "sections.csv"]:
        assert words in str(caught.value)


def test_a_hole_in_the_angles_is_refused() -> None:
    s = ellipsoid(8, 36)
    keep = np.r_[0:20, 24:36]
    with pytest.raises(InputError, match="angles are missing"):
        Sections(z=s.z, theta=s.theta[keep], centre=s.centre, radii=s.radii[:, keep])


def test_sections_that_go_back_are_refused() -> None:
    s = ellipsoid(8)
    z = s.z.copy()
    z[4] = z[3]
    with pytest.raises(InputError, match="does not increase"):
        Sections(z=z, theta=s.theta, centre=s.centre, radii=s.radii)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.csv"):
        Sections.from_csv(tmp_path / "nowhere.csv")


def test_a_nail_off_the_finger_is_refused() -> None:
    with pytest.raises(InputError, match="nail"):
        solid_from_sections(ellipsoid(), Patch(z=(2.0, 11.0), theta=(0.5, 2.0)))
    with pytest.raises(InputError, match="increasing"):
        Patch(z=(6.0, 2.0), theta=(0.5, 2.0))


def test_the_solid_goes_through_its_sections() -> None:
    s = ellipsoid()
    solid = solid_from_sections(s, NAIL)
    for layer in range(len(LAYERS)):
        radii = solid.radius(layer, s.z[:, None], s.theta[None, :])
        np.testing.assert_allclose(radii, s.radii[:, :, layer], atol=1e-8)


def test_volumes_of_nested_ellipsoids() -> None:
    solid = solid_from_sections(ellipsoid(), NAIL)
    whole = 2.0 / 3.0 * np.pi * 4.0 * 5.0 * 10.0 * SHARES**3
    for layer in range(len(LAYERS)):
        true = whole[layer] - (whole[layer + 1] if layer < 4 else 0.0)
        assert solid.volume(layer) == pytest.approx(true, rel=2e-3)


def test_the_level_set_is_signed_and_smooth_across_the_end_of_a_layer() -> None:
    solid = solid_from_sections(ellipsoid(), NAIL)
    axis = np.stack([np.zeros(400), np.zeros(400), np.linspace(3.0, 5.0, 400)], axis=1)
    level = solid.level(4, axis)  # the bone ends at z = 4
    end = axis[np.argmin(np.abs(level)), 2]
    assert end == pytest.approx(4.0, abs=0.02)
    slope = np.diff(level) / np.diff(axis[:, 2])
    assert slope.min() > 0 and np.abs(np.diff(slope)).max() < 0.05 * slope.max()


def test_points_are_sorted_into_layers() -> None:
    solid = solid_from_sections(ellipsoid(), NAIL)
    x = 4.0 * np.array([1.05, 0.95, 0.8, 0.7, 0.5, 0.2])
    points = np.stack([x, np.zeros(6), np.full(6, 1e-6)], axis=1)
    assert solid.layer_of(points).tolist() == [-1, 0, 1, 2, 3, 4]
    assert solid.layer_of(np.array([[0.0, 0.0, 10.5]])).tolist() == [-1]


def test_the_angle_wraps_and_the_pad_looks_down() -> None:
    solid = solid_from_sections(ellipsoid(), NAIL)
    z, theta = np.full(5, 3.0), np.array([-0.1, 0.3, 3.0, 4.0, 6.2])
    points = solid.surface(z, theta)
    np.testing.assert_allclose(solid.angle(points), np.mod(theta, 2 * np.pi), atol=1e-12)
    np.testing.assert_allclose(solid.radius(0, z, theta), solid.radius(0, z, theta + 4 * np.pi), atol=1e-12)
    assert solid.pad_y(np.array([3.0]))[0] == pytest.approx(-5.0 * math.sqrt(0.91), abs=1e-3)


def test_a_patch_covers_across_zero_degrees() -> None:
    patch = Patch(z=(0.0, 1.0), theta=(math.radians(-20), math.radians(20)))
    z = np.array([0.5, 0.5, 0.5, 1.5])
    theta = np.radians([350.0, 10.0, 30.0, 0.0])
    assert patch.covers(z, theta).tolist() == [True, True, False, False]
