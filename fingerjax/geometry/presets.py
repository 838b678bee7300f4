"""Two fingertips that need no files: `monkey` and `human`, analytic sections from a few stated dimensions.

Every number is a measured or published dimension or an assumption said to be one; none was fitted to a force.

- Human width 18 mm, monkey 9 mm: the middle of the ranges in Dandekar, Raju & Srinivasan (2003), 16-20 and
  8-10 mm.
- Epidermis 0.5 mm and dermis 1.0 mm at the centre of the human pad (same paper, section 3). The monkey's skin
  is the human's scaled by the height of the finger.
- Bone: a human index distal phalanx, 15.6 mm long, 7.6 mm wide and 4.5 mm thick at its base, 3.9 by 3.2 mm at
  its shaft, 5.1 by 2.8 mm at its tuft; scaled to the monkey by width and height. Proximal to its base the
  bone goes on unchanged.
- As in the paper the inner layers are the section's profile scaled about the bone's centre, which lies
  towards the nail. They are shortened towards the tip too, by their own thickness, for a layer scaled within
  its sections only would shrink to nothing there.
- Assumed: sections are ellipses 12 % wider towards the pad and narrower towards the nail, height 0.98 of the
  width (as one scanned index fingertip is; an earlier 0.86 gave stiffer plates), length 25 and 16.5 mm,
  bone centre 0.18 of the height above the middle, fibrous matrix out to 0.6 of
  the section's radius, bone to 0.82 of the length, nail over 0.42-0.88 of the length and 50-130 deg.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator

from fingerjax.errors import InputError
from fingerjax.geometry.sections import LayeredSolid, Patch, Sections, solid_from_sections
from fingerjax.layers import BONE, LAYERS


@dataclass(frozen=True)
class Dimensions:
    """What a preset is made of. Lengths in mm at the pad's fullest section; shares are parts of 1."""

    name: str
    width: float
    height: float
    length: float
    epidermis: float
    dermis: float
    phalanx: float  # length of the distal phalanx
    bone_width: tuple[float, float, float]  # base, shaft, tuft
    bone_height: tuple[float, float, float]
    bone_rise: float = 0.18  # bone centre above the middle of the section, share of the height
    bone_end: float = 0.82  # share of the length
    fibrous: float = 0.6  # share of the section's radius
    pad_at: float = 0.53  # z of the fullest section, share of the length
    cap_at: float = 0.60  # where the tip begins to round off, share of the length
    cap_power: float = 2.5  # above 2, so that the curvature has no jump where the tip begins
    fullness: float = 0.12  # how much wider the pad's side of a section is than the nail's
    slimming: tuple[float, float] = (
        0.10,
        0.20,
    )  # width and half-height lost from the fullest section to the proximal cut
    nail: tuple[float, float] = (0.42, 0.88)  # share of the length
    nail_angles: tuple[float, float] = (50.0, 130.0)  # deg

    @property
    def bulge(self) -> float:
        """Greatest width of a section over its width at half its height: the maximum of (1 - e v) (1 - v^2)^(1/2), e the fullness."""
        e = self.fullness
        v = (1.0 - math.sqrt(1.0 + 8.0 * e**2)) / (4.0 * e)
        return (1.0 - e * v) * math.sqrt(1.0 - v**2)

    def scaled(self, name: str, width: float, height: float, length: float) -> Dimensions:
        """Another finger of the same build: widths by width, thicknesses by height, lengths by length."""
        across, up, along = width / self.width, height / self.height, length / self.length
        base, shaft, tuft = self.bone_width
        low, middle, top = self.bone_height
        return dataclasses.replace(
            self,
            name=name,
            width=width,
            height=height,
            length=length,
            epidermis=self.epidermis * up,
            dermis=self.dermis * up,
            phalanx=self.phalanx * along,
            bone_width=(base * across, shaft * across, tuft * across),
            bone_height=(low * up, middle * up, top * up),
        )


HEIGHT = 0.98  # of the width: measured on a scanned index fingertip, 12.0 mm high and 12.3 mm wide

HUMAN = Dimensions(
    name="human",
    width=18.0,
    height=HEIGHT * 18.0,
    length=25.0,
    epidermis=0.5,
    dermis=1.0,
    phalanx=15.6,
    bone_width=(7.6, 3.9, 5.1),
    bone_height=(4.5, 3.2, 2.8),
)
# "Monkey fingertips are more ellipsoidal whereas the human fingertips are more cylindrical" (Dandekar et al., section 4.1).
MONKEY = dataclasses.replace(HUMAN.scaled("monkey", width=9.0, height=HEIGHT * 9.0, length=16.5), slimming=(0.20, 0.35))
PRESETS = {"monkey": MONKEY, "human": HUMAN}


def preset(name: str) -> LayeredSolid:
    """The layered solid of a preset. Raises `InputError` when there is none of that name."""
    if name not in PRESETS:
        raise InputError(
            "no such preset finger", place="finger, preset", seen=name, remedy="write monkey or human"
        )
    return solid_from_dimensions(PRESETS[name])


def solid_from_dimensions(d: Dimensions) -> LayeredSolid:
    """Sections every 0.02 of the length (finer where layers end), then the smooth solid through them."""
    share = np.concatenate(
        [np.linspace(0.0, d.cap_at, 31)[:-1], 1.0 - (1.0 - d.cap_at) * np.linspace(1, 0, 49) ** 2]
    )
    z = d.length * share
    theta = np.radians(np.arange(0.0, 360.0, 4.0))
    profile = _profile(d, z, theta)
    bone = phalanx(d, z, theta)
    ends = _ends(d)
    radii = np.zeros((len(z), len(theta), len(LAYERS)))
    for layer, share_of_radius in enumerate(_shares(d)):
        radii[:, :, layer] = rounding(d, z, ends[layer])[:, None] * share_of_radius * profile
    radii[:, :, BONE] = np.minimum(
        rounding(d, z, ends[BONE], blunt=True)[:, None] * bone, radii[:, :, BONE - 1]
    )
    sections = Sections(
        z=z, theta=theta, centre=np.tile([0.0, d.bone_rise * d.height], (len(z), 1)), radii=radii
    )
    low, high = (math.radians(angle) for angle in d.nail_angles)
    nail = Patch(z=(d.nail[0] * d.length, d.nail[1] * d.length), theta=(low, high))
    return solid_from_sections(sections, nail, d.name)


def _shares(d: Dimensions) -> tuple[float, float, float, float]:
    """Outer radius of each soft layer as a share of the section's, from its thickness at the pad's centre."""
    pad = (0.5 + d.bone_rise) * d.height
    return 1.0, 1.0 - d.epidermis / pad, 1.0 - (d.epidermis + d.dermis) / pad, d.fibrous


def _ends(d: Dimensions) -> tuple[float, ...]:
    """z where each layer ends: skin keeps its thickness, fibrous matrix half-way from dermis to bone."""
    dermis, adipose = d.length - d.epidermis, d.length - d.epidermis - d.dermis
    bone = d.bone_end * d.length
    return d.length, dermis, adipose, 0.5 * (adipose + bone), bone


def _profile(d: Dimensions, z: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Outer radius about the bone's centre before the tip rounds off: an ellipse wider in its lower half.

        (x / (a (1 - e v)))^2 + v^2 = 1,   v = (y - middle) / b

    found along each angle by bisection.
    """
    off = (1.0 - z / (d.pad_at * d.length))[:, None] ** 2
    a = 0.5 * d.width * (1.0 - d.slimming[0] * off)
    pad, dorsum = 0.5 * d.height * (1.0 - d.slimming[1] * off), 0.5 * d.height
    b, middle = 0.5 * (pad + dorsum), 0.5 * (dorsum - pad)
    low, high = np.zeros((len(z), len(theta))), np.full((len(z), len(theta)), d.width + d.height)
    for _ in range(60):
        r = 0.5 * (low + high)
        v = (d.bone_rise * d.height + r * np.sin(theta) - middle) / b
        inside = (r * np.cos(theta) / (a * (1.0 - d.fullness * v))) ** 2 + v**2 < 1.0
        low, high = np.where(inside, r, low), np.where(inside, high, r)
    return 0.5 * (low + high)


def phalanx(d: Dimensions, z: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Radius of the bone's elliptical section: base, shaft and tuft of the phalanx joined smoothly."""
    end = d.bone_end * d.length
    base = end - d.phalanx
    places = [base - 0.3 * d.phalanx, base, base + 0.55 * d.phalanx, base + 0.85 * d.phalanx, end]
    size = np.stack([d.bone_width, d.bone_height], axis=-1)[[0, 0, 1, 2, 2]]
    clipped = np.clip(z, places[0], places[-1])
    half = 0.5 * np.asarray(PchipInterpolator(places, size, axis=0)(clipped))[:, None, :]
    return 1.0 / np.sqrt((np.cos(theta) / half[..., 0]) ** 2 + (np.sin(theta) / half[..., 1]) ** 2)


def rounding(d: Dimensions, z: np.ndarray, end: float, blunt: bool = False) -> np.ndarray:
    """Factor on the radius towards a layer's end: sqrt(1 - u^p), u from 0 where rounding begins to 1."""
    start = end - 0.5 * d.bone_width[2] if blunt else d.cap_at * d.length
    u = np.clip((z - start) / (end - start), 0.0, 1.0)
    return np.sqrt(1.0 - u**d.cap_power)
