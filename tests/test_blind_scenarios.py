"""The blind laboratory's registry and its folders: what a study is told, what it is not told, and what is kept apart for scoring."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from fingerjax.runners.rows import rows_of
from fingerjax.study import load_studies
from tests.blind import bricks, folders, truths
from tests.blind.flesh import midline
from tests.blind.instruments import along
from tests.blind.laboratory import Profiles
from tests.blind.protocol import Elastic, Rig, Sweep, Trace, elastic
from tests.blind.scenarios import EFFECTS, KINDS, SCENARIOS

ROOT = Path(__file__).resolve().parents[1]
VOCABULARY = {
    *("epidermis_thickness", "dermis_thickness", "bone_offset", "receptor_depth", "receptor_position", "strain_stiffening"),
    *("finite_strain", "skin_poisson", "deep_poisson", "skin_pretension", "anisotropy", "stratum_corneum", "depth_gradient"),
    *("nail_compliance", "bed_compliance", "contact_offset", "apparatus_compliance", "indenter_shift", "indenter_tilt", "tip_radius"),
    *("friction", "adhesion", "relaxation", "hysteresis", "poroelastic_drift", "force_gain", "force_offset", "force_drift", "force_lag"),
    *("camera_scale", "profile_tilt", "rate_saturation", "rate_power_law", "spontaneous_rate", "rate_adaptation"),
    *("receptive_field_pooling", "mixed_quantity"),
}


def test_the_registry_has_what_it_must():
    counts = {kind: sum(one.kind == kind for one in SCENARIOS.values()) for kind in KINDS}
    assert counts["single"] >= 24 and counts["double"] >= 4 and counts["outside"] >= 5
    assert counts["absorbed"] >= 1 and counts["mesh_limited"] >= 1
    assert {one.finger for one in SCENARIOS.values() if one.kind == "none"} == {"human", "monkey"}


def test_families_are_words_of_the_loop():
    named = {family for one in SCENARIOS.values() for family in one.families}
    assert named <= VOCABULARY and set(EFFECTS) <= VOCABULARY
    sizes = {"single": 1, "double": 2, "absorbed": 1}
    assert all(len(one.families) == sizes.get(one.kind, 0) for one in SCENARIOS.values())


@pytest.mark.parametrize("name", [one.name for one in SCENARIOS.values() if one.kind != "none"])
def test_every_scenario_alters_the_world_and_not_what_is_written_of_it(name):
    scenario = SCENARIOS[name]
    world, plain = scenario.world(), scenario.plain()
    assert world != plain
    assert world.nominal == plain.nominal and world.records == plain.records


@pytest.mark.parametrize("thin", [False, True])
def test_every_finger_can_be_meshed_and_holds_its_receptors(thin):
    for flesh in {one.world(thin=thin).flesh for one in SCENARIOS.values()}:
        mesh = replace(flesh, bed=None).mesh()
        bricks.gradients(mesh.nodes[mesh.bricks], 2)
        for which in range(len(flesh.receptors)):
            assert mesh.layer[bricks.locate(mesh, np.array(flesh.receptor(which)))[0]] == 1


@pytest.mark.parametrize("finger", ["human", "monkey"])
def test_bricks_under_a_wedge_are_as_short_as_its_tip_is_wide(finger):
    flesh = SCENARIOS[f"none_{finger}"].world().flesh
    flesh = replace(flesh, divisions=flesh.divisions.undivided())
    mesh = flesh.mesh()
    ends = mesh.nodes[midline(mesh), 2][::2] - flesh.finger.site
    lengths, middles = np.diff(ends), 0.5 * (ends[1:] + ends[:-1])
    under = int(np.abs(middles).argmin())
    assert middles[under] == pytest.approx(0.0, abs=1e-9)
    assert lengths[under] == lengths.min() == pytest.approx(0.05)
    beside = lengths[np.abs(middles) < flesh.divisions.reach]
    assert np.abs(np.diff(np.log(beside))).max() < np.log(2.5)  # 1.6 but where the cap's own end leaves no room for another


def test_several_bricks_lie_under_the_tip_of_a_wedge():
    flesh = SCENARIOS["none_human"].world().flesh
    mesh = flesh.mesh()
    ends = mesh.nodes[midline(mesh), 2][::2] - flesh.finger.site
    under = ends[np.abs(ends) < 0.026]
    assert under == pytest.approx(np.array([-0.025, -0.019, -0.01, 0.01, 0.019, 0.025]), abs=1e-9)


def test_bricks_cut_otherwise_leave_layers_as_they_are():
    flesh = SCENARIOS["none_human"].world(thin=True).flesh
    cut = replace(flesh, divisions=replace(flesh.divisions, epidermis=(0.45, 0.75, 0.92, 1.0)))
    even, uneven = (volumes(one.mesh()) for one in (flesh, cut))
    assert np.allclose(even, uneven, rtol=1e-3)


def test_a_wedge_on_bricks_of_its_own_size_takes_less_of_the_skin_along():
    world = SCENARIOS["none_monkey"].world(thin=True)
    sharp = replace(world.flesh, divisions=replace(world.flesh.divisions, sharp=0.05, epidermis=(0.45, 0.75, 0.92, 1.0)))
    wide, narrow = (elastic(flesh, world.rig, world.records[:1]) for flesh in (world.flesh, sharp))
    beside = np.array([0.5, 1.0])
    wide_, narrow_ = (along(one.z, one.lines["wedge_profile"][2], beside) for one in (wide, narrow))
    assert np.all(narrow_ < 0.98 * wide_)


def volumes(mesh) -> np.ndarray:
    """Of the four layers, mm^3."""
    weights = bricks.gradients(mesh.nodes[mesh.bricks], 2)[1].sum(1)
    return np.bincount(mesh.layer, weights, minlength=4)


def test_weights_of_a_pooled_field_are_shares():
    sites = SCENARIOS["receptive_field_pooling"].world().instruments.sites
    assert sum(weight for _, weight in sites) == pytest.approx(1.0)


def made_up(world) -> Elastic:
    """What some finger might do: smooth and positive, cheap."""
    z = np.linspace(-11.0, 11.0, 89)
    found = Elastic({}, z, {}, {})
    for record in world.records:
        if isinstance(record, Profiles):
            found.lines[record.name] = np.stack([d * np.exp(-0.5 * (z / (2.0 + d)) ** 2) for d in record.depths])
        elif isinstance(record, Trace):
            travel = np.unique([0.0, *record.travel(np.array(record.times))])
            found.curves[record.name] = np.stack([travel, 0.1 * travel**1.5])
        elif isinstance(record, Sweep):
            count = len(world.flesh.receptors)
            at = np.array(record.positions)[:, None] + 0.1 * np.arange(count)
            found.energy[record.name] = np.repeat((5e-4 * np.exp(-0.5 * at**2) + 1e-4)[None], len(record.stimuli), 0)
    return found


class Quick(truths.Truths):
    """Truths of a made-up finger, which takes no time; moduli multiply all its forces."""

    def _elastic(self, world, name):
        found = made_up(world)
        share = sum(world.flesh.moduli) / sum(SCENARIOS["none_human"].world().flesh.moduli)
        curves = {key: curve * np.array([[1.0], [share]]) for key, curve in found.curves.items()}
        return Elastic(found.lines, found.z, curves, found.energy)


@pytest.fixture
def quick(tmp_path) -> Quick:
    return Quick(tmp_path / "mechanics")


def write(name: str, quick: Quick, folder: Path, *, seed: int = 1) -> dict:
    folders.write(SCENARIOS[name], quick, folder / "lab", folder / "truth.yaml", noise=0.02, seed=seed)
    return yaml.safe_load((folder / "truth.yaml").read_text())


@pytest.mark.parametrize("name", ["none_human", "rate_saturation", "coarse_mesh"])
def test_a_laboratory_loads_as_a_study_and_matches_its_truth(name, quick, tmp_path):
    said = write(name, quick, tmp_path)
    study = next(iter(load_studies(tmp_path / "lab" / "experiments.yaml").values()))
    assert study.finger.resolution.pad_mm == SCENARIOS[name].world().resolution[0]
    for measurement in study.measurements:
        right = said["rows"][measurement.name]
        assert len(measurement) == folders.TRIALS * len(right["clean"])
        for column, values in right["coordinates"].items():
            read, wanted = measurement.table[column], np.tile(values, folders.TRIALS)
            assert np.all(read == wanted if read.dtype.kind == "U" else np.abs(read - wanted) < 1e-4), column
        left = (measurement.measured - np.tile(right["clean"], folders.TRIALS)) / measurement.sigma
        count = len(left)
        assert abs(left.std() - 1.0) < 4.5 / np.sqrt(2 * count) and abs(left.mean()) < 4.5 / np.sqrt(count)
        kept = np.zeros(len(measurement), bool)
        for one in study.diagnose.hold_out:
            if one.measurement == measurement.name:
                kept |= np.all([np.isin(measurement.table[key], wanted) for key, wanted in one.where.items()], axis=0)
        assert np.array_equal(kept, np.tile(right["held_out"], folders.TRIALS))


def test_nothing_brought_to_the_program_names_the_effect(quick, tmp_path):
    for name in ("force_drift", "periodic_drift", "load_cell_gain"):
        write(name, quick, tmp_path / name)
        for path in (tmp_path / name / "lab").iterdir():
            text = path.read_text().lower()
            assert name not in text and "truth" not in text and "drift" not in text and "gain" not in text, path


def test_seeds_change_the_noise_alone(quick, tmp_path):
    for folder, seed in (("a", 1), ("b", 1), ("c", 2)):
        write("none_human", quick, tmp_path / folder, seed=seed)
    files = sorted(path.name for path in (tmp_path / "a" / "lab").iterdir())
    assert all((tmp_path / "a" / "lab" / file).read_bytes() == (tmp_path / "b" / "lab" / file).read_bytes() for file in files)
    differ = {file for file in files if (tmp_path / "a" / "lab" / file).read_bytes() != (tmp_path / "c" / "lab" / file).read_bytes()}
    assert differ == {file for file in files if file.endswith(".csv")} - {"sections.csv"}


def test_trials_have_gains_of_their_own_where_they_should(quick, tmp_path):
    def spread(name: str) -> float:
        write(name, quick, tmp_path / name)
        study = next(iter(load_studies(tmp_path / name / "lab" / "experiments.yaml").values()))
        plate = study.measurement("plate_hold")
        sums = [plate.measured[plate.table["trial"] == trial].sum() for trial in ("1", "2", "3", "4")]
        return float(np.std(sums) / np.mean(sums))

    assert spread("trial_gain") > 1.5 * spread("none_human")


def test_excess_misfit_knows_what_moduli_take_up(quick):
    assert quick.excess(SCENARIOS["none_human"], 0.02, 4) == 0.0
    gain, offset = (quick.excess(SCENARIOS[name], 0.02, 4) for name in ("load_cell_gain", "force_offset"))
    assert gain < 0.05 * offset
    assert offset < quick.excess(SCENARIOS["force_offset"], 0.01, 4) < 4 * offset
    assert quick.excess(SCENARIOS["force_offset"], 0.01, 4) == pytest.approx(quick.excess(SCENARIOS["force_offset"], 0.02, 16), rel=1e-9)


def test_excess_misfit_of_a_perfect_model_is_in_units_of_the_noise_of_the_mean(quick, monkeypatch):
    monkeypatch.setattr(truths, "no_news", lambda record, clean: (np.zeros(clean.size), np.zeros(clean.size)))
    offset = quick.excess(SCENARIOS["force_offset"], 0.02, 4)
    assert quick.excess(SCENARIOS["force_offset"], 0.01, 4) == pytest.approx(4 * offset, rel=1e-9)
    assert quick.excess(SCENARIOS["force_offset"], 0.02, 8) == pytest.approx(2 * offset, rel=1e-9)


def test_what_is_no_news_is_what_the_study_says(quick, tmp_path):
    """The program that reads a laboratory's study counts the same for its readings."""
    scenario = SCENARIOS["none_human"]
    folders.write(scenario, quick, tmp_path / "lab", tmp_path / "truth.yaml", noise=1e-6, seed=1)
    rows = rows_of(load_studies(tmp_path / "lab" / "experiments.yaml")["experiments"])
    clean = quick.clean(scenario)
    for record in scenario.world(thin=quick.thin).records:
        each, shared = truths.no_news(record, clean[record.name])
        assert rows.form[rows.blocks[record.name]][: len(each)] == pytest.approx(each, rel=1e-4)
        known = f"place of the afferent of {record.name}"
        beside = rows.calibration[known][rows.blocks[record.name]] if shared.any() else np.zeros(len(each))
        assert beside[: len(each)] == pytest.approx(shared, abs=1e-4 * float(np.abs(shared).max()) + 1e-12)


def test_each_of_two_effects_leaves_less_than_both(quick):
    double = SCENARIOS["rate_saturation+force_offset"]
    each = quick.excess_of_each(double, 0.02, 4)
    assert set(each) == set(double.families)
    assert min(each.values()) > 0 and max(each.values()) < quick.excess(double, 0.02, 4)


def test_held_out_rows_are_whole_conditions():
    scenario = SCENARIOS["none_human"]
    for record in scenario.world().records:
        kept = truths.held_out(scenario, record)
        labels = np.array(truths.coordinates(record)["condition"])
        assert all(len(set(kept[labels == label])) == 1 for label in set(labels.tolist()))


def test_mechanics_is_computed_once_for_all_instruments(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(
        truths, "elastic", lambda flesh, rig, records: made.append((flesh, rig)) or made_up(SCENARIOS["none_human"].world())
    )
    kept = truths.Truths(tmp_path)
    for name in ("none_human", "force_offset", "relaxation", "contact_offset", "force_offset"):
        kept.clean(SCENARIOS[name])
    assert [rig for _, rig in made] == [Rig(), SCENARIOS["contact_offset"].world().rig]


def test_the_program_reads_no_truth_and_no_blind_laboratory():
    for path in (ROOT / "fingerjax").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert "truth.yaml" not in text and "tests.blind" not in text and "moduli_scored" not in text, path


def test_leaning_plates_touch_skin_whose_bricks_are_fine_enough():
    """A plate that leans touches the skin away from the site, where a laboratory's bricks are long."""
    world = SCENARIOS["indenter_tilt"].world(thin=True)
    pressed = tuple(record for record in world.records if record.name == "plate_force")
    finer = replace(world.flesh, divisions=replace(world.flesh.divisions, reach=6.5))
    forces = [elastic(flesh, world.rig, pressed).curves["plate_force"][1] for flesh in (world.flesh, finer)]
    np.testing.assert_allclose(forces[0], forces[1], rtol=0.02, atol=0.01 * forces[1].max())
