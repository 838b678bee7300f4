"""Which element of a body a point lies in, and where in it."""

from __future__ import annotations

import numpy as np

from . import element
from .body import Body

INSIDE = 1e-6  # barycentric slack for a point on a face


def locate(body: Body, point: np.ndarray) -> tuple[int, np.ndarray]:
    """The element that holds `point` (3,), mm, and the point's reference coordinates in it.

    Candidates come from the straight tetrahedra on the corners, nearest first; Newton's method then undoes the curved map.
    Raises ValueError where the point lies in no element.
    """
    tets, nodes = np.asarray(body.tets), np.asarray(body.nodes)
    corners = nodes[tets[:, :4]]
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    reference = np.linalg.solve(edges, (point - corners[:, 0])[..., None])[..., 0]
    worst = element.barycentric(reference).min(axis=1)
    for candidate in np.argsort(-worst)[:24]:
        local = _undo_map(nodes[tets[candidate]], body.order, point, reference[candidate])
        if element.barycentric(local[None]).min() >= -INSIDE:
            return int(candidate), local
    raise ValueError(f"the point {np.round(point, 3).tolist()} mm lies outside the meshed tissue; check the receptor's depth and site")


def _undo_map(nodes: np.ndarray, order: int, point: np.ndarray, local: np.ndarray) -> np.ndarray:
    for _ in range(20):
        values, slopes = element.shape(local[None], order)[0], element.slopes(local[None], order)[0]
        step = np.linalg.solve(nodes.T @ slopes, point - values @ nodes)
        local = local + step
        if np.abs(step).max() < 1e-13:
            break
    return local
