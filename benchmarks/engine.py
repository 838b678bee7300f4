"""The forward engine in figures: products, growth, batches of columns, derivatives, iterations over the box of moduli, condensing, starts.

`--quick` stays at 8,500 nodes. Every growth figure comes from a process of its own, so that memory is its alone.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks._bodies import COARSE, FINE, Problem, bytes_per_unknown, moduli, problem
from benchmarks._record import Figure, at_least, at_most, listed, run
from benchmarks._sweep import sweeping
from fingerjax.fem.assembly import Assembled
from fingerjax.fem.columns import Columns, columns_from_matrix
from fingerjax.fem.multigrid import Hierarchy, hierarchy, preconditioner
from fingerjax.fem.operator import apply, internal_force
from fingerjax.fem.pardiso import pardiso_available
from fingerjax.fem.slopes import slopes
from fingerjax.fem.solver import AbstractSolver, MultigridCG, solver_for
from fingerjax.fem.stiffness import Elastic

REPEATS = 3
HARDEST = [(*skin, 8) for skin in itertools.product((2, 5), repeat=4)]  # corners of the box of models m{2..5}{2..5}{2..5}{2..5}8
GROWTH = ((0.5, False), (0.17, False), (0.5, True), (0.3, True), (0.22, True))  # node spacing, each element cut into eight


def main(quick: bool) -> Iterator[Figure]:
    """The figures of every part, in order."""
    small = problem(COARSE)
    one = small if quick else problem(FINE)
    frozen = hierarchy(one.body)
    yield from products(one)
    yield from bandwidth(one, frozen)
    yield from iterations(one, frozen)
    frozen = frozen if quick else hierarchy(small.body)
    yield from many(one, None)
    yield from many(small, frozen)
    yield from condensing(small)
    yield from sweeping(COARSE if quick else FINE)
    yield from growth(GROWTH[:1] if quick else GROWTH)
    yield starting()


def seconds(call: Callable[[], Any], repeats: int = REPEATS) -> float:
    """The least of some repeats, the first call left out."""
    jax.block_until_ready(call())
    found = []
    for _ in range(repeats):
        begun = time.perf_counter()
        jax.block_until_ready(call())
        found.append(time.perf_counter() - begun)
    return min(found)


def products(one: Problem) -> Iterator[Figure]:
    """The matrix-free product beside the assembled one of SciPy."""
    body, nodes = one.body, len(one.body.free)
    assembled = Assembled(body, upper=False)
    K = assembled.matrix(np.asarray(one.lame))
    u = jax.random.normal(jax.random.key(0), (nodes, 3)) * body.free[:, None]
    flat, multiply = np.asarray(u).ravel()[assembled.free], jax.jit(apply)
    free, sparse = np.asarray(multiply(body, one.lame, u)).ravel()[assembled.free], K @ flat
    note = f"{nodes} nodes, P2"
    apart = float(np.abs(free - sparse).max() / np.abs(sparse).max())
    yield at_most("matrix-free and assembled product differ by", apart, "1", 1e-13, note)
    alone = seconds(lambda: multiply(body, one.lame, u))
    yield Figure("matrix-free product", 1e3 * alone, "ms", note=note)
    stored = f"{K.data.nbytes / one.unknowns:.0f} bytes per unknown"
    yield Figure("SciPy's assembled product", 1e3 * seconds(lambda: K @ flat), "ms", note=stored)
    single = jax.tree.map(_halved, (body, one.lame, u))
    yield Figure("matrix-free product, single precision", 1e3 * seconds(lambda: multiply(*single)), "ms", note=note)
    yield at_most("matrix-free product reads", bytes_per_unknown(one), "bytes/unknown", 60, note)


def _halved(leaf: Any) -> Any:
    return leaf.astype(jnp.float32) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf


def bandwidth(one: Problem, frozen: Hierarchy) -> Iterator[Figure]:
    """Bytes that one V-cycle has to read, by its time, against a triad on this machine."""
    a, b, c = (np.ones(20_000_000) for _ in range(3))
    triad = 3 * a.nbytes / seconds(lambda: np.add(a, b, out=c)) / 1e9
    yield Figure("triad, NumPy on one thread", triad, "GB/s")
    load = jnp.asarray(one.load)

    @jax.jit
    def cycles(count: jax.Array, body: Any, frozen: Hierarchy, lame: jax.Array) -> jax.Array:
        cycle = preconditioner(body, frozen, lame)
        return jax.lax.fori_loop(0, count, lambda _, r: cycle(r), load)

    none, ten = (seconds(partial(cycles, jnp.asarray(count), one.body, frozen, one.lame)) for count in (0, 10))
    cycle = (ten - none) / 10
    yield Figure("V-cycle", 1e3 * cycle, "ms", note="single precision")
    product = 0.5 * bytes_per_unknown(one) * one.unknowns
    groups = 4 * (frozen.groups.members.size * 9 * frozen.groups.members.shape[1] if frozen.groups is not None else 0)
    rows = 4 * sum(each.size for each in frozen.corners.rows(one.lame))
    moved = 8 * (product + groups + rows) / cycle / 1e9
    note = "the rest is arithmetic of the matrix-free product, which XLA keeps from the roof: eight of them, see its time above"
    yield at_least("V-cycle reads, as a share of the triad", moved / triad, "1", 0.6, note)


class _Fresh:
    """The elastic body at moduli that no call has seen, so that nothing is kept from one call to the next."""

    def __init__(self, one: Problem):
        self.one, self._tick = one, itertools.count()

    def lame(self) -> jax.Array:
        return self.one.lame * (1 + 1e-6 * next(self._tick))

    def __call__(self) -> Elastic:
        return Elastic(self.one.body, self.lame())


def many(one: Problem, frozen: Hierarchy | None) -> Iterator[Figure]:
    """By factorisation, or by multigrid where there is a hierarchy: a column among sixteen, and derivatives, against one answer."""
    nodes, fresh = len(one.body.free), _Fresh(one)
    rows = np.flatnonzero(one.load[:, 1])[:16]
    loads = jnp.zeros((len(rows), nodes, 3)).at[jnp.arange(len(rows)), rows, 1].set(1.0)
    if frozen is None:
        solver, name, note = solver_for(one.body, "frontal"), "factorised", f"{nodes} nodes, our own factorisation"
        yield from _batch(solver, solver, 16, fresh, loads, f"{name}: ", note)
        yield from derivatives(one, solver, fresh, f"{name}: ", note)
        return
    single = MultigridCG(frozen, tolerance=1e-8, batch=1)
    alike = f"{nodes} nodes; columns share no arithmetic of the matrix-free product"
    for batch in (2, 4, 16):
        yield from _batch(single, MultigridCG(frozen, tolerance=1e-8, batch=batch), batch, fresh, loads, "multigrid: ", alike)
    solves = f"{nodes} nodes; a modulus asks for one more solve"
    yield from derivatives(one, MultigridCG(frozen, tolerance=1e-8, batch=4), fresh, "multigrid: ", solves)


def _batch(
    single: AbstractSolver, solver: AbstractSolver, batch: int, fresh: _Fresh, loads: jax.Array, title: str, note: str
) -> Iterator[Figure]:
    alone = seconds(lambda: single.held(fresh(), loads[:1]))
    share = seconds(lambda: solver.held(fresh(), loads)) / len(loads) / alone
    figure, note = f"{title}a column of 16, {batch} at a time, against a single solve", f"{note}; single {alone:.2f} s"
    yield at_most(figure, share, "1", 0.35, note) if batch == 16 else Figure(figure, share, "1", note=note)


def derivatives(one: Problem, solver: AbstractSolver, fresh: _Fresh, title: str, note: str) -> Iterator[Figure]:
    """Force with its moduli's derivatives, and sixteen skin deflections with theirs, against the answer alone."""
    body, load = one.body, jnp.asarray(one.load)
    rows = np.flatnonzero(one.load[:, 1])[:16]
    units = jnp.eye(8).reshape(8, 2, 4)
    units = jnp.pad(units, ((0, 0), (0, 0), (0, one.lame.shape[1] - 4)))

    @jax.jit
    def tangents(body: Any, u: jax.Array) -> jax.Array:
        return jax.lax.map(lambda unit: internal_force(body, unit, u), units)

    def forward(stiffness: Elastic) -> jax.Array:
        return solver.held(stiffness, load[None]).displacement[0]

    def force() -> tuple[jax.Array, jax.Array]:
        u = forward(fresh())
        return jnp.vdot(load, u), -tangents(body, u).reshape(8, -1) @ u.ravel()

    def profile() -> tuple[jax.Array, jax.Array]:
        stiffness = fresh()
        u = forward(stiffness)
        return u[rows, 1], -solver.held(stiffness, _by_modulus(tangents(body, u))).displacement[:, rows, 1]

    alone = seconds(lambda: forward(fresh()))
    note = f"{note}; forward {alone:.2f} s"
    yield at_most(f"{title}compliance with all derivatives, against the compliance", seconds(force) / alone, "1", 1.1, note)
    yield at_most(f"{title}profile with the Jacobian of four moduli, against the profile", seconds(profile) / alone, "1", 2.5, note)


def _by_modulus(tangents: jax.Array) -> jax.Array:
    """Products with d K / d E of each layer at a Poisson ratio of 0.48, from those per unit of each Lame parameter."""
    lame = moduli("m4444", 0.48).lame()[:, 0]
    volumetric, shear = tangents[:4], tangents[4:]
    return lame[0] * volumetric + lame[1] * shear


def iterations(one: Problem, frozen: Hierarchy) -> Iterator[Figure]:
    """With one hierarchy: the paper's model, nearer to incompressible, and the corners of the box of models."""
    solver = MultigridCG(frozen, tolerance=1e-8, batch=1)
    load, note = jnp.asarray(one.load)[None], f"{len(one.body.free)} nodes, to 1e-8"

    def count(model: str, ratio: float) -> int:
        solution = solver.held(Elastic(one.body, moduli(model, ratio).lame()), load)
        return int(solution.iterations[0]) if bool(solution.converged[0]) else solver.max_steps

    yield at_most("iterations, m43338 at 0.48", count("m43338", 0.48), "1", 60, note)
    yield at_most("iterations, m43338 at 0.495", count("m43338", 0.495), "1", 90, note)
    found = {model: count(model, 0.48) for model in ("m" + "".join(map(str, powers)) for powers in HARDEST)}
    worst = max(found, key=lambda model: found[model])
    yield at_most("iterations, the worst of the box's corners at 0.48", found[worst], "1", 120, f"{note}; {worst}")


def condensing(one: Problem) -> Iterator[Figure]:
    """A pad condensed, with all derivatives of what seven indentations read, against a factorisation and as many columns by PARDISO."""
    if not pardiso_available():
        yield Figure("condensing 150 columns", float("nan"), "1", note="needs pip install fingerjax[direct]")
        return
    columns, fresh = _pad(one, 150), _Fresh(one)
    forces = jax.random.uniform(jax.random.key(0), (7, columns.count))
    directions = jnp.eye(one.lame.size).reshape(-1, *one.lame.shape)

    def condensed(solver: AbstractSolver) -> np.ndarray:
        body = solver.condense(one.body, fresh.lame(), columns)
        return slopes(body, one.body, forces, directions)

    host, own, load = solver_for(one.body, "pardiso"), solver_for(one.body, "frontal"), columns.loads()
    plain = seconds(lambda: host.held(fresh(), load))
    note = f"{len(one.body.free)} nodes, {columns.count} columns; factorisation and columns {plain:.2f} s"
    yield at_most("condensing with all derivatives, with PARDISO", seconds(lambda: condensed(host)) / plain, "1", 1.3, note)
    yield at_most("condensing with all derivatives, without", seconds(lambda: condensed(own)) / plain, "1", 6.0, note)


def _pad(one: Problem, count: int) -> Columns:
    import scipy.sparse as sp

    rows = np.flatnonzero(one.load[:, 1])[:count]
    return columns_from_matrix(sp.csc_matrix((np.ones(len(rows)), (3 * rows + 1, np.arange(len(rows)))), shape=(one.load.size, len(rows))))


def growth(sizes: tuple[tuple[float, bool], ...]) -> Iterator[Figure]:
    """Time and memory per unknown from 8,500 nodes to a million unknowns, each in its own process."""
    found = []
    for pad, refined in sizes:
        command = [sys.executable, "-m", "benchmarks._growth", str(pad), str(int(refined))]
        print(f"growth: {pad} mm {'in eighths' if refined else ''} ...", file=sys.stderr, flush=True)
        done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"NPROC": "16"})
        if done.returncode:
            yield Figure(f"solve at {pad} mm", float("nan"), "s", note=(done.stderr.strip().splitlines() or ["no message"])[-1][:160])
            continue
        each = json.loads(done.stdout.splitlines()[-1])
        found.append(each)
        note = f"{each['iterations']} iterations; hierarchy {each['frozen']:.1f} s; first call {each['first']:.1f} s; {each['GiB']:.1f} GiB"
        yield Figure(f"solve, {each['nodes']} nodes", each["seconds"], "s", note=f"{note}; residual {each['residual']:.0e}")
    if len(found) > 1:
        rates = [each["seconds"] / each["unknowns"] for each in found]
        text = "the rest is iterations: " + ", ".join(f"{each['iterations']}" for each in found)
        yield at_most("time per unknown, largest against smallest mesh", rates[-1] / rates[0], "1", 1.3, text)
        yield at_most(f"memory at {found[-1]['unknowns']} unknowns", found[-1]["GiB"], "GiB", 24)


def starting() -> Figure:
    """The first answer of a new process whose caches are warm, against imports and a warm answer."""
    command = [sys.executable, "-m", "benchmarks._growth", str(COARSE.pad), "0", "start"]
    _, done = (subprocess.run(command, capture_output=True, text=True, env=os.environ | {"NPROC": "16"}, check=True) for _ in range(2))
    each = json.loads(done.stdout.splitlines()[-1])  # the first one filled the caches
    rest = each["first"] - each["seconds"]
    parts = f"imports {each['imports']:.1f} s, warm answer {each['seconds']:.2f} s, tracing and loading compiled code {rest:.1f} s"
    limit = 2 * each["seconds"] + each["imports"]
    return at_most("first answer of a new process", each["first"] + each["imports"], "s", limit, f"{parts}; 8.7k nodes")


TEXT = """What one answer of the forward engine costs. Written by `python -m benchmarks.engine --write`; a goal that is not met says so, and
the note what limits it. Measured on"""
PAGE = Path(__file__).resolve().parent.parent / "docs" / "engine.md"

if __name__ == "__main__":
    run(main, page=(PAGE, listed("The forward engine", TEXT)))
