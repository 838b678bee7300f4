"""Rigid, frictionless indenters pressed towards +y on a linear body, by a penalty at surface points that is
raised until it is idle.

The skin may not be below the indenter: at every covered point u_y >= Y + h(x, z) - y, with y the undeformed
surface, h <= 0 the indenter's shape and Y the height of its highest point.  Pressure acts along +y on the
area projected on the x-z plane.  The body enters through its compliance at the nodes of the pad, found
once; every indentation after that is a small dense problem whose energy is convex, minimised by Newton's
method on the set of points in contact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from .bricks import NATURAL, Array, Bricks, SlabFactor, assemble, shape_slopes, shape_values, strain_rows

STEEP = np.radians(68.0)
"""Walls steeper than this are flanks that do not touch."""


@dataclass(frozen=True)
class Indenter:
    """A shape: `height(x, z)` with maximum 0, -inf where there is no material; `edges` are z of its kinks,
    relative to it."""

    name: str
    height: Callable[[Array, Array], Array]
    edges: tuple[float, ...] = ()


def _rounded(distance: Array, half: float, edge: float) -> Array:
    """Height of a flat of half-width `half` whose edge is a quarter circle of radius `edge`."""
    over = np.maximum(distance - (half - edge), 0.0)
    inside = np.minimum(over, edge) if edge else over
    drop = edge - np.sqrt(np.maximum(edge**2 - inside**2, 0.0))
    return np.where(over <= edge * np.sin(STEEP) + 1e-12, -drop, -np.inf)


def flat_plate() -> Indenter:
    """A plate larger than the finger."""
    return Indenter("flat_plate", lambda x, z: np.zeros(np.broadcast(x, z).shape))


def line(width: float = 0.05) -> Indenter:
    """A wedge across the finger (along x) whose tip is a flat of `width` mm along z."""
    return Indenter(
        "line", lambda x, z: _rounded(np.abs(z) + 0.0 * x, 0.5 * width, 0.0), (-0.5 * width, 0.5 * width)
    )


def bar(width: float, edge_radius: float) -> Indenter:
    """A rectangular bar across the finger with rounded edges."""
    foot = 0.5 * width - edge_radius
    ends = (foot, foot + edge_radius * np.sin(STEEP))
    edges = (-ends[1], -ends[0], ends[0], ends[1])
    return Indenter("bar", lambda x, z: _rounded(np.abs(z) + 0.0 * x, 0.5 * width, edge_radius), edges)


def probe(radius: float, edge_radius: float = 0.0) -> Indenter:
    """A flat-ended cylindrical probe whose axis is y."""
    return Indenter("point", lambda x, z: _rounded(np.hypot(x, z), radius, edge_radius))


def cylinder(radius: float) -> Indenter:
    """A cylinder across the finger (its axis along x)."""
    return Indenter("cylinder", lambda x, z: _arc(np.abs(z) + 0.0 * x, radius))


def sphere(radius: float) -> Indenter:
    """A ball."""
    return Indenter("sphere", lambda x, z: _arc(np.hypot(x, z), radius))


def _arc(distance: Array, radius: float) -> Array:
    drop = radius - np.sqrt(np.maximum(radius**2 - distance**2, 0.0))
    return np.where(distance <= radius * np.sin(STEEP), -drop, -np.inf)


@dataclass(frozen=True)
class Body:
    """A meshed, factored body seen from its pad.

    pad (m,) node numbers of the skin that can be touched; border (m,) those at the rim of that skin; faces
    (f, 8) bricks' outer nodes as positions in `pad`; corners (f, 8, 3) their places; compliance (m, m) mm/N
    of u_y under forces along y; readings (r, m) per N: first u_y at the `watched`
    nodes, then 6 strains a receptor; `residual` of the linear solves; `symmetry` by how much a computed
    force must be multiplied to be that of the whole body.
    """

    mesh: Bricks
    pad: Array
    border: Array
    faces: Array
    corners: Array
    compliance: Array
    watched: Array
    readings: Array
    receptor_layers: tuple[int, ...]
    residual: float
    symmetry: float


def condense(
    mesh: Bricks,
    moduli: Array,
    poisson: float,
    touchable: Callable[[Array], Array],
    *,
    watched: Array | None = None,
    receptors: tuple[tuple[float, float, float], ...] = (),
    symmetry: float = 2.0,
    **orders: int,
) -> Body:
    """Factor a body of four plain layers and find what unit forces along y on the touchable skin do to it.

    `touchable` picks outer faces by their centres (f, 3); `watched` are nodes whose u_y will be read;
    `receptors` points.
    """
    factor = SlabFactor(mesh, assemble(mesh, moduli, poisson, **orders))
    return condense_factored(mesh, factor, touchable, watched=watched, receptors=receptors, symmetry=symmetry)


def condense_factored(
    mesh: Bricks,
    factor: SlabFactor,
    touchable: Callable[[Array], Array],
    *,
    watched: Array | None = None,
    receptors: tuple[tuple[float, float, float], ...] = (),
    symmetry: float = 2.0,
) -> Body:
    """As `condense`, of a body whose stiffness, whatever it is, has been factored."""
    pad, faces, border = pad_faces(mesh, touchable)
    watched = np.array([], int) if watched is None else watched
    strains = [strain_rows(mesh, np.array(p)) for p in receptors]
    rows = sp.vstack([_y_rows(mesh, pad), _y_rows(mesh, watched), *(s for s, _ in strains)]).tocsr()
    found, residual = [], 0.0
    for part in np.array_split(np.arange(len(pad)), 1 + len(pad) // 250):
        load = _y_rows(mesh, pad[part]).T.toarray()
        answer = factor.solve(load)
        residual = max(residual, factor.residual(load, answer))
        found.append(rows @ answer)
    seen = np.concatenate(found, axis=1)
    compliance = 0.5 * (seen[: len(pad)] + seen[: len(pad)].T)
    return Body(
        mesh,
        pad,
        border,
        faces,
        mesh.nodes[pad][faces],
        compliance,
        watched,
        seen[len(pad) :],
        tuple(layer for _, layer in strains),
        residual,
        symmetry,
    )


def pad_faces(mesh: Bricks, touchable: Callable[[Array], Array]) -> tuple[Array, Array, Array]:
    """Nodes (m,) of the skin that can be touched, its faces (f, 8) as positions among them, and which nodes
    (m,) lie at its rim."""
    outer = outer_faces(mesh)
    chosen = touchable(mesh.nodes[outer].mean(1))
    pad, faces = np.unique(outer[chosen], return_inverse=True)
    return pad, faces.reshape(-1, 8), np.isin(pad, outer[~chosen])


def _y_rows(mesh: Bricks, nodes: Array) -> sp.csr_matrix:
    return sp.csr_matrix(
        (np.ones(len(nodes)), (np.arange(len(nodes)), 3 * nodes + 1)), (len(nodes), 3 * len(mesh.nodes))
    )


_FACE = np.flatnonzero(NATURAL[:, 0] == 1.0)


def outer_faces(mesh: Bricks) -> Array:
    """Nodes (f, 8) of the outermost bricks' outer faces, in the order of the 20-node brick."""
    i, j, k = mesh.cells
    return mesh.bricks.reshape(i, j, k, 20)[-1].reshape(-1, 20)[:, _FACE]


@dataclass(frozen=True)
class Points:
    """Contact points: rows (q, m) interpolating pad values, x, y, z (q,) on the undeformed skin, area (q,)
    on the x-z plane."""

    rows: sp.csr_matrix
    x: Array
    y: Array
    z: Array
    area: Array


def contact_points(body: Body, breaks: Array | tuple[float, ...] = (), order: int = 3) -> Points:
    """Gauss points of the pad's faces, with faces cut across z at `breaks` (mm) so that an indenter's kinks
    fall between points."""
    gauss, weight = np.polynomial.legendre.leggauss(order)
    breaks = np.asarray(breaks, float)
    low, high = body.corners[:, :, 2].min(1), body.corners[:, :, 2].max(1)
    whole = [f for f in range(len(low)) if not np.any((breaks > low[f]) & (breaks < high[f]))]
    cut = [f for f in range(len(low)) if np.any((breaks > low[f]) & (breaks < high[f]))]
    jobs = [(np.array(whole, int), np.array([-1.0, 1.0]))]
    jobs += [(np.array([f]), _cuts(body.corners[f], breaks)) for f in cut]
    parts = []
    for faces, stops in jobs:
        middle, half = 0.5 * (stops[1:] + stops[:-1]), 0.5 * np.diff(stops)
        along, share = (middle[:, None] + half[:, None] * gauss).ravel(), (half[:, None] * weight).ravel()
        at = np.stack([np.ones((order, len(along))), *np.meshgrid(gauss, along, indexing="ij")], -1).reshape(
            -1, 3
        )
        parts.append(_points(body, faces, at, (weight[:, None] * share).ravel()))
    rows = sp.vstack([p.rows for p in parts]).tocsr()
    x, y, z, area = (np.concatenate([getattr(p, n) for p in parts]) for n in ("x", "y", "z", "area"))
    return Points(rows, x, y, z, area)


def _cuts(corners: Array, breaks: Array) -> Array:
    """Natural coordinates of the cuts of one face.  z depends on the third coordinate alone, as a
    quadratic."""
    ends = NATURAL[_FACE][:, 2]
    a, b = corners[ends == -1, 2].mean(), corners[ends == 1, 2].mean()
    middle = corners[ends == 0, 2].mean()
    bend, slope = 0.5 * (a + b) - middle, 0.5 * (b - a)
    inside = breaks[(breaks > a) & (breaks < b)] - middle
    at = inside / slope
    for _ in range(20):
        at -= (bend * at**2 + slope * at - inside) / (2 * bend * at + slope)
    return np.concatenate([[-1.0], np.sort(at), [1.0]])


def _points(body: Body, faces: Array, at: Array, weight: Array) -> Points:
    values, slopes = shape_values(at)[:, _FACE], shape_slopes(at)[:, _FACE]
    place = np.einsum("qa,fai->fqi", values, body.corners[faces])
    around, along = (np.einsum("qa,fai->fqi", slopes[:, :, d], body.corners[faces]) for d in (1, 2))
    # the outward normal is around x along; its y part, negative on the pad, is the projected area
    area = -(around[..., 2] * along[..., 0] - around[..., 0] * along[..., 2]) * weight
    count = len(faces) * len(at)
    columns = np.broadcast_to(body.faces[faces][:, None, :], (len(faces), len(at), 8)).ravel()
    data = np.broadcast_to(values, (len(faces), len(at), 8)).ravel()
    rows = sp.csr_matrix((data, columns, np.arange(count + 1) * 8), (count, len(body.pad)))
    x, y, z = (place[..., i].ravel() for i in range(3))
    return Points(rows, x, y, z, np.maximum(area, 0.0).ravel())


@dataclass(frozen=True)
class Press:
    """One indentation: force N along y (whole body), travel mm, nodal forces (m,) and u_y (m,) of the pad,
    points in contact, `deepest` mm by which the skin still passes through the indenter, and `drift`, the
    force's last relative change with the penalty."""

    force: float
    travel: float
    nodal: Array
    displacement: Array
    touching: Array
    deepest: float
    drift: float


def first_contact(points: Points, indenter: Indenter, at: float, x0: float = 0.0) -> float:
    """Height Y of the indenter's highest point when it first touches the undeformed skin."""
    height = indenter.height(points.x - x0, points.z - at)
    return float((points.y - height)[np.isfinite(height)].min())


def press(
    body: Body,
    indenter: Indenter,
    *,
    at: float,
    travel: float,
    order: int = 3,
    split: int = 1,
    tolerance: float = 2e-4,
) -> Press:
    """Press `indenter`, its origin at z = `at`, by `travel` mm from first contact.

    `split` cuts every face into that many strips along z besides the indenter's own kinks.  Raises
    RuntimeError when the set of points in contact does not settle, the penalty stays felt, or contact
    reaches skin that was not declared touchable.
    """
    points, above = overlap(body, indenter, at, order, split)
    near = np.flatnonzero(above > -2.0 * travel)  # skin bulges onto an indenter by less than the travel
    rows, gap, area = points.rows[near], above[near] + travel, points.area[near]
    nodes = np.unique(rows.indices)
    compliance, rows = body.compliance[np.ix_(nodes, nodes)], rows[:, nodes]
    u, pressure, drift = raise_penalty(compliance, rows, gap, area, tolerance)
    nodal = np.zeros(len(body.pad))
    nodal[nodes] = rows.T @ pressure
    if np.any(nodal[body.border] != 0.0):
        raise RuntimeError(
            f"contact at z = {at:g}, travel {travel:g} reached skin that was not made touchable"
        )
    force, deepest = float(pressure.sum()) * body.symmetry, float((gap - rows @ u).max())
    return Press(force, travel, nodal, body.compliance @ nodal, near[pressure > 0], deepest, drift)


def overlap(body: Body, indenter: Indenter, at: float, order: int, split: int) -> tuple[Points, Array]:
    """Contact points and the height of the indenter at first contact above the skin there (<= 0; -inf:
    none)."""
    breaks = at + np.array(indenter.edges)
    if split > 1:
        z = np.unique(body.corners[:, :, 2][:, NATURAL[_FACE][:, 2] != 0].round(9))
        strips = [(z[:-1] * (split - n) + z[1:] * n) / split for n in range(1, split)]
        breaks = np.concatenate([breaks, *strips])
    points = contact_points(body, np.unique(breaks), order)
    height = indenter.height(points.x, points.z - at)
    over = np.isfinite(height) & (points.area > 0.0)
    start = _touching_height(body, indenter, at)
    return points, np.where(over, start + np.where(over, height, 0.0) - points.y, -np.inf)


def raise_penalty(
    compliance: Array, rows: sp.csr_matrix, gap: Array, area: Array, tolerance: float
) -> tuple[Array, Array, float]:
    """Displacements, forces at the points and the force's last relative change, once the penalty is idle.

    Nodes that no contact point touches carry no force and drop out, so the body's stiffness is the inverse of
    the others' compliance.
    """
    stiffness, u = la.inv(compliance), np.zeros(len(compliance))
    load = rows.T @ (area / area.sum())
    penalty = 30.0 / float(load @ compliance @ load) / float(area.sum())  # 30 times the body's own resistance
    force, drift = 0.0, np.inf
    for _ in range(12):
        u = settle(stiffness, rows, gap, penalty * area, u)
        pressure = penalty * area * np.maximum(gap - rows @ u, 0.0)
        before, force = force, float(pressure.sum())
        drift = abs(force - before) / max(force, 1e-300)
        if drift < tolerance:
            return u, pressure, drift
        penalty *= 4.0
    raise RuntimeError(f"force still changes by {drift:.1e} with the penalty; refine the mesh")


def _touching_height(body: Body, indenter: Indenter, at: float) -> float:
    """First contact on the skin sampled finely near the indenter: Gauss points alone would miss the lowest
    point by microns."""
    order = np.argsort(np.abs(body.corners[:, :, 2].mean(1) - at))
    side = np.linspace(-1.0, 1.0, 41)
    grid = np.stack([np.ones((41, 41)), *np.meshgrid(side, side, indexing="ij")], -1).reshape(-1, 3)
    dense = _points(body, order[: max(60, len(order) // 3)], grid, np.ones(len(grid)))
    return first_contact(dense, indenter, at)


def settle(stiffness: Array, rows: sp.csr_matrix, gap: Array, weight: Array, u: Array) -> Array:
    """Minimise u'Su/2 + sum w max(gap - row u, 0)^2/2 over u.  Raises RuntimeError after 80 Newton steps."""

    def energy(v: Array) -> float:
        return 0.5 * float(v @ (stiffness @ v)) + 0.5 * float(weight @ np.maximum(gap - rows @ v, 0.0) ** 2)

    for _ in range(80):
        active = gap - rows @ u > 0.0
        chosen = rows[active]
        held = sp.diags(weight[active])
        tangent = stiffness + (chosen.T @ held @ chosen).toarray()
        target = la.solve(
            tangent, chosen.T @ (weight[active] * gap[active]), assume_a="pos", check_finite=False
        )
        if np.array_equal(gap - rows @ target > 0.0, active):
            return target
        step, now = 1.0, energy(u)
        while energy(u + step * (target - u)) > now and step > 1e-4:
            step *= 0.5
        u = u + step * (target - u)
    raise RuntimeError(
        "contact did not settle in 80 Newton steps; press less deeply in one go or refine the mesh"
    )


def deflection(body: Body, contact: Press) -> Array:
    """u_y, mm, at the body's watched nodes."""
    return body.readings[: len(body.watched)] @ contact.nodal


def receptor_strain(body: Body, contact: Press, which: int = 0) -> Array:
    """Tensor strains (6,) at a receptor, ordered as in `bricks.strain_rows`."""
    start = len(body.watched) + 6 * which
    return body.readings[start : start + 6] @ contact.nodal
