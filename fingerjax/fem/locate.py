"""Which element of a body a point lies in, and where in it."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import numpy as np

from . import element

SAG = 0.1  # mm that a face may bulge beyond its straight edges
INSIDE = 1e-6  # barycentric slack for a point on a face


class Locator:
    """Finds points among the elements of a mesh: `nodes` (n, 3) mm, `tets` (e, 4 or 10)."""

    def __init__(self, nodes: np.ndarray, tets: np.ndarray):
        self.nodes, self.tets = nodes, tets
        self.order = 1 if tets.shape[1] == 4 else 2
        corners = nodes[tets[:, :4]]
        self._first = corners[:, 0]
        self._inverse = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))

    def __call__(self, point: np.ndarray) -> tuple[int, np.ndarray]:
        """The element that holds `point` (3,), mm, and the point's reference coordinates in it.

        Candidates come from the straight tetrahedra on the corners, nearest first; Newton's method then undoes the curved map.
        Raises ValueError where the point lies in no element.
        """
        for candidate, local in self._candidates(point):
            if element.barycentric(local[None]).min() >= -INSIDE:
                return candidate, local
        place = np.round(point, 3).tolist()
        raise ValueError(f"the point {place} mm lies outside the meshed tissue; check the receptor's depth and site")

    def within(self, point: np.ndarray, distance: float, among: np.ndarray) -> list[int]:
        """Elements of those marked in `among` (e,) none of whose faces' planes leaves a point (3,) more than `distance`, mm, outside."""
        found = []
        for candidate in np.flatnonzero(among & (self._outside(point) <= SAG)):
            reference = self._inverse[candidate] @ (point - self._first[candidate])
            local = _undo_map(self.nodes[self.tets[candidate]], self.order, point, reference)
            if (-element.barycentric(local[None])[0] / self._steepness[candidate]).max() <= distance:
                found.append(int(candidate))
        return found

    @cached_property
    def _steepness(self) -> np.ndarray:
        """How fast the barycentric coordinates change, (e, 4) 1/mm."""
        return np.linalg.norm(element.CORNER_SLOPES @ self._inverse, axis=2)

    def _outside(self, point: np.ndarray) -> np.ndarray:
        """By how much the point lies beyond the worst face of each element with straight edges, (e,) mm."""
        reference = np.einsum("eij,ej->ei", self._inverse, point - self._first)
        return (-element.barycentric(reference) / self._steepness).max(axis=1)

    def _candidates(self, point: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Elements by how far inside their straight corners the point lies, with its place in each."""
        reference = np.einsum("eij,ej->ei", self._inverse, point - self._first)
        worst = element.barycentric(reference).min(axis=1)
        for candidate in np.argsort(-worst)[:24]:
            yield int(candidate), _undo_map(self.nodes[self.tets[candidate]], self.order, point, reference[candidate])


def _undo_map(nodes: np.ndarray, order: int, point: np.ndarray, local: np.ndarray) -> np.ndarray:
    for _ in range(20):
        values, slopes = element.shape(local[None], order)[0], element.slopes(local[None], order)[0]
        step = np.linalg.solve(nodes.T @ slopes, point - values @ nodes)
        local = local + step
        if np.abs(step).max() < 1e-13:
            break
    return local
