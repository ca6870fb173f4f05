"""Settings from and to YAML: files, `key=value` overrides, nested mappings."""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

from directshape_torch.config import RefinerConfig
from directshape_torch.errors import ConfigError

BUNDLED_CONFIGS = ("default", "paper", "fast")
"""Names of the settings that come with the package, for `load_config`."""

_CONFIG_FOLDER = Path(__file__).parent / "assets" / "configs"
_ConfigT = TypeVar("_ConfigT")


def config_from_mapping(cls: type[_ConfigT], mapping: Mapping[str, Any], where: str = "") -> _ConfigT:
    """A configuration dataclass from nested mappings; missing keys keep their defaults.

    Raises:
        ConfigError: an unknown key (naming the nearest one) or a value of the wrong kind.

    Example:
        >>> config_from_mapping(RefinerConfig, {"silhouette": {"weight": 6}}).silhouette.weight
        6.0
    """
    return _from_mapping(cls, mapping, where, _Root(cls, where))


class _Root(NamedTuple):
    """The whole configuration that a key is looked for in, and what stands before its keys."""

    cls: type[Any]
    where: str


def _from_mapping(cls: type[_ConfigT], mapping: Mapping[str, Any], where: str, root: _Root) -> _ConfigT:
    if not isinstance(mapping, Mapping):
        raise ConfigError(f"{where or 'configuration'}: expected keys and values, got {mapping!r}")
    hints = typing.get_type_hints(cls)
    for key in mapping:
        if key not in hints:
            nearest = _nearest_key(str(key), list(hints), where, root)
            raise ConfigError(f"unknown key {where}{key!s}; the nearest known one is {nearest}")
    return cls(**{key: _convert(hints[key], value, f"{where}{key}", root) for key, value in mapping.items()})


def _nearest_key(key: str, known: Sequence[str], where: str, root: _Root) -> str:
    """The nearest key of the same group, or one of another group whose own name is nearer still."""
    here = difflib.get_close_matches(key, known, n=1, cutoff=0.0)[0]
    paths = {f"{where}{here}": here} | {f"{root.where}{path}": path.split(".")[-1] for path in _leaves(root.cls)}
    # Of equally near ones the first, which is of the same group.
    return max(paths, key=lambda path: difflib.SequenceMatcher(None, paths[path], key).ratio())


def _leaves(cls: type[Any]) -> Iterator[str]:
    """Dotted paths of all settings of a configuration; those of a list's entries as if there were one entry."""
    for name, hint in typing.get_type_hints(cls).items():
        kinds = [kind for kind in (hint, *typing.get_args(hint)) if dataclasses.is_dataclass(kind)]
        if kinds:
            yield from (f"{name}.{leaf}" for leaf in _leaves(typing.cast(type[Any], kinds[0])))
        else:
            yield name


def _convert(hint: Any, value: Any, where: str, root: _Root) -> Any:
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return _from_mapping(hint, value, f"{where}.", root)
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is tuple:
        if isinstance(value, (str, Mapping)) or not isinstance(value, Sequence):
            raise ConfigError(f"{where}: expected a list, got {value!r}")
        kinds = [arguments[0]] * len(value) if arguments[-1] is Ellipsis else list(arguments)
        if len(kinds) != len(value):
            raise ConfigError(f"{where}: expected {len(kinds)} entries, got {value!r}")
        return tuple(
            _convert(kind, item, f"{where}[{i}]", root) for i, (kind, item) in enumerate(zip(kinds, value, strict=True))
        )
    if origin is Literal:
        if isinstance(value, bool) and {"on", "off"} <= set(arguments):
            # YAML 1.1 reads the words on and off as truth values.
            return "on" if value else "off"
        if value not in arguments:
            raise ConfigError(f"{where}: expected one of {', '.join(map(str, arguments))}, got {value!r}")
        return value
    return _convert_scalar(hint, value, where)


def _convert_scalar(hint: Any, value: Any, where: str) -> Any:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if hint is float and isinstance(value, str):
        # YAML 1.1 reads 1e7 (no point) as text.
        try:
            return float(value)
        except ValueError as error:
            raise ConfigError(f"{where}: expected a number, got {value!r}") from error
    if hint is float and is_number:
        return float(value)
    if hint is int and is_number and float(value).is_integer():
        return int(value)
    if hint in (bool, str) and isinstance(value, hint):
        return value
    name = hint.__name__ if isinstance(hint, (type, types.GenericAlias)) else str(hint)
    raise ConfigError(f"{where}: expected {name}, got {value!r}")


def load_config(path: Path | str | None = None, overrides: Sequence[str] = ()) -> RefinerConfig:
    """Read a YAML file and apply `key.sub=value` overrides (values in YAML).

    Args:
        path: the file, or the name of one that comes with the package: "default", "paper" or "fast". None for the
            defaults. A file of such a name in the working folder is "./paper".
        overrides: for example `["silhouette.weight=6", "solver.max_code=2.5"]`.

    Raises:
        ConfigError: unreadable file, unknown key, wrong kind of value.

    Example:
        >>> load_config(None, ["solver.max_code=2.5"]).solver.max_code
        2.5
        >>> load_config("paper").silhouette.form
        'product'
    """
    import yaml

    mapping: dict[str, Any] = {}
    if path is not None:
        try:
            mapping = yaml.safe_load(_config_file(path).read_text(encoding="utf-8")) or {}
        except (OSError, yaml.YAMLError) as error:
            names = f"bundled ones are {', '.join(BUNDLED_CONFIGS)}"
            raise ConfigError(f"{path}: cannot be read as a YAML configuration: {error}; {names}") from error
        if not isinstance(mapping, dict):
            raise ConfigError(f"{path}: expected keys and values, got {mapping!r}")
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals:
            raise ConfigError(f"--set {override}: expected key=value")
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise ConfigError(f"--set {override}: the value is not YAML") from error
        _set_nested(mapping, key.strip().split("."), value, override)
    return config_from_mapping(RefinerConfig, mapping)


def _config_file(path: Path | str) -> Path:
    return _CONFIG_FOLDER / f"{path}.yaml" if str(path) in BUNDLED_CONFIGS else Path(path)


def _set_nested(mapping: dict[str, Any], keys: Sequence[str], value: Any, override: str) -> None:
    for key in keys[:-1]:
        mapping = mapping.setdefault(key, {})
        if not isinstance(mapping, dict):
            raise ConfigError(f"--set {override}: {key} holds no keys of its own")
    mapping[keys[-1]] = value


def config_to_mapping(config: Any) -> Any:
    """Nested plain values of a configuration, for YAML, JSON and hashes.

    Example:
        >>> config_to_mapping(RefinerConfig())["stages"][0]["image_level"]
        1
    """
    if dataclasses.is_dataclass(config):
        return {f.name: config_to_mapping(getattr(config, f.name)) for f in dataclasses.fields(config)}
    if isinstance(config, tuple):
        return [config_to_mapping(item) for item in config]
    return config
