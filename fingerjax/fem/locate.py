"""Which element of a body a point lies in, and where in it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from . import element

NEAREST = 24  # elements that are tried
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
        for candidate, local in self._candidates(point, among):
            ways = element.CORNER_SLOPES @ self._inverse[candidate]  # of the four barycentric coordinates, 1/mm
            outside = -element.barycentric(local[None])[0] / np.linalg.norm(ways, axis=1)
            if outside.max() <= distance:
                found.append(candidate)
        return found

    def _candidates(self, point: np.ndarray, among: np.ndarray | None = None) -> Iterator[tuple[int, np.ndarray]]:
        """Elements by how far inside their straight corners the point lies, with its place in each."""
        reference = np.einsum("eij,ej->ei", self._inverse, point - self._first)
        worst = element.barycentric(reference).min(axis=1)
        near = np.argsort(-worst)[:NEAREST]
        for candidate in near if among is None else near[among[near]]:
            yield int(candidate), _undo_map(self.nodes[self.tets[candidate]], self.order, point, reference[candidate])


def _undo_map(nodes: np.ndarray, order: int, point: np.ndarray, local: np.ndarray) -> np.ndarray:
    for _ in range(20):
        values, slopes = element.shape(local[None], order)[0], element.slopes(local[None], order)[0]
        step = np.linalg.solve(nodes.T @ slopes, point - values @ nodes)
        local = local + step
        if np.abs(step).max() < 1e-13:
            break
    return local
