"""Local refinement: longest edges are bisected, conforming, until the mesh is fine enough where an indenter
or receptor is.

An edge is cut when it is the longest of every element around it; an element that must be cut while its
longest edge is a neighbour's shorter one waits for that neighbour (Rivara 1984). A new vertex is X of the
edge's midpoint in reference coordinates, so it lies on the interface when its edge does, and layers keep
their volumes.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from fingerjax.errors import InputError
from fingerjax.geometry.sections import LayeredSolid
from fingerjax.mesh.columns import INSIDE, Columns
from fingerjax.mesh.jacobian import volumes
from fingerjax.mesh.topology import boundary, edges, quadratic, signed_volumes

PASSES = 400
ROUNDS = 12  # in which elements are cut that are flat or folded but for their curved edges
LEAST = 0.07  # of an element's volume, that it must have with straight edges
FLATTEST = 0.02  # of a cut element's volume, that each half must keep: on the chord it is a half


@dataclass(frozen=True)
class Focus:
    """Where the mesh is refined, and how far.

    **Arguments:**

    - `kind`: "point", about one site of the skin; "line", a strip of the skin through it.
    - `z`, `theta`: the site, mm and rad.
    - `size`: NODE spacing to reach there, mm; edges come to twice that at most.
    - `extent`: mm; radius of a point's fine patch (`2 size` when None), half the length of a line (when None:
        across the pad half-way to its sides; along it 0.3 of the finger's length).
    - `along`: a line's direction, "x" across the pad or "z" along the finger.
    - `growth`: how fast edges may grow with distance from the focus, along the skin and in depth, mm per mm.
    """

    kind: str
    z: float
    theta: float = 1.5 * math.pi
    size: float = 0.1
    extent: float | None = None
    along: str = "x"
    growth: float = 0.6

    def __post_init__(self) -> None:
        if self.kind not in ("point", "line") or self.along not in ("x", "z"):
            raise InputError(
                "unknown focus",
                place="focus",
                seen=(self.kind, self.along),
                remedy="kind is point or line, along is x or z",
            )
        if not (self.size > 0 and self.growth > 0 and (self.extent is None or self.extent > 0)):
            raise InputError(
                "size, growth and extent of a focus must be positive",
                place="focus",
                seen=(self.size, self.growth, self.extent),
                remedy="write lengths in mm above 0",
            )

    def sites(self, solid: LayeredSolid) -> np.ndarray:
        """Points `(k, 3)` of the skin, a node spacing apart or less, that the focus stands for."""
        z, theta = np.array([self.z]), np.array([self.theta])
        if self.kind == "line" and self.along == "z":
            half = 0.3 * solid.length if self.extent is None else self.extent
            z = np.clip(_steps(self.z - half, self.z + half, self.size), 0.0, solid.length)
        elif self.kind == "line":
            radius = solid.largest_radius
            theta = _steps(self.theta - 0.5 * math.pi, self.theta + 0.5 * math.pi, 0.5 * self.size / radius)
        points = solid.surface(z, theta)
        if self.kind == "line" and self.along == "x":
            middle = solid.surface(np.array([self.z]), np.array([self.theta]))[0]
            half = 0.5 * float(np.abs(points[:, 0] - middle[0]).max()) if self.extent is None else self.extent
            points = points[np.abs(points[:, 0] - middle[0]) <= half]
        return points

    @property
    def core(self) -> float:
        """Distance from the sites within which the mesh is as fine as it gets, mm."""
        wide = 2.0 * self.size
        return max(wide, self.extent) if self.kind == "point" and self.extent is not None else wide


def _steps(low: float, high: float, step: float) -> np.ndarray:
    return np.linspace(low, high, max(2, math.ceil((high - low) / step) + 1))


def allowed_edge(solid: LayeredSolid, focus: tuple[Focus, ...], points: np.ndarray) -> np.ndarray:
    """Longest edge allowed at points `(k, 3)`, mm: twice the focus's size in its core, growing outside."""
    allowed = np.full(len(points), np.inf)
    for one in focus:
        distance, _ = cKDTree(one.sites(solid)).query(points)
        allowed = np.minimum(allowed, 2.0 * one.size + one.growth * np.maximum(distance - one.core, 0.0))
    return allowed


def refine(mesh: Columns, focus: tuple[Focus, ...]) -> Columns:
    """The mesh bisected until no element near a focus has an edge longer than is allowed there.

    The bone's inside is cut only where its surface is. Raises `InputError` for a focus off the finger.
    """
    solid = mesh.rays.solid
    for one in focus:
        if not 0.0 <= one.z <= solid.length:
            raise InputError(
                "the focus is not on the finger",
                place="focus, z",
                seen=one.z,
                remedy=f"stay between 0 and {solid.length:g} mm",
            )
    refined = _refined(mesh, focus, 0.0)
    if (signed_volumes(refined.vertices, refined.tets) <= 0).any():
        refined = _refined(mesh, focus, FLATTEST)
    corners, left = boundary(refined.tets), _on_chord(refined)
    skin = corners[(refined.t[corners] == 0.0).all(axis=1)]
    return dataclasses.replace(refined, skin=skin, notes=refined.notes | {"on_chord": left})


def _refined(mesh: Columns, focus: tuple[Focus, ...], flattest: float) -> Columns:
    """The same without its skin. `flattest`: see `_bisected`."""
    rounds = ROUNDS if focus and not flattest else 0
    for _ in range(PASSES):
        pairs, of = edges(mesh.tets, len(mesh.vertices))
        length = np.linalg.norm(np.diff(mesh.vertices[pairs], axis=1)[:, 0], axis=1)
        wanted = _too_long(mesh, focus, length[of])
        if not wanted.any() and rounds:
            wanted, rounds = _flat(mesh), rounds - 1
        if not wanted.any():
            break
        mesh = _bisected(mesh, pairs, of, _terminal(length, of, wanted), flattest)
    return mesh


def _on_chord(mesh: Columns) -> int:
    """How many vertices are not on their interface."""
    soft = mesh.t < INSIDE
    off = mesh.rays.position(mesh.feet[soft], mesh.t[soft]) - mesh.vertices[soft]
    return int((np.linalg.norm(off, axis=1) > 1e-9 * mesh.rays.solid.length).sum())


def _flat(mesh: Columns) -> np.ndarray:
    """`(e,)` bool: elements that are flat or folded but for their curved edges.

    An edge of the skin is cut before the one below it, or after: for a while the sag of the one is more than the thickness between. Curved
    edges hold such elements open; cut again, they open themselves.
    """
    pairs, _ = edges(mesh.tets, len(mesh.vertices))
    nodes, curved, _ = quadratic(mesh.vertices, mesh.tets, mesh.midpoints(pairs)[2])
    flat = signed_volumes(mesh.vertices, mesh.tets) < LEAST * np.abs(volumes(nodes, curved))
    return np.asarray(flat & (mesh.t[mesh.tets] < INSIDE).all(axis=1))


def _too_long(mesh: Columns, focus: tuple[Focus, ...], length: np.ndarray) -> np.ndarray:
    """`(e,)` bool: elements with an edge longer than is allowed at their nearest corner."""
    soft = (mesh.t[mesh.tets] < INSIDE).all(axis=1)
    if not focus:
        return np.zeros(len(soft), bool)
    corner = allowed_edge(mesh.rays.solid, focus, mesh.vertices)[mesh.tets].min(axis=1)
    middle = allowed_edge(mesh.rays.solid, focus, mesh.vertices[mesh.tets].mean(axis=1))
    return soft & (length.max(axis=1) > np.minimum(corner, middle) * (1.0 + 1e-9))


def _terminal(length: np.ndarray, of: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Edges to cut now: asked for by a `wanted` element or one that waits for it, and longest all round.

    Equal lengths are ordered by edge number, the same for all elements, so that some edge always is the
    longest.
    """
    rank = np.empty(len(length), np.int64)
    rank[np.lexsort((np.arange(len(length)), length))] = np.arange(len(length))
    longest = of[np.arange(len(of)), np.argmax(rank[of], axis=1)]
    marked = np.zeros(len(length), bool)
    marked[longest[wanted]] = True
    while True:
        waiting = marked[of].any(axis=1)
        grown = marked.copy()
        grown[longest[waiting]] = True
        if (grown == marked).all():
            break
        marked = grown
    not_longest = of[of != longest[:, None]]
    marked[not_longest] = False
    return np.flatnonzero(marked)


def _bisected(mesh: Columns, pairs: np.ndarray, of: np.ndarray, cut: np.ndarray, flattest: float) -> Columns:
    """The mesh with the edges `cut` halved; no element has two of them.

    A new vertex lies on its interface; but where that would leave a half of an element less than this share of its volume, and `flattest`
    is not 0, on the chord: a finger whose edges are nearly as long as it is wide cannot be refined otherwise.
    """
    feet, t, position = mesh.midpoints(pairs[cut])
    number = np.full(len(pairs), -1)
    number[cut] = len(mesh.vertices) + np.arange(len(cut))
    element, side = np.nonzero(number[of] >= 0)
    new = number[of[element, side]]
    ends = pairs[of[element, side]]
    old = mesh.tets[element]
    first = np.where(old == ends[:, :1], new[:, None], old)
    second = np.where(old == ends[:, 1:], new[:, None], old)
    keep = np.ones(len(mesh.tets), bool)
    keep[element] = False
    vertices = np.concatenate([mesh.vertices, position])
    if flattest:
        least = flattest * signed_volumes(mesh.vertices, old)
        folded = np.minimum(signed_volumes(vertices, first), signed_volumes(vertices, second)) < least
        on_chord = np.unique(new[folded])
        vertices[on_chord] = mesh.vertices[pairs[cut[on_chord - len(mesh.vertices)]]].mean(axis=1)
    return dataclasses.replace(
        mesh,
        feet=np.concatenate([mesh.feet, feet]),
        t=np.concatenate([mesh.t, t]),
        vertices=vertices,
        tets=np.concatenate([mesh.tets[keep], first, second]),
        layer=np.concatenate([mesh.layer[keep], np.tile(mesh.layer[element], 2)]),
    )
