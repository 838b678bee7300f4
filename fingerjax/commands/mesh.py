"""`fingerjax mesh`: the mesh of one study, for a look at it in ParaView or as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from fingerjax.commands._ending import console, told
from fingerjax.commands._progress import Board
from fingerjax.errors import InputError
from fingerjax.geometry.account import told as account_of
from fingerjax.mesh.files import export_vtu
from fingerjax.report.mesh_picture import draw_mesh
from fingerjax.report.records import mesh_record
from fingerjax.report.words import mesh_sentence
from fingerjax.spelling import choose_from
from fingerjax.study import Study, load_studies


def mesh(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Studies, as in experiments.yaml.")],
    study: Annotated[str, typer.Option(help="Whose finger to mesh.")],
    out: Annotated[Path | None, typer.Option(help="Write the mesh here, .vtu for ParaView.")] = None,
    picture: Annotated[Path | None, typer.Option(help="Draw its layers, nail, sizes and quality, .png or .svg.")] = None,
) -> None:
    """Say what the finger of one study holds, mesh it and say how good the mesh is.

    \b
    Example:
      fingerjax mesh experiments.yaml --study table1 --out human.vtu
      fingerjax mesh experiments.yaml --study table1 --picture human.png
    """
    with told():
        studies = load_studies(file)
        if study not in studies:
            raise InputError("no such study", place="--study", seen=study, remedy=choose_from(study, studies))
        _, finger = _shaped(studies[study])
        console().print(mesh_sentence(finger.name, mesh_record(finger)), highlight=False, markup=False)
        if out is not None:
            export_vtu(finger, out)
        if picture is not None:
            draw_mesh(picture, finger)


def finger_of(study: Study) -> Any:
    """The `Finger` of a study, meshed or from the cache."""
    from fingerjax.forward.shape import mesh_of, solid_of

    return mesh_of(study, solid_of(study))


def _shaped(study: Study) -> tuple[Any, Any]:
    """Solid and mesh, with a bar on the terminal; the solid is told before it is meshed."""
    from fingerjax.forward.shape import mesh_of, solid_of

    with Board([study.name], {}, console()) as board:
        tell = board.teller(study.name)
        solid = solid_of(study, lambda share, what: tell(0.5 * share, what))
        for line in account_of(solid):
            board.line(line)
        tell(0.5, "meshing")
        finger = mesh_of(study, solid)
    return solid, finger


