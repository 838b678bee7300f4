"""Independent pieces of numerical work, as many at a time as there are processors.

A factorisation of a fingertip gains little from a second thread of its own, two of them gain nearly all of it. The libraries that they
call give the interpreter free meanwhile, so threads serve; each piece has one thread of those libraries to itself.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from threadpoolctl import threadpool_limits

Item = TypeVar("Item")
Result = TypeVar("Result")
_here = threading.local()


def beside_others() -> bool:
    """Whether this is a piece of work that others are done beside."""
    return getattr(_here, "beside_others", False)


def _begin() -> None:
    _here.beside_others = True
    threadpool_limits(1)  # again: OpenMP counts for each thread apart


def processors() -> int:
    """How many this process may use: those of the machine, or as many threads as OMP_NUM_THREADS allows where that is less."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    asked = os.environ.get("OMP_NUM_THREADS", "").split(",")[0]
    return max(1, min(there, int(asked))) if asked.isdigit() else there


def side_by_side(work: Callable[[Item], Result], items: Sequence[Item], workers: int | None = None) -> list[Result]:
    """`work` of every item, in the order of the items. What the first of them raised is raised once those that were begun have ended, and
    no more are begun.
    """
    workers = min(processors() if workers is None else workers, len(items))
    if workers < 2:
        return [work(item) for item in items]
    with threadpool_limits(1), ThreadPoolExecutor(workers, initializer=_begin) as pool:
        waiting = [pool.submit(work, item) for item in items]
        try:
            return [one.result() for one in waiting]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
