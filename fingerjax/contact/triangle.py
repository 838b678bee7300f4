"""The quadratic triangle of the skin: shape functions, slopes, and a rule fine enough for the edge of an indenter.

Barycentric coordinates are (1 - a - b, a, b); nodes are the vertices, then the midsides of 01, 12 and 20.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

QUARTERS = ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))  # nodes of the quarters of a facet, in the order of the rule


def shapes(a: Any, b: Any) -> Any:
    """Quadratic shape functions (..., 6) at parameters (...), of NumPy or of JAX as they are."""
    c = 1.0 - a - b
    return _of(a).stack([c * (2 * c - 1), a * (2 * a - 1), b * (2 * b - 1), 4 * c * a, 4 * a * b, 4 * b * c], axis=-1)


def slopes(a: Any, b: Any) -> Any:
    """Their derivatives in (a, b): (..., 2, 6)."""
    xp, c = _of(a), 1.0 - a - b
    o = xp.zeros_like(a)
    in_a = [1 - 4 * c, 4 * a - 1, o, 4 * (c - a), 4 * b, -4 * b]
    in_b = [1 - 4 * c, o, 4 * b - 1, -4 * a, 4 * a, 4 * (c - b)]
    return xp.stack([xp.stack(in_a, -1), xp.stack(in_b, -1)], axis=-2)


def _of(values: Any) -> Any:
    return np if isinstance(values, np.ndarray) else jnp


def _rule() -> tuple[np.ndarray, np.ndarray]:
    """Points (24, 2) and weights (24,) summing to 1/2: 6, exact to degree 4, in each quarter triangle."""
    corners = np.array([(0, 0), (1, 0), (0, 1), (0.5, 0), (0.5, 0.5), (0, 0.5)], float)
    a, b = 0.445948490915965, 0.091576213509771
    one = [(a, a), (1 - 2 * a, a), (a, 1 - 2 * a), (b, b), (1 - 2 * b, b), (b, 1 - 2 * b)]
    bary = np.array([(1 - s - t, s, t) for s, t in one])
    weight = np.repeat([0.223381589678011, 0.109951743655322], 3) / 8.0
    return np.concatenate([bary @ corners[list(quarter)] for quarter in QUARTERS]), np.tile(weight, 4)


def _lattice(order: int) -> np.ndarray:
    return np.array([(i, j) for i in range(order + 1) for j in range(order + 1 - i)], float) / order


POINTS, WEIGHTS = _rule()
SHAPES: Float[np.ndarray, "q 6"] = shapes(*POINTS.T)
SLOPES: Float[np.ndarray, "q 2 6"] = slopes(*POINTS.T)
HATS: Float[np.ndarray, "q 3"] = np.column_stack([1 - POINTS.sum(1), POINTS])
SAMPLES = _lattice(6)  # parameters (28, 2) at which a facet is looked at for first contact
SAMPLED: Float[np.ndarray, "s 6"] = shapes(*SAMPLES.T)
