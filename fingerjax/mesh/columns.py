"""Columns: from every point of the skin a straight ray to the axis of the bone, layers found on it, prisms
cut into tetrahedra.

Any point of the soft tissue has a reference coordinate (P, t): its foot P on the skin, and a depth t that is
0 on the skin and 1, 2, 3, 4 on the interfaces, 4 being the bone's surface, linear in between. X(P, t) is
where it lies. Vertices, midsides and the children of refinement all are X of some (P, t), so interfaces stay
where the solid has them at any refinement. Inside the bone, triangles of its surface are joined to a few
points of its axis, straight.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from fingerjax.errors import InputError
from fingerjax.geometry.sections import LayeredSolid
from fingerjax.layers import BONE
from fingerjax.mesh.quality import dihedral_angles
from fingerjax.mesh.topology import oriented, prism_tets, signed_volumes

INSIDE = 5.0  # depth t of points inside the bone, which have no foot
FLAT = 1e-4  # volume of an element of the bone over the cube of its size, below which other diagonals are tried
HALVINGS = 42  # 10 mm / 2^42 is at rounding


@dataclass(frozen=True, eq=False)
class Rays:
    """The map X(P, t) of one solid.

    `thinnest`: a layer thinner than this along a ray, mm, is made this thick at the expense of the ones
    inside it. `factors` multiply the thickness of epidermis, dermis and fibrous matrix; adipose tissue gives way.
    """

    solid: LayeredSolid
    thinnest: float = 0.03
    factors: tuple[float, float, float] = (1.0, 1.0, 1.0)

    @cached_property
    def bone_reach(self) -> float:
        """z of the last axis point, mm: inside the bone, about its own radius short of its end."""
        z = np.linspace(0.0, self.solid.length, 801)
        theta = np.linspace(0.0, 2 * np.pi, 72, endpoint=False)
        square = self.solid.square(BONE, z[:, None], theta[None, :]).min(axis=1)
        if square[0] <= 0:
            raise InputError(
                "the bone does not reach the proximal cut: columns need it as their axis",
                place="r_bone at z = 0",
                seen=0.0,
                remedy="give the bone a radius from z = 0 on",
            )
        gone = np.flatnonzero(square <= 0)
        end = z[gone[0]] if len(gone) else self.solid.length
        radius = float(np.sqrt(np.median(square[z < end])))
        return max(float(end) - 0.8 * radius, 0.5 * float(end))

    def axis(self, z: np.ndarray) -> np.ndarray:
        """Points `(k, 3)` of the bone's axis at z."""
        return np.concatenate([self.solid.centre(z), np.asarray(z)[:, None]], axis=1)

    def aim(self, z: np.ndarray) -> np.ndarray:
        """z where the ray from a skin point at z meets the axis: about z, less towards the tip; 0 at 0."""
        length = self.solid.length
        short = 1.0 - self.bone_reach / length
        power = min(2.5, 0.9 / short)
        share = np.clip(np.asarray(z, float) / length, 0.0, 1.0)
        return length * (share - short * share**power)

    def foot(self, points: np.ndarray) -> np.ndarray:
        """The point of the skin beyond or before each point `(k, 3)`, on the ray that its z aims along."""
        target = self.axis(self.aim(points[:, 2]))
        reach = points - target

        def outside(s: np.ndarray) -> np.ndarray:
            return self.solid.level(0, target + s[:, None] * reach) > 0

        s = _bisect(outside, np.full(len(points), 0.3), np.full(len(points), 3.0))
        return target + s[:, None] * reach

    def depths(self, feet: np.ndarray) -> tuple[np.ndarray, int]:
        """Share of the ray at which each interface is met, `(k, 5)`, 0 on the skin; how many were moved."""
        target = self.axis(self.aim(feet[:, 2]))
        reach = target - feet
        least = self.thinnest / np.linalg.norm(reach, axis=1)
        met = np.zeros((len(feet), BONE + 1))
        moved = 0
        for layer in range(1, BONE + 1):

            def within(s: np.ndarray, layer: int = layer) -> np.ndarray:
                return self.solid.level(layer, feet + s[:, None] * reach) < 0

            found = _bisect(within, met[:, layer - 1], np.ones(len(feet)))
            met[:, layer] = np.maximum(found, met[:, layer - 1] + least)
            moved += int(np.sum(met[:, layer] > found + 1e-9))
        return (met, moved) if self.factors == (1.0, 1.0, 1.0) else (np.stack(thickened(met.T, self.factors), axis=1), moved)

    def position(self, feet: np.ndarray, t: np.ndarray) -> np.ndarray:
        """X(P, t), `(k, 3)` mm, for feet `(k, 3)` on the skin and depths t `(k,)` from 0 to 4."""
        below = np.clip(np.floor(t), 0, BONE - 1).astype(int)
        met, _ = self.depths(feet)
        row = np.arange(len(feet))
        share = met[row, below] + (t - below) * (met[row, below + 1] - met[row, below])
        return feet + share[:, None] * (self.axis(self.aim(feet[:, 2])) - feet)


def thickened(met: Any, factors: Any) -> list[Any]:
    """Shares of a ray, `(5, k)`, at which interfaces are met once epidermis, dermis and fibrous matrix are `factors` times as thick.

    Skin and bone stay where they are; NumPy's or JAX's arrays.
    """
    skin, epidermis, dermis, adipose, bone = met
    first = skin + factors[0] * (epidermis - skin)
    return [skin, first, first + factors[1] * (dermis - epidermis), bone - factors[2] * (bone - adipose), bone]


def _bisect(beyond: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Where `beyond` turns true between `low` and `high`, one root for each entry."""
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        past = beyond(middle)
        low, high = np.where(past, low, middle), np.where(past, middle, high)
    return 0.5 * (low + high)


@dataclass(frozen=True, eq=False)
class Columns:
    """A mesh of 4-node tetrahedra in reference coordinates.

    - `rays`: the map from reference to position.
    - `feet`: `(n, 3)` mm, skin point above each vertex; the vertex itself inside the bone.
    - `t`: `(n,)` depth, 0 to 4, or `INSIDE`.
    - `vertices`: `(n, 3)` mm.
    - `tets`: `(e, 4)`, positively oriented; `layer`: `(e,)`.
    - `skin`: `(f, 3)` outward triangles.
    - `notes`: what had to be mended, counted.
    """

    rays: Rays
    feet: np.ndarray
    t: np.ndarray
    vertices: np.ndarray
    tets: np.ndarray
    layer: np.ndarray
    skin: np.ndarray
    notes: dict[str, int]

    def midpoints(self, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Feet, depths and positions of the midpoints of edges `(m, 2)`, halved in reference coordinates."""
        a, b = pairs.T
        soft = (self.t[a] < INSIDE) & (self.t[b] < INSIDE)
        t = np.where(soft, 0.5 * (self.t[a] + self.t[b]), INSIDE)
        feet = 0.5 * (self.vertices[a] + self.vertices[b])
        position = feet.copy()
        chord = 0.5 * (self.feet[a[soft]] + self.feet[b[soft]])
        # The foot of an upright edge is its own: no need to look for it again.
        upright = (self.feet[a[soft]] == self.feet[b[soft]]).all(axis=1)
        chord[~upright] = self.rays.foot(chord[~upright])
        feet[soft] = chord
        position[soft] = self.rays.position(chord, t[soft])
        return feet, t, position


def columns(
    solid: LayeredSolid,
    points: np.ndarray,
    triangles: np.ndarray,
    thinnest: float = 0.03,
    through: int = 1,
) -> Columns:
    """Tetrahedra under the skin triangles: `through` elements through each soft layer, and the bone.

    `points`, `(n, 3)`, are put on the true surface; `triangles`, `(f, 3)`, point outwards. Raises
    `InputError` where an element has no volume, which a solid that is not star-shaped about its axis can
    bring about.
    """
    rays = Rays(solid, thinnest)
    feet = rays.foot(points)
    n = len(feet)
    met, moved = rays.depths(feet)
    reach = rays.axis(rays.aim(feet[:, 2])) - feet
    depth = np.arange(BONE * through + 1) / through
    below = np.minimum(depth.astype(int), BONE - 1)
    share = met[:, below] + (depth - below) * (met[:, below + 1] - met[:, below])
    shells = feet[None] + share.T[:, :, None] * reach[None]
    stations, station_of = _stations(rays, shells[-1], triangles)
    vertices = np.concatenate([shells.reshape(-1, 3), rays.axis(stations)])
    tets, layer = [], []
    for shell in range(BONE * through):
        upper, lower = triangles + shell * n, triangles + (shell + 1) * n
        tets.append(prism_tets(upper, lower, rank=_diagonals(vertices, upper, lower)))
        layer.append(np.full(len(tets[-1]), shell // through))
    core = _core(vertices, triangles + BONE * through * n, len(depth) * n + station_of[triangles])
    tets.append(core)
    layer.append(np.full(len(core), BONE))
    elements = oriented(vertices, np.concatenate(tets))
    t = np.concatenate([np.repeat(depth, n), np.full(len(stations), INSIDE)])
    kinds = np.concatenate(layer).astype(np.int64)
    return _without_slivers(
        Columns(
            rays=rays,
            feet=np.concatenate([np.tile(feet, (len(depth), 1)), rays.axis(stations)]),
            t=t,
            vertices=vertices,
            tets=elements,
            layer=kinds,
            skin=triangles,
            notes={"thickened": moved},
        )
    )


def _diagonals(vertices: np.ndarray, upper: np.ndarray, lower: np.ndarray, sweeps: int = 4) -> np.ndarray:
    """Ranks `(f, 3)` of the columns of one shell's prisms that keep its flattest tetrahedra from being
    flatter.

    Any ranking cuts a shell conformingly. Starting from the vertex number, columns at the worst twentieth of
    the prisms are tried first and last in rank, and stay there when the worst angle around them grows.
    """
    first = int(upper.min())
    column, count = upper - first, int(upper.max()) - first + 1
    rank = np.arange(count, dtype=float)

    def worst(prisms: np.ndarray | list[int]) -> np.ndarray:
        tets = prism_tets(upper[prisms], lower[prisms], rank=rank[column[prisms]])
        return dihedral_angles(vertices, tets).min(axis=1).reshape(-1, 3).min(axis=1)

    def suspects() -> np.ndarray:
        angle = worst(np.arange(len(upper)))
        return np.argsort(angle)[: max(10, len(angle) // 20)]

    _reranked(rank, column, worst, suspects, sweeps)
    return rank[column]


def _reranked(
    rank: np.ndarray,
    column: np.ndarray,
    worst: Callable[[Any], np.ndarray],
    suspects: Callable[[], np.ndarray],
    sweeps: int,
) -> None:
    """Columns of the suspect prisms tried first and last in rank, in place, kept there when what is `worst` around them grows."""
    around: list[list[int]] = [[] for _ in range(len(rank))]
    for prism, corners in enumerate(column):
        for corner in corners:
            around[corner].append(prism)
    for _ in range(sweeps):
        changed = False
        for prism in suspects():
            for i in column[prism]:
                before, old = worst(around[i]).min(), rank[i]
                for new in (rank.min() - 1.0, rank.max() + 1.0):
                    rank[i] = new
                    if worst(around[i]).min() > before:
                        changed = True
                        break
                    rank[i] = old
        if not changed:
            break


def _core(vertices: np.ndarray, bone: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Tetrahedra between triangles of the bone's surface and the axis points they share; prisms that collapse
    lose some.

    Diagonals rise from the more proximal axis point's column: by vertex number alone, a column between two of
    another slab could give one tetrahedron twice. An edge along the bone, as the nail's rim brings about, would then give
    flat ones, which lie in one plane with the axis: there other diagonals are taken.
    """
    first, count = int(bone.min()), int(bone.max() - bone.min()) + 1
    column = bone - first
    station = np.zeros(count, np.int64)
    station[column] = axis
    rank = np.argsort(np.argsort(station * np.int64(count) + np.arange(count))).astype(float)

    def worst(prisms: Any) -> np.ndarray:
        tets = prism_tets(bone[prisms], axis[prisms], rank=rank[column[prisms]])
        size = np.ptp(vertices[tets], axis=1).max(axis=1) ** 3
        whole = (np.diff(np.sort(tets, axis=1), axis=1) > 0).all(axis=1)
        thick = np.where(whole, np.abs(signed_volumes(vertices, tets)) / np.maximum(size, 1e-300), np.inf)
        return thick.reshape(-1, 3).min(axis=1)

    _reranked(rank, column, worst, lambda: np.flatnonzero(worst(np.arange(len(bone))) < FLAT), 6)
    tets = prism_tets(bone, axis, rank=rank[column])
    return tets[(np.diff(np.sort(tets, axis=1), axis=1) > 0).all(axis=1)]


def _stations(rays: Rays, bone: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """z of the axis points that the bone's surface is joined to, and which of them each surface point takes.

    The bone is cut into slabs, one axis point in each, the first in the plane of the cut. No triangle may
    reach over a whole slab: a prism with three different points of one line has no volume. So each slab ends
    where the longest triangle across its beginning does.
    """
    z = bone[:, 2]
    low, high = z[triangles].min(axis=1), z[triangles].max(axis=1)
    least = 0.7 * float(np.median(high - low))
    cuts = [0.5 * float(np.median(high[low <= 1e-9]))]
    while True:
        across = (low <= cuts[-1]) & (high >= cuts[-1])
        reached = max(float(high[across].max(initial=0.0)), cuts[-1] + least) + 1e-9
        if reached > rays.bone_reach:
            break
        cuts.append(reached)
    middles = 0.5 * (np.array(cuts) + np.r_[cuts[1:], max(rays.bone_reach, cuts[-1])])
    return np.r_[0.0, middles], np.searchsorted(cuts, z)


def _without_slivers(mesh: Columns) -> Columns:
    """The same mesh without unused vertices; elements of no volume are refused."""
    volume = signed_volumes(mesh.vertices, mesh.tets)
    size = np.ptp(mesh.vertices[mesh.tets], axis=1).max(axis=1) ** 3
    flat = volume < 1e-9 * size
    if flat.any():
        where = mesh.vertices[mesh.tets[flat][0]].mean(axis=0)
        raise InputError(
            f"{int(flat.sum())} elements have no volume",
            place="mesh near x, y, z = " + ", ".join(f"{c:.2f}" for c in where),
            remedy="see that layers are star-shaped about the centre of the bone, or ask for a finer mesh",
        )
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.tets] = True
    number = np.cumsum(used) - 1
    return Columns(
        rays=mesh.rays,
        feet=mesh.feet[used],
        t=mesh.t[used],
        vertices=mesh.vertices[used],
        tets=number[mesh.tets],
        layer=mesh.layer,
        skin=number[mesh.skin],
        notes=mesh.notes,
    )
