"""How every test is run: float64, no silent promotion, no window, and where the measured data are.

Meshes are kept where the program keeps them (`FINGERJAX_CACHE`, or the user's cache folder), so that a second
run of the tests does not mesh again. pytetwild never makes the same skin twice, and a test that fails on one mesh
in twenty tells nobody why: the skins in `tests/skins`, made once by these tests, are put there first, so that every
machine runs on the same ones. Meshes of whatever a new test asks for, and those of nested shells, are made as always. To
run on fresh skins, and renew the kept ones:

    FINGERJAX_SKINS=fresh FINGERJAX_CACHE=/a/new/folder python -m pytest && cp /a/new/folder/*-skin.npz tests/skins
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("NPROC", "16")  # as the program itself sets it
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # on matrices of hundreds of rows its threads only wait for one another

if "JAX_COMPILATION_CACHE_DIR" not in os.environ:  # programs that one file compiled serve the next one, and the commands that tests start
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="fingerjax-programs-")
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")

# Most of the time of these tests is that of the compiler, which has hundreds of small programs to make that run once or twice each: it is
# asked for plain code, soon. Of other releases nobody knows whether they have these options, and one that has not breaks off.
# `XLA_FLAGS= python -m pytest` runs on the code that users have, and `test_compiler.py` always does.
if version("jaxlib").startswith("0.10."):
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0")

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture(autouse=True, scope="module")
def _forget_programs() -> Iterator[None]:
    """Compiled programs are dropped after each file: a process may map some 65,000 pieces of memory, and all tests together have more."""
    yield
    jax.clear_caches()


REPOSITORY = Path(__file__).resolve().parent.parent


def pytest_sessionstart() -> None:
    """Puts the skins of `tests/skins` where the program looks for its meshes, unless `FINGERJAX_SKINS=fresh`."""
    if os.environ.get("FINGERJAX_SKINS") == "fresh":
        return
    from fingerjax.mesh.cache import cache_dir  # not before the hook that checks shapes and types is in place

    folder = cache_dir()
    for skin in (REPOSITORY / "tests" / "skins").glob("*.npz"):
        if not (folder / skin.name).exists():
            handle, temporary = tempfile.mkstemp(dir=folder, suffix=".tmp")
            os.close(handle)
            shutil.copyfile(skin, temporary)
            os.replace(temporary, folder / skin.name)


@pytest.fixture(scope="session")
def measured() -> Path:
    """The folder of measured data: `FINGERJAX_DATA`, or `shared/data` beside the repository; or a skip."""
    named = os.environ.get("FINGERJAX_DATA")
    folder = Path(named) if named else REPOSITORY.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no measured data: {folder} is not a folder; set FINGERJAX_DATA to it")
    return folder
