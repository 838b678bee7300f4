"""How a command ends: the exit code, and the one line that is said with it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import typer
from rich.console import Console

from fingerjax.errors import InputError

NOT_CONVERGED, WRONG_INPUT, INTERRUPTED = 1, 2, 130


def say(line: str) -> None:
    """One line on stderr, whole however narrow the terminal is."""
    typer.echo(line, err=True)


def console() -> Console:
    """The terminal for progress: stderr, so that what is piped on stays clean."""
    return Console(stderr=True)


@contextmanager
def told() -> Iterator[None]:
    """Wrong input ends with one line and exit code 2; Ctrl-C with 130."""
    try:
        yield
    except InputError as error:
        say(f"fingerjax: {error}")
        raise typer.Exit(WRONG_INPUT) from None
    except KeyboardInterrupt:
        say("fingerjax: interrupted")
        raise typer.Exit(INTERRUPTED) from None
