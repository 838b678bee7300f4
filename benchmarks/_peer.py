"""One program solving one stored problem, in a process of its own: `python benchmarks/_peer.py NAME PROBLEM.npz ANSWER.npz`.

Imports nothing of fingerjax unless it is fingerjax that is asked, so that a program may live in an environment of its own. The answer
holds the displacement, the seconds of the first call and of each repeat, iterations, and the memory that solving took.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

REPEATS = 3
TOLERANCE = 1e-8


def main(name: str, stored: str, answer: str) -> None:
    with np.load(stored) as file:
        given = {key: file[key] for key in file.files}
    before = _memory()
    u, iterations, seconds = PROGRAMS[name](given)
    report = {"first": seconds[0], "seconds": seconds[1:], "iterations": iterations, "MiB": _memory() - before}
    np.savez(answer, u=u, report=json.dumps(report))


def _memory() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _timed(solve: Callable[[], tuple[np.ndarray, int]]) -> tuple[np.ndarray, int, list[float]]:
    """The answer, its iterations, and the seconds of the first call and of the repeats."""
    seconds, begun = [], time.perf_counter()
    u, iterations = solve()
    seconds.append(time.perf_counter() - begun)
    for _ in range(REPEATS):
        begun = time.perf_counter()
        u, iterations = solve()
        seconds.append(time.perf_counter() - begun)
    return u, iterations, seconds


def multigrid(given: dict[str, np.ndarray]) -> tuple[np.ndarray, int, list[float]]:
    """Conjugate gradients with the frozen hierarchy of the mesh; forming its levels at the moduli is counted."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp

    from fingerjax.fem.body import assemble_body
    from fingerjax.fem.multigrid import hierarchy
    from fingerjax.fem.solver import MultigridCG
    from fingerjax.fem.stiffness import Elastic

    body = assemble_body(given["nodes"], given["tets"], given["layer"], given["held"])
    solver = MultigridCG(hierarchy(body), tolerance=TOLERANCE, batch=1)
    stiffness, load = Elastic(body, jnp.asarray(given["lame"])), jnp.asarray(given["load"])[None]

    def solve() -> tuple[np.ndarray, int]:
        solution = solver.held(stiffness, load)
        if not solution.converged[0]:
            raise RuntimeError(f"not converged: residual {float(solution.residual[0]):.1e}")
        return np.asarray(solution.displacement[0]), int(solution.iterations[0])

    return _timed(solve)


def pardiso(given: dict[str, np.ndarray]) -> tuple[np.ndarray, int, list[float]]:
    """MKL's sparse Cholesky factorisation."""
    from fingerjax.fem.pardiso import Pardiso

    return _factorised(given, Pardiso)


def frontal(given: dict[str, np.ndarray]) -> tuple[np.ndarray, int, list[float]]:
    """Our own sparse Cholesky factorisation."""
    from fingerjax.fem.frontal import Frontal

    return _factorised(given, Frontal)


def _factorised(given: dict[str, np.ndarray], how: Any) -> tuple[np.ndarray, int, list[float]]:
    """Analysis, factorisation and solve of the assembled stiffness; assembling is not counted."""
    import jax

    jax.config.update("jax_enable_x64", True)

    from fingerjax.fem.assembly import Assembled
    from fingerjax.fem.body import assemble_body

    body = assemble_body(given["nodes"], given["tets"], given["layer"], given["held"])
    assembled = Assembled(body, upper=True)
    K, load = assembled.matrix(given["lame"]), given["load"].reshape(-1, 1)[assembled.free]

    def solve() -> tuple[np.ndarray, int]:
        factor = how(K.indptr, K.indices)
        factor.factor(K.data)
        u = np.zeros(given["load"].size)
        u[assembled.free] = factor.solve(load)[:, 0]
        return u.reshape(-1, 3), 1

    return _timed(solve)


def scikit_fem(given: dict[str, np.ndarray]) -> tuple[np.ndarray, int, list[float]]:
    """Its own assembly is not counted; smoothed aggregation of pyamg with rigid-body modes, set up and solved."""
    import pyamg
    from scipy.spatial import cKDTree
    from skfem import Basis, BilinearForm, ElementTetP1, ElementTetP2, ElementVector, MeshTet, condense
    from skfem.helpers import ddot, eye, sym_grad, trace

    linear = given["tets"].shape[1] == 4
    corners, inverse = np.unique(given["tets"][:, :4], return_inverse=True)
    mesh = MeshTet(given["nodes"][corners].T.copy(), inverse.reshape(-1, 4).T.copy())
    basis = Basis(mesh, ElementVector(ElementTetP1() if linear else ElementTetP2()), intorder=0 if linear else 2)
    lam, mu = (np.repeat(part[given["layer"]][:, None], basis.X.shape[1], axis=1) for part in given["lame"])

    @BilinearForm
    def stiffness(u, v, w):
        strain = sym_grad(u)
        return ddot(eye(w.lam * trace(strain), 3) + 2 * w.mu * strain, sym_grad(v))

    K = stiffness.assemble(basis, lam=lam, mu=mu)
    where = basis.doflocs[:, ::3].T
    of = cKDTree(given["nodes"]).query(where)[1]
    dof = 3 * np.arange(len(where))[:, None] + np.arange(3)
    ours = np.zeros(given["load"].size, int)
    ours[(3 * of[:, None] + np.arange(3)).ravel()] = dof.ravel()
    held = ours[np.flatnonzero(np.repeat(given["held"], 3))]
    load = np.zeros(K.shape[0])
    load[ours] = given["load"].ravel()
    A, b, _, free = condense(K, load, D=held)
    modes = _rigid(where).reshape(-1, 6)[free]
    u = np.zeros(K.shape[0])

    def solve() -> tuple[np.ndarray, int]:
        count: list[float] = []
        blocks = A.tobsr(blocksize=(3, 3)) if A.shape[0] % 3 == 0 else A
        hierarchy = pyamg.smoothed_aggregation_solver(blocks, B=modes, strength="symmetric", max_coarse=500)
        u[free] = hierarchy.solve(b, tol=TOLERANCE, accel="cg", maxiter=2000, residuals=count)
        if np.linalg.norm(b - A @ u[free]) > 10 * TOLERANCE * np.linalg.norm(b):
            raise RuntimeError("pyamg did not converge")
        return u[ours].reshape(-1, 3), len(count) - 1

    return _timed(solve)


def _rigid(nodes: np.ndarray) -> np.ndarray:
    arm = nodes - nodes.mean(axis=0)
    shifts = np.broadcast_to(np.eye(3), (len(nodes), 3, 3))
    turns = np.stack([np.cross(axis, arm) for axis in np.eye(3)], axis=2)
    return np.concatenate([shifts, turns], axis=2)


def torch_fem(given: dict[str, np.ndarray]) -> tuple[np.ndarray, int, list[float]]:
    """One linear increment, assembly included, because its interface offers no other."""
    import torch
    from torchfem import Solid
    from torchfem.materials import IsotropicElasticity3D

    torch.set_default_dtype(torch.float64)
    lam, mu = (torch.tensor(part[given["layer"]]) for part in given["lame"])
    material = IsotropicElasticity3D(E=mu * (3 * lam + 2 * mu) / (lam + mu), nu=lam / (2 * (lam + mu)))
    solid = Solid(torch.tensor(given["nodes"]), torch.tensor(given["tets"].astype(np.int64)), material)
    solid.forces = torch.tensor(given["load"])
    solid.constraints = torch.tensor(np.repeat(given["held"][:, None], 3, axis=1))

    def solve() -> tuple[np.ndarray, int]:
        increments = torch.tensor([0.0, 1.0])
        u, *_ = solid.solve(increments=increments, method="cg", preconditioner="amg", stol=TOLERANCE, max_iter=2, rtol=1e-4)
        return u.detach().numpy(), 0

    return _timed(solve)


def calculix(given: dict[str, np.ndarray]) -> tuple[np.ndarray, int, list[float]]:
    """The whole program, its reading and writing included, with the solver that it chooses itself."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "job.inp").write_text(_deck(given))

        def solve() -> tuple[np.ndarray, int]:
            environment = os.environ | {"OMP_NUM_THREADS": str(os.cpu_count())}
            subprocess.run(["ccx", "-i", "job"], cwd=folder, check=True, stdout=subprocess.DEVNULL, env=environment)
            rows = [line.split() for line in (Path(folder) / "job.dat").read_text().splitlines()]
            table = np.array([row for row in rows if len(row) == 4 and row[0].isdigit()], float)
            u = np.zeros_like(given["nodes"])
            u[table[:, 0].astype(int) - 1] = table[:, 1:]
            return u, 0

        return _timed(solve)


def _deck(given: dict[str, np.ndarray]) -> str:
    used = np.unique(given["tets"])
    lines = ["*NODE, NSET=ALL", *(f"{i + 1}," + ",".join(f"{x:.11e}" for x in given["nodes"][i]) for i in used)]
    kind = "C3D4" if given["tets"].shape[1] == 4 else "C3D10"
    for layer in np.unique(given["layer"]):
        lines.append(f"*ELEMENT, TYPE={kind}, ELSET=L{layer}")
        chosen = np.flatnonzero(given["layer"] == layer)
        lines += [",".join(str(i) for i in (e + 1, *(given["tets"][e] + 1))) for e in chosen]
        lam, mu = given["lame"][:, layer]
        lines += [f"*MATERIAL, NAME=M{layer}", "*ELASTIC", f"{mu * (3 * lam + 2 * mu) / (lam + mu):.12e},{lam / (2 * (lam + mu)):.12e}"]
        lines += [f"*SOLID SECTION, ELSET=L{layer}, MATERIAL=M{layer}"]
    held = np.intersect1d(np.flatnonzero(given["held"]), used)
    lines += ["*BOUNDARY", *(f"{i + 1},1,3" for i in held), "*STEP", "*STATIC", "*CLOAD"]
    lines += [f"{i + 1},2,{given['load'][i, 1]:.12e}" for i in np.flatnonzero(given["load"][:, 1])]
    return "\n".join([*lines, "*NODE PRINT, NSET=ALL", "U", "*END STEP", ""])


PROGRAMS: dict[str, Callable[[dict[str, np.ndarray]], tuple[np.ndarray, int, list[float]]]] = {
    "multigrid": multigrid,
    "fingerjax, frontal": frontal,
    "pardiso": pardiso,
    "scikit-fem": scikit_fem,
    "torch-fem cg+amg": torch_fem,
    "calculix": calculix,
}


if __name__ == "__main__":
    main(*sys.argv[1:])
