"""A study as the loop sees it: its rows and conditions, the effects that may be missing, and what the finger would read with each."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..contact.chord import Chording
from ..effects import Effect
from ..effects.effect import Force
from ..errors import InputError
from ..fem.cholesky import Indefinite
from ..fem.tissue import Linear
from ..forward.inner import Beside, first_order, inner_slopes, of_law
from ..forward.model import Assembled, softened
from ..forward.readings import Prediction, Solved
from ..forward.shape import Tell, unheard
from ..forward.strained import Strained, strained_readings
from ..forward.strained_slopes import strained_slopes
from ..loop.subject import AbstractSubject, Evaluation, LogPrior
from ..parameters import Parameter
from ..study import Prior
from .families import agree, family
from .lawful import Lawful
from .rows import rows_of
from .variants import Amounts, Variants

DECADE = 0.5 * math.log(10.0)  # standard deviation of a modulus's logarithm about where the study begins: a factor of ten is two of them
BESIDE = 1e-5  # of an effect's plausible size: the step to another body; what differs then is computed exactly
NEAR = 0.02  # of an effect's plausible size: the step of a difference
TURN = 1e-5  # of a raw parameter: the step of a difference
LIKE = 0.1  # of a measurement's readings, root mean square, that a coarser mesh may be off by for laws to be followed on it
REMEMBERED = 3  # equilibria under a law, of all indentations each, that are held at a time
SEARCHED = Chording(tolerance=1e-6)  # far below what any noise or mesh leaves


class FingerSubject(AbstractSubject):
    """A study on its mesh, with elements `size` times as large as its own. `absent`: effect -> why the data cannot show it."""

    version = "1"

    def __init__(self, ready: Assembled, effects: tuple[Effect, ...], *, solver: str = "auto", size: float = 1.0, tell: Tell = unheard):
        study = ready.study
        self.study, self.solver, self.size, self.tell = study, solver, size, tell
        self.absent = {effect.name: why for effect in effects if (why := effect.absent(study.measurements) or effect.lacking(ready.mesh))}
        self.effects = {effect.name: effect for effect in effects if effect.name not in self.absent}
        self.name, self.kind = study.name, "measured"
        self._variants = Variants(ready, self.effects, solver, size, self._alike)
        self.parameters = self.base.problem().parameters
        self.priors = _priors(self.base, self.parameters)
        self.rows = rows_of(study)
        self.families = tuple(family(effect) for effect in self.effects.values())
        self._ways = {column.key: column for family in self.families for column in (*family.columns, *family.second)}
        self._fine: Assembled | None = None
        self._soft: Assembled | None = None
        self._left: tuple[np.ndarray, dict[str, np.ndarray]] | None = None
        self._last: dict[bool, tuple[Strained, dict[str, float]]] = {}
        self._added: dict[str, tuple[np.ndarray, Strained, Assembled] | None] = {}

    @property
    def base(self) -> Assembled:
        """The model without any effect awake."""
        return self._variants.base

    def evaluate(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float], moving: tuple[str, ...]) -> Evaluation:
        amounts = self._amounts(phi)
        inside, outside = ([key for key in moving if self._is_compiled(key) is here] for here in (True, False))
        if self._strained(amounts):
            return self._with_law(raw, phi, moving)
        found = self._linearised(self._variants.of(amounts), raw, amounts, tuple(inside))
        if found is None:
            return self._failed(len(raw), len(moving))
        value, slopes = found
        if rubs := self._rubs(amounts):
            value, slopes = value + self._rubbed(raw, phi), slopes + self._rubbed_slopes(raw, phi, inside)
        theta, compiled = slopes[:, : len(raw)], dict(zip(inside, slopes[:, len(raw) :].T, strict=True))
        made = self._inner_slopes(raw, phi, [key for key in outside if (self._is_first_order if rubs else self._is_inner)(key)])
        made |= {key: self._difference(raw, phi, key, value) for key in outside if key not in made}
        together = compiled | made
        columns = [together[key] for key in moving]
        return Evaluation(value, theta, np.stack(columns, axis=1) if columns else np.zeros((len(value), 0)))

    def glance(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float]) -> Evaluation | None:
        """Where the tissue follows a law, whose slopes ask for a factorisation in every indentation."""
        if not self._strained(self._amounts(phi)):
            return None
        value = self._value(raw, phi)
        return self._failed(0, 0) if value is None else Evaluation(value, np.zeros((len(value), 0)), np.zeros((len(value), 0)))

    def columns(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float] | None = None) -> Mapping[str, Float[np.ndarray, " rows"]]:
        """What every effect would leave at the null; with effects awake, what was found before: directions move little."""
        if self._left is None or (not phi and not np.array_equal(self._left[0], raw)):
            self._left = np.array(raw), self._columns(raw)
        return self._left[1]

    def _columns(self, raw: Float[np.ndarray, " p"]) -> dict[str, np.ndarray]:
        phi: dict[str, float] = {}
        amounts = self._amounts(phi)
        base: np.ndarray | None = None
        found: dict[str, np.ndarray] = {}
        smooth = [key for key, way in self._ways.items() if way.step is None and self._is_compiled(key)]
        for keys in self._together(smooth):
            linear = self._linearised(
                self._variants.of(amounts), raw, self._amounts(phi | dict.fromkeys(keys, 0.0), at_null=True), tuple(keys)
            )
            if linear is not None:
                base = linear[0]  # at their nulls effects change nothing
                found |= dict(zip(keys, linear[1][:, len(raw) :].T, strict=True))
        base = self._value(raw, phi) if base is None else base
        if base is None:
            raise InputError("the model has no answer at its own optimum", place=self.name, remedy="see the fit's own report")
        tangent_laws = [key for key, way in self._ways.items() if self._is_law(key) and way.step is None]
        found |= self._inner_slopes(raw, phi, [*filter(self._is_inner, self._ways), *tangent_laws])
        rest = [key for key in self._ways if key not in found]
        for number, key in enumerate(rest):
            self.tell(number / len(rest), f"what {self._ways[key].family} would leave")
            found[key] = self._secant(raw, phi, key, base)
        return found

    def finer(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float]) -> Float[np.ndarray, " rows"] | None:
        """With what a law adds on the finer mesh too: beside a small sphere that is far from converged on the mesh of a search."""
        amounts = self._amounts(phi)
        on = self._on_the_finer(amounts)
        fine = None if on is None else self._value_of(on, raw, self._lawless(amounts))
        if fine is None or not self._strained(amounts):
            return fine
        more = self._beyond(raw, amounts, finely=True) or self._beyond(raw, amounts)
        return None if more is None else fine + more[0]

    def softness(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float]) -> Float[np.ndarray, " rows"] | None:
        """Of the tissue without any law: what that adds is no larger where elements are softer."""
        if self._fine is None or self._soft is None:
            return None
        amounts = self._amounts({key: value for key, value in phi.items() if not self._is_law(key)})
        try:
            fine, soft = (self._value_of(self._variants.on(each, amounts), raw, amounts) for each in (self._fine, self._soft))
        except ValueError:  # an element turns over
            return None
        return None if fine is None or soft is None else (soft - fine) / 2

    def refine(self, fine: Assembled, refinement: float) -> None:
        """Give the subject a finer mesh to check itself against, with elements of `refinement` times the size, and softer ones on it."""
        self._fine, self._soft, self.refinement = fine, softened(fine), refinement

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
        found: dict[str, dict[str, Any]] = {}
        for key, value in phi.items():
            way = self._ways[key]
            number = way.null if at_null and key not in found and value == 0.0 else value
            found.setdefault(way.family, {}).update({way.name: float(number), **way.fixed})
        return {name: self.effects[name].null() | numbers for name, numbers in found.items()}

    def _is_law(self, key: str) -> bool:
        return self.effects[self._ways[key].family].is_law

    def _lawless(self, amounts: Amounts) -> Amounts:
        return {name: each for name, each in amounts.items() if not self.effects[name].is_law}

    def _strained(self, amounts: Amounts) -> bool:
        """Whether the tissue follows another law than Hooke's."""
        return any(self.effects[name].is_law and numbers != self.effects[name].null() for name, numbers in amounts.items())

    def _values(self, raw: Float[np.ndarray, " p"], amounts: Amounts) -> dict[str, Any]:
        numbers = {
            f"{name}.{number}": jnp.asarray(value)
            for name, each in amounts.items()
            if self.effects[name].traced  # the others have changed the model; their names here would have code compiled anew
            for number, value in each.items()
        }
        return {name: jnp.asarray(value) for name, value in self.named(raw).items()} | self._asleep() | numbers

    def _asleep(self) -> dict[str, Any]:
        return {
            f"{one.name}.{number}": jnp.asarray(float(value)) for one in self._variants.compiled for number, value in one.null().items()
        }

    def _linearised(
        self, model: Assembled | None, raw: Float[np.ndarray, " p"], amounts: Amounts, keys: tuple[str, ...]
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """The prediction (rows,), and its slopes (rows, p + k) in the raw parameters and in compiled effects."""
        if model is None:
            return None
        values = self._values(raw, amounts)
        moved = [f"{self._ways[key].family}.{self._ways[key].name}" for key in keys]
        try:
            solved = model.model.solved(values, moving=(*(one.name for one in self.parameters), *moved))
        except Indefinite:  # a support that gives too much holds nothing
            return None
        others = {name: value for name, value in values.items() if name not in {one.name for one in self.parameters}}
        ways = _ways(len(raw), others, moved)
        value, slopes, sound = _sensitive(solved, self.parameters, jnp.asarray(raw), others, ways)
        return (np.asarray(value), np.asarray(slopes).T) if bool(sound) and bool(jnp.all(jnp.isfinite(slopes))) else None

    def _value(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float]) -> np.ndarray | None:
        amounts = self._amounts(phi)
        return self._value_of(self._variants.of(amounts), raw, amounts)

    def _value_of(self, model: Assembled | None, raw: Float[np.ndarray, " p"], amounts: Amounts) -> np.ndarray | None:
        if model is None:
            return None
        linear = self._elastic(model, raw, amounts)
        if linear is not None and self._rubs(amounts):
            linear = linear + first_order(model, self._values(raw, amounts), self._rubs(amounts))
        if linear is None or not self._strained(amounts):
            return linear
        more = self._beyond(raw, amounts)
        return None if more is None else linear + more[0]

    def _elastic(self, model: Assembled, raw: Float[np.ndarray, " p"], amounts: Amounts) -> np.ndarray | None:
        values = self._values(raw, amounts)
        try:
            prediction = _predicted(model.model.solved(values), values)
        except Indefinite:
            return None
        value = np.concatenate([np.asarray(each) for each in prediction.readings])
        return value if bool(prediction.health.converged) and np.isfinite(value).all() else None

    def _alike(self, rough: Assembled, own: Assembled) -> bool:
        """Whether linear tissue reads nearly the same on both where the study begins: on a rough mesh a sphere may not even touch."""
        raw = np.array([one.raw() for one in self.parameters])
        there, here = (self._elastic(each, raw, {}) for each in (rough, own))
        if there is None or here is None:
            return False
        blocks = self.rows.blocks.values()
        return all(float(np.linalg.norm(there[rows] - here[rows])) <= LIKE * float(np.linalg.norm(here[rows])) for rows in blocks)

    def _beyond(
        self, raw: Float[np.ndarray, " p"], amounts: Amounts, *, finely: bool = False
    ) -> tuple[np.ndarray, Strained, Assembled] | None:
        """What a law of the tissue adds to every row, found on the mesh on which laws are followed or, `finely`, on the finer one.

        The last few are known: a search looks at two steps before it asks for the slopes at the better one.
        """
        key = repr((finely, raw.tolist(), sorted((name, sorted(numbers.items())) for name, numbers in amounts.items())))
        if key not in self._added:
            while len(self._added) >= REMEMBERED:
                self._added.pop(next(iter(self._added)))
            self._added[key] = self._followed(raw, amounts, finely)
        return self._added[key]

    def _on_the_finer(self, amounts: Amounts) -> Assembled | None:
        """The finer mesh with effects in it; None where there is none or an element turns over."""
        if self._fine is None:
            return None
        try:
            return self._variants.on(self._fine, self._lawless(amounts))
        except ValueError:
            return None

    def _followed(self, raw: Float[np.ndarray, " p"], amounts: Amounts, finely: bool) -> tuple[np.ndarray, Strained, Assembled] | None:
        """The same, looked for from where the last ones were found."""
        on = self._on_the_finer(amounts) if finely else self._variants.rough(amounts)
        linear, law = None if on is None else self._elastic(on, raw, amounts), self._variants.together(amounts).law(Linear())
        if on is None or linear is None:
            return None
        try:
            found = strained_readings(on.model, self._values(raw, amounts), law, start=self._start(raw, amounts, finely), chording=SEARCHED)
        except ValueError:
            return None
        if not bool(found.prediction.health.converged):
            return None
        self._last[finely] = found, self._numbered(raw, amounts)
        return np.concatenate([np.asarray(each) for each in found.prediction.readings]) - linear, found, on

    def _numbered(self, raw: Float[np.ndarray, " p"], amounts: Amounts) -> dict[str, float]:
        """Raw parameters and numbers of effects by name."""
        numbers = {f"{name}.{number}": float(value) for name, each in amounts.items() for number, value in each.items()}
        return {one.name: float(value) for one, value in zip(self.parameters, raw, strict=True)} | numbers

    def _start(self, raw: Float[np.ndarray, " p"], amounts: Amounts, finely: bool) -> Strained | None:
        """Where equilibria are expected: from where the last ones were, along their slopes where these are known."""
        if finely not in self._last:
            return None
        found, there = self._last[finely]
        here = self._numbered(raw, amounts)
        return found.after(np.array([here.get(name, value) - value for name, value in there.items()]))

    def _with_law(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float], moving: tuple[str, ...]) -> Evaluation:
        """The same for tissue of another law: the linear model's, and what the law adds, with slopes by the implicit rule; by differences
        in what moves an indenter or the receptor.
        """
        amounts, rest = self._amounts(phi), tuple(key for key in moving if not self._is_law(key))
        linear = self.evaluate(raw, {key: value for key, value in phi.items() if not self._is_law(key)}, rest)
        more = self._beyond(raw, amounts)
        if not linear.usable or more is None:
            return self._failed(len(raw), len(moving))
        added, found, rough = more
        own = {name: jax.tree.map(jnp.asarray, numbers) for name, numbers in amounts.items() if self.effects[name].is_law}
        numbers = [key for key in moving if self._is_law(key) or self._is_compiled(key)]
        bodies = {key: other for key in rest if (other := self._beside(rough, amounts, key)) is not None}
        name_of = {key: (self._ways[key].family, self._ways[key].name) for key in moving}
        moved = tuple(name_of[key] for key in numbers)
        of = Lawful(tuple(self.parameters), tuple(self.effects[name] for name in own), moved, self._values(raw, amounts), own)
        at = jnp.asarray([*raw, *(amounts[family][name] for family, name in moved)])
        rows, sloped = strained_slopes(rough.model, of, at, found, tuple(bodies.values()))
        there = self._linear_slopes(rough, raw, amounts, linear, rest, bodies)
        if there is None:
            return self._failed(len(raw), len(moving))
        sizes, keys = self._numbered(raw, amounts), [*numbers, *bodies]
        names = [*(one.name for one in self.parameters), *(".".join(name_of[key]) for key in keys)]
        self._last[False] = sloped, {name: sizes[name] for name in names}
        theta = linear.theta_jacobian + np.asarray(rows)[:, : len(raw)] - there[0]
        slopes, phis = dict(zip(keys, np.asarray(rows)[:, len(raw) :].T, strict=True)), dict(zip(rest, linear.phi_jacobian.T, strict=True))
        for key in rest:
            beyond = slopes[key] - there[1][key] if key in slopes else self._beyond_slope(raw, phi, key, added)
            slopes[key] = phis[key] + beyond
        columns = [slopes[key] for key in moving]
        return Evaluation(linear.prediction + added, theta, np.stack(columns, axis=1) if columns else np.zeros((len(added), 0)))

    def _linear_slopes(
        self,
        rough: Assembled,
        raw: Float[np.ndarray, " p"],
        amounts: Amounts,
        linear: Evaluation,
        keys: tuple[str, ...],
        bodies: Mapping[str, Beside],
    ) -> tuple[Float[np.ndarray, "rows p"], dict[str, Float[np.ndarray, " rows"]]] | None:
        """Those of the linear model on the mesh on which laws are followed, in the raw parameters, and in compiled effects and bodies."""
        if rough is self._variants.of(amounts) and not self._rubs(amounts):
            return linear.theta_jacobian, dict(zip(keys, linear.phi_jacobian.T, strict=True))
        compiled = [key for key in keys if self._is_compiled(key)]
        found = self._linearised(rough, raw, amounts, tuple(compiled))
        if found is None:
            return None
        theta, slopes = found[1][:, : len(raw)], dict(zip(compiled, found[1][:, len(raw) :].T, strict=True))
        if bodies:
            columns = np.asarray(inner_slopes(rough.model, self._values(raw, amounts), list(bodies.values())))
            slopes |= dict(zip(bodies, columns.T, strict=True))
        return theta, slopes

    def _beyond_slope(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float], key: str, here: np.ndarray) -> np.ndarray:
        """How what a law adds changes with another effect."""
        if self._is_first_order(key):
            return np.zeros(len(here))
        there, step = self._stepped(phi, key)
        more = self._beyond(raw, self._amounts(there))
        return np.full(len(here), np.nan) if more is None else (more[0] - here) / step

    def _is_inner(self, key: str) -> bool:
        """Whether an effect may be in the internal force, or in where a receptor is, so that one linear answer gives its slope."""
        effect = self.effects[self._ways[key].family]
        return effect.passive and not effect.traced

    def _is_first_order(self, key: str) -> bool:
        return self.effects[self._ways[key].family].first_order

    def _rubs(self, amounts: Amounts) -> list[tuple[Effect, float]]:
        """Effects awake that are known to first order alone, and how much of each."""
        known = [(self.effects[name], numbers) for name, numbers in amounts.items() if self.effects[name].first_order]
        sizes = [(effect, float(numbers[effect.parameters[0].name])) for effect, numbers in known]
        return [(effect, size) for effect, size in sizes if size != 0.0]

    def _rubbed(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float]) -> np.ndarray:
        """What these add to every row."""
        amounts = self._amounts(phi)
        model = self._variants.of(amounts)
        return np.full(len(self.rows), np.nan) if model is None else first_order(model, self._values(raw, amounts), self._rubs(amounts))

    def _rubbed_slopes(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float], keys: list[str]) -> Float[np.ndarray, "rows d"]:
        """How that changes with the raw parameters and with other effects, by differences: a small part of a small part."""
        here = self._rubbed(raw, phi)
        theta = [(self._rubbed(raw + TURN * way, phi) - here) / TURN for way in np.eye(len(raw))]
        steps = [self._stepped(phi, key) for key in keys]
        return np.stack([*theta, *((self._rubbed(raw, there) - here) / step for there, step in steps)], axis=1)

    def _inner_slopes(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float], keys: list[str]) -> dict[str, np.ndarray]:
        """Slopes of every row in effects that add an internal force f(u): - B' K^-1 f(u), contacts held as they are."""
        amounts = self._amounts(phi)
        model = self._variants.of(amounts)
        if not keys or model is None:
            return {}
        found = {key: other for key in keys if (other := self._lacking(model, amounts, key)) is not None}
        if not found:
            return {}
        columns = inner_slopes(model.model, self._values(raw, amounts), list(found.values()))
        return {key: np.asarray(column) for key, column in zip(found, columns.T, strict=True)}

    def _lacking(self, model: Assembled, amounts: Amounts, key: str) -> Force | Beside | None:
        """The internal force per unit of an effect, where the model is, or the body beside it; None where neither says all."""
        way = self._ways[key]
        effect, numbers = self.effects[way.family], amounts.get(way.family, self.effects[way.family].null())
        if effect.is_law:
            return of_law(model.model.body, lambda size: effect.law(Linear(), numbers | {way.name: size}), numbers[way.name])
        if effect.first_order or numbers[way.name] == way.null:
            own = effect.force(model.model.body, model.finger, model.solid)
            if own is not None:
                return own
        return self._beside(model, amounts, key)

    def _beside(self, model: Assembled, amounts: Amounts, key: str) -> Beside | None:
        """The body with a little more of an effect, or with less of it where more cannot be; None for one that does more than to change
        elements or receptors.
        """
        way, effect = self._ways[key], self.effects[self._ways[key].family]
        if not self._is_inner(key) or self._is_first_order(key):
            return None
        numbers = amounts.get(way.family, effect.null())
        at = numbers[way.name]
        step = way.step if way.step is not None and at == way.null and not effect.reshapes else BESIDE * way.scale
        for each in (step, -step):
            if way.lower <= at + each <= way.upper:
                other = self._variants.beside(model, amounts | {way.family: numbers | {way.name: at + each}}, each)
                if other is not None:
                    return other
        return None

    def _difference(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float], key: str, here: np.ndarray) -> np.ndarray:
        moved, step = self._stepped(phi, key)
        there = self._value(raw, moved)
        return np.full(len(here), np.nan) if there is None else (there - here) / step

    def _stepped(self, phi: Mapping[str, float], key: str) -> tuple[dict[str, float], float]:
        """A small step of one effect that stays inside its bounds, and its length."""
        way = self._ways[key]
        at = phi.get(key, way.null)
        step = NEAR * way.scale if at + NEAR * way.scale <= way.upper else -NEAR * way.scale
        return {**phi, key: at + step}, step

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
            fits = (group for group in groups if all(agree(way, self._ways[other]) for other in group))
            group = next(fits, None)
            if group is None:
                groups.append([key])
            else:
                group.append(key)
        return groups

    def _failed(self, p: int, k: int) -> Evaluation:
        n = len(self.rows)
        return Evaluation(np.full(n, np.nan), np.full((n, p), np.nan), np.full((n, k), np.nan), converged=False)


def _priors(ready: Assembled, parameters: tuple[Parameter, ...]) -> dict[str, Prior | LogPrior]:
    """What is known of a parameter, or of the one that it is an instance of; of a modulus at least that it is of the order of its start."""
    said, owner = ready.study.fit.priors, {}
    for one in parameters:
        name = one.name.split("[")[0]
        owner[one.name] = next((known for known in said if ready.model.wired.owner.get(known, known) == name), None)
    moduli = [one for one in parameters if one.name.split("[")[0].endswith(".modulus") and one.link == "log"]
    plain: dict[str, Prior | LogPrior] = {one.name: LogPrior(one.value, DECADE) for one in moduli}
    return plain | {name: said[known] for name, known in owner.items() if known is not None}


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
