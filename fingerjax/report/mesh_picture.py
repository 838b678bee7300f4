"""A mesh as a picture: two cuts coloured by layer, the skin with its nail and the size of its elements, and how well they are shaped."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure as Canvas
from matplotlib.patches import Patch as Swatch

from ..layers import LAYERS
from ..mesh.quality import dihedral_angles, radius_ratios

TINTS = ("#F2C6A8", "#E38D75", "#F6E3A1", "#C9B7D8", "#F4F1EA")  # epidermis inwards, bone last
_EDGES = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])


def draw_mesh(path: Path, finger: Any) -> None:
    """Two cuts, the outside from the pad's and the nail's side, and histograms of smallest dihedral angles and radius ratios."""
    canvas = Canvas(figsize=(11.0, 8.0), layout="constrained")
    (along, across), (outside, shapes) = canvas.subplots(2, 2, width_ratios=[1.6, 1.0])
    _cuts(along, across, finger)
    outside.set_axis_off()
    seen = outside_view(finger)
    if seen is None:
        outside.text(0.5, 0.5, "no off-screen OpenGL here: the outside is not shown", ha="center", va="center")
    else:
        outside.imshow(seen)
        outside.set_title("edge length of the skin, mm (bar), held nail dark", fontsize=9)
    _shapes(shapes, finger)
    canvas.savefig(path, dpi=100)


def _shapes(axes: Axes, finger: Any) -> None:
    """How many elements have which smallest dihedral angle, and which radius ratio."""
    corners = finger.tets[:, :4]
    axes.hist(dihedral_angles(finger.nodes, corners).min(axis=1), bins=np.arange(0.0, 72.0, 2.0).tolist(), color=TINTS[1], alpha=0.8)
    axes.set(xlabel="smallest dihedral angle, deg (filled)", ylabel="elements")
    ratio = axes.twiny()
    ratio.hist(radius_ratios(finger.nodes, corners), bins=np.linspace(0.0, 1.0, 36).tolist(), histtype="step", color="#5A4A78")
    ratio.set_xlabel("radius ratio, 1 is regular (line)")


def outside_view(finger: Any) -> np.ndarray | None:
    """The skin from the side of the pad and from that of the nail, `(rows, columns, 3)`; None where nothing can be drawn off-screen."""
    import pyvista

    try:
        pyvista.vtk_verbosity("off")  # it complains of a missing screen that is not needed
        plotter: Any = pyvista.Plotter(off_screen=True, shape=(1, 2), window_size=[900, 600], border=False)
        for column, elevation in enumerate((-25.0, 25.0)):
            plotter.subplot(0, column)
            plotter.add_mesh(_skin_of(finger), scalars="edge, mm", cmap="viridis_r", show_edges=True, edge_color="#55555588")
            nail = _nail_of(finger)
            if nail is not None:
                plotter.add_mesh(nail, color="#40304A")
            plotter.camera_position = [(0.0, float(np.sign(elevation)), 0.45), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)]
            plotter.reset_camera()
        return np.asarray(plotter.screenshot(return_img=True))
    except (RuntimeError, OSError, AttributeError):
        return None


def _skin_of(finger: Any) -> Any:
    """Straight triangles of the skin with the mean length of their edges."""
    import pyvista

    corners = finger.skin[:, :3]
    sides = finger.nodes[corners] - finger.nodes[corners[:, [1, 2, 0]]]
    skin = pyvista.PolyData(finger.nodes, np.column_stack([np.full(len(corners), 3), corners]).ravel())
    skin.cell_data["edge, mm"] = np.linalg.norm(sides, axis=2).mean(axis=1)
    return skin


def _nail_of(finger: Any) -> Any:
    """Triangles of the skin all of whose corners are held, a hair outside it."""
    import pyvista

    corners = finger.skin[:, :3]
    held = corners[finger.nail[corners].all(axis=1)]
    if not len(held):
        return None
    middle = 0.5 * (finger.nodes.min(axis=0) + finger.nodes.max(axis=0))
    points = middle + 1.003 * (finger.nodes - middle)
    return pyvista.PolyData(points, np.column_stack([np.full(len(held), 3), held]).ravel())


def _cuts(along: Axes, across: Axes, finger: Any) -> None:
    """A cut along the finger through its middle (x = 0) and one across it under the nail, coloured by layer."""
    centre = 0.5 * (finger.nodes.min(axis=0) + finger.nodes.max(axis=0))
    z = float(np.mean(finger.nodes[finger.nail, 2])) if finger.nail.any() else float(centre[2])
    _paint(along, finger, 0, float(centre[0]), (2, 1), ("z, mm", "y, mm"))
    _paint(across, finger, 2, z, (0, 1), ("x, mm", "y, mm"))
    across.legend(
        handles=[Swatch(facecolor=TINTS[k], label=LAYERS[k]) for k in np.unique(finger.layer)],
        loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=8,
    )  # fmt: skip


def _paint(
    axes: Axes, finger: Any, normal: int, place: float, shown: tuple[int, int], labels: tuple[str, str]
) -> None:
    for layer, polygons in cut(finger, normal, place).items():
        flat = [polygon[:, shown] for polygon in polygons]
        axes.add_collection(
            PolyCollection(flat, facecolor=TINTS[layer], edgecolor="#55555566", linewidth=0.3)
        )
    axes.autoscale_view()
    axes.set(aspect="equal", xlabel=labels[0], ylabel=labels[1])


def cut(finger: Any, normal: int, place: float) -> dict[int, list[np.ndarray]]:
    """Polygons (k, 3), mm, in which the tetrahedra meet the plane where coordinate `normal` is `place`; by
    layer.
    """
    corners = finger.nodes[finger.tets[:, :4]]  # (e, 4, 3)
    height = corners[:, :, normal] - place
    met = np.flatnonzero((height.min(axis=1) < 0) & (height.max(axis=1) > 0))
    found: dict[int, list[np.ndarray]] = {}
    for element in met:
        found.setdefault(int(finger.layer[element]), []).append(
            _slice(corners[element], height[element], normal)
        )
    return found


def _slice(corners: np.ndarray, height: np.ndarray, normal: int) -> np.ndarray:
    """The points in which the edges of one tetrahedron cross the plane, in order around their middle."""
    one, other = height[_EDGES[:, 0]], height[_EDGES[:, 1]]
    crossed = (one < 0) != (other < 0)
    share = (one[crossed] / (one[crossed] - other[crossed]))[:, None]
    start, end = corners[_EDGES[crossed, 0]], corners[_EDGES[crossed, 1]]
    points = start + share * (end - start)
    flat = np.delete(points - points.mean(axis=0), normal, axis=1)
    return points[np.argsort(np.arctan2(flat[:, 1], flat[:, 0]))]
