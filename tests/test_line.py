"""What a mesh does not show of skin under the tip of a line, on a half-space whose answer is known."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from fingerjax.contact.footprint import interface
from fingerjax.contact.indentation import press
from fingerjax.contact.indenter import Cylinder, Line
from fingerjax.contact.line import BLUNTED, RIGID, beside_tip, sharp_compliance
from fingerjax.contact.pad import pad
from fingerjax.fem.body import material

from . import halfspace
from .helpers import Grade

E_STAR, LENGTH = 0.2, 8.0  # MPa, mm
SHARP = 2 / (np.pi * E_STAR)
PLACES = np.arange(-0.5, 0.5, 0.1) + 0.013  # edges of facets, all over one
STRIP = Grade(0.06, 0.0, "logarithm of b / a on the mean of ten places, with c of a tip without width")
MESH = Grade(0.02, 0.0, "a line anywhere on two meshes, on the mean of ten places")


def on_mesh(edge: float, **said):
    """A half-space of LENGTH, its skin's compliance in mm/N, and the contact of a line, made where it stands and for its width."""
    skin = halfspace.lattice(round(LENGTH / edge), edge)
    whole = pad(skin)
    C = halfspace.compliance(skin, np.asarray(whole.nodes), edge, E_STAR, periods=2 * round(LENGTH / edge) + 4)
    return np.asarray(C), lambda place, width: interface(whole, Line(width), (0.0, place * edge))


def mean_of_inverse_distance(a: float, b: float) -> float:
    """Of all pairs of points of a rectangle, 1/mm, in closed form."""
    d = np.hypot(a, b)
    both = 2 * (a * a * b * np.arcsinh(b / a) + a * b * b * np.arcsinh(a / b)) + 2 / 3 * (a**3 + b**3 - d**3)
    return both / (a * b) ** 2


@pytest.fixture(scope="module")
def rough():
    return on_mesh(1.0)


@pytest.mark.parametrize("width", [0.02, 0.1, 0.2])
def test_a_mesh_makes_a_strip_of_a_line(rough, width):
    C, line = rough
    exact, found = mean_of_inverse_distance(LENGTH, width) / (np.pi * E_STAR), []
    for place in PLACES:
        face = line(place, width)
        nodal = np.asarray(face.load).sum(axis=1) / float(face.area.sum())
        found.append((exact - nodal @ C @ nodal) * LENGTH / SHARP)
    said = np.log(np.hypot(0.5 * width, BLUNTED * 0.5) / (0.5 * width))
    assert np.mean(found) == pytest.approx(said, abs=STRIP.relative)
    assert np.ptp(found) > 0.5  # where it stands on the mesh matters more than that


@pytest.mark.parametrize(("place", "found"), [(0.0, 0.15), (0.25, 0.56)], ids=["along edges", "between edges"])
def test_edges_of_facets_bend_more_easily_under_a_line_than_the_middles_of_facets(rough, place, found):
    C, line = rough
    width = 0.04
    face = line(place, width)
    nodal = np.asarray(face.load).sum(axis=1) / float(face.area.sum())
    missing = (mean_of_inverse_distance(LENGTH, width) / (np.pi * E_STAR) - nodal @ C @ nodal) * LENGTH / SHARP
    assert 0.5 * width * np.exp(missing) / 0.5 == pytest.approx(found, abs=0.01)  # half-width of the strip, in spacings of nodes


def test_hats_know_how_much_the_mesh_leaves(rough):
    face = rough[1](0.2, 0.05)
    length = np.asarray(face.area) / 0.05
    spacing = np.sqrt(0.5 / 2)  # of right-angled triangles with an edge of 1 mm
    expected = np.log(np.hypot(0.025, BLUNTED * spacing) / 0.025) - RIGID
    assert np.asarray(face.narrow) * length == pytest.approx(np.full(len(length), expected))


def test_a_line_is_as_stiff_on_a_rough_mesh_as_on_a_finer_one(rough):
    """Without what skin gives way under the tip it is stiffer on the rougher mesh by several times as much."""
    fine = on_mesh(0.5)

    def mean_force(mesh, sharp: float) -> float:
        C, line = mesh
        return float(np.mean([press(jnp.asarray(C), line(place, 0.05), travel=0.1, sharp=sharp).force for place in PLACES[::2]]))

    with_it, without = (mean_force(rough, sharp) / mean_force(fine, sharp) for sharp in (SHARP, 0.0))
    assert with_it == pytest.approx(1.0, rel=MESH.relative)
    assert without > 1.0 + 3 * MESH.relative


def test_other_indenters_have_no_such_skin():
    whole = pad(halfspace.lattice(6, 1.0))
    assert interface(whole, Cylinder(2.0), (0.0, 0.0)).narrow is None


@pytest.mark.parametrize("distance", [0.0, 0.01, 0.04, 0.1, 0.3])
def test_beside_a_tip_skin_lies_between_a_rigid_strip_and_a_uniform_one(distance):
    half, blunt = 0.025, 0.08
    wide = 2 / np.sqrt(np.e) * blunt

    share = (np.arange(400_000) + 0.5) / 400_000
    rigid, uniform = half * np.cos(np.pi * share), wide * (2 * share - 1)  # places that bear equal parts of the load
    deeper = np.mean(np.log(np.abs(distance - uniform))) - np.mean(np.log(np.abs(distance - rigid)))
    assert float(beside_tip(np.array([distance]), half, blunt)[0]) == pytest.approx(deeper, abs=2e-5)


def test_skin_under_the_tip_lies_on_it():
    half, blunt = 0.025, 0.08
    assert float(beside_tip(np.array([0.0]), half, blunt)[0]) == pytest.approx(np.log(blunt / half) - RIGID)
    assert abs(float(beside_tip(np.array([1.0]), half, blunt)[0])) < 2e-3


def test_sharp_compliance_is_that_of_plane_strain():
    E = {"epidermis": 0.18, "dermis": 0.02, "adipose": 0.02, "fibrous": 0.02}
    tissue = material(E, dict.fromkeys(E, 0.48) | {"dermis": 0.4})
    found = [float(sharp_compliance(tissue.lame(), layer)) for layer in (0, 1)]
    assert found == pytest.approx([2 * (1 - nu**2) / (np.pi * E) for E, nu in ((0.18, 0.48), (0.02, 0.4))])
