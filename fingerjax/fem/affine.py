"""Numbers that are affine in the Lame parameters of the layers, such as the entries of a stiffness, added up inside compiled code."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .operator import Lame

_Four = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class Affine(eqx.Module):
    """`size` sums over k terms: entry `place` gains lambda[layer] * volumetric + mu[layer] * shear of each term."""

    place: Int[Array, " k"]
    layer: Int[Array, " k"]
    volumetric: Float[Array, " k"]
    shear: Float[Array, " k"]
    size: int = eqx.field(static=True)

    def __call__(self, lame: Lame) -> Float[Array, " size"]:
        terms = lame[0][self.layer] * self.volumetric + lame[1][self.layer] * self.shear
        return jax.ops.segment_sum(terms, self.place, self.size, indices_are_sorted=True)


class Terms:
    """Collects terms on the host, adding up those of one place and layer."""

    def __init__(self, size: int):
        self.size = size
        self._parts: list[_Four] = []

    def add(self, place: np.ndarray, layer: np.ndarray, volumetric: np.ndarray, shear: np.ndarray) -> None:
        """Terms (k,) each; those with a negative place are dropped."""
        kept = place >= 0
        self._parts.append(_summed(*(part[kept] for part in (place, layer, volumetric, shear))))

    def add_rows(self, corner: np.ndarray, stride: np.ndarray, layer: np.ndarray, parts: tuple[np.ndarray, np.ndarray]) -> None:
        """Blocks of element matrices (e, a, 3, b, 3), their rows `stride` (e, a, b) apart, each from its `corner` on; -1: nowhere."""
        here = corner >= 0
        at = corner[here][:, None, None] + stride[here][:, None, None] * np.arange(3)[:, None] + np.arange(3)
        owner = np.broadcast_to(layer[:, None, None], corner.shape)[here]
        self.add(at.ravel(), np.repeat(owner, 9), *(np.moveaxis(part, 3, 2)[here].ravel() for part in parts))

    def affine(self) -> Affine:
        place, layer, volumetric, shear = map(jnp.asarray, _summed(*(np.concatenate(part) for part in zip(*self._parts, strict=True))))
        return Affine(place, layer, volumetric, shear, self.size)


def _summed(place: np.ndarray, layer: np.ndarray, volumetric: np.ndarray, shear: np.ndarray) -> _Four:
    layers = int(layer.max(initial=0)) + 1
    key, where = np.unique(place.astype(np.int64) * layers + layer, return_inverse=True)
    place, layer = np.divmod(key, layers)
    return place, layer, np.bincount(where, volumetric, len(key)), np.bincount(where, shear, len(key))
