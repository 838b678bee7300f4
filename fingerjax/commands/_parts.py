"""Parts of a long computation, kept as they come, so that one that was stopped goes on from them."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any


class Parts:
    """Called with a name and a function: what was kept under that name, or what the function makes, which is kept from then on.

    **Arguments:** `folder`, where the parts lie; it belongs to one computation, whose inputs do not change.

    A part is plain data: dictionaries, lists, numbers (to the last bit, NaN and infinities too), text. One that cannot be read is made
    again.
    """

    def __init__(self, folder: Path):
        self.folder = folder

    def __call__(self, name: str, make: Callable[[], Any]) -> Any:
        path = self.folder / f"{hashlib.sha256(name.encode()).hexdigest()[:24]}.json"
        found, kept = _read(path, name)
        if found:
            return kept
        made = make()
        waiting = path.with_suffix(".writing")
        waiting.write_text(json.dumps({"name": name, "part": made}), encoding="utf-8")
        os.replace(waiting, path)
        return made

    def __len__(self) -> int:
        return len(list(self.folder.glob("*.json")))


def _read(path: Path, name: str) -> tuple[bool, Any]:
    """(whether it is there, the part)."""
    try:
        said = json.loads(path.read_text(encoding="utf-8"))
        return said["name"] == name, said["part"]
    except (OSError, ValueError, KeyError, TypeError):
        return False, None
