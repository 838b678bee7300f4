"""Fits in several processes at once: each builds the problem for itself, and hands back what it found without it.

Threads would not do: a factorisation is kept with the body that it belongs to, and two fits would take it from each other.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any

import numpy as np

from ..forward.problem import Problem
from ..side_by_side import processors
from .fit import Fit, fit

Remake = Callable[[], Problem]
Tell = Callable[[float, str], object]


def room() -> int:
    """How many fits at once suit this machine: one for every two cores that this process may use."""
    return max(1, processors() // 2)


def fits_at_once(problem: Problem, remake: Remake, starts: np.ndarray, workers: int, tell: Tell) -> list[Fit]:
    """One fit from each start (k, p), in that order.

    **Arguments:** `remake` makes the same problem in another process, and is pickled on the way.
    """
    found: dict[int, Any] = {}
    with ProcessPoolExecutor(min(workers, len(starts)), multiprocessing.get_context("spawn"), _begin, (remake,)) as pool:
        waiting = {pool.submit(_one, start): number for number, start in enumerate(starts)}
        for done in as_completed(waiting):
            found[waiting[done]] = done.result()
            tell(len(found) / len(starts), f"{len(found)} of {len(starts)} starts done")
    return [Fit(problem=problem, **found[number]) for number in range(len(starts))]


_made: list[Problem] = []  # this process's own


def _begin(remake: Remake) -> None:
    import jax

    jax.config.update("jax_enable_x64", True)
    _made.append(remake())


def _one(start: np.ndarray) -> dict[str, Any]:
    """The fields of a fit but its problem, which cannot be pickled."""
    found = fit(_made[0], start=start)
    return {one.name: getattr(found, one.name) for one in dataclasses.fields(Fit) if one.name != "problem"}
