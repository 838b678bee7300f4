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
from fingerjax.mesh.jacobian import EVERYWHERE, POINTS, WEIGHTS, WORST, determinants
from fingerjax.mesh.topology import boundary, edges, signed_volumes

TIP_GROWTH = 4.0  # of edges around a tip, mm per mm: few nodes more than the one that is wanted
PASSES = 400
PATIENCE = 40  # rounds in which flat and folded elements are cut that may leave no fewer of them
LEAST = 0.07  # of an element's volume, that it must have with straight edges
FLATTEST = 0.02  # of a cut element's volume, that each half must keep: on the chord it is a half


@dataclass(frozen=True)
class Focus:
    """Where the mesh is refined, and how far.

    **Arguments:**

    - `kind`: "point", about one site of the skin; "tip", at the very site, for a probe to touch a node there; "line", a strip of the skin
        through it.
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
        if self.kind not in ("point", "tip", "line") or self.along not in ("x", "z"):
            raise InputError(
                "unknown focus",
                place="focus",
                seen=(self.kind, self.along),
                remedy="kind is point, tip or line, along is x or z",
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
        if self.kind == "tip":
            return 0.0
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
    refined = _refined(mesh, focus, everywhere=False)
    if (signed_volumes(refined.vertices, refined.tets) <= 0).any():
        refined = _refined(mesh, focus, everywhere=True)
    corners, left = boundary(refined.tets), int(_Found().on_chord(refined).sum())
    skin = corners[(refined.t[corners] == 0.0).all(axis=1)]
    return dataclasses.replace(refined, skin=skin, notes=refined.notes | {"on_chord": left})


def _refined(mesh: Columns, focus: tuple[Focus, ...], everywhere: bool) -> Columns:
    """The same without its skin. `everywhere`: see `_bisected`.

    Cutting what is flat or folded makes more of it where edges are as long as the finger is wide: the mesh that had least of it is kept.
    """
    found, best, least, most, patience = _Found(), mesh, math.inf, 0, PATIENCE if focus and not everywhere else 0
    for _ in range(PASSES):
        pairs, of = edges(mesh.tets, len(mesh.vertices))
        length = np.linalg.norm(np.diff(mesh.vertices[pairs], axis=1)[:, 0], axis=1)
        wanted = _too_long(mesh, focus, length[of])
        if not wanted.any():
            if not patience:
                break
            wanted, folded = _flat(mesh, pairs, of, found), (signed_volumes(mesh.vertices, mesh.tets) <= 0).sum()
            left = wanted.sum() + len(wanted) * folded
            best, least, patience = (mesh, left, PATIENCE) if left < least else (best, least, patience - 1)
            most = most or 4 * wanted.sum() + 10
            if not patience or not 0 < wanted.sum() <= most:
                return best
        mesh = _bisected(mesh, pairs, of, _terminal(length, of, wanted), everywhere)
    return mesh


class _Found:
    """What lies on the interfaces, found once: vertices stay where they are while elements are cut."""

    def __init__(self) -> None:
        self.edge, self.position, self.off = np.empty(0, np.int64), np.empty((0, 3)), np.empty(0, bool)

    def midsides(self, mesh: Columns, pairs: np.ndarray) -> np.ndarray:
        """Positions `(m, 3)` for the edges `pairs`, `(m, 2)`, which are in order and each there once."""
        edge = (pairs[:, 0] << 32) + pairs[:, 1]
        position, known = np.empty((len(pairs), 3)), np.isin(edge, self.edge)
        position[known] = self.position[np.searchsorted(self.edge, edge[known])]
        position[~known] = mesh.midpoints(pairs[~known])[2]
        self.edge, self.position = edge, position
        return position

    def on_chord(self, mesh: Columns) -> np.ndarray:
        """`(n,)` bool: vertices that are not on their interface."""
        new = slice(len(self.off), None)
        feet, t, vertices = mesh.feet[new], mesh.t[new], mesh.vertices[new]
        off, soft = np.zeros(len(t), bool), t < INSIDE
        away = mesh.rays.position(feet[soft], t[soft]) - vertices[soft]
        off[soft] = np.linalg.norm(away, axis=1) > 1e-9 * mesh.rays.solid.length
        self.off = np.concatenate([self.off, off])
        return self.off


def _flat(mesh: Columns, pairs: np.ndarray, of: np.ndarray, found: _Found) -> np.ndarray:
    """`(e,)` bool: elements that are flat but for their curved edges, or that these turn inside out.

    An edge of the skin is cut before the one below it, or after: for a while the sag of the one is more than the thickness between. Cut
    again, such elements open themselves.
    """
    nodes = np.concatenate([mesh.vertices, found.midsides(mesh, pairs)])
    curved = np.concatenate([mesh.tets, of + len(mesh.vertices)], axis=1)
    straight, own = 6.0 * signed_volumes(mesh.vertices, mesh.tets), determinants(nodes, curved, EVERYWHERE)
    flat = (straight < LEAST * np.abs(own[:, : len(POINTS)] @ WEIGHTS)) | (own.min(axis=1) < WORST * straight)
    free = ~found.on_chord(mesh) & (mesh.t < INSIDE)
    return np.asarray(flat & free[mesh.tets].all(axis=1))


def _too_long(mesh: Columns, focus: tuple[Focus, ...], length: np.ndarray) -> np.ndarray:
    """`(e,)` bool: elements with an edge longer than is allowed at their nearest corner."""
    soft = (mesh.t[mesh.tets] < INSIDE).all(axis=1)
    if not focus:
        return np.zeros(len(soft), bool)
    corner = allowed_edge(mesh.rays.solid, focus, mesh.vertices)[mesh.tets].min(axis=1)
    middle = allowed_edge(mesh.rays.solid, focus, mesh.vertices[mesh.tets].mean(axis=1))
    wanted = soft & (length.max(axis=1) > np.minimum(corner, middle) * (1.0 + 1e-9))
    for one in focus:
        if one.kind == "tip":
            wanted |= _under_tip(mesh, one)
    return np.asarray(wanted)


def _under_tip(mesh: Columns, tip: Focus) -> np.ndarray:
    """`(e,)` bool: elements whose face in the skin has the tip's site in it, and an edge longer than is allowed there: the site may be far
    from the face's corners and from the element's middle alike.
    """
    site = tip.sites(mesh.rays.solid)
    corners = mesh.t[mesh.tets] == 0.0
    element = np.flatnonzero(corners.sum(axis=1) == 3)
    face = mesh.vertices[mesh.tets[element][corners[element]].reshape(-1, 3)]
    centre = mesh.rays.axis(mesh.rays.aim(site[:, 2]))
    a, b, c = np.swapaxes(face - centre, 0, 1)
    to = np.broadcast_to(site - centre, a.shape)
    volume = np.einsum("fi,fi->f", np.cross(a, b), c)
    share = np.stack([np.einsum("fi,fi->f", np.cross(one, other), to) for one, other in ((b, c), (c, a), (a, b))], axis=1)
    inside = (share * np.sign(volume)[:, None] >= -1e-9 * np.abs(volume)[:, None]).all(axis=1)
    longest = np.linalg.norm(face - face[:, [1, 2, 0]], axis=2).max(axis=1)
    out = np.zeros(len(mesh.tets), bool)
    out[element] = inside & (longest > 2.0 * tip.size * (1.0 + 1e-9))
    return out


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


def _bisected(mesh: Columns, pairs: np.ndarray, of: np.ndarray, cut: np.ndarray, everywhere: bool) -> Columns:
    """The mesh with the edges `cut` halved; no element has two of them.

    A new vertex lies on its interface; but where that would leave less than a share `FLATTEST` of an element of the bone's inside, or
    `everywhere` of any element, on the chord: a finger whose edges are nearly as long as it is wide cannot be refined otherwise.
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
    least = FLATTEST * signed_volumes(mesh.vertices, old)
    folded = np.minimum(signed_volumes(vertices, first), signed_volumes(vertices, second)) < least
    on_chord = np.unique(new[folded & (everywhere | (mesh.t[old] == INSIDE).any(axis=1))])
    vertices[on_chord] = mesh.vertices[pairs[cut[on_chord - len(mesh.vertices)]]].mean(axis=1)
    return dataclasses.replace(
        mesh,
        feet=np.concatenate([mesh.feet, feet]),
        t=np.concatenate([mesh.t, t]),
        vertices=vertices,
        tets=np.concatenate([mesh.tets[keep], first, second]),
        layer=np.concatenate([mesh.layer[keep], np.tile(mesh.layer[element], 2)]),
    )
