"""From what a receptor feels to the spikes that its afferent sends.

    rate = scale * max(quantity - threshold, 0)

The kink is kept sharp: rounding it would be a leak of spikes below threshold that nobody measured. A
Levenberg-Marquardt step sees nothing of a position below threshold, so it must not start with all of them
there. `start` gives the best scale and threshold for quantities at the start values of everything else; there
the positions that fire lie above threshold. At the kink itself the slope is that of the firing side.
"""

from __future__ import annotations

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from fingerjax.errors import InputError


class AbstractAfferent(eqx.Module):
    """Turns a receptor quantity into a discharge rate in Hz."""

    @abstractmethod
    def __call__(self, quantity: Float[Array, "..."]) -> Float[Array, "..."]:
        """Rate in Hz."""


class Threshold(AbstractAfferent):
    """Proportional to what exceeds the threshold: `scale` in Hz per unit of quantity, `threshold` in it."""

    scale: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    threshold: Float[Array, ""] = eqx.field(converter=jnp.asarray)

    def __call__(self, quantity: Float[Array, "..."]) -> Float[Array, "..."]:
        return rate(quantity, self.scale, self.threshold)


def rate(
    quantity: Float[ArrayLike, "..."], scale: Float[ArrayLike, "..."], threshold: Float[ArrayLike, "..."]
) -> Float[Array, "..."]:
    """scale * max(quantity - threshold, 0), in Hz; scale and threshold may differ from row to row."""
    above = jnp.asarray(quantity) - threshold
    return jnp.asarray(scale) * jnp.where(above < 0.0, 0.0, above)


def start(
    quantity: np.ndarray, observed: np.ndarray, weight: np.ndarray | None = None
) -> tuple[float, float]:
    """Scale and threshold that minimise sum of weight * (observed - rate(quantity))^2, found exactly.

    Between two neighbouring values of the quantity the same rows fire, and the problem is a straight line. So
    every split is solved, its threshold kept inside its interval, and the best is taken. Scale is positive.

    **Arguments:** `quantity` and `observed` (n,), the rates in Hz; `weight` (n,), 1/sigma^2.

    **Raises:** `InputError` if all quantities are equal or no rate is positive.
    """
    q, r = np.asarray(quantity, float), np.asarray(observed, float)
    w = np.ones_like(q) if weight is None else np.asarray(weight, float)
    if np.ptp(q) == 0 or not np.any(r > 0):
        raise InputError(
            "scale and threshold cannot be told from these rates",
            place="spike rates",
            remedy="give rates at two or more positions that differ, some of them above zero",
        )
    splits = [(low, high) for low, high in zip(_edges(q)[:-1], _edges(q)[1:], strict=True)]
    tried = [one for split in splits for one in _split(q, r, w, *split)]
    return min(tried, key=lambda one: _misfit(q, r, w, *one))


def _edges(q: np.ndarray) -> np.ndarray:
    """Values between which the same rows fire; far below the smallest all do."""
    values = np.unique(q)
    return np.concatenate([[values[0] - 1e3 * np.ptp(values)], values])


def _split(q: np.ndarray, r: np.ndarray, w: np.ndarray, low: float, high: float) -> list[tuple[float, float]]:
    """The best line with its threshold inside [low, high], if any, and the best with it at either end."""
    on = q >= high
    found = [(_slope(q[on] - end, r[on], w[on]), end) for end in (low, high)]
    mean_q, mean_r = np.average(q[on], weights=w[on]), np.average(r[on], weights=w[on])
    scale = _slope(q[on] - mean_q, r[on] - mean_r, w[on])
    if scale > 0 and low <= mean_q - mean_r / scale <= high:
        found.append((scale, mean_q - mean_r / scale))
    return [(float(s), float(t)) for s, t in found if s > 0] or [(1e-12, float(low))]


def _slope(x: np.ndarray, y: np.ndarray, w: np.ndarray) -> float:
    bottom = np.sum(w * x * x)
    return np.sum(w * x * y) / bottom if bottom > 0 else 0.0


def _misfit(q: np.ndarray, r: np.ndarray, w: np.ndarray, scale: float, threshold: float) -> float:
    return float(np.sum(w * (r - scale * np.maximum(q - threshold, 0.0)) ** 2))
