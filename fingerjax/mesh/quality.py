"""How good a mesh is: shapes of elements, counts, and layer volumes against the solid they stand for."""

from __future__ import annotations

from typing import Any

import numpy as np

from fingerjax.layers import LAYERS
from fingerjax.mesh.jacobian import determinants, volumes
from fingerjax.mesh.topology import EDGES, FACES, signed_volumes

QUANTILES = {"min": 0.0, "p1": 0.01, "median": 0.5}


def dihedral_angles(vertices: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """Six angles between faces of each straight tetrahedron, `(e, 6)` deg."""
    a, b, c = (vertices[tets[:, FACES[:, i]]] for i in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    i, j = EDGES.T
    return np.degrees(np.arccos(np.clip(-np.einsum("epi,epi->ep", normal[:, i], normal[:, j]), -1.0, 1.0)))


def radius_ratios(vertices: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """Three times inscribed over circumscribed radius, `(e,)`: 1 for the regular one, 0 for a flat one."""
    volume = np.abs(signed_volumes(vertices, tets))
    a, b, c = (vertices[tets[:, FACES[:, i]]] for i in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum(axis=1)
    side = np.linalg.norm(vertices[tets[:, EDGES[:, 0]]] - vertices[tets[:, EDGES[:, 1]]], axis=-1)
    # Products of opposite edges are the sides of a triangle of area 6 V R (Crelle).
    p, q, r = side[:, 0] * side[:, 5], side[:, 1] * side[:, 3], side[:, 2] * side[:, 4]
    product = np.maximum((p + q + r) * (-p + q + r) * (p - q + r) * (p + q - r), 0.0)
    return 216.0 * volume**2 / np.maximum(area * np.sqrt(product), 1e-300)


def figures(nodes: np.ndarray, tets: np.ndarray, layer: np.ndarray, solid: Any = None) -> dict[str, Any]:
    """Figures of a mesh of ten-node elements: counts, angles, radius ratios, volumes per layer (mm^3) and,
    where the solid
    is given, their relative error.
    """
    corners = tets[:, :4]
    angles, ratios = dihedral_angles(nodes, corners), radius_ratios(nodes, corners)
    determinant = determinants(nodes, tets)
    size = volumes(nodes, tets)
    out: dict[str, Any] = {
        "nodes": len(nodes),
        "vertices": len(np.unique(corners)),
        "tets": len(tets),
        "min_dihedral_deg": float(angles.min()),
        "p1_dihedral_deg": float(np.quantile(angles.min(axis=1), 0.01)),
        "radius_ratio": {name: float(np.quantile(ratios, q)) for name, q in QUANTILES.items()},
        "min_jacobian_ratio": float((determinant.min(axis=1) / determinant.max(axis=1)).min()),
        "volume_mm3": {name: float(size[layer == k].sum()) for k, name in enumerate(LAYERS)},
        "tets_in": {name: int(np.sum(layer == k)) for k, name in enumerate(LAYERS)},
    }
    if solid is not None:
        out["volume_error"] = {
            name: out["volume_mm3"][name] / true - 1.0
            for k, name in enumerate(LAYERS)
            if (true := solid.volume(k)) > 0
        }
    return out


def table(quality: dict[str, Any]) -> str:
    """The figures as lines of text, name and value."""
    lines = []
    for name, value in quality.items():
        if isinstance(value, dict):
            lines += [f"{name + ' ' + part:32s} {_text(number)}" for part, number in value.items()]
        else:
            lines.append(f"{name:32s} {_text(value)}")
    return "\n".join(lines)


def _text(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)
