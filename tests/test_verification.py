"""The mechanics against closed forms and against other codes: tubes, spheres, a half-space, Cook's membrane, and one stiffness matrix.

Bodies are held in single directions, so that symmetric quarters will do; elements, integration and assembly are the product's own.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fingerjax.fem.assembly import Assembled
from fingerjax.fem.body import Body, assemble_body, material
from fingerjax.layers import SOFT_LAYERS
from fingerjax.mesh.bodies import sphere_shell

from .fem_tools import constrained, cube_body, face_load, outer_faces, structured
from .helpers import SAME_ARITHMETIC

INNER, OUTER = 1.0, 2.0
FORMS = pytest.mark.parametrize("dilatation", ["pointwise", "mean"])


def lame(youngs_modulus: float, poisson_ratio: float) -> np.ndarray:
    return np.asarray(material(dict.fromkeys(SOFT_LAYERS, youngs_modulus), poisson_ratio).lame())


def at(value: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda coordinate: np.abs(coordinate - value) < 1e-9


# ---- Lame's tube and sphere (1852): inner pressure 1 MPa, Young's modulus 1 MPa ----


def tube(nodes: np.ndarray) -> np.ndarray:
    """A quarter of a ring, half a millimetre long."""
    r, angle = INNER + (OUTER - INNER) * nodes[:, 0], 0.5 * np.pi * nodes[:, 1]
    return np.stack([r * np.cos(angle), r * np.sin(angle), 0.5 * nodes[:, 2]], axis=1)


def tube_error(cells: tuple[int, int, int], poisson_ratio: float, dilatation: str) -> float:
    """Largest error of the radial displacement in plane strain, relative to the largest."""
    body, nu = structured(cells, tube, dilatation), poisson_ratio
    x, y, z = np.asarray(body.nodes).T
    r = np.hypot(x, y)
    held = np.stack([at(0)(x), at(0)(y), at(0)(z) | at(0.5)(z)], axis=1)
    load = face_load(body, outer_faces(body, lambda nodes: at(INNER)(np.hypot(nodes[:, 0], nodes[:, 1]))), 1.0)
    u = constrained(body, lame(1.0, nu), held, load)
    exact = (1 + nu) * INNER**2 / (OUTER**2 - INNER**2) * ((1 - 2 * nu) * r + OUTER**2 / r)
    return float(np.abs((u[:, 0] * x + u[:, 1] * y) / r - exact).max() / exact.max())


@pytest.mark.parametrize(
    ("dilatation", "poisson_ratio", "allowed"),
    [("pointwise", 0.3, 0.002), ("pointwise", 0.48, 0.007), ("mean", 0.3, 0.002), ("mean", 0.48, 0.002), ("mean", 0.4999, 0.0025)],
)
def test_a_thick_tube_under_pressure_widens_as_lame_says(dilatation: str, poisson_ratio: float, allowed: float) -> None:
    coarse, fine = (tube_error(cells, poisson_ratio, dilatation) for cells in ((2, 4, 1), (4, 8, 2)))
    assert fine < allowed
    assert np.log2(coarse / fine) > 2.0


def sphere_error(refined: int, shells: int, poisson_ratio: float, dilatation: str) -> float:
    """Relative error of the mean radial displacement of the inner surface, with its sign."""
    shell, nu = sphere_shell(INNER, OUTER, n=refined, shells=shells), poisson_ratio
    body = assemble_body(shell.nodes, shell.tets, shell.layer, np.zeros(len(shell.nodes), bool), dilatation=dilatation)
    inside = at(INNER)(np.linalg.norm(shell.nodes, axis=1))
    load = face_load(body, outer_faces(body, lambda nodes: at(INNER)(np.linalg.norm(nodes, axis=1))), 1.0)
    assert np.abs(load.sum(axis=0)).max() < 1e-12  # nothing is needed to hold it but what stops it from drifting
    u = constrained(body, lame(1.0, nu), _adrift(shell.nodes), load)
    radial = np.einsum("ni,ni->n", u - u.mean(axis=0), shell.nodes) / np.linalg.norm(shell.nodes, axis=1)
    exact = ((1 - 2 * nu) * INNER + (1 + nu) * OUTER**3 / (2 * INNER**2)) * INNER**3 / (OUTER**3 - INNER**3)
    return float(radial[inside].mean() / exact - 1)


def _adrift(nodes: np.ndarray) -> np.ndarray:
    """Six directions at three points of the skin, enough to stop a body from drifting and turning."""
    held = np.zeros(nodes.shape, bool)
    for which, directions in ((nodes[:, 2].argmax(), [0, 1]), (nodes[:, 2].argmin(), [0, 1]), (nodes[:, 0].argmax(), [1, 2])):
        held[which, directions] = True
    return held


def test_a_thick_sphere_of_nearly_incompressible_tissue_widens_as_lame_says() -> None:
    """Both forms, coming from below as displacements must; with pointwise dilatation ten times as stiffly."""
    mean, pointwise = (sphere_error(2, 3, 0.4999, form) for form in ("mean", "pointwise"))
    assert -0.0025 < mean < 0
    assert -0.025 < pointwise < 5 * mean


# ---- a half-space under a square of pressure (Boussinesq 1885, Love 1929) ----

SIZE, CELLS, LOADED = 20.0, 7, 2  # mm; cells along each edge, crowded about the load as squares; how many of them are loaded
HALF = SIZE * (LOADED / CELLS) ** 2  # mm: half the side of the square


def boussinesq(nodes: np.ndarray, force: float, youngs_modulus: float, poisson_ratio: float) -> np.ndarray:
    """Displacement (n, 3), mm, of the half-space y > 0 under a force, N, along +y at the origin."""
    E, nu, (x, y, z) = youngs_modulus, poisson_ratio, nodes.T
    R = np.maximum(np.linalg.norm(nodes, axis=1), 1e-12)
    outward = y / R**3 - (1 - 2 * nu) / (R * (R + y))
    return force * (1 + nu) / (2 * np.pi * E) * np.stack([x * outward, 2 * (1 - nu) / R + y**2 / R**3, z * outward], axis=1)


def under_pressure(poisson_ratio: float, dilatation: str) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and displacements (n, 3) of a quarter of a block; its far faces move as the half-space does under the whole force."""
    body = structured((CELLS,) * 3, lambda nodes: SIZE * nodes**2, dilatation)
    nodes = np.asarray(body.nodes)
    far = np.any(nodes > SIZE - 1e-9, axis=1)
    held = np.stack([at(0)(nodes[:, 0]) | far, far, at(0)(nodes[:, 2]) | far], axis=1)
    imposed = np.where(far[:, None], boussinesq(nodes, 4 * HALF**2, 1.0, poisson_ratio), 0.0)
    square = outer_faces(body, lambda x: at(0)(x[:, 1]) & (x[:, [0, 2]] < HALF + 1e-9).all(axis=1))
    return nodes, constrained(body, lame(1.0, poisson_ratio), held, face_load(body, square, 1.0), imposed)


def by_patch(r: np.ndarray, z: np.ndarray, poisson_ratio: float) -> np.ndarray:
    """Surface displacement, mm, of the square at points beside it, integrated from Boussinesq's over 12 x 12 Gauss points."""
    place, weight = np.polynomial.legendre.leggauss(12)
    s, t = (grid.ravel() for grid in np.meshgrid(HALF * place, HALF * place))
    w = np.outer(HALF * weight, HALF * weight).ravel()
    distance = np.hypot(r[:, None] - s, z[:, None] - t)
    return (1 - poisson_ratio**2) / np.pi * (w / distance).sum(axis=1)


@pytest.mark.parametrize(("poisson_ratio", "dilatation"), [(0.3, "pointwise"), (0.48, "mean"), (0.4999, "mean")])
def test_a_half_space_under_a_square_of_pressure_sinks_as_boussinesq_and_love_say(poisson_ratio: float, dilatation: str) -> None:
    nodes, u = under_pressure(poisson_ratio, dilatation)
    middle = 8 * np.log(1 + np.sqrt(2)) / np.pi * HALF * (1 - poisson_ratio**2)
    assert u[np.linalg.norm(nodes, axis=1).argmin(), 1] == pytest.approx(middle, rel=0.02)
    r = np.hypot(nodes[:, 0], nodes[:, 2])
    skin = at(0)(nodes[:, 1]) & (nodes < SIZE - 1e-9).all(axis=1)
    beside, away = skin & (r > 3 * HALF), skin & (r > 5 * HALF)
    np.testing.assert_allclose(u[beside, 1], by_patch(nodes[beside, 0], nodes[beside, 2], poisson_ratio), rtol=0.015)
    # A square is not a point: it is felt a^2 / 6 r^2 more, 0.7 % at five times its half side a.
    np.testing.assert_allclose(u[away, 1], 4 * HALF**2 * (1 - poisson_ratio**2) / (np.pi * r[away]), rtol=0.015)


# ---- Cook's membrane: clamped at x = 0, sheared along x = 48, one layer of elements in plane strain ----


def membrane(nodes: np.ndarray) -> np.ndarray:
    x = 48 * nodes[:, 0]
    return np.stack([x, 44 * nodes[:, 0] + (44 - 28 * nodes[:, 0]) * nodes[:, 1], nodes[:, 2]], axis=1)


def lifted(cells: int, tissue: tuple[float, float], force: float, height: float, dilatation: str) -> float:
    """How far the sheared edge rises at (48, height) mm."""
    body = structured((cells, cells, 1), membrane, dilatation)
    nodes = np.asarray(body.nodes)
    clamped = at(0)(nodes[:, 0])
    held = np.stack([clamped, clamped, np.ones(len(nodes), bool)], axis=1)
    load = face_load(body, outer_faces(body, lambda x: at(48)(x[:, 0])), np.array([0.0, force / 16, 0.0]))
    u = constrained(body, lame(*tissue), held, load)
    return float(u[at(48)(nodes[:, 0]) & at(height)(nodes[:, 1]), 1].mean())


def in_plane_strain(youngs_modulus: float, poisson_ratio: float) -> tuple[float, float]:
    """The tissue that is in plane strain what this one is in plane stress."""
    E, nu = youngs_modulus, poisson_ratio
    return E * (1 + 2 * nu) / (1 + nu) ** 2, nu / (1 + nu)


@FORMS
def test_cooks_membrane_rises_by_the_published_height(dilatation: str) -> None:
    """23.96 for E = 1, nu = 1/3 in plane stress, F = 1, at the middle of the edge (Simo & Rifai, 1990)."""
    heights = [lifted(cells, in_plane_strain(1.0, 1 / 3), 1.0, 52.0, dilatation) for cells in (4, 8, 16)]
    assert heights == sorted(heights)
    assert heights[-1] == pytest.approx(23.96, rel=0.002)


@FORMS
def test_cooks_membrane_in_plane_strain_rises_as_other_codes_say(dilatation: str) -> None:
    """32.20 to 32.28 mm at the upper corner for 70 MPa, 1/3 and 6.25 MPa of shear: CalculiX, Code_Aster and Elmer on very fine meshes.

    The clamped corner is singular, so the last three meshes are extrapolated (Aitken).
    """
    a, b, c = (lifted(cells, (70.0, 1 / 3), 100.0, 60.0, dilatation) for cells in (4, 8, 16))
    assert a < b < c < 32.28
    assert c - (c - b) ** 2 / ((c - b) - (b - a)) == pytest.approx(32.24, rel=0.005)


def test_cooks_membrane_near_incompressibility_wants_the_mean_dilatation() -> None:
    tissue = (250.0, 0.4999)
    coarse, fine = (lifted(cells, tissue, 100.0, 60.0, "mean") for cells in (8, 16))
    locked = lifted(8, tissue, 100.0, 60.0, "pointwise")
    assert 0.97 * fine < coarse < fine
    assert locked < 0.95 * fine


# ---- the same stiffness matrix as another code ----


def other_code(nodes: np.ndarray, tets: np.ndarray, order: int, lam: float, mu: float) -> np.ndarray:
    """The dense stiffness between all degrees of freedom, numbered as ours, by scikit-fem."""
    skfem = pytest.importorskip("skfem")
    from skfem.models.elasticity import linear_elasticity

    corners = np.unique(tets[:, :4])
    assert np.array_equal(corners, np.arange(len(corners)))
    mesh = skfem.MeshTet(nodes[corners].T, tets[:, :4].T)
    scalar = skfem.ElementTetP1() if order == 1 else skfem.ElementTetP2()
    basis = skfem.Basis(mesh, skfem.ElementVector(scalar), intorder=2)
    K = linear_elasticity(lam, mu).assemble(basis).toarray()
    number = np.zeros(K.shape[0], int)  # of each of its degrees of freedom among ours
    kinds = [basis.nodal_dofs] if order == 1 else [basis.nodal_dofs, basis.edge_dofs]
    for direction, dofs in ((i, kind[i]) for kind in kinds for i in range(3)):
        apart = np.linalg.norm(basis.doflocs[:, dofs].T[:, None] - nodes[None], axis=2)
        assert apart.min(axis=1).max() < 1e-12
        number[dofs] = 3 * apart.argmin(axis=1) + direction
    assert np.array_equal(np.sort(number), np.arange(K.shape[0]))
    ours = np.zeros_like(K)
    ours[np.ix_(number, number)] = K
    return ours


@pytest.mark.parametrize("order", [1, 2])
def test_the_stiffness_matrix_is_that_of_another_code(order: int) -> None:
    body: Body = cube_body(2, order=order, held=lambda x: np.zeros(len(x), bool))
    lam, mu = lame(0.18, 0.48)[:, 0]
    expected = other_code(np.asarray(body.nodes), np.asarray(body.tets), order, float(lam), float(mu))
    SAME_ARITHMETIC.check(Assembled(body, upper=False).matrix(lame(0.18, 0.48)).toarray(), expected)
