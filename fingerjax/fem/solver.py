"""Two ways to find the displacement under given nodal forces, behind one interface.

- `MultigridCG`: matrix-free conjugate gradients with a multigrid V-cycle, compiled. For large meshes and
  other devices, and the reference.
- `Factorised`: a sparse Cholesky factorisation on the host, the faster one when many loads are asked for at once, and the way to condense
  a skin that is touched at hundreds of places. MKL PARDISO where the extra `direct` is installed, else our own in NumPy, about half as
  fast. `python -m benchmarks.engine` and `python -m benchmarks.peers` compare them.

Where JAX sees several devices, `Shared` deals load cases out among them. All return the true residual. None is differentiated:
derivatives come from the implicit rule in `displacement` and from the closed forms in `compliance` and `condensed`.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float

from .body import Body
from .carried import bone_loads, carriage, let_go
from .columns import Columns
from .condensed import AbstractCondensed, ByColumns, Held
from .factorised import CONVERGED, Host
from .frontal import Frontal
from .krylov import Field, Solution, conjugate_gradients
from .multigrid import Hierarchy, hierarchy, preconditioner
from .operator import Lame
from .pardiso import pardiso_available
from .stiffness import AbstractStiffness, Elastic

Fields = Float[Array, "m nodes 3"]


class AbstractSolver(eqx.Module):
    """Finds displacements (m, n, 3), mm, under nodal forces (m, n, 3), N: of one body, at given Lame parameters or at a given stiffness."""

    @abc.abstractmethod
    def held(self, stiffness: AbstractStiffness, loads: Fields) -> Solution:
        """Solve for every load with a rigid bone held where it is; forces on supports are ignored."""

    @abc.abstractmethod
    def reduce(self, stiffness: AbstractStiffness, columns: Columns) -> AbstractCondensed:
        """Reduce the body to its columns; to be called outside of compiled code."""

    @property
    def workers(self) -> int | None:
        """How many may ask it at once, outside of compiled code; None where as many as there are processors."""
        return 1

    def forget(self) -> None:
        """Let go of memory for what can be computed again, as for a mesh that is asked rarely. Outside of compiled code."""

    def undo(self, stiffness: AbstractStiffness, loads: Fields) -> Solution:
        """Solve for every load; the tissue carries a rigid bone along where the body says so."""
        together = jnp.concatenate([loads, bone_loads(stiffness)])
        return let_go(stiffness, loads, self.held(stiffness, together))

    def solve(self, body: Body, lame: Lame, loads: Fields) -> Solution:
        """`undo` for the linear body."""
        return self.undo(Elastic(body, lame), loads)

    def condense(self, body: Body, lame: Lame, columns: Columns) -> AbstractCondensed:
        """`reduce` for the linear body."""
        return self.reduce(Elastic(body, lame), columns)


class Last:
    """The columns that a solver answered last, bone held: where it begins when it is asked for them at other moduli. Lives on the host."""

    most = 2**30  # bytes that are kept

    def __init__(self) -> None:
        self._of: Array | None = None
        self._held: Fields | None = None

    def start(self, columns: Columns, count: int) -> Fields:
        """Displacements (count, nodes, 3): the last answer to these columns, or zeros."""
        if self._held is not None and self._of is columns.weight and len(self._held) == count:
            return self._held
        return jnp.zeros((count, columns.nodes, 3))

    def keep(self, columns: Columns, held: Fields) -> None:
        kept = held.nbytes <= self.most and bool(jnp.all(jnp.isfinite(held)))
        self._of, self._held = (columns.weight, held) if kept else (None, None)


def _by_columns(solver: MultigridCG | Shared, last: Last, stiffness: AbstractStiffness, columns: Columns) -> AbstractCondensed:
    """The body reduced by solving for every column, each begun where it ended at the last moduli."""
    start = last.start(columns, columns.count + len(stiffness.body.modes))
    held, influence, matrix = _influence(solver, stiffness, columns, start)
    last.keep(columns, held)
    bone = carriage(stiffness, held[columns.count :])

    def undo(loads: Fields) -> Fields:
        work = bone.motions.reshape(len(bone.motions), -1) @ loads.reshape(len(loads), -1).T
        return bone.complete(solver.held(stiffness, loads).displacement, work)

    return ByColumns(matrix, influence, undo)


@eqx.filter_jit
def _influence(
    solver: MultigridCG | Shared, stiffness: AbstractStiffness, columns: Columns, start: Float[Array, "solved nodes 3"]
) -> tuple[Float[Array, "solved nodes 3"], Fields, Held]:
    loads = columns.loads()
    held = solver.held(stiffness, jnp.concatenate([loads, bone_loads(stiffness)]), start)
    solution = let_go(stiffness, loads, held)
    matrix = columns.read(solution.displacement)
    worst = solution.iterations.max(), solution.residual.max(), solution.converged.all()
    return held.displacement, solution.displacement, Held((matrix + matrix.T) / 2, jnp.asarray(stiffness.lame), *worst)


class MultigridCG(AbstractSolver):
    """Conjugate gradients preconditioned by one V-cycle, that of the linear body whatever the stiffness.

    - `tolerance`: the residual's norm relative to the load's.
    - `max_steps`: a solve cut short here is returned as not converged.
    - `batch`: how many loads advance together.
    - `last`: columns begin where they ended at the last moduli, so that what `reduce` answers depends on what was asked before, within
      the tolerance; take a tighter one where differences of answers are wanted.
    """

    frozen: Hierarchy
    tolerance: float = eqx.field(static=True, default=1e-9)
    max_steps: int = eqx.field(static=True, default=500)
    batch: int = eqx.field(static=True, default=2)
    last: Last = eqx.field(static=True, default_factory=Last)

    @eqx.filter_jit
    def held(self, stiffness: AbstractStiffness, loads: Fields, start: Fields | None = None) -> Solution:
        """`start` (m, n, 3): where to begin, zero where None."""
        body = stiffness.body
        cycle, free = preconditioner(body, self.frozen, jnp.asarray(stiffness.lame)), body.moves
        product = self._product(stiffness)

        def one(case: tuple[Field, Field | None]) -> Solution:
            load, start = case
            begin = None if start is None else free * start
            return conjugate_gradients(product, cycle, free * load, start=begin, tolerance=self.tolerance, max_steps=self.max_steps)

        # Whole batches only: a remainder would be compiled once more, and a load of zero is answered at once.
        count, batch = loads.shape[0], min(self.batch, loads.shape[0])
        cases = jax.tree.map(partial(_filled_up, count=-count % batch), (loads, start))
        return jax.tree.map(lambda part: part[:count], jax.lax.map(one, cases, batch_size=batch))

    def _product(self, stiffness: AbstractStiffness) -> Callable[[Field], Field]:
        """The stiffness between free nodes: assembled for linear tetrahedra, matrix-free for quadratic ones, as each is faster."""
        if isinstance(stiffness, Elastic) and stiffness.body.order == 1 and stiffness.body.springs is None:
            rows = self.frozen.corners.rows(jnp.asarray(stiffness.lame))
            return lambda u: self.frozen.corners.multiply(rows, u)
        free = stiffness.body.moves
        return lambda u: free * stiffness(free * u)

    def reduce(self, stiffness: AbstractStiffness, columns: Columns) -> AbstractCondensed:
        return _by_columns(self, self.last, stiffness, columns)


class Shared(AbstractSolver):
    """The solver `one` on each of several devices, with load cases dealt out among them; the answers are those of `one` alone.

    One solve is never split: at the size of a fingertip its parts would wait for one another more than they compute.
    """

    one: MultigridCG
    devices: tuple[jax.Device, ...] = eqx.field(static=True)

    @eqx.filter_jit
    def held(self, stiffness: AbstractStiffness, loads: Fields, start: Fields | None = None) -> Solution:
        count = loads.shape[0]
        cases = jax.tree.map(partial(_filled_up, count=-count % len(self.devices)), (loads, start))
        arrays, rest = eqx.partition((self.one, stiffness), eqx.is_array)
        mesh, everywhere, dealt = Mesh(np.asarray(self.devices), ("cases",)), PartitionSpec(), PartitionSpec("cases")

        def own(arrays: tuple, cases: tuple) -> Solution:
            solver, stiffness = eqx.combine(arrays, rest)
            return solver.held(stiffness, *cases)

        # Loops carry constants that are the same on every device without saying so, hence no check of what varies among them.
        solution = jax.shard_map(own, mesh=mesh, in_specs=(everywhere, dealt), out_specs=dealt, check_vma=False)(arrays, cases)
        return jax.tree.map(lambda part: part[:count], solution)

    def reduce(self, stiffness: AbstractStiffness, columns: Columns) -> AbstractCondensed:
        return _by_columns(self, self.one.last, stiffness, columns)


def _filled_up(loads: Fields, count: int) -> Float[Array, "more nodes 3"]:
    return jnp.concatenate([loads, jnp.zeros((count, *loads.shape[1:]))])


def _checked(displacement: np.ndarray, residual: float) -> Solution:
    each = jnp.full(len(displacement), residual)
    return Solution(jnp.asarray(displacement), jnp.ones(len(each), int), each, each <= CONVERGED)


class Factorised(AbstractSolver):
    """Sparse Cholesky on the host."""

    host: Host = eqx.field(static=True)

    @property
    def workers(self) -> int | None:
        return None

    def held(self, stiffness: AbstractStiffness, loads: Fields) -> Solution:
        # Known numbers are solved for at once. A callback from compiled code is for traced ones only: compiled programs that hold one
        # are not kept between runs, and large arrays handed to one can wait for ever on a machine of two cores.
        if not isinstance(stiffness.lame, jax.core.Tracer) and not isinstance(loads, jax.core.Tracer):
            return _checked(*self.host.solve(stiffness, np.asarray(loads)))
        if not isinstance(stiffness, Elastic):
            raise TypeError("a factorised solver undoes the stiffness of a strained body outside of compiled code only")
        shapes = jax.ShapeDtypeStruct(loads.shape, loads.dtype), jax.ShapeDtypeStruct((), loads.dtype)
        u, residual = jax.pure_callback(self.host.solve_elastic, shapes, stiffness.lame, loads, vmap_method="sequential")
        each = jnp.broadcast_to(residual, loads.shape[:1])
        return Solution(u, jnp.ones_like(each, dtype=int), each, each <= CONVERGED)

    def reduce(self, stiffness: AbstractStiffness, columns: Columns) -> AbstractCondensed:
        return self.host.condense(stiffness, columns)

    def forget(self) -> None:
        self.host.forget()


# Nodes up to which a factorisation pays. From some 100,000 on multigrid answers a single load sooner (docs/peers.md has both), but a
# finger asks for hundreds at once.
LARGEST = 180_000


def solver_for(body: Body, kind: str = "auto") -> AbstractSolver:
    """The solver to use for a body: `"multigrid"`, `"factorised"`, or `"auto"`, which factorises unless the body is large.

    `"factorised"` is `"pardiso"` where that is installed, and else `"frontal"`; either can be named.
    """
    if kind == "auto":
        kind = "factorised" if len(body.free) < LARGEST else "multigrid"
    if kind == "pardiso" and not pardiso_available():
        raise ImportError("the solver 'pardiso' needs MKL PARDISO: pip install fingerjax[direct], or choose 'factorised' or 'multigrid'")
    if kind in ("factorised", "pardiso", "frontal"):
        return Factorised(Host(body, Frontal if kind == "frontal" else None))
    if kind != "multigrid":
        raise ValueError(f"unknown solver {kind!r}; choose 'auto', 'multigrid', 'factorised', 'pardiso' or 'frontal'")
    solver, devices = MultigridCG(hierarchy(body)), tuple(jax.devices())
    return Shared(solver, devices) if len(devices) > 1 else solver
