"""Every effect: nothing at its null, slopes as differences have them, and the size and sign that theory or its name gives it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from fingerjax.effects import Effect, catalogue, chosen
from fingerjax.effects.added import Effects
from fingerjax.effects.effect import ACTS_ON
from fingerjax.effects.records import Context, Reading
from fingerjax.errors import InputError
from fingerjax.fem.body import body
from fingerjax.fem.solver import Factorised, MultigridCG, solver_for
from fingerjax.fem.springs import bed, facets, film, springs, tension
from fingerjax.fem.stiffness import Elastic
from fingerjax.forward import Assembled, assemble, rigs
from fingerjax.forward.model import changed, lay_out
from fingerjax.forward.readings import growth
from fingerjax.geometry.presets import preset
from fingerjax.layers import SOFT_LAYERS
from fingerjax.mesh import Resolution, build_finger
from fingerjax.mesh.jacobian import volumes
from fingerjax.runners.families import family
from fingerjax.runners.subject import FingerSubject

from .helpers import DIFFERENCED, SAME_ARITHMETIC, Grade
from .test_forward import COARSE, OF, SITE, Rows, study_of

RAMP: Rows = [
    {"trial": 1, "time_s": t, "displacement_mm": d, "force_N": 0.1 * d}
    for t, d in ((0.0, 0.1), (0.2, 0.3), (0.4, 0.6), (1.4, 0.6), (4.4, 0.6), (4.8, 0.3))
]
HELD_RAMP = {
    "kind": "force_displacement",
    "indenter": {"shape": "point", "radius_mm": 0.8, "edge_radius_mm": 0.2},
    "site": SITE,
    "noise": {"sigma": 0.001, "unit": "N"},
}
SWEEP: Rows = [{"position_mm": s, "depth_mm": 0.8, "rate_Hz": 40.0 - 5 * abs(s), "time_s": 0.5} for s in (-2.0, -0.9, 0.3, 1.1, 1.9)]
EVERYTHING = OF | {"ramp": (HELD_RAMP, RAMP), "bar": (OF["bar"][0], SWEEP)}
COMPILED = [effect for effect in catalogue() if effect.traced]
MADE = [effect for effect in catalogue() if not effect.traced and effect.acts_on != "tissue"]


@pytest.fixture(scope="module", autouse=True)
def coarse() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rigs, "LINE_SPACING", 2.0)
        patch.setattr(rigs, "RECEPTOR_SPACING", 4.0)
        patch.setattr(rigs, "PROBE_SPACING", 2.0)
        yield


@pytest.fixture(scope="module")
def ready(tmp_path_factory: pytest.TempPathFactory) -> Assembled:
    folder = tmp_path_factory.mktemp("effects")
    return assemble(study_of(folder, EVERYTHING, finger={"preset": "monkey", "resolution": COARSE}))


@pytest.fixture(scope="module")
def subject(ready: Assembled) -> FingerSubject:
    return FingerSubject(ready, catalogue())


def start(subject: FingerSubject) -> np.ndarray:
    return np.array([one.raw() for one in subject.parameters])


def value(subject: FingerSubject, raw: np.ndarray, phi: dict[str, float]) -> np.ndarray:
    """Every row with the compiled effects of `phi`, without slopes, for which code of its own would be compiled."""
    found = subject.elastic.value(subject.base, raw, subject.elastic.amounts(phi))
    assert found is not None
    return found


def read(ready: Assembled, *made: tuple[Effect, dict[str, float]]) -> np.ndarray:
    changed = lay_out(ready.study, ready.solid, ready.mesh, ready.model.wired, effects=Effects((), made))
    return np.concatenate([np.asarray(each) for each in changed.predict().readings])


def test_every_effect_says_what_it_is() -> None:
    found = catalogue()
    assert len({effect.name for effect in found}) == len(found)
    for effect in found:
        assert effect.acts_on in ACTS_ON
        assert effect.leaves.endswith(".") and effect.confused_with.endswith(".")
        for size in effect.parameters:
            assert size.lower <= size.null <= size.upper and size.scale > 0 and size.unit


def test_compiled_effects_change_nothing_at_their_nulls(ready: Assembled, subject: FingerSubject) -> None:
    raw, without = start(subject), FingerSubject(ready, ())
    assert {effect.name for effect in COMPILED} == {effect.name for effect in subject.elastic.variants.compiled}
    nulls = {key: way.null for key, way in subject.elastic.ways.items() if subject.elastic.is_compiled(key)}
    # The two are compiled apart, and may add in another order.
    np.testing.assert_array_max_ulp(value(subject, raw, nulls), value(without, raw, {}), maxulp=2)


def test_effects_on_the_model_change_nothing_at_their_nulls(ready: Assembled) -> None:
    np.testing.assert_array_equal(read(ready, *((effect, effect.null()) for effect in MADE)), read(ready))


@pytest.mark.parametrize("effect", MADE, ids=lambda effect: effect.name)
def test_a_body_that_no_effect_changes_is_the_same_one(ready: Assembled, effect: Effect) -> None:
    amount = effect.null() | {size.name: size.null + 0.1 * size.scale for size in effect.parameters}
    amounts = Effects((), ((effect, amount),))
    made, anew = changed(ready, amounts), lay_out(ready.study, ready.solid, ready.mesh, ready.model.wired, effects=amounts)
    assert (made.model.body is ready.model.body) != effect.reshapes
    parts = ((one.model.body, one.model.columns, one.model.instruments.rigs) for one in (made, anew))
    assert eqx.tree_equal(*parts)


def test_slopes_of_compiled_effects_are_those_of_differences(subject: FingerSubject) -> None:
    raw, chosen_ways = start(subject), {}
    for key, way in subject.elastic.ways.items():
        if subject.elastic.is_compiled(key) and way.step is None and "second" not in way.name:
            chosen_ways.setdefault((way.family, way.name), key)
    keys = tuple(chosen_ways.values())
    scale = np.array([subject.elastic.ways[key].scale for key in keys])
    away = np.array([0.0 if key == "adhesion.work" else 0.1 for key in keys])
    at = np.array([subject.elastic.ways[key].null for key in keys]) + away * scale
    found = subject.evaluate(raw, dict(zip(keys, at, strict=True)), keys)
    assert found.usable and len(keys) >= 18
    for seed in range(3):
        way = scale * np.random.default_rng(seed).standard_normal(len(keys))
        ends = [value(subject, raw, dict(zip(keys, at + sign * 1e-5 * way, strict=True))) for sign in (1, -1)]
        Grade(1e-4, 1e-7, "contacts are decided anew on both sides").check(found.phi_jacobian @ way, (ends[0] - ends[1]) / 2e-5)


def test_slopes_under_adhesion_leave_out_no_more_than_it_says(subject: FingerSubject) -> None:
    """By its own work they are exact, by the material but for what closes a gap: less than adhesion's own share."""
    raw, key, work = start(subject), "adhesion.work", 0.05
    found = subject.evaluate(raw, {key: work}, (key,))
    own, layers = work * found.phi_jacobian[:, 0], np.eye(len(raw))[: len(SOFT_LAYERS)]
    assert np.max(np.abs(own)) > 0.01

    def slope(way: np.ndarray, more: float) -> np.ndarray:
        ends = [value(subject, raw + sign * way, {key: work + sign * more}) for sign in (1, -1)]
        return (ends[0] - ends[1]) / 2

    Grade(1e-6, 1e-10, "the forces are linear in the work").check(1e-3 * found.phi_jacobian[:, 0], slope(0 * raw, 1e-3))
    missing = np.sum([np.abs(found.theta_jacobian @ one - slope(1e-5 * one, 0.0) / 1e-5) for one in layers], axis=0)
    assert np.all(missing <= np.abs(own) + 1e-4 * np.abs(found.theta_jacobian).max(axis=1))


@pytest.mark.slow
def test_columns_are_there_for_every_effect_and_small_ones_follow_them(subject: FingerSubject) -> None:
    raw = start(subject)
    columns, base = subject.columns(raw), subject.evaluate(raw, {}, ()).prediction
    assert set(columns) == {one.key for family in subject.families for one in (*family.columns, *family.second)}
    assert all(np.isfinite(column).all() for column in columns.values())
    moved = subject.evaluate(raw, {"epidermis_thickness.share": 0.01}, ()).prediction
    thicker = columns["epidermis_thickness.share"]
    assert np.abs((moved - base) / 0.01 - thicker).max() <= 0.05 * np.abs(thicker).max()


@pytest.mark.parametrize("key", ["nail_compliance.compliance", pytest.param("bed_compliance.stiffness", marks=pytest.mark.slow)])
def test_what_a_support_would_leave_is_what_a_plausible_one_leaves(ready: Assembled, key: str) -> None:
    """Which the slope at the null is not, which is several times as large: a bed that hardly gives does so at the rim of the nail alone."""
    subject = FingerSubject(ready, tuple(effect for effect in catalogue() if effect.name == key.split(".")[0]))
    raw, size = start(subject), subject.elastic.ways[key].scale
    column = subject.columns(raw)[key]
    left = (subject._value(raw, {key: size}) - subject._value(raw, {})) / size
    for rows in subject.rows.blocks.values():
        assert 1.0 < np.linalg.norm(column[rows]) / np.linalg.norm(left[rows]) < 2.5
        assert column[rows] @ left[rows] > 0.999 * np.linalg.norm(column[rows]) * np.linalg.norm(left[rows])


@pytest.mark.parametrize(
    ("name", "acting"),
    [
        ("indenter_tilt", {"plate_pitch": ["plate", "held"], "probe_pitch": ["ramp"]}),
        ("tip_radius", {"wedge_wider": ["wedge"], "probe_wider": ["ramp"]}),
    ],
)
def test_instruments_err_each_on_their_own(ready: Assembled, name: str, acting: dict[str, list[str]]) -> None:
    """A plate may lean where a probe does not, and a wedge be blunt; where only one of them was used only its number is asked for."""
    effect = next(effect for effect in catalogue() if effect.name == name)
    names, measurements = ready.model.instruments.names, {one.name: one for one in ready.study.measurements}
    untouched = rigs.plans(ready.study.measurements, ready.solid, ready.model.wired)
    for number, expected in acting.items():
        there = Effects((), ((effect, effect.null() | {number: 0.1}),))
        assert [names[plan.index] for plan in untouched if not eqx.tree_equal(plan.changed(there).indenter, plan.indenter)] == expected
        assert [column.name for column in family(effect, [measurements[expected[0]]]).columns] == [number]
    assert [column.name for column in family(effect, ready.study.measurements).columns] == list(acting)


@pytest.mark.slow
def test_a_plate_that_leans_reads_otherwise_and_a_probe_does_not(ready: Assembled) -> None:
    tilt = next(effect for effect in catalogue() if effect.name == "indenter_tilt")
    names, ends = ready.model.instruments.names, np.cumsum([0, *ready.model.instruments.lengths])
    moved = np.abs(read(ready, (tilt, tilt.null() | {"plate_pitch": 0.1})) - read(ready)) > 1e-6
    read_otherwise = [name for name, start, end in zip(names, ends, ends[1:], strict=False) if moved[start:end].any()]
    assert read_otherwise == ["plate", "held"]


@pytest.mark.slow
def test_softer_supports_and_stiffer_films_do_what_their_names_say(ready: Assembled) -> None:
    by_name = {effect.name: effect for effect in catalogue()}
    plate = ready.model.instruments.names.index("plate")
    rows = slice(*np.cumsum([0, *ready.model.instruments.lengths])[plate : plate + 2])

    def force(name: str, **amount: float) -> float:
        return float(read(ready, (by_name[name], amount))[rows][-1])

    held = float(read(ready)[rows][-1])
    assert force("nail_compliance", compliance=100.0) < force("nail_compliance", compliance=20.0) < held
    # Nodes of the rim, on no whole facet of the nail, are free.
    assert force("nail_compliance", compliance=1e-4) == pytest.approx(held, rel=0.02)
    assert force("bed_compliance", stiffness=0.02) > held
    assert force("stratum_corneum", membrane_stiffness=0.1) > held
    assert force("skin_pretension", tension=0.01) > held
    assert force("anisotropy", fibres=1.0) > held
    # Thicknesses and the bone's place act on both sides of a bone that the tissue carries: their sign is the finger's to say.
    assert abs(force("dermis_thickness", share=0.2) / held - 1) > 1e-3
    assert abs(force("bone_offset", dorsal=0.3) / held - 1) > 1e-3


def test_a_gradient_leaves_the_layers_mean_stiffness_alone(ready: Assembled) -> None:
    gradient = next(effect for effect in catalogue() if effect.name == "depth_gradient")
    made = lay_out(ready.study, ready.solid, ready.mesh, ready.model.wired, effects=Effects((), ((gradient, {"gradient": 0.5}),)))
    ratio = np.asarray(made.model.body.weight_along / ready.model.body.weight_along)[0]
    layer = np.asarray(ready.model.body.layer)
    assert np.all(ratio[layer < 2] == 1.0)
    assert 0.5 <= ratio[layer >= 2].min() < 0.8 and 1.2 < ratio[layer >= 2].max() < 1.5 + 1e-9


def test_thicker_dermis_has_that_much_more_of_it() -> None:
    """Its inner surface alone moves: nodes of the outer one stay, and what the dermis gains adipose tissue loses."""
    thicker = next(effect for effect in catalogue() if effect.name == "dermis_thickness")
    solid = preset("monkey")
    finger = build_finger(solid, Resolution(0.8))
    moved = thicker.shape(finger, solid, {"share": 0.2})
    before, after = (np.bincount(one.layer, volumes(one.nodes, one.tets)) for one in (finger, moved))
    np.testing.assert_allclose(after[[0, 3, 4]], before[[0, 3, 4]], rtol=1e-6)
    # A fifth more of the thickness on the inner, smaller side of a curved layer is a little less than a fifth of the volume.
    assert 1.17 < after[1] / before[1] < 1.2
    assert after[1] + after[2] == pytest.approx(before[1] + before[2], rel=1e-6)


@pytest.mark.parametrize("name", ["epidermis_thickness", "dermis_thickness"])
def test_where_layers_thicken_the_skin_stays(name: str) -> None:
    """To the last bit, the middle of an edge too that was straightened and lies beneath the skin that its ends are on."""
    thicker = next(effect for effect in catalogue() if effect.name == name)
    solid = preset("monkey")
    finger = build_finger(solid, Resolution(1.2))
    nodes, skin = finger.nodes.copy(), np.unique(finger.skin)
    middle = int(finger.skin[len(finger.skin) // 2, 3])
    nodes[middle, :2] *= 0.98
    finger = dataclasses.replace(finger, nodes=nodes, key="")
    moved = thicker.shape(finger, solid, {"share": 0.2})
    assert np.array_equal(moved.nodes[skin], nodes[skin]) and not np.array_equal(moved.nodes, nodes)


@pytest.mark.slow
def test_both_solvers_feel_the_same_springs(ready: Assembled) -> None:
    corneum = next(effect for effect in catalogue() if effect.name == "stratum_corneum")
    fibres = next(effect for effect in catalogue() if effect.name == "anisotropy")
    tissue = body(ready.finger, bone="rigid")
    for effect, amount in ((corneum, {"membrane_stiffness": 0.05}), (fibres, {"fibres": 0.8})):
        tissue = effect.support(tissue, ready.finger, ready.solid, amount)
    lame = ready.model.instruments.materials({})[0].lame()
    load = jnp.zeros((1, *tissue.nodes.shape)).at[0, ready.finger.skin[len(ready.finger.skin) // 2], 1].set(0.01)
    direct, iterated = solver_for(tissue, "factorised"), solver_for(tissue, "multigrid")
    assert isinstance(direct, Factorised) and isinstance(iterated, MultigridCG)
    one, other = (solver.undo(Elastic(tissue, lame), load).displacement for solver in (direct, iterated))
    Grade(1e-6, 1e-12, "two solvers, to 1e-8 and 1e-9").check(other, one)


SQUARE = np.array([[0, 0, 0], [2, 0, 0], [0, 0, 1], [1, 0, 0], [1, 0, 0.5], [0, 0, 0.5]], float)


def test_films_beds_and_tensions_store_what_theory_says() -> None:
    flat = facets(SQUARE, np.arange(6)[None])
    assert flat.area.sum() == pytest.approx(1.0)
    stretch = np.zeros((6, 3))
    stretch[:, 0], stretch[:, 2] = 0.01 * SQUARE[:, 0], -0.004 * SQUARE[:, 2]
    lift = np.zeros((6, 3))
    lift[:, 1] = 0.02 * SQUARE[:, 0] - 0.01 * SQUARE[:, 2]

    def energy(matrix: object, u: np.ndarray) -> float:
        held = springs(matrix)  # type: ignore[arg-type]
        return 0.5 * float(jnp.vdot(jnp.asarray(u), held.force(held.value, jnp.asarray(u))))

    # E t / (2 (1 - nu^2)) (e1^2 + 2 nu e1 e2 + e2^2) per area.
    expected = (0.01**2 - 2 * 0.4 * 0.01 * 0.004 + 0.004**2) / (2 * (1 - 0.4**2))
    assert energy(film(flat, 6, 0.4), stretch) == pytest.approx(expected, rel=1e-12)
    assert energy(film(flat, 6, 0.4), lift) == pytest.approx(0.0, abs=1e-18)
    assert energy(tension(flat, 6), lift) == pytest.approx(0.5 * (0.02**2 + 0.01**2), rel=1e-12)
    assert energy(bed(flat, 6), np.full((6, 3), 0.1)) == pytest.approx(0.5 * 3 * 0.01, rel=1e-12)
    # No motion of six nodes goes unnoticed, and the integral of the square of a quadratic is exact.
    assert np.linalg.eigvalsh(bed(flat, 6).toarray()).min() > 1e-4
    bowl = np.zeros((6, 3))
    bowl[:, 1] = SQUARE[:, 0] ** 2
    assert energy(bed(flat, 6), bowl) == pytest.approx(0.5 * 16 / 15, rel=1e-12)  # of x^4 over the triangle


def context(time: np.ndarray, displacement: np.ndarray) -> Context:
    previous = np.maximum(np.arange(len(time)) - 1, 0)
    table = {"time": jnp.asarray(time), "displacement": jnp.asarray(displacement)}
    rows = jnp.arange(len(time))
    return Context(table, rows, jnp.asarray(previous), jnp.zeros(len(time), int), "ramp", "force_displacement", False)


@pytest.mark.parametrize(("time", "since"), [([2.0, 4.0, 6.0], [2.0, 4.0, 6.0]), ([900.0, 902.0, 904.0], [0.0, 2.0, 4.0]), ([3.0], [0.0])])
def test_a_trace_begins_at_its_clocks_zero_unless_that_is_a_sessions(time: list[float], since: list[float]) -> None:
    np.testing.assert_array_equal(context(np.array(time), np.zeros(len(time))).since_start(), since)


@pytest.mark.parametrize(
    ("time", "trace", "since"),
    [
        ([0.3, 0.3, 3.0, 3.0], [0, 0, 1, 1], [0.3, 0.3, 3.0, 3.0]),
        ([900.0, 902.0, 904.0], [0, 1, 2], [0.0, 0.0, 0.0]),
        ([2.0, 2.0, 2.0], [0, 1, 2], [0.0, 0.0, 0.0]),
        ([0.5, 3.0, 901.0, 902.0], [0, 1, 2, 2], [0.5, 3.0, 0.0, 1.0]),
    ],
)
def test_traces_of_one_instant_share_a_clock_where_it_begins_at_zero(time: list[float], trace: list[int], since: list[float]) -> None:
    rows = jnp.arange(len(time))
    apart = Context({"time": jnp.asarray(time)}, rows, rows, jnp.asarray(trace), "rates", "spike_rate", False)
    np.testing.assert_array_equal(apart.since_start(), since)


def test_relaxation_of_a_ramp_and_hold_is_its_convolution() -> None:
    relaxation = next(effect for effect in catalogue() if effect.name == "relaxation")
    time = np.array([0.0, 0.1, 0.25, 0.4, 1.0, 2.0, 5.0])
    force = np.minimum(time / 0.4, 1.0) * 2.0
    said = Reading(*[jnp.asarray(force)] * 4, context(time, force))
    share, tau = 0.4, 0.7
    amount = relaxation.null() | {"share": share, "time": tau}
    found = relaxation.read(said, {name: jnp.asarray(value) for name, value in amount.items()}).value

    def exact(t: float) -> float:
        s = np.linspace(0.0, min(t, 0.4), 20001)
        return float(np.trapezoid((1 - share * (1 - np.exp(-(t - s) / tau))) * 5.0, s))

    Grade(1e-7, 1e-9, "the trapezoidal rule on 20,000 steps").check(found, [exact(t) for t in time])


def test_a_lagging_force_follows_its_filter() -> None:
    lag = next(effect for effect in catalogue() if effect.name == "force_lag")
    time = np.linspace(0.0, 1.0, 11)
    force = 3.0 * time
    said = Reading(*[jnp.asarray(force)] * 4, context(time, force))
    found = lag.read(said, {"time": jnp.asarray(0.05)}).value
    Grade(1e-12, 1e-12, "exact for a ramp").check(found, 3.0 * (time - 0.05 * (1 - np.exp(-time / 0.05))))
    slope = jax.jacfwd(lambda t: lag.read(said, {"time": t}).value)(jnp.asarray(0.0))
    DIFFERENCED.check(slope, np.where(time > 0, -3.0, 0.0))


def test_a_clock_that_began_late_moves_corners_and_leaves_them_sharp() -> None:
    late = next(effect for effect in catalogue() if effect.name == "clock_offset")
    time = np.linspace(0.0, 1.0, 21)

    def corner(t: np.ndarray) -> np.ndarray:
        return 3.0 * np.clip(t, 0.0, 0.5)

    two = Context(
        {"time": jnp.asarray(np.tile(time, 2)), "displacement": jnp.asarray(np.tile(corner(time), 2))},
        jnp.arange(42),
        jnp.asarray(np.where(np.arange(42) % 21 > 0, np.arange(42) - 1, np.arange(42))),
        jnp.repeat(jnp.arange(2), 21),
        "ramp",
        "force_displacement",
        False,
    )
    force = jnp.asarray(np.concatenate([corner(time), 2 * corner(time)]))
    said = Reading(force, force, force, force, two)
    found = late.read(said, {"delay": jnp.asarray(0.15)}).value
    Grade(1e-12, 1e-12, "knots fall on knots").check(found, np.concatenate([corner(time - 0.15), 2 * corner(time - 0.15)]))
    sooner = late.read(said, {"delay": jnp.asarray(-0.125)}).value
    moved = corner(np.minimum(time + 0.125, 1.0))
    Grade(1e-12, 1e-12, "straight where the rows are").check(sooner[:7], moved[:7])
    between = PchipInterpolator(time, corner(time))(np.minimum(time + 0.125, 1.0))
    Grade(1e-12, 1e-12, "cubics elsewhere").check(sooner, np.concatenate([between, 2 * between]))
    np.testing.assert_array_equal(late.read(said, {"delay": jnp.asarray(0.0)}).value, force)
    slope = jax.jacfwd(lambda delay: late.read(said, {"delay": delay}).value)(jnp.asarray(0.0))
    rising = np.where((time > 0) & (time < 0.475), -3.0, 0.0)  # at the corner cubics are flat
    DIFFERENCED.check(slope, np.concatenate([rising, 2 * rising]))


def test_adhesion_of_a_sphere_is_what_jkr_tends_to() -> None:
    """Johnson, Kendall & Roberts (1971) on an elastic half-space, as the work of adhesion goes to nothing."""
    adhesion = next(effect for effect in catalogue() if effect.name == "adhesion")
    E, R, d = 0.05, 4.0, 0.5  # MPa of plane strain, mm, mm

    def jkr(a: np.ndarray, w: float) -> tuple[np.ndarray, np.ndarray]:
        """Travel, mm, and force, N, at a contact radius, mm, and work of adhesion, N/mm."""
        return a**2 / R - np.sqrt(2 * np.pi * a * w / E), 4 * E * a**3 / (3 * R) - np.sqrt(8 * np.pi * w * E * a**3)

    force = 4 * E * np.sqrt(R) * d**1.5 / 3
    by_travel, by_force = np.array([np.pi * R]), np.array([np.pi * R / (2 * E * np.sqrt(R * d))])
    one = context(np.zeros(1), np.array([d]))
    wrong = []
    for work in (4e-4, 1e-4):  # N/m
        a = np.linspace(0.95, 1.05, 200001) * np.sqrt(R * d)
        travel, held = jkr(a, 1e-3 * work)
        for forced, grown, start, exact in (
            (False, by_travel, force, np.interp(d, travel, held)),
            (True, by_force, d, np.interp(force, held, travel)),
        ):
            begun = jnp.array([start])
            said = Reading(begun, begun, begun, jnp.asarray(grown), dataclasses.replace(one, forced=forced))
            found = float(adhesion.read(said, {"work": jnp.asarray(work)}).value[0])
            wrong.append((found - exact) / (exact - start))
    assert np.all(np.abs(wrong) < 0.04)
    np.testing.assert_allclose(np.array(wrong[:2]) / wrong[2:], 2.0, rtol=0.1)  # what is left out is of order w^(3/2)


def test_how_contact_grows_is_read_off_from_the_depths_that_were_asked_for(ready: Assembled) -> None:
    rig = next(each for each in ready.model.instruments.rigs if each.kind == "force_displacement")
    depth = jnp.array([0.8, 0.2, 0.5, 0.2, 0.4, 0.0, -0.1])
    place = jnp.array([0, 0, 0, 1, 0, 0, 0])
    one = dataclasses.replace(rig, imposed=depth, pose=place, variant=jnp.zeros(7, int))
    area = jnp.where(place == 0, 3.0, 7.0) * jnp.maximum(depth, 0.0) ** 1.3
    found = growth(one, area)
    Grade(1e-12, 1e-12, "exact for a power law").check(found[jnp.array([0, 1, 2, 4])], 3.9 * depth[jnp.array([0, 1, 2, 4])] ** 0.3)
    SAME_ARITHMETIC.check(found[3], area[3] / 0.2)
    np.testing.assert_array_equal(found[5:], 0.0)
    assert np.isfinite(jax.jacfwd(lambda area: growth(one, area))(area)).all()


def test_saturation_and_power_law_keep_silence_silent() -> None:
    rates = jnp.asarray([0.0, 10.0, 50.0, 90.0])
    said = Reading(rates, rates, rates, rates, dataclasses.replace(context(np.arange(4.0), np.arange(4.0)), kind="spike_rate"))
    by_name = {effect.name: effect for effect in catalogue()}
    bent = by_name["rate_power_law"].read(said, {"exponent_beyond_one": 0.5}).value
    SAME_ARITHMETIC.check(bent, [0.0, 10 * 0.2**0.5, 50.0, 90 * 1.8**0.5])
    capped = by_name["rate_saturation"].read(said, {"slowing": 0.01}).value
    SAME_ARITHMETIC.check(capped, [0.0, 10 / 1.1, 50 / 1.5, 90 / 1.9])


OWN = """
import dataclasses
from fingerjax.effects import Effect, Size

class DampGlove(Effect):
    name = "damp_glove"
    acts_on = "instrument"
    leaves = "Forces read a little high."
    confused_with = "force_offset."
    parameters = (Size("more", "N", 0.01, -0.03, 0.03),)

    def read(self, reading, amount):
        return dataclasses.replace(reading, value=reading.value + amount["more"]) if reading.is_force else reading
"""


def test_a_laboratorys_own_effect_is_found_in_its_folder(tmp_path: Path) -> None:
    (tmp_path / "glove.py").write_text(OWN)
    found = {effect.name: effect for effect in catalogue(tmp_path)}
    assert set(found) - {effect.name for effect in catalogue()} == {"damp_glove"}


@pytest.mark.slow
def test_a_laboratorys_own_effect_acts_on_the_readings_that_it_names(tmp_path: Path, ready: Assembled) -> None:
    (tmp_path / "glove.py").write_text(OWN)
    subject = FingerSubject(ready, tuple(effect for effect in catalogue(tmp_path) if effect.name == "damp_glove"))
    column = subject.columns(start(subject))["damp_glove.more"]
    forces = np.concatenate([np.full(n, one in ("plate", "ramp")) for one, n in zip(*_names(ready), strict=True)])
    np.testing.assert_array_equal(column, forces.astype(float))


def _names(ready: Assembled) -> tuple[tuple[str, ...], tuple[int, ...]]:
    return ready.model.instruments.names, ready.model.instruments.lengths


def test_a_file_that_is_no_effect_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "empty.py").write_text("x = 1\n")
    with pytest.raises(InputError, match="defines no effect"):
        catalogue(tmp_path)
    (tmp_path / "empty.py").write_text(OWN.replace("damp_glove", "force_gain"))
    with pytest.raises(InputError, match="there already"):
        catalogue(tmp_path)
    (tmp_path / "empty.py").write_text("raise ValueError('no')\n")
    with pytest.raises(InputError, match="cannot be read"):
        catalogue(tmp_path)
    two = OWN[: OWN.index("    def ")].replace("0.03),)", '0.03), Size("less", "N", 0.01, 0.0, 0.03))')
    (tmp_path / "empty.py").write_text(two + "    def force(self, body, finger, solid):\n        return lambda lame, u: 0.0 * u\n")
    with pytest.raises(InputError, match="so many times that force"):
        catalogue(tmp_path)


def test_effects_are_chosen_by_name() -> None:
    assert chosen("none", catalogue()) == () and chosen("all", catalogue()) == catalogue()
    assert [effect.name for effect in chosen(("force_gain",), catalogue())] == ["force_gain"]
    with pytest.raises(InputError, match="no such effect"):
        chosen(("force_gian",), catalogue())


def test_effects_that_the_data_cannot_show_say_why(tmp_path: Path) -> None:
    study = study_of(tmp_path, {"plate": OF["plate"]}, finger={"preset": "monkey", "resolution": COARSE})
    subject = FingerSubject(assemble(study), catalogue())
    assert subject.absent["rate_saturation"] == "no spike rate was measured"
    assert subject.absent["relaxation"] == "no force was read against time"
    assert "force_gain" in subject.effects
