"""A round body with flat faces: a slab of layers on a floor, or a cylinder between two plates.

It is pressed on its upper face, y = 0, which looks towards -y like the pad of a finger; its lower face is y = thickness. Its axis stands at
x = 0, z = radius, so that sites are counted along z from its edge as they are from a finger's proximal cut.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fingerjax.errors import InputError
from fingerjax.geometry.solid import AbstractSolid
from fingerjax.layers import SOFT_LAYERS

Face = Literal["held", "sliding"]
_SHALLOWEST = 1e-6  # sine of an angle below which a ray runs along the lower face


@dataclass(frozen=True)
class Disc(AbstractSolid):
    """Layers of constant thickness in a circular outline.

    **Arguments:**

    - `name`: what it is called in tables.
    - `outline`: radius, mm.
    - `layers`: thickness, mm, of epidermis, dermis, adipose tissue and fibrous matrix from the pressed face down; 0 where there is none.
    - `lower`: `held`, the lower face sticks to its floor, or `sliding`, it moves along it without friction.
    - `upper`: `sliding`, no friction where it is pressed, or `held`: nothing of it moves sideways, as under a plate that it sticks to.
    - `rim`: whether the side is `free`, or `held` by a rigid ring.
    """

    name: str
    outline: float
    layers: tuple[float, float, float, float]
    lower: Face = "held"
    upper: Face = "sliding"
    rim: Literal["free", "held"] = "free"

    def __post_init__(self) -> None:
        if not self.outline > 0 or min(self.layers) < 0 or not self.thickness > 0:
            seen = (self.outline, *self.layers)
            raise InputError("a body without size", place=self.name, seen=seen, remedy="give a radius and a thickness above 0 mm")

    @property
    def thickness(self) -> float:
        """From face to face, mm."""
        return sum(self.layers)

    @property
    def length(self) -> float:
        return 2.0 * self.outline

    @property
    def pad_centre(self) -> float:
        return self.outline

    @property
    def extent(self) -> str:
        return f"{self.thickness:.2f} mm thick, radius {self.outline:.2f} mm"

    @property
    def notes(self) -> tuple[str, ...]:  # type: ignore[override]
        faces = {
            ("held", "sliding"): "the lower face is held, the upper one is pressed without friction",
            ("sliding", "sliding"): "both faces slide along what they touch",
            ("held", "held"): "neither face moves sideways",
            ("sliding", "held"): "the lower face slides, the upper one does not move sideways",
        }
        side = "; the side is held" if self.rim == "held" else "; the side is free"
        return (faces[self.lower, self.upper] + side,)

    @property
    def tops(self) -> tuple[float, ...]:
        """y, mm, of every layer's outer surface, bone last: that one lies on the lower face."""
        return tuple(float(depth) for depth in np.cumsum([0.0, *self.layers]))

    def centre(self, z: np.ndarray) -> np.ndarray:
        return np.stack([np.zeros(np.shape(z)), np.full(np.shape(z), self.thickness)], axis=-1)

    def radius(self, layer: int, z: np.ndarray, theta: np.ndarray) -> np.ndarray:
        z, theta = np.broadcast_arrays(np.asarray(z, float), np.asarray(theta, float))
        up, side = -np.sin(theta), np.abs(np.cos(theta))
        half = np.sqrt(np.maximum(self.outline**2 - (z - self.outline) ** 2, 0.0))
        to_face = (self.thickness - self.tops[layer]) / np.maximum(up, _SHALLOWEST)
        to_side = half / np.maximum(side, _SHALLOWEST)
        return np.where(up > 0, np.minimum(to_face, to_side), 0.0)

    def rays(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Straight down: layers keep their thickness everywhere."""
        ends = np.stack([points[:, 0], np.full(len(points), self.thickness)], axis=1)
        return ends, np.repeat(self.thickness - np.array(self.tops)[:, None], len(points), axis=1)

    def volume(self, layer: int) -> float:
        return math.pi * self.outline**2 * self.layers[layer] if layer < len(SOFT_LAYERS) else 0.0
