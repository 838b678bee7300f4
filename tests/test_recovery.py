"""Strain recovered from a patch: exact for cubics, a power better than an element's own elsewhere, and blind to other layers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from fingerjax.fem import element
from fingerjax.fem.assembly import Assembled
from fingerjax.fem.body import Body, assemble_body
from fingerjax.fem.locate import Locator
from fingerjax.fem.recovery import ON_INTERFACE, VOIGT, Recovery, strain_columns
from fingerjax.mesh.topology import oriented, quadratic

from .fem_tools import consistent_load, cube, cube_body

Field = Callable[[np.ndarray], np.ndarray]
POINTS = np.random.default_rng(1).uniform(0.3, 0.7, (24, 3))


def shaken(divisions: int) -> Body:
    """A unit cube whose vertices inside were moved at random, by up to a quarter of a cell."""
    corners = np.unique(cube(divisions)[1][:, :4])
    nodes, tets = cube(divisions)
    inside = np.all((nodes > 1e-9) & (nodes < 1 - 1e-9), axis=1)
    shift = np.random.default_rng(divisions).uniform(-0.25, 0.25, nodes.shape) / divisions
    moved = nodes[corners] + shift[corners] * inside[corners, None]
    return _body(moved, tets[:, :4])


def _body(vertices: np.ndarray, tets: np.ndarray) -> Body:
    nodes, tets, _ = quadratic(vertices, oriented(vertices, tets))
    return assemble_body(nodes, tets, np.zeros(len(tets), int), np.zeros(len(nodes), bool))


def wild(edge: float) -> Body:
    """A unit cube as pytetwild fills it, never twice alike."""
    pytetwild = pytest.importorskip("pytetwild")
    nodes, tets = cube(1)
    faces = np.concatenate([tets[:, list(face)] for face in ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    vertices, tets = pytetwild.tetrahedralize(nodes[:8], faces[first[count == 1]], edge_length_fac=edge, optimize=True)[:2]
    return _body(np.asarray(vertices, float), np.asarray(tets, np.int64))


def own_strain(body: Body, locate: Locator, u: np.ndarray, point: np.ndarray) -> np.ndarray:
    """The strain of the element that holds the point."""
    where, local = locate(point)
    nodes = np.asarray(body.tets)[where]
    slopes = element.slopes(local[None], body.order)[0]
    return _voigt(u[nodes].T @ slopes @ np.linalg.inv(np.asarray(body.nodes)[nodes].T @ slopes))


def _voigt(gradient: np.ndarray) -> np.ndarray:
    return np.array([gradient[i, j] + (gradient[j, i] if i != j else 0) for i, j in VOIGT])


def wavy(x: np.ndarray) -> np.ndarray:
    a, b, c = x.T
    return np.stack([np.sin(3 * a + b) * np.cos(2 * c), np.cos(2 * b - a) * np.sin(3 * c), np.exp(a - c) * np.sin(2 * b)], axis=1)


def exact_strain(field: Field, point: np.ndarray, step: float = 1e-5) -> np.ndarray:
    moved = np.stack([(field(point[None] + step * e) - field(point[None] - step * e))[0] / (2 * step) for e in np.eye(3)], axis=1)
    return _voigt(moved)


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def errors(body: Body, u: np.ndarray, field: Field, mean: Callable[[np.ndarray], float] = rms) -> tuple[float, float]:
    """The mean error of the strain over the points: of the elements' own, and of the recovered one."""
    recovery, exact = Recovery(body), np.array([exact_strain(field, point) for point in POINTS])
    own = np.array([own_strain(body, recovery.locate, u, point) for point in POINTS]) - exact
    recovered = (recovery.strains(POINTS)[0].T @ u.ravel()).reshape(-1, 6) - exact
    return mean(own), mean(recovered)


def test_the_strain_of_any_cubic_field_is_read_exactly():
    body, random = shaken(4), np.random.default_rng(0).normal(size=(3, 20))

    def cubic(x: np.ndarray) -> np.ndarray:
        powers = [x[:, 0] ** i * x[:, 1] ** j * x[:, 2] ** k for i in range(4) for j in range(4 - i) for k in range(4 - i - j)]
        return (random @ np.array(powers)).T

    own, recovered = errors(body, cubic(np.asarray(body.nodes)), cubic)
    assert recovered < 1e-8 and own > 1e-2


def test_interpolated_fields_gain_a_power_of_the_mesh():
    own, recovered = np.array([errors(body, wavy(np.asarray(body.nodes)), wavy) for body in (shaken(5), shaken(10))]).T
    assert 1.6 < np.log2(own[0] / own[1]) < 2.4
    assert np.log2(recovered[0] / recovered[1]) > 2.7


def solved(body: Body, field: Field, lame: tuple[float, float] = (1.0, 1.0)) -> np.ndarray:
    """The finite-element solution whose exact one is `field`, prescribed all around the cube."""
    step, lam, mu = 1e-3, *lame

    def force(x: np.ndarray) -> np.ndarray:
        def moved(i: int, j: int) -> np.ndarray:
            a, b = step * np.eye(3)[i], step * np.eye(3)[j]
            return (field(x + a + b) - field(x + a - b) - field(x - a + b) + field(x - a - b)) / (4 * step**2)

        second = [[moved(i, j) for j in range(3)] for i in range(3)]
        divergence = np.stack([sum(second[i][j][:, j] for j in range(3)) for i in range(3)], axis=1)
        return -(lam + mu) * divergence - mu * sum(second[j][j] for j in range(3))

    K = Assembled(body, upper=False).matrix(np.array([[lam] * 5, [mu] * 5]))
    nodes = np.asarray(body.nodes)
    around = np.any((nodes < 1e-9) | (nodes > 1 - 1e-9), axis=1)
    u = np.where(around[:, None], field(nodes), 0.0).ravel()
    free = np.flatnonzero(np.repeat(~around, 3))
    right, inner = (consistent_load(body, force).ravel() - K @ u)[free], K[free][:, free]
    u[free] += spla.cg(inner, right, rtol=1e-8, M=sp.diags(1 / inner.diagonal()))[0]
    return u.reshape(-1, 3)


def test_solutions_gain_on_irregular_meshes():
    """A manufactured solution. Its nodal values are not those of the field, so the gain is smaller than an interpolant's."""
    own, recovered = np.array([errors(body, solved(body, wavy), wavy) for body in (shaken(4), shaken(8))]).T
    assert np.log2(own[0] / own[1]) < 2.1 < np.log2(recovered[0] / recovered[1])
    assert recovered[0] < 0.4 * own[0] and recovered[1] < 0.2 * own[1]


def test_solutions_gain_on_a_mesh_of_pytetwild():
    """At half of the points at the least: one flat element may spoil the recovery at its own."""

    def middle(errors: np.ndarray) -> float:
        return float(np.median(np.linalg.norm(errors, axis=1)))

    body = wild(0.12)
    own, recovered = errors(body, solved(body, wavy), wavy, middle)
    assert recovered < 0.4 * own


def test_each_side_of_an_interface_is_read_from_its_own_layer():
    """A field with a kink where layers meet: its strain is that of its own side, and on the interface that of the outer."""
    body = cube_body(6, layers=2)

    def kinked(x: np.ndarray) -> np.ndarray:
        below = x[:, 1] > 0.5
        return np.stack([x[:, 0] ** 2, np.where(below, 5 * (x[:, 1] - 0.5), x[:, 1] - 0.5), x[:, 2] * x[:, 1]], axis=1)

    u = kinked(np.asarray(body.nodes)).ravel()
    for y, side in ((0.48, 0), (0.499, 0), (0.5, 0), (0.5 + 0.9 * ON_INTERFACE, 0), (0.5 + 1.1 * ON_INTERFACE, 1)):
        columns, layer = strain_columns(body, np.array([0.43, y, 0.57]))
        assert layer == side
        slope = (1.0, 5.0)[side]
        np.testing.assert_allclose(columns.T @ u, [0.86, slope, y, 0.57, 0, 0], atol=1e-9)


def test_a_layer_of_one_element_is_quadratic_across_and_cubic_along():
    body = cube_body(6, layers=6)
    nodes = np.asarray(body.nodes)
    u = np.stack([nodes[:, 0] ** 3, nodes[:, 1] ** 2, nodes[:, 0] * nodes[:, 1]], axis=1).ravel()
    point = np.array([0.45, 0.58, 0.5])
    columns, layer = strain_columns(body, point)
    recovery = Recovery(body)
    around = recovery.patch(recovery.locate(point)[0])
    assert layer == 3 and len(np.unique(np.round(nodes[around, 1], 9))) == 3
    np.testing.assert_allclose(columns.T @ u, [3 * 0.45**2, 2 * 0.58, 0, 0.45, 0.58, 0], atol=1e-9)


def test_the_slope_of_a_strain_along_a_direction_is_that_of_its_polynomial():
    body = shaken(4)
    nodes = np.asarray(body.nodes)
    u = np.stack([nodes[:, 0] ** 3, nodes[:, 1] ** 2 * nodes[:, 0], nodes[:, 2] * nodes[:, 1]], axis=1).ravel()
    point, along = np.array([[0.45, 0.58, 0.5]]), np.array([[0.6, 0.0, 0.8]])
    slope = Recovery(body).slopes(point, along).T @ u
    np.testing.assert_allclose(slope, [6 * 0.45 * 0.6, 2 * 0.58 * 0.6, 0, 0.8, 0, 0], atol=1e-9)


def test_a_point_outside_is_refused():
    with pytest.raises(ValueError, match="lies outside the meshed tissue"):
        strain_columns(cube_body(2), np.array([0.5, -0.2, 0.5]))
