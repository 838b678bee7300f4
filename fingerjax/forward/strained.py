"""Every reading of a study with tissue of any law: the full nonlinear equilibrium of each indentation, followed from the one before it.

The cases of a rig that share pose and material are a load path. Each begins with the last one's displacement, or with that of the same
case at neighbouring values, and is looked for with a stiffness that is kept: the linear engine's, or the tangent of some state on the way
where that pays (`contact.chord`). What is found nowhere on this way is left to Newton's method (`contact.strained`).

What is read is what the linear engine reads, of another displacement: heights of the skin, and receptor strains as the symmetric part of
the displacement gradient.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from .._results import RESULTS
from ..contact.chord import Chord, Chording, Imposed, Place, Resting, Search, tangent_chord
from ..contact.indentation import Contact
from ..contact.strained import Indenting
from ..effects.records import Push
from ..fem.columns import Columns
from ..fem.equilibrium import Newton, State, Tissue, find
from ..fem.tissue import AbstractTissue
from .model import Model
from .problem import Health
from .readings import Instruments, Prediction
from .rigs import Rig
from .wiring import Values

RENEWALS = 4  # tangents that are tried for one case before it is left to Newton


class Ended(NamedTuple):
    """How one case ended: iterations and factorisations in all, those of Newton's method apart, and the error of the state."""

    rest: Resting | None
    iterations: int
    factorisations: int
    newton: int
    result: RESULTS


@dataclasses.dataclass(frozen=True)
class Strained:
    """Readings of every measurement, and the equilibria behind them: for each rig and case how it ended. A warm start for the next.

    Readings of a case without an equilibrium are NaN, and `prediction.converged` is then False.
    """

    prediction: Prediction
    cases: tuple[tuple[Ended, ...], ...]

    @property
    def iterations(self) -> int:
        return sum(ended.iterations for rig in self.cases for ended in rig)

    @property
    def factorisations(self) -> int:
        return sum(ended.factorisations for rig in self.cases for ended in rig)


def strained_readings(
    model: Model,
    values: Values,
    law: AbstractTissue,
    *,
    start: Strained | None = None,
    chording: Chording | None = None,
    quantity: str = "strain_energy_density",
) -> Strained:
    """Every reading at these values of a study whose tissue follows a law; outside of compiled code.

    **Arguments:** `start`, what was found at neighbouring values or of a neighbouring law. `quantity`: what the receptor is taken to feel.
    """
    chording = Chording() if chording is None else chording
    rigs = model.instruments.rigs
    cases: list[list[Ended | None]] = [[None] * len(rig.pose) for rig in rigs]
    for variant, material in enumerate(model.instruments.materials(values)):
        tissue = Tissue(model.body, law, material.lame(), model.solver)
        linear = model.solver.condense(model.body, tissue.lame, model.columns)
        for number, rig in enumerate(rigs):
            for pose, path in paths(rig, variant):
                place, own = place_of(model, rig, pose)
                warm = [None if start is None else start.cases[number][case].rest for case in path]
                loads = [imposed_on(model, values, rig, case) for case in path]
                if not linear.held.converged:
                    cases[number] = [Ended(None, 0, 0, 0, RESULTS.not_converged)] * len(rig.pose)
                    continue
                followed = _followed(tissue, place, Chord(linear, own), loads, warm, chording)
                for case, ended in zip(path, followed, strict=True):
                    cases[number][case] = ended
    found = tuple(tuple(ended for ended in rig if ended is not None) for rig in cases)
    return Strained(_prediction(model, values, found, quantity), found)


def paths(rig: Rig, variant: int) -> Iterator[tuple[int, list[int]]]:
    """Poses of a rig, and the cases of each that a variant of the material has, in the order of what is imposed."""
    load, own, poses = np.asarray(rig.imposed), np.asarray(rig.variant) == variant, np.asarray(rig.pose)
    for pose in np.unique(poses[own]):
        cases = np.flatnonzero(own & (poses == pose))
        yield int(pose), cases[np.argsort(load[cases])].tolist()


def imposed_on(model: Model, values: Values, rig: Rig, case: int) -> Imposed:
    """What is imposed in a case, with effects on the push. **Raises** `ValueError` for an apparatus that gives way."""
    geometry = jax.tree.map(lambda leaf: leaf[rig.pose[case]], rig.interface)
    said = Push(rig.imposed[case], geometry.overlap, geometry.area, jnp.zeros(()), rig.forced, rig.context.measurement)
    push = model.instruments.added.push(said, values)
    if float(push.series) != 0.0:
        raise ValueError("an apparatus that gives way is not computed together with nonlinear tissue")
    value = float(push.imposed)
    return Imposed(None, value) if rig.forced else Imposed(value, None)


def place_of(model: Model, rig: Rig, pose: int) -> tuple[Place, np.ndarray]:
    """Where a rig presses in one pose, and which of the model's columns are pressed."""
    own = np.asarray(rig.columns[pose])
    columns = Columns(model.columns.node[own], model.columns.weight[own], model.columns.nodes)
    return Place(columns, jax.tree.map(lambda leaf: leaf[pose], rig.interface)), own


def _followed(
    tissue: Tissue, place: Place, chord: Chord, loads: list[Imposed], warm: list[Resting | None], chording: Chording
) -> Iterator[Ended]:
    """The equilibria of one load path, each from the one before or from its own warm start."""
    last: Resting | None = None
    for imposed, own in zip(loads, warm, strict=True):
        begin = last if own is None else own
        if begin is None:
            u, active = np.zeros(3 * place.columns.nodes), place.overlapped(imposed)
        else:
            u, active = begin.displacement, begin.contact.active
        ended, chord = _found(tissue, place, chord, imposed, (u, active), last, chording)
        if ended.rest is not None:
            last = ended.rest
        yield ended


def _found(
    tissue: Tissue,
    place: Place,
    chord: Chord,
    imposed: Imposed,
    begin: tuple[np.ndarray, Array],
    last: Resting | None,
    chording: Chording,
) -> tuple[Ended, Chord]:
    """One equilibrium: with the chord at hand, then with tangents on the way, at last by Newton's method from the equilibrium before."""
    (u, active), iterations, factorisations = begin, 0, 0
    for _ in range(RENEWALS + 1):
        ended = Search(tissue, place, chord, imposed, chording).run(u, active)
        iterations += ended.iterations
        if ended.result.ok:
            return Ended(ended.rest, iterations, factorisations, 0, ended.result), chord
        if ended.rest is None:
            break
        u, active = ended.rest.displacement, ended.rest.contact.active
        renewed = tangent_chord(tissue, place, u)
        if renewed is None:
            break
        chord, factorisations = renewed, factorisations + 1
    travel, force = (None if value is None else jnp.asarray(value) for value in imposed)
    found = find(tissue, Indenting(place.columns, place.interface, travel, force), Newton(chording.tolerance), _state(last))
    newton, result, rest = found.iterations, found.result, None
    if result.ok:
        near = tangent_chord(tissue, place, np.asarray(found.state.displacement).ravel())
        if near is not None:
            chord = near
            again = Search(tissue, place, chord, imposed, chording).run(
                np.asarray(found.state.displacement).ravel(), found.state.detail.active
            )
            rest, result = (again.rest, again.result) if again.result.ok else (None, again.result)
    return Ended(rest, iterations, factorisations, newton, result), chord


def _state(rest: Resting | None) -> State | None:
    if rest is None:
        return None
    u, load = (jnp.asarray(part).reshape(-1, 3) for part in (rest.displacement, rest.load))
    return State(u, load, rest.contact.travel, rest.contact)


def _prediction(model: Model, values: Values, cases: tuple[tuple[Ended, ...], ...], quantity: str) -> Prediction:
    every = [ended for rig in cases for ended in rig]
    errors = [ended.rest.error for ended in every if ended.rest is not None]
    health = Health(
        jnp.asarray(all(ended.rest is not None for ended in every)),
        jnp.asarray(max(ended.iterations + ended.newton for ended in every)),
        jnp.asarray(max(errors) if len(errors) == len(every) else jnp.nan),
    )
    matrix = model.columns.matrix()
    found = [rig_readings(matrix, rig, ended) for rig, ended in zip(model.instruments.rigs, cases, strict=True)]
    return _told(model.instruments, found, {name: jnp.asarray(value, float) for name, value in values.items()}, health, quantity)


def rig_readings(matrix: sp.csc_matrix, rig: Rig, cases: tuple[Ended, ...]) -> tuple[Contact, Float[Array, "cases m"]]:
    """The contacts of a rig's cases, and what every column reads under them; NaN where no equilibrium was found."""
    unknown = _unknown(rig)
    contacts = [unknown if ended.rest is None else ended.rest.contact for ended in cases]
    nothing = np.full(matrix.shape[0], np.nan)
    u = np.stack([nothing if ended.rest is None else ended.rest.displacement for ended in cases])
    read = np.full((len(u), matrix.shape[1]), np.nan)
    sound = np.isfinite(u[:, 0])
    read[sound] = (matrix.T @ u[sound].T).T
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *contacts), jnp.asarray(read)


def _unknown(rig: Rig) -> Contact:
    """The contact of which nothing is known."""
    (p, k), nan, no = rig.interface.load.shape[1:], jnp.asarray(jnp.nan), jnp.asarray(False)
    hats, none = jnp.full(k, jnp.nan), jnp.zeros(k, bool)
    return Contact(hats, jnp.full(p, jnp.nan), nan, nan, nan, nan, none, hats, jnp.asarray(0), no, no)


@eqx.filter_jit
def _told(
    instruments: Instruments, found: list[tuple[Contact, Array]], values: dict[str, Array], health: Health, quantity: str
) -> Prediction:
    return instruments.told(found, values, health, quantity)
