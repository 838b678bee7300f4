"""`fingerjax effects`: what a diagnosis may name."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from fingerjax.commands._ending import told
from fingerjax.errors import InputError
from fingerjax.spelling import choose_from

SIDES = {1: "only above", -1: "only below", 0: "either way"}


def effects(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="Only this effect, with all that is known of it.")] = None,
    effects_folder: Annotated[Path | None, typer.Option(help="Folder with effects of your own, one file each.")] = None,
) -> None:
    """List the effects that a diagnosis may name: what they act on, their numbers, what they leave in a residual, what looks like them.

    \b
    Example:
      fingerjax effects                          all of them
      fingerjax effects nail_compliance          one, with its numbers
      fingerjax effects --effects-folder mine    yours beside ours

    Exit code 0; 2: wrong input.
    """
    with told():
        from fingerjax.effects import catalogue

        if effects_folder is not None and not effects_folder.is_dir():
            remedy = "name the folder that holds your effects"
            raise InputError("no such folder", place="--effects-folder", seen=str(effects_folder), remedy=remedy)
        known = {one.name: one for one in catalogue(effects_folder)}
        if name is not None and name not in known:
            raise InputError("no such effect", place="NAME", seen=name, remedy=choose_from(name, known))
        screen = Console()
        if name is None:
            screen.print(listing(list(known.values())))
        else:
            _explain(screen, known[name])


def listing(found: list[Any]) -> Table:
    """One row an effect."""
    table = Table(title=f"{len(found)} effects", title_justify="left", show_lines=True, caption="fingerjax effects NAME tells more of one")
    for heading in ("effect", "acts on", "numbers: plausible size (limits)", "leaves behind", "looks like"):
        table.add_column(heading, overflow="fold")
    for one in found:
        sizes = "\n".join(f"{size.name}: {_size(size)}" for size in one.parameters)
        table.add_row(*(escape(text) for text in (one.name, one.acts_on, sizes, _joined(one.leaves), _joined(one.confused_with))))
    return table


def _explain(screen: Console, one: Any) -> None:
    screen.print(f"{one.name}: acts on {one.acts_on}", highlight=False, markup=False)
    screen.print(f"leaves behind: {_joined(one.leaves)}", highlight=False, markup=False)
    screen.print(f"looks like: {_joined(one.confused_with)}", highlight=False, markup=False)
    table = Table(title="numbers", title_justify="left")
    for heading in ("number", "unit", "changes nothing at", "plausible size", "from", "to", "which way"):
        table.add_column(heading)
    for size in one.parameters:
        ends = (_number(size.null), _number(size.scale), _number(size.lower), _number(size.upper))
        table.add_row(escape(size.name), escape(size.unit), *ends, SIDES.get(size.sign, str(size.sign)))
    screen.print(table)


def _size(size: Any) -> str:
    unit = "" if size.unit == "1" else f" {size.unit}"
    null = "" if size.null == 0 else f", nothing at {_number(size.null)}"
    return f"{_number(size.scale)}{unit} ({_number(size.lower)} to {_number(size.upper)}{null})"


def _number(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else "any"


def _joined(said: Any) -> str:
    """A sentence on one line; several names with commas between them."""
    return " ".join(str(said).split()) if isinstance(said, str) else ", ".join(map(str, said))
