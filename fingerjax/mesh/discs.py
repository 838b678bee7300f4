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

POWER = 1.5  # of the share of the way outwards, or down, with which edges grow
FEWEST, MOST = 6, 48  # nodes on a ring


def disc_mesh(disc: Disc, resolution: Resolution) -> Finger:
    """The mesh of a disc: nodes `resolution.pad` apart about the axis of the pressed face, `resolution.coarsest` at its rim and at its
    lower face; at half of both it is finer everywhere by two. Held nodes are marked `nail`; those that slide are in `rollers`.
    """
    spacing = _Spacing(2 * resolution.pad, 2 * resolution.coarsest)  # edges are two node spacings long
    points, triangles = _plane(spacing.between(0.0, disc.outline, disc.outline)[1:])
    points[:, 1] += disc.outline
    levels, layer_of = _levels(disc, spacing)
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


class _Spacing:
    """Length of edges, mm, at a share 0 to 1 of the way from where they are finest to where they are coarsest."""

    def __init__(self, first: float, largest: float):
        self.first, self.more = first, largest - first

    def between(self, low: float, high: float, whole: float) -> np.ndarray:
        """Places from `low` to `high` on a way of length `whole`, as near to one edge apart as a whole number of edges is."""
        at = np.linspace(low, high, 2001)
        size = self.first + self.more * (0.5 * (at[1:] + at[:-1]) / whole) ** POWER
        edges = np.concatenate([[0.0], np.cumsum(np.diff(at) / size)])
        count = max(round(float(edges[-1])), 1)
        found = np.interp(np.arange(count + 1) / count * edges[-1], edges, at)
        found[-1] = high
        return found


def _levels(disc: Disc, spacing: _Spacing) -> tuple[np.ndarray, np.ndarray]:
    """y of every level, and the layer of the elements below each but the last."""
    levels, layer_of = [0.0], []
    for layer, thickness in enumerate(disc.layers):
        if thickness > 0:
            steps = spacing.between(levels[-1], levels[-1] + thickness, disc.thickness)
            levels += steps[1:].tolist()
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
