"""Everything that was found, before it is written down."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .adequacy import Look
from .calibrate import FalseAlarms
from .explanations import Explanation
from .meshguard import MeshGuard
from .noise import Noise
from .record import NextExperiment, Planted
from .subject import AbstractSubject, Family
from .verdict import Verdict


@dataclass(frozen=True, eq=False)
class Findings:
    """The parts of a diagnosis.

    - `columns`: key -> (rows,) of the subject at the base fit. `last`: what the model says in the end: the base where nothing is named.
    - `nearest`: where nothing explains the data, the model of the catalogue that comes nearest; None where there is none.
    """

    subject: AbstractSubject
    families: tuple[Family, ...]
    roles: Mapping[str, str]
    noise: Noise
    mesh: MeshGuard
    base: Look
    columns: Mapping[str, Float[np.ndarray, "rows"]]
    explanations: list[Explanation]
    verdict: Verdict
    next: list[NextExperiment]
    alarms: FalseAlarms
    planted: list[Planted]
    seed: int
    seconds: float
    nearest: Explanation | None = None

    @property
    def last(self) -> Look:
        return self.verdict.members[0].look if self.verdict.members else self.base

    @property
    def closest(self) -> Look:
        """The same, but where nothing is named the nearest model of the catalogue."""
        return self.nearest.look if self.nearest is not None else self.last
