"""YAML as people write it: read safely, with the line of every key kept, and a key written twice refused."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from .errors import InputError

Keys = tuple[str | int, ...]
Origin = Callable[[Keys], tuple[Path | None, str]]
"""Where a value was written: the path of keys to it -> the file, and its place there in words."""


class _Loader(yaml.SafeLoader):
    """`SafeLoader` for which `1e8` is a number (YAML 1.1 wants `1.0e+8` and would hand over text)."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?\d[\d_]*(\.\d*)?[eE][-+]?\d+"), list("-+0123456789")
)


@dataclasses.dataclass(frozen=True)
class Document:
    """What one YAML file holds.

    - `file`: where it is.
    - `content`: plain dictionaries, lists, numbers and text.
    - `lines`: line number (from 1) of every key and item, by its path of keys.
    """

    file: Path
    content: Any
    lines: dict[Keys, int]

    def origin(self, *prefix: str | int) -> Origin:
        """Where values below `prefix` were written; a key that is absent is placed at the nearest one above
        it.
        """
        return lambda keys: (self.file, place(prefix + keys, self._line(prefix + keys)))

    def _line(self, keys: Keys) -> int | None:
        known = (keys[:end] for end in range(len(keys), 0, -1) if keys[:end] in self.lines)
        return self.lines.get(next(known, ()))


def place(keys: Keys, line: int | None = None) -> str:
    """A path of keys in words: `fit.free.2 (line 14)`."""
    path = ".".join(str(key) for key in keys)
    return f"{path} (line {line})".strip() if line else path


def said_in_python(keys: Keys) -> tuple[None, str]:
    """The `Origin` of what a caller handed over as a dictionary: no file, only the keys."""
    return None, place(keys)


@contextmanager
def located(origin: Origin, *keys: str | int) -> Iterator[None]:
    """Give a refusal raised inside the file and the line of `keys`; its own place is taken as one further
    key.
    """
    try:
        yield
    except InputError as error:
        if error.file is not None:
            raise
        file, where = origin(keys + ((error.place,) if error.place else ()))
        raise InputError(
            error.problem, file=file, place=where, seen=error.seen, remedy=error.remedy
        ) from None


def read_text(file: Path) -> str:
    """The text of a UTF-8 file. **Raises** `InputError` where it is not there or is not UTF-8 text."""
    try:
        return file.read_text(encoding="utf-8-sig")
    except (FileNotFoundError, NotADirectoryError):
        raise InputError("no such file", file=file, remedy="check the path and the spelling") from None
    except IsADirectoryError:
        raise InputError("this is a folder", file=file, remedy="name a file in it") from None
    except UnicodeDecodeError as error:
        problem = f"byte {error.start} is not UTF-8 text"
        raise InputError(problem, file=file, seen=error.object[error.start], remedy="save as UTF-8") from None
    except OSError as error:
        raise InputError(
            f"cannot be read: {error.strerror}", file=file, remedy="check its permissions"
        ) from None


def read_yaml(file: Path) -> Document:
    """Read one YAML document.

    **Raises** `InputError` with the line: text that is not YAML, a key written twice, an object of Python's
    own, nesting too deep.
    """
    loader = _Loader(read_text(file))
    try:
        node = loader.get_single_node()
        lines: dict[Keys, int] = {}
        _walk(node, (), lines, set(), file)
        content = loader.construct_document(node) if node is not None else None
    except yaml.YAMLError as error:
        raise _unreadable(file, error) from None
    except RecursionError:
        raise InputError("nested too deeply", file=file, remedy="see DATA.md for an example") from None
    finally:
        loader.dispose()
    return Document(file, content, lines)


def _unreadable(file: Path, error: yaml.YAMLError) -> InputError:
    mark = getattr(error, "problem_mark", None)
    where = f"line {mark.line + 1}, column {mark.column + 1}" if mark else None
    problem = getattr(error, "problem", None) or getattr(error, "reason", None) or "unreadable text"
    return InputError(
        f"not plain YAML: {problem}", file=file, place=where, remedy="see DATA.md for an example"
    )


def _walk(node: yaml.Node | None, keys: Keys, lines: dict[Keys, int], seen: set[int], file: Path) -> None:
    """Note the line of every key below `node`. A shared node (an alias) is walked once, so aliases cost
    nothing.
    """
    if node is None or id(node) in seen:
        return
    seen.add(id(node))
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            inner = (*keys, str(key.value))
            line = key.start_mark.line + 1
            if inner in lines:
                remedy = f"it was first written in line {lines[inner]}; keep one of them"
                raise InputError("a key is written twice", file=file, place=place(inner, line), remedy=remedy)
            lines[inner] = line
            _walk(value, inner, lines, seen, file)
    elif isinstance(node, yaml.SequenceNode):
        for index, item in enumerate(node.value):
            lines[(*keys, index)] = item.start_mark.line + 1
            _walk(item, (*keys, index), lines, seen, file)
