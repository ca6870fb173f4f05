"""`check_scene` finds common mistakes in the tensors of a call and names their cures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from directshape_torch.check.car_evidence import FrameEvidence, evidence_of_scene
from directshape_torch.check.check_boxes import check_box_2d, check_boxes, check_corners
from directshape_torch.check.check_images import SPOILS_CAMERA, SPOILS_PAIR, check_calibration, with_images
from directshape_torch.check.check_lidar import check_lidar
from directshape_torch.check.check_masks import check_masks
from directshape_torch.check.check_places import check_distances, check_heading, check_swapped, measure_cars
from directshape_torch.check.finding import CheckReport, Finding, by_severity, names
from directshape_torch.check.finding import found as found_mistake
from directshape_torch.check.words import Words
from directshape_torch.numerics.checks import check_type
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch


def check_scene(
    frames: FrameBatch, detections: Detections, match_images: bool = True, words: Words | None = None
) -> CheckReport:
    """Look for common mistakes in images, calibration, masks and boxes (docs/check_data.md).

    Examples are the centre of a box for its bottom, headings in degrees, off by 90 or 180 degrees or of the other sign,
    another order of lengths, axes of a LiDAR, intrinsics of another image size, a wrong focal length or baseline,
    millimetres, left and right swapped, masks that are mirrored, shifted, of another frame, size or order. Consequences
    of a reported mistake are not reported.

    Args:
        frames: F frames.
        detections: B cars; more cars show more mistakes.
        match_images: whether to match features of the two images too, which takes a second for each frame and shows
            whether they are rectified and show the same scene.
        words: wording of the findings. Default: that of `detections.convention`.

    Returns:
        The report; printed, it says what was measured, what was expected, and how to correct it.

    Raises:
        InputError: an argument has another type.

    Examples:
        >>> import torch
        >>> from directshape_torch import StereoCamera
        >>> K = torch.tensor([[360.0, 0.0, 300.0], [0.0, 360.0, 90.0], [0.0, 0.0, 1.0]])
        >>> image, mask = torch.zeros(3, 375, 1242), torch.zeros(1, 375, 1242, dtype=torch.bool)
        >>> mask[0, 180:240, 500:640] = True
        >>> frames = FrameBatch.from_images(image, image, StereoCamera.from_intrinsics(K, 0.54))
        >>> boxes = torch.tensor([[0.5, 0.9, 20.0, 4.0, 1.6, 1.5, 0.3]])
        >>> print(check_scene(frames, Detections.from_boxes(boxes, "opencv", mask_left=mask), match_images=False))
        error: principal_point (frame 000000, left)
          measured  (300.0, 90.0) in images of 1242 x 375 pixels
          expected  near the middle of the image
          cure      K is of images 0.48 times as large: multiply fx, fy, cx and cy by 2.07
        ...
    """
    check_type("frames", frames, (FrameBatch,))
    check_type("detections", detections, (Detections,))
    check_type("match_images", match_images, (bool,))
    evidence = evidence_of_scene(frames.detach(), detections.detach(), words)
    found = _once([finding for one in evidence for finding in _check_camera(one)])
    usable = not names(found) & SPOILS_CAMERA
    for one in evidence:
        if one.pair is not None:
            camera = one.camera if usable else None
            found = with_images(found, one.pair, camera, f"frame {one.frame_id}", match_images)
    found += _mask_sizes(frames, detections)
    if usable and not names(found) & {"mask_size"}:
        spoilt = bool(names(found) & SPOILS_PAIR)
        found += check_cars([replace(one, pair=None) if spoilt else one for one in evidence])
    return CheckReport(by_severity(found), len(frames), len(frames), len(detections))


def _check_camera(one: FrameEvidence) -> list[Finding]:
    camera = one.camera
    matrices = {"left": camera.K_left[0].numpy(), "right": camera.K_right[0].numpy()}
    return check_calibration(matrices, float(camera.baseline[0]), one.size_hw, f"frame {one.frame_id}", one.words)


def check_cars(frames: Sequence[FrameEvidence]) -> list[Finding]:
    """Findings about boxes, masks and distances, each only if the data that it depends on are right."""
    cars = np.concatenate([np.empty((0, 3)), *(measure_cars(one, *one.pair) for one in frames if one.pair is not None)])
    with_scans, frames = frames, [frame for frame in frames if len(frame.boxes)]
    swapped = check_swapped(cars)
    if swapped:
        return swapped
    of_boxes = check_box_2d(frames) or check_boxes(frames)
    if any(finding.severity == "error" for finding in of_boxes):
        # Masks are found by the boxes and distances are of the boxes, so these would only report the same mistake
        # again.
        if "masks_elsewhere" in names(of_boxes):
            return of_boxes
        explained = names(of_boxes) != {"box_projection"}
        of_masks = check_masks(frames)
        return [*of_boxes, *(found for found in of_masks if found.check != "masks_elsewhere" or not explained)]
    found = [*of_boxes, *check_corners(frames), *check_masks(frames)]
    of_places = [*check_distances(cars), *check_heading(frames)]
    # A wrong baseline changes the measurements of the images, not the points.
    of_scans = [] if "distance_scale" in {finding.check for finding in of_places} else check_lidar(with_scans)
    return [*found, *of_places, *of_scans]


def _once(findings: Sequence[Finding]) -> list[Finding]:
    """The first finding of each kind, since frames of a call mostly share their camera."""
    return list({finding.check: finding for finding in reversed(findings)}.values())[::-1]


def _mask_sizes(frames: FrameBatch, detections: Detections) -> list[Finding]:
    images, masks = tuple(frames.images_left.shape[2:]), detections.mask_left.size_hw
    if not len(detections) or images == masks:
        return []
    measured = f"masks of {masks[1]} x {masks[0]}, images of {images[1]} x {images[0]} pixels"
    return [found_mistake("mask_size", "all frames", measured)]
