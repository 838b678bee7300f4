"""A study as the loop sees it: its rows and conditions, the effects that may be missing, and what the finger would read with each."""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..effects import Effect
from ..effects.added import Effects
from ..effects.effect import Column as Way
from ..errors import InputError
from ..forward.model import Assembled, lay_out
from ..forward.readings import Prediction, Solved
from ..forward.shape import Tell, unheard
from ..loop.subject import AbstractSubject, Column, Evaluation, Family
from ..parameters import Parameter
from ..study import Prior, Study
from .rows import rows_of

Amounts = dict[str, dict[str, float]]  # effect -> its numbers
KEPT = 3  # models with an effect in them that are held at a time
NEAR = 0.02  # of an effect's plausible size: the step of a difference
REACH = 3.0  # plausible sizes from the null to the bounds


class FingerSubject(AbstractSubject):
    """A study on its mesh. `absent`: effect -> why the data cannot show it."""

    version = "1"

    def __init__(self, ready: Assembled, effects: tuple[Effect, ...], *, solver: str = "auto", tell: Tell = unheard):
        study = ready.study
        self.study, self.solver, self.tell = study, solver, tell
        self.absent = {effect.name: why for effect in effects if (why := effect.absent(study.measurements)) is not None}
        self.effects = {effect.name: effect for effect in effects if effect.name not in self.absent}
        self.compiled = tuple(effect for effect in self.effects.values() if effect.traced)
        self.name, self.kind = study.name, "measured"
        base = _with(ready, Effects(self.compiled))
        self.base = base
        self.parameters = base.problem().parameters
        self.priors = _priors(base, self.parameters)
        self.rows = rows_of(study)
        self.families = tuple(_family(effect) for effect in self.effects.values())
        self._ways = {column.key: column for family in self.families for column in (*family.columns, *family.second)}
        self._made: OrderedDict[str, Assembled | None] = OrderedDict()
        self._fine: Assembled | None = None

    def evaluate(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float], moving: tuple[str, ...]) -> Evaluation:
        amounts = self._amounts(phi)
        inside, outside = ([key for key in moving if self._is_compiled(key) is here] for here in (True, False))
        found = self._linearised(self._model(amounts), raw, amounts, tuple(inside))
        if found is None:
            return self._failed(len(raw), len(moving))
        value, slopes = found
        theta, compiled = slopes[:, : len(raw)], dict(zip(inside, slopes[:, len(raw) :].T, strict=True))
        made = {key: self._difference(raw, phi, key, value) for key in outside}
        together = compiled | made
        columns = [together[key] for key in moving]
        return Evaluation(value, theta, np.stack(columns, axis=1) if columns else np.zeros((len(value), 0)))

    def columns(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float] | None = None) -> Mapping[str, Float[np.ndarray, " rows"]]:
        phi = dict(phi or {})
        amounts = self._amounts(phi)
        base = self._value(raw, phi)
        if base is None:
            raise InputError("the model has no answer at its own optimum", place=self.name, remedy="see the fit's own report")
        found: dict[str, np.ndarray] = {}
        smooth = [key for key, way in self._ways.items() if way.step is None and self._is_compiled(key)]
        for keys in self._together(smooth):
            linear = self._linearised(self._model(amounts), raw, self._amounts(phi | dict.fromkeys(keys, 0.0), at_null=True), tuple(keys))
            if linear is not None:
                found |= dict(zip(keys, linear[1][:, len(raw) :].T, strict=True))
        rest = [key for key in self._ways if key not in found]
        for number, key in enumerate(rest):
            self.tell(number / len(rest), f"what {self._ways[key].family} would leave")
            found[key] = self._secant(raw, phi, key, base)
        return found

    def finer(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float]) -> Float[np.ndarray, " rows"] | None:
        if self._fine is None:
            return None
        return self._value_of(_with(self._fine, self._effects(self._amounts(phi)), self.solver), raw, self._amounts(phi))

    def refine(self, fine: Assembled) -> None:
        """Give the subject a finer mesh to check itself against."""
        self._fine = fine

    def account(self) -> Mapping[str, object]:
        fine = None if self._fine is None else len(self._fine.mesh.nodes)
        mesh = {"nodes": len(self.base.mesh.nodes), "h": self.study.finger.resolution.pad_mm, "finer_nodes": fine}
        return {"version": self.version, "mesh": mesh, "contact": {"penalty": None, "smoothing": None, "kind": "exact complementarity"}}

    def named(self, raw: Float[np.ndarray, " p"]) -> dict[str, float]:
        """Base parameters in their own units."""
        return {one.name: float(one.natural(each)) for one, each in zip(self.parameters, raw, strict=True)}

    def _is_compiled(self, key: str) -> bool:
        return self.effects[self._ways[key].family].traced

    def _amounts(self, phi: Mapping[str, float], *, at_null: bool = False) -> Amounts:
        found: Amounts = {}
        for key, value in phi.items():
            way = self._ways[key]
            number = way.null if at_null and key not in found and value == 0.0 else value
            found.setdefault(way.family, {}).update({way.name: float(number), **way.fixed})
        return {name: self.effects[name].null() | numbers for name, numbers in found.items()}

    def _effects(self, amounts: Amounts) -> Effects:
        made = tuple((self.effects[name], numbers) for name, numbers in amounts.items() if not self.effects[name].traced)
        return Effects(self.compiled, made)

    def _model(self, amounts: Amounts) -> Assembled | None:
        """The study's model with these amounts of the effects that change it; None where they cannot be."""
        made = {name: numbers for name, numbers in amounts.items() if not self.effects[name].traced}
        made = {name: numbers for name, numbers in made.items() if numbers != self.effects[name].null()}
        if not made:
            return self.base
        key = repr(sorted((name, sorted(numbers.items())) for name, numbers in made.items()))
        if key not in self._made:
            while len(self._made) >= KEPT:
                self._made.popitem(last=False)
            try:
                self._made[key] = _with(self.base, self._effects(made), self.solver)
            except ValueError:
                self._made[key] = None
        self._made.move_to_end(key)
        return self._made[key]

    def _values(self, raw: Float[np.ndarray, " p"], amounts: Amounts) -> dict[str, Any]:
        numbers = {f"{name}.{number}": jnp.asarray(value) for name, each in amounts.items() for number, value in each.items()}
        return {name: jnp.asarray(value) for name, value in self.named(raw).items()} | self._asleep() | numbers

    def _asleep(self) -> dict[str, Any]:
        return {f"{one.name}.{number}": jnp.asarray(float(value)) for one in self.compiled for number, value in one.null().items()}

    def _linearised(
        self, model: Assembled | None, raw: Float[np.ndarray, " p"], amounts: Amounts, keys: tuple[str, ...]
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """The prediction (rows,), and its slopes (rows, p + k) in the raw parameters and in compiled effects."""
        if model is None:
            return None
        values = self._values(raw, amounts)
        moved = [f"{self._ways[key].family}.{self._ways[key].name}" for key in keys]
        solved = model.model.solved(values, moving=(*(one.name for one in self.parameters), *moved))
        others = {name: value for name, value in values.items() if name not in {one.name for one in self.parameters}}
        ways = _ways(len(raw), others, moved)
        value, slopes, sound = _sensitive(solved, self.parameters, jnp.asarray(raw), others, ways)
        return (np.asarray(value), np.asarray(slopes).T) if bool(sound) and bool(jnp.all(jnp.isfinite(slopes))) else None

    def _value(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float]) -> np.ndarray | None:
        amounts = self._amounts(phi)
        model = self._model(amounts)
        return None if model is None else self._value_of(model, raw, amounts)

    def _value_of(self, model: Assembled, raw: Float[np.ndarray, " p"], amounts: Amounts) -> np.ndarray | None:
        values = self._values(raw, amounts)
        prediction = _predicted(model.model.solved(values), values)
        value = np.concatenate([np.asarray(each) for each in prediction.readings])
        return value if bool(prediction.health.converged) and np.isfinite(value).all() else None

    def _difference(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float], key: str, here: np.ndarray) -> np.ndarray:
        way = self._ways[key]
        step = NEAR * way.scale if phi.get(key, way.null) + NEAR * way.scale <= way.upper else -NEAR * way.scale
        there = self._value(raw, {**phi, key: phi.get(key, way.null) + step})
        return np.full(len(here), np.nan) if there is None else (there - here) / step

    def _secant(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float], key: str, here: np.ndarray) -> np.ndarray:
        way = self._ways[key]
        step = (way.step if way.step is not None else NEAR * way.scale) * (-1 if way.sign < 0 else 1)
        there = self._value(raw, {**phi, key: phi.get(key, way.null) + step})
        return np.zeros(len(here)) if there is None else (there - here) / step

    def _together(self, keys: list[str]) -> list[list[str]]:
        """Groups in which no effect stands at two points of its grid."""
        groups: list[list[str]] = []
        for key in keys:
            way = self._ways[key]
            fits = (group for group in groups if all(_agree(way, self._ways[other]) for other in group))
            group = next(fits, None)
            if group is None:
                groups.append([key])
            else:
                group.append(key)
        return groups

    def _failed(self, p: int, k: int) -> Evaluation:
        n = len(self.rows)
        return Evaluation(np.full(n, np.nan), np.full((n, p), np.nan), np.full((n, k), np.nan), converged=False)


def _agree(one: Column, other: Column) -> bool:
    return one.family != other.family or all(other.fixed.get(name, value) == value for name, value in one.fixed.items())


def _with(ready: Assembled, effects: Effects, solver: str = "auto") -> Assembled:
    return lay_out(ready.study, ready.solid, ready.mesh, ready.model.wired, solver, effects)


def _priors(ready: Assembled, parameters: tuple[Parameter, ...]) -> dict[str, Prior]:
    """What is known of a parameter, or of the one that it is an instance of."""
    said, owner = ready.study.fit.priors, {}
    for one in parameters:
        name = one.name.split("[")[0]
        owner[one.name] = next((known for known in said if ready.model.wired.owner.get(known, known) == name), None)
    return {name: said[known] for name, known in owner.items() if known is not None}


def _family(effect: Effect) -> Family:
    columns = tuple(_column(effect, way) for way in effect.columns())
    more = tuple(_column(effect, way) for way in effect.second())
    return Family(effect.name, columns, effect.acts_on, effect.leaves, effect.confused_with, more)


def _column(effect: Effect, way: Way) -> Column:
    size = way.size
    return Column(
        family=effect.name,
        name=size.name,
        unit=size.unit,
        scale=size.scale,
        lower=max(size.lower, size.null - REACH * size.scale),
        upper=min(size.upper, size.null + REACH * size.scale),
        null=size.null,
        sign=size.sign,
        step=size.step,
        fixed=dict(way.fixed),
    )


def _ways(p: int, others: dict[str, Array], moved: list[str]) -> tuple[Array, dict[str, Array]]:
    """Unit directions, (p + k, p) in the raw parameters and (p + k,) in every other value."""
    count = p + len(moved)
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


def at_size(study: Study, share: float) -> Study:
    """The study on a mesh whose elements are `share` times as large."""
    said = study.finger.resolution
    finer = said.model_copy(update={"pad_mm": share * said.pad_mm, "proximal_mm": share * said.proximal_mm})
    return dataclasses.replace(study, finger=study.finger.model_copy(update={"resolution": finer}))
