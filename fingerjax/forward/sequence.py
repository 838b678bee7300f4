"""A sequence of indentations of one finger: any shape at many places, with every reading differentiable in whatever was chosen.

The body is condensed once to the skin that the sequence can touch and to the receptors that listen; each indentation after that is a
small dense contact problem. Shape, tilt, offset, travel or force, moduli and receptor depth are arguments of `press` and `feel`:

    sequence = prepare(finger, Bar(3.0, 0.3), origins, travel=1.0, sites=below(solid, 0.75, z))
    C = sequence.compliance(material)
    pushed = sequence.press(C, Bar(3.0, 0.3), travel=1.0)
    energy = strain_energy_density(sequence.feel(pushed, material))

Derivatives hold the set of touching pressures. Where a pressure comes or goes (an event), force and strain are continuous, their slope in
the travel jumps, and what is computed is the slope of the side that the active set was decided for. A pressure acts on its whole hat, so
force does not begin at first contact but as soon as the mean gap of one hat is closed: that much later, on a skin of radius R and facets
of edge h, as a travel of order h^2/R. Before, all readings and slopes are 0; after, force and strain grow from 0 with a slope.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as Several

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, ArrayLike, Float, Int

from ..contact.footprint import Interface, interface
from ..contact.indentation import Contact, press
from ..contact.line import sharp_compliance
from ..contact.nodal import at_nodes
from ..contact.pad import Pad, functionals, node_area
from ..contact.reach import Indentation, pad_for, windows
from ..contact.shape import AbstractIndenter
from ..errors import InputError
from ..fem.body import Body, Material, body
from ..fem.columns import Columns, columns_from_matrix
from ..fem.compliance import compliance
from ..fem.condensed import AbstractCondensed
from ..fem.recovery import Recovery
from ..fem.solver import AbstractSolver, solver_for
from ..finger import Finger
from ..measure.receptor import Receptor
from ..measure.sites import Sites
from .rigs import outermost

HELD_AT = {"hats": interface, "nodes": at_nodes}
READ = 12  # columns of a receptor: six strains, and their slopes inwards


class Pushed(eqx.Module):
    """Every indentation of a sequence: `contact`, each leaf with a leading axis of poses, and what all columns then read."""

    contact: Contact
    forces: Float[Array, "poses m"]
    readings: Float[Array, "poses m"]

    @property
    def mean_pressure(self) -> Float[Array, " poses"]:
        """Force over contact area, MPa; 0 where nothing touches."""
        area = self.contact.area
        return jnp.where(area > 0, self.contact.force / jnp.where(area > 0, area, 1.0), 0.0)


class Sequence(eqx.Module):
    """A finger made ready for a sequence of `origins` (poses, 2), (x, z) mm, and for the receptors that listen."""

    body: Body
    solver: AbstractSolver
    columns: Columns
    cut: Pad
    origins: Float[Array, "poses 2"]
    receptor: Int[Array, " sites"]
    layer: Int[Array, " sites"]
    held_at: str = eqx.field(static=True, default="hats")
    outermost: int = eqx.field(static=True, default=0)

    def condense(self, material: Material) -> AbstractCondensed:
        """The body behind its columns at a material; outside of compiled code. `held.matrix` is what `press` needs."""
        return self.solver.condense(self.body, material.lame(), self.columns)

    def compliance(self, material: Material) -> Float[Array, "m m"]:
        """Readings of all columns per unit load on each, mm/N where both are skin; differentiable in the material."""
        return compliance(self.body, self.solver, material, self.columns).matrix

    def press(
        self,
        C: Float[Array, "m m"],
        indenter: AbstractIndenter,
        *,
        travel: Float[ArrayLike, "..."] | None = None,
        force: Float[ArrayLike, "..."] | None = None,
        offset: Float[ArrayLike, "2"] | tuple[float, float] = (0.0, 0.0),
        material: Material | None = None,
    ) -> Pushed:
        """Press at every origin, to a travel in mm from first contact or with a force in N: one for all, or one for each.

        **Arguments:** `C` of `compliance`, or `condense(...).held.matrix`; `offset` (x, z), mm, is added to all origins, and must stay
        small beside a node spacing or two, since the skin that can be touched is chosen beforehand; `material`, the one of `C`, for a
        line: without it skin gives way under its tip no more than the mesh shows (`contact.line`).
        """
        sharp = jnp.zeros(()) if material is None else sharp_compliance(material.lame(), self.outermost)
        imposed = jnp.broadcast_to(jnp.asarray(travel if force is None else force, float), self.origins.shape[:1])
        faces = _faces(self.cut, self.origins + jnp.asarray(offset, float), indenter, HELD_AT[self.held_at])
        return _pressed(self.cut.columns, faces, C, imposed, sharp, force is not None)

    def pressure_over(self, pushed: Pushed, radius: float) -> Float[Array, " poses"]:
        """Largest pressure, MPa, over patches of skin of this `radius`, mm, about every node, weighted towards their middle.

        The `peak_pressure` of a contact is that of one vertex, which differs from mesh to mesh where facets are uneven; this does not,
        once the radius is some facets long.
        """
        return _pressure_over(self.cut, pushed.contact.nodal_forces, radius)

    def feel(self, pushed: Pushed, material: Material, deeper: Float[ArrayLike, ""] = 0.0) -> Receptor:
        """State of the tissue at every receptor under every indentation (poses, sites); `deeper` mm further inwards, to first order."""
        at = self.receptor[:, None] + jnp.arange(6)
        strain = pushed.readings[:, at] + jnp.asarray(deeper) * pushed.readings[:, at + 6]
        return Receptor(strain, material.youngs_modulus[self.layer], material.poisson_ratio[self.layer])


def population(sequence: Sequence, condensed: AbstractCondensed, pushed: Pushed, material: Material, sites: Sites) -> Receptor:
    """State of the tissue (poses, m) at any number of places that were not prepared for: maps, lines and sections. Not differentiable."""
    columns, layer = Recovery(sequence.body).strains(sites.points)
    u = np.asarray(condensed.displacement(pushed.forces)).reshape(len(pushed.forces), -1)
    strain = jnp.asarray((columns.T @ u.T).T.reshape(len(u), len(sites), 6))
    return Receptor(strain, material.youngs_modulus[layer], material.poisson_ratio[layer])


# Two programs rather than one: the geometry is compiled for every kind of indenter, the contact once for all of them.


@eqx.filter_jit
def _faces(cut: Pad, origins: Array, indenter: AbstractIndenter, held: Callable[..., Interface]) -> Interface:
    return jax.lax.map(lambda pose: held(pose[0], indenter, (pose[1][0], pose[1][1])), (cut, origins))


@eqx.filter_jit
def _pressed(columns: Array, faces: Interface, C: Array, imposed: Array, sharp: Array, forced: bool) -> Pushed:
    def one(pose: tuple[Array, Interface, Array]) -> tuple[Contact, Array]:
        own, face, value = pose
        only = C[own[:, None], own[None, :]]
        contact = press(only, face, force=value, sharp=sharp) if forced else press(only, face, travel=value, sharp=sharp)
        return contact, jnp.zeros(C.shape[0]).at[own].add(contact.nodal_forces)

    contact, forces = jax.lax.map(one, (columns, faces, imposed))
    return Pushed(contact, forces, forces @ C)


@eqx.filter_jit
def _pressure_over(cut: Pad, forces: Array, radius: Array | float) -> Array:
    def one(pose: tuple[Pad, Array]) -> Array:
        own, force = pose
        x, z = own.points[:, 0], own.points[:, 2]
        near = jnp.maximum(1.0 - ((x[:, None] - x) ** 2 + (z[:, None] - z) ** 2) / radius**2, 0.0)
        area = near @ node_area(own)
        return jnp.max(near @ force / jnp.where(area > 0, area, jnp.inf))

    return jax.lax.map(one, (cut, forces))


def prepare(
    finger: Finger,
    indenters: AbstractIndenter | Several[AbstractIndenter],
    origins: np.ndarray,
    travel: float,
    sites: Sites | None = None,
    *,
    bone: str = "rigid",
    solver: str = "auto",
    held_at: str = "hats",
) -> Sequence:
    """Choose the skin that indenters at `origins` (poses, 2) can touch within `travel` mm, and condense nothing yet.

    **Arguments:** `held_at`, where contact is held: as means over "hats" (`contact.footprint`), or at "nodes" (`contact.nodal`).

    **Raises:** `InputError` for an origin at which none of the indenters touches the pad; for another `held_at`.
    """
    if held_at not in HELD_AT:
        raise InputError("no such place to hold contact at", place="held_at", seen=held_at, remedy=f"one of {', '.join(HELD_AT)}")
    tissue = body(finger, bone=bone)
    bare = finger if bone == "elastic" else finger.without_bone()
    origins = np.atleast_2d(np.asarray(origins, float))
    shapes = [indenters] if isinstance(indenters, AbstractIndenter) else list(indenters)
    wanted = [[Indentation(shape, (float(x), float(z)), travel) for shape in shapes] for x, z in origins]
    pad = pad_for(bare, [one for each in wanted for one in each])
    matrices, layers = [functionals(pad, len(bare.nodes))], np.zeros(0, int)
    first = matrices[0].shape[1]
    if sites is not None:
        recovery = Recovery(tissue)
        strains, layers = recovery.strains(sites.points)
        slopes = recovery.slopes(sites.points, sites.inwards)
        matrices += [part[:, 6 * i : 6 * i + 6] for i in range(len(sites)) for part in (strains, slopes)]
    return Sequence(
        body=tissue,
        solver=solver_for(tissue, solver),
        columns=columns_from_matrix(sp.hstack(matrices).tocsc()),
        cut=windows(pad, wanted),
        origins=jnp.asarray(origins),
        receptor=jnp.asarray(first + READ * np.arange(len(layers))),
        layer=jnp.asarray(layers),
        held_at=held_at,
        outermost=outermost(pad, bare),
    )


def check(sequence: Sequence, pushed: Pushed) -> None:
    """Say what went wrong in a sequence, if anything did.

    **Raises:** `InputError` naming the pose: a force that the prepared skin cannot bear, contact that reached its end, or did not settle.
    """
    contact = pushed.contact
    bad = ~np.asarray(contact.settled) | np.asarray(contact.reached_edge) | ~np.isfinite(np.asarray(contact.force))
    if not bad.any():
        return
    pose = int(np.argmax(bad))
    place = f"pose {pose}, (x, z) = ({float(sequence.origins[pose, 0]):g}, {float(sequence.origins[pose, 1]):g}) mm"
    if not bool(contact.settled[pose]):
        raise InputError("contact was not decided", place=place, remedy="press less deeply, or refine the mesh")
    seen = f"force {float(contact.force[pose]):.4g} N, travel {float(contact.travel[pose]):.4g} mm"
    remedy = "ask for less, or prepare the sequence for a larger travel"
    raise InputError("contact gets to the end of the prepared skin before this is reached", place=place, seen=seen, remedy=remedy)
