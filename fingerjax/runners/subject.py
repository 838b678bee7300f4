"""A study as the loop sees it: its rows and conditions, the effects that may be missing, and what the finger would read with each."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from ..effects import Effect
from ..errors import InputError
from ..forward.model import Assembled, softened
from ..forward.shape import Tell, unheard
from ..loop.subject import AbstractSubject, Evaluation, LogPrior
from ..parameters import Parameter
from ..side_by_side import side_by_side
from ..study import Prior
from .beyond import Beyond
from .elastic import NEAR, ElasticFinger
from .families import agree
from .variants import Amounts

DECADE = 0.5 * math.log(10.0)  # standard deviation of a modulus's logarithm about where the study begins: a factor of ten is two of them


class FingerSubject(AbstractSubject):
    """A study on its mesh, with elements `size` times as large as its own. `absent`: effect -> why the data cannot show it."""

    version = "1"

    def __init__(self, ready: Assembled, effects: tuple[Effect, ...], *, solver: str = "auto", size: float = 1.0, tell: Tell = unheard):
        study = ready.study
        self.study, self.solver, self.size, self.tell = study, solver, size, tell
        self.absent = {effect.name: why for effect in effects if (why := effect.absent(study.measurements) or effect.lacking(ready.mesh))}
        self.effects = {effect.name: effect for effect in effects if effect.name not in self.absent}
        self.name, self.kind = study.name, "measured"
        self.elastic = ElasticFinger(ready, self.effects, solver, size)
        self.parameters, self.rows, self.families = self.elastic.parameters, self.elastic.rows, self.elastic.families
        self.priors = _priors(self.base, self.parameters)
        self._fine: Assembled | None = None
        self._soft: Assembled | None = None
        self._finely: tuple[np.ndarray, Amounts, np.ndarray | None, np.ndarray | None] | None = None
        self._left: tuple[np.ndarray, dict[str, np.ndarray]] | None = None
        self._beyond = Beyond(self.elastic, self._on_the_finer)

    @property
    def base(self) -> Assembled:
        """The model without any effect awake."""
        return self.elastic.base

    def evaluate(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float], moving: tuple[str, ...]) -> Evaluation:
        """With the slope of a law of the tissue at its null too: a search that comes there must see the way back."""
        lawful = self.elastic.is_strained(self.elastic.amounts(phi)) or any(map(self.elastic.is_law, moving))
        return (self._beyond if lawful else self.elastic).evaluate(raw, phi, moving)

    def glance(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float]) -> Evaluation | None:
        """Where the tissue follows a law, whose slopes ask for a factorisation in every indentation."""
        if not self.elastic.is_strained(self.elastic.amounts(phi)):
            return None
        value = self._value(raw, phi)
        return self.elastic.failed(0, 0) if value is None else Evaluation(value, np.zeros((len(value), 0)), np.zeros((len(value), 0)))

    def columns(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float] | None = None) -> Mapping[str, Float[np.ndarray, " rows"]]:
        """What every effect would leave at the null; with effects awake, what was found before: directions move little."""
        if self._left is None or (not phi and not np.array_equal(self._left[0], raw)):
            self._left = np.array(raw), self._columns(raw)
        return self._left[1]

    def _columns(self, raw: Float[np.ndarray, " p"]) -> dict[str, np.ndarray]:
        phi: dict[str, float] = {}
        amounts = self.elastic.amounts(phi)
        base: np.ndarray | None = None
        found: dict[str, np.ndarray] = {}
        smooth = [key for key, way in self.elastic.ways.items() if way.step is None and self.elastic.is_compiled(key)]
        for keys in self._together(smooth):
            linear = self.elastic.linearised(
                self.elastic.variants.of(amounts), raw, self.elastic.amounts(phi | dict.fromkeys(keys, 0.0), at_null=True), tuple(keys)
            )
            if linear is not None:
                base = linear[0]  # at their nulls effects change nothing
                found |= dict(zip(keys, linear[1][:, len(raw) :].T, strict=True))
        base = self._value(raw, phi) if base is None else base
        if base is None:
            raise InputError("the model has no answer at its own optimum", place=self.name, remedy="see the fit's own report")
        inner = [key for key in self.elastic.ways if self.elastic.is_inner(key) and not self.elastic.is_secant(key)]
        tangent_laws = [key for key, way in self.elastic.ways.items() if self.elastic.is_law(key) and way.step is None]
        found |= self.elastic.inner_slopes(raw, phi, [*inner, *tangent_laws])
        rest = [key for key in self.elastic.ways if key not in found]
        for number, key in enumerate(rest):
            self.tell(number / len(rest), f"what {self.elastic.ways[key].family} would leave")
            found[key] = self._secant(raw, phi, key, base)
        return found

    def finer(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float]) -> Float[np.ndarray, " rows"] | None:
        """With what a law adds on the finer mesh too: beside a small sphere that is far from converged on the mesh of a search."""
        amounts = self.elastic.amounts(phi)
        lawless = self.elastic.lawless(amounts)
        on, soft = self._laid(self._fine, lawless), self._laid(self._soft, lawless)
        if on is None:
            return None
        fine = self._both(on, soft, raw, lawless)
        if fine is not None and self.elastic.is_strained(amounts):
            more = self._beyond.on_the_finer(raw, amounts)
            fine = None if more is None else fine + more
        on.model.solver.forget()
        return fine

    def softness(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float]) -> Float[np.ndarray, " rows"] | None:
        """Of the tissue without any law: what that adds is no larger where elements are softer."""
        phi = {key: value for key, value in phi.items() if not self.elastic.is_law(key)}
        if not self._was_asked(raw, self.elastic.amounts(phi)) and self.finer(raw, phi) is None:
            return None
        fine, soft = self._finely[2:] if self._finely is not None else (None, None)
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
        return self.elastic.named(raw)

    def _value(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float]) -> np.ndarray | None:
        amounts = self.elastic.amounts(phi)
        value = self.elastic.value(self.elastic.variants.of(amounts), raw, amounts)
        if value is None or not self.elastic.is_strained(amounts):
            return value
        more = self._beyond.added(raw, amounts)
        return None if more is None else value + more[0]

    def _both(self, fine: Assembled, soft: Assembled | None, raw: Float[np.ndarray, " p"], amounts: Amounts) -> np.ndarray | None:
        """What is read on the finer mesh; that is remembered, with what softer elements of it read at the same time."""
        there = [fine] if soft is None else [fine, soft]
        of_one = soft is None or soft.model.solver is fine.model.solver
        values = side_by_side(lambda on: self.elastic.value(on, raw, amounts), there, 1 if of_one else None)
        self._finely = np.array(raw), amounts, values[0], None if soft is None else values[1]
        if soft is not None:
            soft.model.solver.forget()
        return values[0]

    def _was_asked(self, raw: Float[np.ndarray, " p"], amounts: Amounts) -> bool:
        """Whether the finer mesh was asked for this last."""
        return self._finely is not None and np.array_equal(self._finely[0], raw) and self._finely[1] == amounts

    def _laid(self, ready: Assembled | None, amounts: Amounts) -> Assembled | None:
        """One of the finer meshes with effects in it; None where there is none or an element turns over."""
        if ready is None:
            return None
        try:
            return self.elastic.variants.on(ready, amounts)
        except ValueError:
            return None

    def _on_the_finer(self, amounts: Amounts) -> Assembled | None:
        return self._laid(self._fine, self.elastic.lawless(amounts))

    def _secant(self, raw: Float[np.ndarray, " p"], phi: Mapping[str, float], key: str, here: np.ndarray) -> np.ndarray:
        way = self.elastic.ways[key]
        step = (way.step if way.step is not None else NEAR * way.scale) * (-1 if way.sign < 0 else 1)
        there = self._value(raw, {**phi, key: phi.get(key, way.null) + step})
        return np.zeros(len(here)) if there is None else (there - here) / step

    def _together(self, keys: list[str]) -> list[list[str]]:
        """Groups in which no effect stands at two points of its grid."""
        groups: list[list[str]] = []
        for key in keys:
            way = self.elastic.ways[key]
            fits = (group for group in groups if all(agree(way, self.elastic.ways[other]) for other in group))
            group = next(fits, None)
            if group is None:
                groups.append([key])
            else:
                group.append(key)
        return groups


def _priors(ready: Assembled, parameters: tuple[Parameter, ...]) -> dict[str, Prior | LogPrior]:
    """What is known of a parameter, or of the one that it is an instance of; of a modulus at least that it is of the order of its start."""
    said, owner = ready.study.fit.priors, {}
    for one in parameters:
        name = one.name.split("[")[0]
        owner[one.name] = next((known for known in said if ready.model.wired.owner.get(known, known) == name), None)
    moduli = [one for one in parameters if one.name.split("[")[0].endswith(".modulus") and one.link == "log"]
    plain: dict[str, Prior | LogPrior] = {one.name: LogPrior(one.value, DECADE) for one in moduli}
    return plain | {name: said[known] for name, known in owner.items() if known is not None}
