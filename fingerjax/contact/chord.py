"""Press a rigid indenter into tissue of any law with a stiffness that is kept: one factorisation, then iterations that cost two solves.

Whatever the stiffness K that answers, an equilibrium is where its own answer leaves it,

    v = u - K^-1 f(u),     contact of C = B' K^-1 B with the free surface B'v -> l,     G(u) = v + K^-1 B l = u,

and contact is decided exactly at every iteration, as in `strained`. The last few iterates are mixed (Anderson, 1965) so that their steps
g = G(u) - u = K^-1 r, r = B l - f(u), add up to as little as they can in the norm of K, whose products g_i'K g_j = g_i'r_j are at hand.
On an active set that stays this is GMRES for the tangent, preconditioned by K (Walker & Ni, 2011): a tangent that is a few times as stiff
in places costs some iterations more, not the answer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._results import RESULTS
from ..fem.body import Body
from ..fem.carried import admissible
from ..fem.cholesky import Indefinite
from ..fem.columns import Columns
from ..fem.condensed import AbstractCondensed
from ..fem.energy import energy_and_force
from ..fem.equilibrium import Tissue
from ..fem.stiffness import tangent
from .footprint import Interface
from .indentation import Contact, press

ENOUGH = 1e-4  # share of the promised fall of the energy that a shortened step must bring
SLACK = 1e-9  # share of the energy below which a rise is rounding
SHORTEST = 2.0**-6  # share of a step below which it is given up
WORSE = 1.5  # growth of the step's norm at which a mixture is not believed
BEYOND = 1e100  # N: forces from which on sums of their squares are no longer numbers
ROOM = 1_500_000_000  # bytes of factorisations that are kept between searches
ALIKE = 1e-12  # combinations of steps whose product is less than this share of the largest are none


class Imposed(NamedTuple):
    """A travel, mm, or a force, N; the other is None. `series`: mm/N that the apparatus gives way, as part of the travel."""

    travel: float | None
    force: float | None
    series: float = 0.0


class Place:
    """Where an indenter meets the skin: `columns`, the y-displacements on which `interface.load` acts, and `sharp`, mm^2/N, by which skin
    gives way under the tip of a line (`line.sharp_compliance`). Lives outside of compiled code.
    """

    def __init__(self, columns: Columns, interface: Interface, sharp: float = 0.0):
        self.columns, self.interface, self.sharp = columns, interface, sharp
        self.matrix = columns.matrix()

    def overlapped(self, imposed: Imposed) -> Array:
        """The hats (k,) that undeformed skin would have inside the indenter; all of them under a force."""
        present = self.interface.area > 0
        return present if imposed.travel is None else present & (self.interface.overlap + imposed.travel * self.interface.area > 0)


class Chord:
    """A stiffness that is kept: a condensed body, and which of its columns, `own` (p,), a place's are. Lives outside of compiled code."""

    def __init__(self, condensed: AbstractCondensed, own: np.ndarray):
        self.condensed, self.own = condensed, own
        self.compliance = condensed.held.matrix[np.ix_(own, own)]

    @classmethod
    def of(cls, condensed: Callable[[], AbstractCondensed], own: np.ndarray) -> Chord | None:
        """That of a body which is condensed when it is asked for; None where its solves did not converge."""
        found = condensed()
        return cls(found, own) if found.held.converged else None

    def __call__(self, load: np.ndarray) -> np.ndarray:
        """Displacement (3n,), mm, under nodal forces (3n,), N."""
        return np.asarray(self.condensed.answer(jnp.asarray(load.reshape(1, -1, 3)))).ravel()


class Chords:
    """Chords of cases, counted through all rigs, kept from one search to the next: of the first so many as there is `room` for, in bytes.

    Which are kept does not depend on who comes first, so that cases may be looked for side by side.
    """

    def __init__(self, room: int = ROOM):
        self.room = room
        self._kept: dict[int, tuple[Body, Columns, Chord]] = {}

    def find(self, case: int, body: Body, place: Place) -> Chord | None:
        """The one of a case, if it was made for a body that may move in the same ways and is pressed at the same nodes."""
        if case not in self._kept:
            return None
        other, columns, chord = self._kept[case]
        now, then = ((one.free, one.modes, pressed.node, pressed.weight) for one, pressed in ((body, place.columns), (other, columns)))
        return chord if all(map(np.array_equal, now, then)) else None

    def drop(self, case: int) -> None:
        """Let go of the one of a case, before another is made for it: its analysis serves that one too."""
        self._kept.pop(case, None)

    def keep(self, case: int, body: Body, place: Place, chord: Chord) -> None:
        self.drop(case)
        if 0 < (case + 1) * chord.condensed.memory <= self.room:
            self._kept[case] = body, place.columns, chord


def tangent_chord(tissue: Tissue, place: Place, u: np.ndarray) -> Chord | None:
    """The tangent at a displacement (3n,), mm, as the stiffness to keep; None where it is not positive definite."""
    try:
        there = tangent(tissue.body, tissue.law, tissue.lame, jnp.asarray(u).reshape(-1, 3))
        condensed = tissue.solver.reduce(there, place.columns)
    except Indefinite:
        return None
    return Chord.of(lambda: condensed, np.arange(place.columns.count))


class Chording(eqx.Module):
    """How an equilibrium is looked for with a stiffness that is kept.

    - `tolerance`: on the norm of the force left over relative to the load's, and on the gap left open relative to the travel.
    - `depth`: iterates that are mixed. `iterations`: more than these with one stiffness, and the search ends.
    - `worth`: iterations that another factorisation is worth; where more are expected, `slow` is said.
    """

    tolerance: float = eqx.field(static=True, default=1e-8)
    depth: int = eqx.field(static=True, default=8)
    iterations: int = eqx.field(static=True, default=60)
    worth: float = eqx.field(static=True, default=20.0)


class Resting(NamedTuple):
    """Tissue under an indenter, and how well it rests.

    - `displacement`, `load` (3n,): mm, and N of the contact. `residual`: force left over; `opening`: error of the gap, mm per mm of travel.
    """

    displacement: np.ndarray
    load: np.ndarray
    contact: Contact
    energy: float
    residual: float
    opening: float

    @property
    def error(self) -> float:
        return max(self.residual, self.opening)


class _Iterate(NamedTuple):
    rest: Resting
    step: np.ndarray
    left: np.ndarray
    size: float
    active: bytes


class Searched(NamedTuple):
    """The best state seen, None where there is none; how many iterations it took; and whether it rests, is slow or lost."""

    rest: Resting | None
    iterations: int
    result: RESULTS
    slow: bool


class Search:
    """The search for one equilibrium with one stiffness."""

    def __init__(self, tissue: Tissue, place: Place, chord: Chord, imposed: Imposed, chording: Chording):
        self.tissue, self.place, self.chord, self.imposed, self.chording = tissue, place, chord, imposed, chording

    def run(self, u: np.ndarray, active: Array, patient: bool = False) -> Searched:
        """From a displacement (3n,), mm, and the active set of a neighbour; a `patient` search goes on where a tangent would be quicker.

        What the body cannot do of the displacement, as one that comes from other supports or another bone may ask, is left out.
        """
        at, chording = self._look(np.asarray(_admissible(self.tissue, jnp.asarray(u)[None])).ravel(), active), self.chording
        if at is None:
            return Searched(None, 1, RESULTS.no_equilibrium, False)
        past, errors = [at], [at.rest.error]
        for iteration in range(1, chording.iterations):
            if errors[-1] <= chording.tolerance:
                return Searched(at.rest, iteration, RESULTS.successful, False)
            if not patient and self._slow(errors):
                return Searched(at.rest, iteration, RESULTS.no_equilibrium, True)
            new = self._look(_mixed(past), at.rest.contact.active)
            if new is None or (iteration > 1 and new.size > WORSE * at.size):
                new = self._shortened(at, whole=iteration == 1)
                past = []
            if new is None:
                return Searched(at.rest, iteration, RESULTS.no_equilibrium, False)
            at = new
            past = [*[each for each in past if each.active == at.active][1 - chording.depth :], at]
            errors.append(at.rest.error)
        return Searched(at.rest, chording.iterations, RESULTS.no_equilibrium, True)

    def _slow(self, errors: list[float]) -> bool:
        """Whether more iterations are to be expected than a factorisation is worth, by the last few; the first ones are not asked."""
        if len(errors) < 4:
            return False
        back = min(len(errors) - 2, 3)
        rate = (errors[-1] / errors[-1 - back]) ** (1 / back)
        return bool(rate >= 1.0 or np.log(self.chording.tolerance / errors[-1]) / np.log(rate) > self.chording.worth)

    def _look(self, u: np.ndarray, active: Array) -> _Iterate | None:
        """The chord's answer at a displacement; None where the tissue's law does not hold."""
        energy, force = self._measured(u)
        if not np.isfinite(energy) or not np.all(np.abs(force) < BEYOND):
            return None
        v = u - self.chord(force)
        free, moved = (jnp.asarray(self.place.matrix.T @ each) for each in (v, u))
        gives = jnp.asarray(self.imposed.series, float), jnp.asarray(self.place.sharp, float)
        said = _number(self.imposed.travel), _number(self.imposed.force), *gives
        contact, opening = _touching(self.chord.compliance, self.place.interface, free, moved, active, *said)
        if not bool(contact.settled):
            return None
        load = self.place.matrix @ np.asarray(contact.nodal_forces)
        step, left = v + self.chord(load) - u, load - force
        rest = Resting(u, load, contact, energy, self._residual(load, left), float(opening))
        return _Iterate(rest, step, left, float(np.sqrt(max(step @ left, 0.0))), np.asarray(contact.active).tobytes())

    def _measured(self, u: np.ndarray) -> tuple[float, np.ndarray]:
        energy, force = _energy_and_force(self.tissue, jnp.asarray(u).reshape(-1, 3))
        return float(energy), np.asarray(force).ravel()

    def _residual(self, load: np.ndarray, left: np.ndarray) -> float:
        left, load = np.asarray(_admissible(self.tissue, jnp.asarray(np.stack([left, load]))))
        size = float(np.linalg.norm(load))
        return float(np.linalg.norm(left)) / (size if size > 0 else 1.0)

    def _shortened(self, at: _Iterate, whole: bool) -> _Iterate | None:
        """A part of the way to the chord's own answer, at which the energy has fallen enough; the `whole` of it where a travel is new."""
        rest, share = at.rest, 1.0
        while share >= (1.0 if whole else SHORTEST):
            energy, _ = self._measured(rest.displacement + share * at.step)
            fall = energy - rest.energy - share * float(rest.load @ at.step)
            if np.isfinite(energy) and (whole or fall <= -ENOUGH * share * at.size**2 + SLACK * abs(energy)):
                return self._look(rest.displacement + share * at.step, rest.contact.active)
            share /= 2
        return None


def _number(value: float | None) -> Array | None:
    return None if value is None else jnp.asarray(value, float)


@eqx.filter_jit
def _energy_and_force(tissue: Tissue, u: Float[Array, "nodes 3"]) -> tuple[Float[Array, ""], Float[Array, "nodes 3"]]:
    return energy_and_force(tissue.body, tissue.law, tissue.lame, u)


@eqx.filter_jit
def _admissible(tissue: Tissue, forces: Float[Array, "m _"]) -> Float[Array, "m nodes 3"]:
    return jax.vmap(lambda force: admissible(tissue.body, force.reshape(-1, 3)))(forces)


@eqx.filter_jit
def _touching(
    C: Float[Array, "p p"],
    interface: Interface,
    free: Float[Array, " p"],
    moved: Float[Array, " p"],
    active: Array,
    travel: Float[Array, ""] | None,
    force: Float[Array, ""] | None,
    series: Float[Array, ""],
    sharp: Float[Array, ""],
) -> tuple[Contact, Float[Array, ""]]:
    """The contact of compliance C, mm/N, with a free surface, and how far the gaps over the skin where it is now are from its own."""
    shifted = eqx.tree_at(lambda part: part.overlap, interface, interface.overlap - interface.load.T @ free)
    contact = press(C, shifted, travel=travel, force=force, start=active, series=series, sharp=sharp)
    present = interface.area > 0
    gap = interface.load.T @ moved - interface.overlap - (contact.travel - series * contact.force) * interface.area
    gap = gap / jnp.where(present, interface.area, 1.0)
    if interface.narrow is not None:
        gap += sharp * interface.narrow * interface.area * contact.pressure
    error = jnp.where(present, gap - contact.gap, 0.0)
    wrong = jnp.where(contact.active, jnp.abs(error), jnp.maximum(-(contact.gap + error), 0.0))
    size = jnp.abs(contact.travel)
    return contact, jnp.max(wrong) / jnp.where(size > 0, size, 1.0)


def _mixed(past: list[_Iterate]) -> np.ndarray:
    """The sum of the iterates' answers, with weights that add up to one, whose step is least in the norm of the chord."""
    last = past[-1]
    answer = last.rest.displacement + last.step
    if len(past) == 1:
        return answer
    steps, left, answers = (
        np.stack(each) for each in zip(*((at.step, at.left, at.rest.displacement + at.step) for at in past), strict=True)
    )
    apart, work = np.diff(steps, axis=0), np.diff(left, axis=0)
    gram = apart @ work.T
    size = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))  # steps shrink by decades: each difference counts by its own size
    scaled = (gram + gram.T) / (2 * np.outer(size, size))
    share = np.linalg.lstsq(scaled, apart @ last.left / size, rcond=ALIKE)[0] / size
    return answer - share @ np.diff(answers, axis=0)
