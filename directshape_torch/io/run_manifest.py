"""This module reads and writes `summary.json` of a run (schema 3), so that a run can resume.

The file says how the results were made, and of which frames. Its content does not depend on time, machine or paths.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

import torch
from torch import Tensor

from directshape_torch.errors import DataFormatError, ResumeError, shown
from directshape_torch.files import atomic_files
from directshape_torch.files.find_files import is_frame_id, remembered
from directshape_torch.files.read_files import read_bytes, read_json
from directshape_torch.files.schema import check_type, record_of
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.shape.shape_prior import ShapePrior

MANIFEST_SCHEMA_VERSION = 3
RESUME_CURE = "choose another output folder, or start again with --fresh, which removes the results in this one"
# Without a valid summary it is unknown which files are results, so --fresh removes none.
UNKNOWN_CURE = "choose another output folder, or remove this one"


class RunSettings(TypedDict, total=False):
    """A `RunSettings` has the settings of `config` that other modules than the refiner read."""

    classes: list[str]
    refiner: dict[str, Any]


class SharedHashes(TypedDict):
    """A `SharedHashes` has the sha256 of the shape prior and, if there are any, of the bias maps."""

    prior: str
    stereo_bias: str | None


@dataclass(frozen=True)
class RunManifest:
    """A `RunManifest` says how the results of a folder are made, and of which frames."""

    package_version: str  # of this package
    config: Mapping[str, Any]  # every setting that affects the results, nested as in the configuration file
    sha256: SharedHashes  # hashes of the files that all frames use
    frames: Sequence[str] = ()  # of all runs into the folder, in order

    @property
    def hash(self) -> str:
        """Hash of all fields except the frames; the files of a frame contain it."""
        made_of = [self.package_version, self.config, self.sha256]
        return hash_bytes(json.dumps(made_of, sort_keys=True, default=list).encode())


def hash_bytes(content: bytes) -> str:
    """The sha256 of some bytes, hexadecimal.

    Examples:
        >>> hash_bytes(b"")[:8]
        'e3b0c442'
    """
    return hashlib.sha256(content).hexdigest()


@remembered
def hash_file(path: Path) -> str:
    """The sha256 of a file, hexadecimal; it is cached, since mask files of a whole data set serve every frame."""
    return hash_bytes(read_bytes(path))


def hash_files(files: Mapping[str, Path]) -> dict[str, str]:
    """The sha256 of several files by their role, such as `StereoDataset.input_files` gives."""
    return {role: hash_file(path) for role, path in files.items()}


def hash_tensors(tensors: Mapping[str, Tensor]) -> str:
    """The sha256 (hexadecimal) of named tensors: name, shape and values as float64, little-endian, in order of name.

    The hash does not depend on a file's name or compression.

    Examples:
        >>> hash_tensors({"a": torch.zeros(2)}) == hash_tensors({"a": torch.zeros(2, dtype=torch.float64)})
        True
    """
    digest = hashlib.sha256()
    for name in sorted(tensors):
        values = tensors[name].detach().to("cpu", torch.float64).contiguous().numpy()
        digest.update(json.dumps([name, list(values.shape)]).encode())
        digest.update(values.astype("<f8", copy=False).tobytes())
    return digest.hexdigest()


def hash_prior(prior: ShapePrior) -> str:
    """The sha256 of the buffers, weights and bounds of a shape prior."""
    tensors = {**dict(prior.named_buffers()), **dict(prior.named_parameters())}
    return hash_tensors({"bounds_obj": prior.bounds_obj, **tensors})


def hash_fields(fields: Sequence[DisparityField]) -> str | None:
    """The sha256 of residual disparity fields, or None without any; one field has the hash of its tensors."""
    hashes = []
    for one in fields:
        tensors = {name: value for name, value in vars(one).items() if isinstance(value, Tensor)}
        hashes.append(hash_tensors({"size_wh": torch.tensor(one.size_wh), **tensors}))
    if len(hashes) < 2:
        return hashes[0] if hashes else None
    return hashlib.sha256("".join(hashes).encode()).hexdigest()


def write_manifest(path: Path | str, manifest: RunManifest) -> None:
    """Write `summary.json` and wait for the disk, since results cannot be resumed or read without it."""
    atomic_files.write_json(path, {"schema_version": MANIFEST_SCHEMA_VERSION, **vars(manifest)}, durable=True)


def read_manifest(path: Path | str) -> RunManifest | None:
    """The manifest of an earlier run, or None if there is no such file.

    Raises:
        DataFormatError: the file is not a manifest.
        ResumeError: the file has another schema version.
    """
    if not Path(path).is_file():
        return None
    content = read_json(path, UNKNOWN_CURE)
    if not isinstance(content, dict) or "schema_version" not in content:
        raise DataFormatError(path, "is no summary of a run", cure=UNKNOWN_CURE)
    version = content.pop("schema_version")
    if version != MANIFEST_SCHEMA_VERSION:
        said = f"{path}: schema version is {shown(version)}, this program writes {MANIFEST_SCHEMA_VERSION}"
        raise ResumeError(f"{said}; {UNKNOWN_CURE}")
    manifest = record_of(path, RunManifest, content, UNKNOWN_CURE)
    check_type(path, "config", manifest.config, RunSettings, UNKNOWN_CURE)
    for frame_id in manifest.frames:
        if not is_frame_id(frame_id):
            raise DataFormatError(path, f"frames[{shown(frame_id)}]: no name of a frame", cure=UNKNOWN_CURE)
    return manifest


def check_resume(previous: RunManifest, current: RunManifest) -> None:
    """Refuse to mix results of different settings or files in one folder.

    Raises:
        ResumeError: a setting or file differs; the error names the first one with both values.
    """
    _check_same("package version", previous.package_version, current.package_version)
    check_mapping("setting", flatten(previous.config), flatten(current.config))
    check_mapping("sha256 of", previous.sha256, current.sha256)


def flatten(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as one level with dotted names.

    Examples:
        >>> flatten({"solver": {"iterations": 20}, "device": "cpu"})
        {'solver.iterations': 20, 'device': 'cpu'}
    """
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        key = f"{prefix}{name}"
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{key}.")
        else:
            # JSON has no tuples, so values are compared as lists.
            flat[key] = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else value
    return flat


def check_mapping(what: str, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise `ResumeError` at the first name whose values differ, with both of them."""
    for name in sorted({*before, *now}):
        _check_same(f"{what} {name!r}", before.get(name, "absent"), now.get(name, "absent"))


def _check_same(what: str, before: Any, now: Any) -> None:
    if before != now:
        raise ResumeError(f"cannot resume: {what} was {_short(before)}, now is {_short(now)}; {RESUME_CURE}")


def _short(value: Any) -> str:
    """The first twelve letters of a hash, which distinguish two files, or the full text of a setting."""
    is_hash = isinstance(value, str) and len(value) == hashlib.sha256().digest_size * 2
    return value[:12] if is_hash else repr(value)
