"""What each check expects and how its mistake is mended: one table; the checks themselves only measure."""

from __future__ import annotations

from typing import NamedTuple

from directshape_torch.scene_check.finding import Finding, Severity


class Mistake(NamedTuple):
    """A kind of mistake. What depends on the case is in braces, for `str.format`."""

    severity: Severity
    expected: str
    cure: str


_CAMERA: dict[str, Mistake] = {
    "focal_length": Mistake(
        "error",
        "the same within 5 percent, as rectified images have",
        "scale fx, cx with the width and fy, cy with the height of resized images",
    ),
    "principal_point": Mistake(
        "warning",
        "near the middle of the image",
        "use the intrinsics of this size of image; cutting moves the point, resizing scales it",
    ),
    "baseline_sign": Mistake(
        "error",
        "a positive baseline: P3[0, 3] / fx below P2[0, 3] / fx",
        "swap P2 and P3, or flip the sign of the fourth columns",
    ),
    "baseline_length": Mistake(
        "error",
        "{low} to {high} m",
        "give it in metres; the fourth column of P3 is -fx times the baseline, not the baseline",
    ),
}
_IMAGES: dict[str, Mistake] = {
    "images_swapped": Mistake(
        "error",
        "disparities u_left - u_right above 0: everything lies farther left in the right image",
        "swap the left and the right images (or were they mirrored?)",
    ),
    "image_mirrored": Mistake(
        "error", "two images of the same sense", "mirror the one that is read in the wrong direction"
    ),
    "same_image": Mistake(
        "error", "disparity between the two images", "give the right camera's images, not copies of the left ones"
    ),
    "different_scenes": Mistake(
        "error",
        "at least {share:.0%} of them",
        "check that left and right file of a frame carry the same name, and that neither is mirrored",
    ),
    "not_rectified": Mistake(
        "error",
        "within {limit} px of what the calibration says",
        "rectify the pair (cv2.stereoRectify and initUndistortRectifyMap) with the calibration that is given",
    ),
    "not_synchronous": Mistake(
        "warning", "at most {limit} px", "give images taken at the same moment, with lens distortion removed"
    ),
    "few_matches": Mistake(
        "note", "at least {limit}", "nothing, where the images have little texture; the pair was not checked"
    ),
}
_MASKS: dict[str, Mistake] = {
    "mask_size": Mistake(
        "error",
        "masks of the size of their image",
        "resize the masks to the size of the images, not the images to that of the masks",
    ),
    "masks_elsewhere": Mistake(
        "error",
        "at least {limit}",
        "check that masks and detections are of the same frames and the same size of image, and that 2D boxes are "
        "u_min v_min u_max v_max",
    ),
    "masks_swapped": Mistake(
        "error",
        "left boxes that fit left masks, and cars farther left in the right image",
        "swap the two sides of the masks (or detections and masks were made on the right image)",
    ),
    "no_masks": Mistake(
        "error",
        "masks of the left images, better of both",
        "check the side ('image') and the class (category_id 3, or 1 and 26 in PNG) of the masks",
    ),
}
_BOXES: dict[str, Mistake] = {
    "box_2d": Mistake("error", "u_min v_min u_max v_max, pixels", "add x to the width and y to the height"),
    "box_axes": Mistake(
        "error",
        "x right, y down, z forward, metres, in the frame of the rectified camera",
        "turn locations to x right, y down, z forward before writing them",
    ),
    "box_origin": Mistake(
        "error",
        "the centre of the box's bottom face",
        "write the centre of the bottom face: add half a height to y of a centre (y points down)",
    ),
    "box_yaw": Mistake(
        "error",
        "rotation_y in radians about the y axis, 0 where the car drives along +x, -pi/2 where it drives along +z",
        "convert headings: negate them, add or subtract pi / 2, or turn degrees into radians as found here",
    ),
    "box_order": Mistake("error", "height, width, length", "write height, width, length in this order"),
    "box_units": Mistake("error", "{low} to {high} m", "write metres (for larger vehicles use --classes)"),
    "box_projection": Mistake(
        "error",
        "at least {limit}",
        "check that detections, masks, images and calibration are of the same frames; then frame, origin and units",
    ),
    "distance_scale": Mistake("error", "within {limit:.0%}", "check focal length, baseline and the units of the boxes"),
}
MISTAKES = _CAMERA | _IMAGES | _MASKS | _BOXES


def found(
    check: str,
    where: str,
    measured: str,
    *,
    severity: Severity | None = None,
    expected: str = "",
    cure: str = "",
    **numbers: float,
) -> Finding:
    """A finding with what the table says of its kind, unless something else is said here.

    Examples:
        >>> str(found("few_matches", "frame 1", "7 feature matches between the images", limit=30))[:73]
        'note: few_matches (frame 1): 7 feature matches between the images; expect'
    """
    kind = MISTAKES[check]
    return Finding(
        check,
        severity or kind.severity,
        where,
        measured,
        expected or kind.expected.format(**numbers),
        cure or kind.cure,
    )
