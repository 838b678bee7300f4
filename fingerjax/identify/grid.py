"""The paper's way to layer ratios, as a baseline: every layer at every power of ten, the best kept.

Dandekar et al. (2003), section 3.2: models m2222 to m5555, compared with measured profiles by eye. Here the comparison is by residual.
Only ratios matter to a profile under given travel, and forces grow with the scale of all moduli, so models of the same ratios share one
solve and the scale has a closed form:

    s = sum(F d / sigma^2) / sum(F^2 / sigma^2)         over forces d at given travel, F those of the model
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..forward import Assembled
from ..forward.model import noise_of
from ..layers import SOFT_LAYERS
from ..measurements import Measurement

DECADES = (2, 3, 4, 5)
RIGID = "8"  # the digit of a rigid bone in a model's name
Tell = Callable[[float, str], object]


@dataclass(frozen=True)
class GridModel:
    """One combination: its name, moduli in MPa by layer, and chi-square; infinite where a solve failed."""

    name: str
    moduli: dict[str, float]
    chi2: float


@dataclass(frozen=True)
class Grid:
    """All combinations, best first; `solves`: how many different ratios were solved for; `seconds`: what that took."""

    models: tuple[GridModel, ...]
    solves: int
    seconds: float

    @property
    def best(self) -> GridModel:
        return self.models[0]

    def rows(self, count: int = 10) -> list[dict[str, object]]:
        """Tidy rows of the best few; models of the same ratios stand in one row."""
        alike: dict[tuple[float, ...], list[GridModel]] = {}
        for one in self.models:
            alike.setdefault((one.chi2, *one.moduli.values()), []).append(one)
        best = list(alike.values())[:count]
        return [
            {"model": " = ".join(one.name for one in same), "chi2": same[0].chi2, **{f"{k}_MPa": v for k, v in same[0].moduli.items()}}
            for same in best
        ]


def grid(
    assembled: Assembled, decades: tuple[int, ...] = DECADES, *, share: bool = True, tell: Tell = lambda done, doing: None
) -> Grid:
    """Compare every combination of powers of ten with the study's data.

    **Arguments:** `share`: solve once for models of the same ratios; without it each model is solved for, as the paper did.

    **Raises** `InputError` for data whose reading is not proportional to the scale of the moduli (forces that were imposed, spike rates).
    """
    measurements = assembled.study.measurements
    _check(measurements, assembled)
    began, known = time.perf_counter(), {}
    found, names = [], [digits for digits in itertools.product(decades, repeat=len(SOFT_LAYERS)) if _as_tied(digits, assembled)]
    for number, digits in enumerate(names):
        ratios = tuple(digit - digits[0] for digit in digits)
        key = ratios if share else digits
        if key not in known:
            tell(number / len(names), "m" + "".join(map(str, digits)))
            known[key] = _compared(assembled, ratios, measurements)
        chi2, moduli = known[key]
        found.append(GridModel("m" + "".join(map(str, digits)) + RIGID, moduli, chi2))
    return Grid(tuple(sorted(found, key=lambda one: one.chi2)), len(known), time.perf_counter() - began)


def _as_tied(digits: tuple[int, ...], assembled: Assembled) -> bool:
    """Layers that share one modulus have one digit."""
    owners = [assembled.model.wired.owner[f"{layer}.modulus"] for layer in SOFT_LAYERS]
    return all(a == b for (a, one), (b, other) in itertools.combinations(zip(digits, owners, strict=True), 2) if one == other)


def _check(measurements: tuple[Measurement, ...], assembled: Assembled) -> None:
    for one in measurements:
        if one.controlled == "force" or one.kind == "spike_rate":
            remedy = "take profiles, and forces at given travel"
            raise InputError("the grid of ratios cannot read this measurement", file=one.file, place=one.name, seen=one.kind, remedy=remedy)
    if assembled.study.model.bone_modulus() is not None:
        remedy = "write bone: rigid; an elastic bone has a scale of its own"
        raise InputError("the grid of ratios needs a rigid bone", file=assembled.study.file, place="model.bone", remedy=remedy)
    if assembled.model.wired.per:
        per = ", ".join(assembled.model.wired.per)
        raise InputError("the grid has one finger", place="fit.per", seen=per, remedy="take one subject with `where:`")


def _compared(assembled: Assembled, ratios: tuple[int, ...], measurements: tuple[Measurement, ...]) -> tuple[float, dict[str, float]]:
    """(chi-square, moduli) of the ratios, at the best scale where the epidermis is free, at the study's epidermis where it is not."""
    wired = assembled.model.wired
    epidermis = wired.fixed[wired.owner["epidermis.modulus"]]
    moduli = {layer: epidermis * 10.0**decade for layer, decade in zip(SOFT_LAYERS, ratios, strict=True)}
    prediction = assembled.predict({wired.owner[f"{layer}.modulus"]: value for layer, value in moduli.items()})
    if not bool(prediction.health.converged):
        return math.inf, moduli
    free = wired.owner["epidermis.modulus"] in {one.path for one in wired.free}
    forces = [number for number, one in enumerate(measurements) if one.kind == "force_displacement"]
    reading = [np.asarray(one) / noise_of(m)[0] for one, m in zip(prediction.readings, measurements, strict=True)]
    data = [m.measured / noise_of(m)[0] for m in measurements]
    scale = _scale(reading, data, forces) if free and forces else 1.0
    chi2 = sum(float(np.sum((_scaled(F, k in forces, scale) - d) ** 2)) for k, (F, d) in enumerate(zip(reading, data, strict=True)))
    return chi2, {layer: scale * value for layer, value in moduli.items()}


def _scale(reading: list[np.ndarray], data: list[np.ndarray], forces: list[int]) -> float:
    product = sum(float(reading[k] @ data[k]) for k in forces)
    return max(product / sum(float(reading[k] @ reading[k]) for k in forces), 1e-9)


def _scaled(reading: np.ndarray, force: bool, scale: float) -> np.ndarray:
    return scale * reading if force else reading
