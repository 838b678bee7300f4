"""A study's fit brought to finer meshes, as it asks for under `fit: finer_mm:`, and what that says of the mesh's error."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..forward import Assembled, assemble
from ..forward.model import softened
from ..identify import Fit, refined
from ..identify.noise import weighed
from ..report.records import Context, Row, Table
from ..study import Study

STIFF, MIDDLE = "pointwise dilatation", "half-way to the mean dilatation"


@dataclass(frozen=True)
class Finer:
    """The fit with the readings of the finest mesh; the covariance of what that leaves, None where there is none; and what is told."""

    fit: Fit
    spread: np.ndarray | None = None
    tables: tuple[Table, ...] = ()
    warnings: tuple[str, ...] = ()


def brought_to_finer_meshes(study: Study, assembled: Assembled, found: Fit, sizes: Mapping[str, float], context: Context) -> Finer:
    """The fit as it is where no finer mesh is asked for, or where it is no optimum."""
    wanted = study.fit.finer
    if not wanted or not found.settled:
        return Finer(found)
    meshed = []
    for number, pad in enumerate(wanted):
        context.tell(0.4 * number / len(wanted), f"mesh of {pad:g} mm")
        meshed.append(assemble(_finer(study, pad)))
    problems = [weighed(each.problem(), sizes, found.residual.size) for each in (*meshed, softened(meshed[-1]))]
    steps = refined(found, problems[:-1], softer=problems[-1], tell=context.within(0.4, 1.0).tell)
    done = len(steps.shifts)
    corrected = zip(wanted[:done], meshed[:done], strict=True)
    meshes = [(study.finger.resolution.pad_mm, assembled, STIFF), *((pad, each, STIFF) for pad, each in corrected)]
    if steps.softened is not None:
        meshes.append((*meshes[-1][:2], MIDDLE))
    rows: list[Row] = [
        {"pad_mm": pad, "nodes": len(each.finger.nodes), "elements": kind, **on.best, "chi2": on.chi2}
        for (pad, each, kind), on in zip(meshes, steps.fits, strict=True)
    ]
    note = (
        "Each row's values are those that its mesh gives; the last are half-way to those of elements with one dilatation in each: the one "
        "kind is too stiff, the other too soft. What the last corrections leave is part of the stated intervals."
    )
    told = [f"The fit could not be corrected to the mesh of {wanted[done]:g} mm and finer."] if done < len(wanted) else []
    if done == len(wanted) and steps.softened is None:
        told.append("The fit could not be corrected to softer elements: what the mesh leaves may be larger than stated.")
    return Finer(
        steps.best, steps.spread if done else None, (Table("meshes", "Values on finer and finer meshes", rows, note),), tuple(told)
    )


def _finer(study: Study, pad: float) -> Study:
    """The study on a mesh that is finer everywhere, in the ratio of the spacings on the pad."""
    mesh = study.finger.resolution
    share = pad / mesh.pad_mm
    resolution = mesh.model_copy(update={"pad_mm": pad, "proximal_mm": share * mesh.proximal_mm})
    return dataclasses.replace(study, finger=study.finger.model_copy(update={"resolution": resolution}))
