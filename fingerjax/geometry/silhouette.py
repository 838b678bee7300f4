"""Photographs of a turned replica -> borders -> support function -> closed curves across the finger.

Seen from the side, the border of a silhouette is not the radius of the section but its support function: the
distance h(phi) of the farthest point in direction n(phi). The section is the envelope of the lines that touch
it,

    p(phi) = h n + h' t,   n = (cos phi, sin phi),   t = (-sin phi, cos phi)

so what is concave in a section cannot be seen (the visual hull). Each view gives two borders, h(phi) to the
right of the image of the turning axis and h(phi + pi) to its left. A camera that looks down on the replica
sees what lies before the axis lower than what lies behind it,

    border(phi) = h(phi, z) +- beta h_phi h_z,

which opposite views tell apart. Dandekar, Raju & Srinivasan (2003), section 2, took about 100 views.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import savgol_filter
from scipy.spatial import ConvexHull

from fingerjax.errors import InputError
from fingerjax.geometry.borders import Border, border, read_picture
from fingerjax.geometry.outline import Outline
from fingerjax.geometry.views import Views

HARMONICS = 20  # of the support function, at most a third of the views
SECTIONS = 56
SWEEPS = 3  # of reweighting against outliers
BELOW_TIP = 0.8  # of the height: where the elevation of the camera is told from
ALONG = 0.5  # mm of z that a smoothing parabola spans


@dataclass(frozen=True, eq=False)
class Borders:
    """Borders of all views in mm about the image of the turning axis, on common rows.

    - `z`: `(r,)` mm above the lowest row. `top`: mm, the tip.
    - `right`, `left`: `(k, r)` mm, signed distances.
    - `direction`: `(k,)` rad, theta of what is seen at the right border.
    """

    z: np.ndarray
    top: float
    right: np.ndarray
    left: np.ndarray
    direction: np.ndarray


@dataclass(frozen=True)
class Pose:
    """How the camera stands to the turning axis.

    - `offset`: mm from the middle of the picture to the axis, at the lowest row.
    - `roll`: rad, by which the axis leans in the picture. `elevation`: rad, by which the camera looks down.
    """

    offset: float
    roll: float
    elevation: float

    @property
    def note(self) -> str:
        """In words."""
        return (
            f"turning axis {self.offset:+.3f} mm off the pictures' middle, leaning {np.degrees(self.roll):+.2f} deg in them, "
            f"camera {np.degrees(self.elevation):+.2f} deg above it: corrected"
        )


def _nobody(share: float, what: str) -> None:
    pass


def outline_from_views(views: Views, tell: Callable[[float, str], object] = _nobody) -> Outline:
    """The skin of a finger from its photographs.

    `tell(share, what)` hears of the progress. **Raises** `InputError` naming the picture: empty, saturated, cropped, of another
    size than the others; or a finger shorter than `length_mm`.
    """
    found, width = [], 0
    for number, file in enumerate(views.pictures):
        tell(0.95 * number / len(views.pictures), f"border of {file.name}")
        picture, full = read_picture(file, views.tip)
        if number and picture.shape[1] != width:
            raise InputError("pictures differ in size", file=file, seen=picture.shape, remedy="take all views with one camera setting")
        width = picture.shape[1]
        found.append(border(picture, full, file))
    outline, _ = outline_from_borders(found, views, width)
    return outline


def outline_from_borders(found: list[Border], views: Views, width: int) -> tuple[Outline, Pose]:
    """The skin from borders in pixels of pictures `width` pixels wide, and how the camera stood."""
    points = [(each.points - [0.5 * (width - 1), 0.0]) * views.pixel for each in found]
    straight, leaning = _straightened(points, views.direction)
    level, elevation = straight, 0.0
    for _ in range(4):
        borders = _on_rows(level, views)
        coefficients = fourier(borders)
        more = _elevation(borders, coefficients)
        elevation += more
        level = [_levelled(*each, borders.z, coefficients, elevation) for each in zip(straight, views.direction, strict=True)]
        if abs(more) < 1e-5:
            break
    borders = _on_rows(level, views)
    pose = Pose(leaning[0], leaning[1], elevation)
    return replace(_outline(borders, fourier(borders), views, elevation), notes=(pose.note,)), pose


def _straightened(points: list[np.ndarray], direction: np.ndarray) -> tuple[list[np.ndarray], tuple[float, float]]:
    """Points about the turning axis, upright; and its offset, mm, and lean, rad.

    Left and right borders at one height of a leaning picture belong to different heights of the finger, so the lean is found again
    until nothing is left of it.
    """
    offset = roll = 0.0
    straight = points
    for _ in range(8):
        more = _tilt(straight, direction)
        offset, roll = offset + more[0] / np.cos(roll), roll + more[1]
        straight = [_upright(each, (offset, roll)) for each in points]
        if abs(more[0]) < 1e-5 and abs(more[1]) < 1e-6:
            break
    return straight, (offset, roll)


def _tilt(points: list[np.ndarray], direction: np.ndarray) -> tuple[float, float]:
    """Where the turning axis meets the lowest row, mm, and its lean, rad: the line about which opposite borders are alike."""
    heights = np.linspace(0.05, 0.75, 60) * min(float(each[:, 1].max()) for each in points)
    middle = np.array([0.5 * (_across(each, heights)[0] + _across(each, heights)[1]) for each in points])
    odd = np.concatenate([[np.cos(n * direction), np.sin(n * direction)] for n in (1, 3, 5, 7, 9)])
    fitted, *_ = np.linalg.lstsq(np.vstack([np.ones(len(direction)), odd]).T, middle, rcond=None)
    slope, offset = np.polyfit(heights, fitted[0], 1)
    return float(offset), float(np.arctan(slope))


def _upright(points: np.ndarray, leaning: tuple[float, float]) -> np.ndarray:
    """Points about the axis, turned so that it stands upright."""
    offset, roll = leaning
    right, up = (points - [offset, 0.0]).T
    return np.stack([right * np.cos(roll) - up * np.sin(roll), right * np.sin(roll) + up * np.cos(roll)], axis=1)


def _across(points: np.ndarray, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Outermost left and right of a border at heights `(r,)`; NaN where it does not reach."""
    (x0, y0), (x1, y1) = points[:-1].T, points[1:].T
    low, high = np.minimum(y0, y1), np.maximum(y0, y1)
    first, last = np.searchsorted(heights, low, side="left"), np.searchsorted(heights, high, side="left")
    times = last - first
    segment = np.repeat(np.arange(len(x0)), times)
    row = np.arange(times.sum()) - np.repeat(np.cumsum(times) - times, times) + first[segment]
    share = (heights[row] - y0[segment]) / (y1[segment] - y0[segment])
    x = x0[segment] + share * (x1[segment] - x0[segment])
    left, right = np.full(len(heights), np.inf), np.full(len(heights), -np.inf)
    np.minimum.at(left, row, x)
    np.maximum.at(right, row, x)
    return np.where(np.isfinite(left), left, np.nan), np.where(np.isfinite(right), right, np.nan)


def _on_rows(points: list[np.ndarray], views: Views) -> Borders:
    """Borders at common heights from the cut to the tip, one row to a pixel.

    **Raises** `InputError` where a border does not reach down to the cut on both sides.
    """
    top = float(np.median([each[:, 1].max() for each in points]))
    lowest = max(max(float(each[0, 1]), float(each[-1, 1])) for each in points)
    if top - lowest < views.length:
        raise InputError(
            "the finger in the pictures is shorter than stated",
            file=views.file,
            place="length_mm",
            seen=views.length,
            remedy=f"write at most {top - lowest:.2f} mm, or check pixel_mm",
        )
    heights = np.arange(max(lowest, top - views.length - ALONG), top, views.pixel)
    both = [_across(each, heights) for each in points]
    left, right = (np.array([each[side] for each in both]) for side in (0, 1))
    seen = np.isfinite(left).all(axis=0)
    return Borders(heights[seen], top, right[:, seen], left[:, seen], views.direction)


def fourier(borders: Borders) -> np.ndarray:
    """Coefficients `(r, 1 + 2n)` of h = a0 + sum a_n cos n phi + b_n sin n phi in every row: least squares, outliers weighed down."""
    count = min(HARMONICS, len(borders.direction) // 3)
    phi = np.r_[borders.direction, borders.direction + np.pi]
    data = np.concatenate([borders.right, -borders.left])
    basis = _basis(phi, count)
    coefficients = _weighted(basis, data, np.ones_like(data))
    for _ in range(SWEEPS):
        left = np.abs(data - basis @ coefficients.T)
        spread = 1.4826 * np.median(left, axis=0) + 1e-9
        coefficients = _weighted(basis, data, 1.0 / np.maximum(left / (2.5 * spread), 1.0))
    return coefficients


def _basis(phi: np.ndarray, count: int, slope: bool = False) -> np.ndarray:
    """1, cos n phi, sin n phi, or their slopes in phi: `(k, 1 + 2 count)`."""
    n = np.arange(1, count + 1)
    angle = phi[:, None] * n
    if slope:
        return np.concatenate([np.zeros((len(phi), 1)), -n * np.sin(angle), n * np.cos(angle)], axis=1)
    return np.concatenate([np.ones((len(phi), 1)), np.cos(angle), np.sin(angle)], axis=1)


def _weighted(basis: np.ndarray, data: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Weighted least squares of every column of `data` `(k, r)`: `(r, p)`."""
    normal = np.einsum("kr,kp,kq->rpq", weight, basis, basis, optimize=True)
    normal += 1e-9 * len(basis) * np.eye(basis.shape[1])
    return np.linalg.solve(normal, np.einsum("kr,kp->rp", weight * data, basis)[..., None])[..., 0]


def _elevation(borders: Borders, coefficients: np.ndarray) -> float:
    """rad: by how much right borders exceed, and left ones fall short of, what both together say, against h_phi h_z.

    Told from the finger below its tip, where h has a slope in z.
    """
    phi = np.r_[borders.direction, borders.direction + np.pi]
    data = np.concatenate([borders.right, -borders.left])
    count = (coefficients.shape[1] - 1) // 2
    along = np.gradient(_smooth(coefficients, borders.z), borders.z, axis=0)
    lift = (_basis(phi, count, slope=True) @ coefficients.T) * (_basis(phi, count) @ along.T)
    sign = np.r_[np.ones(len(borders.direction)), -np.ones(len(borders.direction))][:, None]
    left = data - _basis(phi, count) @ coefficients.T
    below = borders.z < borders.z[0] + BELOW_TIP * (borders.top - borders.z[0])
    return float(np.sum((sign * lift * left)[:, below]) / max(np.sum(lift[:, below] ** 2), 1e-12))


def _levelled(points: np.ndarray, direction: float, z: np.ndarray, coefficients: np.ndarray, elevation: float) -> np.ndarray:
    """Points of one border where a camera that looks straight across would see them.

    Looked at from above, what touches the border to the right lies h_phi before the axis, seen so much lower or higher; and likewise to
    the left, with phi + pi and the other sign.
    """
    count = (coefficients.shape[1] - 1) // 2
    slopes = coefficients @ _basis(np.array([direction, direction + np.pi]), count, slope=True).T  # (r, 2)
    tip = int(np.argmax(points[:, 1]))
    first, last = points[: tip + 1], points[tip + 1 :]
    first_is_right = first[:, 0].mean() > last[:, 0].mean()
    depth = []
    for side, right in ((first, first_is_right), (last, not first_is_right)):
        depth.append(np.interp(side[:, 1], z, slopes[:, 0] if right else -slopes[:, 1]))
    raised = points.copy()
    raised[:, 1] += np.tan(elevation) * np.concatenate(depth)
    return raised


def _smooth(coefficients: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Coefficients smoothed along z by moving parabolas; unchanged within twice their span of the tip, where h is a square root."""
    window = max(5, 2 * int(0.5 * ALONG / (z[1] - z[0])) + 1)
    if len(z) <= 2 * window:
        return coefficients
    smooth = savgol_filter(coefficients, window, 2, axis=0)
    out = coefficients.copy()
    out[: -2 * window] = smooth[: -2 * window]
    return out


def _outline(borders: Borders, coefficients: np.ndarray, views: Views, elevation: float) -> Outline:
    """Envelopes at heights that crowd towards the tip. Heights are foreshortened by the elevation."""
    stretch = 1.0 / np.cos(elevation)
    behind = _behind(views.length, max(2.0 * views.pixel, borders.top - borders.z[-1]))  # mm before the tip, descending from the length
    wanted = borders.top - behind / stretch
    rows = _smooth(coefficients, borders.z)
    at = np.array([np.interp(wanted, borders.z, column) for column in rows.T]).T
    count = (at.shape[1] - 1) // 2
    phi = np.linspace(0.0, 2 * np.pi, 720, endpoint=False)
    h, slope = at @ _basis(phi, count).T, at @ _basis(phi, count, slope=True).T
    curves = tuple(_hull(envelope(one, along, phi)) for one, along in zip(h, slope, strict=True))
    tip = curves[-1].mean(axis=0)
    return Outline(views.length - behind, curves, np.array([*tip, views.length]))


def envelope(h: np.ndarray, slope: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """p = h n + h' t, `(k, 2)` mm, from the support function and its slope at angles `(k,)`."""
    n = np.stack([np.cos(phi), np.sin(phi)], axis=1)
    t = np.stack([-np.sin(phi), np.cos(phi)], axis=1)
    return h[:, None] * n + slope[:, None] * t


def _hull(points: np.ndarray) -> np.ndarray:
    """Without the swallowtails that noise puts at sharp corners; counterclockwise."""
    return points[ConvexHull(points).vertices]


def _behind(length: float, first: float) -> np.ndarray:
    """Distances from the tip, mm, from the length down to about `first`: even on the shaft, crowded at the tip."""
    u = np.linspace(1.0, 0.0, SECTIONS + 1)[:-1]
    even = min(SECTIONS * first, 0.8 * length)
    return even * u + (length - even) * u**2
