"""The key `design:` of a study: which indentations could be made next, and what is wanted of them.

    design:
      criterion: c                      # D: all parameters together; A: their mean variance; c: one of them, `target`
      target: adipose.modulus           # or a ratio: dermis.modulus / epidermis.modulus
      candidates:
        - {name: plate, indenter: {shape: flat_plate}, displacement_mm: [0.5, 1.0, 2.0], noise: {sigma: 0.004, unit: N}}
        - {name: ball, indenter: {shape: sphere, radius_mm: 1.5}, depth_mm: [1.0], span_mm: 6, spacing_mm: 0.5,
           site: {z_mm: 13, theta_deg: 270}, noise: {sigma: 0.02, unit: mm}}

Every depth of an entry is an indentation of its own. `displacement_mm` asks for the force, `depth_mm` for the profile of the skin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from .errors import InputError
from .indenter_spec import read_indenter
from .measurements import Measurement, NoiseKeys, Site, SiteKeys
from .spelling import choose_from
from .strict import Positive, Strict
from .units import to_internal
from .yamlfile import Origin, located


class CandidateKeys(Strict):
    """One indenter at one site, at several depths; see the module."""

    name: str
    indenter: Any
    displacement_mm: list[Positive] = []
    depth_mm: list[Positive] = []
    direction: Literal["x", "z"] = "z"
    span_mm: Positive = 6.0
    spacing_mm: Positive = 0.5
    site: SiteKeys | None = None
    noise: NoiseKeys

    @model_validator(mode="after")
    def _one_instrument(self) -> CandidateKeys:
        if bool(self.displacement_mm) == bool(self.depth_mm):
            remedy = "write displacement_mm: [...] for forces, or depth_mm: [...] for a profile"
            raise InputError("a candidate needs one instrument", place=self.name, remedy=remedy)
        if not isinstance(self.noise.sigma, float) or self.noise.unit is None:
            remedy = "write noise: {sigma: 0.004, unit: N}: what a reading would be worth"
            raise InputError("a candidate needs the noise of its readings", place=self.name, seen=self.noise.sigma, remedy=remedy)
        return self


class DesignKeys(Strict):
    """What may stand under `design:`; see the module."""

    criterion: Literal["D", "A", "c"] = "D"
    target: str | None = None
    choose: int = Field(default=3, ge=1, le=5)
    candidates: list[CandidateKeys] = Field(min_length=1)

    @model_validator(mode="after")
    def _aimed(self) -> DesignKeys:
        if (self.criterion == "c") != (self.target is not None):
            remedy = "write criterion: c and target: NAME, or neither"
            raise InputError("criterion c aims at one target", place="target", seen=self.target, remedy=remedy)
        names = [one.name for one in self.candidates]
        twice = next((name for number, name in enumerate(names) if name in names[:number]), None)
        if twice is not None:
            raise InputError("two candidates have one name", place="candidates", seen=twice, remedy="give each its own")
        return self


@dataclass(frozen=True, eq=False)
class Design:
    """Possible indentations as measurements without data, and the criterion by which the next are chosen."""

    criterion: str
    target: str | None
    choose: int
    candidates: tuple[Measurement, ...]


def read_design(said: DesignKeys, free: Sequence[str], taken: Sequence[str], folder: Path, origin: Origin) -> Design:
    """Check what was written. **Raises** `InputError` for a target that is not free, or a name that a measurement has."""
    for name in targets(said.target):
        if name not in free:
            at, where = origin(("target",))
            raise InputError("this parameter is not free", file=at, place=where, seen=name, remedy=choose_from(name, free))
    candidates = []
    for number, one in enumerate(said.candidates):
        if one.name in taken:
            at, where = origin(("candidates", number, "name"))
            raise InputError("a measurement has this name", file=at, place=where, seen=one.name, remedy="choose another")
        with located(origin, "candidates", number):
            candidates.append(_measurement(one, folder))
    return Design(said.criterion, said.target, said.choose, tuple(candidates))


def targets(said: str | None) -> list[str]:
    """`a` -> [a]; `a / b` -> [a, b]."""
    return [] if said is None else [name.strip() for name in said.split("/")]


def _measurement(said: CandidateKeys, folder: Path) -> Measurement:
    forces = bool(said.displacement_mm)
    indenter = read_indenter(said.indenter, direction=said.direction, folder=folder)
    place = None if said.site is None else Site(said.site.z_mm, float(to_internal(said.site.theta_deg, "deg", "angle")) % (2 * np.pi))
    columns = _forces(said) if forces else _profile(said)
    kind, value = ("force_displacement", "force") if forces else ("deflection_profile", "deflection")
    sigma = float(to_internal(said.noise.sigma, said.noise.unit, "force" if forces else "length", "noise.sigma"))
    spread = np.full(len(columns[value]), sigma)
    return Measurement(said.name, kind, columns, value, spread, {"": indenter}, "displacement", said.direction, place, None)


def _forces(said: CandidateKeys) -> dict[str, np.ndarray]:
    return {"displacement": np.array(said.displacement_mm), "force": np.zeros(len(said.displacement_mm))}


def _profile(said: CandidateKeys) -> dict[str, np.ndarray]:
    count = round(said.span_mm / said.spacing_mm)
    along = said.spacing_mm * np.arange(-count, count + 1)
    depth = np.repeat(said.depth_mm, len(along))
    return {"depth": depth, "distance": np.tile(along, len(said.depth_mm)), "deflection": np.zeros(len(depth))}
