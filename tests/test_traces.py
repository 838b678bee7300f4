"""Recorded traces at the door: zero at first contact, read at fewer places, repeats made alike, spikes counted in windows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fingerjax.errors import InputError
from fingerjax.forward.model import noise_of
from fingerjax.measurements import Measurement, read_measurement

FORCE = {"kind": "force_displacement", "indenter": "flat_plate"}
RATE = {
    "kind": "spike_rate",
    "indenter": "flat_plate",
    "receptor": {"depth_mm": 0.1, "z_mm": 5.0, "theta_deg": 270},
    "every": {"position_mm": 0},
}
BEGINS = {1: 0.4, 2: 0.4513, 3: 0.5027}  # mm: where the skin is, in each trial's own displacement
LEVEL, LATER = {"force_mN": 250}, 0.0125  # what is taken for first contact, and mm by which it comes after the true one


def ramp() -> str:
    """Three trials: 1 mm/s for 0.3 s into the skin, held to 1.0 s, withdrawn; 20 N/mm."""
    lines = ["trial,time_s,displacement_um,force_mN"]
    for trial, skin in BEGINS.items():
        for step in range(0, 261):
            time = 0.01 * step
            depth = min(time, skin + 0.3) if time < 1.6 else max(skin + 0.3 - (time - 1.6), 0.0)
            lines.append(f"{trial},{time:.2f},{1000 * depth:.1f},{max(20.0 * (depth - skin), 0.0) * 1000:.3f}")
    return "\n".join(lines) + "\n"


def read(folder: Path, csv: str, said: dict[str, Any]) -> Measurement:
    (folder / "trial.csv").write_text(csv)
    return read_measurement(folder / "trial.csv", said)


def refused(folder: Path, csv: str, said: dict[str, Any]) -> str:
    with pytest.raises(InputError) as refusal:
        read(folder, csv, said)
    assert "trial" in str(refusal.value)
    return str(refusal.value)


@pytest.mark.parametrize("contact", [LEVEL, {"force_N": 0.25}])
def test_displacement_and_time_begin_at_first_contact(tmp_path: Path, contact: dict[str, float]) -> None:
    one = read(tmp_path, ramp(), {**FORCE, "contact": contact})
    for trial, skin in BEGINS.items():
        own = one.table["trial"] == str(trial)
        assert one.table["displacement"][own].min() >= 0 and one.table["time"][own].min() > 0
        np.testing.assert_allclose(one.measured[own], 0.25 + 20.0 * one.table["displacement"][own], atol=5e-6)
        early = own & (one.table["time"] < 0.25)
        np.testing.assert_allclose(one.table["time"][early], one.table["displacement"][early], atol=1e-6)
        first = int(one.rows[own][0]) - 2 - 261 * (trial - 1)
        assert 0.01 * (first - 1) <= skin + LATER < 0.01 * first, "rows are told by their line in the file"


def test_contact_may_be_said_as_a_displacement(tmp_path: Path) -> None:
    one = read(tmp_path, ramp(), {**FORCE, "where": {"trial": 1}, "contact": {"displacement_mm": 0.4}})
    np.testing.assert_allclose(one.measured, 20.0 * one.table["displacement"], atol=2e-6)


def test_traces_are_read_at_the_same_times_and_are_repeats(tmp_path: Path) -> None:
    times = [0.055, 0.2, 0.5, 1.0]
    said = {**FORCE, "contact": LEVEL, "at": {"time_s": times}}
    apart = read(tmp_path, ramp(), said)
    assert len(apart) == 12 and apart.replicates == 3
    np.testing.assert_allclose(apart.table["time"].reshape(3, 4), [times] * 3, rtol=1e-15)
    np.testing.assert_allclose(apart.table["displacement"].reshape(3, 4), [[0.055, 0.2, 0.2875, 0.2875]] * 3, atol=1e-6)
    assert len(np.unique(apart.table["displacement"])) > 6, "rounding keeps repeats apart"
    alike = read(tmp_path, ramp(), {**said, "alike": {"displacement_um": 1}})
    assert noise_of(alike)[1] == "replicates"
    assert len(np.unique(alike.table["displacement"])) == 3, "the hold is one displacement"


def test_what_is_alike_takes_its_mean_and_no_more(tmp_path: Path) -> None:
    csv = "trial,displacement_mm,force_N\n1,0.500,0.1\n2,0.508,0.11\n3,0.512,0.12\n4,0.700,0.2\n"
    one = read(tmp_path, csv, {**FORCE, "alike": {"displacement_um": 10}})
    np.testing.assert_allclose(one.table["displacement"], [0.504, 0.504, 0.512, 0.7], rtol=1e-12)
    np.testing.assert_allclose(one.measured, [0.1, 0.11, 0.12, 0.2])
    other = read(tmp_path, csv.replace("trial", "condition"), {**FORCE, "alike": {"displacement_um": 10}})
    np.testing.assert_allclose(other.table["displacement"], [0.5, 0.508, 0.512, 0.7], err_msg="other conditions are no repeats")


def test_labels_are_joined(tmp_path: Path) -> None:
    csv = "sample,repeat,displacement_mm,force_N\nA,1,0.5,0.1\nA,2,0.5,0.11\nB,1,0.5,0.12\n"
    one = read(tmp_path, csv, {**FORCE, "columns": {"trial": ["sample", "repeat"]}})
    assert one.table["trial"].tolist() == ["A 1", "A 2", "B 1"] and one.replicates == 3
    assert "labels only" in refused(tmp_path, csv, {**FORCE, "columns": {"force_N": ["sample", "repeat"]}})
    assert "repeat" in refused(tmp_path, csv, {**FORCE, "columns": {"trial": ["sample", "repaet"]}})


def test_a_column_that_is_counted_the_other_way_is_turned(tmp_path: Path) -> None:
    csv = "up_mm,force_N\n-0.5,0.1\n-0.7,0.2\n"
    one = read(tmp_path, csv, {**FORCE, "columns": {"displacement_mm": "-up_mm"}})
    assert one.table["displacement"].tolist() == [0.5, 0.7]
    assert "-pu_mm" in refused(tmp_path, csv, {**FORCE, "columns": {"displacement_mm": "-pu_mm"}})


def spikes() -> str:
    """Trial 1: one spike every 10 ms of the first 0.2 s of contact, one every 100 ms later; trial 2 half of that; trial 3 none."""
    lines = ["trial,time_s"]
    for trial, apart in ((1, 1), (2, 2)):
        at = np.concatenate([np.arange(0.005, 0.2, 0.01 * apart), np.arange(0.55, 1.0, 0.1 * apart)])
        lines += [f"{trial},{BEGINS[trial] + LATER + each:.4f}" for each in at]
    return "\n".join(lines) + "\n"


def test_spikes_are_counted_in_windows_on_the_clock_of_their_trace(tmp_path: Path) -> None:
    (tmp_path / "spikes.csv").write_text(spikes())
    rates = {"spikes": "spikes.csv", "windows_s": [[0.0, 0.2], [0.5, 1.0]]}
    said = {
        **RATE,
        "columns": {"depth_um": "displacement_um"},
        "contact": LEVEL,
        "rates": rates,
        "controlled": "displacement",
    }
    one = read(tmp_path, ramp(), said)
    np.testing.assert_allclose(one.measured, [100.0, 10.0, 50.0, 6.0, 0.0, 0.0])
    np.testing.assert_allclose(one.table["time"], [0.1, 0.75] * 3)
    np.testing.assert_allclose(one.table["depth"], [0.1, 0.2875] * 3, atol=0.006)
    assert set(one.table) == {"depth", "position", "time", "trial", "rate"}
    forced = read(tmp_path, ramp(), {**said, "controlled": "force"})
    np.testing.assert_allclose(forced.table["force"], [2.25, 6.0] * 3, atol=0.12)
    assert "depth" not in forced.table and forced.imposed == "force"
    named = read(tmp_path, ramp(), {**said, "every": {**RATE["every"], "subject": "one finger"}})
    np.testing.assert_allclose(named.measured, one.measured)  # what is said of all traces need not be told of spikes


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"contact": {"force_mN": 1e6}}, "does not come into contact"),
        ({"contact": {"force": 1.0}}, "no unit"),
        ({"contact": {"speed_mm": 1.0}}, "force"),
        ({"contact": {"force_mN": 1.0, "displacement_mm": 0.4}}, "one column"),
        ({"at": {"displacement_mm": [0.1, 0.2]}, "contact": {"force_mN": 1.0}}, "does not only rise"),
        ({"at": {"time_s": [0.1, 9.0]}}, "does not go so far"),
        ({"at": {"time_s": [0.2, 0.1]}}, "not values that rise"),
        ({"alike": {"displacement_um": 0}, "contact": {"force_mN": 1.0}}, "not a difference"),
        ({"alike": {"force_mN": 1}, "contact": {"force_mN": 1.0}}, "no such column"),
        ({"at": {"tme_s": [0.1]}}, "time"),
    ],
)
def test_what_cannot_be_done_to_a_trace_is_refused(tmp_path: Path, more: dict[str, Any], words: str) -> None:
    assert words in refused(tmp_path, ramp(), {**FORCE, **more})


def test_spikes_without_a_trace_are_refused(tmp_path: Path) -> None:
    (tmp_path / "spikes.csv").write_text("time_s\n0.5\n")
    said = {**RATE, "columns": {"depth_um": "displacement_um"}, "contact": LEVEL, "controlled": "displacement"}
    rates = {"spikes": "spikes.csv", "windows_s": [[0.0, 0.2]]}
    assert "to which trace" in refused(tmp_path, ramp(), {**said, "rates": rates})
    assert "to which trace" in refused(tmp_path, ramp(), {**said, "rates": rates, "where": {"trial": [1]}})
    assert "no such file" in refused(tmp_path, ramp(), {**said, "rates": {**rates, "spikes": "other.csv"}})
    (tmp_path / "spikes.csv").write_text(spikes())
    assert "in a window" in refused(tmp_path, ramp(), {**said, "rates": {**rates, "windows_s": [[7.0, 8.0]]}})
    assert "rise" in refused(tmp_path, ramp(), {**said, "rates": {**rates, "windows_s": [[1.0, 0.5]]}})
