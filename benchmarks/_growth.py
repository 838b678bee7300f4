"""One solve in a process of its own: `python -m benchmarks._growth SPACING REFINED [start]`, figures as one line of JSON.

With `start`, compiled programs are kept in the cache as the command line keeps them.
"""

from __future__ import annotations

import time

BEGUN = time.perf_counter()

import json  # noqa: E402
import resource  # noqa: E402
import sys  # noqa: E402

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402

from benchmarks._bodies import COARSE, FINE, problem  # noqa: E402
from fingerjax.fem.krylov import Solution  # noqa: E402
from fingerjax.fem.multigrid import hierarchy  # noqa: E402
from fingerjax.fem.solver import MultigridCG  # noqa: E402
from fingerjax.fem.stiffness import Elastic  # noqa: E402
from fingerjax.mesh import Resolution, cache_dir  # noqa: E402


def main(pad: float, refined: bool, start: bool) -> None:
    imports = time.perf_counter() - BEGUN
    if start:
        jax.config.update("jax_compilation_cache_dir", str(cache_dir() / "compiled"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.05)
    known = {each.pad: each for each in (COARSE, FINE)}
    one = problem(known.get(pad, Resolution(pad, 3 * pad)), refined=refined)
    begun = time.perf_counter()
    solver = MultigridCG(hierarchy(one.body), tolerance=1e-8, batch=1)
    frozen = time.perf_counter() - begun
    stiffness, load = Elastic(one.body, one.lame), jnp.asarray(one.load)[None]

    def solved() -> tuple[Solution, float]:
        begun = time.perf_counter()
        return jax.block_until_ready(solver.held(stiffness, load)), time.perf_counter() - begun

    (solution, first), *again = [solved() for _ in range(3)]
    report = {
        "nodes": len(one.body.free), "unknowns": one.unknowns, "imports": imports, "frozen": frozen, "first": first,
        "seconds": min(each for _, each in again), "iterations": int(solution.iterations[0]), "residual": float(solution.residual[0]),
        "GiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }  # fmt: skip
    print(json.dumps(report))


if __name__ == "__main__":
    main(float(sys.argv[1]), bool(int(sys.argv[2])), len(sys.argv) > 3)
