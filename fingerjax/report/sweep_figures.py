"""What a receptor and the skin above it meet as a shape is moved over them: after Figs. 11 to 13 of Dandekar et al. (2003)."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure as Canvas

from fingerjax.report.figures import COLOURS, draw, groups, numbers
from fingerjax.report.records import Figure, Row

PANELS = {"area_mm2": "area, mm²", "mean_pressure_kPa": "mean pressure, kPa", "strain_energy_density_kPa": "energy density, kPa"}


def sweeps(rows: Sequence[Row], name: str = "sweep", caption: str = "") -> Figure:
    """Contact area, mean pressure and energy density at the receptor against position, a line for each indenter."""

    def paint(canvas: Canvas) -> None:
        panels = canvas.subplots(len(PANELS), 1, sharex=True)
        for axes, (column, label) in zip(panels, PANELS.items(), strict=True):
            for number, (indenter, members) in enumerate(groups(rows, "indenter").items()):
                axes.plot(numbers(members, "position_mm"), numbers(members, column), color=COLOURS[number % len(COLOURS)], label=indenter)
            axes.set_ylabel(label)
        panels[0].legend()
        panels[-1].set_xlabel("indenter's origin relative to the receptor, mm")

    return draw(name, caption, rows, paint, (6.4, 6.0))
