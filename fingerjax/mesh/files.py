"""Fingers on disk: `.npz`, lossless and read back, and `.vtu` for viewers."""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from fingerjax.errors import InputError
from fingerjax.finger import Finger

ARRAYS = ("nodes", "tets", "layer", "skin", "nail", "bone", "proximal")
TEXTS = ("name", "key", "quality")


def arrays_of(finger: Finger) -> dict[str, np.ndarray]:
    """A finger as named arrays, texts as JSON."""
    out = {name: getattr(finger, name) for name in ARRAYS}
    texts = {name: getattr(finger, name) for name in TEXTS}
    out["texts"] = np.frombuffer(json.dumps(texts).encode(), np.uint8)
    return out


def finger_of(arrays: dict[str, np.ndarray]) -> Finger:
    """The finger that `arrays_of` took apart."""
    texts: dict[str, Any] = json.loads(arrays["texts"].tobytes().decode())
    fields: dict[str, Any] = {name: arrays[name] for name in ARRAYS}
    return Finger(**fields, **texts)


def checksum(arrays: dict[str, np.ndarray]) -> str:
    """Hash of names, types, shapes and contents."""
    hashed = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        hashed.update(f"{name}{array.dtype.str}{array.shape}".encode())
        hashed.update(array.tobytes())
    return hashed.hexdigest()


def packed(arrays: dict[str, np.ndarray]) -> bytes:
    """Arrays with their checksum, as the bytes of an `.npz`."""
    buffer = io.BytesIO()
    sealed = {**arrays, "checksum": np.frombuffer(checksum(arrays).encode(), np.uint8)}
    np.savez_compressed(buffer, **sealed)  # type: ignore[arg-type]
    return buffer.getvalue()


def unpacked(data: bytes) -> dict[str, np.ndarray] | None:
    """The arrays of `packed`, or None where the bytes are damaged."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        seal = arrays.pop("checksum").tobytes().decode()
    except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile, UnicodeDecodeError, RuntimeError):
        return None
    except Exception as error:  # zlib.error, struct.error: whatever a damaged archive raises, it is damaged
        if type(error).__name__ != "error":
            raise
        return None
    return arrays if checksum(arrays) == seal else None


def save(finger: Finger, path: str | os.PathLike[str]) -> None:
    """Write a finger as `.npz`."""
    Path(path).write_bytes(packed(arrays_of(finger)))


def load(path: str | os.PathLike[str]) -> Finger:
    """Read a finger written by `save`. Raises `InputError` where the file is missing or damaged."""
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(
            f"cannot be read ({error})", file=path, remedy="name a file written by fingerjax"
        ) from None
    arrays = unpacked(data)
    if arrays is None:
        raise InputError("is damaged, or not a finger", file=path, remedy="build the mesh again")
    return finger_of(arrays)


def export_vtu(finger: Finger, path: str | os.PathLike[str], **fields: np.ndarray) -> None:
    """Write a finger for viewers and other programs, in any format of meshio: ten-node tetrahedra, layer of every element (1 epidermis
    to 5 bone), nail, bone and proximal nodes.

    `fields` are further arrays per node `(n, ...)` or per element `(e, ...)`, told apart by their length.
    """
    import meshio

    points = {name: getattr(finger, name).astype(np.int8) for name in ("nail", "bone", "proximal")}
    cells = {"layer": [(finger.layer + 1).astype(np.int8)]}
    for name, values in fields.items():
        if len(values) == len(finger.nodes):
            points[name] = np.asarray(values)
        elif len(values) == len(finger.tets):
            cells[name] = [np.asarray(values)]
        else:
            raise InputError(
                "field is neither per node nor per element",
                place=name,
                seen=len(values),
                remedy=f"give {len(finger.nodes)} or {len(finger.tets)} rows",
            )
    meshio.Mesh(finger.nodes, [("tetra10", finger.tets)], point_data=points, cell_data=cells).write(path)
