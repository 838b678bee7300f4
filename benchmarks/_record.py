"""The form of a benchmark: figures with units and goals, the machine and the versions beside them."""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

PACKAGES = ("fingerjax", "jax", "jaxlib", "numpy", "scipy", "equinox", "optimistix", "lineax", "pyamg")


@dataclass(frozen=True)
class Figure:
    """One number that was measured, and what it was hoped to be.

    **Arguments:**

    - `figure`: what was measured, in words.
    - `value`, `unit`: the number; `"1"` is the unit of a ratio or a count. NaN: it could not be measured.
    - `goal`: the goal in words, `None` where there is none.
    - `met`: whether `value` meets the goal, `None` where there is none.
    - `note`: on what mesh, with what settings, compile time apart or not.

    Raises `ValueError` when exactly one of `goal` and `met` is given, or when NaN is said to meet a goal.
    """

    figure: str
    value: float
    unit: str
    goal: str | None = None
    met: bool | None = None
    note: str = ""

    def __post_init__(self) -> None:
        if (self.goal is None) != (self.met is None):
            seen = f"goal is {self.goal!r} and met is {self.met!r}"
            raise ValueError(f"{self.figure}: {seen}; give both or neither")
        if self.met and math.isnan(self.value):
            raise ValueError(f"{self.figure}: value is nan, which meets no goal; say met=False")


def at_most(figure: str, value: float, unit: str, limit: float, note: str = "") -> Figure:
    """A figure whose goal is not to exceed `limit`, in `unit`."""
    return Figure(figure, float(value), unit, f"<= {limit:g}", bool(value <= limit), note)


def at_least(figure: str, value: float, unit: str, limit: float, note: str = "") -> Figure:
    """A figure whose goal is to reach `limit`, in `unit`."""
    return Figure(figure, float(value), unit, f">= {limit:g}", bool(value >= limit), note)


def between(figure: str, value: float, unit: str, low: float, high: float, note: str = "") -> Figure:
    """A figure whose goal is to lie from `low` to `high`, in `unit`."""
    return Figure(figure, float(value), unit, f"{low:g} to {high:g}", bool(low <= value <= high), note)


def machine() -> dict[str, Any]:
    """The processor, the cores this process may use, and the memory in GiB (NaN: not known)."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "cpu": _processor(),
        "cores": allowed,
        "memory_GiB": round(_memory() / 2**30, 1),
        "system": f"{platform.system()} {platform.machine()}",
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()


def _memory() -> float:
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, OSError, ValueError):
        return math.nan


def versions() -> dict[str, str | None]:
    """The versions of Python and of the packages that a figure depends on; `None`: not installed."""
    return {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}}


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def record(figures: Iterable[Figure], *, quick: bool = False) -> list[dict[str, Any]]:
    """The figures as they are written to JSON: each with the machine and the versions beside it.

    JSON has no NaN: a value that could not be measured is `null` there.
    """
    beside = {"quick": quick, "machine": _finite(machine()), "versions": versions()}
    return [_finite(asdict(figure)) | beside for figure in figures]


def _finite(entry: dict[str, Any]) -> dict[str, Any]:
    lost = [key for key, value in entry.items() if isinstance(value, float) and not math.isfinite(value)]
    return entry | dict.fromkeys(lost)


def table(figures: Sequence[Figure]) -> str:
    """The figures in columns, a goal that was missed marked as such, and the number of goals met below."""
    columns = zip(*map(_row, figures), strict=True)
    padded = [[cell.ljust(max(map(len, column))) for cell in column] for column in columns]
    lines = ["  ".join(row).rstrip() for row in zip(*padded, strict=True)]
    goals = [figure.met for figure in figures if figure.met is not None]
    return "\n".join([*lines, f"{sum(goals)} of {len(goals)} goals met"])


def _row(figure: Figure) -> tuple[str, ...]:
    verdict = "" if figure.met is None else ("met" if figure.met else "NOT MET")
    unit = "" if figure.unit == "1" else figure.unit
    goal = "" if figure.goal is None else f"goal {figure.goal}"
    return figure.figure, f"{figure.value:.4g}", unit, goal, verdict, figure.note


def listed(title: str, text: str) -> Callable[[Sequence[Figure]], str]:
    """A page that tells every figure, its goal and whether that was met, on the machine that it was measured on."""

    def page(figures: Sequence[Figure]) -> str:
        here = machine()
        cores = f"{here['cores']} cores, {here['memory_GiB']:g} GiB, {here['cpu']}"
        return "\n".join([f"# {title}", "", f"{text} {cores}.", "", listed_table(figures), ""])

    return page


def listed_table(figures: Sequence[Figure]) -> str:
    """The figures as a table in Markdown."""
    rows = [["figure", "value", "goal", "", "note"], ["---", "---:", "---", "---", "---"]]
    for name, value, unit, goal, met, note in map(_row, figures):
        rows.append([name, f"{value} {unit}".strip(), goal.removeprefix("goal "), met, note])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def run(
    main: Callable[[bool], Iterable[Figure]],
    arguments: Sequence[str] | None = None,
    page: tuple[Path, Callable[[Sequence[Figure]], str]] | None = None,
) -> None:
    """Run one benchmark from the command line: print its table, and write its JSON where `--json` says.

    A benchmark that has a `page`, where it lies and how it is told from the figures, writes it when `--write` is given.

    `main` is called with whether `--quick` was given, in float64, and yields its figures. A missed goal is
    printed and recorded, not raised: what a benchmark has to say, it says in its figures.
    """
    parser = argparse.ArgumentParser(description=sys.modules[main.__module__].__doc__)
    parser.add_argument("--quick", action="store_true", help="smaller meshes and fewer repeats")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there as well")
    if page is not None:
        parser.add_argument("--write", action="store_true", help=f"renew {page[0].parent.name}/{page[0].name} as well")
    options = parser.parse_args(arguments)
    use_float64()
    figures = [shown(figure) for figure in main(options.quick)]
    print(table(figures))
    if options.json is not None:
        write(options.json, record(figures, quick=options.quick))
    if page is not None and options.write:
        page[0].write_text(page[1](figures), encoding="utf-8")


def shown(figure: Figure) -> Figure:
    """The figure, told on stderr as it comes: a benchmark can take many minutes."""
    print("  ".join(_row(figure)), file=sys.stderr, flush=True)
    return figure


def use_float64() -> None:
    """What every benchmark computes in."""
    import jax

    jax.config.update("jax_enable_x64", True)


def write(file: Path, records: list[dict[str, Any]]) -> None:
    """Write records to `file` as JSON, whole or not at all."""
    file.parent.mkdir(parents=True, exist_ok=True)
    unfinished = file.with_name(file.name + ".part")
    unfinished.write_text(json.dumps(records, indent=1, allow_nan=False) + "\n")
    unfinished.replace(file)
