"""The project's own studies load and can be run, and what their runners conclude follows from the rows."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from fingerjax.indenter_spec import IndenterSpec
from fingerjax.report.records import Row
from fingerjax.runners import RUNNERS
from fingerjax.runners.force_table import _growth, crossing
from fingerjax.runners.layer_models import check_findings
from fingerjax.study import ForceTable, LayerStudy, Study, TableRow, load_studies

FILE = Path(__file__).resolve().parent.parent / "experiments.yaml"


@pytest.fixture(scope="module")
def studies() -> dict[str, Study]:
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("FINGERJAX_DATA", raising=False)
        return load_studies(FILE)


def test_the_papers_studies_are_there_and_each_kind_is_run(studies: dict[str, Study]) -> None:
    assert {"table1", "table2", "layer_ratios", "layer_study", "sa1_bar"} <= set(studies)
    assert {study.kind for study in studies.values()} <= set(RUNNERS)
    assert {study.kind for study in studies.values()} >= {"fit", "table", "layer_study"}


def test_everything_but_measured_data_lies_beside_the_file(studies: dict[str, Study]) -> None:
    """Paths that do not begin with `data:` were found on loading; what stands in for a study without its data is there."""
    for study in studies.values():
        assert study.sections is None or study.sections.is_file()
        assert all(one.file is not None and one.file.is_file() for one in study.measurements)
        if study.missing_data and study.fallback is not None:
            assert not studies[study.fallback].missing_data
    assert {name for name, study in studies.items() if study.missing_data} == {"layer_ratios", "sa1_bar_measured", "sa1_spheres"}


def test_measured_data_are_found_in_the_data_folder(measured: Path) -> None:
    if not (measured / "human-fingertip-surface-profile").is_dir():
        pytest.skip(f"no measured profiles in {measured}; set FINGERJAX_DATA to the folder that holds them")
    study = load_studies(FILE, measured)["layer_ratios"]
    assert not study.missing_data and len(study.measurements) == 2
    assert all(len(one) > 10 for one in study.measurements)


def test_tables_hold_the_papers_rows_in_newtons(studies: dict[str, Study]) -> None:
    one, two = studies["table1"].options, studies["table2"].options
    assert isinstance(one, ForceTable) and isinstance(two, ForceTable)
    assert (len(one.rows), len(two.rows)) == (10, 7)
    assert one.rows[0].force == pytest.approx(5.29 * 9.80665e-3)
    plates = [row.modulus for row in one.rows if row.indenter == "flat_plate"]
    assert np.mean(plates) == pytest.approx(0.166)


def test_the_layer_study_changes_one_layer_at_a_time(studies: dict[str, Study]) -> None:
    options = studies["layer_study"].options
    assert isinstance(options, LayerStudy)
    differing = [sum(a != b for a, b in zip(options.models[0], name, strict=True)) for name in options.models[1:]]
    assert differing == [1] * 8


def influence(**changed: dict[str, float]) -> list[Row]:
    """Rows as the paper's Fig. 8 has them, `layerN` changed."""
    numbers = {1: (0.02, 0.03), 2: (-0.01, 0.004), 3: (-0.05, -0.02), 4: (-0.04, -0.03)}
    rows: list[Row] = []
    for layer, (near, beyond) in numbers.items():
        size = {1: 0.03, 2: 0.01, 3: 0.04, 4: 0.035}[layer]
        for change, sign in (("stiffer", 1.0), ("softer", -1.0)):
            row: Row = {"layer": layer, "change": change, "near": sign * near, "beyond": sign * beyond}
            rows.append({**row, "rms": size, "centre_mm": 1.0 + 0.2 * layer, **changed.get(f"layer{layer}", {})})
    return rows


def holding(rows: list[Row]) -> list[str]:
    return [row["holds"] for row in check_findings(rows)]


def test_findings_hold_for_rows_as_in_the_paper() -> None:
    assert holding(influence()) == ["yes"] * 5


@pytest.mark.parametrize(
    ("changed", "failing"),
    [
        ({"layer1": {"beyond": -0.01}}, 0),
        ({"layer2": {"near": 0.01}}, 1),
        ({"layer2": {"rms": 0.05}}, 2),
        ({"layer4": {"beyond": 0.01}}, 3),
        ({"layer3": {"centre_mm": 1.1}}, 4),
    ],
)
def test_each_finding_fails_on_its_own(changed: dict[str, dict[str, float]], failing: int) -> None:
    assert holding(influence(**changed)) == ["no" if number == failing else "yes" for number in range(5)]


def test_findings_that_nothing_was_computed_for_are_not_tried() -> None:
    without = [row for row in influence() if row["layer"] != 2]
    assert holding(without) == ["yes", "not tried", "not tried", "yes", "not tried"]
    softer = [row for row in influence() if row["change"] == "softer"]
    assert holding(softer) == ["not tried", "not tried", "yes", "not tried", "yes"]


def test_a_curve_is_crossed_where_its_logarithms_say() -> None:
    x = np.array([0.1, 0.2, 0.4, 0.8])
    assert crossing(x, 3.0 * x**-0.7, 3.0 * 0.3**-0.7) == pytest.approx(0.3)
    assert crossing(x, x, 0.4) == pytest.approx(0.4)
    assert crossing(x, x, 0.1) == pytest.approx(0.1)
    assert crossing(x, x, 0.05) is None and crossing(x, x, 1.0) is None


def test_growth_is_the_exponent_between_the_ends_and_needs_two_travels() -> None:
    travels = {"plate": (0.78, 0.5, 1.0), "line": (1.0, 1.0, 1.01)}
    rows = [TableRow(name, str(i), 0.1, travel, None) for name, each in travels.items() for i, travel in enumerate(each)]
    table = ForceTable(tuple(rows), {name: IndenterSpec("flat_plate") for name in travels}, "displacement")
    forces = {name: 0.2 * np.array(each) ** 1.8 for name, each in travels.items()}
    found = _growth(table, forces)
    assert [row["indenter"] for row in found] == ["plate"]
    assert found[0]["exponent"] == pytest.approx(1.8) and math.isclose(found[0]["to_mm"], 1.0)
    assert found[0]["from_mm"] == 0.5
