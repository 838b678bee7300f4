"""A body factorised on the host: full answers to any load, and the skin condensed within the factorisation itself."""

from __future__ import annotations

import threading
import weakref
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse as sp
from jaxtyping import Array

from .assembly import Assembled
from .body import Body
from .carried import Carriage, bone_loads, carriage
from .cholesky import AbstractCholesky, Indefinite
from .columns import Columns
from .condensed import AbstractCondensed, ByFactor, Held, Stiffer, first_like, probe
from .frontal import Frontal
from .pardiso import Pardiso, pardiso_available
from .stiffness import AbstractStiffness, Elastic

CONVERGED = 1e-8  # relative residual up to which a factorisation went well
PARTIAL_FROM = 64  # columns from which on the skin is condensed in the factorisation itself
REMEMBERED = 6  # condensed bodies of one pattern: subjects, say
SPARE = 300_000_000  # bytes of factorisations that nothing asks for, whose analysis may serve again
PROBES = 8  # random combinations of all loads in which a factorisation's residual is measured


@dataclass(frozen=True, eq=False)
class _Answered:
    """What a stiffness was asked for: `columns`, known by their weights and as a `matrix`, and their readings with the `bone_held`."""

    columns: Array
    stiffness: AbstractStiffness
    condensed: AbstractCondensed
    matrix: sp.csc_matrix
    riding: Carriage
    bone_held: np.ndarray


class _Apart:
    """A strained body's stiffness with a factorisation of its own, which lives as long as what was condensed with it."""

    def __init__(self, stiffness: AbstractStiffness, K: sp.csr_matrix, factor: AbstractCholesky):
        self.stiffness, self.K, self.factor = stiffness, K, factor
        self.schur = factor.factor(K.data)


class _Spares:
    """Factorisations that nothing asks for any more: what was analysed serves the next of the same pattern. Of many the oldest go."""

    def __init__(self) -> None:
        self._all: list[tuple[bytes, AbstractCholesky]] = []
        self._one_at_a_time = threading.RLock()  # the interpreter may let go of one, and hand it in, in the midst of this

    def take(self, pattern: bytes) -> AbstractCholesky | None:
        with self._one_at_a_time:
            fits = [number for number, (other, _) in enumerate(self._all) if other == pattern]
            return self._all.pop(fits[-1])[1] if fits else None

    def put(self, pattern: bytes, factor: AbstractCholesky) -> None:
        with self._one_at_a_time:
            self._all.append((pattern, factor))
            while sum(one.memory for _, one in self._all) > SPARE:
                self._all.pop(0)

    def clear(self) -> None:
        with self._one_at_a_time:
            self._all.clear()


class Host:
    """The assembled pattern of one body, or of several that share elements and supports, and the last factorisation done with it; lives
    outside compiled code.

    `how`: the factorisation to use, PARDISO's where it is installed and nothing is said.

    Several threads may ask it: each strained stiffness has a factorisation of its own, and those of the linear body come one at a time.
    """

    def __init__(self, body: Body, how: type[AbstractCholesky] | None = None):
        self._how = how or (Pardiso if pardiso_available() else Frontal)
        self.body, self.assembled = body, Assembled(body, upper=True)
        self.nodes = len(body.free)
        self._factor: AbstractCholesky | None = None
        self._kept = np.zeros(len(self.assembled.free), bool)
        self._stiffness: AbstractStiffness | None = None
        self._K = sp.csr_matrix((0, 0))
        self._last: list[_Answered] = []
        self._own = threading.local()  # of each thread the strained stiffness that it asked about last
        self._one_at_a_time = threading.RLock()
        self._spares = _Spares()

    def forget(self) -> None:
        """Let go of every factorisation that can be made again, and of what was answered but for the last."""
        with self._one_at_a_time:
            self._factor = self._stiffness = self._own.apart = None
            self._last = self._last[-1:]
            self._kept = np.zeros_like(self._kept)
        self._spares.clear()

    def condense(self, stiffness: AbstractStiffness, columns: Columns) -> AbstractCondensed:
        """The body behind its columns; the last few linear ones are kept, for fits that move something else or all constants in proportion.

        Where most columns were asked for at this stiffness already, only the others are solved for: a receptor that moves, say.
        """
        if not isinstance(stiffness, Elastic):
            return self._condensed(stiffness, columns).condensed
        with self._one_at_a_time:
            return self._condensed_linear(stiffness, columns)

    def _condensed_linear(self, stiffness: Elastic, columns: Columns) -> AbstractCondensed:
        """That of the linear body, which no other thread may ask meanwhile."""
        known = [one for one in self._last if one.columns is columns.weight]
        for answered in known:
            if _same(answered.stiffness, stiffness):
                return answered.condensed
        for answered in known:
            times = _times(answered.stiffness, stiffness)
            if times is not None:
                return Stiffer(answered.condensed, times, jnp.asarray(stiffness.lame))
        found = self._completed(stiffness, columns) or self._condensed(stiffness, columns)
        self._last = [*self._last[1 - REMEMBERED :], found]
        return found.condensed

    def _completed(self, stiffness: Elastic, columns: Columns) -> _Answered | None:
        """What was asked for at this stiffness, with the columns that are new; None where these are many."""
        matrix = columns.matrix()
        wanted = _told_apart(matrix)
        for answered in reversed(self._last):
            if not _same(answered.stiffness, stiffness):
                continue
            number = {column: place for place, column in enumerate(_told_apart(answered.matrix))}
            there = np.array([number.get(column, -1) for column in wanted])
            new, known = np.flatnonzero(there < 0), np.flatnonzero(there >= 0)
            if len(new) < min(PARTIAL_FROM, len(known)):
                C = np.zeros((len(wanted),) * 2)
                C[np.ix_(known, known)] = answered.bone_held[np.ix_(there[known], there[known])]
                flat = sp.csr_matrix(matrix)[self.assembled.free]
                found, residual = self.direct(stiffness, flat[:, new].toarray())
                _enter(C, new, flat.T @ found.reshape(len(new), 3 * self.nodes)[:, self.assembled.free].T)
                return self._answered(stiffness, columns, answered.riding, C, residual)
        return None

    def _condensed(self, stiffness: AbstractStiffness, columns: Columns) -> _Answered:
        matrix, modes = columns.matrix(), len(self.body.modes)
        kept, flat = _touched(columns, matrix)[self.assembled.free], sp.csr_matrix(matrix)[self.assembled.free]
        surface = np.asarray((flat != 0).sum(axis=0)).ravel() == np.asarray((flat[kept] != 0).sum(axis=0)).ravel()
        if columns.count < PARTIAL_FROM or not kept.any():
            kept, surface = np.zeros(len(kept), bool), np.zeros(columns.count, bool)
        apart = None if isinstance(stiffness, Elastic) else self._factorised_apart(stiffness, kept)
        schur = self._at(stiffness, kept) if apart is None else apart.schur
        bone = np.asarray(bone_loads(stiffness)).reshape(modes, 3 * self.nodes)[:, self.assembled.free].T
        others = flat[:, ~surface].toarray()
        found, residual = self.direct(stiffness, np.hstack([others, bone]))
        riding = carriage(stiffness, jnp.asarray(found[others.shape[1] :]))
        C = self._read(flat, surface, found[: others.shape[1]], schur, kept)
        return self._answered(stiffness, columns, riding, C, residual, apart)

    def _factorised_apart(self, stiffness: AbstractStiffness, kept: np.ndarray) -> _Apart:
        """A factorisation beside that of the linear body, of those that nothing asks for any more where there is one."""
        K, pattern = stiffness.matrix(self.assembled), kept.tobytes()
        factor = self._spares.take(pattern) or self._how(K.indptr, K.indices, kept if kept.any() else None)
        try:
            apart = _Apart(stiffness, K, factor)
        except Indefinite:
            self._spares.put(pattern, factor)
            raise
        weakref.finalize(apart, self._spares.put, pattern, factor)
        self._own.apart = apart
        return apart

    def _read(
        self, flat: sp.csr_matrix, surface: np.ndarray, others: np.ndarray, schur: np.ndarray | None, kept: np.ndarray
    ) -> np.ndarray:
        """Readings per unit load with the bone held: from the Schur complement at the surface, from solves for the other columns."""
        C = np.zeros((flat.shape[1],) * 2)
        if schur is not None and surface.any():
            hats = flat[kept][:, surface].toarray()
            lower = scipy.linalg.cholesky(schur, lower=True, overwrite_a=True, check_finite=False)
            half = scipy.linalg.solve_triangular(lower, hats, lower=True, check_finite=False)
            C[np.ix_(surface, surface)] = half.T @ half
        _enter(C, np.flatnonzero(~surface), flat.T @ others.reshape(len(others), 3 * self.nodes)[:, self.assembled.free].T)
        return C

    def _answered(
        self,
        stiffness: AbstractStiffness,
        columns: Columns,
        riding: Carriage,
        bone_held: np.ndarray,
        residual: float,
        apart: _Apart | None = None,
    ) -> _Answered:
        """The carried bone let go, and how well it all went."""
        matrix = columns.matrix()
        work = matrix.T @ np.asarray(riding.motions).reshape(len(riding.motions), 3 * self.nodes).T
        C = bone_held + work @ np.asarray(riding.gives(jnp.asarray(work.T)))

        def held(residual: float) -> Held:
            ended = jnp.asarray(1), jnp.asarray(residual), jnp.asarray(residual <= CONVERGED)
            return Held(jnp.asarray((C + C.T) / 2), jnp.asarray(stiffness.lame), *ended)

        def solve(right: np.ndarray) -> np.ndarray:
            return self._backed(stiffness, right, apart)[0]

        memory = 0 if apart is None else apart.factor.memory
        condensed = ByFactor(held(residual), solve, matrix, self.assembled.free, riding, memory)
        condensed.held = held(max(residual, probe(columns, condensed)))
        return _Answered(columns.weight, stiffness, condensed, matrix, riding, bone_held)

    def solve(self, stiffness: AbstractStiffness, loads: np.ndarray) -> tuple[np.ndarray, float]:
        """Displacements (m, n, 3) under loads (m, n, 3), and the relative residual of them all."""
        return self.direct(stiffness, loads.reshape(len(loads), 3 * self.nodes)[:, self.assembled.free].T)

    def solve_elastic(self, lame: Array | np.ndarray, loads: Array | np.ndarray) -> tuple[np.ndarray, float]:
        """`solve` for the linear body, called from compiled code."""
        return self.solve(Elastic(self.body, np.asarray(lame)), np.asarray(loads))

    def direct(self, stiffness: AbstractStiffness, right: np.ndarray) -> tuple[np.ndarray, float]:
        """Displacements (m, n, 3) under loads (free, m) between free unknowns, and the residual of them all."""
        last: _Apart | None = getattr(self._own, "apart", None)
        if last is not None and last.stiffness is stiffness:
            full, x = self._backed(stiffness, right, last)
            return full, _probed(last.K, x, right)
        with self._one_at_a_time:
            full, x = self._backed(stiffness, right)
            return full, _probed(self._K, x, right)

    def _backed(self, stiffness: AbstractStiffness, right: np.ndarray, apart: _Apart | None = None) -> tuple[np.ndarray, np.ndarray]:
        """The same displacements, and those of the free unknowns (free, m), by a factorisation that has been probed before."""
        if not right.shape[1]:
            return np.zeros((0, self.nodes, 3)), right
        if apart is None:
            with self._one_at_a_time:
                self._at(stiffness)
                assert self._factor is not None
                x = self._factor.solve(right)
        else:
            x = apart.factor.solve(right)
        full = np.zeros((right.shape[1], 3 * self.nodes))
        full[:, self.assembled.free] = x.T
        return full.reshape(-1, self.nodes, 3), x

    def _at(self, stiffness: AbstractStiffness, kept: np.ndarray | None = None) -> np.ndarray | None:
        """Factorise this stiffness unless that was done last; with `kept`, always, for the Schur complement of those unknowns."""
        wanted = self._kept if kept is None else kept
        other_pattern = self._factor is None or not np.array_equal(wanted, self._kept)
        if not other_pattern and kept is None and _same(self._stiffness, stiffness):
            return None
        self._K, self._stiffness = stiffness.matrix(self.assembled), None
        if other_pattern:
            self._factor = None  # its memory goes before the next one's comes
            self._factor = self._how(self._K.indptr, self._K.indices, wanted if wanted.any() else None)
            self._kept = wanted
        assert self._factor is not None
        schur = self._factor.factor(self._K.data)
        self._stiffness = stiffness
        return schur


def _same(one: AbstractStiffness | None, other: AbstractStiffness) -> bool:
    if isinstance(one, Elastic) and isinstance(other, Elastic):
        return _of_one_body(one, other) and np.array_equal(np.asarray(one.lame), np.asarray(other.lame))
    return one is other


def _times(one: AbstractStiffness, other: Elastic) -> float | None:
    """How many times as stiff as the one the other is; None where their constants are not in proportion."""
    if not isinstance(one, Elastic) or not _of_one_body(one, other):
        return None
    like, times = first_like(other.body, [jnp.asarray(one.lame), jnp.asarray(other.lame)], 1)
    return times if like == 0 else None


def _of_one_body(one: Elastic, other: Elastic) -> bool:
    parts = zip(jax.tree.leaves(one.body), jax.tree.leaves(other.body), strict=False)
    return all(part is other_part for part, other_part in parts) and (one.body.springs is None) == (other.body.springs is None)


def _told_apart(matrix: sp.csc_matrix) -> list[tuple[bytes, bytes]]:
    """What each column holds."""
    own = sp.csc_matrix(matrix, copy=True)
    own.eliminate_zeros()
    own.sort_indices()
    parts = zip(own.indptr[:-1], own.indptr[1:], strict=True)
    return [(own.indices[a:b].tobytes(), own.data[a:b].tobytes()) for a, b in parts]


def _enter(C: np.ndarray, at: np.ndarray, seen: np.ndarray) -> None:
    """Write what every column reads under the loads of those `at` into a symmetric matrix."""
    C[:, at], C[at] = seen, seen.T


def _touched(columns: Columns, matrix: sp.csc_matrix) -> np.ndarray:
    """(3n,) bool: unknowns that are loaded by columns which act along y alone, as those of the skin do."""
    weight = np.asarray(columns.weight)
    along_y = ~np.any(weight[..., [0, 2]] != 0, axis=(1, 2))
    return np.asarray(abs(matrix[:, along_y]).sum(axis=1)).ravel() > 0


def _probed(upper: sp.csr_matrix, x: np.ndarray, right: np.ndarray) -> float:
    """Largest relative residual of `K x = right` in random combinations of its columns; `upper` is K's upper triangle.

    A factorisation fails as a whole, not in one column, and a combination of all of them sees that at a fraction of the cost.
    """
    if not right.shape[1]:
        return 0.0
    mix = np.random.default_rng(0).choice([-1.0, 1.0], size=(right.shape[1], min(PROBES, right.shape[1])))
    load, u = right @ mix, x @ mix
    remainder = load - (upper @ u + upper.T @ u - upper.diagonal()[:, None] * u)
    norm = np.linalg.norm(load, axis=0)
    return float(np.max(np.linalg.norm(remainder, axis=0) / np.where(norm > 0, norm, 1.0)))
