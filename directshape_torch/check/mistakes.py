"""This module has the kinds of mistakes with what is expected and the cure, in the terms of each source of data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from directshape_torch.check.finding import Finding, Severity
from directshape_torch.geometry.box_formats import BoxForm, BoxFormat, box_form

Says = tuple[str, str]  # the expectation and the cure of a mistake, with fields in braces for `str.format`


class Mistake(NamedTuple):
    """A `Mistake` is a kind of mistake that has the same texts for every source of data, with fields in braces."""

    expected: str
    cure: str
    severity: Severity = "error"


_CHECK_FILE = "check the path and the file"
MISTAKES: dict[str, Mistake] = {
    "layout": Mistake("data in the layout '{layout}' (docs/inputs.md)", "check the path and the layout"),
    "missing_files": Mistake(
        "every frame to have all of its files", "add them, or leave the frames out with --split or --frames"
    ),
    "left_image": Mistake("a whole PNG or JPEG", _CHECK_FILE),
    "right_image": Mistake("a whole PNG or JPEG", _CHECK_FILE),
    "image_size": Mistake("images of one size, that of the calibration", _CHECK_FILE),
    "mask_file": Mistake("masks of both images", _CHECK_FILE),
    "plane_file": Mistake("a x + b y + c z + d = 0 with |b| near 1", _CHECK_FILE),
    "lidar_file": Mistake("points of x, y, z, reflectance, and where the scanner is", _CHECK_FILE),
    "focal_length": Mistake(
        "the same within 5 percent, as rectified images have",
        "scale fx, cx with the width and fy, cy with the height of resized images",
    ),
    "raw_intrinsics": Mistake(
        "the intrinsics of the rectified images: one focal length and one row of the centre for both",
        "give K = P[:, :3] of the rectified cameras, not K of the raw ones (a ROS camera_info has both, OpenCV's "
        "stereoRectify returns P1 and P2), and the baseline -P_right[0, 3] / P_right[0, 0]",
    ),
    "principal_point": Mistake(
        "near the middle of the image",
        "use the intrinsics of this size of image; cutting moves the point, resizing scales it",
        "warning",
    ),
    "images_swapped": Mistake(
        "disparities u_left - u_right above 0: everything lies farther left in the right image",
        "swap the left and the right images (or were they mirrored?)",
    ),
    "image_mirrored": Mistake("two images of the same sense", "mirror the one that is read in the wrong direction"),
    "same_image": Mistake(
        "disparity between the two images", "give the right camera's images, not copies of the left ones"
    ),
    "different_scenes": Mistake(
        "at least {share:.0%} of them",
        "check that left and right file of a frame carry the same name, and that neither is mirrored",
    ),
    "not_rectified": Mistake(
        "within {limit} px of what the calibration says",
        "rectify the pair (cv2.stereoRectify and initUndistortRectifyMap) with the calibration that is given",
    ),
    "not_synchronous": Mistake(
        "at most {limit} px", "give images taken at the same moment, with lens distortion removed", "warning"
    ),
    "few_matches": Mistake(
        "at least {limit}", "nothing, where the images have little texture; the pair was not checked", "note"
    ),
    "grey_levels": Mistake(
        "photographs of 0 to 255, alike on both sides", "expose and convert both cameras alike", "warning"
    ),
    "mask_size": Mistake(
        "masks of the size of their image",
        "resize the masks to the size of the images, not the images to that of the masks",
    ),
    "masks_elsewhere": Mistake(
        "at least {limit}",
        "check that masks and detections are of the same frames and the same size of image, and that 2D boxes are "
        "u_min v_min u_max v_max",
    ),
    "masks_swapped": Mistake(
        "left boxes that fit left masks, and cars farther left in the right image",
        "swap the two sides of the masks (or detections and masks were made on the right image)",
    ),
    "box_2d": Mistake("u_min v_min u_max v_max, pixels", "add x to the width and y to the height"),
    "rig_offset": Mistake(
        "within {limit} px",
        "nothing for 'directshape refine', which estimates it (--rig auto); for more evidence: 'calibrate-rig'",
        "warning",
    ),
    "detector_bias": Mistake(
        "within {limit}",
        "check focal length and baseline, or the detector's training; 'directshape refine' goes by the images",
        "warning",
    ),
    "lidar_elsewhere": Mistake(
        "at least {limit}",
        "no known way to read the scans fits: check that scan and images are of the same frame, and Tr_velo_to_cam",
    ),
    "distance_scale": Mistake("within {limit:.0%}", "check focal length, baseline and the units of the boxes"),
}


@dataclass(frozen=True)
class Words:
    """A `Words` has the terms of one source of data: the form of its boxes, and the texts that depend on the source."""

    form: BoxForm
    says: Mapping[str, Says]


_BOTH_SIDES = "masks of the left images, better of both"
_BASELINE = "{low} to {high} m"


def words_of_tensors(convention: BoxFormat) -> Words:
    """The terms for tensors whose boxes were written in a convention."""
    form = box_form(convention)
    says = {
        "baseline_length": (
            _BASELINE,
            "give it in metres: baseline_m of StereoCamera.from_intrinsics; of projections P_right[0, 3] is -fx times "
            "the baseline",
        ),
        "box_units": ("{low} to {high} m", "give metres; leave out what is no car, such as buses"),
        "no_masks": (_BOTH_SIDES, "give mask_left, with masks that are not empty, in the order of the boxes"),
    }
    return Words(form, _of_boxes(form) | says)


def words_of_files(calibration: Path, names: tuple[str, str] = ("P2", "P3")) -> Words:
    """The terms for a data set, given its calibration file and the names of the two cameras in it."""
    form = box_form("kitti")
    says = _of_kitti(*names)
    if calibration.suffix.lower() == ".json":
        form = replace(form, heading=f"rotation_y_rad{form.heading.removeprefix('rotation_y')}")
        says = _OF_FOLDER
    units = ("{low} to {high} m", "write metres (for larger vehicles use --classes)")
    return Words(form, _of_boxes(form) | {"box_units": units} | says)


def _of_kitti(left: str, right: str) -> dict[str, Says]:
    return {
        "calibration_file": (f"{left} and {right}, 12 finite numbers each", _CHECK_FILE),
        "detection_file": ("lines of 15 or 16 columns (docs/inputs.md)", _CHECK_FILE),
        "baseline_sign": (
            f"a positive baseline: {right}[0, 3] / fx below {left}[0, 3] / fx",
            f"swap {left} and {right}, or flip the sign of the fourth columns",
        ),
        "baseline_length": (
            _BASELINE,
            f"give it in metres; the fourth column of {right} is -fx times the baseline, not the baseline",
        ),
        "no_masks": (
            _BOTH_SIDES,
            "check the side ('image') and the class (category_id 3, or 1 and 26 in PNG) of the masks",
        ),
        "no_cars": (
            "lines of class Car (or --classes) with positive h w l and a location",
            "check names of classes and the folder of detections",
        ),
    }


_OF_FOLDER: dict[str, Says] = {
    "calibration_file": ("rig.json as in docs/plain_folder.md", _CHECK_FILE),
    "detection_file": ("JSON as in docs/plain_folder.md", _CHECK_FILE),
    "box_origin": (
        "bottom_center_m, the centre of the box's bottom face",
        "give bottom_center_m, half a height below the centre of the box (y points down, so it is larger there)",
    ),
    "box_order": ("height, width, length", "give dimensions_hwl_m as [height, width, length]"),
    "baseline_sign": (
        "baseline_m above 0, or t_right_cam_m with a first component below 0",
        "give baseline_m as a distance without sign; t_right_cam_m is t in x_right = x_left + t, so (-baseline, "
        "0, 0); or left and right are exchanged",
    ),
    "baseline_length": (_BASELINE, "give baseline_m (or t_right_cam_m) in metres"),
    "no_masks": (_BOTH_SIDES, "give mask_left and mask_right of the objects in frames/ID.json, and their class"),
    "no_cars": (
        "objects of class Car (or --classes) with dimensions_hwl_m, bottom_center_m and rotation_y_rad",
        "check 'class' and these keys of the objects in frames/ID.json",
    ),
}


def _of_boxes(form: BoxForm) -> dict[str, Says]:
    other = "above the centre of its bottom face" if form.raised else "below the centre of the box"
    axis = "z points up" if form.upright else "y points down"
    is_larger = form.upright == bool(form.raised)
    place = f"half a height {other} ({axis}, so it is {'larger' if is_larger else 'smaller'} there)"
    motion = "; T_cam_boxes is the motion from the frame of the boxes to the left camera, in metres"
    through = motion if form.upright else ""
    projection = "check that boxes, masks, images and calibration are of the same frames; then frame, origin and units"
    return {
        "box_axes": (form.frame, f"turn locations and headings to these axes before you give them{through}"),
        "box_origin": (form.place, f"give {form.place}, {place}"),
        "box_yaw": (
            form.heading,
            "convert headings: negate them, add or subtract pi / 2, or turn degrees into radians as found here",
        ),
        "box_order": (form.order, f"give {form.order} in this order"),
        "box_projection": ("at least {limit}", f"{projection}{through}"),
    }


def of_cars(count: int) -> str:
    """The place of a finding about all cars."""
    return f"all frames, {count} cars"


def found(
    check: str,
    where: str,
    measured: str,
    words: Words | None = None,
    *,
    severity: Severity | None = None,
    expected: str = "",
    cure: str = "",
    **fields: float | str,
) -> Finding:
    """A finding with the texts of the table or of its source, unless other texts are given."""
    kind = MISTAKES[check] if words is None or check in MISTAKES else Mistake(*words.says[check])
    expected = expected or kind.expected.format(**fields)
    return Finding(check, severity or kind.severity, where, measured, expected, cure or kind.cure)


def unreadable(check: str, where: str, error: Exception, words: Words | None = None, layout: str = "") -> Finding:
    """A finding about an unusable file with the text of its error, and with its cure if the error has one."""
    measured, _, cure = " ".join(str(error).split()).partition("; ")
    return found(check, where, measured, words, cure=cure, layout=layout)
