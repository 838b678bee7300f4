"""Finds the effects: every file of this package, and of a laboratory's own folder, that defines one."""

from __future__ import annotations

import importlib.util
import inspect
import sys
from functools import cache
from pathlib import Path
from types import ModuleType

from ..errors import InputError
from ..spelling import choose_from
from .effect import ACTS_ON, Effect

HERE = Path(__file__).parent


def catalogue(folder: Path | str | None = None) -> tuple[Effect, ...]:
    """Every effect of fingerjax, then those in the files of `folder`, by the order of what they act on and their names.

    **Raises** `InputError` where a file of the folder cannot be read, defines no effect, or one whose name is taken.
    """
    found = list(_own())
    taken = {effect.name: "fingerjax" for effect in found}
    for file in sorted(Path(folder).glob("*.py")) if folder is not None else []:
        for effect in _of(_loaded(file)) or _none(file):
            if effect.name in taken:
                remedy = f"give it another name than that of {taken[effect.name]}"
                raise InputError("an effect of this name is there already", file=file, place=effect.name, remedy=remedy)
            _check(effect, file)
            taken[effect.name] = str(file)
            found.append(effect)
    return tuple(sorted(found, key=lambda effect: (ACTS_ON.index(effect.acts_on), effect.name)))


def chosen(names: str | tuple[str, ...], effects: tuple[Effect, ...]) -> tuple[Effect, ...]:
    """Those that a study asks for: `all`, `none`, or by name. **Raises** `InputError` naming the nearest for a name that is not there."""
    if isinstance(names, str):
        names = tuple(effect.name for effect in effects) if names == "all" else () if names == "none" else (names,)
    there = {effect.name: effect for effect in effects}
    for name in names:
        if name not in there:
            raise InputError("no such effect", place="diagnose: effects", seen=name, remedy=choose_from(name, there))
    return tuple(there[name] for name in there if name in names)


@cache
def _own() -> tuple[Effect, ...]:
    names = sorted(file.stem for file in HERE.glob("*.py") if file.stem != "__init__")
    modules = [importlib.import_module(f"{__package__}.{name}") for name in names]
    return tuple(effect for module in modules for effect in _of(module))


def _of(module: ModuleType) -> list[Effect]:
    """One of each effect that is defined in the module itself."""
    return [
        each()
        for _, each in inspect.getmembers(module, inspect.isclass)
        if issubclass(each, Effect) and each.__module__ == module.__name__ and hasattr(each, "name")
    ]


def _none(file: Path) -> list[Effect]:
    remedy = "define a class that derives from fingerjax.effects.Effect, or move the file elsewhere"
    raise InputError("the file defines no effect", file=file, remedy=remedy)


def _loaded(file: Path) -> ModuleType:
    name = f"fingerjax_effects_of_{abs(hash(str(file.resolve()))):x}_{file.stem}"
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever a laboratory's own code may raise
        raise InputError(f"the effect cannot be read: {error}", file=file, remedy="run the file by itself to see where it fails") from error
    return module


def _check(effect: Effect, file: Path) -> None:
    for attribute in ("acts_on", "leaves", "confused_with", "parameters"):
        if not hasattr(effect, attribute):
            remedy = f"write {attribute} = ... in the class, as the effects of fingerjax do"
            raise InputError(f"the effect does not say its {attribute}", file=file, place=effect.name, remedy=remedy)
    if effect.acts_on not in ACTS_ON:
        raise InputError(
            "no such record to act on", file=file, place=effect.name, seen=effect.acts_on, remedy=choose_from(effect.acts_on, ACTS_ON)
        )
    if effect.first_order and (len(effect.parameters) != 1 or effect.parameters[0].null != 0.0 or effect.grid):
        seen = ", ".join(size.name for size in effect.parameters)
        remedy = "give it one number that is 0 where it does nothing, or a method beside force"
        raise InputError("a force alone counts so many times that force", file=file, place=effect.name, seen=seen, remedy=remedy)
