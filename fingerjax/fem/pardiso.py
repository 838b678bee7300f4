"""A sparse Cholesky factorisation by MKL PARDISO, from the extra `direct`."""

from __future__ import annotations

import ctypes
import functools
import importlib.util
import sys
from typing import Any

import numpy as np

from .cholesky import AbstractCholesky, Indefinite

SYMMETRIC_POSITIVE_DEFINITE = 2
ANALYSE, FACTOR, SOLVE, RELEASE = 11, 22, 33, -1
_INT = ctypes.c_int32


def pardiso_available() -> bool:
    """Whether the extra `direct` is installed."""
    return importlib.util.find_spec("pypardiso") is not None


@functools.cache
def _library() -> Any:
    """MKL, looked for once: that takes longer than many a factorisation."""
    from pypardiso import PyPardisoSolver

    return PyPardisoSolver(mtype=SYMMETRIC_POSITIVE_DEFINITE)


class Pardiso(AbstractCholesky):
    """Raises `ImportError` without the extra `direct`.

    Every phase runs with as many threads as the analysis had: with fewer, MKL writes past the memory that it laid out for them.
    """

    def __init__(self, indptr: np.ndarray, indices: np.ndarray, kept: np.ndarray | None = None):
        self.size = len(indptr) - 1
        self.kept = 0 if kept is None else int(np.count_nonzero(kept))
        self._library = _library()
        self._handle = np.zeros(64, self._library._pt_type[1])
        self._indptr, self._indices = (np.asarray(part, np.int32) + 1 for part in (indptr, indices))
        self._order = np.zeros(self.size, np.int32) if kept is None else np.asarray(kept, np.int32)
        self._options = np.zeros(64, np.int32)
        self._options[[0, 1]] = 1, 2  # own options; nested dissection
        self._options[35] = 2 if self.kept else 0  # the Schur complement, and factors that solve as well
        self._data = np.zeros(len(self._indices))
        self._analysed = False
        self._threads = self._library.libmkl.MKL_Get_Max_Threads()

    def factor(self, data: np.ndarray) -> np.ndarray:
        self._data = np.ascontiguousarray(data, float)
        schur, nothing = np.zeros((max(self.kept, 1),) * 2), np.zeros(1)
        if not self._analysed:
            self._call(ANALYSE, nothing, nothing)
            self._analysed = True
        self._call(FACTOR, nothing, schur)
        return schur[: self.kept, : self.kept]

    def solve(self, right: np.ndarray) -> np.ndarray:
        right = np.asfortranarray(right, float)
        answer = np.zeros_like(right, order="F")
        if right.shape[1]:
            self._call(SOLVE, right, answer)
        return answer

    @property
    def memory(self) -> int:
        return 1024 * int(self._options[15] + self._options[16])  # the analysis and the factors

    def _call(self, phase: int, right: np.ndarray, answer: np.ndarray) -> None:
        columns = right.shape[1] if right.ndim == 2 else 1
        error = _INT(0)
        before = self._library.libmkl.MKL_Set_Num_Threads_Local(self._threads)  # of this thread of the interpreter alone
        self._library._mkl_pardiso(
            self._handle.ctypes.data_as(ctypes.POINTER(self._library._pt_type[0])),
            *(_INT(value) for value in (1, 1, SYMMETRIC_POSITIVE_DEFINITE, phase, self.size)),
            self._data.ctypes.data_as(ctypes.c_void_p),
            *(part.ctypes.data_as(ctypes.POINTER(_INT)) for part in (self._indptr, self._indices, self._order)),
            _INT(columns),
            self._options.ctypes.data_as(ctypes.POINTER(_INT)),
            _INT(0),
            right.ctypes.data_as(ctypes.c_void_p),
            answer.ctypes.data_as(ctypes.c_void_p),
            ctypes.byref(error),
        )
        self._library.libmkl.MKL_Set_Num_Threads_Local(before)
        if error.value == -4:
            raise Indefinite
        if error.value:
            raise RuntimeError(f"MKL PARDISO failed with error {error.value} in phase {phase}")

    def __del__(self) -> None:
        if getattr(self, "_analysed", False) and not sys.is_finalizing():
            self._call(RELEASE, np.zeros(1), np.zeros(1))
