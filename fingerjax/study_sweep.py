"""Options of `kind: sweep`: shapes pressed at one place after another over a receptor, as bars and steps are in the paper.

    options:
      indenters:
        step_1: {shape: step, amplitude_mm: 0.5, wavelength_mm: 0.9}
      force_N: 0.2                      # or depth_mm
      positions_mm: [-4.0, 4.0]         # of the indenter's own origin relative to the receptor, along `direction`
      spacing_mm: 0.2

The receptor is the one under `model:`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from .errors import InputError
from .indenter_spec import IndenterSpec, read_indenter
from .strict import Number, Positive, Strict
from .yamlfile import Origin, located


class SweepKeys(Strict):
    """What may stand under `options:`; see the module."""

    indenters: dict[str, Any] = Field(min_length=1)
    force_N: Positive | None = None
    depth_mm: Positive | None = None
    positions_mm: tuple[Number, Number] = (-4.0, 4.0)
    spacing_mm: Positive = 0.2
    direction: Literal["x", "z"] = "z"

    @model_validator(mode="after")
    def _one_load(self) -> SweepKeys:
        if (self.force_N is None) == (self.depth_mm is None):
            raise InputError("a sweep needs one load", place="force_N", remedy="write force_N: or depth_mm:, one of the two")
        low, high = self.positions_mm
        if not high - low >= 2 * self.spacing_mm:
            remedy = "write the lower end first, two spacings or more below the upper"
            raise InputError("a sweep needs three positions or more", place="positions_mm", seen=[low, high], remedy=remedy)
        return self


@dataclass(frozen=True)
class Sweep:
    """Indenters by name, at every one of `positions` (n,), mm; `force` in N or `depth` in mm, the other is None."""

    indenters: dict[str, IndenterSpec]
    positions: tuple[float, ...]
    direction: str
    force: float | None
    depth: float | None


def read_sweep(said: SweepKeys, folder: Path, origin: Origin) -> Sweep:
    """Check what was written. **Raises** `InputError` for an indenter that is none."""
    indenters = {}
    for name, one in said.indenters.items():
        with located(origin, "indenters", name):
            indenters[name] = read_indenter(one, direction=said.direction, folder=folder)
    low, high = said.positions_mm
    count = round((high - low) / said.spacing_mm)
    places = tuple(float(each) for each in np.linspace(low, high, count + 1))
    return Sweep(indenters, places, said.direction, said.force_N, said.depth_mm)
