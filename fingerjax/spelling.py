"""The nearest allowed word for one that is not allowed, so that a refusal says what was probably meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def nearest(word: object, allowed: Iterable[str]) -> str | None:
    """The allowed word most like `word`; None where nothing is allowed."""
    options = list(allowed)
    folded = {option.lower(): option for option in reversed(options)}
    found = difflib.get_close_matches(str(word).lower(), list(folded), n=1, cutoff=0.0)
    return folded[found[0]] if found else None


def choose_from(word: object, allowed: Iterable[str]) -> str:
    """A remedy: the nearest allowed word first, then all of them, as text for `InputError(remedy=...)`."""
    options = list(allowed)
    if not options:
        return "nothing is allowed here"
    return f"did you mean {nearest(word, options)!r}? Allowed: {', '.join(options)}"
