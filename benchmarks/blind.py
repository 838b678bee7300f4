"""How often the residual loop is right about laboratories it has never seen, made by another finite-element program.

`python -m benchmarks.blind [--quick] [--thin] [--seeds N] [--scenarios a,b] [--noise 0.02] [--out FOLDER] [--workers N] [--mesh]
[--json FILE] [--write]`

Writes every scenario of `tests/blind` with N draws of noise, runs `fingerjax diagnose` on each as its own process, and scores the reports
against the truths. What is finished is kept in FOLDER, so that a run that was stopped goes on. `--thin` asks for coarse meshes and takes
few rows, `--quick` eight scenarios of that kind. `--write` renews docs/blind.md, with every laboratory's verdict: what this run scored
joins what earlier ones did (docs/blind.json), each with the states of the program and of the truths' numerics that it is of.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import yaml

from benchmarks._parts import program
from benchmarks._record import Figure, listed_table, record, table, write
from benchmarks._sections import sections
from tests.blind import folders, score
from tests.blind.scenarios import SCENARIOS
from tests.blind.truths import Truths, in_order, program_hash

QUICK = (
    "none_human",
    "none_monkey",
    "nail_compliance",
    "contact_offset",
    "relaxation",
    "rate_saturation",
    "callus",
    "load_cell_gain",
)
COARSER = 1.4
PAGE = Path(__file__).resolve().parents[1] / "docs" / "blind.md"
SCORED = PAGE.with_suffix(".json")
KINDS = {"full": "Meshes and rows in full", "thin": "Coarse studies with few rows"}
"""Kind of run -> its heading on the page."""
TEXT = """Laboratories that another finite-element program made, each with an effect of another form than the catalogue's, diagnosed as a
user would, and scored against truths that the diagnosis never saw. lambda: what the effect adds to the misfit of the plain model, in units
of the variance of the noise and of what the laboratories say that any model is wrong by (1 % of deflections and forces, 10 % of rates,
and an afferent 0.05 mm beside its place); what the mesh leaves is not in it. Noise 0.02 of the largest reading, 4 trials. Written by
`python -m benchmarks.blind --write`, which adds what it scores to what stands here (docs/blind.json)."""
TIMEOUT = 3600.0
"""s after which a diagnosis is given up."""


def diagnosed(case: Path) -> dict[str, Any] | None:
    """The report on the laboratory in `case/lab`: kept where that and the program are those of before, else made; None where it broke off.
    """
    lab, out, stamp = case / "lab", case / "report", case / "diagnosed"
    same = stamp.exists() and stamp.read_text() == _contents(lab)
    report = out / "report.json"
    if not (same and report.exists()):
        command = [sys.executable, "-m", "fingerjax", "diagnose", str(lab / "experiments.yaml"), "--out", str(out)]
        with (case / "log.txt").open("w") as log:
            report.unlink(missing_ok=True)
            if not _ended(command, log) or not report.exists():
                return None
        stamp.write_text(_contents(lab))
    return json.loads(report.read_text())


def _timed(case: Path) -> tuple[dict[str, Any] | None, float]:
    began = time.perf_counter()
    report = diagnosed(case)
    return report, time.perf_counter() - began


def _ended(command: Sequence[str], log: Any) -> bool:
    try:
        return subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, timeout=TIMEOUT).returncode in (0, 1)
    except subprocess.TimeoutExpired:
        return False


def _contents(folder: Path) -> str:
    files = sorted(path for path in folder.iterdir() if path.is_file())
    return hashlib.sha256(b"".join(path.name.encode() + path.read_bytes() for path in files) + program().encode()).hexdigest()


def outcomes(
    names: Iterable[str], seeds: int, noise: float, folder: Path, *, thin: bool, workers: int = 1
) -> tuple[dict[str, score.Scored], list[str]]:
    """Every diagnosis that ended, scored, by the name of its case, and the names of those that did not; so many diagnosed at a time."""
    truths = Truths(folder / "mechanics", thin, tell=_say)
    found: dict[str, score.Scored] = {}
    broken: list[str] = []
    with ThreadPoolExecutor(workers) as pool:
        begun = []
        for name in in_order(names):
            for seed in range(1, seeds + 1):
                case = folder / f"{name}-{noise:g}-{seed}"
                folders.write(SCENARIOS[name], truths, case / "lab", _truth(case), noise=noise, seed=seed)
                begun.append((case, pool.submit(_timed, case)))
        for case, running in begun:
            report, seconds = running.result()
            if report is None:
                broken.append(case.name)
                _say(f"{case.name}: broke off, see {case / 'log.txt'}")
                continue
            one = score.judge(report, yaml.safe_load(_truth(case).read_text()))
            found[case.name] = score.Scored(one, program()[:8], report["loop"]["runtime_s"] / 60, program_hash()[:8])
            _say(_described(one, seconds))
    return found, broken


def _truth(case: Path) -> Path:
    return case.parent / "truths" / f"{case.name}.yaml"


def _described(one: score.Outcome, seconds: float) -> str:
    named = f": {', '.join(one.named)}" if one.named else ""
    return f"{one.case} (lambda {one.excess:.3g}): {one.verdict}{named} ({seconds:.0f} s)"


def figures(found: Sequence[score.Outcome], broken: Sequence[str]) -> list[Figure]:
    """The table of scores; lines of which there is no case are left out."""
    total = len(found) + len(broken)
    failed = Figure("diagnoses that broke off", len(broken), "1", "<= 0", not broken, f"of {total}")
    return [failed, *(_figure(line) for line in score.table(found) if line.count)]


def mesh_figures(folder: Path, *, thin: bool) -> Iterator[Figure]:
    """What is left of mesh error in the noise-free readings: their change on bricks that are 1.4 times as long, on bricks that are as wide
    as the tips of wedges under them, and on bricks that are no shorter there than elsewhere."""
    truths = Truths(folder / "mechanics", thin, tell=_say)
    cuts: dict[str, Callable[[Any], Any]] = {
        "coarser bricks": lambda cut: cut.scaled(COARSER),
        "bricks as wide under wedges as their tip": lambda cut: cut.undivided(),
        "bricks as long under wedges as elsewhere": lambda cut: cut.blunted(),
    }
    for finger in ("human", "monkey"):
        for words, cut in cuts.items():
            for name, (most, mean) in truths.recut(finger, cut, words).items():
                yield Figure(f"{finger}, {name}: change of the truth on {words}", 100 * mean, "%", note=f"largest {100 * most:.2g} %")


def _figure(line: score.Line) -> Figure:
    note = f"{line.count} cases" if line.low != line.low else f"{line.count} cases, 95 % interval {line.low:.3f} to {line.high:.3f}"
    if line.goal is None:
        return Figure(line.name, line.value, "1", note=note)
    low, high = line.goal
    words = f"<= {high:g}" if low == 0.0 else f">= {low:g}" if high == 1.0 else f"{low:g} to {high:g}"
    return Figure(line.name, line.value, "1", words, low <= line.value <= high, note)


def remembered(file: Path) -> dict[str, dict[str, score.Scored]]:
    """What earlier runs scored: kind of run -> name of the case -> outcome, and what it is of."""
    if not file.is_file():
        return {kind: {} for kind in KINDS}
    kept = json.loads(file.read_text(encoding="utf-8"))
    return {kind: {name: score.Scored.read(one) for name, one in kept.get(kind, {}).items()} for kind in KINDS}


def remember(file: Path, kept: Mapping[str, Mapping[str, score.Scored]]) -> None:
    """Write it down."""
    said = {kind: {name: one.plain() for name, one in sorted(cases.items())} for kind, cases in kept.items()}
    file.write_text(json.dumps(said, indent=1) + "\n", encoding="utf-8")


def page(kept: Mapping[str, Mapping[str, score.Scored]], before: str = "") -> str:
    """For each kind of run the table of scores, and what was said of every laboratory; sections of another heading stay as they were."""
    old = sections(before)
    made = {KINDS[kind]: _section(kind, list(cases.values())) for kind, cases in kept.items() if cases}
    named = [*made, *(name for name in old if name not in made)]
    return "\n\n".join(["# Blind laboratories: how often a diagnosis is right", TEXT, *({**old, **made}[name] for name in named)]) + "\n"


def _section(kind: str, scored: Sequence[score.Scored]) -> str:
    states, truths = sorted({one.state for one in scored}), sorted({one.truth for one in scored})
    count, drawn = len({one.outcome.case for one in scored}), len(scored)
    about = (
        f"{drawn} {'draws' if drawn > 1 else 'draw'} of {count} of the {len(SCENARIOS)} laboratories, by {len(states)} "
        f"{'states' if len(states) > 1 else 'state'} of the program: {', '.join(states)}; {len(truths)} "
        f"{'states' if len(truths) > 1 else 'state'} of the truths' numerics: {', '.join(truths)}."
    )
    head = ["laboratory", "behind it", "lambda", "plain model", "verdict", "named", "among the explanations", "held-out error"]
    head += ["min", "program", "truth"]
    ordered = sorted(scored, key=lambda one: (one.outcome.kind, one.outcome.case))
    rows = [head, ["---"] * len(head), *(_cells(one) for one in ordered)]
    lines = [f"| {' | '.join(row)} |" for row in rows]
    measured = figures([one.outcome for one in scored], [])
    return "\n".join([f"## {KINDS[kind]}", "", about, "", listed_table(measured), "", "### Every laboratory", "", *lines])


def _cells(scored: score.Scored) -> list[str]:
    one = scored.outcome
    held = "" if one.held_out is None else " -> ".join(f"{100 * value:.2g} %" for value in one.held_out)
    behind = f"{one.kind}: {', '.join(one.families)}" if one.families else one.kind
    there = "" if not one.families or not one.named else "yes" if one.found else "in part" if not one.wrong else "no"
    rejected = "rejected" if one.rejected else "not rejected"
    found = [rejected, one.verdict, ", ".join(one.named), there, held]
    return [one.case, behind, f"{one.excess:.3g}", *found, f"{scored.minutes:.1f}", scored.state, scored.truth]


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.blind", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="eight scenarios, coarse mesh, few rows")
    parser.add_argument("--thin", action="store_true", help="coarse mesh and few rows")
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help="draws of noise of each scenario")
    parser.add_argument("--scenarios", default="", metavar="a,b", help=f"of: {', '.join(SCENARIOS)}")
    parser.add_argument("--noise", type=float, default=0.02, help="share of the largest reading")
    parser.add_argument("--out", type=Path, default=Path("build/blind"), metavar="FOLDER", help="laboratories, truths and reports")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="laboratories that are diagnosed at a time")
    parser.add_argument("--mesh", action="store_true", help="only ask how much the truths change on coarser bricks")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there as well")
    parser.add_argument("--write", action="store_true", help=f"renew {PAGE.parent.name}/{PAGE.name} as well")
    said = parser.parse_args(arguments)
    names = [name for name in said.scenarios.split(",") if name] or list(QUICK if said.quick else SCENARIOS)
    if unknown := sorted(set(names) - set(SCENARIOS)):
        parser.error(f"no scenario is called {', '.join(unknown)}")
    thin = said.quick or said.thin
    folder = said.out / ("thin" if thin else "full")
    if said.mesh:
        measured = list(mesh_figures(folder, thin=thin))
    else:
        found, broken = outcomes(names, said.seeds, said.noise, folder, thin=thin, workers=said.workers)
        measured = figures([one.outcome for one in found.values()], broken)
        if said.write and found:
            kept = remembered(SCORED)
            kept[folder.name] |= found
            remember(SCORED, kept)
            PAGE.write_text(page(kept, PAGE.read_text(encoding="utf-8") if PAGE.is_file() else ""), encoding="utf-8")
    print(table(measured))
    if said.json is not None:
        write(said.json, record(measured, quick=said.quick))


if __name__ == "__main__":
    main()
