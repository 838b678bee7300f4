"""The border of a finger in one grey photograph, to a fraction of a pixel.

Light that falls unevenly moves a border found at one grey level for the whole picture. So the grey of the
background and that of the finger are each taken as a smooth function of place, and the border is where the
picture is half-way between the two: there a symmetric blur does not move it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from fingerjax.errors import InputError

SMOOTHING = 1.0  # pixels, against the noise of single ones
COARSE = 8  # every so many pixels are enough to fit the light
CLIPPED = 0.2  # share of one side's pixels at full scale that makes its level unknown
CONTRAST = 6.0  # finger against background, over the noise of a pixel
QUARTER_TURNS = {"up": 0, "left": 3, "down": 2, "right": 1}  # counterclockwise, that bring the tip upwards


@dataclass(frozen=True, eq=False)
class Border:
    """`points`: `(n, 2)` pixels along the border, right and up, from the picture's bottom left corner, tip upwards."""

    points: np.ndarray

    @property
    def top(self) -> float:
        """Height of the tip, pixels."""
        return float(self.points[:, 1].max())


def read_picture(file: Path, tip: str = "up") -> tuple[np.ndarray, float]:
    """Grey values as floats `(rows, columns)` with the tip upwards, and the value at which they are clipped."""
    from PIL import Image

    try:
        with Image.open(file) as opened:
            picture = np.asarray(opened if opened.mode in ("L", "I", "I;16", "I;16B") else opened.convert("L"))
    except (OSError, ValueError, SyntaxError) as error:
        raise InputError(f"cannot be read as a picture ({error})", file=file, remedy="write grey PNG or TIFF") from None
    full = 255.0 if picture.dtype.itemsize == 1 else 65535.0
    return np.rot90(picture, QUARTER_TURNS[tip]).astype(float), full


def border(picture: np.ndarray, full: float, file: Path | None = None) -> Border:
    """The longest closed or bottom-to-bottom border in a picture whose tip points upwards.

    **Raises** `InputError`: nothing seen, clipped grey values, a finger that leaves the picture at its sides or tip.
    """
    from skimage.measure import find_contours

    inside = _rough(picture, full, file)
    level = _between(picture, inside, full, file)
    found = find_contours(ndimage.gaussian_filter(level, SMOOTHING, mode="nearest"), 0.5)
    longest = max(found, key=len)
    rows, columns = picture.shape
    edge = 2.0
    if longest[:, 1].min() < edge or longest[:, 1].max() > columns - 1 - edge or longest[:, 0].min() < edge:
        raise InputError(
            "the finger is cropped", file=file, remedy="leave a margin of background on both sides of the finger and beyond its tip"
        )
    return Border(np.stack([longest[:, 1], rows - 1 - longest[:, 0]], axis=1))


def _rough(picture: np.ndarray, full: float, file: Path | None) -> np.ndarray:
    """Which pixels are finger, by one threshold for the picture; background is what the upper corners show."""
    from skimage.filters import threshold_otsu

    smooth = ndimage.gaussian_filter(picture, 2.0)
    if float(np.mean(picture >= full)) > 0.98:
        raise InputError("the picture is saturated", file=file, seen=f"all pixels at {full:g}", remedy="expose it less")
    noise = float(np.std(picture - smooth))
    mask = smooth > threshold_otsu(smooth)
    corner = max(4, min(picture.shape) // 20)
    background = bool(np.mean(np.r_[mask[:corner, :corner].ravel(), mask[:corner, -corner:].ravel()]) > 0.5)
    inside = mask != background
    both = 0.005 < inside.mean() < 0.995
    apart = abs(float(np.median(picture[inside])) - float(np.median(picture[~inside]))) if both else 0.0
    if apart < max(CONTRAST * noise, 0.02 * full):
        seen = f"two greys {apart:.3g} apart, noise {noise:.3g}"
        raise InputError("no finger is seen: the picture is empty", file=file, seen=seen, remedy="check light, focus and threshold")
    return inside


def _between(picture: np.ndarray, inside: np.ndarray, full: float, file: Path | None) -> np.ndarray:
    """0 on the background, 1 on the finger, with the light taken out; refined once, as the first mask knew no light."""
    level = np.zeros_like(picture)
    for _ in range(2):
        thin, grey = inside[::COARSE, ::COARSE], picture[::COARSE, ::COARSE]
        finger, ground = ndimage.binary_erosion(thin, iterations=2), ~ndimage.binary_dilation(thin, iterations=2)
        for name, side in (("finger", finger), ("background", ground)):
            clipped = float(np.mean(grey[side] >= full)) if side.any() else 0.0
            if clipped > CLIPPED:
                share = f"{100 * clipped:.0f} % of the {name} at {full:g}"
                raise InputError("the picture is saturated", file=file, seen=share, remedy="expose it less, so that no grey is clipped")
        dark, light = _surface(picture, ground), _surface(picture, finger)
        level = (picture - dark) / np.where(np.abs(light - dark) < 1e-9, 1e-9, light - dark)
        inside = ndimage.gaussian_filter(level, 2.0) > 0.5
    return level


def _surface(picture: np.ndarray, side: np.ndarray) -> np.ndarray:
    """A quadratic in row and column through the grey values of one side (of every COARSE-th pixel), evaluated everywhere."""
    rows, columns = (np.linspace(-1.0, 1.0, n) for n in picture.shape)
    y, x = (COARSE * found for found in np.nonzero(side))
    fitted, *_ = np.linalg.lstsq(_terms(columns[x], rows[y]), picture[y, x], rcond=None)
    a, bx, by, cxx, cxy, cyy = fitted
    u, v = columns[None, :], rows[:, None]
    return a + bx * u + by * v + cxx * u * u + cxy * u * v + cyy * v * v


def _terms(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
