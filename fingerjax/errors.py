"""The one exception for wrong input: it names the file, the place in it, what was seen, and the remedy."""

from __future__ import annotations

import os


class InputError(ValueError):
    """Something that a person handed in cannot be used.

    **Arguments:**

    - `problem`: one clause saying what is wrong.
    - `file`: the file it was read from.
    - `place`: where in it: a row, a column, a key.
    - `seen`: the value found there.
    - `remedy`: what to write instead.

    The message is a single line, fit for a terminal; the command line prints it and ends with exit code 2.
    """

    def __init__(
        self,
        problem: str,
        *,
        file: str | os.PathLike[str] | None = None,
        place: str | None = None,
        seen: object = None,
        remedy: str | None = None,
    ):
        self.problem, self.file, self.place, self.seen, self.remedy = problem, file, place, seen, remedy
        where = ", ".join(part for part in (str(file) if file is not None else "", place or "") if part)
        line = f"{where}: {problem}" if where else problem
        if seen is not None:
            line += f" (found {seen!r})"
        if remedy is not None:
            line += f"; {remedy}"
        super().__init__(" ".join(line.split()))
