"""Two ways to find the displacement under given nodal forces, behind one interface.

- `MultigridCG`: matrix-free conjugate gradients with a multigrid V-cycle, compiled, no extra package. The default and the reference.
- `Factorised`: a sparse Cholesky factorisation on the host (MKL PARDISO, the extra `direct`), unbeaten below about thirty thousand
  nodes when many loads are asked for at once.

Both return the true residual. Neither is differentiated: derivatives come from the implicit rule in `displacement` and from the closed
form in `compliance`.
"""

from __future__ import annotations

import abc
import importlib.util

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from .assembly import Assembled
from .body import Body
from .carried import NodalForces, bone_loads, let_go
from .columns import Columns
from .krylov import Field, Solution, conjugate_gradients
from .multigrid import Hierarchy, hierarchy, preconditioner
from .operator import Lame, apply

Fields = Float[Array, "m nodes 3"]


class AbstractSolver(eqx.Module):
    """Finds displacements (m, n, 3), mm, under nodal forces (m, n, 3), N, for one body and given Lame parameters."""

    @abc.abstractmethod
    def held(self, body: Body, lame: Lame, loads: Fields) -> Solution:
        """Solve for every load with a rigid bone held where it is; forces on supports are ignored."""

    def solve(self, body: Body, lame: Lame, loads: Fields) -> Solution:
        """Solve for every load; the tissue carries a rigid bone along where the body says so."""
        together = jnp.concatenate([loads, bone_loads(body, lame)])
        return let_go(body, lame, NodalForces(loads), self.held(body, lame, together))

    def influence(self, body: Body, lame: Lame, columns: Columns) -> Solution:
        """The displacements `K^-1 B` under the unit loads of all columns."""
        return self.solve(body, lame, columns.loads())


class MultigridCG(AbstractSolver):
    """Conjugate gradients preconditioned by one V-cycle.

    - `tolerance`: the residual's norm relative to the load's.
    - `max_steps`: a solve cut short here is returned as not converged.
    - `batch`: how many loads advance together.
    """

    frozen: Hierarchy
    tolerance: float = eqx.field(static=True, default=1e-9)
    max_steps: int = eqx.field(static=True, default=500)
    batch: int = eqx.field(static=True, default=2)

    def held(self, body: Body, lame: Lame, loads: Fields) -> Solution:
        cycle = preconditioner(body, self.frozen, lame)

        def one(load: Field) -> Solution:
            return conjugate_gradients(
                lambda u: apply(body, lame, u), cycle, body.free[:, None] * load, tolerance=self.tolerance, max_steps=self.max_steps
            )

        return jax.lax.map(one, loads, batch_size=min(self.batch, loads.shape[0]))


FACTORISED = 1e-9  # relative residual of a factorisation that went well
PROBES = 8  # random combinations of all loads in which a factorisation's residual is measured


class _Host:
    """The assembled pattern of one body and the last factorisation done with it; lives outside compiled code."""

    def __init__(self, body: Body):
        self.assembled = Assembled(body, upper=True)
        self.nodes = len(body.free)
        self._last: tuple[Array, np.ndarray, Solution] | None = None

    def under(self, body: Body, lame: np.ndarray, columns: Columns) -> Solution:
        """What all columns do; the answer at the last moduli is kept, for fits that move something else."""
        if self._last is None or self._last[0] is not columns.weight or not np.array_equal(self._last[1], lame):
            self._last = None
            known = jnp.asarray(lame)
            bone = np.asarray(bone_loads(body, known)).reshape(len(body.modes), 3 * self.nodes)
            right = np.hstack([columns.matrix()[self.assembled.free].toarray(), bone[:, self.assembled.free].T])
            solution = _checked(*self.direct(lame, np.asfortranarray(right)))
            self._last = (columns.weight, lame.copy(), let_go(body, known, columns, solution))
        return self._last[2]

    def solve(self, lame: Array | np.ndarray, loads: Array | np.ndarray) -> tuple[np.ndarray, float]:
        """Displacements (m, n, 3) under loads (m, n, 3), and the relative residual of them all."""
        flat = np.asarray(loads).reshape(len(loads), 3 * self.nodes)
        return self.direct(np.asarray(lame), np.asfortranarray(flat[:, self.assembled.free].T))

    def direct(self, lame: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, float]:
        """Displacements (m, n, 3) under loads (free, m) between free degrees of freedom, and the residual of them all."""
        from pypardiso import PyPardisoSolver

        K = self.assembled.matrix(lame)
        solver = PyPardisoSolver(mtype=2)
        x = solver.solve(K, right).reshape(right.shape)
        solver.free_memory(everything=True)
        full = np.zeros((right.shape[1], 3 * self.nodes))
        full[:, self.assembled.free] = x.T
        return full.reshape(-1, self.nodes, 3), _probed(K, x, right)


def _probed(upper: sp.csr_matrix, x: np.ndarray, right: np.ndarray) -> float:
    """Largest relative residual of `K x = right` in random combinations of its columns; `upper` is K's upper triangle.

    A factorisation fails as a whole, not in one column, and a combination of all of them sees that at a fraction of the cost.
    """
    mix = np.random.default_rng(0).choice([-1.0, 1.0], size=(right.shape[1], min(PROBES, right.shape[1])))
    load, u = right @ mix, x @ mix
    remainder = load - (upper @ u + upper.T @ u - upper.diagonal()[:, None] * u)
    norm = np.linalg.norm(load, axis=0)
    return float(np.max(np.linalg.norm(remainder, axis=0) / np.where(norm > 0, norm, 1.0)))


def _checked(displacement: np.ndarray, residual: float) -> Solution:
    each = jnp.full(len(displacement), residual)
    return Solution(jnp.asarray(displacement), jnp.ones(len(each), int), each, each <= 10 * FACTORISED)


class Factorised(AbstractSolver):
    """Sparse Cholesky by MKL PARDISO on the host. Needs the extra: `pip install fingerjax[direct]`."""

    host: _Host = eqx.field(static=True)

    def held(self, body: Body, lame: Lame, loads: Fields) -> Solution:
        # Known numbers are solved for at once. A callback from compiled code is for traced ones only: compiled programs that hold one
        # are not kept between runs, and large arrays handed to one can wait for ever on a machine of two cores.
        if not isinstance(lame, jax.core.Tracer) and not isinstance(loads, jax.core.Tracer):
            return _checked(*self.host.solve(np.asarray(lame), np.asarray(loads)))
        shapes = jax.ShapeDtypeStruct(loads.shape, loads.dtype), jax.ShapeDtypeStruct((), loads.dtype)
        u, residual = jax.pure_callback(self.host.solve, shapes, lame, loads, vmap_method="sequential")
        each = jnp.broadcast_to(residual, loads.shape[:1])
        return Solution(u, jnp.ones_like(each, dtype=int), each, each <= 10 * FACTORISED)

    def influence(self, body: Body, lame: Lame, columns: Columns) -> Solution:
        if isinstance(lame, jax.core.Tracer) or isinstance(columns.weight, jax.core.Tracer):
            return super().influence(body, lame, columns)
        return self.host.under(body, np.asarray(lame), columns)


class Known(AbstractSolver):
    """Displacements under the columns that were found before, with the same moduli: what compiled code differentiates about."""

    solution: Solution

    def held(self, body: Body, lame: Lame, loads: Fields) -> Solution:
        raise ValueError("these displacements are known under the model's own columns only; ask another solver for other loads")

    def influence(self, body: Body, lame: Lame, columns: Columns) -> Solution:
        return self.solution


@eqx.filter_jit
def _influence(solver: AbstractSolver, body: Body, lame: Lame, columns: Columns) -> Solution:
    return solver.influence(body, lame, columns)


def known(solver: AbstractSolver, body: Body, lame: Lame, columns: Columns) -> Known:
    """Solve under all columns now, outside of the code that is differentiated."""
    solve = solver.influence if isinstance(solver, Factorised) else lambda *rest: _influence(solver, *rest)
    return Known(solve(body, lame, columns))


def direct_available() -> bool:
    return importlib.util.find_spec("pypardiso") is not None


def solver_for(body: Body, kind: str = "auto") -> AbstractSolver:
    """The solver to use for a body: `"multigrid"`, `"factorised"`, or `"auto"`, which factorises where that is installed and pays."""
    if kind == "auto":
        kind = "factorised" if direct_available() and len(body.free) < 60_000 else "multigrid"
    if kind == "factorised":
        if not direct_available():
            raise ImportError("the factorised solver needs MKL PARDISO: pip install fingerjax[direct], or choose solver 'multigrid'")
        return Factorised(_Host(body))
    if kind != "multigrid":
        raise ValueError(f"unknown solver {kind!r}; choose 'auto', 'multigrid' or 'factorised'")
    return MultigridCG(hierarchy(body))
