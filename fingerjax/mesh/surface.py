"""The skin as triangles: fine on the pad, coarser towards the nail and the proximal cut.

pytetwild (fTetWild, Hu et al. 2020) fills the closed outer surface with tetrahedra under a sizing field; only
their boundary is kept. It is not deterministic, not even with one thread, so meshes are kept by the cache;
its envelope is relative to the diagonal of the bounding box.
"""

from __future__ import annotations

import contextlib
import tempfile
from dataclasses import dataclass

import numpy as np

from fingerjax.errors import InputError
from fingerjax.geometry.sections import LayeredSolid
from fingerjax.mesh.topology import TRIANGLE_EDGES, boundary, kuhn_tets

GROWTH = 0.6  # mm of edge per mm from the pad
OVERSHOOT = (
    0.88  # pytetwild's edges come out this much longer than its sizing field asks (median 1.14, measured)
)


@dataclass(frozen=True)
class Resolution:
    """NODE spacing in mm: quadratic edges are twice as long.

    - `pad`: on the pad.
    - `proximal`: the coarsest, far from the pad; 3 times the pad's when None.

    The defaults give about 8,500 nodes for the preset monkey, as in the paper's coarser mesh, and
    `Resolution(0.17, 1.0)` about 29,000, as in its finer one; for the human `pad=0.9` gives about 8,500.
    """

    pad: float = 0.5
    proximal: float | None = None

    def __post_init__(self) -> None:
        if not self.pad > 0 or not (self.coarsest >= self.pad):
            raise InputError(
                "node spacing must be positive, and not finer proximally than on the pad",
                place="resolution",
                seen=(self.pad, self.proximal),
                remedy="write for example pad_mm: 0.5, proximal_mm: 2.0",
            )

    @property
    def coarsest(self) -> float:
        """Largest node spacing, mm."""
        return 3.0 * self.pad if self.proximal is None else self.proximal

    def finer(self, times: float) -> Resolution:
        """For about `times` as many nodes: a ladder of 2, 4 and 8 for convergence."""
        share = float(times) ** (-1.0 / 3.0)
        return Resolution(self.pad * share, self.coarsest * share)


def closed_surface(solid: LayeredSolid, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """The whole outer surface with its proximal cap, points `(n, 3)` and outward triangles `(f, 3)`."""
    rings = max(24, int(np.ceil(solid.length / spacing)))
    turns = max(48, int(np.ceil(2 * np.pi * solid.largest_radius / spacing)))
    # Rings crowd towards the tip as 1 - u^2, where the radius falls like a square root.
    u = np.linspace(0.0, 1.0, rings + 1)
    z = solid.length * (1.0 - (1.0 - u) ** 1.5)
    if solid.radius(0, z[-1:], np.zeros(1))[0] <= 0:
        z = z[:-1]
    theta = 2 * np.pi * np.arange(turns) / turns
    side = solid.surface(z[:, None], theta[None, :])
    caps = np.array(
        [[*solid.centre(np.array([0.0]))[0], 0.0], [*solid.centre(np.array([solid.length]))[0], solid.length]]
    )
    points = np.concatenate([side.reshape(-1, 3), caps])
    return points, grid_triangles(len(z), turns)


def grid_triangles(rings: int, turns: int) -> np.ndarray:
    """Triangles between rings of points, closed by a fan at each end; outwards when z grows with the ring."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(rings - 1), np.arange(turns), indexing="ij"))
    a, b = i * turns + j, i * turns + (j + 1) % turns
    c, d = a + turns, b + turns
    first, last = np.arange(turns), (rings - 1) * turns + np.arange(turns)
    bottom, top = np.full(turns, rings * turns), np.full(turns, rings * turns + 1)
    return np.concatenate(
        [
            np.stack([a, b, d], axis=1),
            np.stack([a, d, c], axis=1),
            np.stack([bottom, np.roll(first, -1), first], axis=1),
            np.stack([top, last, np.roll(last, -1)], axis=1),
        ]
    )


def edge_length(solid: LayeredSolid, resolution: Resolution, points: np.ndarray) -> np.ndarray:
    """Wanted edge length `(k,)` mm: twice the pad's node spacing about its centre, growing away from it."""
    z = solid.pad_centre
    pad = np.array([*solid.centre(np.array([z]))[0], z])
    pad[1] = solid.pad_y(np.array([z]))[0]
    reach = 0.3 * np.ptp(solid.surface(np.full(90, z), np.linspace(0, 2 * np.pi, 90))[:, 0])
    away = (points - pad) * np.array([1.0, 1.0, 0.8])
    distance = np.maximum(np.linalg.norm(away, axis=1) - reach, 0.0)
    return np.minimum(2.0 * resolution.pad + GROWTH * distance, 2.0 * resolution.coarsest)


def background_box(solid: LayeredSolid, resolution: Resolution) -> tuple[np.ndarray, np.ndarray]:
    """A box of tetrahedra around the finger, points `(n, 3)` and elements `(e, 4)`, to carry the wanted edge length."""
    surface = solid.surface(
        np.linspace(0, solid.length, 40)[:, None], np.linspace(0, 6.28, 40)[None]
    ).reshape(-1, 3)
    low, high = surface.min(axis=0) - 1.0, surface.max(axis=0) + 1.0
    count = np.ceil((high - low) / np.maximum(1.0 * resolution.pad, 0.5)).astype(int)
    axes = [np.linspace(low[i], high[i], count[i] + 1) for i in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    divisions = (int(count[0]), int(count[1]), int(count[2]))
    return points, kuhn_tets(divisions).astype(np.int32)


def skin_triangles(solid: LayeredSolid, resolution: Resolution) -> tuple[np.ndarray, np.ndarray]:
    """Points `(n, 3)` and outward triangles `(f, 3)` of the skin without the proximal cut.

    Points lie within pytetwild's envelope of the true surface; those of the cut's rim lie in z = 0.
    """
    import pytetwild

    points, triangles = closed_surface(solid, 0.5 * resolution.pad)
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    # The sag of the longest edge: a tighter envelope forces the mesh finer than asked (points are put back on
    # the surface).
    envelope = 0.5 * resolution.coarsest**2 / solid.largest_radius
    box, box_tets = background_box(solid, resolution)
    # It leaves a file __tracked_surface.stl in the working directory.
    with tempfile.TemporaryDirectory() as scratch, contextlib.chdir(scratch):
        vertices, tets = pytetwild.tetrahedralize(
            points,
            triangles.astype(np.int32),
            edge_length_abs=2.0 * resolution.coarsest,
            epsilon=envelope / diagonal,
            optimize=True,
            vtk_ordering=True,
            quiet=True,
            bg_vertices=box,
            bg_tets=box_tets,
            bg_values=OVERSHOOT * edge_length(solid, resolution, box),
        )
    return _without_cut(np.asarray(vertices, float), boundary(np.asarray(tets, np.int64)), 2.0 * envelope)


def is_surface(triangles: np.ndarray) -> bool:
    """Whether no edge of the triangles `(f, 3)` has more than two of them, as on a surface that does not touch itself."""
    sides = np.sort(triangles[:, TRIANGLE_EDGES].reshape(-1, 2), axis=1)
    return int(np.unique(sides, axis=0, return_counts=True)[1].max(initial=0)) <= 2


def _without_cut(points: np.ndarray, faces: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """The boundary without its flat cap at z = 0; vertices of the rim are put into the plane."""
    a, b, c = (points[faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    flat = -normal[:, 2] > 0.7 * np.linalg.norm(normal, axis=1)
    cap = flat & (np.abs(points[faces][:, :, 2]) < tolerance).all(axis=1)
    rim = np.intersect1d(faces[cap], faces[~cap])
    points = points.copy()
    points[rim, 2] = 0.0
    used, number = np.unique(faces[~cap], return_inverse=True)
    return points[used], number.reshape(-1, 3)
