"""One load path under a law of the tissue: equilibria of one indenter at one place, each followed from the one before it.

Each is looked for with a stiffness that is kept: the linear engine's, or the tangent of some state on the way where that pays
(`contact.chord`). What is not found so is looked for in steps, and left to Newton's method at last (`contact.strained`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from threading import Event
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._results import RESULTS
from ..contact.chord import Chord, Chording, Chords, Imposed, Place, Resting, Search, tangent_chord
from ..contact.strained import Indenting
from ..fem.equilibrium import Newton, State, Tissue, find

RENEWALS = 4  # tangents that are tried on one way
HALVINGS = 3  # of the way from the equilibrium before, until a case is left to Newton's method


class Ended(NamedTuple):
    """How one case ended: iterations and factorisations in all, those of Newton's method apart. As a start, `tangent` asks for one there:
    where this case needed one before.
    """

    rest: Resting | None
    iterations: int
    factorisations: int
    newton: int
    tangent: bool
    result: RESULTS


UNTRIED = Ended(None, 0, 0, 0, False, RESULTS.not_converged)


class Known(NamedTuple):
    """The chords that a path knows of: kept tangents of its `cases`, and the `linear` body's."""

    chords: Chords
    cases: list[int]
    linear: Callable[[], Chord | None]


class LoadPath(NamedTuple):
    """Of the rig with this number the `cases` in the order of their `loads`, where they press, what is known, and where each may begin."""

    rig: int
    cases: list[int]
    place: Place
    known: Known
    loads: list[Imposed]
    warm: list[Ended | None]


def along(path: LoadPath, *, tissue: Tissue, chording: Chording, lost: Event) -> list[Ended]:
    """The equilibria of one load path, until one has none: on this path, or on another that is followed beside it."""
    followed, found = _followed(tissue, path, chording), []
    while not lost.is_set() and (ended := next(followed, None)) is not None:
        found.append(ended)
        if ended.rest is None:
            lost.set()
    return found


def _followed(tissue: Tissue, path: LoadPath, chording: Chording) -> Iterator[Ended]:
    """The equilibria of one load path, each from the one before or from its own warm start."""
    last: Resting | None = None
    chord: Chord | None = None
    place, known = path.place, path.known
    for case, imposed, own in zip(known.cases, path.loads, path.warm, strict=True):
        spent = 0
        if own is not None and own.rest is not None:
            kept = known.chords.find(case, tissue.body, place)
            if kept is None and own.tangent:
                kept, spent = tangent_chord(tissue, place, own.rest.displacement), 1
            chord = chord if kept is None else kept
        chord = known.linear() if chord is None else chord
        if chord is None:
            yield UNTRIED
            continue
        warm_start = None if own is None or own.rest is None else (own.rest.displacement, _touched(place, own.rest, imposed))
        ended, chord = _found(tissue, place, chord, imposed, warm_start, last, chording)
        last = last if ended.rest is None else ended.rest
        spent += ended.factorisations
        if spent:
            known.chords.keep(case, tissue.body, place, chord)
        yield ended._replace(factorisations=spent, tangent=spent > 0 or (own is not None and own.tangent))


def _touched(place: Place, rest: Resting, imposed: Imposed) -> Array:
    """The hats that touched where an earlier search ended, a guess to begin with; none can be had from a pad of another length, as one that
    is cut under an indenter that leans.
    """
    active = rest.contact.active
    return active if active.shape == place.interface.area.shape else place.overlapped(imposed)


Begin = tuple[np.ndarray, Array]  # a displacement (3n,), mm, and the touching hats


def _found(
    tissue: Tissue, place: Place, chord: Chord, imposed: Imposed, warm: Begin | None, last: Resting | None, chording: Chording
) -> tuple[Ended, Chord]:
    """One equilibrium: from where it is looked for first, then from the equilibrium before, by halves of the way, at last by Newton."""
    spent = UNTRIED
    for begin in ([] if warm is None else [warm]) + [_begin(place, last, imposed)]:
        ended, chord = _by_chords(tissue, place, chord, imposed, begin, chording)
        spent = _sum(spent, ended)
        if ended.result.ok:
            return spent, chord
    ended, chord = _by_halves(tissue, place, chord, imposed, last, chording, HALVINGS)
    spent = _sum(spent, ended)
    return (spent if ended.result.ok else _by_newton(tissue, place, imposed, last, chording, spent)), chord


def _begin(place: Place, last: Resting | None, imposed: Imposed) -> Begin:
    """The equilibrium before, or undeformed skin with whatever the indenter overlaps of it."""
    return (np.zeros(3 * place.columns.nodes), place.overlapped(imposed)) if last is None else (last.displacement, last.contact.active)


def _by_chords(
    tissue: Tissue, place: Place, chord: Chord, imposed: Imposed, begin: Begin, chording: Chording
) -> tuple[Ended, Chord]:
    """With the chord at hand, then with tangents on the path."""
    (u, active), iterations, factorisations = begin, 0, 0
    for _ in range(RENEWALS + 1):
        ended = Search(tissue, place, chord, imposed, chording).run(u, active)
        iterations += ended.iterations
        if ended.result.ok:
            return Ended(ended.rest, iterations, factorisations, 0, False, ended.result), chord
        if ended.rest is None:
            break
        u, active = ended.rest.displacement, ended.rest.contact.active
        renewed = tangent_chord(tissue, place, u)
        if renewed is None:
            break
        chord, factorisations = renewed, factorisations + 1
    return Ended(None, iterations, factorisations, 0, False, RESULTS.no_equilibrium), chord


def _by_halves(
    tissue: Tissue, place: Place, chord: Chord, imposed: Imposed, last: Resting | None, chording: Chording, halvings: int
) -> tuple[Ended, Chord]:
    """In two steps from the equilibrium before, or from undeformed skin, each of which may be halved again."""
    spent = UNTRIED
    for goal in (_half_way(last, imposed), imposed):
        ended, chord = _by_chords(tissue, place, chord, goal, _begin(place, last, goal), chording)
        if not ended.result.ok and halvings > 1:
            further, chord = _by_halves(tissue, place, chord, goal, last, chording, halvings - 1)
            ended = _sum(ended, further)
        spent = _sum(spent, ended)
        if ended.rest is None:
            break
        last = ended.rest
    return spent, chord


def _half_way(last: Resting | None, imposed: Imposed) -> Imposed:
    if imposed.travel is not None:
        return imposed._replace(travel=0.5 * (imposed.travel + (0.0 if last is None else float(last.contact.travel))))
    assert imposed.force is not None
    return imposed._replace(force=0.5 * (imposed.force + (0.0 if last is None else float(last.contact.force))))


def _sum(before: Ended, now: Ended) -> Ended:
    """How the second of two searches ended, with the work of both."""
    return now._replace(iterations=before.iterations + now.iterations, factorisations=before.factorisations + now.factorisations)


def _by_newton(tissue: Tissue, place: Place, imposed: Imposed, last: Resting | None, chording: Chording, spent: Ended) -> Ended:
    """By Newton's method from the equilibrium before, its end told as a chord tells it; not for an apparatus that gives path."""
    if imposed.series != 0.0:
        return spent
    travel, force = (None if value is None else jnp.asarray(value) for value in imposed[:2])
    loading = Indenting(place.columns, place.interface, travel, force, jnp.asarray(place.sharp))
    found = find(tissue, loading, Newton(chording.tolerance), _state(last))
    near = tangent_chord(tissue, place, np.asarray(found.state.displacement).ravel()) if found.result.ok else None
    if near is None:
        return spent._replace(newton=found.iterations, result=found.result)
    again = Search(tissue, place, near, imposed, chording).run(np.asarray(found.state.displacement).ravel(), found.state.detail.active)
    ended = Ended(again.rest if again.result.ok else None, again.iterations, 1, found.iterations, False, again.result)
    return _sum(spent, ended)


def _state(rest: Resting | None) -> State | None:
    if rest is None:
        return None
    u, load = (jnp.asarray(part).reshape(-1, 3) for part in (rest.displacement, rest.load))
    return State(u, load, rest.contact.travel, rest.contact)
