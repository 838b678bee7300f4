"""Nonlinear tissue on two meshes: what a law adds to the readings is found on a coarse one, what the linear engine reads on the fine one.

    readings = linear(fine) + strained(coarse) - linear(coarse)

Most of the mesh's error is common to both readings of the coarse mesh and goes in the difference.
"""

from __future__ import annotations

import dataclasses
import math

import jax.numpy as jnp

from ..contact.chord import Chording
from ..fem.tissue import AbstractTissue
from .model import Assembled, Model, lay_out
from .readings import Prediction
from .rigs import foci, plans
from .shape import mesh_of
from .strained import Strained, strained_readings
from .wiring import Values


def coarser(assembled: Assembled, factor: float) -> Assembled:
    """The same study on a mesh whose elements are `factor` times as large, under indenters and around receptors too.

    A mesh that was made elsewhere stays as it is.
    """
    study, solid, wired = assembled.study, assembled.solid, assembled.model.wired
    fine = study.finger.resolution
    proximal = None if fine.proximal_mm is None else factor * fine.proximal_mm
    resolution = fine.model_copy(update={"pad_mm": factor * fine.pad_mm, "proximal_mm": proximal})
    study = dataclasses.replace(study, finger=study.finger.model_copy(update={"resolution": resolution}))
    wanted = foci(plans(study.measurements, solid, wired), solid, math.inf)
    larger = (dataclasses.replace(focus, size=factor * focus.size) for focus in wanted)
    finger = mesh_of(study, solid, tuple(focus for focus in larger if focus.size < resolution.pad_mm))
    return lay_out(study, solid, finger, wired)


def two_level_readings(
    fine: Model,
    coarse: Model,
    values: Values,
    law: AbstractTissue,
    *,
    start: Strained | None = None,
    chording: Chording | None = None,
    quantity: str = "strain_energy_density",
) -> tuple[Prediction, Strained]:
    """Every reading on the fine mesh, to first order in what the law adds; and the coarse equilibria, a warm start for the next."""
    strained = strained_readings(coarse, values, law, start=start, chording=chording, quantity=quantity)
    there, base, more = fine.predict(values, quantity), coarse.predict(values, quantity), strained.prediction
    prediction = Prediction(
        *(
            tuple(f + s - c for f, s, c in zip(*(getattr(each, name) for each in (there, more, base)), strict=True))
            for name in ("readings", "quantity")
        ),
        *(jnp.stack([getattr(each, name) for each in (there, more, base)]).all() for name in ("converged", "settled", "inside")),
        *(jnp.stack([getattr(each, name) for each in (there, more, base)]).max() for name in ("iterations", "residual")),
    )
    return prediction, strained
