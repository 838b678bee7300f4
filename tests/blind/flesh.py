"""The tissue behind a simulated finger: layers, and whatever sets them apart from four plain ones on a held nail.

A `Flesh` is data and can be compared, so that laboratories that differ in their instruments alone share one factored body.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy.sparse as sp

from .bricks import NATURAL, Array, Bricks, SlabFactor, assemble_bricks, gauss_cube, shape_slopes, shape_values
from .shapes import Divisions, FingerShape, finger_bricks
from .touch import Body, condense_factored, outer_faces


@dataclass(frozen=True)
class OffsetBone(FingerShape):
    """A finger whose bone lies `bone_rise` mm nearer to the nail: its palmar half is lower by that much and its dorsal half higher."""

    bone_rise: float = 0.0

    def body_radius(self, layer: int, z: Array, theta: Array) -> Array:
        if layer < 3:
            return super().body_radius(layer, z, theta)
        sine = np.sin(np.radians(theta))
        flare = 1.0 + self.bone_flare * ((self.cap - z) / self.cap) ** 2
        low, high = self.bone_half_height - self.bone_rise, self.bone_half_height + self.bone_rise
        upright = 0.5 * (1.0 + sine) / high**2 + 0.5 * (1.0 - sine) / low**2
        bone = flare / np.sqrt((np.cos(np.radians(theta)) / self.bone_half_width) ** 2 + sine**2 * upright)
        return bone if layer == 4 else bone + self.fibrous_share * (super().body_radius(2, z, theta) - bone)


GROWTH = 1.6
"""Length of an element over that of its neighbour on the side of the wedge."""


@dataclass(frozen=True)
class FineMiddle(Divisions):
    """Divisions whose element angle is `middle` times the palmar one within `width` degrees of the pad's middle.

    A wedge that is sharper than the elements under it acts as a blunter one, and its profile is too wide: under a tip `sharp` mm wide they
    end at the shares `under` of its half, beside it they are `GROWTH` times as long as their neighbour up to the length of the pad's, and
    `epidermis` says where they end in that layer, see `cuts`. Without `sharp` and `epidermis` they are as elsewhere on the pad.
    """

    middle: float = 0.35
    width: float = 14.0
    sharp: float = 0.0
    under: tuple[float, ...] = (1.0,)
    epidermis: tuple[float, ...] = ()

    def scaled(self, factor: float, layers: tuple[int, int, int, int] | None = None) -> FineMiddle:
        return replace(super().scaled(factor, layers), sharp=self.sharp * factor)  # type: ignore[return-value]

    def blunted(self) -> FineMiddle:
        """The same without shorter elements under wedges."""
        return replace(self, sharp=0.0, epidermis=())

    def undivided(self) -> FineMiddle:
        """The same with one element under the tip of a wedge."""
        return replace(self, under=(1.0,), epidermis=(0.45, 0.75, 0.92, 1.0))

    @property
    def beside(self) -> tuple[float, ...]:
        if not self.sharp:
            return super().beside
        ends = [0.5 * self.sharp * share for share in self.under]
        step = GROWTH * (ends[-1] - ends[-2] if len(ends) > 1 else self.sharp)
        while step < self.pad:
            ends, step = [*ends, ends[-1] + step], step * GROWTH
        return tuple(ends)

    def cuts(self, layer: int) -> tuple[float, ...]:
        return self.epidermis if layer == 0 and self.epidermis else super().cuts(layer)

    @property
    def angles(self) -> tuple[float, ...]:
        return (self.width - 90.0,)

    def angle(self, at: float) -> float:
        return super().angle(at) * (self.middle if at < self.width - 90.0 else 1.0)


@dataclass(frozen=True)
class Flesh:
    """What a finger is made of.

    `moduli` MPa and `poisson`, from the epidermis inwards; `reach` mm of z about the site that may be touched; `receptors` (mm along z
    from the site, mm below the skin there).

    Null values are those of the plain model. `bed` MPa/mm: the nail rests on springs, a third as stiff along the nail as across it and
    half again as stiff at its root as at its edge; None: it is held. `film` N/mm: Young's modulus times thickness of a membrane on the
    skin, of Poisson ratio 0.3. `graded`: the outer half of the adipose tissue is stiffer by this share, the inner half softer. `callus`:
    the epidermis is so many times stiffer within `callus_reach` mm of a point `callus_at` mm along z from the site. `stiffening`: see
    `stiffening.py`.
    """

    finger: FingerShape
    moduli: tuple[float, float, float, float]
    divisions: Divisions
    reach: float
    poisson: tuple[float, float, float, float] = (0.48, 0.48, 0.48, 0.48)
    receptors: tuple[tuple[float, float], ...] = ()
    bed: float | None = None
    film: float = 0.0
    graded: float = 0.0
    callus: float = 1.0
    callus_at: float = 2.5
    callus_reach: float = 2.0
    stiffening: float = 0.0

    def mesh(self) -> Bricks:
        """Half the finger in bricks; the nail is let go where it rests on springs."""
        mesh = finger_bricks(self.finger, self.divisions)
        if self.bed is None:
            return mesh
        skin = np.unique(outer_faces(mesh))
        fixed = mesh.fixed.copy()
        fixed[skin] = False
        fixed[mesh.nodes[:, 0] == 0.0, 0] = True
        return replace(mesh, fixed=fixed)

    def receptor(self, which: int) -> tuple[float, float, float]:
        """Where a receptor lies, mm."""
        along, depth = self.receptors[which]
        z = self.finger.site + along
        skin = self.finger.centre_y - float(self.finger.radius(0, np.array(z), np.array(270.0)))
        return (0.0, skin + depth, z)

    def touchable(self, centre: Array) -> Array:
        """Whether outer faces with these centres (f, 3) may be touched."""
        angle = np.degrees(np.arctan2(centre[:, 1] - self.finger.centre_y, centre[:, 0]))
        return (angle < -12.0) & (np.abs(centre[:, 2] - self.finger.site) < self.reach)


def factored(flesh: Flesh, *, skin: float = 1.0) -> tuple[Bricks, SlabFactor]:
    """The mesh of a flesh and its factored stiffness at small strain, the skin's moduli times `skin`."""
    mesh = flesh.mesh()
    modulus = np.asarray(flesh.moduli)[mesh.layer] * _local(flesh, mesh)
    modulus = modulus * np.where(mesh.layer < 2, skin, 1.0)
    stiffness = assemble_bricks(mesh, modulus, np.asarray(flesh.poisson)[mesh.layer])
    if flesh.film:
        stiffness = stiffness + membrane(mesh, outer_faces(mesh), flesh.film)
    if flesh.bed is not None:
        stiffness = stiffness + bedding(mesh, nail_faces(flesh), flesh.bed)
    return mesh, SlabFactor(mesh, stiffness.tocsr())


@lru_cache(maxsize=3)
def body_of(flesh: Flesh) -> Body:
    """The flesh seen from its pad; the midline of the skin is watched."""
    mesh, factor = factored(flesh)
    receptors = tuple(flesh.receptor(n) for n in range(len(flesh.receptors)))
    return condense_factored(mesh, factor, flesh.touchable, watched=midline(mesh), receptors=receptors)


def midline(mesh: Bricks) -> Array:
    """Nodes of the skin along the middle of the pad, in order of z."""
    line = mesh.number[-1, 0]
    return line[line >= 0]


def nail_faces(flesh: Flesh) -> Array:
    """Outer faces (f, 8) all of whose nodes a held nail would hold."""
    held = finger_bricks(flesh.finger, flesh.divisions)
    outer = outer_faces(held)
    return outer[held.fixed[outer].all(2).all(1)]


def _local(flesh: Flesh, mesh: Bricks) -> Array:
    """By how much each brick (e,) is stiffer than its layer is said to be."""
    factor, centre = np.ones(len(mesh.bricks)), mesh.nodes[mesh.bricks].mean(1)
    if flesh.graded:
        shell = np.repeat(np.arange(mesh.cells[0]), len(mesh.bricks) // mesh.cells[0])
        middle = shell[mesh.layer == 2].mean()
        factor[mesh.layer == 2] += flesh.graded * np.sign(shell[mesh.layer == 2] - middle)
    if flesh.callus != 1.0:
        away = np.hypot(centre[:, 0], centre[:, 2] - flesh.finger.site - flesh.callus_at)
        hard = (mesh.layer == 0) & (away < flesh.callus_reach) & (centre[:, 1] < flesh.finger.centre_y)
        factor[hard] *= flesh.callus
    return factor


_FACE = np.flatnonzero(NATURAL[:, 0] == 1.0)


def _on_faces(mesh: Bricks, faces: Array) -> tuple[Array, Array, Array, Array]:
    """At 3x3 Gauss points of outer faces: shape functions (q, 8), their gradients along the surface (f, q, 8, 3), the surface's own axes
    (f, q, 2, 3), and areas (f, q)."""
    points, weights = gauss_cube(3)
    flat = points[:, 0] == points[:, 0].max()
    at = np.concatenate([np.ones((flat.sum(), 1)), points[flat, 1:]], axis=1)
    values, slopes = shape_values(at)[:, _FACE], shape_slopes(at)[:, _FACE, 1:]
    tangent = np.einsum("qad,fai->fqdi", slopes, mesh.nodes[faces])
    metric = np.linalg.inv(np.einsum("fqdi,fqei->fqde", tangent, tangent))
    gradient = np.einsum("qad,fqde,fqei->fqai", slopes, metric, tangent)
    normal = np.cross(tangent[:, :, 0], tangent[:, :, 1])
    size = np.linalg.norm(normal, axis=-1)
    first = tangent[:, :, 0] / np.linalg.norm(tangent[:, :, 0], axis=-1, keepdims=True)
    second = np.cross(normal / size[..., None], first)
    return values, gradient, np.stack([first, second], 2), size * weights[flat] / weights[flat].sum() * 4.0


def membrane(mesh: Bricks, faces: Array, tension: float, poisson: float = 0.3) -> sp.csr_matrix:
    """Stiffness (3n, 3n) of an elastic film in plane stress on `faces` (f, 8); `tension` is its modulus times its thickness, N/mm."""
    _, gradient, axes, area = _on_faces(mesh, faces)
    along = np.einsum("fqdi,fqai->fqda", axes, gradient)  # d N / d axis
    rows = [np.einsum("fqi,fqa->fqai", axes[:, :, d], along[:, :, d]) for d in (0, 1)]
    cross = np.einsum("fqi,fqa->fqai", axes[:, :, 0], along[:, :, 1]) + np.einsum("fqi,fqa->fqai", axes[:, :, 1], along[:, :, 0])
    strain = np.stack([*rows, cross], 2).reshape(*area.shape, 3, 24)
    law = tension / (1 - poisson**2) * np.array([[1, poisson, 0], [poisson, 1, 0], [0, 0, 0.5 * (1 - poisson)]])
    return _scatter(mesh, faces, np.einsum("fq,fqsm,st,fqtn->fmn", area, strain, law, strain, optimize=True))


def bedding(mesh: Bricks, faces: Array, stiffness: float) -> sp.csr_matrix:
    """Stiffness (3n, 3n) of springs under `faces` (f, 8), see `Flesh.bed`; `stiffness` MPa/mm across the nail, averaged along it."""
    values, _, axes, area = _on_faces(mesh, faces)
    normal = np.cross(axes[:, :, 0], axes[:, :, 1])
    z = np.einsum("qa,fa->fq", values, mesh.nodes[faces][:, :, 2])
    low, high = mesh.nodes[faces][:, :, 2].min(), mesh.nodes[faces][:, :, 2].max()
    along_nail = stiffness * (1.2 - 0.4 * (z - low) / (high - low))
    spring = (np.eye(3) + 2.0 * np.einsum("fqi,fqj->fqij", normal, normal)) / 3.0
    block = np.einsum("fq,qa,qb,fqij->faibj", area * along_nail, values, values, spring, optimize=True)
    return _scatter(mesh, faces, block.reshape(len(faces), 24, 24))


def _scatter(mesh: Bricks, faces: Array, block: Array) -> sp.csr_matrix:
    dof = (3 * faces[:, :, None] + np.arange(3)).reshape(len(faces), 24)
    rows, columns = np.repeat(dof, 24, axis=1).ravel(), np.tile(dof, (1, 24)).ravel()
    return sp.csr_matrix((block.ravel(), (rows, columns)), shape=(3 * len(mesh.nodes),) * 2)
