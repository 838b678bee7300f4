"""`fingerjax verify`: sound studies pass, each check fails when what it checks is broken, and the exit code says which."""

from __future__ import annotations

import dataclasses
import importlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

from fingerjax.__main__ import app
from fingerjax.fem.multigrid import hierarchy
from fingerjax.fem.solver import MultigridCG
from fingerjax.forward import Assembled, assemble, balance
from fingerjax.forward.balance import AtRest, Check, balances
from fingerjax.forward.pressing import pressed, settle
from fingerjax.forward.problem import Health, Problem
from fingerjax.identify import verification
from fingerjax.identify.verification import Slopes, derivative_checks, slopes_of, verify
from fingerjax.layers import SOFT_LAYERS
from fingerjax.parameters import Parameter
from fingerjax.study import load_studies

from .test_forward import PLATE, PRESSED, study_of

command = importlib.import_module("fingerjax.commands.verify")
EXPERIMENTS = Path(__file__).resolve().parent.parent / "experiments.yaml"


def failing(checks: list[Check]) -> list[str]:
    return [check.what for check in checks if not check.ok]


@pytest.fixture(scope="module")
def plate(tmp_path_factory: pytest.TempPathFactory) -> Assembled:
    free = {"free": ["epidermis.modulus", "poisson_ratio"]}
    return assemble(study_of(tmp_path_factory.mktemp("plate"), {"plate": (PLATE, PRESSED)}, free), solver="factorised")


def test_a_sound_study_passes_every_check(plate: Assembled) -> None:
    told: list[float] = []
    found = verify(plate, lambda share, doing: told.append(share))
    assert len(found) == 3 + 6 + 2 * 2 + 1
    assert not failing(found)
    assert told == sorted(told) and told[-1] < 1.0


def test_a_solve_cut_short_is_seen_in_the_residuals(plate: Assembled) -> None:
    short = MultigridCG(hierarchy(plate.model.body), max_steps=3)
    wrong = failing(balances(eqx.tree_at(lambda model: model.solver, plate.model, short), {}))
    assert "plate: residual of the solve, recomputed" in wrong
    assert "plate: supports carry the load" in wrong


@pytest.fixture(scope="module")
def state(plate: Assembled) -> AtRest:
    """The plate's two indentations as they ended."""
    model = plate.model
    condensed = model.solver.condense(model.body, model.instruments.materials({})[0].lame(), model.columns)
    rig = model.instruments.rigs[0]
    known = settle((rig,), [condensed], model.body, jnp.zeros((1, 0, *condensed.held.lame.shape)))
    contact, _ = eqx.filter_jit(pressed)(rig, known.rigs[0], known, jnp.zeros((1, 0)))
    forces = jnp.zeros((2, model.columns.count)).at[:, rig.columns[0]].add(contact.nodal_forces)
    return balance.at_rest(model, condensed, forces)


def statics(plate: Assembled, state: AtRest) -> list[Check]:
    body = plate.model.body
    return [
        balance.energy_balance("plate", state),
        balance.reaction_balance("plate", body, state),
        balance.equilibrium("plate", body, state),
    ]


@pytest.mark.parametrize(
    ("broken", "which"),
    [
        (lambda s: s, []),
        (lambda s: dataclasses.replace(s, load=1.001 * s.load), [0, 1, 2]),
        (lambda s: dataclasses.replace(s, energy=1.001 * s.energy), [0]),
        (lambda s: dataclasses.replace(s, energy=s.energy.at[1].multiply(1.001)), [0]),
        (lambda s: dataclasses.replace(s, displacement=1.001 * s.displacement), [0]),
    ],
)
def test_what_does_not_balance_is_seen(
    plate: Assembled, state: AtRest, broken: Callable[[AtRest], AtRest], which: list[int]
) -> None:
    assert [number for number, check in enumerate(statics(plate, broken(state))) if not check.ok] == which


def test_a_force_that_nothing_carries_is_seen_at_the_supports_and_inside(plate: Assembled, state: AtRest) -> None:
    body = plate.model.body
    inside, held = (int(np.flatnonzero(np.asarray(where))[0]) for where in (body.free > 0, balance._supports(body)))
    size = float(jnp.linalg.norm(state.load[0].sum(axis=0)))
    at_support = dataclasses.replace(state, internal=state.internal.at[0, held, 0].add(1e-3 * size))
    assert [check.ok for check in statics(plate, at_support)] == [True, False, True]
    within = dataclasses.replace(state, internal=state.internal.at[0, inside, 0].add(1e-3 * size))
    assert [check.ok for check in statics(plate, within)] == [True, True, False]


def test_tension_overlap_and_contacts_without_end_are_seen(plate: Assembled) -> None:
    rig, known = plate.model.instruments.rigs[0], plate.model.solved({}).known
    contact, _ = eqx.filter_jit(pressed)(rig, known.rigs[0], known, jnp.zeros((1, 0)))
    ok = lambda one: [check.ok for check in balance.contact_decided("plate", one)]  # noqa: E731
    assert ok(contact) == [True, True]
    touching = int(np.flatnonzero(np.asarray(contact.active[0]))[0])
    broken = lambda part, changed: eqx.tree_at(part, contact, changed(part(contact)))  # noqa: E731
    assert ok(broken(lambda c: c.pressure, lambda p: p.at[0, touching].multiply(-1))) == [False, True]
    assert ok(broken(lambda c: c.gap, lambda g: g.at[0, touching].set(-1e-6))) == [False, True]
    assert ok(broken(lambda c: c.settled, lambda s: s.at[1].set(False))) == [True, False]
    assert ok(broken(lambda c: c.reached_edge, lambda r: r.at[0].set(True))) == [True, False]


def test_a_compliance_that_is_not_positive_or_not_the_solves_is_seen(plate: Assembled) -> None:
    model, rig = plate.model, plate.model.instruments.rigs[0]
    condensed = model.solver.condense(model.body, model.instruments.materials({})[0].lame(), model.columns)
    matrix = condensed.held.matrix
    assert balance.contact_compliance("plate", rig, matrix).ok
    assert not failing(balance.reciprocity("tissue", model, condensed))
    worst = jnp.linalg.eigh(matrix)[1][:, -1]
    assert not balance.contact_compliance("plate", rig, matrix - 2 * jnp.linalg.norm(matrix, 2) * jnp.outer(worst, worst)).ok
    sound = condensed.held
    try:
        condensed.held = dataclasses.replace(sound, matrix=matrix.at[0, 0].multiply(1.001))
        assert failing(balance.reciprocity("tissue", model, condensed)) == ["tissue: the condensed compliance says what solves say"]
    finally:
        condensed.held = sound


def test_a_scaled_column_of_a_jacobian_is_seen_and_named() -> None:
    rng = np.random.default_rng(1)
    J, size = rng.standard_normal((3, 2)), np.ones(2)
    sound = Slopes(("a", "b"), J, J.copy(), J + 1e-7, np.full(2, 1e-4), size, 1.0, 1.0, 1e-13)
    assert not failing(derivative_checks(sound))
    scaled = dataclasses.replace(sound, forward=J * np.array([1.0, 1.001]))
    assert failing(derivative_checks(scaled)) == [
        "d residuals / d b: reverse against forward",
        "d residuals / d b: differences against forward",
    ]
    assert failing(derivative_checks(dataclasses.replace(sound, reverse=1.001 * J)))
    assert failing(derivative_checks(dataclasses.replace(sound, pulled=1.001))) == ["adjoint: w . (J t) is (J' w) . t"]
    assert failing(derivative_checks(dataclasses.replace(sound, difference=np.full((3, 2), np.nan))))


def curve(wrong: float) -> Callable[[jax.Array], jax.Array]:
    """A smooth function of two numbers whose slope in the second is said to be `wrong` times what it is."""

    @jax.custom_jvp
    def value(raw: jax.Array) -> jax.Array:
        return jnp.stack([jnp.exp(raw[0]), raw[0] * raw[1], jnp.sin(raw[1])])

    @value.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        (raw,), (moved,) = primals, tangents
        d = moved * jnp.array([1.0, wrong])
        slope = [jnp.exp(raw[0]) * d[0], raw[1] * d[0] + raw[0] * d[1], jnp.cos(raw[1]) * d[1]]
        return value(raw), jnp.stack(slope)

    return value


@pytest.mark.parametrize(("wrong", "rows"), [(1.0, []), (1.001, ["d residuals / d q: differences against forward"])])
def test_a_wrong_derivative_rule_is_caught_by_differences(wrong: float, rows: list[str]) -> None:
    value, health = curve(wrong), Health(jnp.asarray(True), jnp.asarray(1), jnp.asarray(1e-12))
    parameters = (Parameter("p", 0.7, link="identity"), Parameter("q", 0.4, link="identity"))
    problem = Problem(parameters, lambda raw: (value(raw), health), {"all": slice(0, 3)}, {"all": "stated"})
    assert failing(derivative_checks(slopes_of(problem))) == rows


def test_a_difference_is_not_taken_across_a_change_of_contact(monkeypatch: pytest.MonkeyPatch) -> None:
    """A kink just beside the start: the step is shortened until both its ends lie on one side."""
    health = Health(jnp.asarray(True), jnp.asarray(1), jnp.asarray(1e-12))
    start, kink = 0.5, 0.5 + 0.4e-4  # the first step is 1e-4

    class Bent(eqx.Module):
        at: jax.Array

        def __call__(self, raw: jax.Array) -> tuple[jax.Array, Health]:
            return raw + jnp.maximum(raw - kink, 0.0), health

    problem = Problem(
        (Parameter("p", start, link="identity"),), Bent(jnp.zeros(1)), {"all": slice(0, 1)}, {"all": "stated"}, lambda raw: Bent(raw)
    )
    assert failing(derivative_checks(slopes_of(problem)))
    monkeypatch.setattr(verification, "_touching", lambda bent: (np.asarray(bent.at > kink).tobytes(),))
    found = slopes_of(problem)
    assert found.steps[0] == pytest.approx(0.25e-4)
    assert not failing(derivative_checks(found))


def test_tables_and_layer_studies_are_verified_in_the_four_soft_moduli() -> None:
    studies = load_studies(EXPERIMENTS)
    soft = tuple(f"{layer}.modulus" for layer in SOFT_LAYERS)
    table = list(command.pieces(studies["table2"]))
    assert [one.measurements[0].name for one in table] == ["line", "flat_plate"]
    (layers,) = command.pieces(studies["layer_study"])
    assert layers.model.ratios == studies["layer_study"].options.models[0] and layers.measurements[0].sigma.min() > 0
    assert all(one.fit.free == soft for one in [*table, layers])
    fitted = studies["layer_ratios_simulated"]
    assert list(command.pieces(fitted)) == [fitted]


@pytest.fixture
def written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A study file, and checks that need no mesh: one holds, one is there to be broken."""
    study_of(tmp_path, {"plate": (PLATE, PRESSED)})
    monkeypatch.setattr(command, "prepare", lambda: None)
    monkeypatch.setattr(command, "assemble", lambda study: study)
    return tmp_path / "small.yaml"


@pytest.mark.parametrize(("value", "code"), [(1e-9, 0), (1e-3, 1), (float("nan"), 1)])
def test_the_exit_code_and_the_file_say_what_the_table_says(
    written: Path, monkeypatch: pytest.MonkeyPatch, value: float, code: int
) -> None:
    checks = [Check("balance", value, 1e-7), Check("eigenvalue", 0.1, 1e-12, at_least=True)]
    monkeypatch.setattr(command, "verified", lambda assembled, tell: checks)
    shown = CliRunner().invoke(app, ["verify", str(written), "--json", str(written.with_suffix(".json"))])
    assert shown.exit_code == code, shown.output
    assert f"{2 - code} of 2 hold" in shown.stdout and "at least 1e-12" in shown.stdout
    (found,) = json.loads(written.with_suffix(".json").read_text())["studies"].values()
    assert [row["ok"] for row in found] == [code == 0, True]
    assert found[0]["what"] == "balance" and found[0]["value"] == (value if value == value else None)


def test_an_unknown_study_is_wrong_input(written: Path) -> None:
    shown = CliRunner().invoke(app, ["verify", str(written), "--study", "smal"])
    assert shown.exit_code == 2
    assert shown.stderr.count("\n") == 1 and "small" in shown.stderr


def test_help_teaches() -> None:
    assert "fingerjax verify experiments.yaml" in CliRunner().invoke(app, ["verify", "--help"]).stdout
