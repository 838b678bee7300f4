"""Long benchmarks: parts are kept, taken up again, and told together."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks._parts import deeds, read, run_parts
from benchmarks._record import Figure, at_most

ROOT = Path(__file__).resolve().parents[1]


def first(quick: bool) -> Iterator[Figure]:
    yield at_most("time", 1.0 if quick else 2.0, "s", 1.5)


def second(quick: bool) -> Iterator[Figure]:
    yield Figure("never seen", math.nan, "mm", "<= 1", False, "the mesh")


def broken(quick: bool) -> Iterator[Figure]:
    raise RuntimeError("the solver gave up")


def run(folder: Path, parts: dict, *arguments: str, partial: bool = False) -> tuple[list[str], str]:
    """The parts kept in the file, in order, and the page."""
    page, said = folder / "page.md", ["--json", str(folder / "kept.json"), *arguments]
    run_parts(parts, None, (page, lambda figures: " ".join(one.figure for one in figures)), said, partial=partial)
    return [entry["part"] for entry in json.loads((folder / "kept.json").read_text())], page.read_text() if page.exists() else ""


def test_all_parts_make_a_page(tmp_path: Path) -> None:
    assert run(tmp_path, {"first": first, "second": second}, "--write") == (["first", "second"], "time never seen")
    entry = json.loads((tmp_path / "kept.json").read_text())[1]
    assert entry["value"] is None and math.isnan(read(entry).value) and read(entry).note == "the mesh"


def test_a_part_is_taken_up_again_and_the_page_waits_for_all(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parts = {"first": first, "second": second}
    assert run(tmp_path, parts, "--part", "second", "--write") == (["second"], "")
    assert "no figures of first; the page is not written" in capsys.readouterr().out
    assert run(tmp_path, parts, "--part", "first", "--write") == (["first", "second"], "time never seen")


def test_a_partial_page_does_not_wait(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parts = {"first": first, "second": second}
    assert run(tmp_path, parts, "--part", "second", "--write", partial=True) == (["second"], "never seen")
    assert "no figures of first\n" in capsys.readouterr().out


def test_quick_figures_are_not_mixed_with_others(tmp_path: Path) -> None:
    parts = {"first": first, "second": second}
    run(tmp_path, parts, "--quick")
    assert run(tmp_path, parts, "--part", "first") == (["first"], "")


def test_what_was_found_before_a_part_broke_off_is_kept(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="gave up"):
        run(tmp_path, {"first": first, "second": broken})
    assert [entry["part"] for entry in json.loads((tmp_path / "kept.json").read_text())] == ["first"]


SCRIPT = """
import json, math, sys
from benchmarks._parts import run_parts
from benchmarks._record import Figure

def first(quick):
    yield Figure("time", 1.0 if quick else 2.0, "s")

def second(quick):
    {second}
    yield Figure("length", math.nan, "mm")

run_parts({{"first": first, "second": second}}, None, ({page!r}, lambda found: " ".join(one.figure for one in found)))
"""


@pytest.mark.parametrize("line", ["pass", "raise RuntimeError"])
def test_parts_as_processes_keep_what_parts_in_turn_keep(tmp_path: Path, line: str) -> None:
    script, kept = tmp_path / "script.py", tmp_path / "kept.json"
    script.write_text(SCRIPT.format(second=line, page=tmp_path / "page.md").replace("PosixPath", "__import__('pathlib').Path"))
    command = [sys.executable, str(script), "--workers", "2", "--quick", "--json", str(kept), "--write"]
    ended = subprocess.run(command, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True)
    found = [(entry["part"], entry["value"], entry["quick"]) for entry in json.loads(kept.read_text())]
    if line == "pass":
        assert ended.returncode == 0 and (tmp_path / "page.md").read_text() == "time length", ended.stderr
        assert found == [("first", 1.0, True), ("second", None, True)]
    else:
        assert ended.returncode and "second broke off" in ended.stderr and found == [("first", 1.0, True)]


def test_words_do_not_make_another_program() -> None:
    plain = "SIZE = 2.0\ndef double(x):\n    return SIZE * x\n"
    told = '"""Sizes."""\nSIZE = 2.0  # mm\n"""mm"""\ndef double(x):\n    """Twice."""\n    return (\n        SIZE * x\n    )\n'
    assert deeds(plain) == deeds(told)
    for other in (plain.replace("2.0", "2.1"), plain.replace("SIZE * x", "SIZE + x"), plain.replace("2.0", '"2.0"')):
        assert deeds(plain) != deeds(other)
