"""The skin's triangles cut along the rim of the nail, so that what is held has the nail's own area on every mesh.

Nodes held because they happen to lie in a patch that the triangles do not follow move its rim by a part of an element, another part on
another mesh; under a plate half a node spacing is some per cent of the force. So vertices near the rim are moved onto it and the
edges that still cross it are cut there.
"""

from __future__ import annotations

import numpy as np

from fingerjax.geometry.sections import LayeredSolid
from fingerjax.mesh.topology import TRIANGLE_EDGES

FLATTEST = 0.3  # quality of a triangle below which none of its vertices is moved
LEAST = 0.15  # of an edge: no cut is nearer to its ends, and the rim gives way by as much
NEAR = 0.35  # of the shortest edge around a vertex: moved onto the rim rather than cut beside


def beyond(solid: LayeredSolid, points: np.ndarray) -> np.ndarray:
    """How far outside the nail's rim points `(k, 3)` of the skin lie, `(k,)` mm, along the skin; negative on the nail."""
    z, along = _unrolled(solid, points)
    half = 0.5 * (solid.nail.theta[1] - solid.nail.theta[0]) * _radius(solid, points)
    return np.maximum.reduce([solid.nail.z[0] - z, z - solid.nail.z[1], np.abs(along) - half])


def _radius(solid: LayeredSolid, points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, :2] - solid.centre(points[:, 2]), axis=1)


def _unrolled(solid: LayeredSolid, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """z, and the arc from the nail's middle, mm."""
    middle = 0.5 * (solid.nail.theta[0] + solid.nail.theta[1])
    turned = np.mod(solid.angle(points) - middle + np.pi, 2 * np.pi) - np.pi
    return points[:, 2], turned * _radius(solid, points)


def along_nail(solid: LayeredSolid, points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points `(n, 3)` of the skin and triangles `(f, 3)` none of which reaches over the rim; and which points lie on it, `(n,)` bool."""
    points, on = _snapped(solid, points, triangles)
    side = np.where(on, 0.0, beyond(solid, points))
    pairs = np.unique(np.sort(triangles[:, TRIANGLE_EDGES].reshape(-1, 2), axis=1), axis=0)
    cut = pairs[side[pairs[:, 0]] * side[pairs[:, 1]] < 0]
    new = _crossings(solid, points[cut[:, 0]], points[cut[:, 1]])
    number = {(int(a), int(b)): len(points) + i for i, (a, b) in enumerate(cut)}
    out: list[list[int]] = []
    for triangle in triangles.tolist():
        out += _split(triangle, [number.get((min(a, b), max(a, b)), -1) for a, b in _sides(triangle)])
    return np.concatenate([points, new]), np.array(out, np.int64), np.r_[on, np.ones(len(new), bool)]


def _sides(triangle: list[int]) -> list[tuple[int, int]]:
    return [(triangle[i], triangle[j]) for i, j in TRIANGLE_EDGES.tolist()]


def _split(triangle: list[int], cut: list[int]) -> list[list[int]]:
    """A triangle as one, two or three, by the points that cut its sides 01, 12, 20 (-1: not cut); at most two are."""
    crossed = [side for side in range(3) if cut[side] >= 0]
    if not crossed:
        return [triangle]
    if len(crossed) == 1:
        first = crossed[0]
        a, b, c = (triangle[(first + k) % 3] for k in range(3))
        return [[a, cut[first], c], [cut[first], b, c]]
    first = next(side for side in crossed if (side + 1) % 3 in crossed)  # the corner between both cut sides comes second
    a, b, c = (triangle[(first + k) % 3] for k in range(3))
    p, q = cut[first], cut[(first + 1) % 3]
    return [[p, b, q], [a, p, q], [a, q, c]]


def _snapped(solid: LayeredSolid, points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points with those near the rim on it, the nearest to each corner of the nail on that corner; and which are."""
    moved, on = points.copy(), np.zeros(len(points), bool)
    short = np.full(len(points), np.inf)
    length = np.linalg.norm(points[triangles] - points[triangles[:, [1, 2, 0]]], axis=2)
    for i in range(3):
        np.minimum.at(short, triangles[:, i], np.minimum(length[:, i], length[:, i - 1]))
    z, theta = solid.nail.z, solid.nail.theta
    fixed = points[:, 2] < 1e-9
    for corner in solid.surface(np.repeat(z, 2), np.tile(theta, 2)):
        away = np.where(on | fixed, np.inf, np.linalg.norm(points - corner, axis=1))
        nearest = int(np.argmin(away))
        if away[nearest] < short[nearest]:
            moved[nearest], on[nearest] = corner, True
    near = ~on & ~fixed & (np.abs(beyond(solid, points)) < NEAR * short)
    moved[near], on[near] = _on_rim(solid, points[near]), True
    return _fair(points, moved, on, triangles)


def _fair(points: np.ndarray, moved: np.ndarray, on: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same, with points put back where a triangle would be flattened or turned over, the farthest moved of it first."""
    moved, on = moved.copy(), on.copy()
    before = fairness(points, points, triangles)
    way = np.linalg.norm(moved - points, axis=1)
    for _ in range(50):
        now = fairness(moved, points, triangles)
        bad = triangles[(now < np.minimum(FLATTEST, before)) & on[triangles].any(axis=1)]
        if not len(bad):
            break
        back = bad[np.arange(len(bad)), np.argmax(np.where(on[bad], way[bad], -1.0), axis=1)]
        moved[back], on[back] = points[back], False
    return moved, on


def fairness(points: np.ndarray, known: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """4 sqrt(3) area over the sum of squared sides, `(f,)`, negative where a triangle looks the other way than at points `known`."""

    def normal(at: np.ndarray) -> np.ndarray:
        a, b, c = (at[triangles[:, i]] for i in range(3))
        return 0.5 * np.cross(b - a, c - a)

    then = normal(known)
    area = np.einsum("fi,fi->f", normal(points), then) / np.maximum(np.linalg.norm(then, axis=1), 1e-300)
    sides = points[triangles] - points[triangles[:, [1, 2, 0]]]
    return 4.0 * np.sqrt(3.0) * area / np.maximum((sides**2).sum(axis=(1, 2)), 1e-300)


def _on_rim(solid: LayeredSolid, points: np.ndarray) -> np.ndarray:
    """The points of the rim next to points `(k, 3)` close to it."""
    z, along = _unrolled(solid, points)
    radius = _radius(solid, points)
    middle, half = 0.5 * sum(solid.nail.theta), 0.5 * (solid.nail.theta[1] - solid.nail.theta[0])
    low, high = solid.nail.z
    turned = along / radius
    gaps = np.stack([np.abs(z - low), np.abs(z - high), np.abs(turned + half) * radius, np.abs(turned - half) * radius])
    nearest = np.argmin(gaps, axis=0)
    outside = (z < low) | (z > high) | (np.abs(turned) > half)
    new_z, new_turned = np.clip(z, low, high), np.clip(turned, -half, half)
    inside = ~outside
    new_z = np.where(inside & (nearest == 0), low, np.where(inside & (nearest == 1), high, new_z))
    new_turned = np.where(inside & (nearest == 2), -half, np.where(inside & (nearest == 3), half, new_turned))
    return solid.surface(new_z, middle + new_turned)


def _crossings(solid: LayeredSolid, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Points of the skin where edges cross the rim."""
    sign = np.sign(beyond(solid, start))
    low, high = np.zeros(len(start)), np.ones(len(start))
    for _ in range(40):
        middle = 0.5 * (low + high)
        at = start + middle[:, None] * (end - start)
        same = np.sign(beyond(solid, at)) == sign
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    at = start + np.clip(0.5 * (low + high), LEAST, 1.0 - LEAST)[:, None] * (end - start)
    return solid.surface(at[:, 2], solid.angle(at))


def nail_nodes(solid: LayeredSolid, nodes: np.ndarray, skin: np.ndarray, followed: bool = False) -> np.ndarray:
    """`(n,)` bool: nodes of the six-node triangles of the skin whose middle lies on the nail.

    Where the triangles have `followed` its rim, one that reaches over it across a corner all the same is not held.
    """
    corners = nodes[skin[:, :3]]
    middle = corners.mean(axis=1)
    held = solid.nail.covers(middle[:, 2], solid.angle(middle))
    if followed:
        edge = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2).max(axis=1)
        over = beyond(solid, corners.reshape(-1, 3)).reshape(-1, 3).max(axis=1)
        held &= over < 1.5 * LEAST * edge
    out = np.zeros(len(nodes), bool)
    out[skin[held]] = True
    return out
