"""Twenty-node bricks on a structured lattice: shape functions, stiffness, and a block Cholesky factor.

The lattice has three directions (i depth, outwards; j around; k along the finger).  Element corners sit at
even lattice indices and midside nodes where exactly one index is odd.  Lengths are in mm, moduli in MPa,
forces in N.

Integration is selective: the shear part of the energy is integrated with 3x3x3 Gauss points and the volume
part with 2x2x2. Full integration alone would be somewhat too stiff at a Poisson ratio of 0.48; 2x2x2 for
everything would leave the element with zero-energy modes where skin is ten times stiffer than what carries
it.  The volume part at 2x2x2 asks for eight volume changes an element instead of twenty-seven, which a
twenty-node brick can follow.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

Array = np.ndarray

OFFSETS = np.array(
    [(a, b, c) for c in (0, 2) for b in (0, 2) for a in (0, 2)]
    + [(1, b, c) for c in (0, 2) for b in (0, 2)]
    + [(a, 1, c) for c in (0, 2) for a in (0, 2)]
    + [(a, b, 1) for b in (0, 2) for a in (0, 2)]
)
"""Lattice position of each of the 20 nodes within its brick, (20, 3)."""

NATURAL = OFFSETS - 1.0
"""Natural coordinates of the 20 nodes, (20, 3), each in {-1, 0, 1}."""


def shape_values(at: Array) -> Array:
    """Serendipity shape functions (points, 20) at natural coordinates `at` (points, 3)."""
    factor = _factors(at)[0]
    bubble = np.where(_corner(), (at[:, None, :] * NATURAL).sum(2) - 2.0, 1.0)
    return np.where(_corner(), 0.125, 0.25) * factor.prod(2) * bubble


def shape_slopes(at: Array) -> Array:
    """Derivatives (points, 20, 3) of the shape functions in natural coordinates at `at` (points, 3)."""
    factor, slope = _factors(at)
    corner, scale = _corner(), np.where(_corner(), 0.125, 0.25)
    bubble = np.where(corner, (at[:, None, :] * NATURAL).sum(2) - 2.0, 1.0)
    out = np.empty((len(at), 20, 3))
    for d in range(3):
        others = factor[:, :, [m for m in range(3) if m != d]].prod(2)
        own = slope[:, :, d] * bubble + np.where(corner, factor[:, :, d] * NATURAL[:, d], 0.0)
        out[:, :, d] = scale * others * own
    return out


def _corner() -> Array:
    return np.abs(NATURAL).sum(1) == 3.0


def _factors(at: Array) -> tuple[Array, Array]:
    """One-dimensional factors of every shape function, and their slopes, both (points, 20, 3)."""
    t, n = at[:, None, :], NATURAL[None]
    middle = n == 0.0
    return np.where(middle, 1.0 - t**2, 1.0 + t * n), np.where(middle, -2.0 * t, n + 0.0 * t)


@cache
def gauss_cube(order: int) -> tuple[Array, Array]:
    """Gauss points (order^3, 3) and weights (order^3,) on the cube from -1 to 1."""
    x, w = np.polynomial.legendre.leggauss(order)
    points = np.stack(np.meshgrid(x, x, x, indexing="ij"), -1).reshape(-1, 3)
    weights = np.einsum("a,b,c->abc", w, w, w).ravel()
    return points, weights


@dataclass(frozen=True)
class Bricks:
    """A structured brick mesh.

    nodes (n, 3) mm; bricks (e, 20) node numbers; layer (e,) 0 epidermis to 3 fibrous matrix; number (2I+1,
    2J+1, 2K+1) node at each lattice position or -1; slab (n,) which k-layer a node belongs to, the blocks
    of the factor; fixed (n, 3) held at zero.
    """

    nodes: Array
    bricks: Array
    layer: Array
    number: Array
    slab: Array
    fixed: Array

    @property
    def cells(self) -> tuple[int, int, int]:
        """Number of bricks in depth, around and along."""
        i, j, k = self.number.shape
        return (i - 1) // 2, (j - 1) // 2, (k - 1) // 2


def lattice(
    points: Array, layer_of_depth: Array, *, pole: bool = False
) -> tuple[Array, Array, Array, Array, Array]:
    """Number a lattice of positions (2I+1, 2J+1, 2K+1, 3) and list its bricks.

    With `pole` the last plane in k is one line: all its positions around share a node, so that the last
    bricks are wedges. Returns nodes, bricks, layer, number, slab as in `Bricks`.
    """
    sizes = points.shape[:3]
    index = np.indices(sizes)
    kept = (index % 2).sum(0) <= 1
    first = kept.copy()
    if pole:
        first[:, 1:, -1] = False
    number = np.full(sizes, -1)
    order = np.argwhere(first.transpose(2, 0, 1))  # k slowest, so that slabs are contiguous
    number[order[:, 1], order[:, 2], order[:, 0]] = np.arange(len(order))
    nodes = points[order[:, 1], order[:, 2], order[:, 0]]
    slab = order[:, 0] // 2
    if pole:
        number[:, 1:, -1] = np.where(kept[:, 1:, -1], number[:, :1, -1], -1)
    cell = np.indices([(s - 1) // 2 for s in sizes]).reshape(3, -1).T
    at = 2 * cell[:, None, :] + OFFSETS
    return nodes, number[at[..., 0], at[..., 1], at[..., 2]], layer_of_depth[cell[:, 0]], number, slab


def gradients(coordinates: Array, order: int) -> tuple[Array, Array]:
    """Shape-function gradients (e, q, 20, 3) in mm^-1 and weights (e, q) in mm^3 for bricks at
    `coordinates` (e, 20, 3).

    Raises ValueError when a brick is turned inside out at a Gauss point.
    """
    at, weights = gauss_cube(order)
    slopes = shape_slopes(at)
    jacobian = np.einsum("eai,qaj->eqij", coordinates, slopes, optimize=True)
    size = np.linalg.det(jacobian)
    if size.min() <= 0.0:
        worst = int(size.min(1).argmin())
        raise ValueError(
            f"brick {worst} has Jacobian {size.min():.3g}; use smoother sections or finer divisions"
        )
    return np.einsum("qaj,eqji->eqai", slopes, np.linalg.inv(jacobian), optimize=True), size * weights


def brick_stiffness(
    coordinates: Array, first: Array, second: Array, *, volume_order: int = 2, shear_order: int = 3
) -> Array:
    """Stiffness matrices (e, 60, 60) in N/mm for Lame moduli `first` and `second` (e,), integrated
    selectively."""
    volume = _products(*gradients(coordinates, volume_order))
    shear = volume if shear_order == volume_order else _products(*gradients(coordinates, shear_order))
    trace = np.einsum("eakbk->eab", shear)
    matrix = first[:, None, None, None, None] * volume
    matrix += second[:, None, None, None, None] * shear.transpose(0, 1, 4, 3, 2)
    for i in range(3):
        matrix[:, :, i, :, i] += second[:, None, None] * trace
    return matrix.reshape(-1, 60, 60)


def _products(gradient: Array, weights: Array) -> Array:
    """Integral of N_a,i N_b,j over each brick: (e, 20, 3, 20, 3)."""
    flat = gradient.reshape(*gradient.shape[:2], 60)
    return ((flat * weights[..., None]).transpose(0, 2, 1) @ flat).reshape(-1, 20, 3, 20, 3)


def lame(modulus: Array, poisson: Array | float) -> tuple[Array, Array]:
    """The two Lame moduli, MPa, of Young's `modulus` (any shape) and Poisson ratio `poisson`."""
    return modulus * poisson / ((1 + poisson) * (1 - 2 * poisson)), modulus / (2 * (1 + poisson))


def assemble(mesh: Bricks, moduli: Array, poisson: float, **orders: int) -> sp.csr_matrix:
    """Stiffness (3n, 3n) in N/mm of a mesh whose layers have Young's `moduli` (4,) in MPa; no support is
    applied."""
    return assemble_bricks(mesh, np.asarray(moduli)[mesh.layer], np.full(len(mesh.bricks), poisson), **orders)


def assemble_bricks(mesh: Bricks, modulus: Array, poisson: Array, **orders: int) -> sp.csr_matrix:
    """Stiffness (3n, 3n) in N/mm of bricks that each have a Young's `modulus` (e,) in MPa and a `poisson` ratio (e,)."""
    first, second = lame(modulus, poisson)
    total = sp.csr_matrix((3 * len(mesh.nodes),) * 2)
    for part in np.array_split(np.arange(len(mesh.bricks)), 1 + len(mesh.bricks) // 800):
        block = brick_stiffness(mesh.nodes[mesh.bricks[part]], first[part], second[part], **orders)
        dof = (3 * mesh.bricks[part][:, :, None] + np.arange(3)).reshape(len(part), 60)
        rows, columns = np.repeat(dof, 60, axis=1).ravel(), np.tile(dof, (1, 60)).ravel()
        total = total + sp.csr_matrix((block.ravel(), (rows, columns)), shape=total.shape)
    return total


def _lower(factor: Array, right: Array, trans: str = "N") -> Array:
    return la.solve_triangular(factor, right, lower=True, trans=trans, check_finite=False)


class SlabFactor:
    """Block Cholesky factor of the supported stiffness: bricks couple a slab of the lattice with its two
    neighbours only.

    Dense blocks of one slab at a time use the fast part of LAPACK, and no sparse direct package is needed.
    """

    def __init__(self, mesh: Bricks, stiffness: sp.csr_matrix) -> None:
        free = np.flatnonzero(~mesh.fixed.ravel())
        slab = np.repeat(mesh.slab, 3)[free]
        self.size, self.free = stiffness.shape[0], free
        self.matrix = stiffness[free][:, free].tocsr()
        edges = np.searchsorted(slab, np.arange(slab.max() + 2))
        self.parts = [slice(a, b) for a, b in pairwise(edges) if b > a]
        self.diagonal: list[Array] = []
        self.coupling: list[Array] = []
        for m, part in enumerate(self.parts):
            block = self.matrix[part][:, part].toarray()
            if m:
                below = self.matrix[part][:, self.parts[m - 1]].toarray()
                link = _lower(self.diagonal[-1], below.T).T
                block -= link @ link.T
                self.coupling.append(link)
            self.diagonal.append(la.cholesky(block, lower=True, overwrite_a=True, check_finite=False))

    def solve(self, load: Array) -> Array:
        """Displacements (3n, columns) in mm under `load` (3n, columns) in N; supported ones are zero."""
        x = np.array(load[self.free], dtype=float)
        for m, part in enumerate(self.parts):
            if m:
                x[part] -= self.coupling[m - 1] @ x[self.parts[m - 1]]
            x[part] = _lower(self.diagonal[m], x[part])
        for m, part in reversed(list(enumerate(self.parts))):
            if m + 1 < len(self.parts):
                x[part] -= self.coupling[m].T @ x[self.parts[m + 1]]
            x[part] = _lower(self.diagonal[m], x[part], "T")
        out = np.zeros((self.size, load.shape[1]))
        out[self.free] = x
        return out

    def residual(self, load: Array, answer: Array) -> float:
        """Largest norm of load - K u over the columns, relative to the load's: what the factor is worth,
        recomputed."""
        left = load[self.free] - self.matrix @ answer[self.free]
        return float((np.linalg.norm(left, axis=0) / np.linalg.norm(load[self.free], axis=0)).max())


def locate(mesh: Bricks, point: Array, tolerance: float = 1e-6) -> tuple[int, Array]:
    """The brick that holds `point` (3,) mm and the point's natural coordinates (3,).  Raises ValueError
    outside the mesh."""
    centre = mesh.nodes[mesh.bricks].mean(1)
    for brick in np.argsort(np.linalg.norm(centre - point, axis=1))[:40]:
        at, corners = np.zeros((1, 3)), mesh.nodes[mesh.bricks[brick]]
        for _ in range(25):
            miss = point - shape_values(at)[0] @ corners
            at = np.clip(at + np.linalg.solve(corners.T @ shape_slopes(at)[0], miss), -1.5, 1.5)
        left = np.linalg.norm(point - shape_values(at)[0] @ corners)
        if np.abs(at).max() <= 1 + tolerance and left < tolerance:
            return int(brick), np.clip(at[0], -1.0, 1.0)
    raise ValueError(f"point {point} is in no brick; give a point inside the tissue, on the side x >= 0")


def strain_rows(mesh: Bricks, point: Array) -> tuple[sp.csr_matrix, int]:
    """Rows (6, 3n) giving the strains xx, yy, zz, yz, xz, xy (shears as tensor components) at `point`, and
    the layer there."""
    brick, at = locate(mesh, np.asarray(point, float))
    nodes, slopes = mesh.bricks[brick], shape_slopes(at[None])[0]
    gradient = slopes @ np.linalg.inv(mesh.nodes[nodes].T @ slopes)
    rows = np.zeros((6, 3 * len(mesh.nodes)))
    for row, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))):
        np.add.at(rows[row], 3 * nodes + i, 0.5 * gradient[:, j])
        np.add.at(rows[row], 3 * nodes + j, 0.5 * gradient[:, i])
    return sp.csr_matrix(rows), int(mesh.layer[brick])


def strain_energy_density(strain: Array, modulus: float, poisson: float) -> Array:
    """Strain energy per volume, MPa, of tensor strains (6, ...) ordered as in `strain_rows`."""
    first, second = lame(np.asarray(modulus), poisson)
    squares = (strain[:3] ** 2).sum(0) + 2.0 * (strain[3:] ** 2).sum(0)
    return 0.5 * first * strain[:3].sum(0) ** 2 + second * squares
