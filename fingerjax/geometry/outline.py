"""The skin of a finger alone, as closed curves in planes across it: what images and scans hand over to the layers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fingerjax.errors import InputError
from fingerjax.geometry.sections import fullest


@dataclass(frozen=True, eq=False)
class Outline:
    """Closed curves across a finger: z from the proximal cut to the tip, nail at +y.

    - `z`: `(s,)` mm, increasing from 0. `curves`: s arrays `(k, 2)` mm, x and y once round, counterclockwise.
    - `apex`: `(3,)` mm, the tip, beyond the last curve.
    - `notes`: what was found or corrected on the way, in words.
    """

    z: np.ndarray
    curves: tuple[np.ndarray, ...]
    apex: np.ndarray
    notes: tuple[str, ...] = ()

    @property
    def length(self) -> float:
        """mm"""
        return float(self.apex[2])

    @property
    def low(self) -> np.ndarray:
        """`(s, 2)` mm: least x and y of every curve."""
        return np.array([curve.min(axis=0) for curve in self.curves])

    @property
    def high(self) -> np.ndarray:
        """`(s, 2)` mm: greatest x and y of every curve."""
        return np.array([curve.max(axis=0) for curve in self.curves])

    @property
    def fullest(self) -> int:
        """Number of the curve in which the pad is lowest."""
        return fullest(self.z, self.low[:, 1], self.length)

    def radii(self, centre: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """Radius of every curve about its centre `(s, 2)` along angles `(m,)`: `(s, m)` mm.

        **Raises** `InputError` where a centre lies outside its curve.
        """
        out = np.empty((len(self.z), len(theta)))
        for i, curve in enumerate(self.curves):
            out[i] = polar(curve, centre[i], theta)
            if not np.isfinite(out[i]).all():
                raise InputError(
                    "the centre of the bone lies outside the skin",
                    place=f"z = {self.z[i]:.3g} mm",
                    seen=tuple(round(float(v), 3) for v in centre[i]),
                    remedy="give layers: {rise: ...}, the height of the bone's centre above the middle as a share of the height",
                )
        return out


def polar(curve: np.ndarray, centre: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Where rays from a centre `(2,)` leave a closed polygon `(k, 2)` last: `(m,)` mm; NaN where they do not meet it."""
    return last_met(curve, np.roll(curve, -1, axis=0), centre, theta)


def last_met(start: np.ndarray, end: np.ndarray, centre: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """The farthest crossing of each ray `(m,)` from a centre with segments `(k, 2)` to `(k, 2)`; NaN where there is none."""
    a, b = start - centre, end - centre
    ray = np.stack([np.cos(theta), np.sin(theta)], axis=1)
    side_a = ray[:, 0, None] * a[:, 1] - ray[:, 1, None] * a[:, 0]  # (m, k): which side of the ray's line a lies on
    side_b = ray[:, 0, None] * b[:, 1] - ray[:, 1, None] * b[:, 0]
    crossed = (side_a <= 0) != (side_b <= 0)
    share = np.where(crossed, side_a / np.where(crossed, side_a - side_b, 1.0), 0.0)
    far = (ray @ a.T) * (1.0 - share) + (ray @ b.T) * share
    far = np.where(crossed & (far > 0), far, -np.inf).max(axis=1)
    return np.where(np.isfinite(far), far, np.nan)
