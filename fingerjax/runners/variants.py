"""The models of a study with effects in them, made when they are asked for."""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ..effects import Effect
from ..effects.added import Effects
from ..fem.solver import AbstractSolver, solver_for
from ..forward.inner import Beside, beside
from ..forward.model import Assembled, assemble, changed, lay_out

Amounts = dict[str, dict[str, Any]]  # effect -> its numbers
KEPT = 3  # models with an effect in them that are held at a time
ROUGH = 1.3  # how much larger the elements are on which a law is followed; and none of them is smaller under sharp indenters


class Variants:
    """A study's model, `base`, and others with amounts of effects in them. Elements are `size` times as large as the study's own.

    `compiled`: effects that are numbers in one compiled model; they are in all of them, asleep. `alike(rough, own)`: whether what is read
    on a coarser mesh is near enough to what is read on the model's own for laws to be followed there.
    """

    def __init__(
        self,
        ready: Assembled,
        effects: Mapping[str, Effect],
        solver: str,
        size: float,
        alike: Callable[[Assembled, Assembled], bool] = lambda rough, own: True,
    ):
        self.effects, self.solver, self.size, self.alike = effects, solver, size, alike
        self.compiled = tuple(effect for effect in effects.values() if effect.traced)
        self.base = self._laid_out(ready, "auto")
        self._made: OrderedDict[str, Assembled | None] = OrderedDict()
        self._rough: Assembled | None = None
        self._solvers: dict[tuple[int, bytes], AbstractSolver] = {}

    def of(self, amounts: Amounts) -> Assembled | None:
        """The model with these amounts of the effects that change it; None where they cannot be."""
        made = {name: numbers for name, numbers in self._linear(amounts).items() if numbers != self.effects[name].null()}
        if not made:
            return self.base
        key = repr(sorted((name, sorted(numbers.items())) for name, numbers in made.items()))
        if key not in self._made:
            while len(self._made) >= KEPT:
                self._made.popitem(last=False)
            try:
                self._made[key] = self._changed(self.base, self.together(made))
            except ValueError:
                self._made[key] = None
        self._made.move_to_end(key)
        return self._made[key]

    def rough(self, amounts: Amounts) -> Assembled | None:
        """The same on the mesh on which laws are followed: a coarser one, where there is one that has fewer nodes and reads alike."""
        if self._rough is None:
            self._rough = self._for_laws()
        if self._rough is self.base:
            return self.of(amounts)
        made = self._linear(amounts)
        try:
            return self._changed(self._rough, self.together(made)) if made else self._rough
        except ValueError:
            return None

    def _for_laws(self) -> Assembled:
        try:
            rough = assemble(self.base.study, solver=self.solver, size=ROUGH * self.size, focused=False)
        except ValueError:  # too coarse for a place on the skin to be found, or for a layer to be there
            return self.base
        if len(rough.mesh.nodes) >= len(self.base.mesh.nodes):
            return self.base
        rough = self._laid_out(rough, self.solver)
        return rough if self.alike(rough, self.base) else self.base

    def on(self, ready: Assembled, amounts: Amounts) -> Assembled:
        """The same on another mesh. **Raises** `ValueError` where the effects cannot be."""
        return self._changed(ready, self.together(amounts))

    def beside(self, model: Assembled, amounts: Amounts, step: float) -> Beside | None:
        """The body with these effects, a `step` away from a model's own; None where it cannot be, or has other skin or supports."""
        try:
            return beside(model, self.together({name: each for name, each in amounts.items() if not self.effects[name].traced}), step)
        except ValueError:
            return None

    def together(self, amounts: Amounts) -> Effects:
        """All compiled effects, and these amounts of those that make another model."""
        return Effects(self.compiled, tuple((self.effects[name], each) for name, each in amounts.items() if not self.effects[name].traced))

    def _linear(self, amounts: Amounts) -> Amounts:
        """Of these, what makes another linear model."""

        def makes(effect: Effect) -> bool:
            return not (effect.traced or effect.is_law or effect.first_order)

        return {name: each for name, each in amounts.items() if makes(self.effects[name])}

    def _laid_out(self, ready: Assembled, solver: str) -> Assembled:
        return lay_out(ready.study, ready.solid, ready.mesh, ready.model.wired, solver, Effects(self.compiled))

    def _changed(self, ready: Assembled, effects: Effects) -> Assembled:
        """A model with effects in it, and the solver of one that has the same nodes free where there was one."""
        made = changed(ready, effects)
        free = np.asarray(made.model.body.free)
        if np.array_equal(free, np.asarray(ready.model.body.free)):
            return made
        key = (len(free), free.tobytes())
        if key not in self._solvers:
            self._solvers = {key: solver_for(made.model.body, self.solver)}
        return dataclasses.replace(made, model=dataclasses.replace(made.model, solver=self._solvers[key]))
