"""The silhouette door, tried on SYNTHETIC photographs of a replica whose shape is known."""

from __future__ import annotations

import re
import shutil
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest
import yaml
from PIL import Image

from fingerjax.errors import InputError
from fingerjax.geometry.borders import border, read_picture
from fingerjax.geometry.outline import Outline
from fingerjax.geometry.presets import preset
from fingerjax.geometry.replica import Camera, photograph, write_views
from fingerjax.geometry.silhouette import envelope, outline_from_views
from fingerjax.geometry.views import NAME, read_views

COARSE = Camera(pixel=0.08, eccentric=0.2, offset=0.3, roll=1.5, elevation=1.5)


@cache
def replica() -> Path:
    """Thirty-six synthetic views of the monkey, kept for this run of the tests."""
    return write_views(Path(mkdtemp(prefix="replica-")), preset("monkey"), 36, COARSE).parent


@cache
def found() -> Outline:
    return outline_from_views(read_views(replica()))


def error(outline: Outline, degrees: tuple[float, float]) -> np.ndarray:
    """Radius of the outline less that of the replica, mm, about the replica's own centre, over a range of angles."""
    solid = preset("monkey")
    theta = np.radians(np.arange(*degrees, 2.0))
    centre = solid.centre(outline.z) + np.array([COARSE.eccentric, 0.0])
    true = solid.radius(0, outline.z[:, None], theta[None, :])
    return outline.radii(centre, theta) - true


def test_the_skin_is_found_to_a_fraction_of_a_pixel() -> None:
    """A pixel is 0.08 mm here, light falls off by 40 %, and the camera leans, looks down and is off its axis."""
    for degrees, rms in (((200.0, 340.0), 0.012), ((20.0, 160.0), 0.012)):
        miss = error(found(), degrees)[found().z < 0.97 * found().length]
        assert np.sqrt(np.mean(miss**2)) < rms


def test_axis_offset_and_tilts_are_found_and_told() -> None:
    offset, roll, elevation = (float(number) for number in re.findall(r"[+-]\d+\.\d+", found().notes[0]))
    assert offset == pytest.approx(COARSE.offset, abs=0.05)
    assert roll == pytest.approx(COARSE.roll, abs=0.05) and elevation == pytest.approx(COARSE.elevation, abs=0.2)
    assert "corrected" in found().notes[0] and found().length == preset("monkey").length


def test_the_border_distance_is_not_the_radius() -> None:
    """Ellipse: h = sqrt(a^2 cos^2 + b^2 sin^2); its envelope is the ellipse, h itself bulges outside it."""
    phi = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    a, b = 4.0, 3.0
    h = np.hypot(a * np.cos(phi), b * np.sin(phi))
    slope = (b**2 - a**2) * np.sin(phi) * np.cos(phi) / h
    x, y = envelope(h, slope, phi).T
    np.testing.assert_allclose((x / a) ** 2 + (y / b) ** 2, 1.0, atol=1e-12)
    radius = 1.0 / np.hypot(np.cos(phi) / a, np.sin(phi) / b)
    assert (h - radius).max() > 0.1 and (h - radius).min() > -1e-12


def test_turning_the_other_way_and_lying_pictures_give_the_same_finger(tmp_path: Path) -> None:
    said = yaml.safe_load((replica() / NAME).read_text())
    views = said["views"]
    for number, view in enumerate(views):  # clockwise: the same pictures in the other order
        view["file"] = str(replica() / views[-number % len(views)]["file"]) if number else str(replica() / view["file"])
    files = [str(replica() / f"view_{-number % len(views):03d}.png") for number in range(len(views))]
    said["views"] = [{"file": file, "angle_deg": view["angle_deg"]} for file, view in zip(files, views, strict=True)]
    said["turn"] = "clockwise"
    (tmp_path / NAME).write_text(yaml.safe_dump(said))
    other = outline_from_views(read_views(tmp_path / NAME))
    np.testing.assert_allclose(other.low, found().low, atol=1e-6)
    picture, _ = read_picture(replica() / "view_000.png")
    turned, _ = read_picture(replica() / "view_000.png", tip="left")
    np.testing.assert_array_equal(turned, np.rot90(picture, 3))


def test_a_light_replica_before_a_dark_ground_is_seen_too() -> None:
    camera = Camera(pixel=0.08, bright=True, roll=0.0, offset=0.0, eccentric=0.0)
    dark = Camera(pixel=0.08, bright=False, roll=0.0, offset=0.0, eccentric=0.0)
    tops = [border(photograph(preset("monkey"), 0.3, each).astype(float), 255.0).top for each in (camera, dark)]
    assert tops[0] == pytest.approx(tops[1], abs=0.3)


def changed(tmp_path: Path, change: object) -> Path:
    """The file beside the pictures with something wrong in it."""
    said = yaml.safe_load((replica() / NAME).read_text())
    for view in said["views"]:
        view["file"] = str(replica() / view["file"])
    change(said)  # type: ignore[operator]
    (tmp_path / NAME).write_text(yaml.safe_dump(said))
    return tmp_path


def few(said: dict) -> None:
    said["views"] = said["views"][::3]


def swapped(said: dict) -> None:
    said["views"][4], said["views"][5] = said["views"][5], said["views"][4]


def hole(said: dict) -> None:
    del said["views"][10:14]


def twice_round(said: dict) -> None:
    said["views"].append({"file": said["views"][0]["file"], "angle_deg": 360.0})


def absent(said: dict) -> None:
    said["views"][3]["file"] = "nowhere.png"


def misspelt(said: dict) -> None:
    said["pixel"] = said.pop("pixel_mm")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (few, "too few views"),
        (swapped, "angles are out of order"),
        (hole, "angles are missing"),
        (twice_round, "more than one turn"),
        (absent, "no such picture"),
        (misspelt, "did you mean 'pixel_mm'"),
    ],
)
def test_what_is_wrong_beside_the_pictures_is_named(tmp_path: Path, change: object, says: str) -> None:
    with pytest.raises(InputError, match=says) as caught:
        read_views(changed(tmp_path, change))
    assert NAME in str(caught.value)


def test_a_finger_shorter_than_stated_is_refused(tmp_path: Path) -> None:
    folder = changed(tmp_path, lambda said: said.update(length_mm=30.0))
    with pytest.raises(InputError, match="shorter than stated"):
        outline_from_views(read_views(folder))


def picture(turned: float = 0.3) -> np.ndarray:
    return photograph(preset("monkey"), turned, COARSE).astype(float)


def empty() -> np.ndarray:
    return 200.0 + np.random.default_rng(0).normal(0.0, 3.0, (220, 180))


def white() -> np.ndarray:
    return np.full((220, 180), 255.0)


def overexposed() -> np.ndarray:
    return np.minimum(picture() * 1.8, 255.0)


@pytest.mark.parametrize(
    ("made", "says"),
    [
        (empty, "empty"),
        (white, "saturated"),
        (overexposed, "saturated"),
        (lambda: picture()[:, 50:], "cropped"),
        (lambda: picture()[25:], "cropped"),
    ],
)
def test_bad_pictures_are_named(made: object, says: str) -> None:
    with pytest.raises(InputError, match=says) as caught:
        border(made(), 255.0, Path("view_007.png"))  # type: ignore[operator]
    assert "view_007.png" in str(caught.value)


def test_a_broken_file_and_odd_sizes_are_named(tmp_path: Path) -> None:
    (tmp_path / "view.png").write_bytes(b"not a picture")
    with pytest.raises(InputError, match=r"cannot be read as a picture"):
        read_picture(tmp_path / "view.png")
    folder = shutil.copytree(replica(), tmp_path / "odd")
    with Image.open(folder / "view_002.png") as opened:
        smaller = opened.crop((4, 0, *opened.size))
    smaller.save(folder / "view_002.png")
    with pytest.raises(InputError, match="differ in size") as caught:
        outline_from_views(read_views(folder))
    assert "view_002.png" in str(caught.value)


def test_synthetic_pictures_say_that_they_are() -> None:
    assert yaml.safe_load((replica() / NAME).read_text())["synthetic"] is True
