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
from .columns import Columns
from .krylov import Field, Solution, conjugate_gradients
from .multigrid import Hierarchy, hierarchy, preconditioner
from .operator import Lame, apply

Fields = Float[Array, "m nodes 3"]


class AbstractSolver(eqx.Module):
    """Finds displacements (m, n, 3), mm, under nodal forces (m, n, 3), N, for one body and given Lame parameters."""

    @abc.abstractmethod
    def solve(self, body: Body, lame: Lame, loads: Fields) -> Solution:
        """Solve for every load; forces on supports are ignored."""

    def influence(self, body: Body, lame: Lame, columns: Columns) -> Solution:
        """The displacements `K^-1 B` under the unit loads of all columns."""
        return self.solve(body, lame, body.free[:, None] * columns.loads())


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

    def solve(self, body: Body, lame: Lame, loads: Fields) -> Solution:
        cycle = preconditioner(body, self.frozen, lame)

        def one(load: Field) -> Solution:
            return conjugate_gradients(
                lambda u: apply(body, lame, u), cycle, body.free[:, None] * load, tolerance=self.tolerance, max_steps=self.max_steps
            )

        return jax.lax.map(one, loads, batch_size=min(self.batch, loads.shape[0]))


PROBES = 8  # random combinations of all loads in which a factorisation's residual is measured


class _Host:
    """The assembled pattern of one body and the last factorisation done with it; lives outside compiled code."""

    def __init__(self, body: Body):
        self.assembled = Assembled(body, upper=True)
        self.nodes = len(body.free)
        self._last: tuple[Array, np.ndarray, tuple[Array, float]] | None = None

    def under(self, lame: np.ndarray, columns: Columns) -> tuple[Array, float]:
        """Displacements (m, n, 3) under all columns; those of the last moduli are kept, for fits that move something else."""
        if self._last is None or self._last[0] is not columns.weight or not np.array_equal(self._last[1], lame):
            self._last = None
            right = np.asfortranarray(columns.matrix()[self.assembled.free].toarray())
            x, residual = self.direct(lame, right)
            self._last = (columns.weight, lame.copy(), (jnp.asarray(x), residual))
        return self._last[2]

    def solve(self, lame: Array | np.ndarray, loads: Array | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Displacements (m, n, 3) under loads (m, n, 3), and the relative residual (m,)."""
        flat = np.asarray(loads).reshape(len(loads), -1)
        x, residual = self.direct(np.asarray(lame), np.asfortranarray(flat[:, self.assembled.free].T))
        return x, np.full(len(loads), residual)

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


class Factorised(AbstractSolver):
    """Sparse Cholesky by MKL PARDISO on the host. Needs the extra: `pip install fingerjax[direct]`."""

    host: _Host = eqx.field(static=True)
    tolerance: float = eqx.field(static=True, default=1e-9)

    def solve(self, body: Body, lame: Lame, loads: Fields) -> Solution:
        # Known numbers are solved for at once. A callback from compiled code is for traced ones only: compiled programs that hold one
        # are not kept between runs, and large arrays handed to one can wait for ever on a machine of two cores.
        if not isinstance(lame, jax.core.Tracer) and not isinstance(loads, jax.core.Tracer):
            u, residual = map(jnp.asarray, self.host.solve(np.asarray(lame), np.asarray(loads)))
            return Solution(u, jnp.ones_like(residual, dtype=int), residual, residual <= 10 * self.tolerance)
        shapes = jax.ShapeDtypeStruct(loads.shape, loads.dtype), jax.ShapeDtypeStruct(loads.shape[:1], loads.dtype)
        u, residual = jax.pure_callback(self.host.solve, shapes, lame, loads, vmap_method="sequential")
        return Solution(u, jnp.ones_like(residual, dtype=int), residual, residual <= 10 * self.tolerance)

    def influence(self, body: Body, lame: Lame, columns: Columns) -> Solution:
        if isinstance(lame, jax.core.Tracer) or isinstance(columns.weight, jax.core.Tracer):
            return super().influence(body, lame, columns)
        x, residual = self.host.under(np.asarray(lame), columns)
        each = jnp.full(columns.count, residual)
        return Solution(x, jnp.ones(columns.count, int), each, each <= 10 * self.tolerance)


class Known(AbstractSolver):
    """Displacements under the columns that were found before, with the same moduli: what compiled code differentiates about."""

    solution: Solution

    def solve(self, body: Body, lame: Lame, loads: Fields) -> Solution:
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
