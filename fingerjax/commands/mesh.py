"""`fingerjax mesh`: the mesh of one study, for a look at it in ParaView or as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure as Canvas
from matplotlib.patches import Patch as Swatch

from fingerjax.commands._ending import console, told
from fingerjax.errors import InputError
from fingerjax.layers import LAYERS
from fingerjax.mesh.files import export_vtu
from fingerjax.report.records import mesh_record
from fingerjax.report.words import mesh_sentence
from fingerjax.spelling import choose_from
from fingerjax.study import Study, load_studies

TINTS = ("#F2C6A8", "#E38D75", "#F6E3A1", "#C9B7D8", "#F4F1EA")  # epidermis inwards, bone last
_EDGES = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])


def mesh(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Studies, as in experiments.yaml.")],
    study: Annotated[str, typer.Option(help="Whose finger to mesh.")],
    out: Annotated[Path | None, typer.Option(help="Write the mesh here, .vtu for ParaView.")] = None,
    picture: Annotated[Path | None, typer.Option(help="Draw two cuts through it, .png or .svg.")] = None,
) -> None:
    """Mesh the finger of one study and say how good the mesh is.

    \b
    Example:
      fingerjax mesh experiments.yaml --study table1 --out human.vtu
      fingerjax mesh experiments.yaml --study table1 --picture human.png
    """
    with told():
        studies = load_studies(file)
        if study not in studies:
            raise InputError("no such study", place="--study", seen=study, remedy=choose_from(study, studies))
        finger = finger_of(studies[study])
        console().print(mesh_sentence(finger.name, mesh_record(finger)), highlight=False, markup=False)
        if out is not None:
            export_vtu(finger, out)
        if picture is not None:
            draw_cuts(picture, finger)


def finger_of(study: Study) -> Any:
    """The `Finger` of a study, meshed or from the cache."""
    from fingerjax.forward.shape import mesh_of, solid_of

    return mesh_of(study, solid_of(study))


def draw_cuts(path: Path, finger: Any) -> None:
    """A cut along the finger through its middle (x = 0) and one across it under the nail, coloured by
    layer.
    """
    canvas = Canvas(figsize=(9.0, 4.2), layout="constrained")
    along, across = canvas.subplots(1, 2, width_ratios=[1.6, 1.0])
    centre = 0.5 * (finger.nodes.min(axis=0) + finger.nodes.max(axis=0))
    z = float(np.mean(finger.nodes[finger.nail, 2])) if finger.nail.any() else float(centre[2])
    _paint(along, finger, 0, float(centre[0]), (2, 1), ("z, mm", "y, mm"))
    _paint(across, finger, 2, z, (0, 1), ("x, mm", "y, mm"))
    across.legend(
        handles=[Swatch(facecolor=TINTS[k], label=LAYERS[k]) for k in np.unique(finger.layer)],
        loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=8,
    )  # fmt: skip
    canvas.savefig(path, dpi=100)


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
