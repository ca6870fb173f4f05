"""This module checks whether JSON content has the types of a dataclass or another type hint."""

from __future__ import annotations

import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, Literal, TypeVar

from directshape_torch.errors import DataFormatError, shown

_RecordT = TypeVar("_RecordT")


def record_of(path: Path | str, cls: type[_RecordT], content: Any, cure: str = "", where: str = "") -> _RecordT:
    """A dataclass of plain values, lists and mappings from a JSON object that holds its fields.

    Args:
        path, cure: parts of the message.
        cls: the dataclass.
        content: the object.
        where: place in the file, before the name of a field, such as "objects[0].".

    Examples:
        >>> from dataclasses import make_dataclass
        >>> Event = make_dataclass("Event", [("frame", str), ("at", float)])
        >>> record_of("a.json", Event, {"frame": "000107", "at": 0.5}).frame
        '000107'
        >>> record_of("a.json", Event, {"frame": 107, "at": 0.5})
        Traceback (most recent call last):
        ...
        directshape_torch.errors.DataFormatError: a.json: frame: expected str, got 107
    """
    if not isinstance(content, dict):
        raise DataFormatError(path, f"{where.rstrip('.')} expected an object, got {shown(content)}".strip(), cure=cure)
    known = {each.name: each for each in fields(cls)}  # type: ignore[arg-type]
    needed = {name for name, each in known.items() if each.default is MISSING and each.default_factory is MISSING}
    for wrong in sorted({*content} - {*known}) + sorted(needed - {*content}):
        said = "missing" if wrong in needed else "unknown"
        raise DataFormatError(path, f"{where}{shown(wrong)} is {said}", cure=cure)
    hints = typing.get_type_hints(cls)
    for name, value in content.items():
        check_type(path, f"{where}{name}", value, hints[name], cure)
    return cls(**content)


def check_type(path: Path | str, where: str, value: Any, hint: Any, cure: str = "") -> None:
    """Raise `DataFormatError` if a value, or one within it, does not have its type."""
    for place, wrong, expected in _misfits(where, value, hint):
        raise DataFormatError(path, f"{place}: expected {_words(expected)}, got {shown(wrong)}", cure=cure)


def _words(hint: Any) -> str:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(map(_words, arguments))
    if origin is tuple:
        return f"a list of {len(arguments)}"
    if origin in (list, Sequence):
        return "a list"
    if typing.is_typeddict(hint):
        return f"an object with {' and '.join(map(repr, sorted(hint.__required_keys__)))}".removesuffix(" with ")
    return "nothing" if hint is type(None) else hint.__name__ if isinstance(hint, type) else str(hint)


def _misfits(where: str, value: Any, hint: Any) -> Iterator[tuple[str, Any, Any]]:
    """Place, value and expected type of every value that does not fit."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return
    if origin in (typing.Union, types.UnionType):
        fits = any(not any(_misfits(where, value, each)) for each in arguments)
    elif origin is Literal:
        fits = isinstance(value, str) and value in arguments
    elif origin in (dict, Mapping):
        fits = isinstance(value, dict)
        for key, item in value.items() if fits else ():
            yield from _misfits(f"{where}[{shown(key)}]", item, arguments[1])
    elif origin in (list, Sequence):
        fits = isinstance(value, list)
        for index, item in enumerate(value if fits else ()):
            yield from _misfits(f"{where}[{index}]", item, arguments[0])
    elif origin is tuple:
        fits = isinstance(value, list) and len(value) == len(arguments)
        for index, item in enumerate(value if fits else ()):
            yield from _misfits(f"{where}[{index}]", item, arguments[index])
    elif typing.is_typeddict(hint):
        fits = isinstance(value, dict) and hint.__required_keys__ <= value.keys()
        hints = typing.get_type_hints(hint)
        for key in hints.keys() & value.keys() if fits else ():
            yield from _misfits(f"{where}[{key!r}]", value[key], hints[key])
    else:
        wanted = (int, float) if hint is float else hint
        fits = isinstance(value, wanted) and (hint is bool or not isinstance(value, bool))
    if not fits:
        yield where, value, hint
