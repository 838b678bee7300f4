"""The figures of a diagnosis that compare: errors, effects, parameters, next experiments. `loop_residuals` draws over the finger.

| figure | rows |
|---|---|
| `errors` | measurement, used, rows, before_share_of_data, after_share_of_data, before_over_noise, after_over_noise |
| `effects` | effect, acts_on, score, critical, testable, in_the_set, size, smallest_visible, plausible_size, unit, possible, remark |
| `parameters` | parameter, unit, before, before_lower, before_upper, after, after_lower, after_upper, ... |
| `next_experiments` | condition, repeats, apart_now, apart_after, tells_apart |
| `conditions` | measurement, condition, used, rows, ..., share_of_misfit_before, share_of_misfit_after |
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

from fingerjax.report.figures import COLOURS, PAPER, draw, numbers
from fingerjax.report.loop_record import Record, candidates, condition_rows, critical, error_rows, explanations, maybe, wrong_way
from fingerjax.report.loop_tables import next_experiments as next_table
from fingerjax.report.loop_tables import parameter_rows, remark, size_of, unit_of
from fingerjax.report.loop_words import ACTS_ON, short, spoken
from fingerjax.report.records import Figure, Row

BEFORE, AFTER = PAPER, COLOURS[0]
ACTING = dict(zip(ACTS_ON, ("#0072B2", "#D55E00", "#8C6D31", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"), strict=True))
CREDIBLE = 3.0  # plausible sizes beyond which no effect is believed
SEPARATED = 13.0  # squared distance from which two explanations are told apart in 95 % of repeats
LINE = 0.27  # inches for one line of a list


def plainly(text: object, width: int = 0) -> str:
    """Text that matplotlib draws as it stands, wrapped where `width` letters are given."""
    said = str(text).replace("$", r"\$")
    return "\n".join(textwrap.wrap(said, width)) if width and len(said) > width else said


def _lines(axes: Axes, labels: Sequence[str], *, bold: Sequence[bool] = ()) -> np.ndarray:
    """One line for each label from the top down; returns their heights."""
    place = np.arange(len(labels), dtype=float)
    axes.set_yticks(place, [plainly(label) for label in labels])
    axes.set_ylim(len(labels) - 0.4, -0.6)
    axes.grid(axis="y", visible=False)
    axes.tick_params(axis="y", length=0)
    for tick, strong in zip(axes.get_yticklabels(), bold, strict=False):
        tick.set_fontweight("bold" if strong else "normal")
    return place


def plain_ticks(axes: Axes, places: Sequence[float]) -> None:
    """Ticks along x at such of the places as lie within the axis, written as 0.1, 1, 10."""
    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(FixedLocator([place for place in places if low <= place <= high]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


DECADES = [10.0**power for power in range(-6, 7)]
SPREAD = [0, 1, 3, 10, 30, 100, 300, 1000]


# ---- errors ----


def errors(record: Record, name: str = "loop_errors") -> Figure:
    """Errors before and after, a pair of bars for each measurement and role."""
    rows = error_rows(record)
    labels = [f"{row['measurement']}\n{row['used']}" for row in rows]

    def paint(canvas: Canvas) -> None:
        left, right = canvas.subplots(1, 2, sharey=True)
        for axes, ending, factor in ((left, "share_of_data", 100.0), (right, "over_noise", 1.0)):
            place = _lines(axes, labels)
            for shift, when, colour in ((-0.19, "before", BEFORE), (0.19, "after", AFTER)):
                values = factor * numbers(rows, f"{when}_{ending}")
                axes.barh(place + shift, np.nan_to_num(values), 0.34, color=colour, label=when)
                _write(axes, place + shift, values)
            axes.set_xlim(0, 1.18 * axes.get_xlim()[1])
        left.set_xlabel("error, % of the data's root mean square")
        right.set_xlabel("error, in units of noise")
        right.axvline(1.0, color="black", linewidth=0.9, linestyle="--")
        canvas.legend(
            handles=[
                Patch(color=BEFORE, label="before"),
                Patch(color=AFTER, label="after"),
                Line2D([], [], color="black", linewidth=0.9, linestyle="--", label="noise alone"),
            ],
            loc="outside upper right",
            ncols=3,
        )

    caption = "Error before and after, on conditions that were fitted and on those held out."
    return draw(name, caption, rows, paint, (7.2, 1.1 + 0.55 * len(rows)))


def _write(axes: Axes, place: np.ndarray, values: np.ndarray) -> None:
    for height, value in zip(place, values, strict=True):
        if math.isfinite(value):
            box = {"facecolor": "white", "edgecolor": "none", "pad": 0.6}
            axes.annotate(short(value), (value, height), (4, 0), textcoords="offset points", va="center", fontsize=7.5, bbox=box)


# ---- effects ----


def effect_rows(record: Record) -> list[Row]:
    """What the picture of the effects is drawn from, in its order."""
    line, names = critical(record), explanations(record)
    rows = []
    for one in candidates(record):
        size, plausible = size_of(one)
        testable = one.get("testable") is not False
        rows.append(
            {
                "effect": spoken(one["family"]),
                "acts_on": str(one.get("acts_on") or ""),
                "score": maybe(one.get("z")),
                "critical": maybe(line),
                "testable": testable,
                "in_the_set": str(one["family"]) in names,
                "size": maybe(size),
                "smallest_visible": maybe(one.get("mde")),
                "plausible_size": maybe(plausible),
                "unit": unit_of(one),
                "possible": not wrong_way(one),
                "remark": remark(one),
            }
        )
    return rows


def effects(record: Record, name: str = "loop_effects") -> Figure:
    """The ranking: scores against the critical value, and beside each how small an effect the data could have shown."""
    rows = effect_rows(record)

    def paint(canvas: Canvas) -> None:
        left, right = canvas.subplots(1, 2, sharey=True, width_ratios=[1.15, 1.0])
        place = _lines(left, [row["effect"] for row in rows], bold=[row["in_the_set"] for row in rows])
        right.grid(axis="y", visible=False)
        _scores(left, rows, place)
        _sizes(right, rows, place)
        _legend(canvas, rows)

    caption = (
        "Effects by how well their traces match what is left (left half), and how small an effect could have been seen (right half). "
        "Bold: still possible explanations. Pale: the trace fits only the wrong way round. Colours: what an effect acts on."
    )
    return draw(name, caption, rows, paint, (7.6, 1.5 + LINE * len(rows)))


def _scores(axes: Axes, rows: Sequence[Row], place: np.ndarray) -> None:
    scores = np.abs(numbers(rows, "score"))
    line = numbers(rows, "critical")[:1]
    furthest = float(np.nanmax(np.append(scores, line), initial=1.0))
    for row, height, score in zip(rows, place, scores, strict=True):
        if row["testable"] and math.isfinite(score):
            axes.barh(height, score, 0.66, color=ACTING.get(row["acts_on"], PAPER), alpha=1.0 if row["possible"] else 0.25)
            if not row["possible"]:
                axes.annotate(
                    "the wrong way round", (0.0, height), (4, 0), textcoords="offset points", va="center", fontsize=7.5, style="italic"
                )
        else:
            style: dict[str, Any] = {"fontsize": 7.5, "color": "#666666", "style": "italic"}
            box = {"facecolor": "white", "edgecolor": "none", "pad": 0.6}
            axes.annotate(
                plainly(_briefly(row["remark"])), (0.0, height), (4, 0), textcoords="offset points", va="center", bbox=box, **style
            )
    axes.set_xlim(0, 1.05 * furthest)
    if line.size and math.isfinite(line[0]):
        axes.axvline(line[0], color="black", linestyle="--", linewidth=0.9)
        if furthest > 5 * line[0]:  # a strong effect must not press the line into the axis
            axes.set_xscale("function", functions=(lambda x: np.sqrt(np.maximum(x, 0.0)), np.square))
            axes.set_xlim(0, 1.05 * furthest)
            plain_ticks(axes, SPREAD)
    axes.set_xlabel("score |z|")


def _briefly(remark: str) -> str:
    if not remark:
        return "not tested"
    return "absorbed by the parameters" if "absorbed" in remark else textwrap.shorten(remark, 44, placeholder=" ...")


def _sizes(axes: Axes, rows: Sequence[Row], place: np.ndarray) -> None:
    plausible = numbers(rows, "plausible_size")
    scale = np.where(plausible > 0, plausible, math.nan)
    seen, size = numbers(rows, "smallest_visible") / scale, np.abs(numbers(rows, "size")) / scale
    testable = np.array([row["testable"] for row in rows], bool)
    found = np.abs(numbers(rows, "score")) > np.nan_to_num(numbers(rows, "critical"), nan=np.inf)
    found &= np.array([row["possible"] for row in rows], bool)
    for mask, colour in ((found & testable, "black"), (~found & testable, "white")):
        axes.plot(size[mask], place[mask], "D", color="black", markerfacecolor=colour, markersize=4.2, linestyle="none", zorder=3)
    axes.plot(seen[testable], place[testable], "|", color="black", markersize=11, markeredgewidth=1.8, linestyle="none", zorder=2)
    shown = np.concatenate([seen[testable], size[testable]])
    shown = shown[np.isfinite(shown) & (shown > 0)]
    low, high = (min(0.2, shown.min()), max(8.0, shown.max())) if shown.size else (0.1, 10.0)
    axes.set_xscale("log")
    axes.set_xlim(max(0.6 * low, 1e-3), 1.6 * high)
    plain_ticks(axes, DECADES)
    axes.axvspan(CREDIBLE, 1e6, color="#F1EFEA", zorder=0)
    axes.axvline(1.0, color="#999999", linewidth=0.8)
    axes.set_xlabel("size, in plausible sizes")
    edge = axes.twinx()
    edge.set_ylim(axes.get_ylim())
    edge.set_yticks(place, [_amount(row) for row in rows], fontsize=7.5, color="#444444")
    edge.tick_params(axis="y", length=0)
    edge.grid(visible=False)
    edge.set_ylabel("smallest visible size", fontsize=7.5, color="#444444", rotation=270, labelpad=10)


def _amount(row: Row) -> str:
    value = row["smallest_visible"]
    return plainly(f"{short(value)} {row['unit']}".strip()) if row["testable"] and value is not None else "-"


def _legend(canvas: Canvas, rows: Sequence[Row]) -> None:
    there = {row["acts_on"] for row in rows}
    handles: list[Any] = [Patch(color=colour, label=ACTS_ON[key]) for key, colour in ACTING.items() if key in there]
    if there - set(ACTING):
        handles.append(Patch(color=PAPER, label="not said"))
    handles += [
        Line2D([], [], color="black", linestyle="--", linewidth=0.9, label="critical value"),
        Line2D([], [], marker="|", color="black", markersize=9, markeredgewidth=1.8, linestyle="none", label="smallest visible"),
        Line2D([], [], marker="D", color="black", markersize=4.2, linestyle="none", label="as large as it seems (filled: beyond chance)"),
        Patch(color="#F1EFEA", label="too large to be believed"),
    ]
    canvas.legend(handles=handles, loc="outside lower center", ncols=4, columnspacing=1.2, handlelength=1.4)


# ---- parameters ----


def parameters(record: Record, name: str = "loop_parameters") -> Figure | None:
    """Values after over values before, with both intervals; None where no positive value can be compared."""
    rows = parameter_rows(record)
    drawn = [row for row in rows if (row["before"] or 0.0) > 0]
    if not drawn:
        return None

    def paint(canvas: Canvas) -> None:
        axes = canvas.subplots()
        place = _lines(axes, [row["parameter"] for row in drawn])
        base = numbers(drawn, "before")
        for shift, when, colour, marker in ((-0.16, "before", BEFORE, "o"), (0.16, "after", AFTER, "D")):
            values = numbers(drawn, when) / base
            ends = np.stack([numbers(drawn, f"{when}_lower"), numbers(drawn, f"{when}_upper")]) / base
            reach = np.where(np.isfinite(ends) & np.isfinite(values), np.abs(ends - values), 0.0)
            reach[0] = np.minimum(reach[0], 0.999 * np.where(values > 0, values, np.inf))
            axes.errorbar(values, place + shift, xerr=reach, fmt=marker, color=colour, capsize=2.5, label=when, markersize=5)
        axes.axvline(1.0, color="#999999", linewidth=0.8)
        axes.set_xlabel("value over the value before, with 95 % intervals")
        edge = axes.twinx()
        edge.set_ylim(axes.get_ylim())
        edge.set_yticks(place, [_change(row) for row in drawn], fontsize=7.5, color="#444444")
        edge.tick_params(axis="y", length=0)
        edge.grid(visible=False)
        canvas.legend(*axes.get_legend_handles_labels(), loc="outside upper right", ncols=2)

    return draw(name, "Parameters before and after, each over its value before.", rows, paint, (7.2, 1.1 + 0.42 * len(drawn)))


def _change(row: Row) -> str:
    unit = f" {row['unit']}" if row["unit"] not in ("", "1") else ""
    later = f" → {short(row['after'])}" if row["after"] is not None else ""
    return plainly(f"{short(row['before'])}{later}{unit}")


# ---- what next, and where ----


def next_experiments(record: Record, name: str = "loop_next") -> Figure | None:
    """How far each possible experiment would push the explanations apart; None where none is proposed."""
    rows = next_table(record).rows
    if not rows:
        return None

    def paint(canvas: Canvas) -> None:
        axes = canvas.subplots()
        counts = [f"{row['repeats']} repeats" if row["repeats"] else "" for row in rows]
        names = ["\n".join(textwrap.wrap(str(row["condition"]), 44)) for row in rows]
        place = _lines(axes, ["\n".join(filter(None, pair)) for pair in zip(names, counts, strict=True)])
        now, later = numbers(rows, "apart_now"), numbers(rows, "apart_after")
        axes.hlines(place, np.maximum(now, 1e-2), np.maximum(later, 1e-2), color=AFTER, linewidth=2)
        axes.plot(np.maximum(now, 1e-2), place, "o", color=BEFORE, markersize=6, linestyle="none", label="now")
        axes.plot(np.maximum(later, 1e-2), place, "o", color=AFTER, markersize=6, linestyle="none", label="with it")
        axes.axvline(SEPARATED, color="black", linestyle="--", linewidth=0.9, label="told apart in 95 % of repeats")
        axes.set_xscale("log")
        axes.set_xlim(0.7 * min(1.0, axes.get_xlim()[0]), 1.4 * max(20.0, axes.get_xlim()[1]))
        plain_ticks(axes, DECADES)
        axes.set_xlabel("distance of the explanations, squared, in units of noise")
        canvas.legend(*axes.get_legend_handles_labels(), loc="outside upper right", ncols=3)

    return draw(name, "What to measure next: how far it would push the explanations apart.", rows, paint, (7.2, 1.2 + 0.42 * len(rows)))


def conditions(record: Record, name: str = "loop_conditions") -> Figure:
    """Errors before and after in units of noise, condition by condition."""
    rows = condition_rows(record)

    def paint(canvas: Canvas) -> None:
        axes = canvas.subplots()
        place = _lines(axes, [_place(row) for row in rows])
        before, after = numbers(rows, "before_over_noise"), numbers(rows, "after_over_noise")
        axes.hlines(place, before, after, color="#CCCCCC", linewidth=2, zorder=1)
        axes.plot(before, place, "o", color=BEFORE, markersize=5, linestyle="none", label="before")
        axes.plot(after, place, "o", color=AFTER, markersize=5, linestyle="none", label="after")
        axes.axvline(1.0, color="black", linestyle="--", linewidth=0.9, label="noise alone")
        axes.set_xlim(left=0)
        axes.set_xlabel("error, in units of noise")
        canvas.legend(*axes.get_legend_handles_labels(), loc="outside upper right", ncols=3)

    caption = "Error by condition; what was not fitted is told beside its name."
    return draw(name, caption, rows, paint, (7.2, 1.1 + LINE * len(rows)))


def _place(row: Row) -> str:
    name = row["condition"] if str(row["condition"]).startswith(str(row["measurement"])) else f"{row['measurement']}: {row['condition']}"
    return textwrap.shorten(name, 48, placeholder=" ...") + ("" if row["used"] == "fitted" else " (held out)")
