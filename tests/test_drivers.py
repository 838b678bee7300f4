"""What a modulus changes with: each variant differs from the base in one thing, on one deformed mesh."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from fingerjax.errors import InputError
from fingerjax.geometry.presets import HUMAN, solid_from_dimensions
from fingerjax.mesh import Resolution, build_finger, build_like
from fingerjax.runners import drivers as module
from fingerjax.runners.drivers import Change, changes, drivers, notes, plate_at
from fingerjax.study import ForceTable, load_studies

EXPERIMENTS = Path(__file__).resolve().parent.parent / "experiments.yaml"
STUDY = load_studies(EXPERIMENTS)["table1"]


@pytest.mark.parametrize("change", changes(0.18)[1:], ids=lambda change: change.what)
def test_a_variant_differs_in_one_thing(change: Change) -> None:
    varied = change.dimensions(HUMAN)
    names = [field.name for field in dataclasses.fields(HUMAN) if getattr(varied, field.name) != getattr(HUMAN, field.name)]
    nail = change.solid(solid_from_dimensions(HUMAN)).nail != solid_from_dimensions(HUMAN).nail
    assert len(names) + nail + bool(change.model) + (change.spacing != 1.0) == 1


def test_a_dimension_grows_by_what_its_name_says() -> None:
    by_name = {change.what: change for change in changes(0.18)}
    assert by_name["finger 10 % wider"].dimensions(HUMAN).width == pytest.approx(1.1 * HUMAN.width)
    taller = by_name["bone 20 % higher"].dimensions(HUMAN).bone_height
    assert taller == pytest.approx(tuple(1.2 * height for height in HUMAN.bone_height))
    nail = by_name["nail half as long"].solid(solid_from_dimensions(HUMAN)).nail.z
    assert nail[1] - nail[0] == pytest.approx(0.5 * HUMAN.length * (HUMAN.nail[1] - HUMAN.nail[0]))


def test_ratios_and_notes_come_from_the_readings(monkeypatch: pytest.MonkeyPatch) -> None:
    readings = iter([2.0, 1.0, 2.2, 2.0, 2.0, 2.0, 2.0, None, 2.0, 2.0, 3.0])
    monkeypatch.setattr(module, "slope", lambda *ignored: next(readings))
    assert isinstance(STUDY.options, ForceTable)
    told: list[float] = []
    table, said = drivers(STUDY, STUDY.options, lambda share, what: told.append(share))
    assert [row["ratio_to_base"] for row in table.rows][:3] == pytest.approx([1.0, 0.5, 1.1])
    assert "finger 10 % wider (-50.0 %) and mesh finer" in said[0]
    assert "bone elastic" in said[1] and "Not converged" in said[1]
    assert "small strain" in said[2]
    assert told == sorted(told) and max(told) < 1


def test_nothing_is_claimed_where_the_base_did_not_converge() -> None:
    said = notes([{"changed": "base", "slope_MPa_per_gf": None, "ratio_to_base": None}])
    assert len(said) == 2 and not re.search(r"two move", said[0])


def test_the_plate_is_pressed_as_in_its_first_row() -> None:
    assert isinstance(STUDY.options, ForceTable)
    plate = plate_at(STUDY.options)
    assert plate.name == "flat_plate" and plate.table["displacement"].tolist() == [1.0]


@pytest.mark.parametrize(
    ("finger", "shape", "words"),
    [("{sections: s.csv, nail: {z_mm: [1, 2], theta_deg: [50, 130]}}", "flat_plate", "preset"), ("{preset: human}", "line", "flat plate")],
)
def test_drivers_need_a_preset_and_a_plate(tmp_path: Path, finger: str, shape: str, words: str) -> None:
    (tmp_path / "s.csv").write_text("z_mm\n", encoding="utf-8")
    row = "{indenter: one, subject: a, force_N: 1, displacement_mm: 1}"
    options = f"{{drivers: true, indenters: {{one: {{shape: {shape}}}}}, rows: [{row}]}}"
    text = f"version: 1\nkind: table\nfinger: {finger}\nmodel: {{ratios: m43338}}\noptions: {options}\n"
    (tmp_path / "study.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=words):
        load_studies(tmp_path / "study.yaml")


def test_a_deformed_mesh_keeps_its_triangles_and_lies_on_its_own_skin() -> None:
    base, wider = solid_from_dimensions(HUMAN), solid_from_dimensions(dataclasses.replace(HUMAN, width=1.1 * HUMAN.width))
    coarse = Resolution(1.5, 3.0)
    one, other = build_finger(base, coarse), build_like(wider, base, coarse)
    triangles = [{frozenset(corners) for corners in finger.skin[:, :3].tolist()} for finger in (one, other)]
    assert triangles[0] == triangles[1]
    corners = np.unique(other.skin[:, :3])
    assert np.abs(wider.level(0, other.nodes[corners])).max() < 1e-6
    assert other.quality["volume_error"]["epidermis"] == pytest.approx(0.0, abs=0.02)
    assert np.ptp(other.nodes[:, 0]) == pytest.approx(1.1 * np.ptp(one.nodes[:, 0]), rel=0.01)
