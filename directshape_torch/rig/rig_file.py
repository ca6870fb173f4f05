"""`rig.json`: the estimates of the rigs of a run, and the evidence they rest on (schema 1).

{"schema": "directshape rig", "schema_version": 1,
 "rigs": [{"size_wh": .., "K_left": .., "K_right": .., "T_right_cam": ..,   of which images
           "rows": [[u, v, ..], ..],        one a detection, `rig.detections.COLUMNS`
           "pixels": {"lidar": {..}, ..},   sums over pixels of known depth, by kind
           "says": "rig: -0.44 +- 0.06 px .."}, ..]}
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.files.atomic_files import write_json
from directshape_torch.files.read_files import read_json
from directshape_torch.geometry.disparity_field import NUM_COEFFICIENTS, DisparityField
from directshape_torch.rig.detections import COLUMNS
from directshape_torch.rig.estimate import RigEstimate
from directshape_torch.rig.field_file import load_field
from directshape_torch.rig.pixels import PixelEvidence

# In the folder of a run.
RIG_FILE, RIG_PICTURE = "rig.json", "rig.png"
SCHEMA, SCHEMA_VERSION = "directshape rig", 1
_CURE = "make it again with 'directshape calibrate-rig'"
_SQUARE, _LONG = (NUM_COEFFICIENTS, NUM_COEFFICIENTS), (NUM_COEFFICIENTS,)
_OF_PIXELS = {
    "information": _SQUARE,
    "vector": _LONG,
    "row_information": _SQUARE,
    "row_vector": _LONG,
    "hull_uv": (None, 2),
}


def save_rigs(path: Path | str, rigs: Sequence[RigEstimate]) -> None:
    """Write the estimates of one or several rigs."""
    entries = [{**_plain(rig.content()), "says": str(rig)} for rig in rigs]
    write_json(path, {"schema": SCHEMA, "schema_version": SCHEMA_VERSION, "rigs": entries})


def load_rigs(path: Path | str) -> list[RigEstimate]:
    """The estimates in a file.

    Raises:
        DataFormatError: it is missing, damaged, or holds no estimates.
    """
    content = _read(path)
    if content.get("schema") != SCHEMA or content.get("schema_version") != SCHEMA_VERSION:
        raise DataFormatError(path, f"is no file of rigs (schema {SCHEMA!r}, version {SCHEMA_VERSION})", cure=_CURE)
    try:
        return [_rig(entry) for entry in content["rigs"]]
    except (AttributeError, KeyError, TypeError, ValueError, IndexError, InputError) as error:
        raise DataFormatError(path, f"is damaged ({error!r})", cure=_CURE) from error


def load_fields(path: Path | str) -> tuple[DisparityField, ...]:
    """The disparity fields of a file of rigs, or the one of a field file of earlier versions.

    Raises:
        DataFormatError: it is missing, damaged or neither of the two.
    """
    return tuple(rig.field for rig in load_rigs(path)) if holds_rigs(path) else (load_field(path),)


def holds_rigs(path: Path | str) -> bool:
    """Whether a JSON file is one of estimates, and not a field file of earlier versions.

    Raises:
        DataFormatError: it is missing or damaged.
    """
    return _read(path).get("schema") == SCHEMA


def _rig(entry: Mapping[str, Any]) -> RigEstimate:
    width, height = (int(n) for n in entry["size_wh"])
    matrices = (_tensor(entry, name, (n, n)) for name, n in (("K_left", 3), ("K_right", 3), ("T_right_cam", 4)))
    rig = RigEstimate((width, height), *matrices)
    rig.add_rows(_tensor(entry, "rows", (None, len(COLUMNS))))
    for kind, sums in entry["pixels"].items():
        tensors = {name: _tensor(sums, name, shape) for name, shape in _OF_PIXELS.items()}
        rig.add_pixels(kind, PixelEvidence(int(sums["num_points"]), int(sums["num_frames"]), **tensors))
    return rig


def _tensor(entry: Mapping[str, Any], name: str, shape: tuple[int | None, ...]) -> Tensor:
    tensor = torch.tensor(entry[name], dtype=torch.float64)
    if not tensor.numel() and None in shape:  # JSON has no rows of nothing
        tensor = tensor.reshape([n or 0 for n in shape])
    fits = tensor.ndim == len(shape) and all(n is None or n == m for n, m in zip(shape, tensor.shape, strict=True))
    if not fits or not bool(tensor.isfinite().all()):
        raise ValueError(f"{name!r} must be finite numbers of shape {shape}")
    return tensor


def _plain(value: Any) -> Any:
    """Tensors as nested lists."""
    if isinstance(value, Mapping):
        return {name: _plain(part) for name, part in value.items()}
    return value.tolist() if isinstance(value, Tensor) else value


def _read(path: Path | str) -> dict[str, Any]:
    content = read_json(path, _CURE)
    if not isinstance(content, dict):
        raise DataFormatError(path, "is no JSON object", cure=_CURE)
    return content
