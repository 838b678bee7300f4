"""How readings change with the law of the tissue: at the linear engine's own answer, and at any strained state.

At the null of a law one linear answer is enough: its extra internal force f_phi(u) moves the free surface and every reading by

    - B' K^-1 f_phi(u),

with the active set held, and contact answers as to any other shift. At a strained state the implicit rule does the same with the tangent
of each equilibrium, in the moduli too, in what effects change of the push, and in other bodies with the same supports.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..contact.chord import Chord, Chords, Place, Resting
from ..contact.line import sharp_compliance
from ..effects.added import Added
from ..fem.body import Body
from ..fem.cholesky import Indefinite
from ..fem.condensed import AbstractCondensed, first_like
from ..fem.energy import internal_force
from ..fem.equilibrium import Tissue
from ..fem.operator import Lame
from ..fem.solver import Factorised
from ..fem.stiffness import tangent
from ..fem.tissue import AbstractTissue, Linear
from ..side_by_side import side_by_side
from .echoes import firsts
from .inner import Beside, towards
from .model import Model
from .pressing import Known, settle_with
from .problem import Health
from .readings import Instruments
from .rigs import Rig
from .strained import Strained, impositions, numbered, place_of, pushed, rig_readings, twin
from .wiring import Values

Vector = Float[Array, " d"]
Law = Callable[[Vector], AbstractTissue]
LINEAR = 1e-9  # relative difference of two forces up to which one law is another
ALIKE = 16  # loads are filled up to a multiple of this, so that code is compiled for few numbers of them
Of = Callable[[Vector], tuple[Values, AbstractTissue]]


class Ways(NamedTuple):
    """How a case changes in d ways: `material`, the Lame parameters (d, 2, layers) and the numbers of the law; `imposed` (d,), mm or N, and
    `series` (d,), mm/N, of the apparatus.
    """

    material: tuple[Float[Array, "d 2 layers"], AbstractTissue]
    imposed: Float[np.ndarray, " d"]
    series: Float[np.ndarray, " d"]


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


def strained_slopes(
    model: Model, of: Of, at: Vector, found: Strained, bodies: Sequence[Beside] = (), chords: Chords | None = None
) -> tuple[Float[Array, "rows d_b"], Strained]:
    """The same, and `found` with the slopes of its displacements, from where the equilibria of neighbouring parameters can be expected.

    Slopes towards other `bodies` come after those in the parameters. `chords` are handed the tangents.
    """
    values, law = of(at)
    count = len(at) + len(bodies)
    slopes = [np.full((len(rig.pose), count, model.columns.count + 2), np.nan) for rig in model.instruments.rigs]
    moved: list[list[np.ndarray | None]] = [[None] * len(rig.pose) for rig in model.instruments.rigs]
    tissues = [Tissue(model.body, law, material.lame(), model.solver) for material in model.instruments.materials(values)]
    materials = [_material_ways(model.instruments, of, at, variant) for variant in range(len(tissues))]
    same = firsts(model, [impositions(model.instruments.added, rig, values) for rig in model.instruments.rigs])
    pushed_so: dict[tuple[int, int], Ways] = {}
    own: list[tuple[Shape, list[Ways]]] = []
    echoes: list[tuple[int, int]] = []
    for number, rig in enumerate(model.instruments.rigs):
        series, *pushes = (np.asarray(each) for each in _push_ways(model.instruments.added, rig, of, at))
        ways = [Ways(materials[variant], *each) for variant, *each in zip(np.asarray(rig.variant).tolist(), *pushes, strict=True)]
        pushed_so |= {(number, case): way for case, way in enumerate(ways)}
        for first, twins in _of_one_shape(rig, tissues, rigid=not np.any(series)).items():
            if all(_heard(same[number][case], (number, case), pushed_so) for case, _ in twins):
                echoes += [(number, case) for case, _ in twins]
                continue
            rests = {case: rest for case, _ in twins if (rest := found.cases[number][case].rest) is not None}
            if first in rests:
                own.append((Shape(model, tissues, rig, (number, first), dict(twins), rests, float(series[first])), ways))
    sloped = partial(_shape_slopes, bodies=bodies, d=len(at), chords=chords or Chords())
    for (shape, _), each in zip(own, side_by_side(lambda one: list(sloped(*one)), own, model.solver.workers), strict=True):
        for case, ends in each:
            slopes[shape.of[0]][case], moved[shape.of[0]][case] = ends
    for number, case in echoes:
        rig_before, before = same[number][case]
        slopes[number][case], moved[number][case] = slopes[rig_before][before], moved[rig_before][before]
    contacts = [rig_readings(model.columns.matrix(), rig, cases) for rig, cases in zip(model.instruments.rigs, found.cases, strict=True)]
    rows = _rows(model.instruments, contacts, [jnp.asarray(each) for each in slopes], of, at)
    return rows, dataclasses.replace(found, slopes=tuple(map(tuple, moved)))


def _heard(other: tuple[int, int], case: tuple[int, int], ways: dict[tuple[int, int], Ways]) -> bool:
    """Whether a case is another one's, and goes on being that with every parameter."""
    mine, its = ways[case], ways[other]
    return other != case and np.array_equal(mine.imposed, its.imposed) and np.array_equal(mine.series, its.series)


def _of_one_shape(rig: Rig, tissues: Sequence[Tissue], rigid: bool) -> dict[int, list[tuple[int, float]]]:
    """Cases of one shape under the first of them: each with how many times as stiff its tissue is. An apparatus that is not `rigid` gives
    way by other lengths under stiffer tissue.
    """
    found: dict[int, list[tuple[int, float]]] = {}
    for variant in range(len(tissues)):
        like, stiffer = first_like(tissues[0].body, [tissue.lame for tissue in tissues], variant)
        for case in np.flatnonzero(np.asarray(rig.variant) == variant).tolist():
            other = None if like == variant or not rigid else twin(rig, case, like)
            first, times = (case, 1.0) if other is None else (other, stiffer)
            found.setdefault(first, []).append((case, times))
    return found


class Shape(NamedTuple):
    """Cases of one shape, `of` a rig's number and the first of them: how many `times` as stiff the tissue of each is, and how each rests,
    under an apparatus that gives way by `series`, mm/N.
    """

    model: Model
    tissues: Sequence[Tissue]
    rig: Rig
    of: tuple[int, int]
    times: dict[int, float]
    rests: dict[int, Resting]
    series: float


def _shape_slopes(
    shape: Shape, ways: Sequence[Ways], bodies: Sequence[Beside], d: int, chords: Chords
) -> Iterator[tuple[int, tuple[Float[np.ndarray, "d_b m_2"], Float[np.ndarray, "d_b _"]]]]:
    """Of cases of one shape: change of every column's reading, then of the force and of the travel, with each parameter and towards each
    body; and of the displacement (d + b, 3n). Nothing where the shape's tangent has no answer.

    What touches goes on touching: the tangent answers a unit of each pressure there, and every change of the internal force.
    """
    model, rig, rests, times, first = shape.model, shape.rig, shape.rests, shape.times, shape.of[1]
    count, matrix, felt = d + len(bodies), model.columns.matrix(), {case: _felt(ways[case].material) for case in rests}
    if not (bodies or any(len(felt[case]) or np.any(ways[case].imposed) or np.any(ways[case].series) for case in rests)):
        for case, rest in rests.items():  # an afferent's own parameters move nothing
            yield case, (np.zeros((count, model.columns.count + 2)), np.zeros((count, rest.displacement.size)))
        return
    place, _ = place_of(model, rig, int(rig.pose[first]), shape.tissues[int(rig.variant[first])])
    active = {case: np.asarray(rest.contact.active) for case, rest in rests.items()}
    touching = np.flatnonzero(np.any(list(active.values()), axis=0))
    hats, area = place.matrix @ np.asarray(place.interface.load)[:, touching], np.asarray(place.interface.area)[touching]
    own = {case: shape.tissues[int(rig.variant[case])] for case in rests}
    pushing = {case: np.append(felt[case], np.arange(d, count)) for case in rests}
    pushes = [_pushes(own[case], ways[case].material, felt[case], bodies, rest.displacement) for case, rest in rests.items()]
    tissue, loads = own[first], np.concatenate([hats.T, *(-push for push in pushes)])
    number = numbered(model.instruments.rigs)[shape.of[0]] + first
    chords.drop(number)
    undone = _undone(tissue, place, rests[first].displacement, loads)
    if undone is None:
        return
    found, chord = undone
    if chord is not None:
        chords.keep(number, tissue.body, place, chord)
    pressed, *freely = np.split(found, np.cumsum([len(touching), *(len(each) for each in pushing.values())])[:-1])
    for case, free in zip(rests, freely, strict=True):
        here = active[case][touching]
        under, size = pressed[here].T / times[case], area[here]
        moved, imposed, gap = np.zeros((count, found.shape[1])), np.zeros(count), np.zeros((here.sum(), count))
        moved[pushing[case]], imposed[:d] = free / times[case], ways[case].imposed
        gap[:, pushing[case]] = hats[:, here].T @ moved[pushing[case]].T
        gap[:, :d] += float(rests[case].contact.force) * np.outer(size, ways[case].series)
        compliance = hats[:, here].T @ under + shape.series * np.outer(size, size)
        sharp, sharper = _sharpness(rig, own[case].lame, ways[case].material[0])
        if (narrow := place.interface.narrow) is not None:
            gives = np.asarray(narrow)[touching][here] * size**2
            compliance += sharp * np.diag(gives)
            gap[:, :d] += np.outer(gives * np.asarray(rests[case].contact.pressure)[touching][here], sharper)
        pressure, travel = _held(compliance, size, gap, imposed, rig.forced)
        moved += (under @ pressure).T
        read = (matrix.T @ moved.T).T
        for number, other in enumerate(bodies):
            read[d + number] += other.reads(rests[case].displacement[None], read.shape[1])[0]
        if rig.beneath is not None:
            rows = np.flatnonzero(np.asarray(rig.case) == case)
            deeper = np.asarray(rig.beneath)[rows][:, touching[here]] @ pressure
            read[:, np.asarray(rig.reading)[rows]] += sharp * deeper.T
        slopes = np.concatenate([read, (size @ pressure)[:, None], travel[:, None]], axis=1)
        yield case, (slopes, moved)


def _sharpness(rig: Rig, lame: Lame, ways: Float[Array, "d 2 layers"]) -> tuple[float, Float[np.ndarray, " d"]]:
    """The skin's `sharp_compliance`, mm^2/N, and how it changes with each parameter."""
    slope = jax.grad(partial(sharp_compliance, layer=rig.layer))(jnp.asarray(lame))
    return float(sharp_compliance(jnp.asarray(lame), rig.layer)), np.einsum("dij,ij->d", np.asarray(ways), np.asarray(slope))


def _undone(tissue: Tissue, place: Place, u: np.ndarray, loads: np.ndarray) -> tuple[np.ndarray, Chord | None] | None:
    """What the tangent at a displacement (3n,), mm, answers to loads (k, 3n), N; and the tangent as a chord, where it is factorised.

    None where it does not answer.
    """
    there = tangent(tissue.body, tissue.law, tissue.lame, jnp.asarray(u).reshape(-1, 3))
    filled, chord = np.pad(loads, ((0, -len(loads) % ALIKE), (0, 0))), None
    try:
        if isinstance(tissue.solver, Factorised):
            condensed = tissue.solver.reduce(there, place.columns)
            chord = Chord.of(lambda: condensed, np.arange(place.columns.count))
        answer = tissue.solver.undo(there, jnp.asarray(filled).reshape(len(filled), -1, 3))
    except Indefinite:
        return None
    return (np.asarray(answer.displacement).reshape(filled.shape)[: len(loads)], chord) if bool(answer.converged.all()) else None


def _held(
    compliance: Float[np.ndarray, "a a"],
    area: Float[np.ndarray, " a"],
    gap: Float[np.ndarray, "a d"],
    imposed: Float[np.ndarray, " d"],
    forced: bool,
) -> tuple[Float[np.ndarray, "a d"], Float[np.ndarray, " d"]]:
    """Changes of the pressures, MPa, and of the travel, mm, that keep what touches in touch while its gaps open: travel imposed, or force.

    **Arguments:** `compliance`, mm^3 of gap under each hat per MPa on each; `area`, mm^2; `gap`, mm^3, by which each opens in d ways, and
    `imposed`, mm or N, what is imposed more in each.
    """
    if not forced or not len(area):
        return -np.linalg.solve(compliance, gap - np.outer(area, imposed)), np.zeros(gap.shape[1]) if forced else imposed
    bordered = np.block([[compliance, -area[:, None]], [area[None], np.zeros((1, 1))]])
    ends = np.linalg.solve(bordered, np.concatenate([-gap, imposed[None]]))
    return ends[:-1], ends[-1]


@eqx.filter_jit
def _material_ways(instruments: Instruments, of: Of, at: Vector, variant: int) -> tuple[Float[Array, "d 2 layers"], AbstractTissue]:
    """How the Lame parameters of a variant's tissue and the numbers of its law, each (d, ...), change with each parameter."""

    def numbers(vector: Vector) -> tuple[Lame, AbstractTissue]:
        values, law = of(vector)
        return instruments.materials(values)[variant].lame(), eqx.filter(law, eqx.is_inexact_array)

    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), jax.jacfwd(numbers)(at))


@eqx.filter_jit
def _push_ways(
    added: Added, rig: Rig, of: Of, at: Vector
) -> tuple[Float[Array, " cases"], Float[Array, "cases d"], Float[Array, "cases d"]]:
    """What the apparatus gives way in each case, mm/N; how what is imposed changes with each parameter; and how the first does."""

    def pushes(vector: Vector) -> tuple[Array, Array]:
        values = of(vector)[0]
        each = jax.vmap(lambda pose, imposed: pushed(added, rig, pose, imposed, values))(rig.pose, rig.imposed)
        return each.imposed, jnp.broadcast_to(each.series, each.imposed.shape)

    return pushes(at)[1], *jax.jacfwd(pushes)(at)


def _felt(ways: tuple[Array, AbstractTissue]) -> Int[np.ndarray, " f"]:
    """The parameters that a tissue depends on: not those of other subjects."""
    sizes = [np.abs(np.asarray(leaf)).reshape(len(leaf), -1).max(axis=1, initial=0.0) for leaf in jax.tree.leaves(ways)]
    return np.flatnonzero(np.max(sizes, axis=0))


def _pushes(
    tissue: Tissue, ways: tuple[Array, AbstractTissue], felt: Int[np.ndarray, " f"], bodies: Sequence[Beside], u: Float[np.ndarray, " _"]
) -> Float[np.ndarray, "f_b _"]:
    """Change of the internal force (3n,), N, at a displacement (3n,), mm, with some of the parameters, then towards other bodies."""
    some, field, lame = jax.tree.map(lambda leaf: leaf[felt], ways), jnp.asarray(u).reshape(-1, 3), jnp.asarray(tissue.lame)
    found = [np.asarray(_forces(tissue.body, tissue.law, some, lame, field)).reshape(len(felt), u.size)]
    found += [np.asarray(towards(tissue.law, lame, tissue.body, other, field)).reshape(1, -1) for other in bodies]
    return np.concatenate(found)


@eqx.filter_jit
def _forces(
    body: Body, law: AbstractTissue, ways: tuple[Array, AbstractTissue], lame: Lame, u: Float[Array, "nodes 3"]
) -> Float[Array, "f nodes 3"]:
    numbers, rest = eqx.partition(law, eqx.is_inexact_array)

    def force(own: tuple[Lame, AbstractTissue]) -> Array:
        return internal_force(body, eqx.combine(own[1], rest), own[0], u)

    return jax.vmap(lambda way: jax.jvp(force, ((lame, numbers),), (way,))[1])(ways)


@eqx.filter_jit
def _rows(instruments: Instruments, contacts: list, slopes: list[Array], of: Of, at: Vector) -> Float[Array, "rows d_b"]:
    """From the slopes of columns, forces and travels to those of the rows of each measurement."""
    health = Health(jnp.asarray(True), jnp.asarray(0), jnp.asarray(0.0))

    def readings(step: Vector) -> Array:
        moved = []
        for (contact, observed), slope in zip(contacts, slopes, strict=True):
            change = jnp.einsum("d,cdm->cm", step, slope)
            ends = contact.force + change[:, -2], contact.travel + change[:, -1]
            moved.append((eqx.tree_at(lambda part: (part.force, part.travel), contact, ends), observed + change[:, :-2]))
        return jnp.concatenate(instruments.told(moved, of(at + step[: len(at)])[0], health).readings)

    return jax.jacfwd(readings)(jnp.zeros(slopes[0].shape[1]))
