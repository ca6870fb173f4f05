"""This module converts settings from and to YAML files, `key=value` overrides and nested mappings."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import typing
from collections.abc import Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Literal, TypeVar

from directshape_torch.config import RefinerConfig, Settings
from directshape_torch.errors import ConfigError, shown
from directshape_torch.files.text_files import read_text

BUNDLED_CONFIGS = ("default", "paper", "fast", "geometric", "combined")
"""These are the names of the settings that come with the package, for `load_config`."""

# The YAML parser takes a second for ten thousand lines.
_MOST_BYTES = 2**20
_CONFIG_FOLDER = Path(__file__).parents[1] / "assets" / "configs"
# A misspelt name and the right one have a similarity above this, because they share most of their letters.
_ALIKE = 0.6
_KINDS = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}
_GroupT = TypeVar("_GroupT", bound=Settings)


def config_from_mapping(cls: type[_GroupT], mapping: Mapping[str, Any], where: str = "") -> _GroupT:
    """A group of settings from nested mappings; missing keys keep their defaults.

    Args:
        cls: class of the settings, such as `RefinerConfig`.
        mapping: keys and values, as they come from YAML or JSON.
        where: prefix of the keys in errors, such as "refiner.".

    Raises:
        ConfigError: a key is unknown (the error names the nearest one, or all keys of the group), or a value is of the
            wrong kind or out of range.

    Examples:
        >>> config_from_mapping(RefinerConfig, {"silhouette": {"weight": 6}}).silhouette.weight
        6.0
    """
    if not isinstance(mapping, Mapping):
        raise ConfigError(f"{where.rstrip('.') or 'configuration'}: expected keys and values, got {shown(mapping)}")
    hints = cls.types()
    for key in mapping:
        if key not in hints:
            raise ConfigError(f"unknown key {where}{key!s}; {_other_keys(str(key), where, list(hints))}")
    values = {key: _convert(hints[key], value, f"{where}{key}") for key, value in mapping.items()}
    try:
        return cls(**values)
    except ConfigError as error:
        raise ConfigError(f"{where}{error}") from error


def _other_keys(key: str, where: str, here: Sequence[str]) -> str:
    """Advice that names the key nearest to a misspelt one, or all keys of the group if none is near."""
    # Among equally near keys the first is taken, which belongs to the same group.
    names = {f"{where}{name}": name for name in here} | {path: path.split(".")[-1] for path in _leaves(RefinerConfig)}
    likeness = {path: difflib.SequenceMatcher(None, name, key).ratio() for path, name in names.items()}
    nearest = max(likeness, key=likeness.__getitem__)
    return f"the nearest known one is {nearest}" if likeness[nearest] > _ALIKE else f"known are {', '.join(here)}"


def _leaves(cls: type[Any]) -> Iterator[str]:
    """Dotted paths of all settings; a list counts as if it had one entry."""
    for name, hint in cls.types().items():
        kind = next((kind for kind in (hint, *typing.get_args(hint)) if _is_group(kind)), None)
        yield from [name] if kind is None else (f"{name}.{leaf}" for leaf in _leaves(kind))


def _is_group(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, Settings)


def _convert(hint: Any, value: Any, where: str) -> Any:
    """A value converted to the type of its setting; the group itself checks limits and words."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if _is_group(hint):
        return config_from_mapping(hint, value, f"{where}.")
    if origin is tuple:
        return tuple(_convert(*entry) for entry in _entries(arguments, value, where))
    if origin is Literal:
        # YAML 1.1 reads the words on and off as truth values.
        word = "on" if value else "off"
        return word if isinstance(value, bool) and word in arguments else value
    return _convert_scalar(hint, value, where)


def _entries(arguments: Sequence[Any], value: Any, where: str) -> list[tuple[Any, Any, str]]:
    """Type, value and name of each entry of a list."""
    if isinstance(value, (str, Mapping)) or not isinstance(value, Sequence):
        raise ConfigError(f"{where}: expected a list, got {shown(value)}")
    kinds = [arguments[0]] * len(value) if arguments[-1] is Ellipsis else list(arguments)
    if len(kinds) != len(value):
        raise ConfigError(f"{where}: expected {len(kinds)} entries, got {shown(value)}")
    return [(kind, item, f"{where}[{i}]") for i, (kind, item) in enumerate(zip(kinds, value, strict=True))]


def _convert_scalar(hint: type[Any], value: Any, where: str) -> Any:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if hint is float and isinstance(value, str):
        # YAML 1.1 reads 1e7 (without a point) as text.
        with contextlib.suppress(ValueError):
            return float(value)
    if hint is float and is_number:
        return float(value)
    if hint is int and is_number and float(value).is_integer():
        return int(value)
    if hint in (bool, str) and isinstance(value, hint):
        return value
    raise ConfigError(f"{where}: expected {_KINDS[hint]}, got {shown(value)}")


def load_config(path: Path | str | None = None, overrides: Sequence[str] = ()) -> RefinerConfig:
    """Read a YAML file and apply `key.sub=value` overrides (values in YAML).

    Args:
        path: the file, or the name of bundled settings (`BUNDLED_CONFIGS`). None gives the defaults. A file with such a
            name in the working folder is given as "./paper".
        overrides: for example `["silhouette.weight=6", "solver.max_code=2.5"]`.

    Raises:
        ConfigError: the file is unreadable, a key is unknown, or a value is of the wrong kind or out of range. The
            error names the file and the overrides.

    Examples:
        >>> load_config(None, ["solver.max_code=2.5"]).solver.max_code
        2.5
        >>> load_config("paper").silhouette.form
        'product'
    """
    if not isinstance(overrides, (list, tuple)) or not all(isinstance(each, str) for each in overrides):
        raise ConfigError(f"overrides: expected a list of 'key=value', got {shown(overrides)}")
    if not isinstance(path, (str, PathLike, type(None))):
        raise ConfigError(f"path: expected a file or a name, got {shown(path)}")
    mapping = {} if path is None else _read(path)
    for override in overrides:
        _override(mapping, override)
    sources = ([] if path is None else [str(path)]) + [f"--set {override}" for override in overrides]
    try:
        return config_from_mapping(RefinerConfig, mapping)
    except ConfigError as error:
        raise ConfigError(f"{' '.join(sources)}: {error}") from error


def _read(path: Path | str) -> dict[str, Any]:
    import yaml

    file = _CONFIG_FOLDER / f"{path}.yaml" if str(path) in BUNDLED_CONFIGS else Path(path)
    try:
        mapping = yaml.safe_load(read_text(file, _MOST_BYTES)) or {}
    # The parser raises many types of errors, for example for impossible dates and for deep nesting.
    except Exception as error:
        names = f"bundled ones are {', '.join(BUNDLED_CONFIGS)}"
        raise ConfigError(f"{path}: cannot be read as a YAML configuration: {error}; {names}") from error
    if not isinstance(mapping, dict):
        raise ConfigError(f"{path}: expected keys and values, got {shown(mapping)}")
    return mapping


def _override(mapping: dict[str, Any], override: str) -> None:
    """Apply `key.sub=value` to nested keys."""
    import yaml

    path, equals, text = override.partition("=")
    if not equals:
        raise ConfigError(f"--set {override}: expected key=value")
    *groups, key = path.strip().split(".")
    for group in groups:
        mapping = mapping.setdefault(group, {})
        if not isinstance(mapping, dict):
            raise ConfigError(f"--set {override}: {group} holds no keys of its own")
    try:
        mapping[key] = yaml.safe_load(text)
    except Exception as error:
        raise ConfigError(f"--set {override}: the value is not YAML") from error


def config_to_mapping(config: Any) -> Any:
    """Nested plain values of a configuration, for YAML, JSON and hashes.

    Examples:
        >>> config_to_mapping(RefinerConfig())["stages"][0]["image_level"]
        1
    """
    if dataclasses.is_dataclass(config):
        return {f.name: config_to_mapping(getattr(config, f.name)) for f in dataclasses.fields(config)}
    if isinstance(config, tuple):
        return [config_to_mapping(item) for item in config]
    return config
