"""A better triangulation of the skin for columns: edges flipped, points moved along the surface.

A column's elements are as good as its triangle on every shell. Towards the bone triangles are squeezed around
the finger and not along it, so a triangle that is fair on the skin may be a needle on the bone. The quality
used here is therefore the product of the qualities on the skin and on the bone; and of how round the finger stays:
an edge that is seen under a right angle from the bone cuts off so much of the finger that it cannot be refined.
"""

from __future__ import annotations

import numpy as np

from fingerjax.layers import BONE
from fingerjax.mesh.columns import Rays
from fingerjax.mesh.contour import along_nail
from fingerjax.mesh.topology import TRIANGLE_EDGES


def triangle_quality(corners: np.ndarray) -> np.ndarray:
    """4 sqrt(3) area / sum of squared sides, `(f,)`, of triangles `(f, 3, 3)`: 1 when equilateral."""
    sides = corners[:, [1, 2, 0]] - corners
    area = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    return 4.0 * np.sqrt(3.0) * area / np.maximum((sides**2).sum(axis=(1, 2)), 1e-300)


def _shells(rays: Rays, feet: np.ndarray) -> np.ndarray:
    """Points of the skin and of the bone below it, `(2, n, 3)`."""
    met, _ = rays.depths(feet)
    reach = rays.axis(rays.aim(feet[:, 2])) - feet
    return np.stack([feet, feet + met[:, BONE, None] * reach])


def _quality(shells: np.ndarray, triangles: np.ndarray, turning: bool = False) -> np.ndarray:
    """Quality on both shells, times the cosine of the widest angle between two of a triangle's rays, 0 from a right angle on; with
    `turning`, -1 where a triangle looks towards the bone.
    """
    quality = triangle_quality(shells[0][triangles]) * triangle_quality(shells[1][triangles]) * _roundness(shells, triangles)
    if turning:
        a, b, c = (shells[0][triangles[:, i]] for i in range(3))
        down = (shells[1] - shells[0])[triangles].mean(axis=1)
        quality = np.where(np.einsum("fi,fi->f", np.cross(b - a, c - a), down) < 0, quality, -1.0)
    return quality


def _roundness(shells: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Cosine of the widest angle between two of the three rays to a triangle's corners, `(f,)`, not below 0."""
    ray = (shells[0] - shells[1])[triangles]
    ray /= np.maximum(np.linalg.norm(ray, axis=-1, keepdims=True), 1e-300)
    return np.clip(np.einsum("fij,fij->fi", ray, ray[:, [1, 2, 0]]).min(axis=1), 0.0, 1.0)


def flipped(shells: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, int]:
    """Triangles after one round of flips that raise the worse of two neighbours, and how many were flipped.

    In a round each triangle takes part in one flip at most, the most gainful first.
    """
    f = len(triangles)
    half = triangles[:, TRIANGLE_EDGES].reshape(-1, 2)
    opposite = triangles[:, [2, 0, 1]].reshape(-1)
    owner = np.repeat(np.arange(f), 3)
    code = np.sort(half, axis=1) @ np.array([len(shells[0]), 1])
    order = np.argsort(code, kind="stable")
    twin = np.flatnonzero(code[order][1:] == code[order][:-1])
    one, two = order[twin], order[twin + 1]
    a, b, c, d = half[one, 0], half[one, 1], opposite[one], opposite[two]
    new = np.stack([np.stack([a, d, c], axis=1), np.stack([d, b, c], axis=1)], axis=1)
    now = _quality(shells, triangles, turning=True)
    before = np.minimum(now[owner[one]], now[owner[two]])
    after = _quality(shells, new.reshape(-1, 3), turning=True).reshape(-1, 2).min(axis=1)
    exists = np.isin(np.sort(np.stack([c, d], axis=1), axis=1) @ np.array([len(shells[0]), 1]), code)
    gain = np.where(exists, 0.0, after - before)
    out, busy, count = triangles.copy(), np.zeros(f, bool), 0
    for i in np.argsort(-gain):
        if gain[i] <= 1e-3:
            break
        pair = [owner[one[i]], owner[two[i]]]
        # Neighbours of a flipped pair wait for the next round too: their new diagonal might be this one.
        if busy[pair].any():
            continue
        out[pair] = new[i]
        busy[pair] = True
        count += 1
    return _without_repeats(out, triangles), count


def _without_repeats(out: np.ndarray, before: np.ndarray) -> np.ndarray:
    """`out`, unless two flips made one edge twice."""
    _, times = np.unique(np.sort(out[:, TRIANGLE_EDGES].reshape(-1, 2), axis=1), axis=0, return_counts=True)
    return before if times.max() > 2 else out


def smoothed(
    rays: Rays, points: np.ndarray, triangles: np.ndarray, rounds: int = 4
) -> tuple[np.ndarray, np.ndarray]:
    """Points `(n, 3)` on the true skin and triangles `(f, 3)` of better quality, the rim of the cut left in
    place.

    A point moves a share of the way to the mean of its triangles' centroids, weighted by area, when that does
    not make the worst triangle around it worse.
    """
    feet = rays.foot(points)
    rim = np.abs(feet[:, 2]) < 1e-12
    for _ in range(rounds):
        for _ in range(4):
            triangles, count = flipped(_shells(rays, feet), triangles)
            if not count:
                break
        feet = _moved(rays, feet, triangles, rim)
    return feet, triangles


def outlined(rays: Rays, points: np.ndarray, triangles: np.ndarray, rounds: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """The triangulation cut along the nail's rim, and smoothed again with that rim and the one of the cut left in place."""
    points, triangles, on = along_nail(rays.solid, points, triangles)
    feet = rays.foot(points)
    feet[on] = points[on]
    still = on | (np.abs(feet[:, 2]) < 1e-12)
    for _ in range(rounds):
        feet = _moved(rays, feet, triangles, still)
    return feet, triangles


def worst_of(rays: Rays, points: np.ndarray, triangles: np.ndarray) -> float:
    """Least quality of all triangles: not above 0 where one is turned over, or has an edge seen under a right angle from the bone."""
    return float(_quality(_shells(rays, points), triangles, turning=True).min())


def _moved(rays: Rays, feet: np.ndarray, triangles: np.ndarray, rim: np.ndarray) -> np.ndarray:
    before = _worst_around(_quality(_shells(rays, feet), triangles, turning=True), triangles, len(feet))
    a, b, c = (feet[triangles[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    total, weight = np.zeros_like(feet), np.zeros(len(feet))
    for i in range(3):
        np.add.at(total, triangles[:, i], area[:, None] * (a + b + c) / 3.0)
        np.add.at(weight, triangles[:, i], area)
    wanted = np.where(rim[:, None], feet, feet + 0.5 * (total / weight[:, None] - feet))
    trial = np.where(rim[:, None], feet, rays.foot(wanted))
    for _ in range(10):
        after = _worst_around(_quality(_shells(rays, trial), triangles, turning=True), triangles, len(feet))
        worse = (after < before) & (trial != feet).any(axis=1)
        if not worse.any():
            break
        trial[worse] = feet[worse]
    return trial


def _worst_around(quality: np.ndarray, triangles: np.ndarray, count: int) -> np.ndarray:
    worst = np.full(count, np.inf)
    for i in range(3):
        np.minimum.at(worst, triangles[:, i], quality)
    return worst
