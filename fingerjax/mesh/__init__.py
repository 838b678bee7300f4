"""Meshes: tetrahedra that follow the layers of a solid, refined where an indenter needs it.

`build_finger` is the way in. `Resolution` says how fine the mesh is all over, `Focus` where it is finer. Two meshers make it:
`columns`, the default, one element through each layer where nothing is refined, exact at any thickness, in seconds; `nested`, even
elements between nested surfaces, for fingers whose layers cannot be seen along straight rays from the bone, in a minute or more.
`ladder` refines a mesh throughout, for convergence; `fingerjax.mesh.imported` reads meshes made elsewhere;
`fingerjax.mesh.bodies` has test bodies that need no meshing library.
"""

from __future__ import annotations

import time
from typing import Literal

import numpy as np

from fingerjax.errors import InputError
from fingerjax.finger import Finger
from fingerjax.geometry.sections import LayeredSolid
from fingerjax.layers import BONE
from fingerjax.mesh.cache import Arrays, cache_dir, content_key, kept
from fingerjax.mesh.columns import Columns, Rays, columns
from fingerjax.mesh.contour import nail_nodes
from fingerjax.mesh.files import arrays_of, checksum, finger_of
from fingerjax.mesh.jacobian import relaxed
from fingerjax.mesh.nested import nested
from fingerjax.mesh.quality import figures
from fingerjax.mesh.refine import Focus, refine
from fingerjax.mesh.smooth import outlined, smoothed, worst_of
from fingerjax.mesh.surface import Resolution, is_surface, skin_triangles
from fingerjax.mesh.topology import divided, edges, quadratic, quadratic_triangles

__all__ = ["PAPER", "Focus", "Resolution", "build_finger", "build_like", "cache_dir", "ladder"]

DEFAULT = Resolution()
MESHER = "columns 3"  # part of every key: raise it when the same input would give another mesh
NESTED = "nested 2"
PAPER = {"monkey": Resolution(), "monkey fine": Resolution(0.17, 1.0), "human": Resolution(0.9)}  # about 8,500, 29,000 and 8,500 nodes
TRIES = 5  # triangulations of a skin before it is given up
REFINER = "chords 8"  # the same for refined meshes alone


def build_finger(
    solid: LayeredSolid,
    resolution: Resolution = DEFAULT,
    focus: tuple[Focus, ...] = (),
    mesher: Literal["columns", "nested"] = "columns",
    repeat: int = 0,
) -> Finger:
    """The labelled mesh of a layered solid, kept in `cache_dir()` and built only once.

    All column meshes of one solid and resolution share one triangulated skin, whatever their focus. `repeat` asks for another mesh of
    the same solid, as pytetwild does not make the same one twice: how far answers differ between repeats is their mesh noise. Raises
    `InputError` where the solid cannot be meshed.
    """
    again = (f"repeat {repeat}",) if repeat else ()
    if mesher == "nested":
        key = content_key(NESTED, solid.digest, resolution, solid.name, *focus, *again)
        return finger_of(kept(key, lambda: arrays_of(nested(solid, resolution, focus, key))))
    base = content_key(MESHER, solid.digest, resolution, *again)
    key = content_key(base, solid.name, *focus, *([REFINER] if focus else []))
    return finger_of(kept(key, lambda: arrays_of(_built(solid, resolution, focus, base, key))))


def build_like(solid: LayeredSolid, model: LayeredSolid, resolution: Resolution = DEFAULT) -> Finger:
    """The mesh of a solid on the skin triangles of another, `model`, carried over at equal theta and share of the length.

    Meshing the same solid twice can change a force by some per cent; two solids on one triangulation differ by their shapes alone.
    """
    key = content_key(MESHER, solid.digest, resolution, "like", model.digest)
    return finger_of(kept(key, lambda: arrays_of(_carried(solid, model, resolution, key))))


def ladder(solid: LayeredSolid, step: int, resolution: Resolution = DEFAULT, focus: tuple[Focus, ...] = ()) -> Finger:
    """The column mesh of a solid with all its edges `step` times as short, along the skin and through the layers, for convergence.

    Steps 1, 2, 3 have 1, 8 and 27 times as many elements; each triangle of the skin is cut into `step**2` and each layer into `step`.
    It is then refined under each `focus`, whose size is the caller's to shrink.
    """
    base = content_key(MESHER, solid.digest, resolution)
    key = content_key(base, solid.name, *focus, *([REFINER] if focus else []), *((f"step {step}",) if step > 1 else ()))

    def build() -> Finger:
        started, stored = time.perf_counter(), _skin(solid, resolution, base)
        points, triangles = divided(stored["points"], stored["triangles"], step)
        return finger_from_columns(refine(columns(solid, points, triangles, through=step), focus), key, started)

    return finger_of(kept(key, lambda: arrays_of(build())))


def _carried(solid: LayeredSolid, model: LayeredSolid, resolution: Resolution, key: str) -> Finger:
    started = time.perf_counter()
    stored = _skin(model, resolution, content_key(MESHER, model.digest, resolution))
    z = stored["points"][:, 2] * solid.length / model.length
    points = solid.surface(z, model.angle(stored["points"]))
    same = solid.nail.theta == model.nail.theta
    same &= np.allclose(np.array(solid.nail.z) / solid.length, np.array(model.nail.z) / model.length)
    return finger_from_columns(columns(solid, points, stored["triangles"]), key, started, followed=bool(same))


def _skin(solid: LayeredSolid, resolution: Resolution, base: str) -> Arrays:
    """The triangulated skin of a solid, kept.

    Coarse triangles may touch each other, or turn over where the nail's rim cuts them; as pytetwild never makes the same ones twice, it is
    asked again. The best of all is taken where one of each is turned over, or reaches round a quarter of the finger.
    """

    def skin() -> Arrays:
        rays, best, least = Rays(solid), None, -np.inf
        for _ in range(TRIES):
            points, triangles = outlined(rays, *smoothed(rays, *skin_triangles(solid, resolution)))
            if is_surface(triangles) and (worst := worst_of(rays, points, triangles)) > least:
                best, least = {"points": points, "triangles": triangles}, worst
            if least > 0.0:
                break
        if best is not None:
            return best
        raise InputError(
            "the skin could not be triangulated: parts of it touch each other",
            place="resolution",
            seen=(resolution.pad, resolution.coarsest),
            remedy=f"write a proximal_mm of {0.25 * solid.largest_radius:.2g} or less",
        )

    return kept(f"{base}-skin", skin)


def _built(
    solid: LayeredSolid, resolution: Resolution, focus: tuple[Focus, ...], base: str, key: str
) -> Finger:
    started = time.perf_counter()
    stored = _skin(solid, resolution, base)
    mesh = refine(columns(solid, stored["points"], stored["triangles"]), focus)
    return finger_from_columns(mesh, key, started)


def finger_from_columns(mesh: Columns, key: str, started: float | None = None, followed: bool = True) -> Finger:
    """A finger from a column mesh: midsides on the true interfaces, nail, bone and cut marked.

    `followed`: the triangles of the skin end at the nail's rim.
    """
    solid, count = mesh.rays.solid, len(mesh.vertices)
    pairs, _ = edges(mesh.tets, count)
    _, t, middle = mesh.midpoints(pairs)
    nodes, tets, _ = quadratic(mesh.vertices, mesh.tets, middle)
    nodes, straightened = relaxed(nodes, tets, count)
    depth = np.concatenate([mesh.t, t])
    skin = quadratic_triangles(mesh.skin, pairs, count)
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
        nail=nail_nodes(solid, nodes, skin, followed),
        bone=depth >= BONE,
        proximal=np.abs(nodes[:, 2]) < 1e-9 * solid.length,
        key=key,
        quality=quality,
    )
