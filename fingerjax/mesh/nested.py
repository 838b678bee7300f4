"""Nested shells: the surfaces of all layers filled with tetrahedra in one call of pytetwild (fTetWild, Hu et al. 2020).

For fingers that columns cannot follow, and as a check on those: elements are of even shape, and a layer may have
several through its thickness, but surfaces are met to within an envelope only. What has been learnt of it:

- Closed shells handed over together come out conforming where they meet; no label comes back, so an element
  belongs to the layer that its centroid lies in.
- Its own removal of what lies outside leaks through the plane in which all shells end, so nothing is removed
  there and what lies outside the skin is culled here.
- The envelope is relative to the diagonal of the bounding box, and at most a quarter of the thinnest layer.
- It is not deterministic, not even with one thread.

Vertices of a layer's surface are then put onto the true one, midsides of the skin and of the interfaces too,
as far as no element turns inside out.
"""

from __future__ import annotations

import contextlib
import tempfile
import time

import numpy as np

from fingerjax.errors import InputError
from fingerjax.finger import Finger
from fingerjax.geometry.sections import LayeredSolid
from fingerjax.layers import BONE, LAYERS
from fingerjax.mesh.contour import nail_nodes
from fingerjax.mesh.files import checksum
from fingerjax.mesh.jacobian import relaxed
from fingerjax.mesh.quality import figures
from fingerjax.mesh.refine import Focus, allowed_edge
from fingerjax.mesh.surface import OVERSHOOT, Resolution, background_box, edge_length, grid_triangles
from fingerjax.mesh.topology import EDGES, boundary, faces, oriented, quadratic, quadratic_triangles, signed_volumes

SHARE_OF_LAYER = 0.25  # envelope over the thinnest layer
STOP_ENERGY = 10.0  # where pytetwild ends its optimisation: AMIPS energy, 3 for a regular element


def nested(solid: LayeredSolid, resolution: Resolution, focus: tuple[Focus, ...] = (), key: str = "") -> Finger:
    """The labelled mesh of a layered solid from its nested surfaces. **Raises** `InputError` where a layer is lost in the envelope."""
    started = time.perf_counter()
    envelope = _envelope(solid, resolution)
    vertices, tets = _filled(solid, resolution, focus, envelope)
    vertices, tets, layer = _labelled(solid, vertices, tets, envelope)
    on = _surfaces(tets, layer, vertices)
    vertices, settled = _settled(solid, vertices, tets, on)
    straight, elements, pairs = quadratic(vertices, tets)
    nodes, bent = _bent(solid, straight, tets, layer, pairs, len(vertices))
    nodes, straightened = relaxed(nodes, elements, len(vertices))
    skin = quadratic_triangles(_outer(tets, vertices), pairs, len(vertices))
    bone = np.zeros(len(nodes), bool)
    bone[elements[layer == BONE]] = True
    quality = figures(nodes, elements, layer, solid) | {
        "envelope_mm": envelope,
        "straddling": straddling(solid, vertices, tets, layer),
        "off_surface": len(on) - settled,
        "bent": bent,
        "straightened": straightened,
        "mesh_hash": checksum({"n": nodes, "t": elements})[:20],
        "seconds": time.perf_counter() - started,
    }
    return Finger(
        name=solid.name,
        nodes=nodes,
        tets=elements.astype(np.int64),
        layer=layer,
        skin=skin.astype(np.int64),
        nail=nail_nodes(solid, nodes, skin),
        bone=bone,
        proximal=nodes[:, 2] == 0.0,
        key=key,
        quality=quality,
    )


def _envelope(solid: LayeredSolid, resolution: Resolution) -> float:
    """mm: a quarter of the thinnest soft layer at the centre of the pad, and not above what the pad's own spacing asks for."""
    z, theta = np.array([solid.pad_centre]), np.array([1.5 * np.pi])
    radii = np.array([solid.radius(layer, z, theta)[0] for layer in range(len(LAYERS))])
    thin = -np.diff(radii)
    thin = thin[thin > 1e-6]
    if not len(thin):
        raise InputError("no layer has a thickness at the centre of the pad", place=f"z = {z[0]:.2f} mm", remedy="check the radii")
    return float(min(SHARE_OF_LAYER * thin.min(), 0.5 * resolution.pad))


def layer_surface(solid: LayeredSolid, layer: int, spacing: float) -> tuple[np.ndarray, np.ndarray] | None:
    """The closed surface of everything from a layer inwards, with its cap at z = 0; None where the layer is nowhere."""
    z = np.linspace(0.0, solid.length, 1601)
    turns = max(32, int(np.ceil(2 * np.pi * solid.largest_radius / spacing)))
    theta = 2 * np.pi * np.arange(turns) / turns
    there = solid.radius(layer, z[:, None], theta[None, ::4]).min(axis=1) > 0
    if not there[0]:
        return None
    end = float(z[np.flatnonzero(~there)[0]]) if (~there).any() else solid.length
    rings = max(16, int(np.ceil(end / spacing)))
    u = np.linspace(0.0, 1.0, rings + 1)
    z = (end * (1.0 - (1.0 - u) ** 1.5))[:-1]
    side = solid.surface(z[:, None], theta[None, :], layer)
    centre = solid.centre(np.array([0.0, end]))
    caps = np.array([[*centre[0], 0.0], [*centre[1], end]])
    return np.concatenate([side.reshape(-1, 3), caps]), grid_triangles(len(z), len(theta))


def _filled(solid: LayeredSolid, resolution: Resolution, focus: tuple[Focus, ...], envelope: float) -> tuple[np.ndarray, np.ndarray]:
    """Everything in a box around the shells, as pytetwild leaves it."""
    import pytetwild

    shells = [shell for layer in range(len(LAYERS)) if (shell := layer_surface(solid, layer, 0.6 * resolution.pad)) is not None]
    offsets = np.cumsum([0, *(len(points) for points, _ in shells[:-1])])
    points = np.concatenate([points for points, _ in shells])
    triangles = np.concatenate([faces + offset for (_, faces), offset in zip(shells, offsets, strict=True)])
    box, box_tets = background_box(solid, resolution)
    wanted = edge_length(solid, resolution, box)
    if focus:
        wanted = np.minimum(wanted, allowed_edge(solid, focus, box))
    with tempfile.TemporaryDirectory() as scratch, contextlib.chdir(scratch):
        vertices, tets = pytetwild.tetrahedralize(
            points,
            triangles.astype(np.int32),
            edge_length_abs=2.0 * resolution.coarsest,
            epsilon=envelope / float(np.linalg.norm(np.ptp(points, axis=0))),
            stop_energy=STOP_ENERGY,
            optimize=True,
            disable_filtering=True,
            vtk_ordering=True,
            quiet=True,
            bg_vertices=box,
            bg_tets=box_tets,
            bg_values=OVERSHOOT * wanted,
        )
    return np.asarray(vertices, float), np.asarray(tets, np.int64)


def _labelled(
    solid: LayeredSolid, vertices: np.ndarray, tets: np.ndarray, envelope: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What lies inside the skin, oriented, its cut in the plane z = 0, with the layer of every element."""
    near = np.abs(vertices[:, 2]) < 1.5 * envelope
    vertices = vertices.copy()
    vertices[near, 2] = 0.0
    tets = oriented(vertices, tets)
    centroid = vertices[tets].mean(axis=1)
    layer = solid.layer_of(centroid)
    size = np.ptp(vertices[tets], axis=1).max(axis=1)
    kept = (layer >= 0) & (centroid[:, 2] > 0) & (signed_volumes(vertices, tets) > 1e-6 * size**3)
    kept &= _attached(tets, kept)
    lost = [name for number, name in enumerate(LAYERS) if solid.volume(number) > 0 and not (layer[kept] == number).any()]
    if lost:
        seen = f"envelope {envelope:.3g} mm"
        raise InputError("a layer is thinner than the mesh can show", place=lost[0], seen=seen, remedy="ask for a finer mesh")
    used, number = np.unique(tets[kept], return_inverse=True)
    return vertices[used], number.reshape(-1, 4), layer[kept].astype(np.int64)


def _attached(tets: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Which elements hang together with the largest piece of those kept, through faces."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    index = np.flatnonzero(kept)
    every, owner, shared = faces(tets[index])
    order = np.lexsort(np.sort(every, axis=1).T)
    twice = order[shared[order] == 2].reshape(-1, 2)
    graph = coo_matrix((np.ones(len(twice)), (owner[twice[:, 0]], owner[twice[:, 1]])), shape=(len(index), len(index)))
    _, piece = connected_components(graph, directed=False)
    out = np.zeros(len(tets), bool)
    out[index[piece == np.argmax(np.bincount(piece))]] = True
    return out


def _outer(tets: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Boundary triangles that are not the cut."""
    outer = boundary(tets)
    return outer[~(vertices[outer][:, :, 2] == 0.0).all(axis=1)]


def _interfaces(tets: np.ndarray, layer: np.ndarray) -> dict[int, np.ndarray]:
    """Triangles `(f, 3)` between layers: the outer surface of each inner one."""
    every, owner, shared = faces(tets)
    twice = np.flatnonzero(shared == 2)
    code = np.sort(every[twice], axis=1)
    order = np.lexsort(code.T)
    pair = twice[order].reshape(-1, 2)
    one, other = layer[owner[pair[:, 0]]], layer[owner[pair[:, 1]]]
    inner = np.maximum(one, other)
    return {number: every[pair[(one != other) & (inner == number), 0]] for number in range(1, len(LAYERS))}


def _surfaces(tets: np.ndarray, layer: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """`(k, 2)`: vertex and the layer whose surface it lies on; the outermost where surfaces meet."""
    on = np.full(len(vertices), -1)
    for number, triangles in sorted(_interfaces(tets, layer).items(), reverse=True):
        on[triangles] = number
    on[_outer(tets, vertices)] = 0
    where = np.flatnonzero(on >= 0)
    return np.stack([where, on[where]], axis=1)


def _projected(solid: LayeredSolid, layer: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points moved along the gradient of their layer's level set until they lie on it; those in the cut stay in it."""
    moved = points.copy()
    flat = points[:, 2] == 0.0
    step = 1e-5
    for number in np.unique(layer):
        mine = np.flatnonzero(layer == number)
        for _ in range(6):
            value = solid.level(int(number), moved[mine])
            slope = np.stack([(solid.level(int(number), moved[mine] + step * axis) - value) / step for axis in np.eye(3)], axis=1)
            slope[flat[mine], 2] = 0.0
            moved[mine] -= (value / np.maximum((slope**2).sum(axis=1), 1e-3))[:, None] * slope
            moved[mine, 2] = np.clip(moved[mine, 2], 0.0, solid.length)
    return moved


def _settled(solid: LayeredSolid, vertices: np.ndarray, tets: np.ndarray, on: np.ndarray) -> tuple[np.ndarray, int]:
    """Vertices on their true surfaces, as far as every element keeps a third of its volume; and how many are."""
    which, layer = on.T
    target = _projected(solid, layer, vertices[which])
    least = 0.3 * signed_volumes(vertices, tets)
    edge = np.linalg.norm(np.diff(vertices[tets[:, EDGES]], axis=2)[:, :, 0], axis=2).min(axis=1)
    reach = np.full(len(vertices), np.inf)
    np.minimum.at(reach, tets.ravel(), np.repeat(edge, 4))
    share = np.where(np.linalg.norm(target - vertices[which], axis=1) < 0.5 * reach[which], 1.0, 0.0)
    moved = vertices.copy()
    for _ in range(12):
        moved[which] = vertices[which] + share[:, None] * (target - vertices[which])
        bad = signed_volumes(moved, tets) < least
        if not bad.any():
            break
        touched = np.zeros(len(vertices), bool)
        touched[tets[bad]] = True
        share = np.where(touched[which], np.where(share > 0.2, 0.5 * share, 0.0), share)
    return moved, int(np.sum(share == 1.0))


def _bent(
    solid: LayeredSolid, nodes: np.ndarray, tets: np.ndarray, layer: np.ndarray, pairs: np.ndarray, count: int
) -> tuple[np.ndarray, int]:
    """Midsides of surface edges on the true surfaces; and how many were moved."""
    code = pairs[:, 0] * np.int64(count) + pairs[:, 1]
    surfaces = {**_interfaces(tets, layer), 0: _outer(tets, nodes)}
    out, moved = nodes.copy(), 0
    for number, triangles in sorted(surfaces.items(), reverse=True):
        if not len(triangles):
            continue
        sides = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
        at = count + np.searchsorted(code, sides[:, 0] * np.int64(count) + sides[:, 1])
        ends = nodes[sides]
        level = np.abs(solid.level(number, ends.reshape(-1, 3))).reshape(-1, 2)
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        at = at[(level < 1e-6).all(axis=1)]
        straight = nodes[at]
        target = _projected(solid, np.full(len(at), number), straight)
        near = np.linalg.norm(target - straight, axis=1) < 0.25 * length[(level < 1e-6).all(axis=1)]
        out[at[near]] = target[near]
        moved += int(near.sum())
    return out, moved


def straddling(solid: LayeredSolid, vertices: np.ndarray, tets: np.ndarray, layer: np.ndarray, share: float = 0.1) -> float:
    """Part of the elements that reach over the surface of a layer by more than `share` of the local layer's thickness.

    A corner reaches over where it lies deeper inside another layer, along the section's radius, than that share of the thickness of
    the layer it lies in or of its element's own, whichever is less. Layers of no thickness there are passed over.
    """
    x, y = (vertices[:, :2] - solid.centre(vertices[:, 2])).T
    theta, r = np.arctan2(y, x), np.hypot(x, y)
    radii = np.stack([solid.radius(number, vertices[:, 2], theta) for number in range(len(LAYERS))], axis=1)
    inner = np.concatenate([radii[:, 1:], np.zeros((len(radii), 1))], axis=1)
    thick = radii - inner  # (n, 5)
    corner = tets
    mine = layer[:, None]
    outwards = r[corner] - np.take_along_axis(radii[corner], mine[:, :, None], axis=2)[..., 0]
    inwards = np.take_along_axis(inner[corner], mine[:, :, None], axis=2)[..., 0] - r[corner]
    own = np.take_along_axis(thick[corner], mine[:, :, None], axis=2)[..., 0]
    own = np.where(own > 1e-6, own, np.inf)
    return float(np.mean((np.maximum(outwards, inwards) > share * own).any(axis=1)))
