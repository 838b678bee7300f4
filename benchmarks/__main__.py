"""Run every benchmark in a process of its own: `python -m benchmarks [NAME ...] [--quick] [--out FOLDER]`.

`FOLDER/NAME.json` holds each one's figures. The exit code is 1 when a benchmark broke off, 0 otherwise: a
missed goal is a figure, not a failure.
"""

from __future__ import annotations

import argparse
import pkgutil
import subprocess
import sys
import time
from pathlib import Path


def names() -> list[str]:
    """The benchmarks there are, in alphabetical order."""
    here = str(Path(__file__).parent)
    return sorted(module.name for module in pkgutil.iter_modules([here]) if not module.name.startswith("_"))


def _listed(names: list[str]) -> str:
    return ", ".join(names) or "none yet"


def run_one(name: str, out: Path, quick: bool) -> bool:
    """Run one benchmark and say whether it came to its end."""
    command = [sys.executable, "-m", f"benchmarks.{name}", "--json", str(out / f"{name}.json")]
    print(f"\n== {name}", flush=True)
    began = time.perf_counter()
    finished = subprocess.run([*command, "--quick"] if quick else command).returncode == 0
    seconds = time.perf_counter() - began
    print(f"({name} {'took' if finished else 'broke off after'} {seconds:.0f} s)", flush=True)
    return finished


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmarks named on the command line, or all; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"any of: {_listed(names())}")
    parser.add_argument("--quick", action="store_true", help="smaller meshes and fewer repeats")
    parser.add_argument("--out", type=Path, default=Path("build/benchmarks"), metavar="FOLDER")
    options = parser.parse_args(arguments)
    if unknown := sorted(set(options.names) - set(names())):
        parser.error(f"no benchmark is called {_listed(unknown)}; there are: {_listed(names())}")
    broken = [name for name in options.names or names() if not run_one(name, options.out, options.quick)]
    if broken:
        print(f"broke off: {_listed(broken)}", file=sys.stderr)
    return int(bool(broken))


if __name__ == "__main__":
    sys.exit(main())
