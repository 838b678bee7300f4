"""Long benchmarks, part by part: what a part found is kept, so that another run takes up the others, and the page tells them all."""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from benchmarks._record import Figure, record, shown, table, use_float64, write

Part = Callable[[bool], Iterable[Figure]]
Page = tuple[Path, Callable[[Sequence[Figure]], str]]


def run_parts(
    parts: Mapping[str, Part], about: str | None, page: Page, arguments: Sequence[str] | None = None, *, partial: bool = False
) -> None:
    """Run a benchmark whose figures come in named parts, or some of them.

    `--part NAME`, as often as wanted, leaves the others as the `--json` file has them. The file is renewed after every part, so that one
    that breaks off loses nothing but itself. `--write` writes the page when there are figures of every part, or, with `partial`, of any.
    """
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--quick", action="store_true", help="smaller meshes and fewer repeats")
    parser.add_argument("--part", action="append", choices=list(parts), help="only this one; may be given several times")
    parser.add_argument("--json", type=Path, metavar="FILE", help="figures are kept there, part by part")
    parser.add_argument("--write", action="store_true", help=f"renew {page[0].parent.name}/{page[0].name} as well")
    options = parser.parse_args(arguments)
    use_float64()
    wanted = options.part or list(parts)
    kept = _kept(options.json, options.quick) if options.part else {}
    for name in (name for name in parts if name in wanted):
        began = time.perf_counter()
        figures = [shown(figure) for figure in parts[name](options.quick)]
        kept[name] = [entry | {"part": name} for entry in record(figures, quick=options.quick)]
        print(f"({name} took {time.perf_counter() - began:.0f} s)", flush=True)
        if options.json is not None:
            write(options.json, [entry for each in parts if each in kept for entry in kept[each]])
    told = [read(entry) for each in parts if each in kept for entry in kept[each]]
    print(table(told))
    absent, complete = [name for name in parts if name not in kept], partial or len(kept) == len(parts)
    if absent:
        print(f"no figures of {', '.join(absent)}" + ("; the page is not written" if options.write and not complete else ""))
    if options.write and complete:
        page[0].write_text(page[1](told), encoding="utf-8")


def _kept(file: Path | None, quick: bool) -> dict[str, list[dict[str, Any]]]:
    """The records of a file by part; none where there is no file, or where it was made with or without `--quick` unlike this run."""
    found: dict[str, list[dict[str, Any]]] = {}
    for entry in json.loads(file.read_text()) if file is not None and file.is_file() else []:
        if "part" in entry and entry["quick"] == quick:
            found.setdefault(entry["part"], []).append(entry)
    return found


def read(entry: Mapping[str, Any]) -> Figure:
    """A figure as it was written; `null` is a value that could not be measured."""
    said = {one.name: entry[one.name] for one in fields(Figure)}
    return Figure(**{**said, "value": math.nan if said["value"] is None else said["value"]})
