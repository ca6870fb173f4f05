"""This module writes KITTI result files, and reads and writes states and shapes of frames (schema 5)."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError, InputError, shown
from directshape_torch.files import atomic_files
from directshape_torch.files.array_files import read_npz, write_npz
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.status import Status

SHAPES_SCHEMA_VERSION = 5
_AGAIN = "refine the frame again"

Floats = NDArray[np.floating[Any]]
# The kinds of arrays in a file are keyed by the type of the field.
_KINDS = {"str": "U", "tuple[str, ...]": "U", "Floats": "f", "NDArray[np.int64]": "i", "NDArray[np.bool_]": "b"}


# A refinement changes these columns of a result line, in this order: observation angle; height, width and length of the
# refined zero level along the object axes; its bottom centre in `ref`; heading about the y axis of `ref`. Units are
# metres and radians.
RefinedBox = Sequence[float]


def result_line(source: KittiObject, refined: RefinedBox) -> str:
    """The input line with its 3D box and alpha replaced; every other column keeps its text.

    Examples:
        >>> from directshape_torch.io.kitti_labels import parse_object
        >>> from directshape_torch.files.text_files import Line
        >>> raw = "Car -1 -1 0.1 5.25 6 70 80.5 1.5 1.6 3.9 1 1.6 20 0 0.930"
        >>> box = (-0.0363, 1.4, 1.7, 4.1, 1.1, 1.65, 19.5, 0.02)
        >>> result_line(parse_object("results", Line(1, raw, raw)), box)
        'Car -1 -1 -0.0363 5.25 6 70 80.5 1.4000 1.7000 4.1000 1.1000 1.6500 19.5000 0.0200 0.930'
    """
    words = source.raw_line.split()
    if not np.isfinite(refined).all():
        raise InputError("refined", "finite numbers", str(refined), "keep the input line of a car that failed")
    # Four decimals are 0.1 mm. Adding zero turns a negative zero into zero.
    alpha, *box_3d = (f"{round(float(number), 4) + 0.0:.4f}" for number in refined)
    line = " ".join([*words[:3], alpha, *words[4:8], *box_3d, *words[15:]])
    return line + ("\r" if source.raw_line.endswith("\r") else "")


def write_result_text(
    path: Path | str, input_objects: Sequence[KittiObject], refined: Mapping[int, RefinedBox]
) -> None:
    """Write a KITTI result file with one line for each input line, in order; lines not refined stay unchanged."""
    unknown = sorted(set(refined) - set(range(len(input_objects))))
    if unknown:
        raise InputError("refined", f"indices of the {len(input_objects)} input lines", str(unknown))
    lines = (
        result_line(source, refined[index]) if index in refined else source.raw_line
        for index, source in enumerate(input_objects)
    )
    atomic_files.write_text(path, "".join(f"{line}\n" for line in lines))


def shaped(*sizes: str | int) -> dict[str, tuple[str | int, ...]]:
    """Metadata of a field: its sizes, with letters as in the description of the class, which checks them."""
    return {"shape": sizes}


@dataclass(frozen=True)
class ShapeArrays:
    """A `ShapeArrays` is `OUT/shapes/NNNNNN.npz` for B refined lines; K codes, D = 6 + K, T terms, P offsets."""

    frame_id: str
    prior_sha256: str  # of the shape prior of the codes
    ground_source: str  # "file", "stereo" or "camera_height"
    input_lines: NDArray[np.int64] = field(metadata=shaped("B"))  # line numbers in the detection file, from 1
    # Name of the track of each car, "" for none.
    tracks: tuple[str, ...] = field(metadata=shaped("B"))
    # 0 for views that share a shape, 1, 2 .. for the parts of a track that was split, -1 for none.
    track_parts: NDArray[np.int64] = field(metadata=shaped("B"))
    # Object to left camera, and object to the frame of the labels.
    T_cam_obj: Floats = field(metadata=shaped("B", 4, 4))
    T_ref_obj: Floats = field(metadata=shaped("B", 4, 4))
    boxes_hwl: Floats = field(metadata=shaped("B", 3))  # metres
    boxes_location_ref: Floats = field(metadata=shaped("B", 3))  # bottom centres, metres
    boxes_rotation_y: Floats = field(metadata=shaped("B"))  # radians
    codes: Floats = field(metadata=shaped("B", "K"))  # standard deviations
    # In the tangent (v, omega, code) of the solver; NaN if there is none.
    covariances: Floats = field(metadata=shaped("B", "D", "D"))
    covariances_ref: Floats = field(metadata=shaped("B", 4, 4))  # of (x, y, z, yaw) in `ref`, metres and radians
    statuses: tuple[str, ...] = field(metadata=shaped("B"))
    messages: tuple[str, ...] = field(metadata=shaped("B"))
    term_names: tuple[str, ...]  # (T,) text
    # Cost of each term.
    costs_before: Floats = field(metadata=shaped("B", "T"))
    costs_after: Floats = field(metadata=shaped("B", "T"))
    iterations: NDArray[np.int64] = field(metadata=shaped("B"))
    has_mask_left: NDArray[np.bool_] = field(metadata=shaped("B"))  # whether a mask of the left image was matched
    # IoU of the projected shape and its masks; NaN if not refined.
    mask_iou_left: Floats = field(metadata=shaped("B"))
    mask_iou_right: Floats = field(metadata=shaped("B"))
    # Mean absolute difference of the images, in grey levels of 0..255.
    photometric_errors_grey: Floats = field(metadata=shaped("B"))
    matched_shares: Floats = field(metadata=shaped("B"))  # share of the photometric pixels that could be compared
    # Calibrated probabilities, see `FitQuality`.
    probabilities_better: Floats = field(metadata=shaped("B"))
    probabilities_not_worse: Floats = field(metadata=shaped("B"))
    probabilities_heading: Floats = field(metadata=shaped("B"))
    # Distance between the boxes of images and detector, in standard deviations of both; NaN if these are not known.
    distances_in_sigmas: Floats = field(metadata=shaped("B"))
    # Calibrated standard deviations of (x, y, z, yaw) in `ref`, metres and radians.
    sigmas_ref: Floats = field(metadata=shaped("B", 4))
    unseen: tuple[str, ...] = field(metadata=shaped("B"))  # text, the direction that the view shows least
    # Standard deviations along the principal directions, in descending order, without priors.
    unseen_sigmas_m: Floats = field(metadata=shaped("B", 7))
    # The principal directions as rows; columns are `observability.CAR_QUANTITIES`.
    unseen_directions: Floats = field(metadata=shaped("B", 7, 7))
    profile_offsets_px: Floats = field(metadata=shaped("P"))  # offsets of disparity
    # Photometric costs at the offsets, see `DisparityProfile`.
    profile_costs_before: Floats = field(metadata=shaped("B", "P"))
    profile_costs_after: Floats = field(metadata=shaped("B", "P"))
    made_of: str = ""  # `FrameRecord` as JSON, by which a run recognises its files; "" outside a run

    def __post_init__(self) -> None:
        last = {"B": self.input_lines.shape, "K": self.codes.shape, "P": self.profile_offsets_px.shape}
        sizes = {letter: shape[-1] if shape else 0 for letter, shape in last.items()}
        sizes |= {"D": 6 + sizes["K"], "T": len(self.term_names)}
        for entry in fields(self):
            shape = tuple(sizes.get(str(size), size) for size in entry.metadata.get("shape", ()))
            got = np.shape(getattr(self, entry.name))
            if shape and got != shape:
                raise InputError(entry.name, f"shape {shape}", f"{got}")


def write_shapes(path: Path | str, shapes: ShapeArrays) -> None:
    """Write the states and shapes of a frame with a checksum; equal content gives equal bytes, without pickle."""
    arrays: dict[str, NDArray[Any]] = {"schema_version": np.array(SHAPES_SCHEMA_VERSION)}
    for name, value in vars(shapes).items():
        arrays[name] = np.array(value, dtype=np.str_) if isinstance(value, (str, tuple)) else np.asarray(value)
    write_npz(path, {**arrays, "sha256": np.array(_hash_arrays(arrays))})


def read_shapes(path: Path | str) -> ShapeArrays:
    """Read a file of `write_shapes`."""
    arrays = read_npz(path, cure=_AGAIN)
    sha256 = arrays.pop("sha256", None)
    is_whole = sha256 is not None and sha256.tolist() == _hash_arrays(arrays)
    version = arrays.pop("schema_version", None)
    if version is None or version.tolist() != SHAPES_SCHEMA_VERSION:
        found = shown(None if version is None else version.tolist())
        problem = f"has shape schema {found}, this version reads {SHAPES_SCHEMA_VERSION}"
        raise DataFormatError(path, problem, cure=_AGAIN)
    if not is_whole:
        raise DataFormatError(path, "has been changed since it was written", cure=_AGAIN)
    kinds = {entry.name: _KINDS[str(entry.type)] for entry in fields(ShapeArrays)}
    if set(arrays) != set(kinds):
        raise DataFormatError(path, f"has the fields {sorted(arrays)}, expected {sorted(kinds)}", cure=_AGAIN)
    for name, letter in kinds.items():
        if arrays[name].dtype.kind != letter:
            raise DataFormatError(path, f"{name} holds {arrays[name].dtype}, expected kind {letter!r}", cure=_AGAIN)
    try:
        shapes = ShapeArrays(**{name: _from_text(array) for name, array in arrays.items()})
    except InputError as error:
        raise DataFormatError(path, str(error), cure=_AGAIN) from error
    if unknown := set(shapes.statuses) - set(Status.__members__):
        raise DataFormatError(path, f"statuses hold {shown(min(unknown))}", cure=_AGAIN)
    return shapes


def _hash_arrays(arrays: Mapping[str, NDArray[Any]]) -> str:
    """The sha256 of the names, types, shapes and values of arrays."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"{name} {array.dtype.str} {array.shape} ".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _from_text(array: NDArray[Any]) -> Any:
    if array.dtype.kind != "U":
        return array
    return str(array) if array.ndim == 0 else tuple(array.tolist())


def track_name(sequence: str, track_id: int) -> str:
    """The name of a track in file names, "" for a car without a track.

    Examples:
        >>> track_name("", 7), track_name("0005", 31), track_name("0005", -1)
        ('000007', '0005_000031', '')
    """
    if track_id < 0:
        return ""
    return f"{sequence}_{track_id:06d}" if sequence else f"{track_id:06d}"
