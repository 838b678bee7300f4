"""A sparse Cholesky factorisation, analysed once for a pattern, and able to leave some unknowns to the end.

    K = [[A, B'], [B, D]]    ->    S = D - B A^-1 B'

The Schur complement S of the unknowns that are kept is the stiffness of the body as felt at them, and falls out of the same
factorisation that afterwards answers any load. MKL PARDISO does it where that is installed, `Frontal` everywhere.
"""

from __future__ import annotations

import abc

import numpy as np


class Indefinite(ValueError):
    """A matrix that should have been positive definite is not."""

    def __init__(self) -> None:
        super().__init__("the stiffness is not positive definite: something is not held, or an element is inverted")


class AbstractCholesky(abc.ABC):
    """Factorisations of symmetric positive definite matrices (n, n) of one sparsity.

    **Arguments:**

    - `indptr`, `indices`: of the upper triangle, by rows, with sorted indices and every diagonal entry.
    - `kept`: (n,) bool, unknowns whose Schur complement is wanted; None where none is.
    """

    @abc.abstractmethod
    def __init__(self, indptr: np.ndarray, indices: np.ndarray, kept: np.ndarray | None = None): ...

    @abc.abstractmethod
    def factor(self, data: np.ndarray) -> np.ndarray:
        """Factorise the matrix with these entries, and return the Schur complement (kept, kept) of the kept unknowns, in their order.

        Raises `Indefinite` where the matrix is not positive definite.
        """

    @abc.abstractmethod
    def solve(self, right: np.ndarray) -> np.ndarray:
        """The unknowns (n, m) under loads (n, m), with the last matrix that was factorised."""

    @property
    @abc.abstractmethod
    def memory(self) -> int:
        """Bytes that the last factorisation holds."""
