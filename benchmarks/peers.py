"""One solve on one mesh by fingerjax and by its peers: each in a process of its own, agreement checked before any time is printed.

`--quick` takes the small mesh alone. A program that is not installed is left out and said to be: pypardiso (the extra `direct`),
scikit-fem, CalculiX (`ccx` on the path), torch-fem (here, or in the environment of the Python that TORCH_FEM_PYTHON names).
"""

from __future__ import annotations

import importlib.util
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks._bodies import COARSE, FINE, LARGE, Problem, problem
from benchmarks._record import Figure, at_most, listed, run

PEER = Path(__file__).with_name("_peer.py")
AGREED = 1e-5  # of the largest displacement: what separates answers that were solved to a residual of 1e-8
OWN = "fingerjax, frontal"
SECONDS = 300  # after which a program is given up


@dataclass(frozen=True)
class Answer:
    """One program's displacement, and the seconds of its first call and of the repeats."""

    u: np.ndarray
    first: float
    seconds: tuple[float, ...]
    iterations: int
    memory: float

    @property
    def best(self) -> float:
        return min(self.seconds)

    @property
    def note(self) -> str:
        steps = f", {self.iterations} iterations" if self.iterations > 1 else ""
        return f"{self.best:.2f} to {max(self.seconds):.2f} s{steps}; first call {self.first:.1f} s; {self.memory:.0f} MiB"


def main(quick: bool) -> Iterator[Figure]:
    """Seconds of each program on each problem, and fingerjax's as a multiple of each."""
    yield from compared("P2, 8.5k nodes", problem(COARSE), {})
    yield from compared("P1, 8.5k nodes", problem(COARSE, order=1), {})
    if quick:
        return
    yield from compared("P2, 29k nodes", problem(FINE), {"pardiso": 0.30})
    yield from compared("P1, 29k nodes", problem(FINE, order=1), {"pardiso": 0.15, "torch-fem": 0.15})
    yield from compared("P2, 105k nodes", problem(LARGE, refined=True), {"pardiso": 0.10}, among=("multigrid", "pardiso"))


def programs() -> dict[str, str]:
    """The programs that are here, and the Python to run each with."""
    other = os.environ.get("TORCH_FEM_PYTHON") or (sys.executable if importlib.util.find_spec("torchfem") else "")
    found = {
        "multigrid": sys.executable,
        OWN: sys.executable,
        "pardiso": sys.executable if importlib.util.find_spec("pypardiso") else "",
        "scikit-fem": sys.executable if importlib.util.find_spec("skfem") else "",
        "calculix": sys.executable if shutil.which("ccx") else "",
        "torch-fem cg+amg": other,
    }
    return {name: python for name, python in found.items() if python}


def compared(title: str, one: Problem, goals: dict[str, float], among: tuple[str, ...] = ()) -> Iterator[Figure]:
    """Every program's time on one problem; the times of programs that disagree with fingerjax are not printed."""
    with tempfile.TemporaryDirectory() as folder:
        stored = _stored(one, Path(folder) / "problem.npz")
        chosen = {name: python for name, python in programs().items() if name in among or not among}
        answers = {name: _answer(name, python, stored, Path(folder)) for name, python in chosen.items()}
    ours = answers.pop("multigrid")
    if isinstance(ours, str):
        yield Figure(f"{title}: fingerjax, multigrid", math.nan, "s", note=ours)
        return
    yield Figure(f"{title}: fingerjax, multigrid", ours.best, "s", note=ours.note)
    for name, theirs in answers.items():
        off = _apart(ours.u, theirs.u) if isinstance(theirs, Answer) else math.nan
        if isinstance(theirs, str) or off > AGREED:
            why = theirs if isinstance(theirs, str) else f"differs by {off:.1e} of the largest displacement"
            yield Figure(f"{title}: {name}", math.nan, "s", note=why)
            continue
        yield Figure(f"{title}: {name}", theirs.best, "s", note=f"{theirs.note}; agrees to {off:.1e}")
        if name == OWN:
            continue
        goal = next((limit for peer, limit in goals.items() if name.startswith(peer)), None)
        ratio, text = ours.best / theirs.best, f"{title}: fingerjax as a multiple of {name}"
        each = f"{ours.iterations} iterations of {1e3 * ours.best / ours.iterations:.0f} ms, most of it the V-cycle's products"
        yield Figure(text, ratio, "1") if goal is None else at_most(text, ratio, "1", goal, each)
    missing = sorted({"pardiso", "scikit-fem", "calculix", "torch-fem cg+amg"} - set(programs()))
    if missing:
        yield Figure(f"{title}: programs not installed", len(missing), "1", note=", ".join(missing))


def _stored(one: Problem, file: Path) -> Path:
    body = one.body
    held = np.asarray(body.free) == 0
    nodes, tets, layer = (np.asarray(each) for each in (body.nodes, body.tets, body.layer))
    np.savez(file, nodes=nodes, tets=tets, layer=layer, held=held, lame=np.asarray(one.lame), load=one.load)
    return file


def _answer(name: str, python: str, stored: Path, folder: Path) -> Answer | str:
    """The answer of one program, or in words why there is none."""
    answer = folder / "answer.npz"
    answer.unlink(missing_ok=True)
    environment = os.environ | {"PYTHONPATH": str(PEER.parent.parent), "NPROC": "16", "TF_CPP_MIN_LOG_LEVEL": "3"}
    command = [python, str(PEER), name, str(stored), str(answer)]
    print(f"{name} ...", file=sys.stderr, flush=True)
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=SECONDS)
    except subprocess.TimeoutExpired:
        return f"given up after {SECONDS} s"
    if done.returncode:
        return "failed: " + (done.stderr.strip().splitlines() or ["no message"])[-1][:160]
    with np.load(answer) as file:
        u, report = file["u"], json.loads(str(file["report"]))
    return Answer(u, report["first"], tuple(report["seconds"]), report["iterations"], report["MiB"])


def _apart(ours: np.ndarray, theirs: np.ndarray) -> float:
    return float(np.abs(ours - theirs).max() / np.abs(ours).max())


TEXT = """One push on the pad of the preset monkey, bone held, midsides straight, solved to a relative residual of 1e-8 by fingerjax and by
other programs on the same mesh; a time is told only of answers that agree. CalculiX is timed as a whole program, torch-fem with its
assembly, PARDISO without. Written by `python -m benchmarks.peers --write`. Measured on"""
PAGE = Path(__file__).resolve().parent.parent / "docs" / "peers.md"

if __name__ == "__main__":
    run(main, page=(PAGE, listed("Beside other programs", TEXT)))
