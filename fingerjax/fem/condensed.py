"""A body at one material, reduced to its columns: what they read under each other's loads, and answers to any other load.

    C = B' K^-1 B

Contact needs C alone; how C changes with the material, under the forces that a contact ends with, is in `fem.slopes`.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, Int

from .body import Body
from .carried import Carriage
from .columns import Columns
from .operator import Lame

Fields = Float[Array, "k nodes 3"]
PROPORTIONAL = 1e-10  # relative difference up to which constants or forces are the same


class Held(eqx.Module):
    """Readings per unit load, `matrix` (m, m), with the material held at `lame`, and how well the solves behind it went."""

    matrix: Float[Array, "m m"]
    lame: Lame
    iterations: Int[Array, ""]
    residual: Float[Array, ""]
    converged: Bool[Array, ""]


class AbstractCondensed(abc.ABC):
    """A body at one material behind its columns. Lives outside compiled code: it may hold a factorisation."""

    held: Held

    @property
    def unscaled(self) -> tuple[AbstractCondensed, float]:
        """The body that this one is so many times as stiff as: itself, once."""
        return self, 1.0

    @property
    def memory(self) -> int:
        """Bytes that it holds for itself."""
        return 0

    @abc.abstractmethod
    def displacement(self, forces: Float[Array, "k m"]) -> Fields:
        """The displacement, mm, under each set of column forces, N."""

    @abc.abstractmethod
    def readings(self, loads: Fields) -> Float[Array, "k m"]:
        """What the columns read under other nodal forces, N."""

    @abc.abstractmethod
    def answer(self, loads: Fields) -> Fields:
        """The displacement, mm, under other nodal forces, N."""


class ByColumns(AbstractCondensed):
    """Every column's displacement at hand, (m, n, 3): all else but other answers is a dense product.

    `undo`: loads (k, n, 3) -> displacements (k, n, 3).
    """

    def __init__(self, held: Held, influence: Fields, undo: Callable[[Fields], Fields]):
        self.held, self.influence, self._undo = held, influence, undo

    @property
    def memory(self) -> int:
        return self.influence.nbytes

    def displacement(self, forces: Float[Array, "k m"]) -> Fields:
        return _combined(forces, self.influence)

    def readings(self, loads: Fields) -> Float[Array, "k m"]:
        return _worked(loads, self.influence)

    def answer(self, loads: Fields) -> Fields:
        return self._undo(loads)


@eqx.filter_jit
def _combined(forces: Array, influence: Array) -> Array:
    # Plain matrix products: XLA is slow at other contractions on a CPU.
    return (forces @ influence.reshape(len(influence), -1)).reshape(len(forces), *influence.shape[1:])


@eqx.filter_jit
def _worked(loads: Array, influence: Array) -> Array:
    return loads.reshape(len(loads), -1) @ influence.reshape(len(influence), -1).T


class ByFactor(AbstractCondensed):
    """A factorisation at hand, and the carried bone's motions: displacements are solved for when they are asked for.

    - `solve`: (free unknowns, k) loads -> displacements (k, n, 3) with the bone held.
    - `matrix`: the columns, (3n, m) sparse; `free`: which of the 3n unknowns are free.
    - `memory`: bytes of the factorisation, where that is its own.
    """

    memory = 0

    def __init__(
        self,
        held: Held,
        solve: Callable[[np.ndarray], np.ndarray],
        matrix: sp.csc_matrix,
        free: np.ndarray,
        bone: Carriage,
        memory: int = 0,
    ):
        self.held, self.memory = held, memory
        self._solve, self._matrix, self._free = solve, matrix, free
        self._motions, self._stiffness = np.asarray(bone.motions).reshape(len(bone.motions), matrix.shape[0]), np.asarray(bone.stiffness)

    def displacement(self, forces: Float[Array, "k m"]) -> Fields:
        return self._flat_answer(np.asarray((self._matrix @ np.asarray(forces).T).T))

    def readings(self, loads: Fields) -> Float[Array, "k m"]:
        flat = np.asarray(loads).reshape(len(loads), -1)
        return jnp.asarray((self._matrix.T @ np.asarray(self._flat_answer(flat)).reshape(len(flat), -1).T).T)

    def answer(self, loads: Fields) -> Fields:
        return self._flat_answer(np.asarray(loads).reshape(len(loads), -1))

    def _flat_answer(self, loads: np.ndarray) -> Array:
        held = self._solve(loads[:, self._free].T)
        if len(self._motions):  # as `Carriage.complete`, which is for compiled code
            held = held + (np.linalg.solve(self._stiffness, self._motions @ loads.T).T @ self._motions).reshape(held.shape)
        return jnp.asarray(held)


class Stiffer(AbstractCondensed):
    """A condensed body with its constants so many `times` as large, `lame` where they are known: every answer is that much smaller."""

    def __init__(self, condensed: AbstractCondensed, times: float, lame: Lame | None = None):
        held = condensed.held
        constants = held.lame * times if lame is None else jnp.asarray(lame)
        self.held = eqx.tree_at(lambda part: (part.matrix, part.lame), held, (held.matrix / times, constants))
        self._condensed, self._times = condensed, times

    @property
    def unscaled(self) -> tuple[AbstractCondensed, float]:
        body, times = self._condensed.unscaled
        return body, times * self._times

    def displacement(self, forces: Float[Array, "k m"]) -> Fields:
        return self._condensed.displacement(forces) / self._times

    def readings(self, loads: Fields) -> Float[Array, "k m"]:
        return self._condensed.readings(loads) / self._times

    def answer(self, loads: Fields) -> Fields:
        return self._condensed.answer(loads) / self._times


def first_like(body: Body, lames: Sequence[Lame], variant: int) -> tuple[int, float]:
    """The first of some materials whose constants are all in proportion to those of a variant, and how many times stiffer the variant is.

    Under a given travel both take one shape. The variant itself where none is, or where springs that do not follow the moduli hold the body
    too.
    """
    if body.springs is not None and body.springs.stay:
        return variant, 1.0
    layers = np.unique(np.asarray(body.layer))
    sizes = [np.asarray(lame, float)[:, layers].ravel() for lame in lames[: variant + 1]]
    lengths = [float(np.linalg.norm(size)) for size in sizes]
    own = sizes[variant] / lengths[variant]
    like = next(number for number, size in enumerate(sizes) if np.allclose(size / lengths[number], own, rtol=1e-12, atol=0.0))
    return like, lengths[variant] / lengths[like] if like < variant else 1.0


def probe(columns: Columns, condensed: AbstractCondensed) -> float:
    """How far the matrix is from what a solve under a random mix of all columns reads, relative."""
    mix = np.random.default_rng(0).choice([-1.0, 1.0], size=(1, columns.count))
    u = np.asarray(condensed.displacement(jax.device_put(mix)))[0]
    direct = np.einsum("msi,msi->m", np.asarray(columns.weight), u[np.asarray(columns.node)])
    through = np.asarray(condensed.held.matrix) @ mix[0]
    return float(np.linalg.norm(direct - through) / np.linalg.norm(through))
