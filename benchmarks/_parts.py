"""Long benchmarks, part by part: what a part found is kept, so that another run takes up the others, and the page tells them all."""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import fields
from pathlib import Path
from typing import Any

from benchmarks._record import Figure, machine, record, shown, table, use_float64, write

ROOT = Path(__file__).resolve().parents[1]
Part = Callable[[bool], Iterable[Figure]]
Page = tuple[Path, Callable[[Sequence[Figure]], str]]


def program() -> str:
    """What tells this program from another: what is kept of one is not the other's. What is only said beside the code does not count."""
    hashed = hashlib.sha256()
    for file in sorted((ROOT / "fingerjax").rglob("*.py")):
        hashed.update(deeds(file.read_text(encoding="utf-8")).encode())
    return hashed.hexdigest()


def deeds(source: str) -> str:
    """What a file of Python does: without its comments and docstrings, and however its lines are broken."""
    return ast.dump(_WithoutWords().visit(ast.parse(source)))


class _WithoutWords(ast.NodeTransformer):
    def visit_Expr(self, node: ast.Expr) -> ast.AST | None:
        word = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if word else self.generic_visit(node)


def run_parts(
    parts: Mapping[str, Part], about: str | None, page: Page, arguments: Sequence[str] | None = None, *, partial: bool = False
) -> None:
    """Run a benchmark whose figures come in named parts, or some of them.

    `--part NAME`, as often as wanted, leaves the others as the `--json` file has them. The file is renewed after every part, so that one
    that breaks off loses nothing but itself. `--workers N` runs N parts at a time, each as a process of its own on its share of the
    processor's threads. `--write` writes the page when there are figures of every part, or, with `partial`, of any.
    """
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--quick", action="store_true", help="smaller meshes and fewer repeats")
    parser.add_argument("--part", action="append", choices=list(parts), help="only this one; may be given several times")
    parser.add_argument("--json", type=Path, metavar="FILE", help="figures are kept there, part by part")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="parts that run at the same time, as processes")
    parser.add_argument("--write", action="store_true", help=f"renew {page[0].parent.name}/{page[0].name} as well")
    options = parser.parse_args(arguments)
    use_float64()
    wanted = options.part or list(parts)
    kept = _kept(options.json, options.quick) if options.part else {}
    for name, entries in _run({name: parts[name] for name in parts if name in wanted}, options.quick, options.workers):
        kept[name] = entries
        if options.json is not None:
            write(options.json, [entry for each in parts if each in kept for entry in kept[each]])
    told = [read(entry) for each in parts if each in kept for entry in kept[each]]
    print(table(told))
    absent, complete = [name for name in parts if name not in kept], partial or len(kept) == len(parts)
    if absent:
        print(f"no figures of {', '.join(absent)}" + ("; the page is not written" if options.write and not complete else ""))
    if options.write and complete:
        page[0].write_text(page[1](told), encoding="utf-8")


def _run(parts: Mapping[str, Part], quick: bool, workers: int) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Part by part what it found, in the order in which they end."""
    if workers < 2 or len(parts) < 2:
        for name, part in parts.items():
            began = time.perf_counter()
            figures = [shown(figure) for figure in part(quick)]
            yield name, [entry | {"part": name} for entry in record(figures, quick=quick)]
            print(f"({name} took {time.perf_counter() - began:.0f} s)", flush=True)
        return
    threads = str(max(machine()["cores"] // workers, 1))
    environment = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), threads)
    with tempfile.TemporaryDirectory() as place, ThreadPoolExecutor(workers) as pool:

        def alone(name: str) -> tuple[str, list[dict[str, Any]]]:
            file = Path(place) / f"{name}.json"
            command = [*_this(), "--part", name, "--json", str(file), *(["--quick"] if quick else [])]
            subprocess.run(command, env=environment, check=False)
            return name, json.loads(file.read_text()) if file.is_file() else []

        broken = []
        for ended in as_completed([pool.submit(alone, name) for name in parts]):
            name, entries = ended.result()
            if entries:
                yield name, entries
            else:
                broken.append(name)
        if broken:
            raise SystemExit(f"{', '.join(broken)} broke off; what the others found is kept")


def _this() -> list[str]:
    """The command that started this program."""
    spec = sys.modules["__main__"].__spec__
    return [sys.executable, "-m", spec.name] if spec is not None else [sys.executable, sys.argv[0]]


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
