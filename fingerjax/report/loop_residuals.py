"""What the model misses, drawn where it lives: along the finger, over depth or travel, over position, over time.

| figure | rows |
|---|---|
| `residuals` | condition, used, coordinates, measured, sigma, before, after, left_before, left_after, each with its unit |
| `remainder` | condition, used, coordinates, left, smooth, lower, upper, each with its unit |
"""

from __future__ import annotations

import math
import re
import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from fingerjax.report.figures import COLOURS, MARKERS, draw, shades
from fingerjax.report.loop_figures import DECADES, plain_ticks, plainly
from fingerjax.report.loop_record import NORMAL, ROLES, UNITS, Block, Record, column, maybe, residual_rows, with_unit
from fingerjax.report.records import Figure, Row

ACROSS = {
    "distance": "distance from the load, mm",
    "position": "position of the indenter over the receptor, mm",
    "displacement": "travel of the indenter, mm",
    "travel": "travel of the indenter, mm",
    "depth": "depth of indentation, mm",
    "force": "force, N",
    "time": "time, s",
}
BAND = "#E9EDF0"
MOST = 12  # conditions that a legend can hold
PANELS = 6


def file_name(start: str, block: Block) -> str:
    """The name of a measurement's figure: letters, digits and underscores."""
    return f"{start}_{re.sub(r'[^A-Za-z0-9]+', '_', block.name).strip('_') or 'rows'}"


def residuals(block: Block) -> Figure:
    """Data - model over the coordinate of a measurement, one colour for each condition: before above, after below."""
    return draw(
        file_name("loop_residual", block), _caption(block), residual_rows(block), lambda canvas: _paint(canvas, block), _size(block)
    )


def _caption(block: Block) -> str:
    over = ACROSS.get(block.along or "", block.along or "row").rsplit(",", 1)[0]
    which = "before (above) and after (below)" if block.has_after else "of the model as it stands"
    return f"{block.name}: what the model misses, {which}, over {over}. Grey: 95 % of the noise; hollow: conditions held out."


def _size(block: Block) -> tuple[float, float]:
    return 7.4, 4.8 if block.has_after else 3.0


def _paint(canvas: Canvas, block: Block) -> None:
    moments = ["before", "after"] if block.has_after else ["before"]
    panels = canvas.subplots(len(moments), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    x, series = across(block), block.series
    colours = _colours(block)
    for axes, when in zip(panels, moments, strict=True):
        _band(axes, block, x)
        axes.axhline(0.0, color="black", linewidth=0.8)
        for number, mask in enumerate(series.values()):
            _line(axes, x[mask], block.left(when)[mask], colours[number], MARKERS[number % len(MARKERS)], held_out(block)[mask])
        if _spread_out(block, x):
            axes.set_xscale("log")
            plain_ticks(axes, DECADES)
        axes.set_title(when if len(moments) > 1 else "", loc="left", fontsize=9, fontweight="bold")
        axes.set_ylabel(plainly(f"data − model{_in(block.unit)}"))
    panels[-1].set_xlabel(plainly(ACROSS.get(block.along or "", block.along or "number of the row")))
    _legend(canvas, block, colours)


def across(block: Block) -> np.ndarray:
    """(rows,) the coordinate that a measurement is drawn over; the number of the row where none varies."""
    return block.coordinates[block.along] if block.along is not None else np.arange(1.0, len(block) + 1)


def held_out(block: Block) -> np.ndarray:
    """(rows,) true where a row was not fitted."""
    return ~block.where("fit")


def _spread_out(block: Block, x: np.ndarray) -> bool:
    """Whether times are many early and few late, and want a logarithmic axis."""
    x = x[np.isfinite(x)]
    return block.along == "time" and bool(x.size) and float(x.min()) > 0 and float(x.max()) > 30 * float(x.min())


def _in(unit: str) -> str:
    return f", {unit}" if unit not in ("", "1") else ""


def _colours(block: Block) -> list[Any]:
    """Shades where another coordinate puts the conditions in order (depths), else colours apart."""
    masks = list(block.series.values())
    for name, values in block.coordinates.items():
        if name == block.along:
            continue
        levels = [np.unique(np.round(values[mask], 9)) for mask in masks]
        if len(masks) > 2 and all(level.size == 1 for level in levels) and len({float(level[0]) for level in levels}) == len(masks):
            dark = shades(len(masks))
            order = np.argsort(np.argsort([float(level[0]) for level in levels]))
            return [dark[rank] for rank in order]
    return [COLOURS[i % len(COLOURS)] for i in range(len(masks))] if len(masks) <= len(COLOURS) else shades(len(masks))


def _band(axes: Axes, block: Block, x: np.ndarray) -> None:
    """Where 95 % of single readings fall, by the root mean square of the noise at each place."""
    place = np.unique(x[np.isfinite(x) & np.isfinite(block.sigma)])
    wide = np.array([NORMAL * math.sqrt(float(np.nanmean(block.sigma[x == at] ** 2))) for at in place])
    axes.fill_between(place, -wide, wide, color=BAND, linewidth=0, zorder=0)


def _line(axes: Axes, x: np.ndarray, y: np.ndarray, colour: Any, marker: str, held: np.ndarray) -> None:
    """Single readings as points, hollow where they were held out, joined through the mean of repeats."""
    place = np.unique(np.round(x[np.isfinite(x) & np.isfinite(y)], 9))
    mean = [float(np.nanmean(y[np.isclose(x, at, rtol=0.0, atol=1e-8)])) for at in place]
    for mask, face in ((~held, colour), (held, "white")):
        axes.plot(x[mask], y[mask], marker, color=colour, markerfacecolor=face, markersize=3.2, alpha=0.75, linestyle="none")
    axes.plot(place, mean, color=colour, linewidth=1.2, linestyle="--" if held.all() else "-")


def _legend(canvas: Canvas, block: Block, colours: list[Any]) -> None:
    handles: list[Any] = []
    series = block.series
    for number, (label, mask) in enumerate(list(series.items())[:MOST]):
        hollow = bool(held_out(block)[mask].all())
        face = "white" if hollow else colours[number]
        text = plainly(label.removeprefix(f"{block.name}: ").removeprefix(f"{block.name}, "), 26)
        handles.append(
            Line2D([], [], color=colours[number], marker=MARKERS[number % len(MARKERS)], markerfacecolor=face,
                   linestyle="--" if hollow else "-", label=text)
        )  # fmt: skip
    if len(series) > MOST:
        handles.append(Line2D([], [], linestyle="none", label=f"and {len(series) - MOST} more"))
    if np.isfinite(block.sigma).any():
        handles.append(Patch(color=BAND, label="95 % of the noise"))
    canvas.legend(handles=handles, loc="outside right upper")


# ---- what remains ----


def remainder(block: Block, smooth: Record) -> Figure | None:
    """What remains with its smooth part and the band of that, condition by condition; None where the record has no smooth part of it."""
    rows = remainder_rows(block, smooth)
    if not rows or not any(row[with_unit("smooth", block.unit)] for row in rows):
        return None
    caption = (
        f"{block.name}: what remains (points; hollow: held out), its smooth part (line) and where that lies in 95 % of repeats (band)."
    )
    worst = _worst(block)
    if len(worst) < len(block.series):
        caption += f" The {len(worst)} conditions with the largest remainder; the others are in the table beside it."
    size = (7.4, 0.9 + 2.0 * -(-len(worst) // _wide(len(worst))))
    return draw(file_name("loop_remainder", block), caption, rows, lambda canvas: _panels(canvas, block, smooth, worst), size)


def remainder_rows(block: Block, smooth: Record) -> list[Row]:
    """Rows of the picture; none where the smooth part is not known at each row."""
    mean, lower, upper = smooth_part(block, smooth)
    if not np.isfinite(mean).any():
        return []
    return [
        {
            "condition": block.condition[i],
            "used": ROLES.get(block.role[i], block.role[i]),
            **{with_unit(name, UNITS.get(name)): maybe(values[i]) for name, values in block.coordinates.items()},
            with_unit("left", block.unit): maybe(left_over(block)[i]),
            with_unit("smooth", block.unit): maybe(mean[i]),
            with_unit("lower", block.unit): maybe(lower[i]),
            with_unit("upper", block.unit): maybe(upper[i]),
        }
        for i in range(len(block))
    ]


def left_over(block: Block) -> np.ndarray:
    """(rows,) data - model at the end of the diagnosis."""
    return block.left("after" if block.has_after else "before")


def smooth_part(block: Block, smooth: Record) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(mean, lower, upper), (rows,) each, NaN where it is not known. `mean` and `band`, one standard deviation, are of every row or of
    those that were fitted.
    """
    mean, half = (_dealt(smooth.get(key), block) for key in ("mean", "band"))
    return mean, mean - NORMAL * half, mean + NORMAL * half


def _dealt(values: Any, block: Block) -> np.ndarray:
    fitted = np.flatnonzero(~held_out(block))
    if isinstance(values, (list, tuple)) and len(values) == len(fitted) != len(block):
        dealt = np.full(len(block), math.nan)
        dealt[fitted] = column(values, len(fitted))
        return dealt
    return column(values, len(block))


def _worst(block: Block) -> list[str]:
    """The series with the largest remainder, in the order of the record."""
    size = {label: float(np.nanmean(left_over(block)[mask] ** 2)) for label, mask in block.series.items()}
    most = sorted(size, key=lambda label: -size[label])[:PANELS]
    return [label for label in size if label in most]


def _wide(count: int) -> int:
    return 1 if count == 1 else 2 if count in (2, 4) else 3


def _panels(canvas: Canvas, block: Block, smooth: Record, labels: list[str]) -> None:
    wide = _wide(len(labels))
    grid = canvas.subplots(-(-len(labels) // wide), wide, sharex=True, sharey=True, squeeze=False)
    mean, lower, upper = smooth_part(block, smooth)
    x, rest, series = across(block), left_over(block), block.series
    for axes, label in zip(grid.flat, labels, strict=False):
        mask = series[label]
        order = np.flatnonzero(mask)[np.argsort(x[mask], kind="stable")]
        held = held_out(block)
        axes.fill_between(x[order], lower[order], upper[order], color="#F6D9C3", linewidth=0)
        for chosen, face in ((order[~held[order]], "#777777"), (order[held[order]], "white")):
            axes.plot(x[chosen], rest[chosen], "o", color="#777777", markerfacecolor=face, markersize=2.8, linestyle="none")
        axes.plot(x[order], mean[order], color=COLOURS[1])
        if _spread_out(block, x):
            axes.set_xscale("log")
            plain_ticks(axes, DECADES)
        axes.axhline(0.0, color="black", linewidth=0.7)
        axes.set_title(plainly(textwrap.shorten(label, 34, placeholder=" ...")), fontsize=8)
    for axes in list(grid.flat)[len(labels) :]:
        axes.set_visible(False)
    canvas.supxlabel(plainly(ACROSS.get(block.along or "", block.along or "number of the row")), fontsize=9)
    canvas.supylabel(plainly(f"data − model{_in(block.unit)}"), fontsize=9)
