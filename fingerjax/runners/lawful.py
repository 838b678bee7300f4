"""The tissue's law as a function of numbers of effects, alone or behind raw parameters, for slopes in them."""

from __future__ import annotations

from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from ..effects import Effect
from ..fem.tissue import AbstractTissue, Linear
from ..parameters import Parameter


class Lawful(eqx.Module):
    """Values and the tissue's law from a vector of raw `parameters`, then of the `moving` numbers (effect, number) of `laws` or of others,
    which are among the values.

    What is held is in `values` and in `amounts`, effect -> its numbers. Numbers are arrays, so that code is compiled once for all of them.
    """

    parameters: tuple[Parameter, ...] = eqx.field(static=True)
    laws: tuple[Effect, ...] = eqx.field(static=True)
    moving: tuple[tuple[str, str], ...] = eqx.field(static=True)
    values: dict[str, Array]
    amounts: dict[str, dict[str, Array]]

    def __call__(self, at: Float[Array, " d"]) -> tuple[dict[str, Any], AbstractTissue]:
        named = {one.name: one.natural(at[number]) for number, one in enumerate(self.parameters)}
        said = {name: dict(numbers) for name, numbers in self.amounts.items()}
        for (effect, number), value in zip(self.moving, at[len(self.parameters) :], strict=True):
            if effect in said:
                said[effect][number] = value
            else:
                named[f"{effect}.{number}"] = value
        law: AbstractTissue = Linear()
        for one in self.laws:
            law = one.law(law, said[one.name])
        return self.values | named, law


class LawAlong(eqx.Module):
    """The law of linear tissue with one effect as a function of one of its numbers, `moving`; the others are arrays in `amount`, so that
    code is compiled once for all of them.
    """

    effect: Effect = eqx.field(static=True)
    moving: str = eqx.field(static=True)
    amount: dict[str, Array]

    def __call__(self, size: Float[Array, ""]) -> AbstractTissue:
        return self.effect.law(Linear(), self.amount | {self.moving: size})
