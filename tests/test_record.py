"""A benchmark's figures keep to one form, and a missed goal cannot be overlooked."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import jax.numpy as jnp
import pytest

from benchmarks.__main__ import main as run_all
from benchmarks.__main__ import names
from benchmarks._record import Figure, at_least, at_most, between, run, table


def example(quick: bool) -> Iterator[Figure]:
    yield at_most("time of one solve", 0.4 if quick else 1.5, "s", 1.0, "10k nodes")
    yield at_least("agreement", 0.5, "1", 0.9)
    yield Figure("precision", float(jnp.ones(1).dtype.itemsize), "bytes")
    yield Figure("size never seen", math.nan, "mm", "<= 1", False)


def test_the_json_is_a_list_of_figures_with_machine_and_versions(tmp_path: Path) -> None:
    file = tmp_path / "new folder" / "example.json"
    run(example, ["--quick", "--json", str(file)])
    records = json.loads(file.read_text())
    first = records[0]
    form = ("figure", "value", "unit", "goal", "met", "note")
    assert [first[key] for key in form] == ["time of one solve", 0.4, "s", "<= 1", True, "10k nodes"]
    assert first["quick"] is True
    assert first["machine"]["cores"] >= 1
    assert first["machine"]["cpu"]
    assert first["versions"]["jax"].count(".") >= 2
    assert [entry["met"] for entry in records] == [True, False, None, False]
    assert [entry["value"] for entry in records] == [0.4, 0.5, 8.0, None]
    assert list(file.parent.iterdir()) == [file]


def test_a_missed_goal_is_printed_as_not_met(capsys: pytest.CaptureFixture[str]) -> None:
    run(example, [])
    lines = capsys.readouterr().out.splitlines()
    assert [" ".join(line.split()) for line in lines] == [
        "time of one solve 1.5 s goal <= 1 NOT MET 10k nodes",
        "agreement 0.5 goal >= 0.9 NOT MET",
        "precision 8 bytes",
        "size never seen nan mm goal <= 1 NOT MET",
        "0 of 3 goals met",
    ]


def test_a_benchmark_that_breaks_off_leaves_no_file(tmp_path: Path) -> None:
    def broken(quick: bool) -> Iterator[Figure]:
        yield at_most("time", 0.1, "s", 1.0)
        raise RuntimeError("the solver gave up")

    with pytest.raises(RuntimeError, match="gave up"):
        run(broken, ["--json", str(tmp_path / "broken.json")])
    assert not list(tmp_path.iterdir())


def test_a_page_is_written_when_it_is_asked_for(tmp_path: Path) -> None:
    def one(quick: bool) -> Iterator[Figure]:
        yield Figure("error", 12.34, "%", note="Poisson ratio 0.48")

    page = tmp_path / "page.md"
    run(one, [], page=(page, lambda figures: str(len(figures))))
    assert not page.exists()
    run(one, ["--write"], page=(page, lambda figures: f"{len(figures)} figure: {figures[0].value:+.1f}"))
    assert page.read_text() == "1 figure: +12.3"


@pytest.mark.parametrize(
    ("value", "met"), [(0.99, False), (1.0, True), (2.0, True), (2.01, False), (math.nan, False)]
)
def test_a_range_includes_its_ends_and_no_nan(value: float, met: bool) -> None:
    assert between("ratio", value, "1", 1.0, 2.0).met is met


def test_a_goal_without_a_verdict_is_refused() -> None:
    with pytest.raises(ValueError, match="both or neither"):
        Figure("ratio", 1.0, "1", goal="<= 2")
    with pytest.raises(ValueError, match="meets no goal"):
        Figure("ratio", math.nan, "1", goal="<= 2", met=True)


def test_no_figures_make_a_table_all_the_same() -> None:
    assert table([]) == "0 of 0 goals met"


def test_only_benchmarks_are_run_and_an_unknown_one_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert not [name for name in names() if name.startswith("_")]
    with pytest.raises(SystemExit, match="2"):
        run_all(["no_such_benchmark"])
    assert "no benchmark is called no_such_benchmark" in capsys.readouterr().err
