"""Every notebook runs from its first cell to its last, and the scripts under fits/ are short and can be asked for help."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
LONG = ("from_data_to_modulus_table", "what_the_data_can_tell")  # a minute each
SCRIPTS = sorted(path for path in (ROOT / "fits").glob("*.py") if not path.name.startswith("_"))


def cells(notebook: Path) -> list[str]:
    """The code of a notebook, cell by cell."""
    return ["".join(cell["source"]) for cell in json.loads(notebook.read_text())["cells"] if cell["cell_type"] == "code"]


@pytest.mark.parametrize(
    "notebook", [pytest.param(path, id=path.stem, marks=[pytest.mark.slow] if path.stem in LONG else []) for path in NOTEBOOKS]
)
def test_a_notebook_runs(notebook: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    names: dict[str, object] = {"__name__": notebook.stem}
    for number, code in enumerate(cells(notebook), 1):
        exec(compile(code, f"{notebook.name}, code cell {number}", "exec"), names)


def test_notebooks_are_kept_without_outputs() -> None:
    assert len(NOTEBOOKS) >= 3
    for notebook in NOTEBOOKS:
        assert all(not cell.get("outputs") for cell in json.loads(notebook.read_text())["cells"]), notebook.name


@pytest.mark.parametrize("script", SCRIPTS, ids=[path.stem for path in SCRIPTS])
def test_a_script_is_short(script: Path) -> None:
    assert len(script.read_text().splitlines()) < 120


def test_a_script_says_what_it_does() -> None:
    command = [sys.executable, str(ROOT / "fits" / "layer_ratios.py"), "--help"]
    said = subprocess.run(command, capture_output=True, text=True, check=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
    assert "powers of ten" in said.stdout and "--coarse" in said.stdout
