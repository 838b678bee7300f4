"""The door for studies: `experiments.yaml` becomes checked `Study` records before anything is computed.

A study names a finger, a model, measurements, and what is to be done with them. Every name in it (a layer, a
parameter, a column, a measurement) is checked here against what there is; what is wrong is refused with
file, line and the nearest name.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .errors import InputError
from .spelling import choose_from
from .study_keys import Finger, Model
from .study_reader import StudyReader
from .study_records import (
    Diagnose,
    Fit,
    ForceTable,
    HeldOut,
    LayerStudy,
    Prior,
    Study,
    TableRow,
    base_parameters,
)
from .study_sweep import Sweep
from .yamlfile import Document, Origin, located, read_yaml

__all__ = [
    "Diagnose",
    "Finger",
    "Fit",
    "ForceTable",
    "HeldOut",
    "LayerStudy",
    "Model",
    "Prior",
    "Study",
    "Sweep",
    "TableRow",
    "base_parameters",
    "load_studies",
]

VERSION = 1


def load_studies(path: Path | str, data: Path | str | None = None) -> dict[str, Study]:
    """Read a study, or several under `studies:`, with every file that they name.

    **Arguments:** the YAML file, and the data folder (the environment's FINGERJAX_DATA where None).

    **Returns** the studies by name; a single one is named after its file.

    **Raises** `InputError` for the first thing wrong. Data that should lie in the data folder and do not are
    no error: see `Study.missing_data`.
    """
    file = Path(path)
    folder = data if data is not None else os.environ.get("FINGERJAX_DATA") or None
    shared = Path(folder) if folder is not None else None
    document = read_yaml(file)
    sources = _split(document)
    studies = {
        name: StudyReader(name, file, shared, origin).read(said) for name, (said, origin) in sources.items()
    }
    for name, study in studies.items():
        if study.fallback is not None and (study.fallback not in studies or study.fallback == name):
            others = [other for other in studies if other != name]
            at, where = sources[name][1](("fallback",))
            remedy = choose_from(study.fallback, others)
            raise InputError("no such study", file=at, place=where, seen=study.fallback, remedy=remedy)
    return studies


def _split(document: Document) -> dict[str, tuple[Any, Origin]]:
    content, file = document.content, document.file
    if not isinstance(content, Mapping):
        remedy = "write keys and values: version: 1, finger: ..., see DATA.md"
        raise InputError("the file holds no study", file=file, seen=content, remedy=remedy)
    origin = document.origin()
    if content.get("version", VERSION) != VERSION:
        at, where = origin(("version",))
        remedy = f"this program reads version {VERSION}"
        raise InputError("unknown version", file=at, place=where, seen=content["version"], remedy=remedy)
    if "studies" not in content:
        return {file.stem: (content, origin)}
    with located(origin):
        other = next((str(key) for key in content if key not in ("version", "studies")), None)
        if other is not None:
            remedy = choose_from(other, ["version", "studies"]) + "; write it inside each study"
            raise InputError("unknown key beside `studies`", place=other, remedy=remedy)
        if not isinstance(content["studies"], Mapping) or not content["studies"]:
            raise InputError("no studies are named", place="studies", remedy="write NAME: {finger: ..., ...}")
    return {str(name): (said, document.origin("studies", name)) for name, said in content["studies"].items()}
