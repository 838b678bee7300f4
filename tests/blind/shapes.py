"""Bodies to press on: analytic fingers with five nested layers, and rectangular blocks.

Frame as in the measurement contract: z from the proximal cut to the tip, y towards the nail, x lateral;
theta about the bone's centre, 0 at +x and 90 deg at the nail.  Every body here is symmetric in x and only
its half x >= 0 is meshed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from .bricks import Array, Bricks, lattice

SURFACES = ("epidermis", "dermis", "adipose", "fibrous", "bone")


@dataclass(frozen=True)
class FingerShape:
    """A fingertip in closed form; lengths in mm, angles in degrees.

    Up to `cap` the sections swell as a parabola of z; beyond it every layer's outer surface is a quarter
    ellipse in z that ends at its own tip, so skin keeps a thickness all round.  A section is an ellipse
    with a dorsal and a palmar half-height that pass smoothly into each other.  Skin thins towards the
    dorsal side by the factor `dorsal_skin`.
    """

    name: str
    species: str
    length: float
    cap: float
    site: float
    half_width: float
    palmar: float
    dorsal: float
    centre_y: float
    swelling: float
    epidermis: float
    dermis: float
    dorsal_skin: float
    fibrous_share: float
    bone_half_width: float
    bone_half_height: float
    bone_flare: float
    bone_end: float
    nail_z: tuple[float, float]
    nail_theta: tuple[float, float] = (50.0, 130.0)

    def tips(self) -> Array:
        """z at which each layer's outer surface ends, (5,)."""
        adipose = self.length - self.epidermis - self.dermis
        fibrous = self.bone_end + self.fibrous_share * (adipose - self.bone_end)
        return np.array([self.length, self.length - self.epidermis, adipose, fibrous, self.bone_end])

    def body_radius(self, layer: int, z: Array, theta: Array) -> Array:
        """Radius of a layer's outer surface for z up to `cap` (broadcasting z and theta in degrees)."""
        back = ((self.cap - z) / self.cap) ** 2
        sine = np.sin(np.radians(theta))
        skin = _oval(theta, self.half_width, self.palmar, self.dorsal) * (1.0 - self.swelling * back)
        thin = 0.5 * (1.0 - sine) + self.dorsal_skin * 0.5 * (1.0 + sine)
        inner = skin - (self.epidermis + self.dermis) * thin
        bone = _oval(theta, self.bone_half_width, self.bone_half_height, self.bone_half_height)
        bone = bone * (1.0 + self.bone_flare * back)
        return (skin, skin - self.epidermis * thin, inner, bone + self.fibrous_share * (inner - bone), bone)[
            layer
        ]

    def radius(self, layer: int, z: Array, theta: Array) -> Array:
        """Radius of a layer's outer surface from the bone's centre; 0 beyond the layer's tip."""
        z, theta = np.broadcast_arrays(np.asarray(z, float), np.asarray(theta, float))
        reach = np.clip((z - self.cap) / (self.tips()[layer] - self.cap), 0.0, 1.0)
        return self.body_radius(layer, np.minimum(z, self.cap), theta) * np.sqrt(1.0 - reach**2)

    def surface(self, layer: int, along: Array, theta: Array) -> Array:
        """Points (..., 3) of a layer's outer surface; `along` is z in the body and cap + angle (rad) in the
        cap."""
        along, theta = np.broadcast_arrays(along, theta)
        angle = np.maximum(along - self.cap, 0.0)
        z = np.minimum(along, self.cap) + (self.tips()[layer] - self.cap) * np.sin(angle)
        r = self.body_radius(layer, np.minimum(along, self.cap), theta) * np.cos(angle)
        return np.stack([r * np.cos(np.radians(theta)), self.centre_y + r * np.sin(np.radians(theta)), z], -1)

    def along(self, z: float) -> float:
        """The coordinate `along` at which the skin is at z."""
        beyond = min(max(z - self.cap, 0.0) / (self.length - self.cap), 1.0)
        return min(z, self.cap) + float(np.arcsin(beyond))


def _oval(theta: Array, half_width: float, palmar: float, dorsal: float) -> Array:
    sine, cosine = np.sin(np.radians(theta)), np.cos(np.radians(theta))
    upright = 0.5 * (1.0 + sine) / dorsal**2 + 0.5 * (1.0 - sine) / palmar**2
    return 1.0 / np.sqrt(cosine**2 / half_width**2 + sine**2 * upright)


HUMAN = FingerShape(
    name="human 17.5 mm",
    species="human",
    length=25.2,
    cap=13.5,
    site=13.0,
    half_width=8.75,
    palmar=9.4,
    dorsal=5.7,
    centre_y=1.8,
    swelling=0.25,
    epidermis=0.5,
    dermis=1.0,
    dorsal_skin=0.55,
    fibrous_share=0.45,
    bone_half_width=2.9,
    bone_half_height=2.2,
    bone_flare=0.3,
    bone_end=20.3,
    nail_z=(10.6, 22.2),
)

MONKEY = FingerShape(
    name="monkey 9.3 mm",
    species="monkey",
    length=16.8,
    cap=9.2,
    site=8.8,
    half_width=4.65,
    palmar=5.6,
    dorsal=3.3,
    centre_y=1.0,
    swelling=0.35,
    epidermis=0.3,
    dermis=0.6,
    dorsal_skin=0.55,
    fibrous_share=0.45,
    bone_half_width=1.6,
    bone_half_height=1.3,
    bone_flare=0.1,
    bone_end=13.5,
    nail_z=(7.0, 14.8),
)

LAST_SECTION = 0.02
"""How far before the tip a table of sections ends, mm: a section of no area cannot be written down."""


def section_heights(finger: FingerShape, count: int = 40) -> Array:
    """z of the sections of a table, mm: even in the body, even in angle in the cap, and every layer's own
    tip."""
    body = np.linspace(0.0, finger.cap, count // 2, endpoint=False)
    angle = np.linspace(0.0, np.pi / 2, count - len(body) - 4, endpoint=False)
    cap = finger.cap + (finger.length - finger.cap) * np.sin(angle)
    end = [*finger.tips()[1:], finger.length - LAST_SECTION]
    return np.unique(np.round(np.concatenate([body, cap, end]), 4))


def section_table(finger: FingerShape, count: int = 40, angles: int = 72) -> Array:
    """Rows (sections x angles, 9): z, theta, cx, cy and the five outer radii, as in `sections.csv`."""
    z, theta = np.meshgrid(section_heights(finger, count), np.arange(angles) * 360.0 / angles, indexing="ij")
    radii = [finger.radius(layer, z, theta) for layer in range(5)]
    middle = np.full_like(z, finger.centre_y)
    return np.stack([z, theta, 0.0 * z, middle, *radii], -1).reshape(-1, 9)


def divide(breaks: Sequence[float], size: Callable[[float], float]) -> Array:
    """Grid through all `breaks` whose steps are no longer than `size` at the middle of each stretch between
    breaks."""
    grid = [breaks[0]]
    for a, b in pairwise(breaks):
        steps = max(1, int(np.ceil((b - a) / size(0.5 * (a + b)) - 1e-9)))
        grid += list(a + (b - a) * np.arange(1, steps + 1) / steps)
    return np.array(grid)


def halved(grid: Array) -> Array:
    """The grid with its midpoints put in: element edges become lattice positions."""
    out = np.empty(2 * len(grid) - 1)
    out[::2], out[1::2] = grid, 0.5 * (grid[:-1] + grid[1:])
    return out


@dataclass(frozen=True)
class Divisions:
    """How finely a finger is cut: lengths in mm, angles in degrees, `layers` bricks per layer from the bone
    outwards.

    `pad` is the element length along z under the indenters (within `reach` of the site), `flank` between
    there and `span`, `rest` elsewhere in the body; `palmar` and `dorsal` are the element angles.  Node
    spacing is half of each.
    """

    pad: float = 0.5
    reach: float = 3.0
    flank: float = 1.0
    span: float = 9.0
    rest: float = 2.0
    palmar: float = 7.5
    dorsal: float = 20.0
    cap: float = 9.0
    layers: tuple[int, int, int, int] = (2, 2, 2, 1)

    def scaled(self, factor: float, layers: tuple[int, int, int, int] | None = None) -> Divisions:
        """The same grading with every element `factor` times as long."""
        lengths = {k: getattr(self, k) * factor for k in ("pad", "flank", "rest", "palmar", "dorsal", "cap")}
        return replace(self, **lengths, layers=layers or self.layers)

    @property
    def beside(self) -> tuple[float, ...]:
        """Where elements must end on both sides of the site, mm from it."""
        return (0.5 * self.pad,)

    def cuts(self, layer: int) -> tuple[float, ...]:
        """Where bricks end in a layer, as shares of its thickness from its inner surface outwards; the last is 1."""
        count = self.layers[3 - layer]
        return tuple((n + 1) / count for n in range(count))

    @property
    def angles(self) -> tuple[float, ...]:
        """Where else than at the pad's middle, the sides and the nail elements must end, degrees."""
        return ()

    def angle(self, at: float) -> float:
        """Longest element at an angle, degrees."""
        return self.palmar if at < 0 else self.dorsal


def finger_bricks(finger: FingerShape, divisions: Divisions = Divisions()) -> Bricks:
    """Mesh half a finger from the bone's surface to the skin.  Bone surface and nail patch are fixed, u_x =
    0 on x = 0."""
    along, theta = halved(_along_grid(finger, divisions)), halved(_angle_grid(finger, divisions))
    shells = [finger.surface(k, along[None, :], theta[:, None]) for k in range(5)]
    depth, layer = [shells[4]], []
    for k in (3, 2, 1, 0):
        cuts = divisions.cuts(k)
        depth += [shells[k + 1] + t * (shells[k] - shells[k + 1]) for t in halved(np.array([0.0, *cuts]))[1:]]
        layer += [k] * len(cuts)
    nodes, bricks, layers, number, slab = lattice(np.stack(depth), np.array(layer), pole=True)
    nodes[np.abs(nodes[:, 0]) < 1e-9, 0] = 0.0
    fixed = np.repeat(_fixed_nodes(finger, number, nodes, along, theta)[:, None], 3, 1)
    fixed[nodes[:, 0] == 0.0, 0] = True
    return Bricks(nodes, bricks, layers, number, slab, fixed)


def _along_grid(finger: FingerShape, d: Divisions) -> Array:
    site, tip = finger.site, finger.cap + 0.5 * np.pi
    wanted = [0.0, finger.cap, tip, *map(finger.along, finger.nail_z)]
    wanted += [finger.along(site + s * r) for r in d.beside for s in (-1, 1)]
    wanted += [
        finger.along(min(max(site + s * r, 0.0), finger.length)) for r in (d.reach, d.span) for s in (-1, 1)
    ]
    breaks = _apart(sorted(set(wanted)), keep=(0.0, finger.cap, tip, *map(finger.along, finger.nail_z)))

    def size(at: float) -> float:
        if at > finger.cap:  # the arc's step: as long as in the body near the site, then the cap's own angle
            arc = finger.length - finger.cap
            z = finger.cap + arc * np.sin(at - finger.cap)
            return min(np.radians(d.cap), _length(z - site, d) / (arc * max(np.cos(at - finger.cap), 0.3)))
        return _length(at - site, d)

    return divide(breaks, size)


def _length(distance: float, d: Divisions) -> float:
    return d.pad if abs(distance) < d.reach else d.flank if abs(distance) < d.span else d.rest


def _apart(breaks: list[float], keep: tuple[float, ...], least: float = 0.08) -> list[float]:
    """Drop breaks that crowd one that must be kept."""
    return [b for b in breaks if b in keep or min(abs(b - k) for k in keep) > least]


def _angle_grid(finger: FingerShape, d: Divisions) -> Array:
    return divide([-90.0, *d.angles, 0.0, finger.nail_theta[0], 90.0], d.angle)


def _fixed_nodes(finger: FingerShape, number: Array, nodes: Array, along: Array, theta: Array) -> Array:
    held = np.zeros(len(nodes), bool)
    held[number[0][number[0] >= 0]] = True
    low, high = (finger.along(z) for z in finger.nail_z)
    nail = (theta[:, None] >= finger.nail_theta[0] - 1e-9) & (along >= low - 1e-9) & (along <= high + 1e-9)
    held[number[-1][nail & (number[-1] >= 0)]] = True
    return held


def block_bricks(depth: Array, across: Array, along: Array, *, held: str = "base") -> Bricks:
    """A block of one layer with its top at y = 0, filling y up to `depth[-1]`, x over `across`, z over
    `along` (grids in mm).

    `held` is "base" (the far face fixed), "slides" (the far face on rollers) or "none"; x = 0 and z = 0 are
    symmetry planes where the grids begin there.
    """
    y, x, z = halved(depth[::-1]), halved(across), halved(along)
    points = np.stack(np.broadcast_arrays(x[None, :, None], y[:, None, None], z[None, None, :]), -1)
    nodes, bricks, layer, number, slab = lattice(points, np.zeros(len(depth) - 1, int))
    fixed = np.zeros((len(nodes), 3), bool)
    far = nodes[:, 1] == depth[-1]
    if held != "none":
        fixed[far, 1 if held == "slides" else slice(None)] = True
        fixed[(nodes[:, 0] == 0.0) & (across[0] == 0.0), 0] = True
        fixed[(nodes[:, 2] == 0.0) & (along[0] == 0.0), 2] = True
    return Bricks(nodes, bricks, layer, number, slab, fixed)
