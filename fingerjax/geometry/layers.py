"""Five nested layers inside a skin that was measured from outside.

As in the paper the inner layers are the section's own profile, scaled about the centre of the bone, which lies
towards the nail (Dandekar, Raju & Srinivasan 2003, section 3). Thickness is stated at the centre of the pad. A
layer scaled within its sections only would shrink to nothing towards the tip, so each is shortened along z too,
by its own thickness: where the tip rounds off, beyond z_c, the preset's rounding is exchanged for one that ends sooner,

    r_k(z, theta) = s_k r_0(z, theta) q(z, L - d_k) / q(z, L),   q(z, end) = (1 - ((z - z_c) / (end - z_c))^p)^(1/2),

d_k being the depth of the layer at the centre of the pad. `even` skin has the same thickness all round instead.
What is not stated is taken from a preset, scaled to the width, height and length that were measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from fingerjax.csvfile import read_table
from fingerjax.errors import InputError
from fingerjax.geometry.outline import Outline
from fingerjax.geometry.presets import PRESETS, Dimensions, phalanx, rounding
from fingerjax.geometry.sections import LayeredSolid, Patch, Sections, solid_from_sections
from fingerjax.layers import BONE, LAYERS

ANGLES = 90
THINNEST = 0.02  # mm left of adipose tissue or of the fibrous matrix before layers are said to cross


@dataclass(frozen=True)
class LayerPlan:
    """What is known of the inside of a finger; None: as in the preset `like`, scaled to this finger.

    - `epidermis`, `dermis`: thickness at the centre of the pad, mm.
    - `varies`: `scaled` with the section's radius, or `even` all round.
    - `fibrous`: outer radius of the fibrous matrix, share of the skin's.
    - `bone_width`, `bone_height`: base, shaft and tuft, mm; `bone_length`: of the phalanx, mm; `bone_end`: share of the length.
    - `rise`: the bone's centre above the middle of the fullest section, share of its height.
    - `bone_sections`: a CSV of the bone's own sections instead, `z_mm, theta_deg, r_mm` about its centre.
    """

    like: str = "human"
    epidermis: float | None = None
    dermis: float | None = None
    varies: Literal["scaled", "even"] = "scaled"
    fibrous: float | None = None
    bone_width: tuple[float, float, float] | None = None
    bone_height: tuple[float, float, float] | None = None
    bone_length: float | None = None
    bone_end: float | None = None
    rise: float | None = None
    bone_sections: Path | None = None

    def dimensions(self, width: float, height: float, length: float) -> Dimensions:
        """The preset's build at these greatest sizes, with what is stated put in."""
        stated = {
            "epidermis": self.epidermis,
            "dermis": self.dermis,
            "fibrous": self.fibrous,
            "bone_width": self.bone_width,
            "bone_height": self.bone_height,
            "phalanx": self.bone_length,
            "bone_end": self.bone_end,
            "bone_rise": self.rise,
        }
        like = PRESETS[self.like]
        scaled = like.scaled(self.like, width / like.bulge, height, length)
        return Dimensions(**{**vars(scaled), **{name: value for name, value in stated.items() if value is not None}})


@dataclass(frozen=True, eq=False)
class _Skin:
    """r_0(z, theta) about the bone's centre, and the centre."""

    outline: Outline
    dimensions: Dimensions
    z: np.ndarray
    centre: np.ndarray
    theta: np.ndarray

    def radius(self, z: np.ndarray) -> np.ndarray:
        """`(k, m)` mm; r^2 is interpolated, and 0 at the tip."""
        return np.sqrt(np.maximum(self._square(np.minimum(z, self.outline.length)), 0.0))

    @cached_property
    def _square(self) -> PchipInterpolator:
        radii = self.outline.radii(self.centre[:-1], self.theta)
        return PchipInterpolator(self.z, np.vstack([radii**2, np.zeros(len(self.theta))]), axis=0)


def layered(outline: Outline, plan: LayerPlan, nail: Patch | None = None, name: str = "finger") -> LayeredSolid:
    """The layered solid inside a skin; without a nail, the patch that the preset `like` has.

    **Raises** `InputError` where layers cross. What had to be clamped, assumed or corrected is in the solid's `notes`.
    """
    d = _measured(outline, plan)
    skin = _skin(outline, d)
    pad = _pad_radius(skin)
    ends = _ends(outline, d)
    cap = d.cap_at * outline.length
    z = np.unique(np.r_[skin.z, np.minimum(np.concatenate([_before(end, cap) for end in ends[1:]]), outline.length)])
    z = z[np.r_[True, np.diff(z) > 1e-6 * outline.length]]
    radii = np.zeros((len(z), len(skin.theta), len(LAYERS)))
    radii[:, :, 0] = skin.radius(z)
    for layer in range(1, BONE):
        radii[:, :, layer] = _inner(skin, z, layer, d, pad, ends[layer], plan.varies)
    _check_crossing(radii, z, skin.theta, d)
    bone, clamped = _bone(skin, z, d, plan, radii)
    radii[:, :, BONE] = bone
    radii[-1] = 0.0
    centre = np.stack([np.interp(z, skin.z, column) for column in skin.centre.T], axis=1)
    sections = Sections(z=z, theta=skin.theta, centre=centre, radii=radii)
    patch, assumed = (nail, ()) if nail is not None else _nail(outline, d, plan.like)
    return solid_from_sections(sections, patch, name, notes=(*outline.notes, *clamped, *assumed))


def _measured(outline: Outline, plan: LayerPlan) -> Dimensions:
    at = outline.fullest
    width, height = outline.high[at] - outline.low[at]
    return plan.dimensions(float(width), float(height), outline.length)


def _skin(outline: Outline, d: Dimensions) -> _Skin:
    """The bone's centre runs straight below the dorsum as far as the bone goes, and on to the tip from there."""
    low, high = outline.low, outline.high
    at = outline.fullest
    height = float(high[at, 1] - low[at, 1])
    shaft = outline.z <= d.cap_at * outline.length
    dorsum = np.polyval(np.polyfit(outline.z[shaft], high[shaft, 1], 1), outline.z)
    middle = np.polyval(np.polyfit(outline.z[shaft], 0.5 * (low + high)[shaft, 0], 1), outline.z)
    line = np.stack([middle, dorsum - (0.5 - d.bone_rise) * height], axis=1)
    end = d.bone_end * outline.length
    share = (np.clip((outline.z - end) / (outline.length - end), 0.0, 1.0) ** 2)[:, None]
    centre = np.vstack([line * (1.0 - share) + outline.apex[:2] * share, outline.apex[:2]])
    theta = np.radians(np.arange(ANGLES) * 360.0 / ANGLES)
    return _Skin(outline, d, np.r_[outline.z, outline.length], centre, theta)


def _pad_radius(skin: _Skin) -> float:
    """mm from the bone's centre to the centre of the pad."""
    return float(np.interp(1.5 * np.pi, skin.theta, skin.radius(skin.outline.z[[skin.outline.fullest]])[0]))


def _ends(outline: Outline, d: Dimensions) -> tuple[float, ...]:
    """z where each layer ends: skin keeps its thickness, fibrous matrix half-way from dermis to bone."""
    length = outline.length
    dermis, adipose, bone = length - d.epidermis, length - d.epidermis - d.dermis, d.bone_end * length
    return length, dermis, adipose, 0.5 * (adipose + bone), bone


def _before(end: float, cap: float) -> np.ndarray:
    """Sections that crowd towards a layer's end."""
    return cap + (end - cap) * (1.0 - np.linspace(1.0, 0.0, 25) ** 2)


def _inner(skin: _Skin, z: np.ndarray, layer: int, d: Dimensions, pad: float, end: float, varies: str) -> np.ndarray:
    """Outer radius `(s, m)` of one inner soft layer."""
    there = z < end
    sooner = rounding(d, z, end) / np.where(there, rounding(d, z, skin.outline.length), 1.0)
    outer = np.where(there, sooner, 0.0)[:, None] * skin.radius(z)
    depth = (0.0, d.epidermis, d.epidermis + d.dermis)
    if layer == BONE - 1:
        return d.fibrous * outer
    if varies == "even":
        return np.maximum(outer - depth[layer], 0.0)
    return (1.0 - depth[layer] / pad) * outer


def _check_crossing(radii: np.ndarray, z: np.ndarray, theta: np.ndarray, d: Dimensions) -> None:
    """Adipose tissue must be left between the skin and the fibrous matrix wherever the latter is."""
    room = np.where(radii[:, :, BONE - 1] > 0, radii[:, :, BONE - 2] - radii[:, :, BONE - 1], np.inf)
    i, j = np.unravel_index(int(np.argmin(room)), room.shape)
    if room[i, j] < THINNEST:
        most = radii[i, j, 0] - radii[i, j, BONE - 1] - THINNEST
        raise InputError(
            "layers cross: the dermis reaches into the fibrous matrix",
            place=f"layers, z = {z[i]:.2f} mm, theta = {np.degrees(theta[j]):.0f} deg",
            seen=f"epidermis {d.epidermis:.3g} mm and dermis {d.dermis:.3g} mm, {room[i, j]:.3g} mm left for adipose tissue",
            remedy=f"at most {max(most, 0):.3g} mm of skin there, or fibrous: below {d.fibrous:g}",
        )


def _bone(skin: _Skin, z: np.ndarray, d: Dimensions, plan: LayerPlan, radii: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """Radius `(s, m)` of the bone, kept inside the fibrous matrix; and a note of where it had to be."""
    if plan.bone_sections is not None:
        free = _bone_table(plan.bone_sections, z, skin.theta)
    else:
        free = rounding(d, z, d.bone_end * d.length, blunt=True)[:, None] * phalanx(d, z, skin.theta)
    limit = radii[:, :, BONE - 1]
    over = np.where((z < 0.98 * d.bone_end * d.length)[:, None], free - limit, 0.0)
    i, j = np.unravel_index(int(np.argmax(over)), over.shape)
    if over[i, j] <= 1e-6:
        return np.minimum(free, limit), ()
    note = (
        f"bone clamped to the fibrous matrix at {100 * float(np.mean(over > 1e-6)):.0f} % of its points, most at z = {z[i]:.1f} mm, "
        f"theta = {np.degrees(skin.theta[j]):.0f} deg, by {over[i, j]:.2f} mm"
    )
    return np.minimum(free, limit), (note,)


def _bone_table(file: Path, z: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Radius of the bone `(s, m)` from its own sections; r^2 is interpolated along z, 0 beyond the last section."""
    table = read_table(file)
    at, angle, radius = (table.numbers(name) for name in ("z_mm", "theta_deg", "r_mm"))
    levels = np.unique(at)
    if len(levels) < 4:
        raise InputError("too few sections of the bone", file=file, seen=len(levels), remedy="give four or more")
    squares = np.empty((len(levels), len(theta)))
    for i, level in enumerate(levels):
        order = np.argsort(angle[at == level])
        known, r = np.radians(angle[at == level][order]), radius[at == level][order]
        spline = CubicSpline(np.r_[known, known[0] + 2 * np.pi], np.r_[r, r[0]], bc_type="periodic")
        squares[i] = np.maximum(spline(theta), 0.0) ** 2
    inside = PchipInterpolator(levels, squares, axis=0)(np.clip(z, levels[0], levels[-1]))
    return np.where((z <= levels[-1])[:, None], np.sqrt(np.maximum(inside, 0.0)), 0.0)


def _nail(outline: Outline, d: Dimensions, like: str) -> tuple[Patch, tuple[str, ...]]:
    z = (d.nail[0] * outline.length, d.nail[1] * outline.length)
    low, high = d.nail_angles
    note = f"nail assumed as in the preset {like}: z {z[0]:.1f} to {z[1]:.1f} mm, theta {low:g} to {high:g} deg"
    return Patch(z=z, theta=(float(np.radians(low)), float(np.radians(high)))), (note,)
