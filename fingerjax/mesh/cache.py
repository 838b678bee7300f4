"""Meshes are kept by what made them: pytetwild is not deterministic, so a mesh built twice is two meshes.

A file is written beside its place and then linked into it, so a reader never sees half of it and of two
processes that build the same mesh at once the first wins and the second takes its mesh. A damaged file is
built again.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from fingerjax.mesh.files import packed, unpacked

Arrays = dict[str, np.ndarray]


def cache_dir() -> Path:
    """Folder of kept meshes: FINGERJAX_CACHE or the user's cache folder, made if missing."""
    named = os.environ.get("FINGERJAX_CACHE")
    if named:
        folder = Path(named)
    else:
        from platformdirs import user_cache_dir

        folder = Path(user_cache_dir("fingerjax"))
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def content_key(*parts: object) -> str:
    """Twenty hexadecimal digits that name whatever the parts' texts say."""
    return hashlib.sha256("\n".join(str(part) for part in parts).encode()).hexdigest()[:20]


def kept(key: str, build: Callable[[], Arrays]) -> Arrays:
    """The arrays kept under `key`, built and kept first when there are none or the file is damaged."""
    path = cache_dir() / f"{key}.npz"
    found = _read(path)
    if found is not None:
        return found
    damaged = path.exists()
    built = build()
    return _keep(path, built, replace=damaged)


def _read(path: Path) -> Arrays | None:
    try:
        return unpacked(path.read_bytes())
    except OSError:
        return None


def _keep(path: Path, arrays: Arrays, replace: bool) -> Arrays:
    """Put arrays into place whole; when another process was first, return what it kept."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=".tmp")
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(packed(arrays))
        if replace:
            os.replace(temporary, path)
            return arrays
        try:
            os.link(temporary, path)
        except FileExistsError:
            return _read(path) or arrays
        except OSError:  # a file system without links
            os.replace(temporary, path)
        return arrays
    finally:
        temporary.unlink(missing_ok=True)
