"""What a fit says of itself, in figures: certified problems, recovery, the paper's grid, intervals four ways, the next experiment.

`--quick` takes coarse meshes and few repeats; `--full` the meshes of 8,500 nodes everywhere and all 256 models of the grid one by one.
"""

from __future__ import annotations

import dataclasses
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks._parts import Part, run_parts
from benchmarks._record import Figure, at_least, at_most, between, listed
from fingerjax.finger_keys import MeshResolution
from fingerjax.forward import Assembled, assemble
from fingerjax.forward.model import noise_of, softened
from fingerjax.identify import Fit, Problem, bootstrap, fit, profiles, refined, sample, uncertainty
from fingerjax.identify.bootstrap import REGULAR, agreement
from fingerjax.identify.design import recommend
from fingerjax.identify.directions import sentences
from fingerjax.identify.grid import DECADES, grid
from fingerjax.identify.weighing import Chain, Counted, Redrawn
from fingerjax.indenter_spec import IndenterSpec
from fingerjax.layers import SOFT_LAYERS
from fingerjax.measurements import Measurement
from fingerjax.runners.certainty import warnings_of
from fingerjax.study import Fit as Fitted
from fingerjax.study import Study, load_studies
from tests.nist import CERTIFIED

ROOT = Path(__file__).resolve().parent.parent
TRUTH = ROOT / "fits" / "synthetic" / "layer_ratios" / "truth.yaml"
NAMES = tuple(f"{layer}.modulus" for layer in SOFT_LAYERS)
MODULI = dict(zip(NAMES, (0.14, 0.02, 0.009, 0.03), strict=True))  # MPa, off the powers of ten
COARSE, PAPER = MeshResolution(pad_mm=1.2, proximal_mm=3.0), MeshResolution(pad_mm=0.5, proximal_mm=1.5)
LADDER = tuple(MeshResolution(pad_mm=0.9 / f, proximal_mm=2.7 / f) for f in (1.0, 2**0.5, 2.0))  # from the paper's 8,500 nodes of a human
SEED = 11
TIMED = 3  # fits, of which the median is told: one takes seconds, the grid minutes
FEW = 100  # repeats where widths have no goal, since the problem is not regular


def parts(full: bool) -> dict[str, Part]:
    """Each part on a mesh of its own."""
    return {
        "certified": lambda quick: certified(),
        "recovery": lambda quick: recovery(_studies()["layer_ratios_simulated"], 20 if quick else 200, fine=not quick),
        "grid": lambda quick: beside_the_grid(_studies()["layer_study"], (3, 4) if quick else DECADES, every=full, fine=full),
        "intervals": lambda quick: four_ways(_studies(), *((60, 60) if quick else (400, 250)), fine=full),
        "design": lambda quick: next_experiment(_studies()["layer_study"], 10 if quick else 100, fine=full),
        "unseen": lambda quick: not_seen(_studies()["layer_study"]),
    }


def _studies() -> dict[str, Study]:
    return load_studies(ROOT / "experiments.yaml", os.environ.get("FINGERJAX_DATA"))


# ---- certified ----


def certified() -> Iterator[Figure]:
    """Digits to which the certified sets of NIST are met, the worst of all parameters."""
    import jax.numpy as jnp

    from fingerjax.identify import Health
    from fingerjax.parameters import Parameter

    values, errors = [], []
    for case in CERTIFIED:
        started = tuple(Parameter(f"b{j}", value) for j, value in enumerate(case.starts[1]))

        def residuals(raw: Any, case: Any = case, started: Any = started) -> Any:
            b = [one.natural(raw[j]) for j, one in enumerate(started)]
            return case.model(jnp.asarray(case.x), b) - jnp.asarray(case.y), Health(jnp.array(True), jnp.array(1), jnp.array(0.0))

        problem = Problem(started, residuals, {"data": slice(0, len(case.y))}, {"data": "assumed"})
        found = fit(problem, max_steps=400, gradient_tolerance=1e-9)
        known = uncertainty(found).estimates
        values.append(max(abs(one.value / exact - 1) for one, exact in zip(known, case.values, strict=True)))
        errors.append(max(abs(one.standard_error / exact - 1) for one, exact in zip(known, case.deviations, strict=True)))
    yield at_least("NIST: digits of the parameters, worst of all", -math.log10(max(values)), "1", 6.0, f"{len(CERTIFIED)} sets")
    yield at_least("NIST: digits of the standard errors, worst of all", -math.log10(max(errors)), "1", 4.0)


# ---- recovery ----


def recovery(study: Study, repeats: int, fine: bool) -> Iterator[Figure]:
    """Fits to data of the brick program with new noise each time, corrected to finer meshes, whose error is counted in the intervals."""
    truth = yaml.safe_load(TRUTH.read_text())
    clean = {"cylinder_3mm": "cylinder_3_profile", "cylinder_9mm": "cylinder_9_profile", "plate_force": "plate_force"}
    measured = tuple(_first_trial(one, truth["noiseless"][clean[one.name]]) for one in study.measurements)
    coarse, *finer = [assemble(_on(study, measured, mesh)) for mesh in (LADDER if fine else (COARSE, LADDER[0]))]
    first = fit(coarse.problem())
    if not first.settled:
        yield Figure("recovery", math.nan, "1", "an optimum", False, first.reason)
        return
    steps = refined(first, [each.problem() for each in finer], softer=softened(finer[-1]).problem())
    found = steps.best
    raw = np.log([truth["moduli_MPa"][name.partition(".")[0]] for name in found.problem.names])
    noise = np.sqrt(uncertainty(found).covariance.diagonal())
    whole = np.sqrt(uncertainty(found, spread=steps.spread).covariance.diagonal()) if len(steps.shifts) else noise
    ends = _redrawn(found, repeats)
    inside = np.abs(ends - found.raw) <= 1.96 * noise
    bias = np.abs(ends.mean(axis=0) - found.raw) / noise
    nodes = ", ".join(str(len(each.finger.nodes)) for each in (coarse, *finer[: len(steps.shifts)]))
    note = f"elements of {nodes} nodes, {repeats} repeats; {found.reason}"
    yield between("recovery: 95 % interval holds the fit to the same data without noise", 100 * inside.mean(), "%", 93.0, 97.0, note)
    yield at_most("recovery: largest bias over standard error, from the same", bias.max(), "1", 0.25, f"{repeats} repeats")
    held = np.abs(ends - raw) <= 1.96 * whole
    note = "all parameters; the mesh's share is the same in every repeat, so that it is all or nothing where it is larger than the noise's"
    yield between("recovery: 95 % interval with the mesh's error holds the truth", 100 * held.mean(), "%", 93.0, 97.0, note)
    alone = np.abs(ends - raw) <= 1.96 * noise
    yield Figure("recovery: 95 % interval of noise alone holds the truth", 100 * float(alone.mean()), "%")
    counted = np.abs(ends.mean(axis=0) - raw) / whole
    worst = found.problem.names[int(counted.argmax())]
    note = f"{repeats} repeats; limited by what both programs' meshes leave in {worst}: the same in every repeat"
    yield at_most("recovery: largest bias from the truth over standard error with the mesh's", counted.max(), "1", 0.25, note)
    for j, name in enumerate(found.problem.names):
        off = ", ".join(f"{100 * math.expm1(each.raw[j] - raw[j]):+.2g} %" for each in steps.fits)
        note = f"on each mesh, then half-way to softer elements: {off}; "
        note += f"standard error of noise {100 * noise[j]:.2g} %, with the mesh's {100 * whole[j]:.2g} %"
        yield Figure(f"recovery: {name}, error without noise", 100 * math.expm1(found.raw[j] - raw[j]), "%", note=note)


def _first_trial(one: Measurement, reading: list[float]) -> Measurement:
    """The rows of the first trial, with readings that have no noise in them."""
    kept = np.flatnonzero(one.table["trial"] == one.table["trial"][0])
    table = {name: column[kept] for name, column in one.table.items() if name != "trial"}
    assert one.sigma is not None
    return dataclasses.replace(one, table={**table, one.value: np.array(reading)}, sigma=one.sigma[kept], rows=one.rows[kept])


def _redrawn(found: Fit, repeats: int) -> np.ndarray:
    """(repeats, p): raw values of fits to the same readings with new noise."""
    random = np.random.default_rng(SEED)
    ends = []
    for _ in range(repeats):
        noise = random.standard_normal(found.residual.size)
        ends.append(fit(found.problem, start=found.raw, weighing=Redrawn(noise), gradient_tolerance=1e-4).raw)
    return np.array(ends)


def _on(study: Study, measured: tuple[Measurement, ...], mesh: MeshResolution, free: tuple[str, ...] = NAMES) -> Study:
    finger = study.finger.model_copy(update={"resolution": mesh})
    return dataclasses.replace(study, kind="fit", finger=finger, measurements=measured, fit=Fitted(free=free), options=None)


# ---- the grid ----


def beside_the_grid(study: Study, decades: tuple[int, ...], every: bool, fine: bool) -> Iterator[Figure]:
    """The fit of four moduli to four depths under a blunt line, profile and force, beside all powers of ten."""
    ready = _with_own_data(assemble(_on(study, (wedge_profile((0.5, 1.0, 1.5, 2.0)), wedge_force()), PAPER if fine else COARSE)))
    problem = ready.problem()
    fit(problem, max_steps=1)  # compiles
    ready.predict()
    timed = [_timed(lambda: fit(problem)) for _ in range(TIMED)]
    found, seconds = timed[-1][0], float(np.median([took for _, took in timed]))
    tried = grid(ready, decades, share=not every)
    alone = tried.seconds / tried.solves
    known = uncertainty(found)
    cost = f"fit {seconds:.1f} s, {found.evaluations} runs; grid {tried.seconds:.1f} s, {tried.solves} solves"
    each = seconds / found.evaluations / alone
    note = f"{len(ready.finger.nodes)} nodes; {cost}; limited by the number of runs: {256 / 50 / each:.1f} would do"
    yield at_least("grid of 256 over the fit, time", 256 * alone / seconds, "1", 50.0, note)
    yield Figure("a run of the model with its Jacobian over one without", each, "1")
    yield at_least("best of the grid over the fit, chi-square", tried.best.chi2 / found.chi2, "1", 1.0, tried.best.name)
    yield at_least("moduli of the fit with an interval", sum(one.identified for one in known.estimates), "1", 4.0)
    worst = max(abs(math.log(one.value / MODULI[one.name])) for one in known.estimates)
    nearest = max(abs(math.log(tried.best.moduli[layer] / MODULI[f"{layer}.modulus"])) for layer in SOFT_LAYERS)
    yield Figure("largest error of a modulus, fit", 100 * math.expm1(worst), "%")
    yield Figure("largest error of a modulus, grid", 100 * math.expm1(nearest), "%")


def _timed(work: Callable[[], Fit]) -> tuple[Fit, float]:
    began = time.perf_counter()
    return work(), time.perf_counter() - began


def wedge_profile(depths: tuple[float, ...], name: str = "profile") -> Measurement:
    along = np.arange(-4.0, 4.01, 0.5)
    depth = np.repeat(depths, len(along))
    columns = {"depth": depth, "distance": np.tile(along, len(depths)), "deflection": np.zeros(len(depth))}
    return _asked(name, "deflection_profile", columns, "deflection", 0.01 * max(depths), _wedge())


def wedge_force() -> Measurement:
    columns = {"displacement": np.array([0.5, 1.0, 1.5, 2.0]), "force": np.zeros(4)}
    return _asked("force", "force_displacement", columns, "force", 0.001, _wedge())


def pressed(name: str, spec: IndenterSpec, travel: float, sigma: float = 0.002) -> Measurement:
    columns = {"displacement": np.array([travel]), "force": np.zeros(1)}
    return _asked(name, "force_displacement", columns, "force", sigma, spec)


def _wedge() -> IndenterSpec:
    """A blunt one: under the sharp wedge the mesh is refined to four times the nodes that the goal is set for."""
    return IndenterSpec("cylinder", {"radius": 1.0}, "x")


def _asked(name: str, kind: str, columns: dict[str, np.ndarray], value: str, sigma: float, spec: IndenterSpec) -> Measurement:
    spread = np.full(len(columns[value]), sigma)
    return Measurement(name, kind, columns, value, spread, {"": spec}, "displacement", "z", None, None)


def _with_own_data(ready: Assembled, moduli: dict[str, float] = MODULI) -> Assembled:
    """The study with its own readings at given moduli, and noise of the stated size."""
    random, prediction = np.random.default_rng(SEED), ready.predict(moduli)
    measured = []
    for one, reading in zip(ready.study.measurements, prediction.readings, strict=True):
        noisy = np.asarray(reading) + noise_of(one)[0] * random.standard_normal(len(one))
        measured.append(dataclasses.replace(one, table={**one.table, one.value: noisy}))
    return dataclasses.replace(ready, study=dataclasses.replace(ready.study, measurements=tuple(measured)))


# ---- intervals four ways ----


def four_ways(studies: dict[str, Study], repeats: int, steps: int, fine: bool) -> Iterator[Figure]:
    """Widths of other intervals over the linearised one: profile, bootstrap and samples, of Table 1, of the measured set, if there, and of
    the simulated one.
    """
    table1, real = load_studies(ROOT / "fits" / "measured" / "table1.yaml")["table1"], studies["layer_ratios"]
    for study in (table1, *(() if real.missing_data else (real,)), studies["layer_ratios_simulated"]):
        resolution = study.finger.resolution if fine or study is table1 else COARSE
        finger = study.finger.model_copy(update={"resolution": resolution})
        ready = assemble(dataclasses.replace(study, finger=finger, diagnose=None))
        found = fit(ready.problem())
        if not found.settled:
            yield Figure(f"{study.name}: intervals", math.nan, "1", "an optimum", False, found.reason)
            continue
        scale = study.model.moduli()["epidermis"] if study is table1 else 1.0
        yield from intervals(study.name, found, repeats, steps, f"{len(ready.finger.nodes)} nodes", scale)


def intervals(study: str, found: Fit, repeats: int, steps: int, mesh: str, scale: float) -> Iterator[Figure]:
    """`scale`: MPa in a parameter of one. A problem is regular where every profile is as wide as its linearised interval; where one is
    not, widths have no goal, but its parameter must be named in the report.
    """
    known, lines = uncertainty(found), profiles(found)
    wide = {one.parameter.name: agreement(known, one.parameter.name, one.lower, one.upper) if one.bounded else math.nan for one in lines}
    odd = [name for name, ratio in wide.items() if not abs(ratio - 1) <= REGULAR]
    repeats = min(repeats, FEW) if odd else repeats
    again, drawn = bootstrap(found, repeats=repeats, seed=SEED), sample(found, steps=steps, seed=SEED) if known.identified else None
    if odd:
        said = warnings_of(found, known, lines, again, drawn)
        named = sum(any(name in each for each in said) for name in odd)
        yield at_least(f"{study}: parameters that are not regular and named as such", named / len(odd), "1", 1.0, " ".join(said))

    def over(figure: str, ratio: float, note: str) -> Figure:
        if odd:
            return Figure(figure, ratio, "1", note=note)
        return between(figure, ratio, "1", 1 - REGULAR, 1 + REGULAR, note)

    for line in lines:
        name = line.parameter.name
        note = f"{mesh}; {scale * known[name].value:.3g} MPa ({scale * line.lower:.3g} to {scale * line.upper:.3g}); {line.verdict()}"
        yield over(f"{study}: {name}, profile over linearised", wide[name], note)
        often = agreement(known, name, *again.interval(name))
        yield over(f"{study}: {name}, bootstrap over linearised", often, f"{repeats} repeats")
        if drawn is not None:
            often = agreement(known, name, *drawn.interval(name))
            yield over(f"{study}: {name}, samples over linearised", often, drawn.verdict())


# ---- the next experiment ----


def next_experiment(study: Study, repeats: int, fine: bool) -> Iterator[Figure]:
    """A third experiment chosen after two, made again and again: the standard error of one modulus against what was predicted of it."""
    base = (wedge_profile((1.0,)), pressed("plate", IndenterSpec("flat_plate"), 0.8))
    candidates = (
        pressed("plate_deep", IndenterSpec("flat_plate"), 1.5),
        pressed("ball", IndenterSpec("sphere", {"radius": 2.0}), 1.0),
        pressed("small_ball", IndenterSpec("sphere", {"radius": 1.0}), 0.6),
        pressed("bar", IndenterSpec("cylinder", {"radius": 1.5}, "x"), 1.0),
        wedge_profile((2.0,), "deep_profile"),
        wedge_profile((0.5,), "shallow_profile"),
    )
    aim = "adipose.modulus"
    ready = _with_own_data(assemble(_on(study, (*base, *candidates), PAPER if fine else COARSE)))
    problem, blocks = ready.problem(), {one.name: ready.problem().blocks[one.name] for one in (*base, *candidates)}
    known = _chosen(blocks, [one.name for one in base])
    first = fit(problem, weighing=Counted(known))
    seen = {one.name: first.jacobian[blocks[one.name]] for one in candidates}
    advice = recommend(_only(first, known), seen, criterion="c", target=aim, choose=1)
    best, j = advice.best[0].names[0], first.problem.names.index(aim)
    promised = math.sqrt(advice.best[0].covariance[j, j])
    ends, errors, beaten = _made(first, blocks, [one.name for one in base], [one.name for one in candidates], best, repeats)
    note = f"{best}; {len(ready.finger.nodes)} nodes, {repeats} repeats; interval times {advice.narrowing(advice.best[0]):.2f}"
    yield between("next experiment: standard error over what was predicted", float(np.mean(errors)) / promised, "1", 0.9, 1.1, note)
    yield Figure("next experiment: scatter of the repeats over what was predicted", float(np.std(ends, ddof=1)) / promised, "1")
    yield at_least("next experiment: better than one chosen at random", 100 * beaten / repeats, "%", 95.0)


def _chosen(blocks: dict[str, slice], names: list[str]) -> np.ndarray:
    weight = np.zeros(max(rows.stop for rows in blocks.values()))
    for name in names:
        weight[blocks[name]] = 1.0
    return weight


def _only(found: Fit, weight: np.ndarray) -> Fit:
    """The fit as if the rows that were left out had never been there."""
    kept = weight > 0
    problem = dataclasses.replace(found.problem, blocks={"kept": slice(0, int(kept.sum()))}, sigma_source={"kept": "stated"})
    return dataclasses.replace(found, problem=problem, residual=found.residual[kept], jacobian=found.jacobian[kept])


def _made(
    first: Fit, blocks: dict[str, slice], base: list[str], others: list[str], best: str, repeats: int
) -> tuple[list[float], list[float], int]:
    """(values of the target, its standard errors, how often they were below those of a random choice) over repeats with new noise."""
    random, j = np.random.default_rng(SEED), first.problem.names.index("adipose.modulus")
    truth, ends, errors, beaten = first.residual, [], [], 0
    for _ in range(repeats):
        weight = _chosen(blocks, [*base, best])
        new = Redrawn(truth + random.standard_normal(truth.size))
        found = fit(first.problem, start=first.raw, weighing=Chain(new, Counted(weight)), gradient_tolerance=1e-4)
        errors.append(_error(found, weight, j))
        rival = _chosen(blocks, [*base, str(random.choice([name for name in others if name != best]))])
        beaten += errors[-1] < _error(found, rival, j)
        ends.append(float(found.raw[j]))
    return ends, errors, beaten


def _error(found: Fit, weight: np.ndarray, j: int) -> float:
    J = found.jacobian[weight > 0]
    return math.sqrt(float(np.linalg.inv(J.T @ J)[j, j]))


# ---- what cannot be seen ----


def not_seen(study: Study) -> Iterator[Figure]:
    """Two layers fitted to one force: said to be seen in one combination, by name, and by their profile."""
    two = ("dermis.modulus", "adipose.modulus")
    ready = _with_own_data(assemble(_on(study, (pressed("plate", IndenterSpec("flat_plate"), 0.8),), COARSE, two)))
    found = fit(ready.problem())
    said = sentences(found) + list(uncertainty(found).sentences)
    named = any(two[0] in each and two[1] in each for each in said)
    yield at_least("one force for two layers: both named as not told apart", float(named), "1", 1.0, "; ".join(said) or "nothing was said")
    lines = profiles(found) if found.settled else ()
    yield at_least("one force for two layers: profiles that say so", sum(not one.identified for one in lines), "1", 1.0)


TEXT = """What a fit says of its own certainty, on data whose truth is known, and beside the paper's grid of powers of ten. Without
`--full`, grid, intervals and design are on coarse meshes, as their notes say. Written by `python -m benchmarks.identification --write`.
Measured on"""
PAGE = ROOT / "docs" / "identification.md"

if __name__ == "__main__":
    given = sys.argv[1:]
    chosen = [one for one in given if one != "--full"]
    run_parts(parts("--full" in given), __doc__, (PAGE, listed("Identification: values, and how sure they are", TEXT)), chosen)
