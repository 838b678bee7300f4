"""The door for measured tables: what keeps to the contract loads, what does not is refused in words."""

from __future__ import annotations

import dataclasses
import math
import os
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from fingerjax.csvfile import read_table
from fingerjax.errors import InputError
from fingerjax.forward.rigs import indenter_from
from fingerjax.indenter_spec import SHAPES, IndenterSpec, read_indenter
from fingerjax.measurements import Receptor, Site, read_measurement

DATA = Path(os.environ.get("FINGERJAX_DATA") or Path(__file__).parents[1].parent / "shared" / "data")
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"no measured data in {DATA}; set FINGERJAX_DATA")

FORCE = {"kind": "force_displacement", "indenter": {"shape": "sphere", "radius_mm": 3.0}}
PROFILE = {"kind": "deflection_profile", "indenter": {"shape": "line"}}
RATE = {
    "kind": "spike_rate",
    "indenter": {"shape": "bar", "width_mm": 3.0},
    "receptor": {"depth_mm": 0.75, "z_mm": 8.0, "theta_deg": 270},
}
FORCE_CSV = "displacement_mm,force_N\n0.5,0.1\n1.0,0.3\n"
PROFILE_CSV = "depth_mm,distance_mm,deflection_mm\n0.5,-1,0.2\n0.5,0,0.5\n"
RATE_CSV = "position_mm,depth_mm,rate_Hz\n-1,1,20\n0,1,35\n"


def read(folder, csv, said, **more):
    file = folder / "trial.csv"
    file.write_text(csv, encoding="utf-8")
    return read_measurement(file, said, **more)


def refused(folder, csv, said):
    with pytest.raises(InputError) as refusal:
        read(folder, csv, said)
    assert "trial" in str(refusal.value)  # every refusal names its file
    return str(refusal.value)


# ---- what loads
# -----------------------------------------------------------------------------------------------------


def test_units_are_internal_afterwards(tmp_path):
    csv = "displacement_um,force_gf,sigma_mN,time_ms,subject,trial\n500,10,2,250,MK1,1\n1000,30,2,500,MK1,2\n"
    one = read(tmp_path, csv, FORCE)
    np.testing.assert_allclose(one.table["displacement"], [0.5, 1.0], rtol=1e-15)
    np.testing.assert_allclose(one.measured, [0.0980665, 0.2941995], rtol=1e-15)
    np.testing.assert_allclose(one.sigma, [0.002, 0.002], rtol=1e-15)
    np.testing.assert_allclose(one.table["time"], [0.25, 0.5], rtol=1e-15)
    assert one.table["sigma"] is one.sigma
    assert one.table["subject"].tolist() == ["MK1", "MK1"] and one.replicates == 2
    assert (one.value, one.unit, one.imposed, one.controlled, len(one)) == (
        "force",
        "N",
        "displacement",
        "displacement",
        2,
    )
    assert one.rows.tolist() == [2, 3] and one.name == "trial"


def test_controlled_force_measures_displacement(tmp_path):
    one = read(tmp_path, FORCE_CSV, {**FORCE, "controlled": "force"})
    assert (one.value, one.imposed, one.unit, one.sigma) == ("displacement", "force", "mm", None)


def test_profile_and_its_frame(tmp_path):
    said = {
        **PROFILE,
        "direction": "x",
        "site": {"z_mm": 9.0, "theta_deg": -90},
        "noise": {"sigma": 20, "unit": "um"},
    }
    one = read(tmp_path, PROFILE_CSV, said)
    assert one.site is not None and (one.site.z, one.site.theta) == (9.0, pytest.approx(1.5 * math.pi))
    assert one.indenters == {"": IndenterSpec("line", {"width": 0.05}, "z")}
    np.testing.assert_allclose(one.sigma, [0.02, 0.02], rtol=1e-15)
    assert one.direction == "x" and one.receptor is None and one.replicates == 1


def test_no_site_stays_unsaid(tmp_path):
    assert read(tmp_path, PROFILE_CSV, PROFILE).site is None


def test_rates_by_depth_and_by_force(tmp_path):
    one = read(tmp_path, RATE_CSV, RATE)
    assert dataclasses.astuple(one.receptor) == ("SA-I", 0.75, 8.0, pytest.approx(1.5 * math.pi))
    assert dataclasses.astuple(one.site) == (8.0, pytest.approx(1.5 * math.pi))
    assert (one.controlled, one.value, one.unit) == ("displacement", "rate", "Hz")
    pressed = read(tmp_path, RATE_CSV.replace("depth_mm", "force_gf"), RATE)
    assert (pressed.controlled, pressed.imposed) == ("force", "force")
    assert pressed.table["force"][0] == pytest.approx(9.80665e-3)


def test_receptor_of_the_study_serves_where_the_file_has_none(tmp_path):
    said = {key: value for key, value in RATE.items() if key != "receptor"}
    ending = Receptor("SA-I", 0.9, 7.0, 4.7)
    one = read(tmp_path, RATE_CSV, said, receptor=ending)
    assert one.receptor == ending and one.site == Site(7.0, 4.7)
    assert read(tmp_path, RATE_CSV, RATE, receptor=ending).receptor.depth == 0.75


def test_several_stimuli(tmp_path):
    csv = "position_mm,depth_mm,rate_Hz,shape\n0,1,20,flat\n0,1,35,edge\n"
    stimuli = {
        "flat": {"shape": "flat_plate"},
        "edge": {"shape": "step", "amplitude_mm": 0.5, "wavelength_mm": 2},
    }
    one = read(tmp_path, csv, {**RATE, "columns": {"stimulus": "shape"}, "indenter": {"stimuli": stimuli}})
    assert one.table["stimulus"].tolist() == ["flat", "edge"]
    assert one.indenters["edge"] == IndenterSpec("step", {"amplitude": 0.5, "wavelength": 2.0}, "x")


def test_columns_where_drop_and_units(tmp_path):
    csv = "probe,bad,F,travel\npoint,0,10,0.5\nplate,0,99,0.5\npoint,1.0,x,1.0\npoint,2,30,1.5\n"
    said = {
        **FORCE,
        "columns": {"force": "F", "displacement_mm": "travel"},
        "units": {"F": "gf"},
        "where": {"probe": ["point"]},
        "drop": [{"bad": 1}, {"bad": 2, "probe": "plate"}],
    }
    one = read(tmp_path, csv, said)
    assert one.rows.tolist() == [2, 5]  # the row that is dropped is not judged either
    np.testing.assert_allclose(one.measured, [0.0980665, 0.2941995], rtol=1e-15)


def test_comments_blank_lines_and_a_byte_order_mark(tmp_path):
    csv = "\ufeff# seen on Monday\n displacement_mm , force_N \n\n0.5, 0.1\n# slipped\n1.0,0.3\n"
    assert read(tmp_path, csv, FORCE).rows.tolist() == [4, 6]


def test_sidecar_beside_the_table_and_keys_above_it(tmp_path):
    (tmp_path / "trial.yaml").write_text(
        yaml.safe_dump({**FORCE, "source": "ours", "noise": {"replicates": 4}})
    )
    one = read(tmp_path, FORCE_CSV, {"noise": {"sigma": 1.0, "unit": "gf"}}, name="ball")
    assert (one.name, one.source, one.replicates) == ("ball", "ours", 1)
    np.testing.assert_allclose(one.sigma, 9.80665e-3)


def test_stated_noise_stands_above_the_column(tmp_path):
    csv = "displacement_mm,force_N,sigma_N\n0.5,0.1,0.01\n"
    assert read(tmp_path, csv, {**FORCE, "noise": {"sigma": 0.02, "unit": "N"}}).sigma.tolist() == [0.02]
    assert read(tmp_path, csv, {**FORCE, "noise": {"sigma": "per row"}}).sigma.tolist() == [0.01]
    assert read(tmp_path, csv, FORCE).sigma.tolist() == [0.01]


finite = st.floats(-1e3, 1e3).map(lambda value: round(value, 6))
depths = st.floats(0, 5).map(lambda value: round(value, 6))


@given(st.lists(st.tuples(depths, finite, finite), min_size=1, max_size=20))
@settings(max_examples=40, deadline=None)
def test_what_is_written_is_read(tmp_path_factory, rows):
    lines = [",".join(repr(value) for value in row) for row in rows]
    csv = "depth_mm,distance_mm,deflection_mm\n" + "\n".join(lines) + "\n"
    one = read(tmp_path_factory.mktemp("tables"), csv, PROFILE)
    for column, name in enumerate(("depth", "distance", "deflection")):
        assert one.table[name].tolist() == [row[column] for row in rows]


# ---- what is refused
# ------------------------------------------------------------------------------------------------

REFUSED = {
    "missing column": (
        FORCE,
        "displacement_mm,forse_N\n1,2\n",
        ["no column 'force_N'", "did you mean 'forse_N'"],
    ),
    "text": (
        FORCE,
        "displacement_mm,force_N\n0.5,0.1\n1.0,a lot\n",
        ["row 3", "'force_N'", "not a number", "'a lot'"],
    ),
    "underscore": (FORCE, "displacement_mm,force_N\n0.5,1_0\n", ["row 2", "not a number", "'1_0'"]),
    "nan": (
        FORCE,
        "displacement_mm,force_N\n# c\n0.5,NaN\n",
        ["row 3", "'force_N'", "finite number", "'NaN'", "drop"],
    ),
    "infinite": (FORCE, "displacement_mm,force_N\n0.5,-inf\n", ["row 2", "finite number"]),
    "overflow": (FORCE, "displacement_mm,force_N\n0.5,1e999\n", ["row 2", "1e999"]),
    "empty cell": (FORCE, "displacement_mm,force_N\n0.5,\n", ["row 2", "a number is missing"]),
    "negative depth": (
        PROFILE,
        PROFILE_CSV + "-0.5,0,0\n",
        ["row 4", "'depth_mm'", "negative depth", "'-0.5'", "drop"],
    ),
    "negative travel": (FORCE, FORCE_CSV + "-1,0\n", ["row 4", "negative displacement", "first contact"]),
    "zero sigma": (
        FORCE,
        "displacement_mm,force_N,sigma_N\n1,1,0\n",
        ["row 2", "'sigma_N'", "not positive", "'0'"],
    ),
    "negative sigma": (FORCE, "displacement_mm,force_N,sigma_N\n1,1,-2\n", ["row 2", "not positive", "'-2'"]),
    "sigma of a length": (
        FORCE,
        "displacement_mm,force_N,sigma_mm\n1,1,1\n",
        ["'sigma_mm'", "force", "'mm'", "gf"],
    ),
    "unit nonsense": (FORCE, "displacement_mm,force_stone\n1,1\n", ["'force_stone'", "'stone'", "N, mN"]),
    "no unit": (FORCE, "displacement_mm,force\n1,1\n", ["'force' has no unit", "units:", "N, mN"]),
    "wrong unit": (FORCE, "displacement_N,force_N\n1,1\n", ["'displacement_N'", "length", "mm"]),
    "two forces": (
        FORCE,
        "displacement_mm,force_N,force_gf\n1,1,1\n",
        ["more than one column of force", "columns:"],
    ),
    "neither": (
        RATE,
        "position_mm,rate_Hz\n0,1\n",
        ["exactly one", "depth_mm, force_N or force_gf", "add the depth"],
    ),
    "both": (RATE, "position_mm,rate_Hz,depth_mm,force_N\n0,1,1,1\n", ["exactly one", "depth_mm', 'force_N"]),
    "nothing": (FORCE, "", ["is empty"]),
    "only comments": (FORCE, "# soon\n\n", ["is empty"]),
    "no rows": (FORCE, "displacement_mm,force_N\n", ["no rows"]),
    "decimal comma": (
        FORCE,
        "displacement_mm,force_N\n0,5,0,1\n",
        ["row 2", "4 cells where the header has 2"],
    ),
    "semicolons": (FORCE, "displacement_mm;force_N\n1;1\n", ["not separated by commas"]),
    "twice": (FORCE, "force_N,force_N\n1,1\n", ["two columns have one name", "'force_N'"]),
    "nameless": (FORCE, "force_N,\n1,1\n", ["column 2", "no name"]),
    "several names": (
        RATE,
        "position_mm,depth_mm,rate_Hz,stimulus\n0,1,1,a\n0,1,1,b\n",
        ["one indenter", "stimuli"],
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_table_refused(tmp_path, case):
    said, csv, words = REFUSED[case]
    message = refused(tmp_path, csv, said)
    assert "trial.csv" in message
    for word in words:
        assert word in message


WRONG_KEYS = {
    "kind": (
        {"kind": "force_displacment"},
        ["kind", "'force_displacment'", "did you mean 'force_displacement'"],
    ),
    "key": ({"controled": "force"}, ["controled", "unknown key", "did you mean 'controlled'"]),
    "controlled": ({"controlled": "Force"}, ["controlled", "did you mean 'force'"]),
    "direction": ({"direction": "y"}, ["direction", "'y'", "x, z"]),
    "shape": ({"indenter": {"shape": "spere"}}, ["indenter.shape", "'spere'", "did you mean 'sphere'"]),
    "no shape": ({"indenter": {"radius_mm": 3}}, ["no shape", "flat_plate"]),
    "no indenter": ({"indenter": None}, ["nothing says what the indenter is"]),
    "no radius": ({"indenter": {"shape": "sphere"}}, ["indenter.radius_mm", "'sphere' needs this dimension"]),
    "negative": ({"indenter": {"shape": "sphere", "radius_mm": -3}}, ["indenter.radius_mm", "-3", "above 0"]),
    "zero": ({"indenter": {"shape": "bar", "width_mm": 0}}, ["indenter.width_mm", "above 0"]),
    "text": (
        {"indenter": {"shape": "sphere", "radius_mm": "3 mm"}},
        ["indenter.radius_mm", "not a number", "3 mm"],
    ),
    "dimension": (
        {"indenter": {"shape": "sphere", "radios_mm": 3}},
        ["radios_mm", "did you mean 'radius_mm'"],
    ),
    "other shape's": (
        {"indenter": {"shape": "flat_plate", "radius_mm": 3}},
        ["'flat_plate'", "unknown key", "shape"],
    ),
    "length in newton": ({"indenter": {"shape": "sphere", "radius_N": 3}}, ["radius_N", "length", "'N'"]),
    "bare length": ({"indenter": {"shape": "sphere", "radius": 3}}, ["'radius' has no unit", "radius_mm"]),
    "edge": (
        {"indenter": {"shape": "bar", "width_mm": 1, "edge_radius_mm": 0.6}},
        ["larger than the shape", "0.5 mm"],
    ),
    "axis": (
        {"indenter": {"shape": "line", "along": "the thumb"}},
        ["indenter.along", "unknown axis", "the thumb"],
    ),
    "two axes": ({"indenter": {"shape": "line", "along": "z", "across": "finger"}}, ["along two axes"]),
    "grating": (
        {"indenter": {"shape": "grating", "ridge_mm": [3, 1], "groove_mm": [1, 1]}},
        ["2 ridges, 2 grooves", "one groove fewer"],
    ),
    "no heights": ({"indenter": {"shape": "profile"}}, ["indenter.data", "height_mm against position_mm"]),
    "stimuli": ({"indenter": {"stimuli": {"a": {"shape": "line"}}}}, ["no column stimulus", "columns:"]),
    "beside stimuli": (
        {"indenter": {"stimuli": {}, "shape": "line"}},
        ["indenter.shape", "beside `stimuli`"],
    ),
    "site": ({"site": {"z_mm": 3}}, ["site.theta_deg", "missing"]),
    "site key": ({"site": {"z": 3, "theta_deg": 1}}, ["site.z", "unknown key", "did you mean 'z_mm'"]),
    "sigma": ({"noise": {"sigma": -1, "unit": "N"}}, ["noise.sigma", "not positive", "-1"]),
    "sigma's unit": ({"noise": {"sigma": 1}}, ["noise.sigma", "without a unit", "unit: N"]),
    "sigma's dimension": ({"noise": {"sigma": 1, "unit": "mm"}}, ["noise", "'mm'", "N, mN"]),
    "sigma's words": ({"noise": {"sigma": "small"}}, ["noise.sigma", "'small'", "per row"]),
    "sigma's column": ({"noise": {"sigma": "per row"}}, ["no column 'sigma_N'"]),
    "replicates": ({"noise": {"replicates": 0}}, ["noise.replicates", "greater than or equal to 1"]),
    "truth value": ({"noise": {"sigma": True}}, ["noise.sigma"]),
    "our column": ({"columns": {"forse_N": "force_N"}}, ["columns.forse_N", "did you mean 'force'"]),
    "their column": ({"columns": {"force_N": "F"}}, ["no column 'F'", "displacement_mm, force_N"]),
    "where column": ({"where": {"probe": 1}}, ["no column 'probe'"]),
    "where value": ({"where": {"displacement_mm": 0.7}}, ["'displacement_mm'", "0.7", "0.5"]),
    "drop column": ({"drop": {"midpoint": 1}}, ["no column 'midpoint'"]),
    "all dropped": ({"drop": [{"force_N": [0.1, 0.3]}]}, ["no row of the table is left", "drop"]),
    "unit of nothing": (
        {"units": {"forse": "N"}},
        ["units.forse", "a unit of no column", "did you mean 'force'"],
    ),
    "two units": ({"units": {"force_N": "gf"}}, ["'force_N' has two units", "gf"]),
}


@pytest.mark.parametrize("case", WRONG_KEYS)
def test_keys_refused(tmp_path, case):
    change, words = WRONG_KEYS[case]
    message = refused(tmp_path, FORCE_CSV, {**FORCE, **change})
    for word in words:
        assert word in message


def test_profile_cannot_be_controlled_by_force(tmp_path):
    message = refused(tmp_path, PROFILE_CSV, {**PROFILE, "controlled": "force"})
    assert "deflection_profile with a column of depth" in message and "controlled: displacement" in message


def test_rates_need_a_receptor(tmp_path):
    message = refused(tmp_path, RATE_CSV, {key: value for key, value in RATE.items() if key != "receptor"})
    assert "where the receptor is" in message and "receptor: {depth_mm" in message


def test_unknown_stimulus(tmp_path):
    csv = "position_mm,depth_mm,rate_Hz,stimulus\n0,1,20,bar\n0,1,35,barr\n"
    message = refused(tmp_path, csv, {**RATE, "indenter": {"stimuli": {"bar": {"shape": "line"}}}})
    assert "row 3, column 'stimulus'" in message and "'barr'" in message and "did you mean 'bar'" in message


def test_no_sidecar(tmp_path):
    message = refused(tmp_path, FORCE_CSV, {})
    assert "what kind of measurement" in message and "trial.yaml" in message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "kind: force_displacement\nindenter:\n  shape: sphere\n  radius_mm: -1\n",
            ["indenter.radius_mm (line 4)", "-1"],
        ),
        ("kind: force_displacement\nkinds: 1\n", ["kinds (line 2)", "did you mean 'kind'"]),
        ("kind: spike_rate\nkind: force_displacement\n", ["kind (line 2)", "written twice", "line 1"]),
        ("kind: [\n", ["not plain YAML", "line 2"]),
        ("kind: !!python/object:os.system x\n", ["not plain YAML", "line 1"]),
        ("- kind\n", ["holds no keys"]),
    ],
)
def test_sidecar_refused_with_its_line(tmp_path, text, words):
    (tmp_path / "trial.yaml").write_text(text)
    message = refused(tmp_path, FORCE_CSV, None)
    for word in ["trial.yaml", *words]:
        assert word in message


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match="none.csv: no such file"):
        read_measurement(tmp_path / "none.csv", FORCE)
    with pytest.raises(InputError, match="this is a folder"):
        read_table(tmp_path)
    (tmp_path / "latin.csv").write_bytes(b"displacement_\xb5m\n1\n")
    with pytest.raises(InputError, match="latin.csv: byte 13 is not UTF-8"):
        read_table(tmp_path / "latin.csv")
    with pytest.raises(InputError, match="a sidecar, not a table"):
        read_measurement(tmp_path / "trial.yaml")


# ---- indenters
# ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [name for name in SHAPES if name != "profile"])
@given(size=st.floats(0.1, 10.0))
@settings(deadline=None)
def test_every_shape_has_its_dimensions(shape, size):
    wanted = SHAPES[shape]
    spec = read_indenter({"shape": shape, **{f"{name}_mm": size for name in (*wanted.needed, *wanted.lists)}})
    assert spec.dimensions == {**wanted.optional, **dict.fromkeys((*wanted.needed, *wanted.lists), size)}
    assert spec.along == ("x" if wanted.lies_along else "")


@pytest.mark.parametrize(
    ("said", "along"),
    [
        ({"across": "the wedge lies across the finger (along x)"}, "x"),
        ({"across": "finger"}, "x"),
        ({"across": "z"}, "x"),
        ({"across": "x"}, "z"),
        ({"along": "z"}, "z"),
        ({"axis": "x", "along": "x"}, "x"),
        ({"along": "it lies along z"}, "z"),
        ({}, "x"),
    ],
)
def test_axis(said, along):
    assert read_indenter({"shape": "line", **said}).along == along


def test_grating_by_list():
    spec = read_indenter(
        {"shape": "grating", "ridge_mm": [3, 0.5], "groove_um": [500], "edge_radius_mm": 0.1}
    )
    assert spec == IndenterSpec("grating", {"edge_radius": 0.1}, "x", {"ridge": (3.0, 0.5), "groove": (0.5,)})


def test_profile_reads_its_heights(tmp_path):
    (tmp_path / "ramp.csv").write_text("position_mm,height_um\n-1,0\n0,-250\n2,-500\n")
    spec = read_indenter({"shape": "profile", "data": "ramp.csv"}, direction="x", folder=tmp_path)
    assert spec.along == "z" and spec.lists == {"position": (-1.0, 0.0, 2.0), "height": (0.0, -0.25, -0.5)}
    (tmp_path / "ramp.csv").write_text("position_mm,height_um\n-1,0\n0,-250\n0,-500\n")
    with pytest.raises(InputError, match="ramp.csv, row 4: positions do not rise"):
        read_indenter({"shape": "profile", "data": "ramp.csv"}, folder=tmp_path)


# ---- measured data, where it is there
# -------------------------------------------------------------------------------


@needs_data
@pytest.mark.parametrize("case", ["plain", "nail_bed", "stiffening"])
def test_practice_files_load(case):
    files = [file for file in sorted((DATA / "practice" / case).glob("*.csv")) if file.stem != "sections"]
    assert len(files) == 3
    for file in files:
        one = read_measurement(file)
        lines = [line for line in file.read_text().splitlines() if line and not line.startswith("#")]
        assert len(one) == len(lines) - 1 and one.replicates == 3
        assert one.sigma is not None and (one.sigma > 0).all() and one.site is not None
        assert np.isfinite(one.measured).all() and one.rows[0] == 2


PUBLISHED_PROFILES = {
    "kind": "deflection_profile",
    "indenter": {"shape": "cylinder", "radius_mm": 1.585},
    "columns": {"depth_mm": "depth_mm", "distance_mm": "x_mm", "deflection_mm": "deflection_mm"},
    "drop": {"midpoint": 1},
    "where": {"cylinder_diameter_mm": 3.17},
    "noise": {"sigma": 0.05, "unit": "mm"},
}


@needs_data
def test_published_profiles_load_without_a_sidecar():
    one = read_measurement(DATA / "human-fingertip-surface-profile" / "profiles.csv", PUBLISHED_PROFILES)
    raw = read_table(DATA / "human-fingertip-surface-profile" / "profiles.csv")
    kept = (raw.numbers("midpoint") == 0) & (raw.numbers("cylinder_diameter_mm") == 3.17)
    np.testing.assert_array_equal(one.table["distance"], raw.numbers("x_mm")[kept])
    assert len(one) == 92 and one.sigma[0] == 0.05
    assert set(one.table["depth"]) == set(raw.numbers("depth_mm")[kept]) and len(set(one.table["depth"])) == 4


@needs_data
def test_published_forces_load_without_a_sidecar():
    said = {
        "kind": "force_displacement",
        "columns": {
            "displacement_mm": "depth_mm",
            "force_N": "force_N",
            "sigma_N": "force_read_error_N",
            "subject": "subject",
        },
        "where": {"indenter": "point"},
        "indenter": {"shape": "point", "radius_mm": 0.25},
    }
    one = read_measurement(DATA / "human-fingerpad-force-depth" / "force_depth.csv", said)
    assert set(one.table["subject"]) == {"1", "3"} and (one.sigma > 0).all()


def test_a_grating_may_say_its_period():
    spec = read_indenter({"shape": "grating", "ridge_mm": 1, "period_mm": 3})
    assert spec.dimensions["groove"] == 2.0
    with pytest.raises(InputError, match="as wide as its period"):
        read_indenter({"shape": "grating", "ridge_mm": 3, "period_mm": 3})
    with pytest.raises(InputError, match="say the same"):
        read_indenter({"shape": "grating", "ridge_mm": 1, "period_mm": 3, "groove_mm": 2})


def test_shapes_with_lists_become_indenters(tmp_path):
    (tmp_path / "ramp.csv").write_text("position_mm,height_mm\n-1,0\n0,0.2\n1,-0.1\n")
    ramp = indenter_from(read_indenter({"shape": "profile", "data": "ramp.csv"}, folder=tmp_path))
    assert float(ramp.height(0.0, 1.0)) == pytest.approx(-0.3)
    ridges = indenter_from(read_indenter({"shape": "grating", "ridge_mm": [1, 2], "groove_mm": [0.5]}))
    assert bool(ridges.covers(0.0, 2.9)) and not bool(ridges.covers(0.0, 0.7))


@pytest.mark.parametrize(
    ("said", "positions"),
    [("x_mm", [-1.0, 1.25]), ("-x_mm", [1.0, -1.25]), ("3.5 - x_mm", [4.5, 2.25]), ("x_mm - 3.5", [-4.5, -2.25]), ("1-x_mm", [2.0, -0.25])],
)
def test_a_column_may_be_counted_the_other_way_and_from_elsewhere(tmp_path, said, positions):
    (tmp_path / "rates.csv").write_text("x_mm,rate_ips\n-1,3\n+1.25,4\n")
    study = {"kind": "spike_rate", "indenter": "flat_plate", "columns": {"position_mm": said}, "every": {"depth_um": 800}}
    study["receptor"] = {"depth_mm": 0.75, "z_mm": 8, "theta_deg": 270}
    assert read_measurement(tmp_path / "rates.csv", study).table["position"].tolist() == positions
    with pytest.raises(InputError, match="no column"):
        read_measurement(tmp_path / "rates.csv", {**study, "columns": {"position_mm": said.replace("x_mm", "z_mm")}})


def test_what_holds_for_every_row_is_said_once(tmp_path):
    (tmp_path / "rates.csv").write_text("x_mm,rate_ips\n-1,3\n1,4\n")
    said = {"kind": "spike_rate", "indenter": "flat_plate", "columns": {"position_mm": "x_mm"}, "every": {"depth_um": 800}}
    said["receptor"] = {"depth_mm": 0.75, "z_mm": 8, "theta_deg": 270}
    assert read_measurement(tmp_path / "rates.csv", said).table["depth"].tolist() == [0.8, 0.8]
    for every, word in (({"deepness_mm": 1}, "not one of our columns"), ({"x_mm": 1}, "not one of our columns")):
        with pytest.raises(InputError, match=word):
            read_measurement(tmp_path / "rates.csv", {**said, "every": every})
    with pytest.raises(InputError, match="the table has this column itself"):
        read_measurement(tmp_path / "rates.csv", {**said, "every": {"depth_mm": 1, "rate_ips": 2}})
