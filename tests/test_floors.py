"""The house has floors, and a file imports lower floors, or other files of its own without going in circles.

`pytest tests/test_floors.py -s` prints the picture.
"""

from __future__ import annotations

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "fingerjax"

FLOORS: dict[str, tuple[str, ...]] = {
    "words": (
        *("errors", "layers", "spelling", "yamlfile", "csvfile", "strict", "tidy", "side_by_side"),
        *("units", "parameters", "_results", "_types"),
    ),
    "shape": ("geometry", "mesh", "finger"),
    "mechanics": ("fem",),
    "touching": ("contact",),
    "instruments": ("measure", "response"),
    "effects": ("effects",),
    "experiments": (
        *("indenter_spec", "row_choice", "traces", "spike_windows", "measurements", "finger_keys", "study_design", "study_sweep"),
        *("study_keys", "study_records", "study_diagnose", "study_reader", "study"),
    ),
    "forward": ("forward",),
    "identify": ("identify", "loop"),
    "report": ("report", "runners", "commands", "__main__"),
}
LEVEL = {room: level for level, rooms in enumerate(FLOORS.values()) for room in rooms}
ROOF = len(FLOORS)


def read_imports(package: Path) -> dict[str, set[str]]:
    """Each file of the package, as `room.file`, with the files of it that it imports; `""` is the package."""
    files = {".".join(_parts(path, package)): path for path in sorted(package.rglob("*.py"))}
    return {name: set(_targets(name, path, package.name, files)) - {name} for name, path in files.items()}


def _parts(path: Path, package: Path) -> tuple[str, ...]:
    parts = path.relative_to(package).with_suffix("").parts
    return parts[:-1] if parts[-1] == "__init__" else parts


def _targets(name: str, path: Path, package: str, files: dict[str, Path]) -> list[str]:
    here = [package, *(name.split(".") if name else [])]
    if path.name != "__init__.py":
        here.pop()
    found = []
    for node in ast.walk(ast.parse(path.read_text(), filename=str(path))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = ".".join([*here[: len(here) - node.level + 1], *([node.module] if node.module else [])])
            found += _named_files(base if node.level else (node.module or ""), node.names, package, files)
    return [_inside(target, package) for target in found if target.split(".")[0] == package]


def _named_files(base: str, names: list[ast.alias], package: str, files: dict[str, Path]) -> list[str]:
    """What `from base import names` reaches: files by their own name, `base` for anything else in it."""
    reached = []
    for alias in names:
        below = f"{base}.{alias.name}"
        if base == package and alias.name == "__version__":
            continue  # said before anything is imported
        reached.append(below if _inside(below, package) in files else base)
    return reached


def _inside(target: str, package: str) -> str:
    return target.removeprefix(package).removeprefix(".")


def level(name: str) -> int:
    """The floor of a file, 0 at the ground; the package itself is the roof. `KeyError`: no such room."""
    return LEVEL[name.split(".")[0]] if name else ROOF


def climbs(imports: dict[str, set[str]]) -> list[str]:
    """Every import of a higher floor, in words."""
    names = [*FLOORS, "the package"]
    return [
        f"{name} ({names[level(name)]}) imports {target or 'fingerjax'} ({names[level(target)]})"
        for name, targets in imports.items()
        for target in sorted(targets)
        if level(target) > level(name)
    ]


def circle(imports: dict[str, set[str]]) -> list[str]:
    """The files of one circle of imports, or nothing."""
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def picture(imports: dict[str, set[str]]) -> str:
    """The house from the roof down: each floor, its files, and the floors they stand on."""
    lines = []
    for number, floor in reversed(list(enumerate(FLOORS))):
        files = [name for name in imports if name and level(name) == number]
        levels = {level(target) for name in files for target in imports[name]}
        below = [floor for k, floor in enumerate(FLOORS) if k in levels and k < number]
        stands = f"   [on {', '.join(below)}]" if below else ""
        lines.append(f"{number}  {floor:<12} {' '.join(files) or '-'}{stands}")
    return "\n".join(lines)


def test_every_file_has_a_floor() -> None:
    homeless = [name for name in read_imports(PACKAGE) if name and name.split(".")[0] not in LEVEL]
    assert not homeless, f"say in FLOORS on which floor these live: {homeless}"


def test_no_file_imports_a_higher_floor() -> None:
    imports = read_imports(PACKAGE)
    print("\n" + picture(imports))
    assert not climbs(imports), "\n".join(climbs(imports))


def test_no_imports_go_in_circles() -> None:
    assert not circle(read_imports(PACKAGE))


@pytest.fixture
def crooked_house(tmp_path: Path) -> dict[str, set[str]]:
    """A package in which everything the other tests look for is wrong, in every manner of importing."""
    package = tmp_path / "fingerjax"
    written = {
        "__init__.py": "from .errors import InputError",
        "errors.py": "def late():\n    from fingerjax import forward",
        "forward.py": "import fingerjax.fem.solver\nfrom fingerjax import __version__",
        "fem/__init__.py": "from .solver import solve",
        "fem/operator.py": "from .. import errors\nfrom ..report.page import draw",
        "fem/solver.py": "from . import operator\nfrom fingerjax.fem import __doc__",
        "report/page.py": "import numpy\nimport fingerjax",
    }
    for name, text in written.items():
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text(text)
    return read_imports(package)


def test_imports_are_read_in_every_manner(crooked_house: dict[str, set[str]]) -> None:
    assert crooked_house == {
        "": {"errors"},
        "errors": {"forward"},
        "forward": {"fem.solver"},
        "fem": {"fem.solver"},
        "fem.operator": {"errors", "report.page"},
        "fem.solver": {"fem.operator", "fem"},
        "report.page": {""},
    }


def test_a_climb_and_a_circle_are_seen(crooked_house: dict[str, set[str]]) -> None:
    assert climbs(crooked_house) == [
        "errors (words) imports forward (forward)",
        "fem.operator (mechanics) imports report.page (report)",
        "report.page (report) imports fingerjax (the package)",
    ]
    assert circle(crooked_house)
