"""What the floors above ask of a layered body before it is meshed: how far it goes, and where its layers lie beneath its skin."""

from __future__ import annotations

import abc

import numpy as np


class AbstractSolid(abc.ABC):
    """Nested layers, 0 the outermost, seen along rays that end in each section's origin; sections are counted along z."""

    name: str
    notes: tuple[str, ...]

    @property
    @abc.abstractmethod
    def length(self) -> float:
        """How far it goes along z from z = 0, mm."""

    @property
    @abc.abstractmethod
    def pad_centre(self) -> float:
        """z, mm, of the point of the pad that is pressed where nothing else is said."""

    @property
    @abc.abstractmethod
    def extent(self) -> str:
        """How large it is, in words."""

    @abc.abstractmethod
    def centre(self, z: np.ndarray) -> np.ndarray:
        """x and y of the section's origin, `(k, 2)` mm, at z `(k,)` mm."""

    @abc.abstractmethod
    def radius(self, layer: int, z: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """Distance of a layer's outer surface from the section's origin, `(k,)` mm, at z and theta (rad); 0 beyond its end."""

    @abc.abstractmethod
    def rays(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of points `(k, 3)` mm: x and y where their rays end, `(k, 2)` mm, and how far from there every layer's outer surface lies on
        them, `(5, k)` mm.
        """

    @abc.abstractmethod
    def volume(self, layer: int) -> float:
        """Volume of one layer, mm^3."""

    def surface(self, z: np.ndarray, theta: np.ndarray, layer: int = 0) -> np.ndarray:
        """Points `(k, 3)` mm of a layer's outer surface at z and theta (rad)."""
        z, theta = np.broadcast_arrays(np.asarray(z, float), np.asarray(theta, float))
        r, middle = self.radius(layer, z, theta), self.centre(z)
        return np.stack([middle[..., 0] + r * np.cos(theta), middle[..., 1] + r * np.sin(theta), z], axis=-1)

    def pad_y(self, z: np.ndarray) -> np.ndarray:
        """y of the pad's middle line (theta = 270 deg), `(k,)` mm."""
        return self.surface(z, np.full(np.shape(z), 1.5 * np.pi))[..., 1]
