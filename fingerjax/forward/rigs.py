"""A measurement as a rig: which indentations were made, and which reading of which indentation each row is."""

from __future__ import annotations

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float, Int

from ..contact.footprint import Interface, interface, only
from ..contact.indenter import FlatCylinder, Line, Point, Sphere, from_spec
from ..contact.line import RIGID, beside_tip
from ..contact.locate import surface_functionals
from ..contact.pad import Pad, functionals
from ..contact.reach import Indentation, filled, pad_for, room, windows
from ..contact.shape import AbstractIndenter
from ..effects.added import Effects
from ..effects.records import Context, Placed
from ..errors import InputError
from ..fem.body import Body
from ..fem.recovery import strain_columns
from ..finger import Finger
from ..geometry.solid import AbstractSolid
from ..indenter_spec import IndenterSpec
from ..measurements import Measurement, Receptor
from ..mesh import Focus
from ..mesh.refine import TIP_GROWTH
from .wiring import Wiring

COLUMNS = 32  # all columns together are filled up to a multiple of these, for code is compiled for each number of them
LARGEST_STRAIN_SHARE = 0.35  # of the finger's height: no travel under force control goes deeper


class Rig(eqx.Module):
    """One indenter of one measurement.

    - `columns` (poses, p): where the pad nodes of each pose stand among the compliance's columns.
    - `interface`: contact geometry of each pose. `pose`, `imposed` (cases,): where, and mm of travel or N of force.
    - `variant` (cases,): which material. `row` (r,), `case` (r,), `reading` (r,): what each row of the measurement is; `reading` is
      the compliance column of an observed surface point, or the first of six strain columns.
    - `beneath` (r, k), mm, of profiles under a line alone: how much deeper the point of each row lies than the mesh shows, for the pressure
      of each hat, per unit of the `sharp_compliance` of `layer`, the outermost.
    """

    indenter: AbstractIndenter
    columns: Int[Array, "poses p"]
    interface: Interface
    pose: Int[Array, " cases"]
    imposed: Float[Array, " cases"]
    variant: Int[Array, " cases"]
    row: Int[Array, " r"]
    case: Int[Array, " r"]
    reading: Int[Array, " r"]
    context: Context
    measurement: int = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    forced: bool = eqx.field(static=True)
    layer: int = eqx.field(static=True)
    beneath: Float[Array, "r k"] | None = None


@dataclasses.dataclass(frozen=True)
class Plan:
    """What one indenter of one measurement asks for, before there is a mesh: poses in (x, z) mm, cases and rows."""

    measurement: Measurement
    index: int
    indenter: AbstractIndenter
    rows: np.ndarray
    origins: np.ndarray
    pose: np.ndarray
    imposed: np.ndarray
    variant: np.ndarray
    case: np.ndarray

    @property
    def deepest(self) -> float:
        return float(self.imposed.max())

    def changed(self, effects: Effects) -> Plan:
        """The plan with what effects do to the indenter, its poses and the receptor."""
        measurement = self.measurement
        placed = effects.place(Placed(self.indenter, self.origins, measurement.kind))
        if measurement.receptor is not None and (placed.deeper or placed.along):
            at = measurement.receptor
            moved = dataclasses.replace(at, depth=at.depth + placed.deeper, z=at.z + placed.along)
            measurement = dataclasses.replace(measurement, receptor=moved)
        return dataclasses.replace(self, measurement=measurement, indenter=placed.indenter, origins=placed.origins)


def indenter_from(spec: IndenterSpec) -> AbstractIndenter:
    """The rigid shape that a sidecar describes."""
    return from_spec(spec.shape, spec.dimensions, spec.along or "x", spec.lists)


def site(solid: AbstractSolid, measurement: Measurement) -> tuple[float, float]:
    """(x, z), mm, of the point of the skin that a measurement is about: its own site, or the lowest point of the pad."""
    if measurement.site is not None:
        return skin_point(solid, measurement.site.z, measurement.site.theta)
    return skin_point(solid, solid.pad_centre, 1.5 * np.pi)


def skin_point(solid: AbstractSolid, z: float, theta: float) -> tuple[float, float]:
    """(x, z), mm, of the skin at an angle about the section's centre."""
    if not 0 < z < solid.length:
        raise InputError("the site lies beyond the finger", place="z_mm", seen=z, remedy=f"write 0 to {solid.length:g} mm")
    at, angle = np.array([z]), np.array([theta])
    return float(solid.centre(at)[0, 0] + solid.radius(0, at, angle)[0] * np.cos(theta)), z


def plans(measurements: tuple[Measurement, ...], solid: AbstractSolid, wired: Wiring) -> list[Plan]:
    """One plan for each indenter of each measurement."""
    variants = {labels: number for number, labels in enumerate(wired.variants(measurements))}
    found = []
    for index, measurement in enumerate(measurements):
        stimulus = np.asarray(measurement.table.get("stimulus", np.full(len(measurement), ""))).astype(str)
        variant = np.array([variants[labels] for labels in wired.labels(measurement)])
        for name, spec in measurement.indenters.items():
            rows = np.arange(len(measurement)) if name == "" else np.flatnonzero(stimulus == name)
            if len(rows):
                found.append(_plan(measurement, index, indenter_from(spec), rows, variant[rows], solid))
    return found


def _plan(
    measurement: Measurement, index: int, indenter: AbstractIndenter, rows: np.ndarray, variant: np.ndarray, solid: AbstractSolid
) -> Plan:
    origin = _origins(measurement, rows, solid)
    imposed = measurement.table[measurement.imposed][rows]
    origins, pose = np.unique(np.round(origin, 9), axis=0, return_inverse=True)
    key = np.column_stack([pose.reshape(-1), variant, imposed])
    cases, case = np.unique(key, axis=0, return_inverse=True)
    which, tissue = cases[:, :2].astype(int).T
    return Plan(measurement, index, indenter, rows, origins, which, cases[:, 2], tissue, case.reshape(-1))


def _origins(measurement: Measurement, rows: np.ndarray, solid: AbstractSolid) -> np.ndarray:
    """(rows, 2): where the indenter's own origin stands, (x, z) mm."""
    if measurement.kind != "spike_rate":
        return np.tile(site(solid, measurement), (len(rows), 1))
    receptor = _receptor(measurement)
    origin = np.tile(skin_point(solid, receptor.z, receptor.theta), (len(rows), 1))
    origin[:, "xz".index(measurement.direction)] += measurement.table["position"][rows]
    return origin


def _receptor(measurement: Measurement) -> Receptor:
    if measurement.receptor is None:
        raise InputError(
            "spike rates need the place of their receptor",
            file=measurement.file,
            place="receptor",
            remedy="write receptor: {depth_mm: ..., z_mm: ..., theta_deg: ...} in the sidecar or under model:",
        )
    return measurement.receptor


LINE_SPACING = 0.2  # mm: a wedge is a singular line, its profile beside the load wants a few nodes to the millimetre
PROBE_SPACING, WIDE = 0.25, 2.0  # of the probe's radius; of the pad's spacing, from which radius on that spacing is fine enough
PROBE_CORE, SOON = 0.8, 1.5  # of the radius, and growth: a finer patch under a probe
SPHERE_SPACING = 0.1  # of the radius of a ball's contact, where the pad's own spacing has no limit
RECEPTOR_SPACING, RECEPTOR_PATCH = 0.25, 1.4  # of its depth: strain that deep varies over as much as the depth, along the skin and down


def foci(
    planned: list[Plan], solid: AbstractSolid, pad_spacing: float, least: float = 0.0, probe_spacing: float = PROBE_SPACING
) -> tuple[Focus, ...]:
    """Where the mesh must be finer than the pad's own spacing, down to the `least`: under wedges, under probes smaller than it, and around
    receptors; under balls too, where the pad's spacing may be anything (inf). `probe_spacing`: of a probe's radius.
    """
    found: dict[Focus, None] = {}
    for plan in planned:
        if plan.measurement.kind == "spike_rate":
            at = _receptor(plan.measurement)
            found[Focus("point", at.z, at.theta, RECEPTOR_SPACING * at.depth, RECEPTOR_PATCH * at.depth, growth=0.8)] = None
        for x, z in plan.origins:
            if isinstance(plan.indenter, Line):
                found[_line_focus(plan.indenter, solid, x, z, plan.deepest)] = None
            elif isinstance(plan.indenter, (Point, FlatCylinder)) and (radius := float(plan.indenter.radius)) < WIDE * pad_spacing:
                found[_probe_focus(radius, z, _theta(solid, x, z), probe_spacing)] = None
            elif isinstance(plan.indenter, Sphere) and math.isinf(pad_spacing):
                touching = _contact_radius(float(plan.indenter.radius), plan)
                found[Focus("point", z, _theta(solid, x, z), SPHERE_SPACING * touching, touching, growth=1.0)] = None
    clipped = dict.fromkeys(dataclasses.replace(focus, size=max(focus.size, least)) for focus in found)
    return tuple(focus for focus in clipped if focus.size < pad_spacing)


def _probe_focus(radius: float, z: float, theta: float, spacing: float) -> Focus:
    """A patch as wide as the probe; a finer one is hardly wider than what a rounded probe touches at first, and ends soon."""
    extent, growth = (PROBE_CORE * radius, SOON) if spacing < PROBE_SPACING else (radius, 1.0)
    return Focus("point", z, theta, spacing * radius, extent, growth=growth)


def _contact_radius(radius: float, plan: Plan) -> float:
    """Of a ball where it is pressed deepest, a^2 = R d, mm (Hertz, 1882). Under a force nobody knows how deep that is: then as if by half
    of the ball's radius.
    """
    return math.sqrt(radius * min(0.5 * radius if plan.measurement.controlled == "force" else plan.deepest, radius))


def tips(planned: list[Plan], solid: AbstractSolid, pad_spacing: float) -> tuple[Focus, ...]:
    """No more than it takes for nodes to lie under every probe: a spacing of its radius."""
    found: dict[Focus, None] = {}
    for plan in planned:
        if isinstance(plan.indenter, (Point, FlatCylinder)):
            radius = float(plan.indenter.radius)
            found |= {Focus("tip", z, _theta(solid, x, z), radius, radius, growth=TIP_GROWTH): None for x, z in plan.origins}
    return tuple(focus for focus in found if focus.size < pad_spacing)


def _theta(solid: AbstractSolid, x: float, z: float) -> float:
    """Angle of the pad's skin at (x, z) about the section's centre."""
    at = np.linspace(np.pi, 2 * np.pi, 721)
    return float(at[np.argmin(np.abs(solid.surface(np.full(721, z), at)[:, 0] - x))])


def _line_focus(line: Line, solid: AbstractSolid, x: float, z: float, travel: float) -> Focus:
    """A strip as long as the skin that lies within `travel` of the wedge's first contact."""
    if line.along == "z":
        s = np.linspace(0.0, solid.length, 801)[1:-1]
        height, s = solid.pad_y(s), s - z
    else:
        points = solid.surface(np.full(721, z), np.linspace(np.pi, 2 * np.pi, 721))
        height, s = points[:, 1], points[:, 0] - x
    reached = np.abs(s[height < height.min() + travel])
    return Focus("line", z, _theta(solid, x, z), LINE_SPACING, float(reached.max()), line.along, growth=1.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Skin:
    """The skin that rigs touch: a part of it for each pose.

    - `pad`: all of it. `swept`: whether some indenter is moved over it, and every node of it is a column of its own.
    - `places`: of each rig where its nodes stand among the columns, its contact geometry, and, for a single pose, the columns themselves.
    """

    planned: list[Plan]
    pad: Pad
    swept: bool
    places: list[tuple[Int[Array, "_ _"], Interface, sp.csc_matrix | None]]

    def serves(self, planned: list[Plan]) -> bool:
        """Whether these plans press the same shapes at the same places."""

        def alike(one: Plan, other: Plan) -> bool:
            return np.array_equal(one.origins, other.origins) and bool(eqx.tree_equal(one.indenter, other.indenter))

        return all(map(alike, self.planned, planned))

    def is_alike(self, one: Finger, other: Finger) -> bool:
        """Whether all of it is at the same place in two fingers that have the same elements."""
        touched = np.unique(np.asarray(self.pad.nodes))
        return np.array_equal(one.nodes[touched], other.nodes[touched])


@dataclasses.dataclass(frozen=True, eq=False)
class Laid:
    """Rigs laid out on a mesh: the columns that they read and press, the layer of each receptor, and the skin that they touch."""

    rigs: tuple[Rig, ...]
    columns: sp.csc_matrix
    receptor_layer: dict[int, int]
    skin: Skin


def lay(planned: list[Plan], finger: Finger, body: Body, solid: AbstractSolid, known: Skin | None = None) -> Laid:
    """Choose the skin that can be touched, and number everything that is pressed or read. `known`: the skin of other plans on this mesh.

    Under one pose the columns are the pressures themselves, a quarter as many as the nodes that they press on; an indenter that is
    swept over the skin is given all the nodes that it can reach, so that every pose is a product with the same matrix.
    """
    skin = known if known is not None and known.serves(planned) else _skin(planned, finger)
    skin_layer = outermost(skin.pad, finger)
    matrices = [functionals(skin.pad, len(finger.nodes))] if skin.swept else []
    rigs, layers = [], {}
    for plan, (columns, geometry, pressed) in zip(planned, skin.places, strict=True):
        observed, reading, layer = _readings(plan, finger, body, solid)
        reading = reading + _append(matrices, observed)
        if layer is not None:
            layers[plan.index] = layer
        if pressed is not None:
            columns = jax.device_put(np.asarray(columns) + _append(matrices, pressed))
        beneath = None if pressed is None else _beneath(plan, finger, solid, geometry, pressed)
        rigs.append(_rig(plan, columns, geometry, reading, skin_layer, beneath))
    count = sum(matrix.shape[1] for matrix in matrices)
    matrices.append(sp.csc_matrix((3 * len(finger.nodes), -count % COLUMNS)))
    return Laid(tuple(rigs), sp.hstack(matrices).tocsc(), layers, skin)


def _skin(planned: list[Plan], finger: Finger) -> Skin:
    limit = LARGEST_STRAIN_SHARE * float(np.ptp(finger.nodes[:, 1]))
    wanted = [_indentations(plan, limit) for plan in planned]
    pad = pad_for(finger, [one for each in wanted for one in each])
    places = []
    for plan, indentations in zip(planned, wanted, strict=True):
        cut = windows(pad, indentations)
        columns, geometry, pressed = cut.columns, _interfaces(plan.indenter, cut, jnp.asarray(plan.origins)), None
        if len(plan.origins) == 1:
            pressed, geometry = _pressures(cut, geometry, len(finger.nodes))
            columns = jax.device_put(filled(np.arange(pressed.shape[1]), len(geometry.area[0]))[None])
        places.append((columns, geometry, pressed))
    return Skin(planned, pad, any(len(plan.origins) > 1 for plan in planned), places)


def _append(matrices: list[sp.csc_matrix], more: sp.csc_matrix | None) -> int:
    """Add columns to the list, and say where they begin."""
    begin = sum(matrix.shape[1] for matrix in matrices)
    if more is not None:
        matrices.append(more)
    return begin


@eqx.filter_jit
def _interfaces(indenter: AbstractIndenter, cut: Pad, origins: Float[Array, "poses 2"]) -> Interface:
    return jax.vmap(lambda one, at: interface(one, indenter, (at[0], at[1])))(cut, origins)


def _pressures(cut: Pad, geometry: Interface, nodes: int) -> tuple[sp.csc_matrix, Interface]:
    """The hats of a single pose as columns (3n, k), and the interface that presses on them instead of on nodes, with `room` for hats that
    bear nothing.
    """
    kept = np.flatnonzero(np.asarray(geometry.area)[0] > 0)
    if not len(kept):
        remedy = "write a smaller pad_mm, or least_mm, under finger: resolution:"
        raise InputError("the mesh is too coarse for this indenter: no node of the skin lies under it", place="indenter", remedy=remedy)
    load = sp.coo_matrix(np.asarray(geometry.load)[0][:, kept])
    rows = 3 * np.asarray(cut.nodes)[0][load.row] + 1
    matrix = sp.csc_matrix((load.data, (rows, load.col)), shape=(3 * nodes, len(kept)))
    pressing = only(jax.tree.map(lambda leaf: np.asarray(leaf)[0], geometry), kept, np.eye(len(kept)))
    return matrix, jax.tree.map(lambda leaf: jax.device_put(leaf[None]), _with_room(pressing))


def _with_room(pressing: Interface) -> Interface:
    """An interface that presses on columns of its own, on the host, with hats that bear nothing and facets of no area."""
    hats, facets = room(len(pressing.area)), room(len(pressing.pieces))
    overlap, area, rim = (filled(np.asarray(part), hats) for part in (pressing.overlap, pressing.area, pressing.rim))
    pieces, covered = (filled(np.asarray(part), facets) for part in (pressing.pieces, pressing.covered))
    load = np.diag((np.arange(hats) < len(pressing.area)).astype(float))
    narrow = () if pressing.narrow is None else (filled(np.asarray(pressing.narrow), hats),)
    rest = overlap, area, rim, np.asarray(pressing.lowest), pieces, covered, *narrow
    return jax.tree.unflatten(jax.tree.structure(pressing), (load, *rest))


def _indentations(plan: Plan, limit: float) -> list[Indentation]:
    forced = plan.measurement.controlled == "force"
    expected = plan.measurement.table.get("displacement") if forced else plan.imposed
    travel = float(np.max(expected)) * (1.3 if forced else 1.0) if expected is not None else limit
    return [Indentation(plan.indenter, (float(x), float(z)), min(max(travel, 0.05), limit)) for x, z in plan.origins]


def _readings(plan: Plan, finger: Finger, body: Body, solid: AbstractSolid) -> tuple[sp.csc_matrix | None, np.ndarray, int | None]:
    """Columns observed beside the pad, which of them each row reads, and the layer of the receptor."""
    measurement, rows = plan.measurement, plan.rows
    if measurement.kind == "deflection_profile":
        unique, reading = np.unique(np.round(_observed(plan, solid), 9), axis=0, return_inverse=True)
        return surface_functionals(finger, unique), reading.reshape(-1), None
    if measurement.kind == "spike_rate":
        matrix, layer = strain_columns(body, receptor_point(solid, _receptor(measurement)))
        return matrix, np.zeros(len(rows), int), layer
    return None, np.zeros(len(rows), int), None


def _observed(plan: Plan, solid: AbstractSolid) -> Float[np.ndarray, "r 2"]:
    """(x, z), mm, of the points of the skin whose deflection the rows tell."""
    measurement = plan.measurement
    points = np.tile(site(solid, measurement), (len(plan.rows), 1))
    points[:, "xz".index(measurement.direction)] += measurement.table["distance"][plan.rows]
    return points


def receptor_point(solid: AbstractSolid, receptor: Receptor) -> np.ndarray:
    """(3,), mm: `depth` below the skin, on the way to the section's centre."""
    z, theta = np.array([receptor.z]), np.array([receptor.theta])
    radius = solid.radius(0, z, theta)[0] - receptor.depth
    x, y = solid.centre(z)[0] + radius * np.array([np.cos(receptor.theta), np.sin(receptor.theta)])
    return np.array([x, y, receptor.z])


def outermost(pad: Pad, finger: Finger) -> int:
    """The layer that most of the pad's skin is the surface of."""
    outside = np.isin(finger.tets[:, :4], np.asarray(pad.nodes)[np.asarray(pad.facets)[:, :3]]).sum(axis=1) == 3
    return int(np.bincount(finger.layer[outside]).argmax()) if outside.any() else 0


def _beneath(
    plan: Plan, finger: Finger, solid: AbstractSolid, geometry: Interface, pressed: sp.csc_matrix
) -> Float[Array, "r k"] | None:
    """See `Rig`. A hat stands where its load has its centre; between two of them the load per length is linear."""
    line = plan.indenter
    if not isinstance(line, Line) or plan.measurement.kind != "deflection_profile":
        return None
    along, across = ((0, 1), (1, 0))[line.along == "z"]
    place = finger.nodes[:, (0, 2)[along]]
    stands = (pressed.T @ np.repeat(place, 3)) / np.asarray(pressed.sum(axis=0)).ravel()
    order, half = np.argsort(stands), 0.5 * float(line.width)
    at = _observed(plan, solid)
    share = np.zeros((len(at), len(stands)))
    for hat, peak in zip(order, np.eye(len(order)), strict=True):
        share[:, hat] = np.interp(at[:, along], stands[order], peak, left=0.0, right=0.0)
    area, narrow = (np.asarray(part)[0, : len(stands)] for part in (geometry.area, geometry.narrow))
    blunt = half * np.exp(narrow * area / (2 * half) + RIGID)
    deeper = beside_tip(at[:, across, None] - plan.origins[0, across], half, blunt)
    return jax.device_put(filled((share * deeper * 2 * half).T, geometry.area.shape[1]).T)


def _rig(
    plan: Plan,
    columns: Int[Array, "poses p"],
    geometry: Interface,
    reading: np.ndarray,
    layer: int,
    beneath: Float[Array, "r k"] | None,
) -> Rig:
    return Rig(
        indenter=plan.indenter,
        columns=columns,
        interface=geometry,
        pose=jnp.asarray(plan.pose),
        imposed=jnp.asarray(plan.imposed),
        variant=jnp.asarray(plan.variant),
        row=jnp.asarray(plan.rows),
        case=jnp.asarray(plan.case),
        reading=jnp.asarray(reading),
        context=_context(plan),
        measurement=plan.index,
        kind=plan.measurement.kind,
        forced=plan.measurement.controlled == "force",
        layer=layer,
        beneath=beneath,
    )


def _context(plan: Plan) -> Context:
    """What the rows of a plan say of themselves; a trace is what shares every label, in the order of time."""
    measurement, rows = plan.measurement, plan.rows
    numbers = {name: each[rows] for name, each in measurement.table.items() if np.issubdtype(each.dtype, np.number)}
    labels = [each[rows].astype(str) for name, each in measurement.table.items() if name not in numbers]
    trace = np.zeros(len(rows), int)
    if labels:
        trace = np.unique(np.column_stack(labels), axis=0, return_inverse=True)[1].reshape(-1)
    order = np.lexsort((numbers.get("time", np.arange(len(rows))), trace))
    return Context(
        table={name: jnp.asarray(each) for name, each in numbers.items()},
        order=jnp.asarray(order),
        previous=jnp.asarray(_previous(order, trace)),
        trace=jnp.asarray(trace),
        measurement=measurement.name,
        kind=measurement.kind,
        forced=measurement.controlled == "force",
    )


def _previous(order: np.ndarray, trace: np.ndarray) -> np.ndarray:
    """(rows,): the row before in the same trace; itself for a first one."""
    previous = np.arange(len(trace))
    follows = trace[order[1:]] == trace[order[:-1]]
    previous[order[1:][follows]] = order[:-1][follows]
    return previous
