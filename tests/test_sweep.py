"""A sweep of a shape over a receptor: what may be written, and that a step is felt as the paper says on a coarse finger."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fingerjax.errors import InputError
from fingerjax.report.records import Context, StudyResult
from fingerjax.runners import RUNNERS, sweeps
from fingerjax.study import Study, Sweep, load_studies

STUDY = """\
version: 1
kind: sweep
finger: {preset: monkey, resolution: {pad_mm: 1.2, proximal_mm: 3.0}}
model: {ratios: m43338, epidermis_MPa: 0.14, receptor: {depth_mm: 0.75, z_mm: 8.7, theta_deg: 270}}
options:
  indenters: {step: {shape: step, amplitude_mm: 0.5, wavelength_mm: 6.0}, plate: flat_plate}
  force_N: 0.2
  positions_mm: [-3.0, 3.0]
  spacing_mm: 1.0
"""


def load(folder: Path, text: str = STUDY) -> Study:
    (folder / "moved.yaml").write_text(text)
    return load_studies(folder / "moved.yaml")["moved"]


def test_what_is_written_is_read_in_mm_and_newtons(tmp_path: Path) -> None:
    options = load(tmp_path).options
    assert isinstance(options, Sweep) and options.force == 0.2 and options.depth is None
    assert options.positions == pytest.approx(np.arange(-3.0, 3.1)) and options.indenters["step"].along == "x"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("force_N: 0.2", "force_N: 0.2\n  depth_mm: 1.0", "needs one load"),
        ("  force_N: 0.2\n", "", "needs one load"),
        ("[-3.0, 3.0]", "[3.0, -3.0]", "three positions or more"),
        ("flat_plate", "flat_plat", "unknown indenter shape"),
    ],
)
def test_what_cannot_be_swept_is_refused(tmp_path: Path, old: str, new: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        load(tmp_path, STUDY.replace(old, new))


def test_a_sweep_without_a_receptor_says_where_to_write_it(tmp_path: Path) -> None:
    text = STUDY.replace(", receptor: {depth_mm: 0.75, z_mm: 8.7, theta_deg: 270}", "")
    with pytest.raises(InputError, match="place of its receptor"):
        RUNNERS["sweep"](load(tmp_path, text), Context(tmp_path))


@pytest.fixture(scope="module", autouse=True)
def coarse() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweeps, "SPACING", 1.0)
        yield


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> StudyResult:
    folder = tmp_path_factory.mktemp("sweep")
    return RUNNERS["sweep"](load(folder), Context(folder))


def test_under_a_step_area_and_pressure_are_opposed_and_the_convex_part_is_felt_most(result: StudyResult) -> None:
    rows = {row["indenter"]: row for table in result.tables if table.name == "summary" for row in table.rows}
    assert rows["step"]["correlation_of_area_and_mean_pressure"] < -0.9
    assert rows["step"]["most_energy_at_mm"] > 0  # the receptor is under the rounded top, proximal of the origin
    assert rows["step"]["most_energy_kPa"] > rows["plate"]["most_energy_kPa"]


def test_a_plate_is_the_same_wherever_it_is_moved_and_every_place_has_the_force(result: StudyResult) -> None:
    (table,) = [table for table in result.tables if table.name == "sweep"]
    plate = [row for row in table.rows if row["indenter"] == "plate"]
    assert len(table.rows) == 14 and all(row["force_N"] == pytest.approx(0.2, rel=1e-9) for row in table.rows)
    for column in ("area_mm2", "travel_mm", "strain_energy_density_kPa", "maximum_compressive_strain"):
        assert np.ptp([row[column] for row in plate]) < 1e-6 * abs(plate[0][column])
    assert result.figures[0].rows == table.rows and "feels most under step" in result.verdict


def test_a_force_that_cannot_be_reached_ends_with_its_pose(tmp_path: Path) -> None:
    study = load(tmp_path)
    assert isinstance(study.options, Sweep)
    hard = dataclasses.replace(study, options=dataclasses.replace(study.options, force=50.0))
    with pytest.raises(InputError, match="pose|end of the prepared skin"):
        RUNNERS["sweep"](hard, Context(tmp_path))
