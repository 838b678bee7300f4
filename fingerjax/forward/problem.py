"""What a fit needs to know of a model: which numbers move, and how far every reading is from its measurement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..parameters import Parameter

LOSSES = ("linear", "huber", "soft_l1", "cauchy")


class Health(eqx.Module):
    """How the solves and contacts inside one evaluation went: the worst of all of them.

    - `converged`: did every one of them converge?
    - `iterations`: the most iterations any of them took.
    - `residual`: the largest true relative residual.
    """

    converged: Bool[Array, ""]
    iterations: Int[Array, ""]
    residual: Float[Array, ""]


@dataclass(frozen=True)
class Problem:
    """A least-squares problem: free parameters, and whitened residuals as a function of them.

    **Arguments:**

    - `parameters`: the free ones, in the order of the raw vector.
    - `residuals`: raw vector (p,) -> (residuals (rows,), `Health`); a residual is (prediction - data) / sigma. Traceable by jax.
      Rows of prior knowledge come last.
    - `blocks`: the rows of each measurement; those of prior knowledge are called `prior`.
    - `sigma_source`: for each measurement `stated`, `replicates` or `assumed`.
    - `prepare`: for one raw vector, residuals that hold there and whose derivatives do: what needs no derivative (the linear
      solves) is done before anything is traced. None where the residuals are cheap as they are.
    - `reseat`: for one raw vector, the same with the values that can be found exactly for the others (scale and threshold of an
      afferent) replaced by the best ones: where nothing fires, no slope leads back. None where there are none.
    - `loss`: what is done to a squared residual before they are added, one of `LOSSES`; rows of prior knowledge are always squared.
    """

    parameters: tuple[Parameter, ...]
    residuals: Callable[[Array], tuple[Array, Health]]
    blocks: dict[str, slice]
    sigma_source: dict[str, str]
    prepare: Callable[[Array], Callable[[Array], tuple[Array, Health]]] | None = None
    reseat: Callable[[np.ndarray], np.ndarray] | None = None
    loss: str = "linear"

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(parameter.name for parameter in self.parameters)

    def start(self) -> np.ndarray:
        """Raw start values, (p,)."""
        return np.array([parameter.raw() for parameter in self.parameters])
