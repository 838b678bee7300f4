"""Records that people write by hand: an unknown key is an error that names the nearest allowed one."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from .errors import InputError
from .spelling import choose_from
from .yamlfile import Keys, Origin, said_in_python


def _no_truth_value(value: Any) -> Any:
    if isinstance(value, bool):
        raise InputError("not a number", seen=value, remedy="write a number")
    return value


Number = Annotated[float, BeforeValidator(_no_truth_value)]
Positive = Annotated[Number, Field(gt=0)]
NotNegative = Annotated[Number, Field(ge=0)]


class Strict(BaseModel):
    """A frozen record with known keys only; numbers are finite, numbers serve where text is wanted."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, coerce_numbers_to_str=True)

    @model_validator(mode="before")
    @classmethod
    def _only_known_keys(cls, data: Any) -> Any:
        allowed = [field.alias or name for name, field in cls.model_fields.items()]
        if not isinstance(data, Mapping):
            remedy = f"write keys and values; allowed: {', '.join(allowed)}"
            raise InputError("keys and values are needed here", seen=data, remedy=remedy)
        for key in data:
            if key not in allowed:
                raise InputError("unknown key", place=str(key), remedy=choose_from(key, allowed))
        return data


Record = TypeVar("Record", bound=Strict)


def checked(record: type[Record], data: Any, origin: Origin = said_in_python, *keys: str | int) -> Record:
    """Make a record of what was written.

    **Arguments:** the kind of record; what was written; where that was, as an `Origin` and the keys that
    lead to it.

    **Raises** `InputError` for the first thing wrong, with file, line and keys.
    """
    try:
        return record.model_validate(data)
    except ValidationError as wrong:
        raise _refusal(wrong, origin, keys) from None


def _refusal(wrong: ValidationError, origin: Origin, keys: Keys) -> InputError:
    first = wrong.errors()[0]
    inner: Keys = (*keys, *first["loc"])
    cause = first.get("ctx", {}).get("error")
    if not isinstance(cause, InputError):
        cause = _in_our_words(first)
    if cause.place:
        inner = (*inner, cause.place)
    file, where = origin(inner)
    return InputError(cause.problem, file=file, place=where, seen=cause.seen, remedy=cause.remedy)


def _in_our_words(first: Any) -> InputError:
    kind, seen = first["type"], first["input"]
    if kind == "missing":
        return InputError("this key is missing", remedy=f"write {first['loc'][-1]}: and its value")
    if kind == "literal_error":
        allowed = re.findall(r"'([^']*)'", first["ctx"]["expected"])
        return InputError("not one of the allowed words", seen=seen, remedy=choose_from(seen, allowed))
    message = str(first["msg"]).replace("Input should be", "should be")
    return InputError(message[0].lower() + message[1:], seen=seen, remedy="correct the value")
