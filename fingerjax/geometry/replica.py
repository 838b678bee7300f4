"""SYNTHETIC photographs of a replica of known shape: to try the silhouette door, never as data of a finger.

Every point of the surface is turned, leant and projected (orthographic camera); each quarter of a row of
pixels is covered from the least to the greatest of what crosses it. Light gradient, blur, noise and the
misalignments of a real stage are added, and grey values are rounded to 8 bits.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from scipy import ndimage

from fingerjax.geometry.sections import LayeredSolid
from fingerjax.geometry.views import NAME

QUARTERS = 4  # of a row of pixels


@dataclass(frozen=True)
class Camera:
    """How the synthetic photographs are taken.

    - `pixel`: mm. `blur`: pixels, standard deviation. `noise`: grey values of 255, standard deviation.
    - `gradient`: part of the light lost from one corner of the picture to the opposite one.
    - `offset`: mm from the picture's middle to the turning axis. `roll`, `elevation`: deg, the axis in the picture and the camera above it.
    - `lean`: deg by which the replica itself leans on the stage; `eccentric`: mm off the turning axis.
    - `bright`: a light replica before a dark ground rather than a dark one before a light ground.
    """

    pixel: float = 0.025
    blur: float = 1.5
    noise: float = 4.0
    gradient: float = 0.4
    offset: float = 0.3
    roll: float = 1.5
    elevation: float = 0.0
    eccentric: float = 0.2
    bright: bool = False

    def misaligned(self, points: np.ndarray, turned: float) -> np.ndarray:
        """Right and up `(..., 2)` mm in the picture of points `(..., 3)` of a replica turned by `turned` rad."""
        x, y, z = np.moveaxis(points, -1, 0)
        x = x + self.eccentric
        c, s = np.cos(turned), np.sin(turned)
        right, depth = -(c * x - s * y), s * x + c * y  # the nail faces the camera when nothing is turned
        e, r = np.radians(self.elevation), np.radians(self.roll)
        up = z * np.cos(e) + depth * np.sin(e)
        return np.stack([self.offset + right * np.cos(r) + up * np.sin(r), up * np.cos(r) - right * np.sin(r)], axis=-1)


def photograph(solid: LayeredSolid, turned: float, camera: Camera, seed: int = 0, rod: float = 1.0) -> np.ndarray:
    """One picture, `(rows, columns)` of 8 bits, tip upwards; the replica goes on for `rod` mm before its cut."""
    points = camera.misaligned(_surface(solid, rod, camera.pixel), turned)
    half = solid.largest_radius + abs(camera.offset) + abs(camera.eccentric) + 0.03 * solid.length + 1.0
    columns, rows = int(2 * half / camera.pixel) + 1, int((solid.length + rod + 0.5) / camera.pixel)
    heights = ((np.arange(rows * QUARTERS) + 0.5) / QUARTERS - 0.5) * camera.pixel - 0.7 * rod
    left, right = _extent(points, heights)
    at = np.arange(columns)
    left, right = (edge / camera.pixel + 0.5 * (columns - 1) for edge in (left, right))
    cover = np.clip(np.minimum(right[:, None], at + 0.5) - np.maximum(left[:, None], at - 0.5), 0.0, 1.0)
    cover = cover.reshape(rows, QUARTERS, columns).mean(axis=1)[::-1]
    return _exposed(cover, camera, seed)


def _surface(solid: LayeredSolid, rod: float, pixel: float) -> np.ndarray:
    """Points `(m, s, 3)` of the skin, meridians from before the cut to the tip, a pixel or so apart."""
    u = np.linspace(0.0, 1.0, int(0.7 * solid.length / pixel))
    z = np.r_[-rod, solid.length * (1.0 - (1.0 - u) ** 2)]
    theta = np.linspace(0.0, 2 * np.pi, int(12.0 / pixel), endpoint=False)
    points = solid.surface(np.maximum(z, 0.0)[None, :], theta[:, None])
    points[:, :, 2] = z
    return points


def _extent(points: np.ndarray, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Leftmost and rightmost crossing of every height by the meridians."""
    start, end = points[:, :-1].reshape(-1, 2), points[:, 1:].reshape(-1, 2)
    low, high = np.minimum(start[:, 1], end[:, 1]), np.maximum(start[:, 1], end[:, 1])
    first, last = np.searchsorted(heights, low), np.searchsorted(heights, high)
    times = last - first
    segment = np.repeat(np.arange(len(start)), times)
    row = np.arange(times.sum()) - np.repeat(np.cumsum(times) - times, times) + first[segment]
    rise = end[segment, 1] - start[segment, 1]
    x = start[segment, 0] + (heights[row] - start[segment, 1]) / rise * (end[segment, 0] - start[segment, 0])
    left, right = np.full(len(heights), np.inf), np.full(len(heights), -np.inf)
    np.minimum.at(left, row, x)
    np.maximum.at(right, row, x)
    return left, right


def _exposed(cover: np.ndarray, camera: Camera, seed: int) -> np.ndarray:
    """Light, blur, noise and 8 bits."""
    rows, columns = cover.shape
    across = np.linspace(0.0, 1.0, columns)[None, :] * 0.7 + np.linspace(0.0, 1.0, rows)[:, None] * 0.3
    light = 220.0 * (1.0 - camera.gradient * across)
    share = ndimage.gaussian_filter(cover, camera.blur, mode="nearest")
    ground, finger = (0.06, 1.0) if camera.bright else (1.0, 0.06)
    grey = light * (ground + (finger - ground) * share)
    grey = grey + np.random.default_rng(seed).normal(0.0, camera.noise, cover.shape)
    return np.clip(np.round(grey), 0, 255).astype(np.uint8)


def write_views(folder: Path, solid: LayeredSolid, count: int = 100, camera: Camera | None = None, seed: int = 0) -> Path:
    """Synthetic photographs of a solid and the YAML file beside them, which says that they are; the path of that file."""
    from PIL import Image

    camera = camera or Camera()
    folder.mkdir(parents=True, exist_ok=True)
    angles = np.arange(count) * 360.0 / count
    for number, angle in enumerate(angles):
        picture = photograph(solid, float(np.radians(angle)), camera, seed=seed + number)
        Image.fromarray(picture).save(folder / f"view_{number:03d}.png")
    said = {
        "synthetic": True,
        "pixel_mm": camera.pixel,
        "length_mm": float(solid.length),
        "nail_deg": 0.0,
        "views": [{"file": f"view_{number:03d}.png", "angle_deg": float(angle)} for number, angle in enumerate(angles)],
    }
    file = folder / NAME
    file.write_text(yaml.safe_dump(said, sort_keys=False), encoding="utf-8")
    return file
