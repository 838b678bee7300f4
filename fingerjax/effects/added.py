"""Effects in play, and how much of each: those that compiled code computes, and those that make another model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from ..fem.body import Body, Material
from ..fem.tissue import AbstractTissue
from ..finger import Finger
from ..geometry.solid import AbstractSolid
from .effect import Amount, Effect
from .records import Felt, Placed, Push, Reading


class Added(eqx.Module):
    """What compiled code does of some effects; their numbers are among the model's values, as `effect.number`."""

    effects: tuple[Effect, ...] = eqx.field(static=True, default=())

    def amount(self, effect: Effect, values: Mapping[str, Any]) -> Amount:
        return {name: jnp.asarray(values.get(f"{effect.name}.{name}", null), float) for name, null in effect.null().items()}

    def material(self, material: Material, values: Mapping[str, Any]) -> Material:
        for effect in self.effects:
            material = effect.material(material, self.amount(effect, values))
        return material

    def push(self, push: Push, values: Mapping[str, Any]) -> Push:
        for effect in self.effects:
            push = effect.push(push, self.amount(effect, values))
        return push

    def feel(self, felt: Felt, values: Mapping[str, Any]) -> Felt:
        for effect in self.effects:
            felt = effect.feel(felt, self.amount(effect, values))
        return felt

    def read(self, reading: Reading, values: Mapping[str, Any]) -> Reading:
        for effect in self.effects:
            reading = effect.read(reading, self.amount(effect, values))
        return reading


@dataclass(frozen=True, eq=False)
class Effects:
    """Effects of a model: `compiled` ones, and `made` ones with the amounts that the model is made with."""

    compiled: tuple[Effect, ...] = ()
    made: tuple[tuple[Effect, Amount], ...] = field(default=())

    @property
    def added(self) -> Added:
        return Added(self.compiled)

    @property
    def reshape(self) -> bool:
        """Whether any of them changes elements or supports."""
        return any(effect.reshapes for effect, _ in self.made)

    def shape(self, finger: Finger, solid: AbstractSolid) -> Finger:
        for effect, amount in self.made:
            finger = effect.shape(finger, solid, amount)
        return finger

    def place(self, placed: Placed) -> Placed:
        for effect, amount in self.made:
            placed = effect.place(placed, amount)
        return placed

    def support(self, body: Body, finger: Finger, solid: AbstractSolid) -> Body:
        for effect, amount in self.made:
            body = effect.support(body, finger, solid, amount)
        return body

    def law(self, law: AbstractTissue) -> AbstractTissue:
        for effect, amount in self.made:
            law = effect.law(law, amount)
        return law


NONE = Effects()
