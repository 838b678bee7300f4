"""Meshes of round bodies with flat faces, made of rings and levels; no meshing library is needed.

Rings of nodes about the axis, joined to triangles, are repeated at every level, and the prisms between two levels are cut into tetrahedra.
Elements have straight edges: the outline is a polygon of the same area as the circle, so that volumes, and the force of a cylinder between
frictionless plates, are exact.
"""

from __future__ import annotations

import hashlib
import math

import numpy as np

from fingerjax.finger import Finger
from fingerjax.geometry.disc import Disc
from fingerjax.mesh.quality import figures
from fingerjax.mesh.surface import Resolution
from fingerjax.mesh.topology import boundary, oriented, prism_tets, quadratic, quadratic_triangles

EVEN = 3.0  # edges from the axis within which rings are evenly spaced
GROWTH = 0.5  # by which edges grow per mm beyond that, and with depth
FEWEST, MOST = 6, 48  # nodes on a ring


def disc_mesh(disc: Disc, resolution: Resolution) -> Finger:
    """The mesh of a disc: nodes `resolution.pad` apart about the axis of the pressed face, up to `resolution.coarsest` outwards and down.

    A body of one layer has even spacing all through. Held nodes are marked `nail`; those that slide are in `rollers`.
    """
    even = sum(thickness > 0 for thickness in disc.layers) == 1
    first, largest = 2 * resolution.pad, 2 * resolution.coarsest  # edges are two node spacings long
    points, triangles = _plane(_radii(disc.outline, first, largest, even))
    points[:, 1] += disc.outline
    levels, layer_of = _levels(disc, first, largest, even)
    flat = len(points)
    vertices = np.concatenate([np.column_stack([points[:, 0], np.full(flat, y), points[:, 1]]) for y in levels])
    tets = np.concatenate([prism_tets(triangles + s * flat, triangles + (s + 1) * flat) for s in range(len(levels) - 1)])
    layer = np.repeat(layer_of, 3 * len(triangles))
    tets = oriented(vertices, tets)
    nodes, elements, pairs = quadratic(vertices, tets)
    skin = quadratic_triangles(boundary(tets), pairs, len(vertices)).astype(np.int64)
    nail, rollers = _supports(disc, nodes, skin)
    digest = hashlib.sha256(repr(disc).encode() + nodes.tobytes() + elements.tobytes()).hexdigest()[:20]
    nothing = np.zeros(len(nodes), bool)
    return Finger(
        name=disc.name,
        nodes=nodes,
        tets=elements.astype(np.int64),
        layer=layer.astype(np.int64),
        skin=skin,
        nail=nail,
        bone=nothing,
        proximal=nothing.copy(),
        key=f"disc-{digest}",
        quality=figures(nodes, elements, layer, disc) | {"mesh_hash": digest},
        rollers=rollers,
    )


def _radii(outline: float, first: float, largest: float, even: bool) -> np.ndarray:
    return _even(outline, first)[1:] if even else _steps(outline, first, largest, EVEN * first)[1:]


def _even(end: float, spacing: float) -> np.ndarray:
    return np.linspace(0.0, end, math.ceil(end / spacing - 1e-9) + 1)


def _steps(end: float, first: float, largest: float, even: float) -> np.ndarray:
    """From 0 to `end`: `first` apart up to `even`, then further and further; what lies beyond that is stretched to end where it must."""
    at = [0.0]
    while at[-1] < end * (1 - 1e-9):
        at.append(at[-1] + min(first + GROWTH * max(at[-1] - even, 0.0), largest))
    found = np.array(at)
    if len(found) > 2 and found[-1] - end > 0.5 * (found[-1] - found[-2]):
        found = found[:-1]
    kept = int(np.searchsorted(found, even * (1 + 1e-9), side="right")) - 1 if even < end else 0
    kept = min(kept, len(found) - 2)
    start = found[kept]
    found[kept:] = start + (found[kept:] - start) * (end - start) / (found[-1] - start)
    return found


def _levels(disc: Disc, first: float, largest: float, even: bool) -> tuple[np.ndarray, np.ndarray]:
    """y of every level, and the layer of the elements below each but the last."""
    levels, layer_of = [0.0], []
    for layer, thickness in enumerate(disc.layers):
        if thickness <= 0:
            continue
        top = levels[-1]
        size = min(first + GROWTH * top, max(first, largest))
        steps = _even(thickness, first) if even else _steps(thickness, size, largest, 0.0)
        levels += (top + steps[1:]).tolist()
        layer_of += [layer] * (len(steps) - 1)
    return np.array(levels), np.array(layer_of)


def _plane(radii: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (k, 2) about the origin, ring by ring from the axis, and triangles (f, 3) between them."""
    spacing = np.diff(radii, prepend=0.0)
    counts = [_count(radius, step) for radius, step in zip(radii, spacing, strict=True)]
    points, triangles = [np.zeros((1, 2))], []
    before, start = np.zeros(1, np.int64), 1
    for number, (radius, count) in enumerate(zip(radii, counts, strict=True)):
        turn = 2 * np.pi / count
        last = number == len(radii) - 1
        reach = radius * math.sqrt(turn / math.sin(turn)) if last else radius  # the polygon has the circle's area
        angle = turn * np.arange(count)
        points.append(reach * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        ring = start + np.arange(count)
        triangles += _between(before, ring)
        before, start = ring, start + count
    return np.concatenate(points), np.array(triangles, np.int64)


def _count(radius: float, spacing: float) -> int:
    """Nodes on a ring, in sixes, about as far apart as the ring is from the one before."""
    return int(np.clip(6 * round(2 * np.pi * radius / spacing / 6), FEWEST, MOST))


def _between(inner: np.ndarray, outer: np.ndarray) -> list[list[int]]:
    """Triangles of the strip between two rings, each of which begins at angle 0; the shorter step round is taken first."""
    m, n = len(inner), len(outer)
    if m == 1:
        return [[int(inner[0]), int(outer[j]), int(outer[(j + 1) % n])] for j in range(n)]
    found, i, j = [], 0, 0
    while i < m or j < n:
        if j < n and (i == m or (j + 1) * m <= (i + 1) * n):
            found.append([int(inner[i % m]), int(outer[j % n]), int(outer[(j + 1) % n])])
            j += 1
        else:
            found.append([int(inner[i % m]), int(outer[j % n]), int(inner[(i + 1) % m])])
            i += 1
    return found


def _supports(disc: Disc, nodes: np.ndarray, skin: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Nodes that are held, and (n, 3) the ways in which others are: None where there are none.

    What slides on its floor and under its plate alike could still drift and turn, which no force asks of it: the middle of the lower face,
    and the direction of one node beside it, are kept.
    """
    small = 1e-9 * max(disc.thickness, disc.outline)
    low, high = nodes[:, 1] > disc.thickness - small, nodes[:, 1] < small
    away = nodes[:, [0, 2]] - np.array([0.0, disc.outline])
    distance = np.linalg.norm(away, axis=1)
    nail = low.copy() if disc.lower == "held" else np.zeros(len(nodes), bool)
    if disc.rim == "held":
        nail[skin[~(low[skin].all(axis=1) | high[skin].all(axis=1))]] = True
    rollers = np.zeros((len(nodes), 3), bool)
    if disc.lower == "sliding":
        rollers[low, 1] = True
    if disc.upper == "held":
        rollers[high, 0] = rollers[high, 2] = True
    elif not nail.any():
        bottom = np.flatnonzero(low)
        middle = bottom[np.argmin(distance[bottom])]
        beside = bottom[np.argmin(np.where(np.abs(away[bottom, 1]) < small, -away[bottom, 0], np.inf))]
        rollers[middle, [0, 2]] = True
        rollers[beside, 2] = True
    rollers[nail] = False
    return nail, rollers if rollers.any() else None
