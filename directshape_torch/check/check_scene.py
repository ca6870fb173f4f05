"""`check_scene` finds common mistakes in the tensors of a call and names their cures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from directshape_torch.check.car_evidence import FrameEvidence, evidence_of_scene
from directshape_torch.check.check_boxes import check_box_2d, check_boxes, check_corners
from directshape_torch.check.check_images import check_frame
from directshape_torch.check.check_lidar import check_lidar
from directshape_torch.check.check_masks import check_masks
from directshape_torch.check.check_places import check_distances, check_heading, check_swapped, measure_cars
from directshape_torch.check.finding import CheckReport, Finding, by_severity, names
from directshape_torch.check.mistakes import found
from directshape_torch.numerics.checks import check_type
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch


def check_scene(frames: FrameBatch, detections: Detections, match_images: bool = True) -> CheckReport:
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
        error: principal_point (frame 000000, left and 1 more)
          measured  (300.0, 90.0) in images of 1242 x 375 pixels
          expected  near the middle of the image
          cure      K is of images 0.48 times as large: multiply fx, fy, cx and cy by 2.07
        ...
    """
    check_type("frames", frames, (FrameBatch,))
    check_type("detections", detections, (Detections,))
    check_type("match_images", match_images, (bool,))
    findings, usable = list[Finding](), []
    for one in evidence_of_scene(frames.detach(), detections.detach()):
        K = {"left": one.camera.K_left[0].numpy(), "right": one.camera.K_right[0].numpy()}
        numbers, where = (K, float(one.camera.baseline[0])), f"frame {one.frame_id}"
        of_frame, camera, pair = check_frame(numbers, one.camera, one.pair, one.size_hw, where, one.words, match_images)
        findings += of_frame
        usable += [] if camera is None else [replace(one, pair=pair)]
    images, masks = tuple(frames.images_left.shape[2:]), detections.mask_left.size_hw
    if len(detections) and images != masks:
        measured = f"masks of {masks[1]} x {masks[0]}, images of {images[1]} x {images[0]} pixels"
        findings.append(found("mask_size", "all frames", measured))
    else:
        findings += check_cars(usable)
    return CheckReport(by_severity(findings), len(frames), len(frames), len(detections))


def check_cars(all_frames: Sequence[FrameEvidence]) -> list[Finding]:
    """Findings about boxes, masks and distances, each only if the data that it depends on are right."""
    cars = np.concatenate([np.empty((0, 3)), *map(measure_cars, all_frames)])
    frames = [frame for frame in all_frames if len(frame.boxes)]
    if not frames:
        return check_lidar(all_frames)
    if swapped := check_swapped(cars):
        return swapped
    of_boxes = check_box_2d(frames) or check_boxes(frames)
    if any(finding.severity == "error" for finding in of_boxes):
        # Masks are found by the boxes and distances are of the boxes, so these would only report the same mistake
        # again.
        if "masks_elsewhere" in names(of_boxes):
            return of_boxes
        explained = names(of_boxes) != {"box_projection"}
        return of_boxes + [one for one in check_masks(frames) if one.check != "masks_elsewhere" or not explained]
    of_places = [*check_distances(cars), *check_heading(frames)]
    # A wrong baseline changes the measurements of the images, not the points.
    of_scans = [] if "distance_scale" in {finding.check for finding in of_places} else check_lidar(all_frames)
    return [*of_boxes, *check_corners(frames), *check_masks(frames), *of_places, *of_scans]
