"""The stiffness as a sparse matrix on the host, for direct factorisation and for the coarse levels of multigrid."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from .body import Body


def element_matrices(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Element stiffness (e, 3a, 3a) per unit of Lame's first parameter and per unit of shear modulus, mm."""
    inverse = np.broadcast_to(np.asarray(body.inverse), (*body.weight.shape, 3, 3))
    slope = np.einsum("qak,eqkj->eqaj", np.asarray(body.slopes), inverse, optimize=True)
    outer = np.einsum("eq,eqai,eqbj->eaibj", np.asarray(body.weight), slope, slope, optimize=True)
    square = np.einsum("eaibi->eab", outer)[:, :, None, :, None] * np.eye(3)[None, None, :, None, :]
    size = outer.shape[1] * 3
    shear = np.swapaxes(outer, 2, 4) + square
    return outer.reshape(-1, size, size), shear.reshape(-1, size, size)


class Assembled:
    """Sparse stiffness between free degrees of freedom, refilled for other moduli without looking at the pattern again.

    `upper` keeps the upper triangle alone, as a symmetric factorisation wants it.
    """

    def __init__(self, body: Body, *, upper: bool):
        tets = np.asarray(body.tets)
        dofs = (3 * tets[:, :, None] + np.arange(3)).reshape(len(tets), -1)
        self.free = np.flatnonzero(np.repeat(np.asarray(body.free) > 0, 3))
        number = np.full(3 * len(body.free), -1)
        number[self.free] = np.arange(len(self.free))
        local = number[dofs]
        row = np.repeat(local, local.shape[1], axis=1).ravel()
        column = np.tile(local, local.shape[1]).ravel()
        keep = (row >= 0) & (column >= row) if upper else (row >= 0) & (column >= 0)
        self._keep = np.flatnonzero(keep)
        key = row[self._keep] * len(self.free) + column[self._keep]
        unique, self._slot = np.unique(key, return_inverse=True)
        self._indices = (unique % len(self.free)).astype(np.int32)
        counts = np.bincount(unique // len(self.free), minlength=len(self.free))
        self._indptr = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        self._volumetric, self._shear = element_matrices(body)
        self._layer = np.asarray(body.layer)

    def matrix(self, lame: np.ndarray) -> sp.csr_matrix:
        """The stiffness, N/mm, for Lame parameters (2, layers), MPa."""
        lam, mu = np.asarray(lame)[:, self._layer, None, None]
        values = (lam * self._volumetric + mu * self._shear).ravel()[self._keep]
        data = np.bincount(self._slot, weights=values, minlength=len(self._indices))
        return sp.csr_matrix((data, self._indices, self._indptr), shape=(len(self.free),) * 2)

    def part(self, layer: int, modulus: int) -> sp.csr_matrix:
        """The stiffness per unit of one Lame parameter (0 first, 1 shear) of one layer."""
        lame = np.zeros((2, int(self._layer.max()) + 1))
        lame[modulus, layer] = 1.0
        return self.matrix(lame)
