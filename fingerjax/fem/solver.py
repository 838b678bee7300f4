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
from collections import OrderedDict

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .assembly import Assembled
from .body import Body
from .krylov import Field, Solution, conjugate_gradients
from .multigrid import Hierarchy, hierarchy, preconditioner
from .operator import Lame, apply

Fields = Float[Array, "m nodes 3"]


class AbstractSolver(eqx.Module):
    """Finds displacements (m, n, 3), mm, under nodal forces (m, n, 3), N, for one body and given Lame parameters."""

    @abc.abstractmethod
    def solve(self, body: Body, lame: Lame, loads: Fields) -> Solution:
        """Solve for every load; forces on supports are ignored."""


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


class _Host:
    """The assembled pattern of one body and the factorisations done with it; lives outside compiled code."""

    def __init__(self, body: Body):
        self.assembled = Assembled(body, upper=True)
        self.nodes = len(body.free)
        self._kept: OrderedDict[bytes, tuple[np.ndarray, np.ndarray]] = OrderedDict()

    def solve(self, lame: Array | np.ndarray, loads: Array | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        key = np.asarray(lame).tobytes() + np.asarray(loads).tobytes()[:4096] + str(loads.shape).encode()
        if key not in self._kept:
            self._kept[key] = self._fresh(np.asarray(lame), np.asarray(loads))
            while len(self._kept) > 2:
                self._kept.popitem(last=False)
        return self._kept[key]

    def _fresh(self, lame: np.ndarray, loads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        from pypardiso import PyPardisoSolver

        K, free = self.assembled.matrix(lame), self.assembled.free
        right = np.asfortranarray(loads.reshape(len(loads), -1)[:, free].T)
        direct = PyPardisoSolver(mtype=2)
        x = direct.solve(K, right).reshape(right.shape)
        direct.free_memory(everything=True)
        remainder = right - (K @ x + K.T @ x - K.diagonal()[:, None] * x)
        norm = np.linalg.norm(right, axis=0)
        full = np.zeros((len(loads), 3 * self.nodes))
        full[:, free] = x.T
        return full.reshape(len(loads), self.nodes, 3), np.linalg.norm(remainder, axis=0) / np.where(norm > 0, norm, 1.0)


class Factorised(AbstractSolver):
    """Sparse Cholesky by MKL PARDISO on the host. Needs the extra: `pip install fingerjax[direct]`."""

    host: _Host = eqx.field(static=True)
    tolerance: float = eqx.field(static=True, default=1e-9)

    def solve(self, body: Body, lame: Lame, loads: Fields) -> Solution:
        shapes = jax.ShapeDtypeStruct(loads.shape, loads.dtype), jax.ShapeDtypeStruct(loads.shape[:1], loads.dtype)
        u, residual = jax.pure_callback(self.host.solve, shapes, lame, loads, vmap_method="sequential")
        return Solution(u, jnp.ones_like(residual, dtype=int), residual, residual <= 10 * self.tolerance)


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
