"""Cross-sections of a fingertip, and the smooth layered solid through them.

A finger is handed in as axial sections, each a table of five nested radii about the centre of the bone.
Between the sections the squared radius is interpolated (a rounded tip has r^2 that falls linearly, where r
itself has an infinite slope), between the angles a periodic cubic spline. Dandekar, Raju & Srinivasan (2003),
sections 2 and 3: axial cross-sections 0.5-2.0 mm apart, joined to a closed solid with continuous slopes;
polar coordinates about the bone's centre.
"""

from __future__ import annotations

import csv
import hashlib
import math
import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from fingerjax.errors import InputError
from fingerjax.geometry.solid import AbstractSolid
from fingerjax.layers import BONE, LAYERS

LENGTHS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 1e-3}
ANGLES = {"deg": math.pi / 180.0, "rad": 1.0}
QUANTITIES = ("z", "theta", "cx", "cy", *(f"r_{layer}" for layer in LAYERS))
ROUNDING = (
    1e-4  # mm: tables are written with four decimals, so nested radii may cross by one in the last place
)

PAD_SHARE = (0.25, 0.85)  # of the length, where the fullest point of the pad is looked for


@dataclass(frozen=True, eq=False)
class Sections:
    """Axial cross-sections of one fingertip: s sections, m angles, five layers.

    **Arguments:**

    - `z`: `(s,)` mm, increasing from 0, the proximal cut.
    - `theta`: `(m,)` rad, increasing, once round.
    - `centre`: `(s, 2)` mm, x and y of each section's origin (the centre of the bone).
    - `radii`: `(s, m, 5)` mm, outer radius of each layer, from the skin inwards; 0 beyond a layer's end.

    Raises `InputError` where the sections do not close, do not nest, or do not increase in z.
    """

    z: np.ndarray
    theta: np.ndarray
    centre: np.ndarray
    radii: np.ndarray
    file: str | None = None

    def __post_init__(self) -> None:
        _check_sections(self)
        _check_angles(self)
        _check_radii(self)
        _check_ends(self)

    @classmethod
    def from_csv(cls, path: str | os.PathLike[str]) -> Sections:
        """Read `sections.csv`: columns z, theta, cx, cy, r_epidermis, ..., r_bone, each with its unit in its
        name.

        One row per section and angle, lines that begin with `#` are comments. Raises `InputError` with file,
        row, column, value and remedy.
        """
        header, rows, lines = _read_table(Path(path))
        columns = _columns(header, str(path))
        table = _numbers(rows, lines, columns, str(path))
        return _gather(table, lines, str(path))

    @property
    def digest(self) -> str:
        """Hash of the numbers, to name a mesh by what made it."""
        hashed = hashlib.sha256()
        for array in (self.z, self.theta, self.centre, self.radii):
            hashed.update(np.ascontiguousarray(array, np.float64).tobytes())
        return hashed.hexdigest()


def _read_table(path: Path) -> tuple[list[str], list[list[str]], list[int]]:
    """Header, rows and their line numbers in the file, without comments and empty lines."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"cannot be read ({error})", file=path, remedy="name a readable UTF-8 CSV file"
        ) from None
    kept = [
        (number, row)
        for number, row in enumerate(csv.reader(text.splitlines()), start=1)
        if any(cell.strip() for cell in row) and not row[0].lstrip().startswith("#")
    ]
    if len(kept) < 2:
        raise InputError("has no rows", file=path, remedy="write a header and one row per section and angle")
    return (
        [cell.strip() for cell in kept[0][1]],
        [row for _, row in kept[1:]],
        [number for number, _ in kept[1:]],
    )


def _columns(header: list[str], file: str) -> dict[str, tuple[int, float]]:
    """Where each quantity stands and the factor that turns it into mm or rad."""
    found: dict[str, tuple[int, float]] = {}
    for index, name in enumerate(header):
        stem, _, unit = name.rpartition("_")
        units = ANGLES if stem == "theta" else LENGTHS
        if stem in QUANTITIES and unit in units:
            if stem in found:
                raise InputError(
                    "column given twice", file=file, place=f"column {name}", remedy="keep one of them"
                )
            found[stem] = (index, units[unit])
    for stem in QUANTITIES:
        if stem not in found:
            wanted = f"{stem}_{'deg' if stem == 'theta' else 'mm'}"
            raise InputError(
                "column missing, or without its unit",
                file=file,
                place="header",
                seen=",".join(header),
                remedy=f"add a column {wanted}",
            )
    return found


def _numbers(
    rows: list[list[str]], lines: list[int], columns: dict[str, tuple[int, float]], file: str
) -> dict[str, np.ndarray]:
    """The table as numbers in mm and rad."""
    table = {stem: np.empty(len(rows)) for stem in columns}
    for r, (row, line) in enumerate(zip(rows, lines, strict=True)):
        for stem, (index, factor) in columns.items():
            cell = row[index].strip() if index < len(row) else ""
            table[stem][r] = factor * _number(cell, file, f"row {line}, column {stem}")
    return table


def _number(cell: str, file: str, place: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(
            "not a number", file=file, place=place, seen=cell, remedy="write a finite decimal number"
        )
    return value


def _gather(table: dict[str, np.ndarray], lines: list[int], file: str) -> Sections:
    """Rows sorted into sections; every section must have the same angles and one centre."""
    z = table["z"]
    starts = np.flatnonzero(np.r_[True, np.diff(z) != 0.0])
    ends = np.r_[starts[1:], len(z)]
    theta = _usual_angles([table["theta"][a:b] for a, b in zip(starts, ends, strict=True)])
    for start, end in zip(starts, ends, strict=True):
        _check_rows(table, slice(int(start), int(end)), theta, lines, file)
    shape = (len(starts), len(theta))
    radii = np.stack([table[f"r_{layer}"].reshape(shape) for layer in LAYERS], axis=-1)
    centre = np.stack([table["cx"][starts], table["cy"][starts]], axis=-1)
    return Sections(z=z[starts], theta=theta, centre=centre, radii=radii, file=file)


def _usual_angles(each: list[np.ndarray]) -> np.ndarray:
    """The angles that most sections have, so that a slip is found in the section that it is in."""
    lengths = [len(angles) for angles in each]
    usual = max(set(lengths), key=lengths.count)
    return np.median([angles for angles in each if len(angles) == usual], axis=0)


def _check_rows(
    table: dict[str, np.ndarray], rows: slice, theta: np.ndarray, lines: list[int], file: str
) -> None:
    """One section against the usual one: the same angles in the same order, one centre."""
    z, angles = table["z"][rows.start], table["theta"][rows]
    place = f"rows {lines[rows.start]}-{lines[rows.stop - 1]} (z = {z:g} mm)"
    if len(angles) != len(theta):
        raise InputError(
            "section does not close: it has not the angles of the others",
            file=file,
            place=place,
            seen=f"{len(angles)} angles, not {len(theta)}",
            remedy="give every section the same angles, once round",
        )
    wrong = np.flatnonzero(np.abs(angles - theta) > 1e-9)
    if len(wrong):
        raise InputError(
            "angle differs from the other sections'",
            file=file,
            place=f"row {lines[rows.start + int(wrong[0])]}, column theta",
            seen=f"{math.degrees(angles[wrong[0]]):g} deg, not {math.degrees(theta[wrong[0]]):g} deg",
            remedy="give every section the same angles in the same order",
        )
    for stem in ("cx", "cy"):
        moved = np.flatnonzero(np.abs(table[stem][rows] - table[stem][rows.start]) > ROUNDING)
        if len(moved):
            raise InputError(
                "a section has two centres",
                file=file,
                place=f"row {lines[rows.start + int(moved[0])]}, column {stem}",
                seen=float(table[stem][rows][moved[0]]),
                remedy="write one centre for all rows of a section",
            )


def _check_sections(s: Sections) -> None:
    shape = (len(s.z), len(s.theta), len(LAYERS))
    if s.radii.shape != shape or s.centre.shape != (len(s.z), 2):
        raise InputError(
            "arrays do not fit together",
            file=s.file,
            seen=f"radii {s.radii.shape}, centre {s.centre.shape}",
            remedy=f"radii need the shape {shape}, centre {(len(s.z), 2)}",
        )
    if len(s.z) < 4:
        raise InputError(
            "too few sections for a smooth solid", file=s.file, seen=len(s.z), remedy="give four or more"
        )
    back = np.flatnonzero(np.diff(s.z) <= 0)
    if len(back):
        raise InputError(
            "z does not increase from section to section",
            file=s.file,
            place=f"section {back[0] + 2}, column z",
            seen=float(s.z[back[0] + 1]),
            remedy="order the sections from the proximal cut to the tip, each once",
        )
    if abs(s.z[0]) > ROUNDING:
        raise InputError(
            "the first section is not the proximal cut",
            file=s.file,
            place="section 1, column z",
            seen=float(s.z[0]),
            remedy="count z from the proximal cut, so that the first section has z = 0",
        )


def _check_angles(s: Sections) -> None:
    degrees = np.degrees(s.theta)
    gaps = np.diff(np.r_[degrees, degrees[0] + 360.0])
    if (gaps[:-1] <= 0).any() or gaps[-1] <= 1e-6:
        at = int(np.flatnonzero(gaps <= 1e-6)[0])
        raise InputError(
            "angles do not increase once round",
            file=s.file,
            place=f"angle {at + 1}, column theta",
            seen=f"{degrees[at]:g} deg",
            remedy="list each angle once, from 0 to below 360 deg",
        )
    widest = int(np.argmax(gaps))
    if gaps[widest] > 45.0 or gaps[widest] > 3.0 * np.median(gaps):
        raise InputError(
            "sections do not close: angles are missing",
            file=s.file,
            place="column theta",
            seen=f"a gap of {gaps[widest]:g} deg after {degrees[widest]:g} deg",
            remedy="give angles all the way round, at most 45 deg apart and without holes",
        )


def _check_radii(s: Sections) -> None:
    if not np.isfinite(s.radii).all() or not np.isfinite(s.centre).all():
        raise InputError("a radius or centre is not a number", file=s.file, remedy="write finite numbers")
    if (s.radii < 0).any():
        i, j, k = (int(v) for v in np.argwhere(s.radii < 0)[0])
        raise InputError(
            "negative radius",
            file=s.file,
            place=_place(s, i, j, k),
            seen=float(s.radii[i, j, k]),
            remedy="write 0 beyond the end of a layer",
        )
    crossed = np.argwhere(np.diff(s.radii, axis=-1) > 2 * ROUNDING)
    if len(crossed):
        i, j, k = (int(v) for v in crossed[0])
        raise InputError(
            f"radii increase inwards: {LAYERS[k + 1]} lies outside {LAYERS[k]}",
            file=s.file,
            place=_place(s, i, j, k + 1),
            seen=float(s.radii[i, j, k + 1]),
            remedy=f"at most {s.radii[i, j, k]:g} mm, the radius of {LAYERS[k]} there",
        )


def _check_ends(s: Sections) -> None:
    hollow = np.argwhere(s.radii[:-1, :, 0] <= 0)
    if len(hollow):
        i, j = (int(v) for v in hollow[0])
        raise InputError(
            "the skin has no radius before the tip",
            file=s.file,
            place=_place(s, i, j, 0),
            seen=0.0,
            remedy="only the last section may shrink to a point",
        )
    for k in range(1, len(LAYERS)):
        if (s.radii[-1, :, k] > 0).any():
            raise InputError(
                f"the solid does not close: {LAYERS[k]} is cut open at the tip",
                file=s.file,
                place=f"last section (z = {s.z[-1]:g} mm), column r_{LAYERS[k]}",
                seen=float(s.radii[-1, :, k].max()),
                remedy="go on to the tip, where every inner layer has ended (radius 0)",
            )


def _place(s: Sections, i: int, j: int, k: int) -> str:
    return f"z = {s.z[i]:g} mm, theta = {math.degrees(s.theta[j]):g} deg, column r_{LAYERS[k]}"


@dataclass(frozen=True)
class Patch:
    """A rectangle of the outer surface: ranges of z (mm) and of theta (rad, from +x towards +y)."""

    z: tuple[float, float]
    theta: tuple[float, float]

    def __post_init__(self) -> None:
        for name, (low, high) in (("z", self.z), ("theta", self.theta)):
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise InputError(
                    "a range needs two increasing numbers",
                    place=f"nail, {name}",
                    seen=(low, high),
                    remedy="write [low, high]",
                )

    def covers(self, z: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """`(k,)` bool: which surface points `(z, theta)` lie on the patch."""
        turned = np.mod(np.asarray(theta) - self.theta[0], 2 * np.pi)
        z = np.asarray(z)
        return (z >= self.z[0]) & (z <= self.z[1]) & (turned <= self.theta[1] - self.theta[0])


@dataclass(frozen=True, eq=False)
class LayeredSolid(AbstractSolid):
    """Five nested surfaces of one fingertip, smooth in z and theta; 0 is epidermis, 4 is bone.

    `notes` say what was assumed, clamped or corrected on the way here.
    """

    sections: Sections
    nail: Patch
    name: str = "finger"
    notes: tuple[str, ...] = ()

    @property
    def length(self) -> float:
        """z of the tip, mm."""
        return float(self.sections.z[-1])

    @property
    def extent(self) -> str:
        return f"{self.length:.2f} mm long, widest radius {self.largest_radius:.2f} mm"

    @property
    def digest(self) -> str:
        """Hash of everything that shapes the solid."""
        text = f"{self.sections.digest}{self.nail!r}"
        return hashlib.sha256(text.encode()).hexdigest()

    @cached_property
    def _squares(self) -> np.ndarray:
        """Coefficients of r^2, `(5, s - 1, m, 4, 4)`: powers of z - z_i, of theta - theta_j."""
        theta = self.sections.theta
        closed = np.r_[theta, theta[0] + 2 * np.pi]
        out = []
        for layer in range(len(LAYERS)):
            squares = _continued(self.sections.z, self.sections.radii[:, :, layer] ** 2)
            in_z = PchipInterpolator(self.sections.z, squares, axis=0).c  # (4, s-1, m)
            wrapped = np.concatenate([in_z, in_z[:, :, :1]], axis=2)
            in_theta = CubicSpline(closed, wrapped, axis=2, bc_type="periodic").c  # (4 theta, m, 4 z, s-1)
            out.append(np.transpose(in_theta, (3, 1, 2, 0)))
        return np.stack(out)

    @cached_property
    def _middle(self) -> PchipInterpolator:
        return PchipInterpolator(self.sections.z, self.sections.centre, axis=0)

    def centre(self, z: np.ndarray) -> np.ndarray:
        """x and y of the section's origin, `(k, 2)` mm, at z `(k,)` mm."""
        return np.asarray(self._middle(np.clip(np.asarray(z, float), 0.0, self.length)))

    def square(self, layer: int, z: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """Squared radius of a layer's outer surface, `(k,)` mm^2; negative beyond the layer's end."""
        knots, angles = self.sections.z, self.sections.theta
        z = np.clip(np.asarray(z, float), 0.0, self.length)
        turned = angles[0] + np.mod(np.asarray(theta, float) - angles[0], 2 * np.pi)
        i = np.clip(np.searchsorted(knots, z, side="right") - 1, 0, len(knots) - 2)
        j = np.clip(np.searchsorted(angles, turned, side="right") - 1, 0, len(angles) - 1)
        c = self._squares[layer][i, j]  # (k, 4 powers of z, 4 powers of theta)
        a, b = (z - knots[i])[..., None], turned - angles[j]
        in_theta = ((c[..., 0, :] * a + c[..., 1, :]) * a + c[..., 2, :]) * a + c[..., 3, :]
        return ((in_theta[..., 0] * b + in_theta[..., 1]) * b + in_theta[..., 2]) * b + in_theta[..., 3]

    def radius(self, layer: int, z: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """Radius of a layer's outer surface, `(k,)` mm; 0 beyond its end, at most the layer's outside it."""
        z, theta = np.broadcast_arrays(np.asarray(z, float), np.asarray(theta, float))
        squares = np.stack([self.square(k, z, theta) for k in range(layer + 1)])
        return np.sqrt(np.maximum(squares.min(axis=0), 0.0))

    def level(self, layer: int, points: np.ndarray) -> np.ndarray:
        """Negative inside a layer's outer surface: (rho^2 - r^2) / (2 r_max), `(k,)` mm, about a distance on
        the pad.

        `points` is `(k, 3)` mm. The skin is closed at the tip by z = length as well.
        """
        x, y = (points[..., :2] - self.centre(points[..., 2])).T
        square = self.square(layer, points[..., 2], np.arctan2(y, x))
        value = (x * x + y * y - square) / (2.0 * self.largest_radius)
        return np.maximum(value, points[..., 2] - self.length) if layer == 0 else value

    @cached_property
    def largest_radius(self) -> float:
        """Largest outer radius of any section, mm."""
        return float(self.sections.radii[:, :, 0].max())

    def layer_of(self, points: np.ndarray) -> np.ndarray:
        """Which layer each point `(k, 3)` lies in: 0 to 4, or -1 outside the skin."""
        return np.sum([self.level(k, points) < 0 for k in range(len(LAYERS))], axis=0) - 1

    def rays(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """From each point's section's origin, outwards through the point."""
        centre = self.centre(points[:, 2])
        x, y = (points[:, :2] - centre).T
        theta = np.arctan2(y, x)
        return centre, np.stack([self.radius(layer, points[:, 2], theta) for layer in range(len(LAYERS))])

    def angle(self, points: np.ndarray) -> np.ndarray:
        """theta in [0, 2 pi) of points `(k, 3)` about their section's origin."""
        x, y = (points[..., :2] - self.centre(points[..., 2])).T
        return np.mod(np.arctan2(y, x), 2 * np.pi)

    @cached_property
    def pad_centre(self) -> float:
        """z of the fullest point of the pad's middle line, mm."""
        z = np.linspace(0.0, self.length, 2001)
        return float(z[fullest(z, self.pad_y(z), self.length)])

    def area(self, layer: int, z: np.ndarray, angles: int = 180) -> np.ndarray:
        """Area within a layer's outer surface in the sections at z, `(k,)` mm^2."""
        theta = 2 * np.pi * np.arange(angles) / angles
        squares = self.radius(layer, np.asarray(z, float)[:, None], theta[None, :]) ** 2
        return np.pi * squares.mean(axis=1)

    def volume(self, layer: int, slices: int = 1000) -> float:
        """Volume of one layer, mm^3, by the midpoint rule over fine slices."""
        z = (np.arange(slices) + 0.5) * self.length / slices
        inner = self.area(layer + 1, z) if layer < BONE else 0.0
        return float(np.sum(self.area(layer, z) - inner) * self.length / slices)


def fullest(z: np.ndarray, pad: np.ndarray, length: float) -> int:
    """Where along z `(s,)` mm the pad's line `(s,)` mm is lowest, within the last phalanx.

    A finger that goes on growing thicker proximally has no lowest point there; then it is where the line hangs lowest below its chord.
    """
    there = np.flatnonzero((z >= PAD_SHARE[0] * length) & (z <= PAD_SHARE[1] * length))
    at = there[np.argmin(pad[there])]
    if there[0] < at < there[-1]:
        return int(at)
    share = (z[there] - z[there[0]]) / (z[there[-1]] - z[there[0]])
    return int(there[np.argmin(pad[there] - (1.0 - share) * pad[there[0]] - share * pad[there[-1]])])


def _continued(z: np.ndarray, squares: np.ndarray) -> np.ndarray:
    """r^2 `(s, m)` with the zeros beyond a layer's end replaced by a straight fall below zero.

    A rounded end has r^2 falling linearly; going on keeps the level set smooth across the end. The fall is at
    least steep enough to end the layer before the first section that says it has ended.
    """
    out = squares.copy()
    positive = squares > 0
    last = np.where(positive.any(axis=0), len(z) - 1 - np.argmax(positive[::-1], axis=0), -1)
    for j in np.flatnonzero((last >= 0) & (last < len(z) - 1)):
        i = int(last[j])
        slope = -squares[i, j] / (z[i + 1] - z[i])
        if i > 0:
            slope = min(slope, (squares[i, j] - squares[i - 1, j]) / (z[i] - z[i - 1]))
        out[i + 1 :, j] = squares[i, j] + slope * (z[i + 1 :] - z[i])
    return out


def solid_from_sections(sections: Sections, nail: Patch, name: str = "finger", notes: tuple[str, ...] = ()) -> LayeredSolid:
    """The smooth solid through sections, with the patch of its surface that is nail."""
    if nail.z[0] < 0 or nail.z[1] > sections.z[-1]:
        raise InputError(
            "the nail leaves the finger",
            place="nail, z",
            seen=nail.z,
            remedy=f"stay between 0 and {sections.z[-1]:g} mm",
        )
    return LayeredSolid(sections=sections, nail=nail, name=name, notes=notes)
