"""The paper's bar at 36 places with derivatives in all moduli and every displacement, against a factorisation of the same body."""

from __future__ import annotations

import csv
import itertools
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import yaml

from benchmarks._bars import POSITIONS, TRAVEL
from benchmarks._record import Figure, at_most
from fingerjax.fem.pardiso import pardiso_available
from fingerjax.fem.solver import solver_for
from fingerjax.fem.stiffness import Elastic
from fingerjax.forward import Assembled, assemble
from fingerjax.identify.evaluation import evaluator
from fingerjax.layers import SOFT_LAYERS
from fingerjax.mesh import Resolution
from fingerjax.study import load_studies

REPEATS = 3
FIGURE = "36 places of a bar with every displacement and the Jacobian of all moduli, over a factorisation by PARDISO"


def sweeping(resolution: Resolution) -> Iterator[Figure]:
    """As a fit asks for it: condensed anew at moduli that were not seen before, pressed, read, differentiated."""
    if not pardiso_available():
        yield Figure(FIGURE, float("nan"), "1", note="needs pip install fingerjax[direct]")
        return
    ready = _bar(resolution)
    problem = ready.problem()
    evaluate, raw, ticks = evaluator(problem), np.array([one.raw() for one in problem.parameters]), itertools.count()

    def whole() -> None:
        moved = raw + 1e-6 * next(ticks)
        point = evaluate(moved)
        assert point.usable
        values = {one.name: one.natural(each) for one, each in zip(problem.parameters, jnp.asarray(moved), strict=True)}
        (condensed,) = ready.model.condensed([tissue.lame() for tissue in ready.model.instruments.materials(values)])
        jax.block_until_ready(condensed.displacement(forces))

    forces = jax.random.uniform(jax.random.key(0), (len(POSITIONS), ready.model.columns.count))
    sweep, factor = _shortest(whole), _factorisation(ready)
    answers = f"the Schur complement of all columns, and {5 * len(POSITIONS)} answers"
    note = f"{len(ready.mesh.nodes)} nodes, {ready.model.columns.count} columns; {sweep:.1f} s over {factor:.2f} s: {answers}"
    yield at_most(FIGURE, sweep / factor, "1", 4.0, note)


def _bar(resolution: Resolution) -> Assembled:
    """Rates of an afferent in the middle of the preset monkey's pad; the numbers do not matter here."""
    said = {
        "version": 1,
        "finger": {"preset": "monkey", "resolution": {"pad_mm": resolution.pad, "proximal_mm": resolution.proximal}},
        "model": {
            "ratios": "m43338",
            "epidermis_MPa": 0.14,
            "poisson_ratio": 0.48,
            "receptor": {"depth_mm": 0.75, "z_mm": 8.7, "theta_deg": 270.0},
        },
        "measurements": [
            {
                "name": "bar",
                "data": "bar.csv",
                "kind": "spike_rate",
                "indenter": {"shape": "bar", "width_mm": 3.0, "along": "x"},
                "every": {"depth_mm": TRAVEL},
                "noise": {"sigma": 2.5, "unit": "Hz"},
            }
        ],
        "fit": {"free": [f"{layer}.modulus" for layer in SOFT_LAYERS]},
    }
    with tempfile.TemporaryDirectory() as folder:
        with (Path(folder) / "bar.csv").open("w", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(["position_mm", "rate_Hz"])
            rows.writerows((float(place), 40.0 - 4.0 * abs(float(place))) for place in POSITIONS)
        path = Path(folder) / "sweep.yaml"
        path.write_text(yaml.safe_dump(said))
        return assemble(load_studies(path)["sweep"], solver="pardiso")


def _factorisation(ready: Assembled) -> float:
    """Seconds of one factorisation and one answer, the pattern analysed before."""
    body, solver = ready.model.body, solver_for(ready.model.body, "pardiso")
    lame, ticks = ready.model.instruments.materials({})[0].lame(), itertools.count()
    load = ready.model.columns.load(jnp.zeros(ready.model.columns.count).at[0].set(1.0))[None]
    return _shortest(lambda: jax.block_until_ready(solver.held(Elastic(body, lame * (1 + 1e-6 * next(ticks))), load).displacement))


def _shortest(call: Callable[[], object]) -> float:
    call()
    found = []
    for _ in range(REPEATS):
        begun = time.perf_counter()
        call()
        found.append(time.perf_counter() - begun)
    return min(found)
