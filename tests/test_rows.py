"""What the rows of a study say of themselves: how wrong any model may be, and what an afferent beside its place would read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fingerjax.runners.rows import rows_of
from fingerjax.study import Study

from .test_forward import PLATE, study_of

BAR = {
    "kind": "spike_rate",
    "indenter": {"shape": "bar", "width_mm": 3.0},
    "receptor": {"depth_mm": 0.75, "z_mm": 8.7, "theta_deg": 270},
    "noise": {"sigma": 1.0, "unit": "Hz"},
}
PLACES = (-1.0, -0.5, 0.0, 0.5, 1.0)


def measured(folder: Path, **diagnose: object) -> Study:
    bar = [{"trial": k, "position_mm": s, "depth_mm": 1.0, "rate_Hz": 50.0 + 20.0 * s} for k in (1, 2, 3) for s in PLACES]
    plate = [{"trial": k, "displacement_mm": d, "force_N": d} for k in (1, 2, 3) for d in (0.2, 0.4)]
    files = {"bar": (BAR, bar), "plate": (PLATE, plate)}
    return study_of(folder, files, {"free": ["epidermis.modulus"]}, diagnose={"effects": "all", **diagnose})


def test_what_any_model_is_wrong_by_is_a_share_of_what_was_read(tmp_path: Path) -> None:
    rows = rows_of(measured(tmp_path, model_error={"rate": 0.2, "force": 0.03}))
    assert rows.form is not None
    assert rows.form[rows.blocks["bar"]] == pytest.approx(0.2 * 70.0)  # of the greatest rate of the sweep
    assert rows.form[rows.blocks["plate"]] == pytest.approx(0.03 * rows.measured[rows.blocks["plate"]])


def test_an_afferent_beside_its_place_reads_the_slope_of_its_sweep(tmp_path: Path) -> None:
    rows = rows_of(measured(tmp_path, placement_mm=0.3))
    (added,) = rows.calibration.values()
    assert added[rows.blocks["bar"]] == pytest.approx(0.3 * 20.0)
    assert not np.any(added[rows.blocks["plate"]])
    (tmp_path / "sure").mkdir()
    assert not rows_of(measured(tmp_path / "sure", placement_mm=0.0)).calibration


def test_conditions_of_one_set_up_differ_in_what_was_imposed_alone(tmp_path: Path) -> None:
    bar = [
        {"stimulus": name, "trial": k, "position_mm": s, "depth_mm": depth, "rate_Hz": 50.0 + 20.0 * s}
        for name in ("narrow", "wide") for depth in (0.5, 1.0) for k in (1, 2, 3) for s in PLACES
    ]  # fmt: skip
    widths = {"narrow": {"shape": "bar", "width_mm": 1.5}, "wide": {"shape": "bar", "width_mm": 3.0}}
    bars = {**BAR, "indenter": {"stimuli": widths}}
    rows = rows_of(study_of(tmp_path, {"bar": (bars, bar)}, {"free": ["epidermis.modulus"]}, diagnose={"effects": "all"}))
    assert set(rows.setups.tolist()) == {"bar, narrow", "bar, wide"}
    assert set(rows.conditions) == {f"bar, {name}, {depth} mm" for name in ("narrow", "wide") for depth in ("0.5", "1")}
