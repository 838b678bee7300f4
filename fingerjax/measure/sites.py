"""Where receptors are asked what they feel: at one place, along a line of places, on a plane of them, all at a depth below the skin.

Depth is counted from the undeformed skin on the way to the centre of the section, as in a sidecar's `receptor`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from ..geometry.solid import AbstractSolid


@dataclass(frozen=True)
class Sites:
    """m places: `points` (m, 3) mm in the undeformed tissue, `inwards` (m, 3) the unit way from the skin to the section's centre."""

    points: Float[np.ndarray, "m 3"]
    inwards: Float[np.ndarray, "m 3"]

    def __len__(self) -> int:
        return len(self.points)


def below(solid: AbstractSolid, depth: float | np.ndarray, z: float | np.ndarray, theta: float | np.ndarray = 1.5 * np.pi) -> Sites:
    """Places `depth` mm below the skin at z mm and theta rad; the three are broadcast against each other and counted in C order.

    **Raises:** `InputError` where a place is not in soft tissue.
    """
    depth, z, theta = (np.asarray(each, float).ravel() for each in np.broadcast_arrays(depth, z, theta))
    if np.any(z <= 0) or np.any(z >= solid.length):
        raise InputError("a receptor lies beyond the finger", place="z", seen=float(z[np.argmax(np.abs(z - solid.length / 2))]))
    radius, bone = solid.radius(0, z, theta), solid.radius(4, z, theta)
    deep = (depth <= 0) | (depth >= radius - bone)
    if deep.any():
        first = int(np.argmax(deep))
        remedy = f"soft tissue is {radius[first] - bone[first]:.3g} mm thick there"
        raise InputError("a receptor does not lie in soft tissue", place="depth", seen=float(depth[first]), remedy=remedy)
    outwards = np.stack([np.cos(theta), np.sin(theta), np.zeros(len(z))], axis=1)
    centre = np.column_stack([solid.centre(z), z])
    return Sites(centre + (radius - depth)[:, None] * outwards, -outwards)


def along(solid: AbstractSolid, depth: float, z: float, distances: np.ndarray, direction: str = "z") -> Sites:
    """A line of places at one depth: at `distances` (m,) mm along z from (z, middle of the pad), or across, counted along x."""
    distances = np.asarray(distances, float)
    if direction == "z":
        return below(solid, depth, z + distances)
    return below(solid, depth, z, _angle(solid, z, distances))


def plane(solid: AbstractSolid, depth: float, x: np.ndarray, z: np.ndarray) -> Sites:
    """A population: places at one depth under every (x, z) of the two lists, mm; (x, z) is that of the skin above. Numbered x first."""
    x, z = np.asarray(x, float), np.asarray(z, float)
    theta = np.stack([_angle(solid, float(each), x) for each in z], axis=1)  # x z
    return below(solid, depth, np.broadcast_to(z, theta.shape), theta)


def _angle(solid: AbstractSolid, z: float, x: np.ndarray) -> np.ndarray:
    """theta of the pad's skin at x, (m,)."""
    theta = np.linspace(np.pi, 2 * np.pi, 1441)
    at = solid.surface(np.full(theta.shape, z), theta)[:, 0]
    widest = slice(int(np.argmin(at)), int(np.argmax(at)) + 1)
    if np.any(x < at.min()) or np.any(x > at.max()):
        remedy = f"stay within {at.min():.3g} to {at.max():.3g} mm at z = {z:g}"
        raise InputError("no skin of the pad lies at this x", place="x", seen=float(x[np.argmax(np.abs(x))]), remedy=remedy)
    return np.interp(x, at[widest], theta[widest])
