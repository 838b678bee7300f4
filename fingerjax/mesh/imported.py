"""A mesh made elsewhere: any format of meshio that holds tetrahedra and says in which layer each of them lies.

Cell data `layer` (or `gmsh:physical`, `medit:ref`) number the layers from the skin inwards, 1 epidermis to 5 bone. Point data
`nail` and `bone` mark held nodes and the bone's surface where the file has them. Coordinates are those of every finger here: z from
the proximal cut (z = 0) to the tip, nail at +y. The sections that sites and receptors are placed by are cut from the mesh itself.
"""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from fingerjax.errors import InputError
from fingerjax.finger import Finger
from fingerjax.geometry.outline import last_met
from fingerjax.geometry.scan import SCALES, cut_at
from fingerjax.geometry.sections import LayeredSolid, Patch, Sections, solid_from_sections
from fingerjax.layers import BONE, LAYERS
from fingerjax.mesh.contour import nail_nodes
from fingerjax.mesh.files import checksum
from fingerjax.mesh.quality import figures
from fingerjax.mesh.topology import boundary, edges, quadratic, quadratic_triangles, signed_volumes

TAGS = ("layer", "gmsh:physical", "medit:ref")
FLIPPED = [0, 1, 3, 2, 4, 8, 7, 6, 5, 9]  # a ten-node tetrahedron with two corners exchanged
SECTIONS, ANGLES = 40, 90
UPWARDS = np.array([0.0, 0.0, 1.0])


def read_mesh(file: Path, nail: Patch | None = None, unit: str = "mm", name: str = "finger") -> tuple[Finger, LayeredSolid]:
    """The finger in a mesh file, and the layered solid that its surfaces enclose.

    A `nail` given stands above the file's own mark. **Raises** `InputError`: a file without tetrahedra or layers, layers that are not
    1 to 5, a cut that is not at z = 0, no nail.
    """
    mesh = _read(file)
    nodes, tets = _elements(mesh, file)
    nodes = np.ascontiguousarray(nodes * SCALES[unit])
    layer = _layers(mesh, file)
    _check_place(nodes, file)
    marks = {key: np.asarray(mesh.point_data[key], bool).reshape(-1) for key in ("nail", "bone") if key in mesh.point_data}
    nodes, tets, used = _quadratic(nodes, tets)
    proximal = np.abs(nodes[:, 2]) < 1e-6 * float(np.ptp(nodes[:, 2]))
    bone = _bone(tets, layer, marks.get("bone"), len(nodes), used)
    skin = _skin(tets, proximal, bone, len(nodes))
    solid = _solid(nodes, tets, layer, proximal, bone, nail, name)
    held = _nail(nodes, tets, skin, solid, nail, marks.get("nail"), used, file)
    quality = figures(nodes, tets, layer, solid) | {"mesh_hash": checksum({"n": nodes, "t": tets})[:20]}
    finger = Finger(name, nodes, tets, layer, skin, held, bone, proximal, key=quality["mesh_hash"], quality=quality)
    return finger, solid


def _read(file: Path) -> Any:
    import meshio

    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            return meshio.read(file)
    except (Exception, SystemExit) as error:  # meshio's readers raise what they like, and its `read` exits
        raise InputError(f"cannot be read as a mesh ({error})", file=file, remedy="write .vtu, .msh or another format of meshio") from None


def _elements(mesh: Any, file: Path) -> tuple[np.ndarray, np.ndarray]:
    for kind in ("tetra10", "tetra"):
        if kind in mesh.cells_dict:
            return np.asarray(mesh.points, float), np.asarray(mesh.cells_dict[kind], np.int64)
    raise InputError("holds no tetrahedra", file=file, seen=sorted(mesh.cells_dict), remedy="write tetrahedra of 4 or 10 nodes")


def _layers(mesh: Any, file: Path) -> np.ndarray:
    kind = "tetra10" if "tetra10" in mesh.cells_dict else "tetra"
    tag = next((name for name in TAGS if kind in mesh.cell_data_dict.get(name, {})), None)
    if tag is None:
        seen = sorted(mesh.cell_data)
        raise InputError("does not say the layer of its elements", file=file, seen=seen, remedy="write cell data named layer")
    layer = np.asarray(mesh.cell_data_dict[tag][kind]).astype(np.int64).reshape(-1)
    wrong = np.setdiff1d(layer, np.arange(1, len(LAYERS) + 1))
    if len(wrong):
        raise InputError("an unknown layer", file=file, place=tag, seen=int(wrong[0]), remedy="number them 1 epidermis to 5 bone")
    return layer - 1


def _check_place(nodes: np.ndarray, file: Path) -> None:
    low, size = nodes.min(axis=0), np.ptp(nodes, axis=0)
    if abs(low[2]) > 1e-3 * size[2]:
        raise InputError("the proximal cut is not at z = 0", file=file, seen=float(low[2]), remedy="move the mesh along z")
    if not 5.0 < size.max() < 300.0:
        raise InputError("not the size of a finger", file=file, seen=f"{size.max():.3g} mm long", remedy="give unit: m, cm or mm")


def _quadratic(nodes: np.ndarray, tets: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ten-node elements, positively oriented, corners first among the nodes; and the file's number of every node (-1: new)."""
    flip = signed_volumes(nodes, tets[:, :4]) < 0
    tets = tets.copy()
    if tets.shape[1] == 4:
        tets[flip] = tets[flip][:, FLIPPED[:4]]
        used, number = np.unique(tets, return_inverse=True)
        points, elements, _ = quadratic(nodes[used], number.reshape(tets.shape))
        return points, elements, np.r_[used, np.full(len(points) - len(used), -1)]
    tets[flip] = tets[flip][:, FLIPPED]
    corners = np.unique(tets[:, :4])
    pairs, of = edges(tets[:, :4], len(nodes))
    middle = np.empty(len(pairs), np.int64)
    middle[of] = tets[:, 4:]
    used = np.r_[corners, middle]
    number = np.empty(len(nodes), np.int64)
    number[used] = np.arange(len(used))
    return nodes[used], number[tets], used


def _bone(tets: np.ndarray, layer: np.ndarray, marked: np.ndarray | None, count: int, used: np.ndarray) -> np.ndarray:
    bone = np.zeros(count, bool)
    bone[tets[layer == BONE]] = True
    if not bone.any() and marked is not None:
        bone = _carried(marked, tets, used)
    return bone


def _carried(marked: np.ndarray, tets: np.ndarray, used: np.ndarray) -> np.ndarray:
    """A mark on the file's nodes on ours; a midside that the file lacks has it when both ends of its edge do."""
    mark = np.where(used >= 0, marked[used], False)
    for side, (i, j) in enumerate(((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))):
        new = used[tets[:, 4 + side]] < 0
        mark[tets[new, 4 + side]] = mark[tets[new, i]] & mark[tets[new, j]]
    return mark


def _skin(tets: np.ndarray, proximal: np.ndarray, bone: np.ndarray, count: int) -> np.ndarray:
    """Outer six-node triangles that are neither cut nor the wall of a bone that is not meshed."""
    corners = tets[:, :4]
    outer = boundary(corners)
    outer = outer[~(proximal[outer].all(axis=1) | bone[outer].all(axis=1))]
    vertices = int(corners.max()) + 1
    pairs, _ = edges(corners, vertices)
    return quadratic_triangles(outer, pairs, vertices)


def _solid(
    nodes: np.ndarray, tets: np.ndarray, layer: np.ndarray, proximal: np.ndarray, bone: np.ndarray, nail: Patch | None, name: str
) -> LayeredSolid:
    """Sections cut from the surfaces between the layers."""
    length = float(nodes[:, 2].max())
    u = np.linspace(1.0, 0.0, SECTIONS + 1)
    z = length * (1.0 - 0.5 * (u + u**2))
    theta = np.linspace(0.0, 2 * np.pi, ANGLES, endpoint=False)
    surfaces = [_enclosing(tets, layer, proximal, bone, number) for number in range(len(LAYERS))]
    centre = _centres(nodes, surfaces, z, length)
    radii = np.zeros((len(z), len(theta), len(LAYERS)))
    for i, level in enumerate(z[:-1]):
        for number, triangles in enumerate(surfaces):
            cut = cut_at(nodes, triangles, UPWARDS, max(level, 1e-6 * length))[:, :, :2]
            if len(cut):
                radii[i, :, number] = np.nan_to_num(last_met(cut[:, 0], cut[:, 1], centre[i], theta))
    radii = np.minimum.accumulate(radii, axis=2)
    patch = nail or Patch(z=(0.0, length), theta=(0.0, np.pi))
    sections = Sections(z=z, theta=theta, centre=centre, radii=radii)
    return solid_from_sections(sections, patch, name, ("sections cut from the imported mesh",))


def _enclosing(tets: np.ndarray, layer: np.ndarray, proximal: np.ndarray, bone: np.ndarray, number: int) -> np.ndarray:
    """Straight triangles, four to a face with its midsides, around everything from layer `number` inwards."""
    inside = tets[layer >= number][:, :4]
    if len(inside):
        outer = boundary(inside)
        hole = bone[outer].all(axis=1) & (number < BONE)
    else:
        outer = boundary(tets[:, :4])
        hole = ~bone[outer].all(axis=1)
    outer = outer[~(hole | proximal[outer].all(axis=1))]
    vertices = int(tets[:, :4].max()) + 1
    six = quadratic_triangles(outer, edges(tets[:, :4], vertices)[0], vertices)
    return np.concatenate([six[:, [0, 3, 5]], six[:, [3, 1, 4]], six[:, [5, 4, 2]], six[:, [3, 4, 5]]])


def _centres(nodes: np.ndarray, surfaces: list[np.ndarray], z: np.ndarray, length: float) -> np.ndarray:
    """Middle of the bone's section, or of the innermost layer that is there, `(s, 2)` mm; the tip's own at the last."""
    out = np.empty((len(z), 2))
    for i, level in enumerate(z[:-1]):
        for triangles in surfaces[::-1]:
            cut = cut_at(nodes, triangles, UPWARDS, max(level, 1e-6 * length))[:, :, :2].reshape(-1, 2)
            if len(cut):
                out[i] = 0.5 * (cut.min(axis=0) + cut.max(axis=0))
                break
    out[-1] = nodes[np.argmax(nodes[:, 2]), :2]
    return out


def _nail(
    nodes: np.ndarray,
    tets: np.ndarray,
    skin: np.ndarray,
    solid: LayeredSolid,
    nail: Patch | None,
    marked: np.ndarray | None,
    used: np.ndarray,
    file: Path,
) -> np.ndarray:
    held = None
    if nail is not None:
        held = nail_nodes(solid, nodes, skin)
    elif marked is not None:
        held = np.isin(np.arange(len(nodes)), skin) & _carried(marked, tets, used)
    if held is None or not held.any():
        remedy = "write nail: {z_mm: ..., theta_deg: ...}, or point data named nail"
        raise InputError("no node is nail", file=file, place="nail", remedy=remedy)
    return held
