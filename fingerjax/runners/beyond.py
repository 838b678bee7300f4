"""What a law of the tissue adds to the linear model's readings, and how that changes: followed on a mesh of its own, and remembered."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..contact.chord import Chording, Chords
from ..fem.tissue import Linear
from ..forward.inner import Beside, inner_slopes
from ..forward.model import Assembled
from ..forward.strained import Strained, strained_readings
from ..forward.strained_slopes import strained_slopes
from ..loop.subject import Evaluation
from .elastic import ElasticFinger
from .lawful import Lawful
from .variants import Amounts

REMEMBERED = 3  # equilibria under a law, of all indentations each, that are held at a time
LIKE_BEFORE = 0.2  # change of what a law adds to any measurement, within which the finer mesh is not asked anew
SEARCHED = Chording(tolerance=1e-6)  # far below what any noise or mesh leaves


class Beyond:
    """`finer(amounts)`: the finer mesh with effects in it; None where there is none."""

    def __init__(self, elastic: ElasticFinger, finer: Callable[[Amounts], Assembled | None]):
        self.elastic, self._finer = elastic, finer
        self._chords = {False: Chords(), True: Chords(room=0)}
        self._last: dict[bool, tuple[Strained, dict[str, float]]] = {}
        self._added: dict[str, tuple[np.ndarray, Strained, Assembled] | None] = {}
        self._more: tuple[frozenset[str], np.ndarray, np.ndarray] | None = None  # laws, what they added, and what the finer mesh adds to it

    def added(
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

    def on_the_finer(self, raw: Float[np.ndarray, " p"], amounts: Amounts) -> Float[np.ndarray, " rows"] | None:
        """What a law adds to every row on the finer mesh; on the mesh on which laws are followed where there is no answer there.

        Where it adds nearly what it added when the finer mesh was last asked, what that adds to it has grown in proportion: a correction of
        a tenth or so is known well enough from so near, and asking costs as much as a search.
        """
        here = self.added(raw, amounts)
        laws = frozenset(name for name in amounts if self.elastic.effects[name].is_law)
        if here is not None and (more := self._in_proportion(here[0], laws)) is not None:
            return here[0] + more
        finely = self.added(raw, amounts, finely=True)
        if finely is None or here is None:
            return None if (known := finely or here) is None else known[0]
        self._more = laws, here[0], finely[0] - here[0]
        return finely[0]

    def _in_proportion(self, added: Float[np.ndarray, " rows"], laws: frozenset[str]) -> Float[np.ndarray, " rows"] | None:
        """What the finer mesh adds more than this; None where it was not asked for these laws, or for something else."""
        if self._more is None or self._more[0] != laws:
            return None
        _, before, more = self._more
        more = more.copy()
        for where in self.elastic.rows.blocks.values():
            size = float(np.linalg.norm(before[where]))
            if np.linalg.norm(added[where] - before[where]) > LIKE_BEFORE * size:
                return None
            more[where] *= np.linalg.norm(added[where]) / size if size > 0 else 1.0
        return more

    def _followed(self, raw: Float[np.ndarray, " p"], amounts: Amounts, finely: bool) -> tuple[np.ndarray, Strained, Assembled] | None:
        """The same, looked for from where the last ones were found."""
        on = self._finer(amounts) if finely else self.elastic.variants.rough(amounts)
        linear, law = None if on is None else self.elastic.read(on, raw, amounts), self.elastic.variants.together(amounts).law(Linear())
        if on is None or linear is None:
            return None
        try:
            found = strained_readings(
                on.model,
                self.elastic.values(raw, amounts),
                law,
                start=self._start(raw, amounts, finely),
                chording=SEARCHED,
                chords=self._chords[finely],
            )
        except ValueError:
            return None
        if not bool(found.prediction.health.converged):
            return None
        self._last[finely] = self._still_sloped(found, self._numbered(raw, amounts), finely)
        return np.concatenate([np.asarray(each) for each in found.prediction.readings]) - linear, found, on

    def _still_sloped(self, found: Strained, numbers: dict[str, float], finely: bool) -> tuple[Strained, dict[str, float]]:
        """New equilibria with the slopes of the last ones, where there are any: good enough to tell where the next can be expected."""
        last = self._last.get(finely)
        if last is None or last[0].slopes is None or not set(last[1]) <= set(numbers) or _sizes(last[0]) != _sizes(found):
            return found, numbers
        return dataclasses.replace(found, slopes=last[0].slopes), {name: numbers[name] for name in last[1]}

    def _numbered(self, raw: Float[np.ndarray, " p"], amounts: Amounts) -> dict[str, float]:
        """Raw parameters and numbers of effects by name."""
        numbers = {f"{name}.{number}": float(value) for name, each in amounts.items() for number, value in each.items()}
        return {one.name: float(value) for one, value in zip(self.elastic.parameters, raw, strict=True)} | numbers

    def _start(self, raw: Float[np.ndarray, " p"], amounts: Amounts, finely: bool) -> Strained | None:
        """Where equilibria are expected: from where the last ones were, along their slopes where these are known."""
        if finely not in self._last:
            return None
        found, there = self._last[finely]
        here = self._numbered(raw, amounts)
        return found.after(np.array([here.get(name, value) - value for name, value in there.items()]))

    def evaluate(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float], moving: tuple[str, ...]) -> Evaluation:
        """Every row with what the law adds, and its slopes: by the implicit rule, by differences in what moves an indenter."""
        amounts, rest = self.elastic.amounts(phi), tuple(key for key in moving if not self.elastic.is_law(key))
        linear = self.elastic.evaluate(raw, {key: value for key, value in phi.items() if not self.elastic.is_law(key)}, rest)
        more = self.added(raw, amounts)
        if not linear.usable or more is None:
            return self.elastic.failed(len(raw), len(moving))
        added, found, rough = more
        own = {name: jax.tree.map(jnp.asarray, numbers) for name, numbers in amounts.items() if self.elastic.effects[name].is_law}
        numbers = [key for key in moving if self.elastic.is_law(key) or self.elastic.is_compiled(key)]
        bodies = {key: other for key in rest if (other := self.elastic.beside(rough, amounts, key)) is not None}
        name_of = {key: (self.elastic.ways[key].family, self.elastic.ways[key].name) for key in moving}
        moved = tuple(name_of[key] for key in numbers)
        of = Lawful(
            tuple(self.elastic.parameters), tuple(self.elastic.effects[name] for name in own), moved, self.elastic.values(raw, amounts), own
        )
        at = jnp.asarray([*raw, *(amounts[family][name] for family, name in moved)])
        rows, sloped = strained_slopes(rough.model, of, at, found, tuple(bodies.values()), self._chords[False])
        there = self._linear_slopes(rough, raw, amounts, linear, rest, bodies)
        if there is None:
            return self.elastic.failed(len(raw), len(moving))
        sizes, keys = self._numbered(raw, amounts), [*numbers, *bodies]
        names = [*(one.name for one in self.elastic.parameters), *(".".join(name_of[key]) for key in keys)]
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
        if rough is self.elastic.variants.of(amounts) and not self.elastic.rubs(amounts):
            return linear.theta_jacobian, dict(zip(keys, linear.phi_jacobian.T, strict=True))
        compiled = [key for key in keys if self.elastic.is_compiled(key)]
        found = self.elastic.linearised(rough, raw, amounts, tuple(compiled))
        if found is None:
            return None
        theta, slopes = found[1][:, : len(raw)], dict(zip(compiled, found[1][:, len(raw) :].T, strict=True))
        if bodies:
            columns = np.asarray(inner_slopes(rough.model, self.elastic.values(raw, amounts), list(bodies.values())))
            slopes |= dict(zip(bodies, columns.T, strict=True))
        return theta, slopes

    def _beyond_slope(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float], key: str, here: np.ndarray) -> np.ndarray:
        """How what a law adds changes with another effect."""
        if self.elastic.is_first_order(key):
            return np.zeros(len(here))
        there, step = self.elastic.stepped(phi, key)
        more = self.added(raw, self.elastic.amounts(there))
        return np.full(len(here), np.nan) if more is None else (more[0] - here) / step


def _sizes(found: Strained) -> list[list[int | None]]:
    return [[None if ended.rest is None else ended.rest.displacement.size for ended in rig] for rig in found.cases]
