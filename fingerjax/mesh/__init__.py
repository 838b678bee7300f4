"""Meshes: tetrahedra that follow the layers of a solid, refined where an indenter needs it.

`build_finger` is the way in. `Resolution` says how fine the mesh is all over, `Focus` where it is finer;
`fingerjax.mesh.bodies` has test bodies that need no meshing library.
"""

from __future__ import annotations

import time

import numpy as np

from fingerjax.finger import Finger
from fingerjax.geometry.sections import LayeredSolid
from fingerjax.layers import BONE
from fingerjax.mesh.cache import Arrays, cache_dir, content_key, kept
from fingerjax.mesh.columns import Columns, Rays, columns
from fingerjax.mesh.files import arrays_of, checksum, finger_of
from fingerjax.mesh.jacobian import relaxed
from fingerjax.mesh.quality import figures
from fingerjax.mesh.refine import Focus, refine
from fingerjax.mesh.smooth import smoothed
from fingerjax.mesh.surface import Resolution, skin_triangles
from fingerjax.mesh.topology import edges, quadratic, quadratic_triangles

__all__ = ["Focus", "Resolution", "build_finger", "build_like", "cache_dir"]

DEFAULT = Resolution()
MESHER = "columns 1"  # part of every key: raise it when the same input would give another mesh
REFINER = "chords 1"  # the same for refined meshes alone


def build_finger(
    solid: LayeredSolid, resolution: Resolution = DEFAULT, focus: tuple[Focus, ...] = ()
) -> Finger:
    """The labelled mesh of a layered solid, kept in `cache_dir()` and built only once.

    All meshes of one solid and resolution share one triangulated skin, whatever their focus. Raises
    `InputError` where the solid cannot be meshed in columns.
    """
    base = content_key(MESHER, solid.digest, resolution)
    key = content_key(base, solid.name, *focus, *([REFINER] if focus else []))
    return finger_of(kept(key, lambda: arrays_of(_built(solid, resolution, focus, base, key))))


def build_like(solid: LayeredSolid, model: LayeredSolid, resolution: Resolution = DEFAULT) -> Finger:
    """The mesh of a solid on the skin triangles of another, `model`, carried over at equal theta and share of the length.

    Meshing the same solid twice can change a force by some per cent; two solids on one triangulation differ by their shapes alone.
    """
    key = content_key(MESHER, solid.digest, resolution, "like", model.digest)
    return finger_of(kept(key, lambda: arrays_of(_carried(solid, model, resolution, key))))


def _carried(solid: LayeredSolid, model: LayeredSolid, resolution: Resolution, key: str) -> Finger:
    started = time.perf_counter()
    stored = _skin(model, resolution, content_key(MESHER, model.digest, resolution))
    z = stored["points"][:, 2] * solid.length / model.length
    points = solid.surface(z, model.angle(stored["points"]))
    return finger_from_columns(columns(solid, points, stored["triangles"]), key, started)


def _skin(solid: LayeredSolid, resolution: Resolution, base: str) -> Arrays:
    """The triangulated skin of a solid, kept."""

    def skin() -> Arrays:
        points, triangles = smoothed(Rays(solid), *skin_triangles(solid, resolution))
        return {"points": points, "triangles": triangles}

    return kept(f"{base}-skin", skin)


def _built(
    solid: LayeredSolid, resolution: Resolution, focus: tuple[Focus, ...], base: str, key: str
) -> Finger:
    started = time.perf_counter()
    stored = _skin(solid, resolution, base)
    mesh = refine(columns(solid, stored["points"], stored["triangles"]), focus)
    return finger_from_columns(mesh, key, started)


def finger_from_columns(mesh: Columns, key: str, started: float | None = None) -> Finger:
    """A finger from a column mesh: midsides on the true interfaces, nail, bone and cut marked."""
    solid, count = mesh.rays.solid, len(mesh.vertices)
    pairs, _ = edges(mesh.tets, count)
    _, t, middle = mesh.midpoints(pairs)
    nodes, tets, _ = quadratic(mesh.vertices, mesh.tets, middle)
    nodes, straightened = relaxed(nodes, tets, count)
    depth = np.concatenate([mesh.t, t])
    skin = quadratic_triangles(mesh.skin, pairs, count)
    on_skin = np.zeros(len(nodes), bool)
    on_skin[skin] = True
    quality = figures(nodes, tets, mesh.layer, solid)
    quality |= {
        **mesh.notes,
        "straightened": straightened,
        "mesh_hash": checksum({"n": nodes, "t": tets})[:20],
    }
    if started is not None:
        quality["seconds"] = time.perf_counter() - started
    return Finger(
        name=solid.name,
        nodes=nodes,
        tets=tets.astype(np.int64),
        layer=mesh.layer,
        skin=skin.astype(np.int64),
        nail=on_skin & solid.nail.covers(nodes[:, 2], solid.angle(nodes)),
        bone=depth >= BONE,
        proximal=np.abs(nodes[:, 2]) < 1e-9 * solid.length,
        key=key,
        quality=quality,
    )
