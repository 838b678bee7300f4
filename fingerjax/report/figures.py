"""Figures, each drawn from tidy rows that are kept beside it.

| figure | rows |
|---|---|
| `profiles` | depth_mm, distance_mm, measured_mm, sigma_mm, predicted_mm, residual_mm |
| `force_displacement` | series, displacement_mm, measured_N, sigma_N, predicted_N |
| `rates` | stimulus, position_mm, measured_Hz, sigma_Hz, predicted_Hz |
| `moduli` | name, value_MPa, lower_MPa, upper_MPa, paper_MPa, paper_sd_MPa |
| `layer_study` | model, distance_mm, deflection (of the load's), optionally `panel` |
| `tip_radius` | radius_mm, slope_MPa_per_gf, ratio |
| `heat_map` | any: a row name, a column name, a value |
| `profile_likelihood` | parameter, value, root, t |
| `basins` | basin, chi2, `from NAME`, `to NAME` |
| `fit_path` | step, chi2, gradient, accepted |

A row may lack a measured value (the curve goes on between the points) or a predicted one. Every function
returns a `Figure` whose SVG is the same each time it is drawn from the same rows.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from fingerjax.report.records import Figure, Row

# Okabe & Ito (2008): told apart by people who do not see all colours.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
PAPER = "#8A8A8A"
STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E6E6E6",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.6,
    "lines.markersize": 3.6,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "svg.fonttype": "path",
    "figure.constrained_layout.use": True,
}


def draw(
    name: str,
    caption: str,
    rows: Sequence[Row],
    paint: Callable[[Canvas], object],
    size: tuple[float, float] = (6.4, 4.0),
) -> Figure:
    """Paint a canvas (size in inches) in the house style and keep it as SVG with its rows."""
    with mpl.rc_context({**STYLE, "svg.hashsalt": name}):
        canvas = Canvas(figsize=size)
        paint(canvas)
        buffer = io.StringIO()
        canvas.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return Figure(name, caption, buffer.getvalue(), [dict(row) for row in rows])


def shades(count: int) -> list[Any]:
    """Colours for values that have an order, light to dark."""
    return [mpl.colormaps["viridis_r"](share) for share in np.linspace(0.15, 0.9, max(count, 1))]


def groups(rows: Sequence[Row], column: str) -> dict[Any, list[Row]]:
    """Rows by the value of a column, in order of appearance; all under "" where it is missing."""
    found: dict[Any, list[Row]] = {}
    for row in rows:
        found.setdefault(row.get(column, ""), []).append(row)
    return found


def numbers(rows: Sequence[Row], column: str) -> np.ndarray:
    """A column as floats, NaN where it is missing."""
    return np.array([math.nan if row.get(column) is None else float(row[column]) for row in rows])


def _ordered(rows: Sequence[Row], column: str) -> list[Row]:
    return sorted(rows, key=lambda row: float(row[column]))


def _points_and_curve(
    axes: Axes, rows: Sequence[Row], x: str, unit: str, colour: Any, marker: str, label: str
) -> None:
    """Measured values with one sigma as points, predicted ones as a curve."""
    across, measured = numbers(rows, x), numbers(rows, f"measured_{unit}")
    sigma = numbers(rows, f"sigma_{unit}")
    spread = np.where(np.isfinite(sigma), sigma, 0.0)
    there = np.isfinite(measured)
    predicted = numbers(rows, f"predicted_{unit}")
    told = np.isfinite(predicted)
    if there.any():
        axes.errorbar(
            across[there], measured[there], spread[there], fmt=marker, color=colour, elinewidth=0.8,
            markerfacecolor="white", label=label if not told.any() else None,
        )  # fmt: skip
    if told.any():
        axes.plot(across[told], predicted[told], color=colour, label=label)


def _two_panels(canvas: Canvas) -> tuple[Axes, Axes]:
    upper, lower = canvas.subplots(2, 1, sharex=True, height_ratios=[3, 1])
    lower.axhline(0.0, color="black", linewidth=0.8)
    return upper, lower


def _residual_strip(axes: Axes, rows: Sequence[Row], x: str, unit: str, colour: Any, marker: str) -> None:
    difference = numbers(rows, f"predicted_{unit}") - numbers(rows, f"measured_{unit}")
    axes.plot(numbers(rows, x), difference, marker, color=colour, markerfacecolor="white", linestyle="none")


def _against(
    rows: Sequence[Row], x: str, unit: str, by: str, labels: tuple[str, str], colours: Sequence[Any]
) -> Callable[[Canvas], None]:
    """Data and fit over `x`, one colour for each value of `by`, with the residuals in a strip below."""

    def paint(canvas: Canvas) -> None:
        upper, lower = _two_panels(canvas)
        for number, (label, members) in enumerate(groups(rows, by).items()):
            colour, marker = colours[number % len(colours)], MARKERS[number % len(MARKERS)]
            members = _ordered(members, x)
            _points_and_curve(upper, members, x, unit, colour, marker, _said(by, label))
            _residual_strip(lower, members, x, unit, colour, marker)
        upper.set_ylabel(f"{labels[1]}, {unit}")
        lower.set(xlabel=labels[0], ylabel=f"fit - data, {unit}")
        if len(groups(rows, by)) > 1 or next(iter(groups(rows, by)), ""):
            upper.legend(title=_legend_title(by))
        canvas.align_ylabels()

    return paint


def _said(by: str, label: Any) -> str:
    return f"{label:g}" if isinstance(label, float) else str(label)


def _legend_title(by: str) -> str | None:
    return "depth, mm" if by == "depth_mm" else None


def profiles(rows: Sequence[Row], name: str = "profiles", caption: str = "", axis: str = "z") -> Figure:
    """Surface deflection against distance from the load at each depth: data, fit, and what is left.

    **Arguments:** rows as in the module's table; `axis` along which the distance is counted.
    """
    rows = sorted(rows, key=lambda row: (float(row["depth_mm"]), float(row["distance_mm"])))
    labels = (f"distance from the load along {axis}, mm", "deflection")
    colours = shades(len(groups(rows, "depth_mm")))

    def paint(canvas: Canvas) -> None:
        _against(rows, "distance_mm", "mm", "depth_mm", labels, colours)(canvas)
        canvas.axes[0].invert_yaxis()  # an indentation goes down on paper

    text = caption or "Surface deflection beside the load: points measured, curves fitted; below, the rest."
    return draw(name, text, rows, paint, (6.4, 4.8))


def force_displacement(rows: Sequence[Row], name: str = "force", caption: str = "") -> Figure:
    """Force against the travel of the indenter: data, fit, and what is left."""
    labels = ("travel from first contact, mm", "force")
    paint = _against(rows, "displacement_mm", "N", "series", labels, COLOURS)
    text = caption or "Normal force against travel: points measured, curves fitted; below, what is left."
    return draw(name, text, rows, paint, (6.4, 4.8))


def rates(rows: Sequence[Row], name: str = "rates", caption: str = "") -> Figure:
    """Spike rate against the position of the indenter: data, fit, and what is left."""
    labels = ("position of the indenter over the receptor, mm", "rate")
    paint = _against(rows, "position_mm", "Hz", "stimulus", labels, COLOURS)
    text = caption or "Spike rate against position: points recorded, curves fitted; below, what is left."
    return draw(name, text, rows, paint, (6.4, 4.8))


def moduli(rows: Sequence[Row], name: str = "moduli", caption: str = "") -> Figure:
    """Our moduli with their intervals beside the paper's, on a logarithmic scale where they span a decade."""

    def paint(canvas: Canvas) -> None:
        axes = canvas.subplots()
        place = np.arange(len(rows), dtype=float)
        ours, theirs = numbers(rows, "value_MPa"), numbers(rows, "paper_MPa")
        style: dict[str, Any] = {"color": COLOURS[0], "label": "fingerjax", "capsize": 2}
        axes.bar(place - 0.2, ours, 0.36, yerr=_whiskers(rows), **style)
        if np.isfinite(theirs).any():
            spread = numbers(rows, "paper_sd_MPa")
            axes.bar(
                place + 0.2, theirs, 0.36, color=PAPER, label="Dandekar et al. 2003",
                yerr=np.where(np.isfinite(spread), spread, 0.0), capsize=2,
            )  # fmt: skip
        every = np.concatenate([ours, theirs])
        every = every[np.isfinite(every) & (every > 0)]
        if every.size and every.max() > 10 * every.min():
            axes.set_yscale("log")
        turned = max((len(str(row["name"])) for row in rows), default=0) > 9
        axes.set_xticks(place, [str(row["name"]) for row in rows], rotation=35 if turned else 0,
                        ha="right" if turned else "center")  # fmt: skip
        axes.set_ylabel("modulus, MPa")
        axes.grid(axis="x", visible=False)
        axes.legend()

    return draw(name, caption or "Moduli with 95 % intervals, beside the paper's.", rows, paint)


def _whiskers(rows: Sequence[Row]) -> np.ndarray:
    value = numbers(rows, "value_MPa")
    ends = np.stack([value - numbers(rows, "lower_MPa"), numbers(rows, "upper_MPa") - value])
    return np.where(np.isfinite(ends), np.maximum(ends, 0.0), 0.0)


def layer_study(rows: Sequence[Row], name: str = "layers", caption: str = "") -> Figure:
    """Deflection profiles of the models, a panel for each layer that was changed.

    The model of the rows without a `panel` (or with panel "") is drawn grey in every panel, for comparison.
    """
    panels = [panel for panel in groups(rows, "panel") if panel] or [""]
    reference = [row for row in rows if not row.get("panel")] if panels != [""] else []

    def paint(canvas: Canvas) -> None:
        across = min(len(panels), 2)
        grid = canvas.subplots(-(-len(panels) // across), across, sharex=True, sharey=True, squeeze=False)
        for axes, panel in zip(grid.flat, panels, strict=False):
            _curves(axes, reference, [PAPER])
            _curves(axes, [row for row in rows if row.get("panel", "") == panel], COLOURS)
            axes.set_title(panel, fontsize=9)
            axes.legend()
        for axes in grid.flat[len(panels) :]:
            axes.set_visible(False)
        grid[0, 0].invert_yaxis()
        canvas.supxlabel("distance from the load, mm", fontsize=9)
        canvas.supylabel("deflection, share of that under the load", fontsize=9)

    tall = 2.4 * -(-len(panels) // 2) if len(panels) > 1 else 4.0
    return draw(name, caption or "Deflection profiles of the layer models.", rows, paint, (6.8, tall + 0.6))


def _curves(axes: Axes, rows: Sequence[Row], colours: Sequence[str]) -> None:
    for number, (model, members) in enumerate(groups(rows, "model").items()):
        members = _ordered(members, "distance_mm")
        axes.plot(
            numbers(members, "distance_mm"), numbers(members, "deflection"), label=str(model),
            color=colours[number % len(colours)],
        )  # fmt: skip


def tip_radius(
    rows: Sequence[Row], paper_slope: float, paper_ratio: float, name: str = "tip_radius", caption: str = ""
) -> Figure:
    """Modulus per force of a point, and the plate's force over the point's, against the radius of its tip.

    **Arguments:** `paper_slope` in MPa/gf and `paper_ratio`, drawn as lines.
    """
    rows = _ordered(rows, "radius_mm")

    def paint(canvas: Canvas) -> None:
        left, right = canvas.subplots(1, 2)
        radius = numbers(rows, "radius_mm")
        for axes, column, line, label in (
            (left, "slope_MPa_per_gf", paper_slope, "modulus per force, MPa/gf"),
            (right, "ratio", paper_ratio, "force on the plate / on the point"),
        ):
            axes.plot(radius, numbers(rows, column), "o-", color=COLOURS[0], label="fingerjax")
            axes.axhline(line, color=PAPER, linestyle="--", label=f"paper: {line:g}")
            axes.set(xlabel="radius of the tip, mm", ylabel=label)
            axes.legend()

    text = caption or "What the radius of the point, which the paper does not give, does to its modulus."
    return draw(name, text, rows, paint, (7.2, 3.2))


def heat_map(
    rows: Sequence[Row], across: str, down: str, value: str, *, name: str, caption: str, label: str
) -> Figure:
    """A table of numbers as colours, zero white; written into the cells while there are few."""
    columns, lines = list(groups(rows, across)), list(groups(rows, down))
    cells = np.full((len(lines), len(columns)), np.nan)
    for row in rows:
        if row[value] is not None:
            cells[lines.index(row[down]), columns.index(row[across])] = float(row[value])

    def paint(canvas: Canvas) -> None:
        axes = canvas.subplots()
        limit = float(np.nanmax(np.abs(cells), initial=1e-300))
        image = axes.imshow(cells, cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="auto")
        canvas.colorbar(image, ax=axes, label=label)
        turned = max((len(str(c)) for c in columns), default=0) > 6
        if len(columns) <= 40:
            axes.set_xticks(range(len(columns)), [str(c) for c in columns], rotation=35 if turned else 0,
                            ha="right" if turned else "center")  # fmt: skip
        if len(lines) <= 40:
            axes.set_yticks(range(len(lines)), [str(line) for line in lines])
        else:
            axes.set_ylabel(down)
        axes.grid(visible=False)
        if cells.size <= 64:
            _write(axes, cells, limit)

    return draw(name, caption, rows, paint, (6.4, 1.6 + 0.28 * min(len(lines), 18)))


def _write(axes: Axes, cells: np.ndarray, limit: float) -> None:
    for (line, column), number in np.ndenumerate(cells):
        colour = "white" if abs(number) > 0.6 * limit else "black"
        text = f"{number:.2g}" if math.isfinite(number) else "-"
        axes.text(column, line, text, ha="center", va="center", fontsize=7, color=colour)


def correlations(record: dict[str, dict[str, float | None]], name: str = "correlations") -> Figure:
    """The correlation matrix of a fit's record as a heat map."""
    rows: list[Row] = [
        {"parameter": one, "with": other, "correlation": value}
        for one, line in record.items()
        for other, value in line.items()
    ]
    caption = "Correlations of the parameters (of their logarithms where they are moduli)."
    return heat_map(rows, "with", "parameter", "correlation", name=name, caption=caption, label="correlation")


def sensitivities(rows: Sequence[Row], name: str = "sensitivity") -> Figure:
    """Which observation sees which parameter, from `Sensitivity.table()`."""
    told = [{**row, "observation": f"{row['measurement']} {row['observation']}"} for row in rows]
    return heat_map(
        told, "parameter", "observation", "per_log_sigma", name=name, label="sigmas per factor e",
        caption="Change of each prediction, in standard deviations, when a parameter grows by a factor e.",
    )  # fmt: skip


def profile_likelihood(rows: Sequence[Row], name: str = "profile_likelihood") -> Figure:
    """Signed root of the rise of chi-square over each parameter, a panel for each; straight where the problem is regular."""
    panels = groups(rows, "parameter")

    def paint(canvas: Canvas) -> None:
        across = min(len(panels), 3)
        grid = canvas.subplots(-(-len(panels) // across), across, squeeze=False)
        for axes, (label, members) in zip(grid.flat, panels.items(), strict=False):
            members = _ordered(members, "value")
            value, root, t = numbers(members, "value"), numbers(members, "root"), float(members[0]["t"])
            axes.plot(value, root, "o-", color=COLOURS[0])
            for end in (-t, t):
                axes.axhline(end, color=PAPER, linestyle="--")
            if (value > 0).all() and value.max() > 3 * value.min():
                axes.set_xscale("log")
            axes.set_title(label, fontsize=9)
        for axes in list(grid.flat)[len(panels) :]:
            axes.set_visible(False)
        canvas.supylabel("signed root of the rise of chi-square", fontsize=9)

    text = "Profile likelihood: dashed, where the 95 % interval ends; a curve that flattens before it says that the data do not object."
    return draw(name, text, rows, paint, (6.8, 2.3 * -(-len(panels) // 3) + 0.4))


def basins(rows: Sequence[Row], across: str, up: str, name: str = "basins") -> Figure:
    """Which start ends in which optimum, over two of the parameters; crosses found none."""

    def paint(canvas: Canvas) -> None:
        axes = canvas.subplots()
        for basin, members in sorted(groups(rows, "basin").items()):
            colour, marker = (PAPER, "x") if basin == 0 else (COLOURS[(basin - 1) % len(COLOURS)], MARKERS[(basin - 1) % len(MARKERS)])
            label = "no optimum" if basin == 0 else f"chi-square {members[0]['chi2']:.4g}"
            began = numbers(members, f"from {across}"), numbers(members, f"from {up}")
            axes.plot(*began, marker, color=colour, linestyle="none", label=label)
            if basin:
                axes.plot(numbers(members, f"to {across}")[:1], numbers(members, f"to {up}")[:1], "*", color=colour, markersize=12)
        axes.set(xlabel=across, ylabel=up, xscale="log", yscale="log")
        axes.legend()

    return draw(name, "Where fits began, coloured by where they ended; stars are the optima.", rows, paint, (5.2, 4.0))


def fit_path(rows: Sequence[Row], name: str = "fit_path") -> Figure:
    """Chi-square and gradient over the steps of a fit."""

    def paint(canvas: Canvas) -> None:
        left, right = canvas.subplots(1, 2)
        step = numbers(rows, "step")
        for axes, column, label in ((left, "chi2", "chi-square"), (right, "gradient", "relative gradient")):
            values = numbers(rows, column)
            axes.semilogy(step, np.where(values > 0, values, np.nan), "o-", color=COLOURS[0])
            axes.set(xlabel="step", ylabel=label)

    return draw(name, "The way of the fit to its optimum.", rows, paint, (7.2, 2.8))
