"""Rows in units of their noise: L^-1 with L L' = Sigma, and the part of a column that no base parameter can imitate.

r = L^-1 (y - f),   Q = I - J J^+
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_triangular

UNSEEN = 1e-9  # singular value of the column-normalised Jacobian, relative to the largest, that counts as nothing


@dataclass(frozen=True, eq=False)
class Whitener:
    """The Cholesky factor L (rows, rows) of a covariance."""

    factor: Float[np.ndarray, "rows rows"]

    @classmethod
    def of(cls, covariance: Float[np.ndarray, "rows rows"]) -> Whitener:
        """**Raises** `numpy.linalg.LinAlgError` where the covariance is not positive definite."""
        size = np.sqrt(np.diag(covariance))
        with np.errstate(divide="ignore", invalid="ignore"):
            return cls(size[:, None] * np.linalg.cholesky(covariance / np.outer(size, size)))

    def __call__(self, columns: Float[np.ndarray, "rows *columns"]) -> Float[np.ndarray, "rows *columns"]:
        """L^-1 columns."""
        return solve_triangular(self.factor, columns, lower=True, check_finite=False)

    def back(self, columns: Float[np.ndarray, "rows *columns"]) -> Float[np.ndarray, "rows *columns"]:
        """L columns."""
        return self.factor @ columns


@dataclass(frozen=True, eq=False)
class Projection:
    """What the base parameters can imitate.

    - `basis` (rows, rank): orthonormal columns that span J.
    - `inverse` (p, rows): J^+, by which a change of the data becomes one of the parameters.
    """

    basis: Float[np.ndarray, "rows rank"]
    inverse: Float[np.ndarray, "p rows"]

    @classmethod
    def of(cls, jacobian: Float[np.ndarray, "rows p"]) -> Projection:
        lengths = np.linalg.norm(jacobian, axis=0)
        scale = np.where(lengths > 0, lengths, 1.0)
        left, singular, right = np.linalg.svd(jacobian / scale, full_matrices=False)
        seen = singular > UNSEEN * np.max(singular, initial=0.0)
        basis = left[:, seen]
        return cls(basis, (right[seen].T / singular[seen] / scale[:, None]) @ basis.T)

    def __call__(self, columns: Float[np.ndarray, "rows *columns"]) -> Float[np.ndarray, "rows *columns"]:
        """Q columns. Twice, so that nothing of J is left of what lay almost wholly in it."""
        once = columns - self.basis @ (self.basis.T @ columns)
        return once - self.basis @ (self.basis.T @ once)

    @property
    def rank(self) -> int:
        return self.basis.shape[1]

    def covariance(self) -> Float[np.ndarray, "p p"]:
        """(J'J)^-1 on what is seen."""
        return self.inverse @ self.inverse.T
