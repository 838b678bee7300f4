"""An elastic half-space under a regular lattice of quadratic triangles: its compliance without a mesh.

The half-space turns a pressure into the displacement with Fourier transform 2/(E* |k|) times it. So the
stiffness between quadratic shape functions of a periodic lattice is S_ij = sum_k E* |k|/2 N_i(k) conj N_j(k),
and the compliance its inverse, completed by what periodic images take away: the sum of 1/r over a square
lattice less its mean, 3.900265/L - 2.2584 r^2/L^3 (Bonsall & Maradudin 1977 for the first).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MADELUNG, CURVATURE = 3.900265, 9.033622 / 4


@dataclass(frozen=True)
class Skin:
    nodes: np.ndarray
    skin: np.ndarray


def lattice(elements: int, edge: float, lift=lambda x, z: 0.0 * x) -> Skin:
    """A square of elements x elements cells, each cut in two triangles, normals to -y, centre (0, 0)."""
    side = 2 * elements + 1
    i, j = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    x, z = ((i - elements) * edge / 2).ravel(), ((j - elements) * edge / 2).ravel()
    nodes = np.column_stack([x, lift(x, z), z])

    def at(a, b):
        return (a * side + b).ravel()

    a, b = np.meshgrid(np.arange(0, side - 1, 2), np.arange(0, side - 1, 2), indexing="ij")
    one = [at(a, b), at(a + 2, b), at(a + 2, b + 2), at(a + 1, b), at(a + 2, b + 1), at(a + 1, b + 1)]
    two = [at(a, b), at(a + 2, b + 2), at(a, b + 2), at(a + 1, b + 1), at(a + 1, b + 2), at(a, b + 1)]
    return Skin(nodes, np.concatenate([np.stack(one, 1), np.stack(two, 1)]))


def compliance(
    skin: Skin, nodes: np.ndarray, edge: float, modulus: float, periods: int = 24, fine: int = 8
) -> np.ndarray:
    """Compliance (p, p) in mm/N of the half-space with E/(1 - nu^2) = `modulus` in MPa between `nodes`."""
    kinds = [(0, 0), (1, 0), (0, 1), (1, 1)]  # positions of vertex and midsides in a cell, in half edges
    count, size = 2 * fine * periods, periods * edge
    hat = [np.fft.fft2(_shape(kind, count, fine)) / count**2 for kind in kinds]
    k = 2 * np.pi / size * np.fft.fftfreq(count, 1 / count)
    symbol = modulus * np.hypot(k[:, None], k[None, :]) / 2 * size**2
    block = np.zeros((4, 4, periods, periods), complex)
    for a in range(4):
        for b in range(4):
            product = symbol * np.conj(hat[a]) * hat[b]
            block[a, b] = product.reshape(2 * fine, periods, 2 * fine, periods).sum((0, 2)) * periods**2
    weights = np.array([h[0, 0].real * size**2 for h in hat])  # int N of each kind
    inverse = np.zeros_like(block)
    for s in range(periods):
        for t in range(periods):
            m = block[:, :, s, t]
            if s == t == 0:
                keep = np.eye(4) - np.outer(np.ones(4), weights) / weights.sum()
                inverse[:, :, s, t] = keep @ np.linalg.pinv(m) @ keep.T
            else:
                inverse[:, :, s, t] = np.linalg.inv(m)
    influence = np.fft.ifft2(inverse).real  # response of kind a at cell shift to kind b, forces in N
    at = np.rint((skin.nodes[nodes][:, [0, 2]] - skin.nodes[0, [0, 2]]) / (edge / 2)).astype(int)
    kind = at[:, 0] % 2 + 2 * (at[:, 1] % 2)
    cell = at // 2
    shift = (cell[:, None] - cell[None, :]) % periods
    matrix = influence[kind[:, None], kind[None, :], shift[..., 0], shift[..., 1]]
    square = np.sum((at[:, None] - at[None, :]) ** 2, -1) * (edge / 2) ** 2
    matrix = matrix + (MADELUNG / size - CURVATURE * square / size**3) / (np.pi * modulus)
    return (matrix + matrix.T) / 2


def _shape(kind: tuple[int, int], count: int, fine: int) -> np.ndarray:
    """A quadratic shape function, its node at `kind` half edges, sampled `fine` times per half edge."""
    s = (np.arange(count) / fine + count // (2 * fine)) % (count // fine) - count // (2 * fine)
    u, v = np.meshgrid(s / 2, s / 2, indexing="ij")  # in cells, from the cell's own corner
    value = np.zeros_like(u)
    for i in (-1, 0):
        for j in (-1, 0):
            a, b = u - i, v - j  # inside cell (i, j)
            inside = (a >= 0) & (a < 1) & (b >= 0) & (b < 1)
            lower = inside & (a >= b)
            # lower triangle (0,0) (1,0) (1,1), barycentric 1-a, a-b, b; upper (0,0) (1,1) (0,1), barycentric
            # 1-b, a, b-a
            for where, bary in ((lower, (1 - a, a - b, b)), (inside & ~lower, (1 - b, a, b - a))):
                corners = [(0, 0), (1, 0), (1, 1)] if where is lower else [(0, 0), (1, 1), (0, 1)]
                value = np.where(where, _p2(kind, (2 * i, 2 * j), corners, bary), value)
    return value


def _p2(kind, origin, corners, bary):
    place = [(origin[0] + 2 * c[0], origin[1] + 2 * c[1]) for c in corners]
    for n in range(3):
        if place[n] == kind:
            return bary[n] * (2 * bary[n] - 1)
        m = (n + 1) % 3
        if ((place[n][0] + place[m][0]) / 2, (place[n][1] + place[m][1]) / 2) == kind:
            return 4 * bary[n] * bary[m]
    return np.zeros_like(bary[0])
