"""Contact against closed forms: Hertz's sphere and cylinder and a line on a half-space, and a flat punch on a bonded layer."""

from __future__ import annotations

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np
from scipy.integrate import quad_vec

from benchmarks._record import Figure, at_most
from fingerjax.contact.footprint import interface
from fingerjax.contact.indentation import press, recovered
from fingerjax.contact.indenter import from_spec
from fingerjax.contact.line import RIGID
from fingerjax.contact.pad import pad
from fingerjax.fem.body import material
from fingerjax.forward.sequence import check, prepare
from fingerjax.layers import SOFT_LAYERS
from fingerjax.mesh.bodies import block
from tests.halfspace import compliance, lattice

PLANE_MODULUS = 1.7  # MPa, E/(1 - nu^2)
PRACTICAL = 4  # facet edges per contact radius at which the goals hold
OFFSETS = ((0.0, 0.0), (0.13, 0.21), (0.5, 0.25))  # in edges: places on the lattice
LONG = 8.0  # mm of a line
E, NU, THICK, RADIUS, TRAVEL = 0.5, 0.3, 1.0, 1.0, 0.05  # the punch on a layer: MPa, 1, mm, mm, mm


def main(quick: bool) -> Iterator[Figure]:
    for edges in (2, 4) if quick else (2, 3, 4, 6):
        yield from sphere(edges)
    for edges in (2, 4) if quick else (2, 3, 4):
        yield from cylinder(edges)
    for edge in (1.0,) if quick else (1.0, 0.5):
        yield from line(edge)
    yield from punch(quick)


def goal(figure: str, errors: list[float], edges: int) -> Figure:
    note = f"{edges} facet edges per contact radius, worst of {len(errors)} places on the mesh"
    return goal_at(figure, 100 * max(map(abs, errors)), edges, note)


def sphere(edges: int) -> Iterator[Figure]:
    """a = 1 mm, R = 20 mm: F = 4/3 E* a^3/R, area pi a^2, p0 = 2 E* a/(pi R) (Johnson 1985, eqs. 4.22-4.24)."""
    skin = lattice(int(np.ceil(3.4 * edges)), 1 / edges)
    whole = pad(skin)
    C = jnp.asarray(compliance(skin, np.asarray(whole.nodes), 1 / edges, PLANE_MODULUS, periods=max(24, 6 * edges)))
    found = [press(C, interface(whole, from_spec("sphere", {"radius": 20.0}), (x / edges, z / edges)), travel=1 / 20) for x, z in OFFSETS]
    expected = {"force": 4 / 3 * PLANE_MODULUS / 20, "area": np.pi, "peak_pressure": 2 * PLANE_MODULUS / np.pi / 20}
    for name, value in expected.items():
        yield goal(f"Hertz sphere, {name.replace('_', ' ')}", [float(getattr(one, name)) / value - 1 for one in found], edges)


def cylinder(edges: int) -> Iterator[Figure]:
    """In the middle of a long contact of R = 20 mm: p0^2 = P E*/(pi R) at the line load P found there (Johnson 1985, eq. 4.45)."""
    skin = lattice(5 * edges, 1 / edges)
    whole = pad(skin)
    C = jnp.asarray(compliance(skin, np.asarray(whole.nodes), 1 / edges, PLANE_MODULUS, periods=max(24, 8 * edges)))
    line = np.pi * PLANE_MODULUS / (4 * 20)  # N/mm that makes a = 1
    errors, at = [], np.asarray(whole.points)[_vertices(whole)]
    for _, shift in OFFSETS:
        face = interface(whole, from_spec("cylinder", {"radius": 20.0}), (0.0, shift / edges))
        contact = press(C, face, force=5.0 * line)
        pressure, middle = np.asarray(contact.pressure), np.abs(at[:, 0]) < 0.5 + 1e-9  # rows of hats across the middle millimetre
        rows = len(np.unique(np.round(at[middle, 0], 9)))
        own = float(pressure[middle].sum()) / rows / edges  # N/mm of the rows there
        peak = float(np.mean(np.sort(np.asarray(recovered(face, contact.pressure))[middle])[-rows:]))
        errors.append(peak / np.sqrt(own * PLANE_MODULUS / (np.pi * 20)) - 1)
    yield goal("Hertz cylinder, peak pressure at its own line load", errors, edges)


def line(edge: float) -> Iterator[Figure]:
    """A tip of 0.05 mm, LONG mm of it bearing a uniform pressure: its mean indentation against the mean of 1/(pi E* r) over all pairs of
    points of that strip, in closed form; on the mean of ten places on the mesh, with what the mesh leaves added and without.
    """
    skin, width = lattice(round(LONG / edge), edge), 0.05
    whole = pad(skin)
    C = np.asarray(compliance(skin, np.asarray(whole.nodes), edge, PLANE_MODULUS, periods=2 * round(LONG / edge) + 4))
    diagonal = np.hypot(LONG, width)
    pairs = 2 * LONG * width * (LONG * np.arcsinh(width / LONG) + width * np.arcsinh(LONG / width))
    exact = (pairs + 2 / 3 * (LONG**3 + width**3 - diagonal**3)) / (LONG * width) ** 2 / (np.pi * PLANE_MODULUS)
    sharp = 2 / (np.pi * PLANE_MODULUS)
    alone, whole_of_it = [], []
    for place in np.arange(-0.5, 0.5, 0.1) + 0.013:
        face = interface(whole, from_spec("line", {"width": width}), (0.0, place * edge))
        share = np.asarray(face.area) / float(face.area.sum())
        nodal = np.asarray(face.load).sum(axis=1) / float(face.area.sum())
        shown = nodal @ C @ nodal
        alone.append(shown)
        whole_of_it.append(shown + sharp * (np.asarray(face.narrow) @ share**2 + RIGID / LONG))
    note = f"facet edges of {edge:g} mm, a tip of {width:g} mm, mean of {len(alone)} places on the mesh"
    yield at_most("line, indentation", 100 * abs(float(np.mean(whole_of_it)) / exact - 1), "%", 2.0, note)
    yield Figure("line, indentation that the mesh alone shows", 100 * abs(float(np.mean(alone)) / exact - 1), "%", note=note)


def _vertices(whole: object) -> np.ndarray:
    """Pad node of each hat."""
    facets, hats = np.asarray(whole.facets)[:, :3], np.asarray(whole.hats)  # type: ignore[attr-defined]
    found = np.zeros(hats.max() + 1, int)
    found[hats] = facets
    return found


def punch(quick: bool) -> Iterator[Figure]:
    """A flat-ended cylinder on a layer bonded below, against the integral equation of Lebedev & Ufliand (1958)."""
    exact, tissue = punch_on_layer(), material(dict.fromkeys(SOFT_LAYERS, E), NU)
    shape, origin = from_spec("flat_cylinder", {"radius": RADIUS}), np.array([[0.0, 3.0]])
    for across in (12,) if quick else (12, 24, 36):
        finger = block((6.0, THICK, 6.0), (across, across // 3, across))
        sequence = prepare(finger, shape, origin, TRAVEL, bone="held")
        pushed = sequence.press(sequence.condense(tissue).held.matrix, shape, travel=TRAVEL)
        check(sequence, pushed)
        force = float(pushed.contact.force[0])
        half_space = 2 * E / (1 - NU**2) * RADIUS * TRAVEL
        note = f"{across / 6:.3g} facet edges per radius: {force:.5f} N against {exact:.5f}; half-space {half_space:.5f}"
        yield goal_at("flat punch on a bonded layer, force", 100 * abs(force / exact - 1), across / 6, note)


def goal_at(figure: str, error: float, edges: float, note: str) -> Figure:
    return at_most(figure, error, "%", 2.0, note) if edges >= PRACTICAL else Figure(figure, error, "%", note=note)


def punch_on_layer(points: int = 40) -> float:
    """F = pi E* int_0^a f,  f(s) + 2/pi int_0^a f(t) int_0^inf (L(k h) - 1) cos(k s) cos(k t) dk dt = 2 d/pi.

    L is the Hankel transform of the layer's surface displacement over the half-space's (Vorovich, Aleksandrov & Babeshko 1974).
    """
    t, w = np.polynomial.legendre.leggauss(points)
    t, w, chi = 0.5 * RADIUS * (t + 1), 0.5 * RADIUS * w, 3 - 4 * NU

    def integrand(k: float) -> np.ndarray:
        x = k * THICK
        share = (2 * chi * np.sinh(2 * x) - 4 * x) / (2 * chi * np.cosh(2 * x) + 1 + chi**2 + 4 * x**2)
        cosine = np.cos(k * t)
        return (share - 1) * np.outer(cosine, cosine)

    kernel, _ = quad_vec(integrand, 0.0, 30.0 / THICK, epsabs=1e-10)
    f = np.linalg.solve(np.eye(points) + 2 / np.pi * kernel * w[None, :], np.full(points, 2 * TRAVEL / np.pi))
    return float(np.pi * E / (1 - NU**2) * (w @ f))
