"""From a study to readings: derivatives, scaling, control, wiring, noise, and what is said when something goes wrong.

One small finger carries every instrument: a profile under a wedge, a plate's force, a plate's travel under given force, and the rates of
one afferent under a bar. Its mesh is far too coarse for numbers, not for the identities that are tested here.
"""

from __future__ import annotations

import csv
import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from fingerjax._results import RESULTS
from fingerjax.fem.body import Body
from fingerjax.fem.multigrid import hierarchy
from fingerjax.fem.solver import MultigridCG
from fingerjax.forward import Assembled, Prediction, assemble, model, pressing, rigs
from fingerjax.forward.model import ASSUMED_NOISE, noise_of
from fingerjax.forward.readings import Solved
from fingerjax.identify import fit
from fingerjax.layers import SOFT_LAYERS
from fingerjax.measurements import Measurement
from fingerjax.report import Context, StudyResult
from fingerjax.runners import fitting
from fingerjax.runners.fitting import complaint, fit_study, predict_study
from fingerjax.runners.force_table import force_table
from fingerjax.study import Study, load_studies

from .helpers import DIFFERENCED, SOLVED

MODULI = dict(zip(SOFT_LAYERS, (0.14, 0.02, 0.012, 0.03), strict=True))
COARSE = {"pad_mm": 1.2, "proximal_mm": 2.4}
SITE = {"z_mm": 8.7, "theta_deg": 270.0}
PLATE = {"kind": "force_displacement", "indenter": {"shape": "flat_plate"}, "site": SITE, "noise": {"sigma": 0.001, "unit": "N"}}
WEDGE = {
    "kind": "deflection_profile",
    "indenter": {"shape": "line", "width_mm": 0.05, "along": "x"},
    "site": SITE,
    "noise": {"sigma": 0.01, "unit": "mm"},
}
HELD = {**PLATE, "controlled": "force", "noise": {"sigma": 0.01, "unit": "mm"}}
BAR = {
    "kind": "spike_rate",
    "indenter": {"shape": "bar", "width_mm": 3.0, "edge_radius_mm": 0.3},
    "receptor": {"afferent": "SA-I", "depth_mm": 0.75, **SITE},
    "noise": {"sigma": 1.0, "unit": "Hz"},
}
Rows = list[dict[str, Any]]
PRESSED: Rows = [{"displacement_mm": d, "force_N": 0.1 * d} for d in (0.37, 0.81)]
PROFILE: Rows = [{"depth_mm": 0.9, "distance_mm": s, "deflection_mm": 0.5} for s in (-2.1, -0.6, 0.8, 2.3)]
FORCED: Rows = [{"force_N": 0.05, "displacement_mm": 0.8}]
RATES: Rows = [{"position_mm": s, "depth_mm": 0.8, "rate_Hz": 40.0 - 5 * abs(s)} for s in (-2.0, 0.3, 1.9)]
OF: dict[str, tuple[dict[str, Any], Rows]] = {
    "plate": (PLATE, PRESSED),
    "wedge": (WEDGE, PROFILE),
    "held": (HELD, FORCED),
    "bar": (BAR, RATES),
}


def study_of(folder: Path, measured: dict[str, tuple[dict[str, Any], Rows]], fitted: dict[str, Any] | None = None, **said: Any) -> Study:
    """A study on the small finger, written as files and read through the door."""
    for name, (sidecar, rows) in measured.items():
        with (folder / f"{name}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(sidecar))
    written = {
        "finger": {"preset": "monkey", "resolution": COARSE},
        "model": {"moduli_MPa": MODULI, "bone": "rigid", "poisson_ratio": 0.48},
        "measurements": [{"name": name, "data": f"{name}.csv"} for name in measured],
        "fit": fitted or {"free": [f"{layer}.modulus" for layer in SOFT_LAYERS]},
        **said,
    }
    (folder / "small.yaml").write_text(yaml.safe_dump({name: value for name, value in written.items() if value is not None}))
    return load_studies(folder / "small.yaml")["small"]


@pytest.fixture(scope="module", autouse=True)
def coarse_wedge() -> Iterator[None]:
    """No refinement under the wedge and around the receptor: a spacing above the pad's own asks for none."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rigs, "LINE_SPACING", 2.0)
        patch.setattr(rigs, "RECEPTOR_SPACING", 4.0)
        yield


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory) -> Assembled:
    """All four instruments on one mesh."""
    return assemble(study_of(tmp_path_factory.mktemp("everything"), OF), solver="factorised")


@pytest.fixture(scope="module")
def plate(tmp_path_factory: pytest.TempPathFactory) -> Assembled:
    """One plate, one free modulus, and what is known of it from elsewhere."""
    free = {"free": ["epidermis.modulus"], "priors": {"epidermis.modulus": {"value_MPa": 0.16, "relative_sd": 0.1}}}
    return assemble(study_of(tmp_path_factory.mktemp("plate"), {"plate": (PLATE, PRESSED)}, free), solver="factorised")


def at(**factors: float) -> dict[str, float]:
    """The moduli, some of them changed by a factor, and a threshold below what the receptor feels under every pose of the bar."""
    return {f"{layer}.modulus": MODULI[layer] * factors.get(layer, 1.0) for layer in SOFT_LAYERS} | {"bar.threshold": 2e-5}


def named(assembled: Assembled, prediction: Prediction) -> dict[str, np.ndarray]:
    return {one.name: np.asarray(reading) for one, reading in zip(assembled.study.measurements, prediction.readings, strict=True)}


def imposing(assembled: Assembled, number: int, imposed: list[float]) -> Assembled:
    """The same with other travels, or forces, imposed by one of its rigs."""
    changed = eqx.tree_at(lambda one: one.instruments.rigs[number].imposed, assembled.model, jnp.asarray(imposed))
    return dataclasses.replace(assembled, model=changed)


def context(folder: Path) -> Context:
    return Context(folder)


def test_hats_answer_hats_as_the_compliance_says_and_stiffer_bodies_in_proportion(everything: Assembled) -> None:
    model = everything.model
    lame = model.instruments.materials(at())[0].lame()
    bodies = model.condensed([lame, 3.0 * lame])
    for rig in model.instruments.rigs:
        found = np.asarray(pressing._between(rig, bodies))
        assert found.shape[:2] == (2, len(rig.columns))
        for pose, (own, load) in enumerate(zip(np.asarray(rig.columns), np.asarray(rig.interface.load), strict=True)):
            C = np.asarray(bodies[0].held.matrix)[np.ix_(own, own)]
            np.testing.assert_allclose(found[0, pose], load.T @ C @ load, rtol=1e-11, atol=1e-15)
        np.testing.assert_allclose(3.0 * found[1], found[0], rtol=1e-13)


@eqx.filter_jit
def slopes(model: Solved, x: jax.Array) -> jax.Array:
    return jax.jacfwd(lambda x: readings(model, x))(x)


@eqx.filter_jit
def pulled(model: Solved, x: jax.Array, weights: jax.Array) -> jax.Array:
    return jax.grad(lambda x: weights @ readings(model, x))(x)


def readings(model: Solved, x: jax.Array) -> jax.Array:
    """All readings as a function of the logarithms of the four moduli."""
    values = {**at(), **{f"{layer}.modulus": jnp.exp(x[i]) for i, layer in enumerate(SOFT_LAYERS)}}
    return jnp.concatenate(model.predict(values).readings)


def test_derivatives_of_every_reading_in_every_modulus(everything: Assembled) -> None:
    """Forward against differences for force, profile, travel and rate; and the same numbers in reverse."""
    start = everything.predict(at())
    assert start.converged and start.settled and start.inside
    assert all(np.abs(each).min() > 0 for each in named(everything, start).values())
    moving = tuple(f"{layer}.modulus" for layer in SOFT_LAYERS)
    solved, x = everything.model.solved(at(), moving=moving), jnp.log(jnp.asarray(list(MODULI.values())))
    forward = np.asarray(slopes(solved, x))
    h = 3e-4  # truncation about 1e-8 of a reading, the solver's residual of 1e-10 over h less than 1e-6
    for i, layer in enumerate(SOFT_LAYERS):
        up, down = (named(everything, everything.predict(at(**{layer: math.exp(step)}))) for step in (h, -h))
        begin = 0
        for name, high in up.items():
            found = forward[begin : begin + len(high), i]
            DIFFERENCED.check(found, (high - down[name]) / (2 * h))
            begin += len(high)
    weights = jax.random.normal(jax.random.key(2), (len(forward),))
    SOLVED.check(pulled(solved, x, weights), np.asarray(weights) @ forward)


def test_force_control_undoes_displacement_control(everything: Assembled) -> None:
    """The force that a plate gave at a travel, imposed on the other plate, gives that travel."""
    force = named(everything, everything.predict(at()))["plate"][1]
    back = imposing(everything, 2, [float(force)])
    SOLVED.check(named(back, back.predict(at()))["held"], [PRESSED[1]["displacement_mm"]])


def test_twice_the_moduli_twice_the_force_and_no_other_profile(everything: Assembled) -> None:
    one = everything.predict(at())
    twice_as_stiff = imposing(everything, 2, [2 * FORCED[0]["force_N"]])
    other = twice_as_stiff.predict(at(**dict.fromkeys(SOFT_LAYERS, 2.0)))
    before, after = named(everything, one), named(everything, other)
    SOLVED.check(after["plate"], 2 * before["plate"])
    SOLVED.check(after["wedge"], before["wedge"])
    SOLVED.check(after["held"], before["held"])
    SOLVED.check(other.quantity[3], 2 * np.asarray(one.quantity[3]))


def test_what_a_receptor_feels_becomes_a_rate(everything: Assembled) -> None:
    prediction = everything.predict({**at(), "bar.scale": 2e4, "bar.threshold": 1e-4})
    felt = np.asarray(prediction.quantity[3])
    assert felt.min() > 0 and not np.any(np.asarray(prediction.quantity[0]))
    SOLVED.check(prediction.readings[3], 2e4 * np.maximum(felt - 1e-4, 0.0))


def with_readings(study: Study, prediction: Prediction) -> Study:
    """The study with the model's own readings in place of the measured ones."""
    made = [
        dataclasses.replace(one, table={**one.table, one.value: np.asarray(reading)})
        for one, reading in zip(study.measurements, prediction.readings, strict=True)
    ]
    return dataclasses.replace(study, measurements=tuple(made))


@pytest.mark.slow
def test_two_subjects_with_their_own_epidermis_and_one_tissue_beneath_are_recovered(tmp_path: Path) -> None:
    pressed = [{"subject": subject, **row} for subject in "ab" for row in PRESSED]
    profile = [{"subject": "a", **row} for row in PROFILE]
    soft = [f"{layer}.modulus" for layer in SOFT_LAYERS[1:]]
    said = {"free": ["epidermis.modulus", *soft], "tie": [soft], "per": {"epidermis.modulus": "subject"}}
    begun = assemble(study_of(tmp_path, {"plate": (PLATE, pressed), "wedge": (WEDGE, profile)}, said), solver="factorised")
    assert [one.name for one in begun.model.wired.free] == ["epidermis.modulus[a]", "epidermis.modulus[b]", "dermis.modulus"]
    truth = {"epidermis.modulus[a]": 0.2, "epidermis.modulus[b]": 0.09, "dermis.modulus": 0.015}
    assembled = dataclasses.replace(begun, study=with_readings(begun.study, begun.predict(truth)))
    forces = assembled.study.measurements[0].measured
    assert forces[0] > 1.05 * forces[2] and forces[1] > 1.05 * forces[3]
    found = fit(assembled.problem())
    assert found.result is RESULTS.successful
    assert found.values == pytest.approx(truth, rel=1e-4)


def short(body: Body, kind: str = "auto") -> MultigridCG:
    """A solver that stops long before it is done."""
    return MultigridCG(hierarchy(body), max_steps=3)


def test_a_solve_cut_short_ends_the_fit_and_leaves_no_value(
    plate: Assembled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut = dataclasses.replace(plate, model=dataclasses.replace(plate.model, solver=short(plate.model.body)))
    assert complaint(cut.predict()) is RESULTS.not_converged
    ended = fit(cut.problem())
    assert ended.result is RESULTS.not_converged and not ended.converged
    assert ended.iterations == 3 and ended.solve_residual > 1e-8
    assert all(math.isnan(value) for value in ended.values.values())
    monkeypatch.setattr(fitting, "assemble", lambda study, **_: cut)
    check_without_numbers(fit_study(plate.study, context(tmp_path)), RESULTS.not_converged)
    check_without_numbers(predict_study(plate.study, context(tmp_path)), RESULTS.not_converged)


def check_without_numbers(result: StudyResult, why: RESULTS) -> None:
    """Nothing that a reader could take for an answer, and the reason in words."""
    assert not result.converged
    assert not result.tables and not result.figures
    assert why.value in " ".join([result.verdict, *result.warnings])
    for parameter in ((result.fit or {}).get("parameters") or {}).values():
        assert parameter["value"] is None or math.isnan(parameter["value"])
        assert parameter.get("ci95") is None or not any(end is not None and math.isfinite(end) for end in parameter["ci95"])


@pytest.mark.slow
def test_a_table_of_forces_whose_solves_are_cut_short_has_no_modulus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model, "solver_for", short)
    row = {"indenter": "plate", "subject": "A", "force_gf": 5.0, "displacement_mm": 0.5}
    options = {"indenters": {"plate": {"shape": "flat_plate"}}, "rows": [row]}
    study = study_of(tmp_path, {}, kind="table", options=options)
    result = force_table(study, context(tmp_path))
    check_without_numbers(result, RESULTS.not_converged)
    assert "No modulus is reported" in result.verdict


def test_contact_that_reaches_the_edge_is_said_and_gives_no_numbers(
    plate: Assembled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pad prepared for 0.8 mm, with a rim of facets two millimetres wide, pressed by 8 mm."""
    deep = imposing(plate, 0, [0.37, 8.0])
    prediction = deep.predict()
    assert prediction.converged and prediction.settled and not prediction.inside and not prediction.health.converged
    assert complaint(prediction) is RESULTS.contact_reached_edge
    monkeypatch.setattr(fitting, "assemble", lambda study, **_: deep)
    check_without_numbers(predict_study(plate.study, context(tmp_path)), RESULTS.contact_reached_edge)
    assert fit(deep.problem()).result is not RESULTS.successful


def test_priors_are_rows_of_their_own(plate: Assembled) -> None:
    problem = plate.problem()
    assert problem.blocks == {"plate": slice(0, 2), "prior": slice(2, 3)}
    assert problem.sigma_source == {"plate": "stated"} and problem.prepare is not None
    start = jnp.asarray(problem.start())
    rows, health = eqx.filter_jit(problem.prepare(start))(start)
    assert health.converged and rows.shape == (3,)
    assert float(rows[2]) == pytest.approx((MODULI["epidermis"] - 0.16) / 0.016)
    force = plate.study.measurements[0]
    SOLVED.check(rows[:2], (np.asarray(plate.predict().readings[0]) - force.measured) / 0.001)


def measured(folder: Path, rows: Rows, noise: dict[str, Any] | None) -> Measurement:
    sidecar = {name: value for name, value in {**PLATE, "noise": noise}.items() if value is not None}
    return study_of(folder, {"plate": (sidecar, rows)}).measurements[0]


def test_noise_is_stated_or_pooled_or_assumed(tmp_path: Path) -> None:
    stated, source = noise_of(measured(tmp_path, PRESSED, {"sigma": 2.0, "unit": "mN"}))
    assert source == "stated" and stated == pytest.approx([0.002, 0.002])
    pairs = [(trial, depth) for trial in (1, 2, 3) for depth in (0.5, 1.0)]
    trials = [{"trial": trial, "displacement_mm": depth, "force_N": 0.1 * depth + 0.003 * (trial - 2)} for trial, depth in pairs]
    pooled, source = noise_of(measured(tmp_path, trials, None))
    assert source == "replicates" and pooled == pytest.approx(np.full(6, 0.003))
    assumed, source = noise_of(measured(tmp_path, PRESSED, None))
    assert source == "assumed" and assumed == pytest.approx(np.full(2, ASSUMED_NOISE * 0.081))
