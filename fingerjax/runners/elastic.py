"""The linear model of a study with effects in it: what it reads, and how that changes with moduli and with every effect."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..effects import Effect
from ..effects.effect import Force
from ..fem.cholesky import Indefinite
from ..forward.inner import Beside, first_order, inner_slopes, of_law
from ..forward.model import Assembled
from ..forward.readings import Prediction, Solved
from ..loop.subject import Evaluation
from ..parameters import Parameter
from ..side_by_side import side_by_side
from .families import family
from .lawful import LawAlong
from .rows import rows_of
from .variants import Amounts, Variants

BESIDE = 1e-5  # of an effect's plausible size: the step to another body; what differs then is computed exactly
NEAR = 0.02  # of an effect's plausible size: the step of a difference
TURN = 1e-5  # of a raw parameter: the step of a difference
TOGETHER = 8  # directions of slopes are filled up to a multiple of these
LIKE = 0.1  # of a measurement's readings, root mean square, that a coarser mesh may be off by for laws to be followed on it


class ElasticFinger:
    """A study on its mesh without tissue laws. `ways`: every column by which an effect may enter, by its key."""

    def __init__(self, ready: Assembled, effects: Mapping[str, Effect], solver: str, size: float):
        self.effects = effects
        self.variants = Variants(ready, effects, solver, size, self.alike)
        self.parameters = self.base.problem().parameters
        self.rows = rows_of(ready.study)
        self.families = tuple(family(effect, ready.study.measurements) for effect in effects.values())
        self.ways = {column.key: column for family in self.families for column in (*family.columns, *family.second)}

    @property
    def base(self) -> Assembled:
        """The model without any effect awake."""
        return self.variants.base

    def named(self, raw: Float[np.ndarray, " p"]) -> dict[str, float]:
        """Base parameters in their own units."""
        return {one.name: float(one.natural(each)) for one, each in zip(self.parameters, raw, strict=True)}

    def amounts(self, phi: Mapping[str, float], *, at_null: bool = False) -> Amounts:
        found: dict[str, dict[str, Any]] = {}
        for key, value in phi.items():
            way = self.ways[key]
            number = way.null if at_null and key not in found and value == 0.0 else value
            found.setdefault(way.family, {}).update({way.name: float(number), **way.fixed})
        return {name: self.effects[name].null() | numbers for name, numbers in found.items()}

    def is_compiled(self, key: str) -> bool:
        return self.effects[self.ways[key].family].traced

    def is_inner(self, key: str) -> bool:
        """Whether an effect may be in the internal force, or in where a receptor is, so that one linear answer gives its slope."""
        effect = self.effects[self.ways[key].family]
        return effect.passive and not effect.traced

    def is_secant(self, key: str) -> bool:
        """Whether it changes elements or supports, and its slope at the null vanishes or misleads."""
        way = self.ways[key]
        return way.step is not None and self.effects[way.family].reshapes

    def is_first_order(self, key: str) -> bool:
        return self.effects[self.ways[key].family].first_order

    def is_law(self, key: str) -> bool:
        return self.effects[self.ways[key].family].is_law

    def lawless(self, amounts: Amounts) -> Amounts:
        return {name: each for name, each in amounts.items() if not self.effects[name].is_law}

    def is_strained(self, amounts: Amounts) -> bool:
        """Whether the tissue follows another law than Hooke's."""
        return any(self.effects[name].is_law and numbers != self.effects[name].null() for name, numbers in amounts.items())

    def values(self, raw: Float[np.ndarray, " p"], amounts: Amounts) -> dict[str, Any]:
        numbers = {
            f"{name}.{number}": jnp.asarray(value)
            for name, each in amounts.items()
            if self.effects[name].traced  # the others have changed the model; their names here would have code compiled anew
            for number, value in each.items()
        }
        return {name: jnp.asarray(value) for name, value in self.named(raw).items()} | self._asleep() | numbers

    def _asleep(self) -> dict[str, Any]:
        return {f"{one.name}.{number}": jnp.asarray(float(value)) for one in self.variants.compiled for number, value in one.null().items()}

    def evaluate(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float], moving: tuple[str, ...]) -> Evaluation:
        """Every row, and its slopes in the raw parameters and in the effects that move; laws of the tissue are left out."""
        amounts, rubs = self.amounts(phi), bool(self.rubs(self.amounts(phi)))
        inside, outside = ([key for key in moving if self.is_compiled(key) is here] for here in (True, False))
        found = self.linearised(self.variants.of(amounts), raw, amounts, tuple(inside))
        if found is None:
            return self.failed(len(raw), len(moving))
        value, slopes = found
        if rubs:
            value, slopes = value + self._rubbed(raw, phi), slopes + self._rubbed_slopes(raw, phi, inside)
        theta, together = slopes[:, : len(raw)], dict(zip(inside, slopes[:, len(raw) :].T, strict=True))
        together |= self.inner_slopes(raw, phi, [key for key in outside if (self.is_first_order if rubs else self.is_inner)(key)])
        for key in outside:
            if key not in together:
                together[key] = self._difference(raw, phi, key, value)
        columns = [together[key] for key in moving]
        return Evaluation(value, theta, np.stack(columns, axis=1) if columns else np.zeros((len(value), 0)))

    def failed(self, p: int, k: int) -> Evaluation:
        """What is told where there is no answer."""
        n = len(self.rows)
        return Evaluation(np.full(n, np.nan), np.full((n, p), np.nan), np.full((n, k), np.nan), converged=False)

    def value(self, model: Assembled | None, raw: Float[np.ndarray, " p"], amounts: Amounts) -> np.ndarray | None:
        """Every row of a model with these amounts in it; None where there is no answer."""
        value = None if model is None else self.read(model, raw, amounts)
        if value is None or model is None or not self.rubs(amounts):
            return value
        return value + first_order(model, self.values(raw, amounts), self.rubs(amounts))

    def _difference(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float], key: str, here: np.ndarray) -> np.ndarray:
        moved, step = self.stepped(phi, key)
        amounts = self.amounts(moved)
        there = self.value(self.variants.of(amounts), raw, amounts)
        return np.full(len(here), np.nan) if there is None else (there - here) / step

    def read(self, model: Assembled, raw: Float[np.ndarray, " p"], amounts: Amounts) -> np.ndarray | None:
        values = self.values(raw, amounts)
        try:
            prediction = _predicted(model.model.solved(values), values)
        except Indefinite:
            return None
        value = np.concatenate([np.asarray(each) for each in prediction.readings])
        return value if bool(prediction.health.converged) and np.isfinite(value).all() else None

    def linearised(
        self, model: Assembled | None, raw: Float[np.ndarray, " p"], amounts: Amounts, keys: tuple[str, ...]
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """The prediction (rows,), and its slopes (rows, p + k) in the raw parameters and in compiled effects."""
        if model is None:
            return None
        values = self.values(raw, amounts)
        moved = [f"{self.ways[key].family}.{self.ways[key].name}" for key in keys]
        try:
            solved = model.model.solved(values, moving=(*(one.name for one in self.parameters), *moved))
        except Indefinite:  # a support that gives too much holds nothing
            return None
        others = {name: value for name, value in values.items() if name not in {one.name for one in self.parameters}}
        ways = _ways(len(raw), others, moved)
        value, slopes, sound = _sensitive(solved, self.parameters, jnp.asarray(raw), others, ways)
        slopes = slopes[: len(raw) + len(moved)]
        return (np.asarray(value), np.asarray(slopes).T) if bool(sound) and bool(jnp.all(jnp.isfinite(slopes))) else None

    def alike(self, rough: Assembled, own: Assembled) -> bool:
        """Whether linear tissue reads nearly the same on both where the study begins: on a rough mesh a sphere may not even touch."""
        raw = np.array([one.raw() for one in self.parameters])
        there, here = (self.read(each, raw, {}) for each in (rough, own))
        if there is None or here is None:
            return False
        blocks = self.rows.blocks.values()
        return all(float(np.linalg.norm(there[rows] - here[rows])) <= LIKE * float(np.linalg.norm(here[rows])) for rows in blocks)

    def inner_slopes(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float], keys: list[str]) -> dict[str, np.ndarray]:
        """Slopes of every row in effects that add an internal force f(u): - B' K^-1 f(u), contacts held as they are."""
        amounts = self.amounts(phi)
        model = self.variants.of(amounts)
        if not keys or model is None:
            return {}
        others = side_by_side(lambda key: self._lacking(model, amounts, key), keys)
        found = {key: other for key, other in zip(keys, others, strict=True) if other is not None}
        if not found:
            return {}
        columns = inner_slopes(model.model, self.values(raw, amounts), list(found.values()))
        return {key: np.asarray(column) for key, column in zip(found, columns.T, strict=True)}

    def _lacking(self, model: Assembled, amounts: Amounts, key: str) -> Force | Beside | None:
        """The internal force per unit of an effect, where the model is, or the body beside it; None where neither says all."""
        way = self.ways[key]
        effect, numbers = self.effects[way.family], amounts.get(way.family, self.effects[way.family].null())
        if effect.is_law:
            law = LawAlong(effect, way.name, jax.tree.map(jnp.asarray, dict(numbers)))
            return of_law(model.model.body, law, numbers[way.name])
        if effect.first_order or numbers[way.name] == way.null:
            own = effect.force(model.model.body, model.finger, model.solid)
            if own is not None:
                return own
        return self.beside(model, amounts, key)

    def beside(self, model: Assembled, amounts: Amounts, key: str) -> Beside | None:
        """The body with a little more of an effect, or with less of it where more cannot be; None for one that does more than to change
        elements or receptors.
        """
        way, effect = self.ways[key], self.effects[self.ways[key].family]
        if not self.is_inner(key) or self.is_first_order(key):
            return None
        numbers = amounts.get(way.family, effect.null())
        at = numbers[way.name]
        step = way.step if way.step is not None and at == way.null and not effect.reshapes else BESIDE * way.scale
        for each in (step, -step):
            if way.lower <= at + each <= way.upper:
                other = self.variants.beside(model, amounts | {way.family: numbers | {way.name: at + each}}, each)
                if other is not None:
                    return other
        return None

    def rubs(self, amounts: Amounts) -> list[tuple[Effect, float]]:
        """Effects awake that are known to first order alone, and how much of each."""
        known = [(self.effects[name], numbers) for name, numbers in amounts.items() if self.effects[name].first_order]
        sizes = [(effect, float(numbers[effect.parameters[0].name])) for effect, numbers in known]
        return [(effect, size) for effect, size in sizes if size != 0.0]

    def _rubbed(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float]) -> np.ndarray:
        """What these add to every row."""
        amounts = self.amounts(phi)
        model = self.variants.of(amounts)
        return np.full(len(self.rows), np.nan) if model is None else first_order(model, self.values(raw, amounts), self.rubs(amounts))

    def _rubbed_slopes(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float], keys: list[str]) -> Float[np.ndarray, "rows d"]:
        """How that changes with the raw parameters and with other effects, by differences: a small part of a small part."""
        here = self._rubbed(raw, phi)
        theta = [(self._rubbed(raw + TURN * way, phi) - here) / TURN for way in np.eye(len(raw))]
        steps = [self.stepped(phi, key) for key in keys]
        return np.stack([*theta, *((self._rubbed(raw, there) - here) / step for there, step in steps)], axis=1)

    def stepped(self, phi: Mapping[str, float], key: str) -> tuple[dict[str, float], float]:
        """A small step of one effect that stays inside its bounds, and its length."""
        way = self.ways[key]
        at = phi.get(key, way.null)
        step = NEAR * way.scale if at + NEAR * way.scale <= way.upper else -NEAR * way.scale
        return {**phi, key: at + step}, step


def _ways(p: int, others: dict[str, Array], moved: list[str]) -> tuple[Array, dict[str, Array]]:
    """Unit directions, (p + k, p) in the raw parameters and (p + k,) in every other value; filled up with directions that lead nowhere,
    so that a search compiles the same code with one effect, with two, and with none.
    """
    count = -(-(p + len(moved)) // TOGETHER) * TOGETHER
    along = {name: jnp.zeros(count).at[p + moved.index(name)].set(1.0) if name in moved else jnp.zeros(count) for name in others}
    return jnp.eye(count, p), along


@eqx.filter_jit
def _predicted(solved: Solved, values: dict[str, Array]) -> Prediction:
    return solved.predict(values)


@eqx.filter_jit
def _sensitive(
    solved: Solved, parameters: tuple[Parameter, ...], raw: Array, others: dict[str, Array], ways: tuple[Array, dict[str, Array]]
) -> tuple[Array, Array, Array]:
    def read(raw: Array, others: dict[str, Array]) -> tuple[Array, Array]:
        values = {one.name: one.natural(raw[number]) for number, one in enumerate(parameters)} | others
        prediction = solved.predict(values)
        return jnp.concatenate(prediction.readings), prediction.health.converged

    value, along, sound = jax.linearize(read, raw, others, has_aux=True)
    return value, jax.vmap(along)(*ways), sound
