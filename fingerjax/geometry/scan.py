"""A scanned surface -> closed curves across the finger.

The surface is read and mended (trimesh), turned so that z runs to the tip and the nail is at +y, and cut across.
It may be open at its proximal end, as scans are, but nowhere else within the length that is used.
"""

from __future__ import annotations

import contextlib
import io
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fingerjax.errors import InputError
from fingerjax.geometry.outline import Outline, last_met

SCALES = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 1e-3}
SUFFIXES = (".stl", ".obj", ".ply")
SECTIONS = 48
ANGLES = 180
BEND = (0.45, 0.95)  # share of the length over which the side that bulges is looked for
SIDES = 36


@dataclass(frozen=True)
class Frame:
    """How a scan stands. `axis`: towards the tip; `nail`: towards the nail; found where None. `length`: mm used behind the tip."""

    axis: tuple[float, float, float] | None = None
    nail: tuple[float, float, float] | None = None
    length: float | None = None


@dataclass(frozen=True)
class Repair:
    """What was found and mended in a surface."""

    triangles: int
    merged: int
    degenerate: int
    pieces: int
    filled: int
    turned: bool
    open_edges: int

    @property
    def watertight(self) -> bool:
        """Whether no open edge is left."""
        return self.open_edges == 0

    @property
    def note(self) -> str:
        """In words."""
        state = "watertight" if self.watertight else f"open along {self.open_edges} edges"
        done = [
            (self.merged, f"{self.merged} doubled vertices merged"),
            (self.degenerate, f"{self.degenerate} degenerate or doubled triangles removed"),
            (self.pieces - 1, f"{self.pieces - 1} loose pieces left out"),
            (self.filled, f"{self.filled} triangles put into holes"),
            (self.turned, "triangles turned outwards"),
        ]
        mended = "; ".join(text for count, text in done if count)
        return f"surface of {self.triangles} triangles, {state}" + (f"; {mended}" if mended else "")


def read_surface(file: Path, unit: str = "mm") -> tuple[np.ndarray, np.ndarray, Repair]:
    """Points `(n, 3)` mm, triangles `(f, 3)` and what was mended.

    **Raises** `InputError`: not a surface that can be read, or one that is torn.
    """
    import trimesh

    if file.suffix.lower() not in SUFFIXES:
        raise InputError("not a surface format", file=file, seen=file.suffix, remedy=f"write one of {', '.join(SUFFIXES)}")
    try:
        with contextlib.redirect_stderr(io.StringIO()):
            mesh: Any = trimesh.load(file, force="mesh", process=False)
    except Exception as error:  # whatever a reader raises on a damaged file, it cannot be read
        raise InputError(f"cannot be read as a surface ({error})", file=file, remedy="write STL, OBJ or PLY") from None
    if len(getattr(mesh, "faces", ())) < 100:
        raise InputError("too few triangles for a finger", file=file, seen=len(getattr(mesh, "faces", ())), remedy="write a finer surface")
    mesh.apply_scale(SCALES[unit])
    repair = mended(mesh)
    size = float(np.linalg.norm(mesh.extents))
    if not 5.0 < size < 300.0:
        raise InputError("not the size of a finger", file=file, seen=f"{size:.3g} mm across", remedy="give unit: m, cm or mm")
    return np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64), repair


def mended(mesh: Any) -> Repair:
    """Mend a trimesh surface where it stands: vertices merged, the largest piece kept, small holes filled, normals outwards."""
    import trimesh

    logging.getLogger("trimesh").setLevel(logging.ERROR)
    before = len(mesh.vertices), len(mesh.faces)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    merged = before[0] - len(mesh.vertices)
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    degenerate = before[1] - len(mesh.faces)
    label = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    area = np.bincount(label, weights=mesh.area_faces)
    mesh.update_faces(label == int(np.argmax(area)))
    mesh.remove_unreferenced_vertices()
    held = len(mesh.faces)
    turned = not mesh.is_winding_consistent
    if not mesh.is_watertight:
        trimesh.repair.fill_holes(mesh)
    if turned:
        trimesh.repair.fix_winding(mesh)
    if mesh.volume < 0:
        mesh.invert()
        turned = True
    return Repair(len(mesh.faces), merged, degenerate, len(area), len(mesh.faces) - held, turned, len(_open_edges(np.asarray(mesh.faces))))


def _open_edges(faces: np.ndarray) -> np.ndarray:
    """Edges `(k, 2)` of one triangle only."""
    pairs = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, times = np.unique(pairs, axis=0, return_counts=True)
    return unique[times == 1]


def outline_from_scan(file: Path, frame: Frame, unit: str = "mm") -> Outline:
    """The skin of a finger from its scanned surface. **Raises** `InputError` where it cannot be read, stood up or cut."""
    points, faces, repair = read_surface(file, unit)
    stood, how = stand(points, faces, frame)
    outline = _cut(stood, faces, frame, file)
    return Outline(outline.z, outline.curves, outline.apex, (repair.note, *how))


def stand(points: np.ndarray, faces: np.ndarray, frame: Frame) -> tuple[np.ndarray, tuple[str, ...]]:
    """Points with z to the tip, nail at +y and the tip's end of the axis through the middle; and how both were found."""
    axis, how_axis = _axis(points, faces) if frame.axis is None else (_unit(frame.axis, "axis"), "axis given")
    shaft = points - points.mean(axis=0)
    if frame.nail is None:
        nail, how_nail = _nail_side(shaft, faces, axis)
    else:
        nail = _unit(np.asarray(frame.nail) - np.dot(frame.nail, axis) * axis, "nail")
        how_nail = "nail side given"
    frame_of = np.stack([np.cross(nail, axis), nail, axis])
    stood = shaft @ frame_of.T
    return stood - [0.0, 0.0, stood[:, 2].min()], (how_axis, how_nail)


def _unit(vector: Any, key: str) -> np.ndarray:
    size = float(np.linalg.norm(vector))
    if not size > 1e-9:
        raise InputError("not a direction", place=key, seen=tuple(np.asarray(vector)), remedy="write three numbers, not along the axis")
    return np.asarray(vector, float) / size


def _areas(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Area `(f,)`, unit normal and centroid `(f, 3)` of triangles."""
    a, b, c = (points[faces[:, i]] for i in range(3))
    normal = 0.5 * np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    return area, normal / np.maximum(area, 1e-300)[:, None], (a + b + c) / 3.0


def _axis(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, str]:
    """Towards the tip: square to the flat cut where there is one, otherwise the surface's longest principal axis."""
    area, normal, centroid = _areas(points, faces)
    middle = np.average(centroid, axis=0, weights=area)
    spread = np.cov((centroid - middle).T, aweights=area)
    along = np.linalg.eigh(spread)[1][:, -1]
    height = (centroid - middle) @ along
    flat = []
    for way in (1.0, -1.0):
        end = (way * height > 0.9 * np.max(way * height)) & (way * (normal @ along) > 0.95)
        flat.append(float(area[end].sum()))
    section = float(area.sum()) / max(float(np.ptp(points @ along)), 1e-9)  # mm of girth
    if max(flat) > 0.02 * section**2:
        way = 1.0 if flat[0] > flat[1] else -1.0
        end = (way * height > 0.9 * np.max(way * height)) & (way * (normal @ along) > 0.95)
        axis = -np.average(normal[end], axis=0, weights=area[end])
        return _unit(axis, "axis"), "axis found square to the flat cut"
    rim = _open_edges(faces)
    if len(rim):
        way = float(np.sign(((points[rim].reshape(-1, 3) - middle) @ along).mean()))
        return -way * along, "axis found along the scan, away from its open end"
    thick = [float(np.linalg.norm(np.cross(centroid[way * height > 0.6 * np.max(way * height)] - middle, along), axis=1).mean())
             for way in (1.0, -1.0)]  # fmt: skip
    return (-along if thick[0] > thick[1] else along), "axis found along the scan, towards its thinner end"


def _nail_side(points: np.ndarray, faces: np.ndarray, axis: np.ndarray) -> tuple[np.ndarray, str]:
    """Away from the side that bulges most towards the tip, which is the pad; a dorsum with its nail is straighter."""
    across = _unit(np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.8 else [0.0, 1.0, 0.0]), "axis")
    other = np.cross(axis, across)
    height = points @ axis
    low, high = height.min(), height.max()
    levels = low + (high - low) * np.linspace(*BEND, 15)
    theta = np.arange(SIDES) * 2 * np.pi / SIDES
    support = np.empty((len(levels), SIDES))
    for i, level in enumerate(levels):
        segments = cut_at(points, faces, axis, level)
        flat = np.stack([segments.reshape(-1, 3) @ across, segments.reshape(-1, 3) @ other], axis=1)
        support[i] = (flat @ np.stack([np.cos(theta), np.sin(theta)])).max(axis=0)
    share = np.linspace(0.0, 1.0, len(levels))[:, None]
    bulge = (support - (1.0 - share) * support[0] - share * support[-1]).mean(axis=0)
    first = np.sum(bulge * np.exp(1j * theta))
    pad = np.angle(first)
    sure = abs(first) / max(float(np.abs(bulge).sum()), 1e-12)
    nail = -(np.cos(pad) * across + np.sin(pad) * other)
    doubt = "" if sure > 0.05 else ", but hardly one side bulges more than another: give nail: [x, y, z]"
    return nail, f"nail side found opposite to the side that bulges, ({nail[0]:+.2f}, {nail[1]:+.2f}, {nail[2]:+.2f}) in the scan{doubt}"


def cut_at(points: np.ndarray, faces: np.ndarray, normal: np.ndarray, level: float) -> np.ndarray:
    """Segments `(k, 2, 3)` in which triangles cross the plane x . normal = level."""
    height = (points @ normal - level)[faces]
    height = np.where(height == 0.0, 1e-12, height)
    met = (height.min(axis=1) < 0) & (height.max(axis=1) > 0)
    corner, above = points[faces[met]], height[met]
    ends = []
    lonely = np.argmax((above > 0) == ((above > 0).sum(axis=1) == 1)[:, None], axis=1)
    row = np.arange(len(corner))
    for step in (1, 2):
        mate = (lonely + step) % 3
        share = above[row, lonely] / (above[row, lonely] - above[row, mate])
        ends.append(corner[row, lonely] + share[:, None] * (corner[row, mate] - corner[row, lonely]))
    return np.stack(ends, axis=1)


def _cut(points: np.ndarray, faces: np.ndarray, frame: Frame, file: Path) -> Outline:
    """Curves across, crowded towards the tip. **Raises** `InputError` where a section does not close."""
    top = float(points[:, 2].max())
    rim = _open_edges(faces)
    lowest = float(points[rim].reshape(-1, 3)[:, 2].max()) if len(rim) else float(points[:, 2].min())
    length = frame.length if frame.length is not None else (top - lowest) * (1.0 - 1e-6)
    if not 0 < length <= top - lowest + 1e-9 or length < 0.3 * (top - points[:, 2].min()):
        raise InputError(
            "the surface is not closed over the length that is used",
            file=file,
            seen=f"{len(rim)} open edges, the tip's {top - lowest:.2f} mm are closed",
            remedy=f"give length_mm up to {top - lowest:.2f}, or close the holes",
        )
    moved = points - [0.0, 0.0, top - length]
    u = np.linspace(1.0, 0.0, SECTIONS + 1)[:-1]
    z = length * (1.0 - 0.5 * (u + u**2))
    z[0] = 1e-6 * length
    theta = np.linspace(0.0, 2 * np.pi, ANGLES, endpoint=False)
    curves = []
    for level in z:
        curves.append(_curve(cut_at(moved, faces, np.array([0.0, 0.0, 1.0]), level)[:, :, :2], theta, level, file))
    tip = moved[np.argmax(moved[:, 2])]
    z[0] = 0.0
    return Outline(z, tuple(curves), np.array([*tip[:2], length]))


def _curve(segments: np.ndarray, theta: np.ndarray, z: float, file: Path) -> np.ndarray:
    """One closed curve `(m, 2)` from segments `(k, 2, 2)`: the outermost, seen from their middle."""
    ends = segments.reshape(-1, 2)
    middle = 0.5 * (ends.min(axis=0) + ends.max(axis=0)) if len(ends) else np.zeros(2)
    radius = last_met(segments[:, 0], segments[:, 1], middle, theta) if len(ends) else np.full(len(theta), np.nan)
    if not np.isfinite(radius).all():
        remedy = "close the hole there, or give a shorter length_mm"
        raise InputError("a section of the surface does not close round its middle", file=file, place=f"z = {z:.2f} mm", remedy=remedy)
    return middle + radius[:, None] * np.stack([np.cos(theta), np.sin(theta)], axis=1)
