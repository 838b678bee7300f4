"""A sphere on a block of elastic tissue, all the way through: mesh, stiffness, compliance, pad, contact, against Hertz's force.

The block is a layer eight contact radii deep, bonded below, and eight to each side. Hertz's half-space has no bottom; what a bonded
bottom adds to the force is known (Dimitriadis, Horkay, Maresca, Kachar & Chadwick, Biophys. J. 82, 2002, eq. 12, with their constants
for a bonded layer), so the force is compared with

    F = 4/3 E/(1 - nu^2) sqrt(R d^3) (1 + correction in sqrt(R d)/thickness)

where the correction is 9 to 12 % here. Two to three facet edges lie on a contact radius, good for a per cent or two (contact/footprint.py).
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from fingerjax.contact.footprint import interface
from fingerjax.contact.indentation import Contact, press
from fingerjax.contact.indenter import Sphere
from fingerjax.contact.pad import Pad, functionals
from fingerjax.contact.reach import Indentation, pad_for
from fingerjax.fem.body import Body, body, material
from fingerjax.fem.columns import columns_from_matrix
from fingerjax.fem.operator import internal_force
from fingerjax.fem.solver import solver_for
from fingerjax.layers import SOFT_LAYERS
from fingerjax.mesh.bodies import block

MODULUS, POISSON_RATIO, RADIUS, THICKNESS, WIDTH = 0.5, 0.3, 20.0, 8.0, 16.0
DEPTHS = (0.03, 0.05)  # mm: contact radii of 0.77 and 1 mm
TISSUE = material(dict.fromkeys(SOFT_LAYERS, MODULUS), POISSON_RATIO)


def hertz(depth: float) -> float:
    """Force, N, on the half-space."""
    return 4 / 3 * MODULUS / (1 - POISSON_RATIO**2) * np.sqrt(RADIUS * depth**3)


def bottom(depth: float, thickness: float = THICKNESS) -> float:
    """How many times larger the force on a bonded layer is."""
    nu, chi = POISSON_RATIO, np.sqrt(RADIUS * depth) / thickness
    a = -(1.2876 - 1.4678 * nu + 1.3442 * nu**2) / (1 - nu)
    b = (0.6387 - 1.0277 * nu + 1.5164 * nu**2) / (1 - nu)
    third, fourth = a**3 + 4 * np.pi**2 / 15 * b, a**3 + 3 * np.pi**2 / 5 * b
    powers = [1.0, -2 * a / np.pi, 4 * a**2 / np.pi**2, -8 * third / np.pi**3, 16 * a * fourth / np.pi**4]
    return float(np.polyval(powers[::-1], chi))


class Pressed:
    """The block with its skin condensed, and a sphere on the middle of it."""

    def __init__(self) -> None:
        finger = block((WIDTH, THICKNESS, WIDTH), (16, 6, 16), grading=2.0)
        self.sphere, self.origin = Sphere(RADIUS), (0.0, WIDTH / 2)
        self.body: Body = body(finger, bone="held")
        self.pad: Pad = pad_for(finger, [Indentation(self.sphere, self.origin, max(DEPTHS))])
        self.solver = solver_for(self.body)
        columns = columns_from_matrix(functionals(self.pad, len(finger.nodes)))
        held = self.solver.condense(self.body, TISSUE.lame(), columns).held
        assert bool(held.converged)
        self.compliance = held.matrix

    def to(self, depth: float) -> Contact:
        return press(self.compliance, interface(self.pad, self.sphere, self.origin), travel=depth)


@pytest.fixture(scope="module")
def pressed() -> Pressed:
    return Pressed()


@pytest.mark.parametrize("depth", DEPTHS)
def test_the_force_is_hertzs_on_a_bonded_layer(pressed: Pressed, depth: float) -> None:
    contact = pressed.to(depth)
    assert contact.settled and not contact.reached_edge
    assert 1.08 < bottom(depth) < 1.13
    assert float(contact.force) == pytest.approx(hertz(depth) * bottom(depth), rel=0.03)


def test_force_grows_with_the_power_of_three_halves(pressed: Pressed) -> None:
    """Between the two depths; a mesh or contact that is wrong by a factor would not hide here, one wrong in shape would."""
    low, high = (float(pressed.to(depth).force) / bottom(depth) for depth in DEPTHS)
    assert np.log(high / low) / np.log(DEPTHS[1] / DEPTHS[0]) == pytest.approx(1.5, abs=0.06)


def test_reactions_balance_the_contact(pressed: Pressed) -> None:
    contact = pressed.to(DEPTHS[1])
    load = jnp.zeros(pressed.body.nodes.shape).at[pressed.pad.nodes, 1].set(contact.nodal_forces)
    lame = TISSUE.lame()
    solution = pressed.solver.solve(pressed.body, lame, load[None])
    reaction = internal_force(pressed.body, lame, solution.displacement[0]) * (1 - pressed.body.free[:, None])
    total = np.asarray(reaction.sum(axis=0))
    assert float(contact.force) == pytest.approx(float(contact.nodal_forces.sum()), rel=1e-10)
    np.testing.assert_allclose(total, [0.0, -float(contact.force), 0.0], atol=1e-8 * float(contact.force))
