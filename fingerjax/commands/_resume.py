"""When a finished study of a killed run may be used again: nothing that it was made from has changed."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from fingerjax import __version__
from fingerjax.geometry.views import read_views
from fingerjax.report.records import plain
from fingerjax.study import Study
from fingerjax.study_reader import SHARED


def study_key(study: Study, data: Path | None, options: str = "") -> str:
    """A hash of the study as written, every file that it names (with its sidecar), the program, and `options` of the command."""
    digest = hashlib.sha256(options.encode())
    said = {"name": study.name, "written": plain(study.written), "missing": list(study.missing_data)}
    digest.update(json.dumps(said, sort_keys=True).encode())
    for path in sorted(set(named_files(study, data))):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    digest.update(_program().encode())
    return digest.hexdigest()


def named_files(study: Study, data: Path | None) -> Iterator[Path]:
    """Every file that a text in the study names, the sidecars beside them, what lies beside a table and is named, and the pictures that
    its views name.
    """
    if study.finger.images is not None and study.shape is not None:
        yield study.shape
        yield from read_views(study.shape).pictures
    beside = {one.file.parent for one in study.measurements if one.file is not None}
    for text in _texts(study.written):
        folders = {data} if text.startswith(SHARED) else {study.file.parent, *beside}
        for path in [folder / text.removeprefix(SHARED).lstrip("/") for folder in folders if folder is not None]:
            if not os.path.isfile(path):  # where Path.is_file raises, for a text too long to name a file, this says no
                continue
            yield path
            if path.suffix == ".csv" and path.with_suffix(".yaml").is_file():
                yield path.with_suffix(".yaml")


def _texts(said: Any) -> Iterator[str]:
    if isinstance(said, str):
        yield said
    elif isinstance(said, dict):
        for entry in said.values():
            yield from _texts(entry)
    elif isinstance(said, (list, tuple)):
        for entry in said:
            yield from _texts(entry)


@cache
def _program() -> str:
    """The version, and the text of the package: a change of the code asks for a new result."""
    digest = hashlib.sha256(__version__.encode())
    root = Path(__file__).resolve().parent.parent
    for path in sorted(root.rglob("*.py")):
        digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()
