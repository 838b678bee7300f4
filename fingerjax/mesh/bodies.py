"""Test bodies with known answers, meshed without any meshing library: a block and a spherical shell.

Use `block` for patch tests, half-space contact and layered slabs; `sphere_shell` for pressure and curvature.
"""

from __future__ import annotations

import hashlib

import numpy as np

from fingerjax.finger import Finger
from fingerjax.mesh.topology import boundary, kuhn_tets, oriented, prism_tets, quadratic, quadratic_triangles


def _spread(count: int, grading: float) -> np.ndarray:
    """`count + 1` numbers from -1 to 1, crowded about 0 when `grading` exceeds 1."""
    u = np.linspace(-1.0, 1.0, count + 1)
    return np.sign(u) * np.abs(u) ** grading


def _finish(
    name: str, vertices: np.ndarray, tets: np.ndarray, midpoint: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, str]:
    """Nodes, quadratic elements, edges and key of a test body."""
    nodes, elements, pairs = quadratic(vertices, tets, midpoint)
    digest = hashlib.sha256(name.encode() + nodes.tobytes() + elements.tobytes()).hexdigest()
    return nodes, elements, pairs, digest[:20]


def block(
    size: tuple[float, float, float] = (2.0, 1.0, 2.0),
    divisions: tuple[int, int, int] = (4, 3, 4),
    grading: float | None = None,
    interfaces: tuple[float, ...] = (),
) -> Finger:
    """A rectangular block: skin on its face y = 0 (looking towards -y), held on its face y = size[1].

    **Arguments:**

    - `size`: lengths along x, y, z in mm. x runs about 0, y from 0, z from 0.
    - `divisions`: cells along x, y, z; each becomes six tetrahedra.
    - `grading`: power that crowds cells towards the middle of the skin; None is uniform.
    - `interfaces`: depths below the skin, mm, where the next layer begins; layer 0 everywhere when empty.
        Put them on cell boundaries: an element belongs to the layer of its centroid.

    The held face is marked in `bone`, so `without_bone` leaves everything in place. Nothing is nail.
    """
    a, b, c = size
    power = 1.0 if grading is None else float(grading)
    x = 0.5 * a * _spread(divisions[0], power)
    y = b * np.linspace(0.0, 1.0, divisions[1] + 1) ** power
    z = 0.5 * c * (1.0 + _spread(divisions[2], power))
    vertices = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    tets = oriented(vertices, kuhn_tets(divisions))
    nodes, elements, pairs, key = _finish(f"block{size}{divisions}{grading}{interfaces}", vertices, tets)
    surface = boundary(tets)
    surface = surface[(vertices[surface][:, :, 1] < 1e-9 * b).all(axis=1)]
    depth = vertices[tets][:, :, 1].mean(axis=1)
    return Finger(
        name="block",
        nodes=nodes,
        tets=elements,
        layer=np.searchsorted(np.asarray(interfaces, float), depth).astype(np.int64),
        skin=quadratic_triangles(surface, pairs, len(vertices)),
        nail=np.zeros(len(nodes), bool),
        bone=nodes[:, 1] > b * (1.0 - 1e-9),
        proximal=nodes[:, 2] < 1e-9 * c,
        key=key,
        quality={"nodes": len(nodes), "tets": len(elements)},
    )


def _icosphere(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of a unit sphere and outward triangles: an icosahedron, each face cut `n` times into four."""
    import pyvista

    sphere = pyvista.Icosphere(radius=1.0, nsub=n)
    points, faces = np.array(sphere.points, float), np.array(sphere.faces, np.int64).reshape(-1, 4)[:, 1:]
    outward = np.einsum("fi,fi->f", np.cross(points[faces[:, 1]], points[faces[:, 2]]), points[faces[:, 0]]) > 0
    faces[~outward] = faces[~outward][:, ::-1]
    return points / np.linalg.norm(points, axis=1, keepdims=True), faces


def sphere_shell(inner: float = 1.0, outer: float = 2.0, n: int = 2, shells: int = 4) -> Finger:
    """A hollow sphere about the origin: skin outside, held (`bone`) on the inner surface.

    **Arguments:**

    - `inner`, `outer`: radii in mm.
    - `n`: times each face of an icosahedron is cut into four.
    - `shells`: elements through the thickness.

    Midsides lie on their spheres, so the surfaces are curved. Nothing is nail, nothing is proximal.
    """
    points, triangles = _icosphere(n)
    radii = np.linspace(inner, outer, shells + 1)
    vertices = (radii[:, None, None] * points).reshape(-1, 3)
    size = len(points)
    tets = np.concatenate(
        [prism_tets(triangles + s * size, triangles + (s + 1) * size) for s in range(shells)]
    )
    tets = oriented(vertices, tets)
    _, _, pairs = quadratic(vertices, tets)
    straight = vertices[pairs].mean(axis=1)
    radius = np.linalg.norm(vertices, axis=1)[pairs].mean(axis=1)
    curved = straight * (radius / np.linalg.norm(straight, axis=1))[:, None]
    nodes, elements, pairs, key = _finish(f"sphere{inner},{outer},{n},{shells}", vertices, tets, curved)
    distance = np.linalg.norm(nodes, axis=1)
    return Finger(
        name="sphere shell",
        nodes=nodes,
        tets=elements,
        layer=np.zeros(len(elements), np.int64),
        skin=quadratic_triangles(triangles + shells * size, pairs, len(vertices)),
        nail=np.zeros(len(nodes), bool),
        bone=distance < inner * (1.0 + 1e-9),
        proximal=np.zeros(len(nodes), bool),
        key=key,
        quality={"nodes": len(nodes), "tets": len(elements)},
    )
