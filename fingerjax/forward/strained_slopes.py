"""How readings change with the law of the tissue: at the linear engine's own answer, and at any strained state.

At the null of a law one linear answer is enough: its extra internal force f_phi(u) moves the free surface and every reading by

    - B' K^-1 f_phi(u),

with the active set held, and contact answers as to any other shift. At a strained state the implicit rule does the same with the tangent
of each equilibrium, in the moduli too.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..contact.chord import Chord, Place, Resting, tangent_chord
from ..contact.strained import contact_slopes
from ..fem.body import Body
from ..fem.condensed import AbstractCondensed, first_like
from ..fem.energy import internal_force
from ..fem.equilibrium import Tissue
from ..fem.operator import Lame
from ..fem.tissue import AbstractTissue, Linear
from .model import Model
from .pressing import Known, settle_with
from .problem import Health
from .readings import Instruments
from .rigs import Rig
from .strained import Strained, imposed_on, place_of, rig_readings, twin
from .wiring import Values

Vector = Float[Array, " d"]
Law = Callable[[Vector], AbstractTissue]
LINEAR = 1e-9  # relative difference of two forces up to which one law is another
Of = Callable[[Vector], tuple[Values, AbstractTissue]]


def law_tangent(model: Model, values: Values, law: Law, null: Vector) -> Float[Array, "rows d"]:
    """Slopes of all readings, one measurement after the other, in the parameters of a law that is linear at `null`.

    One linear condensation, and one more solve for each case and parameter, however strained the law would have them. Raises `ValueError`
    where the law is not linear at `null`.
    """
    lames = [material.lame() for material in model.instruments.materials(values)]
    bodies = model.condensed(lames)

    def change(variant: int, condensed: AbstractCondensed, forces: Float[Array, "k m"]) -> Array:
        u = condensed.displacement(forces)
        if len(u) and _strangeness(model.body, law(null), lames[variant], u[0]) > LINEAR:
            raise ValueError(f"the law is not linear at null={null}; give the parameters at which it is Hooke's law")
        moved = [condensed.readings(_pushed(model.body, law, null, lames[variant], each)) for each in u]
        return -jnp.stack(moved) if moved else jnp.zeros((0, len(null), model.columns.count))

    directions = jnp.zeros((len(lames), len(null), *lames[0].shape))
    known = settle_with(model.instruments.rigs, bodies, directions, change, model.instruments.added, values)
    return _law_columns(model.instruments, known, dict(values), null)


@eqx.filter_jit
def _strangeness(body: Body, law: AbstractTissue, lame: Lame, u: Float[Array, "nodes 3"]) -> Float[Array, ""]:
    """How far a law's internal force is from that of Hooke's, relative."""
    force = internal_force(body, Linear(), lame, u)
    return jnp.linalg.norm(internal_force(body, law, lame, u) - force) / jnp.linalg.norm(force)


@eqx.filter_jit
def _pushed(body: Body, law: Law, at: Vector, lame: Lame, u: Float[Array, "nodes 3"]) -> Float[Array, "d nodes 3"]:
    """Change of the internal force with each parameter of a law."""
    slope = jax.jacfwd(lambda phi: internal_force(body, law(phi), lame, u))(at)
    return jnp.moveaxis(slope, -1, 0)


@eqx.filter_jit
def _law_columns(instruments: Instruments, known: Known, values: dict, null: Vector) -> Float[Array, "rows d"]:
    variants = len(instruments.variants)

    def readings(phi: Vector) -> Array:
        away = jnp.broadcast_to(phi, (variants, len(phi)))
        return jnp.concatenate(instruments.read(known, values, away=away).readings)

    return jax.jacfwd(readings)(jnp.zeros_like(null))


def strained_jacobian(model: Model, of: Of, at: Vector, found: Strained) -> Float[Array, "rows d"]:
    """Slopes of all readings at the equilibria that were `found`, by the implicit rule: one factorisation for each case that is no twin.

    `of` makes the values and the law from one vector, so that its parameters may be raw or natural, a law's or an afferent's; `at` is the
    one of `found`. NaN where a case has no equilibrium.
    """
    return strained_slopes(model, of, at, found)[0]


def strained_slopes(model: Model, of: Of, at: Vector, found: Strained) -> tuple[Float[Array, "rows d"], Strained]:
    """The same, and `found` with the slopes of its displacements, from where the equilibria of neighbouring parameters can be expected."""
    values, law = of(at)
    slopes = [np.full((len(rig.pose), len(at), model.columns.count + 2), np.nan) for rig in model.instruments.rigs]
    moved: list[list[np.ndarray | None]] = [[None] * len(rig.pose) for rig in model.instruments.rigs]
    tissues = [Tissue(model.body, law, material.lame(), model.solver) for material in model.instruments.materials(values)]
    for number, rig in enumerate(model.instruments.rigs):
        for first, twins in _of_one_shape(rig, tissues).items():
            rest = found.cases[number][first].rest
            place, _ = place_of(model, rig, int(rig.pose[first]))
            chord = None if rest is None else tangent_chord(tissues[int(rig.variant[first])], place, rest.displacement)
            for case, times in twins:
                own = found.cases[number][case].rest
                if chord is not None and own is not None:
                    own_chord = chord.stiffer(times)
                    slopes[number][case], moved[number][case] = _case_slopes(model, own_chord, place, rig, case, own, of, at)
    contacts = [rig_readings(model.columns.matrix(), rig, cases) for rig, cases in zip(model.instruments.rigs, found.cases, strict=True)]
    rows = _rows(model.instruments, contacts, [jnp.asarray(each) for each in slopes], of, at)
    return rows, dataclasses.replace(found, slopes=tuple(map(tuple, moved)))


def _of_one_shape(rig: Rig, tissues: Sequence[Tissue]) -> dict[int, list[tuple[int, float]]]:
    """Cases of one shape under the first of them: each with how many times as stiff its tissue is."""
    found: dict[int, list[tuple[int, float]]] = {}
    for variant in range(len(tissues)):
        like, stiffer = first_like(tissues[0].body, [tissue.lame for tissue in tissues], variant)
        for case in np.flatnonzero(np.asarray(rig.variant) == variant).tolist():
            other = None if like == variant else twin(rig, case, like)
            first, times = (case, 1.0) if other is None else (other, stiffer)
            found.setdefault(first, []).append((case, times))
    return found


def _case_slopes(
    model: Model, chord: Chord, place: Place, rig: Rig, case: int, rest: Resting, of: Of, at: Vector
) -> tuple[Float[np.ndarray, "d m_2"], Float[np.ndarray, "d _"]]:
    """Change of every column's reading, then of the force and of the travel, with each parameter; and of the displacement (d, 3n)."""
    variant, nodes = int(rig.variant[case]), model.columns.nodes
    force, push = _forces(model, of, at, variant, jnp.asarray(rest.displacement).reshape(nodes, 3))
    felt = np.flatnonzero(np.abs(np.asarray(push)).max(axis=(1, 2), initial=0.0))  # not those of other subjects
    answers = chord.condensed.answer(jnp.concatenate([-push[felt], force[None]]))
    free = place.matrix.T @ (rest.displacement - np.asarray(answers[-1]).ravel())
    travel, pressed = imposed_on(model, of(at)[0], rig, case)
    change, travels = contact_slopes(
        chord.compliance,
        place.interface,
        jnp.asarray(free),
        place.columns.read(answers[:-1]),
        None if travel is None else jnp.asarray(travel),
        None if pressed is None else jnp.asarray(pressed),
    )
    load = (place.matrix @ np.asarray(change).T).T
    more = chord.condensed.answer(jnp.asarray(load).reshape(-1, nodes, 3))
    moved = np.zeros((len(at), 3 * nodes))
    moved[felt] = np.asarray(answers[:-1] + more).reshape(len(felt), -1)
    found = np.zeros((len(at), model.columns.count + 2))
    found[felt, :-2] = (model.columns.matrix().T @ moved[felt].T).T
    found[felt, -2], found[felt, -1] = load[:, 1::3].sum(axis=1), np.asarray(travels)
    return found, moved


@eqx.filter_jit
def _forces(
    model: Model, of: Of, at: Vector, variant: int, u: Float[Array, "nodes 3"]
) -> tuple[Float[Array, "nodes 3"], Float[Array, "d nodes 3"]]:
    def force(vector: Vector) -> Array:
        values, law = of(vector)
        return internal_force(model.body, law, model.instruments.materials(values)[variant].lame(), u)

    return force(at), jnp.moveaxis(jax.jacfwd(force)(at), -1, 0)


@eqx.filter_jit
def _rows(instruments: Instruments, contacts: list, slopes: list[Array], of: Of, at: Vector) -> Float[Array, "rows d"]:
    """From the slopes of columns, forces and travels to those of the rows of each measurement."""
    health = Health(jnp.asarray(True), jnp.asarray(0), jnp.asarray(0.0))

    def readings(step: Vector) -> Array:
        moved = []
        for (contact, observed), slope in zip(contacts, slopes, strict=True):
            change = jnp.einsum("d,cdm->cm", step, slope)
            ends = contact.force + change[:, -2], contact.travel + change[:, -1]
            moved.append((eqx.tree_at(lambda part: (part.force, part.travel), contact, ends), observed + change[:, :-2]))
        return jnp.concatenate(instruments.told(moved, of(at + step)[0], health).readings)

    return jax.jacfwd(readings)(jnp.zeros_like(at))
