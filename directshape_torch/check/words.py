"""This module has the terms for boxes, masks and calibration in each source of data: tensors and files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from directshape_torch.geometry.box_formats import BoxForm, BoxFormat, box_form


class Says(NamedTuple):
    """A `Says` has the expectation and the cure of a mistake, with fields in braces for `str.format`."""

    expected: str
    cure: str


@dataclass(frozen=True)
class Words:
    """A `Words` has the terms of one source of data.

    Attributes:
        form: form of the boxes.
        says: expectation and cure of the mistakes whose cure depends on the source.
        calibration_file, detection_file: content of such a file, in words; "" for tensors.
    """

    form: BoxForm
    says: Mapping[str, Says]
    calibration_file: str = ""
    detection_file: str = ""


_KITTI_FORM = box_form("kitti")
_FOLDER_FORM = replace(
    _KITTI_FORM,
    heading=f"rotation_y_rad{_KITTI_FORM.heading.removeprefix('rotation_y')}",
)


def words_of_tensors(convention: BoxFormat) -> Words:
    """The terms for tensors whose boxes were written in a convention."""
    form = box_form(convention)
    says = {
        **_of_boxes(form),
        "baseline_length": Says(
            "{low} to {high} m",
            "give it in metres: baseline_m of StereoCamera.from_intrinsics; of projections P_right[0, 3] is -fx times "
            "the baseline",
        ),
        "box_units": Says("{low} to {high} m", "give metres; leave out what is no car, such as buses"),
        "no_masks": Says(
            "masks of the left images, better of both",
            "give mask_left, with masks that are not empty, in the order of the boxes",
        ),
    }
    return Words(form, says)


_UNITS_IN_FILES = Says("{low} to {high} m", "write metres (for larger vehicles use --classes)")


def words_of_files(calibration: Path, names: tuple[str, str] = ("P2", "P3")) -> Words:
    """The terms for a data set, given its calibration file and the names of the two cameras in it."""
    return _words_of_folder() if calibration.suffix.lower() == ".json" else _words_of_kitti(*names)


def _words_of_kitti(left: str, right: str) -> Words:
    says = {
        **_of_boxes(_KITTI_FORM),
        "box_units": _UNITS_IN_FILES,
        "baseline_sign": Says(
            f"a positive baseline: {right}[0, 3] / fx below {left}[0, 3] / fx",
            f"swap {left} and {right}, or flip the sign of the fourth columns",
        ),
        "baseline_length": Says(
            "{low} to {high} m",
            f"give it in metres; the fourth column of {right} is -fx times the baseline, not the baseline",
        ),
        "no_masks": Says(
            "masks of the left images, better of both",
            "check the side ('image') and the class (category_id 3, or 1 and 26 in PNG) of the masks",
        ),
        "no_cars": Says(
            "lines of class Car (or --classes) with positive h w l and a location",
            "check names of classes and the folder of detections",
        ),
    }
    return Words(
        _KITTI_FORM, says, f"{left} and {right}, 12 finite numbers each", "lines of 15 or 16 columns (docs/inputs.md)"
    )


def _words_of_folder() -> Words:
    says = {
        **_of_boxes(_FOLDER_FORM),
        "box_units": _UNITS_IN_FILES,
        "box_origin": Says(
            "bottom_center_m, the centre of the box's bottom face",
            "give bottom_center_m, half a height below the centre of the box (y points down, so it is larger there)",
        ),
        "box_order": Says("height, width, length", "give dimensions_hwl_m as [height, width, length]"),
        "baseline_sign": Says(
            "baseline_m above 0, or t_right_cam_m with a first component below 0",
            "give baseline_m as a distance without sign; t_right_cam_m is t in x_right = x_left + t, so (-baseline, "
            "0, 0); or left and right are exchanged",
        ),
        "baseline_length": Says("{low} to {high} m", "give baseline_m (or t_right_cam_m) in metres"),
        "no_masks": Says(
            "masks of the left images, better of both",
            "give mask_left and mask_right of the objects in frames/ID.json, and their class",
        ),
        "no_cars": Says(
            "objects of class Car (or --classes) with dimensions_hwl_m, bottom_center_m and rotation_y_rad",
            "check 'class' and these keys of the objects in frames/ID.json",
        ),
    }
    return Words(
        _FOLDER_FORM,
        says,
        "rig.json as in docs/plain_folder.md",
        "JSON as in docs/plain_folder.md",
    )


def _of_boxes(form: BoxForm) -> dict[str, Says]:
    other = "above the centre of its bottom face" if form.raised else "below the centre of the box"
    axis = "z points up" if form.upright else "y points down"
    is_larger = form.upright == bool(form.raised)
    place = f"half a height {other} ({axis}, so it is {'larger' if is_larger else 'smaller'} there)"
    motion = "; T_cam_boxes is the motion from the frame of the boxes to the left camera, in metres"
    through = motion if form.upright else ""
    projection = "check that boxes, masks, images and calibration are of the same frames; then frame, origin and units"
    return {
        "box_axes": Says(form.frame, f"turn locations and headings to these axes before you give them{through}"),
        "box_origin": Says(form.place, f"give {form.place}, {place}"),
        "box_yaw": Says(
            form.heading,
            "convert headings: negate them, add or subtract pi / 2, or turn degrees into radians as found here",
        ),
        "box_order": Says(form.order, f"give {form.order} in this order"),
        "box_projection": Says("at least {limit}", f"{projection}{through}"),
    }


KITTI_FILES = _words_of_kitti("P2", "P3")
"""These are the terms for KITTI's own files."""
