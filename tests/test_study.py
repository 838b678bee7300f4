"""The door for studies: what DATA.md shows loads, and every wrong name is refused with its line and the
nearest right one.
"""

from __future__ import annotations

import math
import os
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from fingerjax.errors import InputError
from fingerjax.indenter_spec import IndenterSpec
from fingerjax.study import ForceTable, HeldOut, LayerStudy, Prior, load_studies
from fingerjax.study_keys import ratio_decades, ratio_moduli
from fingerjax.study_records import Reach

DATA = Path(os.environ.get("FINGERJAX_DATA") or Path(__file__).parents[1].parent / "shared" / "data")
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"no measured data in {DATA}; set FINGERJAX_DATA")

STUDY = """\
version: 1
finger:
  sections: sections.csv
  nail: {z_mm: [9.0, 15.0], theta_deg: [50, 130]}
model:
  moduli_MPa: {epidermis: 0.18, dermis: 0.018, adipose: 0.02, fibrous: 0.03}
  receptor: {depth_mm: 0.75, z_mm: 12.0, theta_deg: 270}
measurements:
  - {name: plate, data: plate.csv}
  - {name: bar, data: bar.csv}
fit:
  free: [epidermis.modulus, dermis.modulus, adipose.modulus]
  tie: [[dermis.modulus, adipose.modulus]]
  per: {epidermis.modulus: subject}
  priors: {epidermis.modulus: {value_kPa: 180, relative_sd: 0.04}}
diagnose:
  effects: [contact_offset]
  hold_out: [{measurement: plate, where: {displacement_mm: [1.0]}}]
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "sections.csv").write_text("z_mm,theta_deg\n")
    (tmp_path / "plate.csv").write_text("subject,displacement_mm,force_gf\nA,0.5,5\nA,1.0,12\nB,0.5,4\n")
    (tmp_path / "plate.yaml").write_text("kind: force_displacement\nindenter: {shape: flat_plate}\n")
    (tmp_path / "bar.csv").write_text("position_mm,depth_mm,rate_Hz\n0,1,40\n1,1,70\n")
    (tmp_path / "bar.yaml").write_text("kind: spike_rate\nindenter: {shape: bar, width_mm: 3}\n")
    return tmp_path


def load(folder, text, **more):
    (folder / "study.yaml").write_text(text)
    return load_studies(folder / "study.yaml", **more)


def test_a_study_says_how_far_a_diagnosis_goes(folder):
    said = next(iter(load(folder, STUDY).values())).diagnose
    assert (said.nodes, said.reach) == (10_000, Reach(3, 4))
    said = next(iter(load(folder, STUDY + "  nodes: 5000\n  pairs: 1\n  together: 2\n").values())).diagnose
    assert (said.nodes, said.reach) == (5000, Reach(pairs=1, together=2))
    with pytest.raises(InputError, match="nodes"):
        load(folder, STUDY + "  nodes: 10\n")


def test_effects_may_differ_between_labels_that_every_row_has(folder):
    said = next(iter(load(folder, STUDY + "  per: {contact_offset: measurement}\n").values())).diagnose
    assert said.per == {"contact_offset": "measurement"}
    with pytest.raises(InputError, match=r"diagnose\.per\.contact_offset.*subjet.*subject"):
        load(folder, STUDY + "  per: {contact_offset: subjet}\n")
    with pytest.raises(InputError, match="rows of .* do not say their stimulus"):
        load(folder, STUDY + "  per: {contact_offset: stimulus}\n")


def one(folder, old="", new="", **more):
    assert old in STUDY
    return load(folder, STUDY.replace(old, new, 1), **more)["study"]


def refused(folder, old, new):
    with pytest.raises(InputError) as refusal:
        one(folder, old, new)
    assert "study.yaml" in str(refusal.value)
    return str(refusal.value)


# ---- what loads
# -----------------------------------------------------------------------------------------------------


def test_a_study(folder):
    study = one(folder)
    assert (study.name, study.kind, study.sections) == ("study", "fit", folder / "sections.csv")
    assert study.finger.nail.z == (9.0, 15.0)
    assert study.finger.nail.theta == pytest.approx((math.radians(50), math.radians(130)))
    assert (study.finger.resolution.pad_mm, study.finger.resolution.proximal_mm) == (0.5, 2.0)
    assert study.model.bone_modulus() is None and study.model.poisson_ratios()["fibrous"] == 0.48
    assert study.measurement("bar").receptor == study.receptor
    assert study.fit.free[-2:] == ("bar.scale", "bar.threshold")
    assert study.fit.tie == (("dermis.modulus", "adipose.modulus"),) and study.fit.per == {
        "epidermis.modulus": "subject"
    }
    prior = study.fit.priors["epidermis.modulus"]
    assert (prior.value, prior.sd, prior.relative_sd) == pytest.approx((0.18, 0.0072, 0.04))
    assert study.diagnose.effects == ("contact_offset",)
    assert study.diagnose.hold_out == (HeldOut("plate", {"displacement": (1.0,)}),)
    assert study.missing_data == () and study.fallback is None and study.options is None


def test_parameters(folder):
    by_name = {parameter.name: parameter for parameter in one(folder).parameters()}
    layers = ["epidermis", "dermis", "adipose", "fibrous"]
    assert list(by_name) == [
        *(f"{layer}.modulus" for layer in layers),
        "stiffness",
        "poisson_ratio",
        "bar.scale",
        "bar.threshold",
    ]
    assert (by_name["fibrous.modulus"].value, by_name["fibrous.modulus"].unit) == (0.03, "MPa")
    assert by_name["bar.scale"].unit == "Hz/MPa" and by_name["bar.threshold"].unit == "MPa"
    assert by_name["poisson_ratio"].link == "logit"
    assert {name for name, one_of in by_name.items() if one_of.link == "log"} == set(by_name) - {
        "poisson_ratio"
    }
    assert all(parameter.at_limit(parameter.value) is None for parameter in by_name.values())


@pytest.mark.parametrize(
    ("said", "modulus"),
    [("rigid", None), ("1800", 1800.0), ("1e8", 1e8), ("17 GPa", 17000.0)],
)
def test_bone(folder, said, modulus):
    study = one(folder, "model:\n", f"model:\n  bone: {said}\n")
    assert study.model.bone_modulus() == modulus
    assert ("bone.modulus" in [parameter.name for parameter in study.parameters()]) == (modulus is not None)


@pytest.mark.parametrize(
    "said", ["[0.4, 0.45, 0.48, 0.49]", "{epidermis: 0.4, dermis: 0.45, adipose: 0.48, fibrous: 0.49}"]
)
def test_poisson_ratio_per_layer(folder, said):
    study = one(folder, "model:\n", f"model:\n  poisson_ratio: {said}\n")
    assert list(study.model.poisson_ratios().values()) == [0.4, 0.45, 0.48, 0.49, 0.48]
    names = [parameter.name for parameter in study.parameters()]
    assert (
        "dermis.poisson_ratio" in names and "poisson_ratio" not in names and "bone.poisson_ratio" not in names
    )


MODULI = "moduli_MPa: {epidermis: 0.18, dermis: 0.018, adipose: 0.02, fibrous: 0.03}"


def test_ratios(folder):
    model = one(folder, MODULI, "ratios: m43338").model
    assert list(model.moduli().values()) == pytest.approx([0.18, 0.018, 0.018, 0.018])
    assert model.bone_modulus() is None
    model = one(folder, MODULI, "ratios: m33333\n  epidermis_MPa: 0.05").model
    assert list(model.moduli().values()) == pytest.approx([0.05] * 5)
    assert one(folder, MODULI, "ratios: m33333\n  bone: rigid").model.bone_modulus() is None


@given(st.from_regex(r"m[0-9]{5}", fullmatch=True), st.floats(1e-3, 1e3))
@settings(deadline=None)
def test_ratio_names(name, epidermis):
    moduli = ratio_moduli(name, epidermis)
    assert moduli["epidermis"] == epidermis
    for layer, decade in ratio_decades(name).items():
        assert math.log10(moduli[layer] / epidermis) == pytest.approx(decade - int(name[1]), abs=1e-9)


@pytest.mark.parametrize("name", ["43338", "m4333", "m433380", "m4333x", "M43338", None])
def test_ratio_names_refused(name):
    with pytest.raises(InputError, match="not the name of a ratio model.*m43338"):
        ratio_decades(name)


def test_entry_stands_above_the_sidecar(folder):
    study = one(folder, "data: plate.csv}", "data: plate.csv, indenter: {shape: sphere, radius_mm: 3}}")
    assert study.measurement("plate").indenters == {"": IndenterSpec("sphere", {"radius": 3.0})}


def test_several_studies(folder):
    body = yaml.safe_load(STUDY)
    studies = load(
        folder, yaml.safe_dump({"version": 1, "studies": {"a": body, "b": {**body, "fallback": "a"}}})
    )
    assert list(studies) == ["a", "b"] and studies["b"].fallback == "a" and studies["a"].name == "a"


def test_missing_data_is_listed_and_found(folder, monkeypatch):
    monkeypatch.delenv("FINGERJAX_DATA", raising=False)
    text = STUDY.replace("data: bar.csv", "data: 'data:monkey/bar.csv', kind: spike_rate")
    study = load(folder, text)["study"]
    assert study.missing_data == ("monkey/bar.csv",) and [m.name for m in study.measurements] == ["plate"]
    shared = folder / "shared" / "monkey"
    shared.mkdir(parents=True)
    (folder / "bar.csv").rename(shared / "bar.csv")
    (folder / "bar.yaml").rename(shared / "bar.yaml")
    assert load(folder, text, data=folder / "elsewhere")["study"].missing_data == ("monkey/bar.csv",)
    assert load(folder, text, data=folder / "shared")["study"].measurement("bar").receptor.z == 12.0
    monkeypatch.setenv("FINGERJAX_DATA", str(folder / "shared"))
    assert load(folder, text)["study"].missing_data == ()


def test_names_of_a_missing_file_may_be_freed(folder, monkeypatch):
    monkeypatch.delenv("FINGERJAX_DATA", raising=False)
    text = STUDY.replace("data: bar.csv", "data: 'data:bar.csv'").replace(
        "adipose.modulus]\n", "adipose.modulus, bar.scale]\n"
    )
    assert "bar.scale" in load(folder, text)["study"].fit.free


TABLE = """\
kind: table
finger: {preset: human}
model: {ratios: m43338}
options:
  indenters: {point: {shape: point, radius_mm: 0.25}, flat_plate: flat_plate}
  rows:
    - {indenter: point, subject: 1, displacement_mm: 1.0, force_gf: 5.29, epidermis_modulus_MPa: 0.28}
    - {indenter: flat_plate, subject: 1, displacement_mm: 1.0, force_gf: 23.59, epidermis_modulus_MPa: 0.21}
"""


def test_table(folder):
    study = load(folder, TABLE)["study"]
    assert isinstance(study.options, ForceTable) and study.finger.nail is None and study.fit.free == ()
    row = study.options.rows[0]
    assert (row.indenter, row.subject, row.displacement, row.modulus) == ("point", "1", 1.0, 0.28)
    assert row.force == pytest.approx(5.29 * 9.80665e-3)
    assert study.options.indenters["flat_plate"] == IndenterSpec("flat_plate")


def test_table_from_a_file(folder):
    (folder / "forces.csv").write_text("indenter,subject,force_gf,displacement_mm\npoint,A,5,0.6\n")
    head = TABLE.partition("  rows:")[0]
    study = load(folder, head + "  data: forces.csv\n  controlled: force\n")["study"]
    assert study.options.controlled == "force" and study.options.rows[0].modulus is None
    lost = load(folder, head + "  data: 'data:forces.csv'\n", data=folder / "none")["study"]
    assert lost.options is None and lost.missing_data == ("forces.csv",)


LAYERS = """\
kind: layer_study
finger: {preset: monkey}
model: {ratios: m43338}
options: {models: [m43338, m33338, m53338], depth_mm: 1.0}
"""


def test_layer_study(folder):
    line = IndenterSpec("line", {"width": 0.05}, "x")
    expected = LayerStudy(("m43338", "m33338", "m53338"), 1.0, line, 5.0, 0.25)
    assert load(folder, LAYERS)["study"].options == expected


def test_predict_needs_no_fit(folder):
    text = "kind: predict\n" + STUDY.partition("fit:")[0]
    assert load(folder, text)["study"].diagnose is None


# ---- what is refused
# ------------------------------------------------------------------------------------------------

REFUSED = {
    "key": ("model:", "modl:", ["modl (line 5)", "unknown key", "did you mean 'model'"]),
    "inner key": ("  moduli_MPa", "  moduli_kPa", ["model.moduli_kPa (line 6)", "did you mean 'moduli_MPa'"]),
    "twice": ("version: 1\n", "version: 1\nversion: 1\n", ["version (line 2)", "written twice"]),
    "version": ("version: 1", "version: 2", ["version (line 1)", "unknown version", "reads version 1"]),
    "no finger": ("finger:", "finger: {preset: human}\nnotes:", ["notes (line 3)"]),
    "two geometries": (
        "  sections:",
        "  preset: human\n  sections:",
        ["finger (line 2)", "exactly one", "scan"],
    ),
    "preset": (
        "  sections: sections.csv",
        "  preset: hunan",
        ["finger.preset (line 3)", "did you mean 'human'"],
    ),
    "images": (
        "  sections: sections.csv",
        "  images: views",
        ["finger.images (line 3)", "no such file", "'views'"],
    ),
    "scan": ("  sections: sections.csv", "  scan: finger.stl", ["finger.scan (line 3)", "no such file"]),
    "scan's unit": (
        "  sections: sections.csv",
        "  scan: {file: finger.stl, unit: inch}",
        ["finger.scan.unit (line 3)", "'inch'"],
    ),
    "mesh": ("  sections: sections.csv", "  mesh: finger.msh", ["finger.mesh (line 3)", "no such file"]),
    "layers": (
        "  sections: sections.csv",
        "  sections: sections.csv\n  layers: {epidermis_mm: 0.5}",
        ["finger.layers (line 4)", "layers of its own"],
    ),
    "mesher": (
        "  sections: sections.csv",
        "  sections: sections.csv\n  mesher: colums",
        ["finger.mesher (line 4)", "did you mean 'columns'"],
    ),
    "sections": (
        "sections: sections.csv",
        "sections: s.csv",
        ["finger.sections (line 3)", "no such file", "'s.csv'"],
    ),
    "no nail": (
        "  nail: {z_mm: [9.0, 15.0], theta_deg: [50, 130]}\n",
        "",
        ["finger (line 2)", "nail", "z_mm"],
    ),
    "nail": ("z_mm: [9.0, 15.0]", "z_mm: [15.0, 9.0]", ["finger.nail.z_mm (line 4)", "does not rise"]),
    "nail ends": ("z_mm: [9.0, 15.0]", "z_mm: [9.0]", ["finger.nail.z_mm"]),
    "negative modulus": (
        "epidermis: 0.18",
        "epidermis: -0.18",
        ["model.moduli_MPa.epidermis (line 6)", "-0.18"],
    ),
    "no number": (
        "epidermis: 0.18",
        "epidermis: soft",
        ["model.moduli_MPa.epidermis (line 6)", "valid number", "soft"],
    ),
    "truth value": (
        "epidermis: 0.18",
        "epidermis: yes",
        ["model.moduli_MPa.epidermis (line 6)", "not a number"],
    ),
    "nan": ("epidermis: 0.18", "epidermis: .nan", ["model.moduli_MPa.epidermis (line 6)", "finite"]),
    "layer": ("dermis: 0.018", "demis: 0.018", ["model.moduli_MPa.demis (line 6)", "did you mean 'dermis'"]),
    "bone's place": ("dermis: 0.018", "bone: 0.018", ["model.moduli_MPa.bone", "its own key"]),
    "absent layer": (", fibrous: 0.03", "", ["model.moduli_MPa (line 6)", "'fibrous'"]),
    "two moduli": (
        "model:\n",
        "model:\n  ratios: m43338\n",
        ["model (line 5)", "exactly one of moduli_MPa and ratios"],
    ),
    "ratios": (MODULI, "ratios: m4333", ["model.ratios (line 6)", "m43338"]),
    "bone": ("model:\n", "model:\n  bone: hard\n", ["model.bone (line 6)", "rigid", "'hard'"]),
    "bone's unit": ("model:\n", "model:\n  bone: 3 N\n", ["model.bone (line 6)", "pressure", "MPa"]),
    "bone's sign": ("model:\n", "model:\n  bone: -5\n", ["model.bone (line 6)", "not positive"]),
    "poisson": (
        "model:\n",
        "model:\n  poisson_ratio: 0.5\n",
        ["model.poisson_ratio (line 6)", "0.5", "excluded"],
    ),
    "poissons": (
        "model:\n",
        "model:\n  poisson_ratio: [0.4]\n",
        ["model.poisson_ratio", "do not fit the layers"],
    ),
    "poisson layer": (
        "model:\n",
        "model:\n  poisson_ratio: {skin: 0.4}\n",
        ["model.poisson_ratio.skin", "unknown layer"],
    ),
    "receptor": (
        "depth_mm: 0.75, ",
        "depth_mm: -1, ",
        ["model.receptor.depth_mm (line 7)", "greater than 0"],
    ),
    "no data": (
        "data: plate.csv",
        "data: plat.csv",
        ["measurements.0.data (line 9)", "no such file", "plat.csv"],
    ),
    "entry key": (
        "data: bar.csv",
        "data: bar.csv, dirction: x",
        ["measurements.1.dirction (line 10)", "'direction'"],
    ),
    "entry value": (
        "data: bar.csv",
        "data: bar.csv, direction: y",
        ["measurements.1.direction (line 10)", "x, z"],
    ),
    "same name": (
        "name: bar",
        "name: plate",
        ["measurements (line 8)", "two measurements have one name", "plate"],
    ),
    "name": ("name: bar", "name: my bar", ["measurements.1.name (line 10)", "my bar"]),
    "free layer": (
        "[epidermis.modulus,",
        "[epidermus.modulus,",
        ["fit.free.0 (line 12)", "did you mean 'epidermis.modulus'"],
    ),
    "free bone": (
        "[epidermis.modulus,",
        "[bone.modulus,",
        ["fit.free.0 (line 12)", "unknown parameter", "bone.modulus"],
    ),
    "free twice": ("[epidermis.modulus,", "[dermis.modulus,", ["fit.free.1 (line 12)", "written twice"]),
    "free text": (
        "free: [epidermis.modulus, dermis.modulus, adipose.modulus]",
        "free: all",
        ["fit.free (line 12)", "list"],
    ),
    "tie": (
        "[[dermis.modulus,",
        "[[derms.modulus,",
        ["fit.tie.0.0 (line 13)", "did you mean 'dermis.modulus'"],
    ),
    "tie not free": (
        "[[dermis.modulus,",
        "[[fibrous.modulus,",
        ["fit.tie.0.0 (line 13)", "not free", "fibrous"],
    ),
    "tie of one": (
        "[[dermis.modulus, adipose.modulus]]",
        "[[dermis.modulus]]",
        ["fit.tie.0 (line 13)", "a tie of one"],
    ),
    "tie of two kinds": (
        "[[dermis.modulus, adipose.modulus]]",
        "[[dermis.modulus, bar.scale]]",
        ["different quantities"],
    ),
    "two ties": (
        "[[dermis.modulus, adipose.modulus]]",
        "[[dermis.modulus, adipose.modulus], [epidermis.modulus, dermis.modulus]]",
        ["fit.tie.1 (line 13)", "in two ties", "'dermis.modulus'"],
    ),
    "per": (
        "per: {epidermis",
        "per: {epiderms",
        ["fit.per.epiderms.modulus (line 14)", "did you mean 'epidermis.modulus'"],
    ),
    "per column": (
        ": subject}",
        ": subjct}",
        ["fit.per.epidermis.modulus (line 14)", "did you mean 'subject'"],
    ),
    "prior": ("priors: {epidermis", "priors: {fibrous", ["fit.priors.fibrous.modulus (line 15)", "not free"]),
    "prior unit": ("value_kPa", "value_mm", ["fit.priors.epidermis.modulus (line 15)", "pressure", "MPa"]),
    "prior no unit": ("value_kPa", "value", ["fit.priors.epidermis.modulus", "has no unit", "MPa"]),
    "prior key": (
        "relative_sd",
        "relative_ds",
        ["fit.priors.epidermis.modulus.relative_ds", "did you mean 'relative_sd'"],
    ),
    "prior width": (", relative_sd: 0.04", "", ["a value and one width"]),
    "prior sign": (
        "value_kPa: 180",
        "value_kPa: -180",
        ["fit.priors.epidermis.modulus.value_kPa", "positive"],
    ),
    "effects": ("[contact_offset]", "some", ["diagnose.effects (line 17)", "all, none, or a list"]),
    "held out": (
        "measurement: plate",
        "measurement: plat",
        ["diagnose.hold_out.0.measurement (line 18)", "'plate'"],
    ),
    "held column": (
        "displacement_mm: [1.0]",
        "depth_mm: [1.0]",
        ["depth_mm", "no such column", "displacement_mm"],
    ),
    "held value": ("displacement_mm: [1.0]", "displacement_mm: [2.0]", ["no row has this value", "0.5, 1"]),
    "held unit": ("displacement_mm: [1.0]", "displacement: [1.0]", ["'displacement' has no unit"]),
    "options": ("fit:\n", "options: {depth_mm: 1}\nfit:\n", ["options (line 11)", "kind fit has no options"]),
    "kind": ("version: 1", "kind: fitt", ["kind (line 1)", "did you mean 'fit'"]),
    "fallback": ("version: 1", "fallback: other", ["fallback (line 1)", "no such study", "'other'"]),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(folder, case):
    old, new, words = REFUSED[case]
    message = refused(folder, old, new)
    for word in words:
        assert word in message


def test_nothing_free(folder):
    (folder / "bar.csv").unlink()
    text = STUDY.partition("  - {name: bar")[0]
    with pytest.raises(InputError, match="nothing is free to be fitted.*epidermis.modulus"):
        load(folder, text)


def test_fit_needs_measurements(folder):
    with pytest.raises(InputError, match=r"measurements.*kind fit needs measurements"):
        load(folder, STUDY.partition("measurements:")[0])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["holds no study"]),
        ("studies: {}\n", ["studies (line 1)", "no studies are named"]),
        ("studies: {a: 3}\nfinger: {}\n", ["finger (line 2)", "beside `studies`"]),
        ("studies: {a: 3}\n", ["studies.a (line 1)", "keys and values are needed"]),
        (LAYERS.replace("m53338", "m5333"), ["options.models (line 4)", "m43338"]),
        (LAYERS.replace("depth_mm: 1.0", "depth_mm: 0"), ["options.depth_mm (line 4)", "greater than 0"]),
        (LAYERS.replace("depth_mm", "depht_mm"), ["options.depht_mm (line 4)", "did you mean 'depth_mm'"]),
        (TABLE.replace("indenter: point,", "indenter: pint,"), ["options", "'pint'", "did you mean 'point'"]),
        (TABLE.replace("force_gf: 5.29", "force_gf: -5.29"), ["row 1", "'force_gf'", "not positive"]),
        (TABLE.replace("force_gf: 5.29, ", ""), ["options.rows.row 2", "same keys", "force_gf"]),
        (
            TABLE.replace("shape: point", "shape: pont"),
            ["options.indenters.point.shape (line 5)", "did you mean 'point'"],
        ),
        (TABLE.partition("  rows:")[0], ["options", "rows: or data:"]),
    ],
)
def test_other_files_refused(folder, text, words):
    with pytest.raises(InputError) as refusal:
        load(folder, text)
    for word in ["study.yaml", *words]:
        assert word in str(refusal.value)


def test_no_such_measurement(folder):
    with pytest.raises(InputError, match="no measurement 'plat'.*did you mean 'plate'"):
        one(folder).measurement("plat")


# ---- measured data, where it is there
# -------------------------------------------------------------------------------


@needs_data
@pytest.mark.parametrize(("case", "files"), [("plain", 3), ("nail_bed", 3), ("stiffening", 3)])
def test_practice_studies_load(case, files):
    study = load_studies(DATA / "practice" / case / "experiments.yaml")["experiments"]
    assert len(study.measurements) == files and study.diagnose.effects == "all" and study.missing_data == ()
    rates = [name for name in study.fit.free if name.startswith("bar_rates")]
    assert rates == (["bar_rates.scale", "bar_rates.threshold"] if case == "plain" else [])
    start = {parameter.name: parameter.value for parameter in study.parameters()}
    assert all(start[f"{layer}.modulus"] > 0 for layer in ("epidermis", "dermis", "adipose", "fibrous"))


@needs_data
def test_published_files_load_from_the_data_folder(folder):
    text = """\
studies:
  profiles:
    finger: {preset: human}
    model: {ratios: m43338}
    measurements:
      - name: thin_cylinder
        data: data:human-fingertip-surface-profile/profiles.csv
        kind: deflection_profile
        indenter: {shape: cylinder, radius_mm: 1.585}
        columns: {depth_mm: depth_mm, distance_mm: x_mm, deflection_mm: deflection_mm}
        drop: {midpoint: 1}
        where: {cylinder_diameter_mm: 3.17}
        noise: {sigma: 0.05, unit: mm}
    fit: {free: [epidermis.modulus]}
    diagnose: {hold_out: [{measurement: thin_cylinder, where: {depth_mm: [0.5]}}]}
  table_2:
    kind: table
    finger: {preset: monkey}
    model: {ratios: m43338}
    options:
      data: data:literature/displacement_at_force_monkey.csv
      controlled: force
      indenters: {line: {shape: line, along: z}, flat_plate: flat_plate}
"""
    studies = load(folder, text, data=DATA)
    assert len(studies["profiles"].measurements[0]) == 92
    assert [row.modulus for row in studies["table_2"].options.rows][:3] == [0.22, 0.10, 0.08]
    assert studies["table_2"].options.indenters["line"].along == "z"
    assert studies["profiles"].diagnose.hold_out[0] == HeldOut("thin_cylinder", {"depth": (0.5,)})


def test_prior_share():
    assert Prior(2.0, 0.5).relative_sd == 0.25
