"""This script makes a table of the answers of `check_scene` to common mistakes.

    python scripts/scene_mistakes.py --data DIR --detections DIR


Each mistake is made in the tensors of correct frames of a data set in KITTI's layout, and the answer must name it.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from directshape_torch import Detections, FrameBatch, check_scene
from directshape_torch.check.finding import CheckReport
from directshape_torch.geometry.box3d import pose_from_kitti, rotation_y_from_pose
from directshape_torch.io.frame_collation import collate
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.scene.masks import MaskCrops

Scene = tuple[FrameBatch, Detections]


@dataclass(frozen=True)
class Mistake:
    """A `Mistake` is one mistake with the expected answer."""

    make: Callable[[FrameBatch, Detections], Scene]  # function that changes a correct scene
    says: tuple[str, str]  # check, and words of measurement or cure, in an answer that names it
    of_images: bool = False  # whether features of both images are needed to find it


def answer(mistake: Mistake, correct: Scene) -> CheckReport:
    """The report about a scene with the mistake."""
    return check_scene(*mistake.make(*correct), match_images=mistake.of_images)


def named(mistake: Mistake, report: CheckReport) -> bool:
    """Whether a finding of a report names the mistake."""
    check, words = mistake.says
    return any(
        re.fullmatch(check, finding.check) and words in f"{finding.measured} {finding.cure}"
        for finding in report.findings
    )


def _boxes(change: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]) -> Callable[..., Scene]:
    """A mistake from `change(location (B, 3), hwl (B, 3), yaw (B,))`."""

    def make(frames: FrameBatch, d: Detections) -> Scene:
        location, hwl, yaw = change(
            d.T_cam_obj[:, :3, 3].clone(), d.dimensions_hwl.clone(), rotation_y_from_pose(d.T_cam_obj)
        )
        return frames, replace(d, T_cam_obj=pose_from_kitti(location, yaw), dimensions_hwl=hwl)

    return make


def _yaw(change: Callable[[Tensor], Tensor]) -> Callable[..., Scene]:
    return _boxes(lambda location, hwl, yaw: (location, hwl, change(yaw)))


def _location(change: Callable[[Tensor], Tensor]) -> Callable[..., Scene]:
    return _boxes(lambda location, hwl, yaw: (change(location), hwl, yaw))


def _order(*columns: int) -> Callable[..., Scene]:
    return _boxes(lambda location, hwl, yaw: (location, hwl[:, list(columns)], yaw))


def _raised(location: Tensor, hwl: Tensor, share: float = 0.5) -> Tensor:
    location[:, 1] -= share * hwl[:, 0]
    return location


def _permuted(*signed: int) -> Callable[[Tensor], Tensor]:
    index = [abs(axis) - 1 for axis in signed]
    return lambda location: location[:, index] * location.new_tensor(signed).sign()


def _intrinsics(scale: float, rows: int = 2, columns: int = 3) -> Callable[..., Scene]:
    """A mistake that multiplies the first rows and columns of both K by a factor."""

    def make(frames: FrameBatch, d: Detections) -> Scene:
        factor = torch.ones(3, 3).to(frames.camera.K_left)
        factor[:rows, :columns] = scale
        camera = frames.camera
        changed = replace(camera, K_left=camera.K_left * factor, K_right=camera.K_right * factor)
        return replace(frames, camera=changed), d

    return make


def _focal(scale: float) -> Callable[..., Scene]:
    return _intrinsics(scale, columns=2)


def _raw_intrinsics(frames: FrameBatch, d: Detections) -> Scene:
    """A mistake with K of two raw cameras in place of the rectified ones, each with its own error."""
    camera = frames.camera
    changed = {}
    for name, scale, centre in (("K_left", 1.02, (9.0, 4.0)), ("K_right", 1.03, (-5.0, -3.0))):
        K = getattr(camera, name).clone()
        K[:, :2, :2] *= scale
        K[:, :2, 2] += K.new_tensor(centre)
        changed[name] = K
    return replace(frames, camera=replace(camera, **changed)), d


def _baseline(scale: float) -> Callable[..., Scene]:
    def make(frames: FrameBatch, d: Detections) -> Scene:
        T = frames.camera.T_right_cam.clone()
        T[:, 0, 3] *= scale
        return replace(frames, camera=replace(frames.camera, T_right_cam=T)), d

    return make


def _images(change: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]) -> Callable[..., Scene]:
    def make(frames: FrameBatch, d: Detections) -> Scene:
        left, right = change(frames.images_left, frames.images_right)
        return replace(frames, images_left=left, images_right=right), d

    return make


def _masks(change: Callable[[Tensor], Tensor]) -> Callable[..., Scene]:
    """A mistake in the masks of both sides, with masks and 2D boxes as a program would make them from wrong masks."""

    def make(frames: FrameBatch, d: Detections) -> Scene:
        left, right = (MaskCrops.of(change(masks.dense())) for masks in (d.mask_left, d.mask_right))
        return frames, replace(d, mask_left=left, mask_right=right, box_2d=left.box_2d.to(d.box_2d), occluders=None)

    return make


def _other_order(frames: FrameBatch, d: Detections) -> Scene:
    """A mistake with the masks of the next car of the same frame."""
    order = torch.arange(len(d))
    for number in range(len(frames)):
        (rows,) = (d.frame_index == number).nonzero(as_tuple=True)
        order[rows] = rows.roll(1)
    return frames, replace(
        d,
        mask_left=d.mask_left.rows(order),
        mask_right=d.mask_right.rows(order),
        box_2d=d.box_2d[order],
    )


def _sides(frames: FrameBatch, d: Detections) -> Scene:
    return frames, replace(d, mask_left=d.mask_right, mask_right=d.mask_left)


MISTAKES: dict[str, Mistake] = {
    "centre of the box for its bottom": Mistake(
        _boxes(lambda at, hwl, yaw: (_raised(at, hwl), hwl, yaw)), ("box_origin", "centre of the box")
    ),
    "top of the box for its bottom": Mistake(
        _boxes(lambda at, hwl, yaw: (_raised(at, hwl, 1.0), hwl, yaw)), ("box_origin", "top of the box")
    ),
    "heading in degrees": Mistake(_yaw(torch.rad2deg), ("box_yaw", "degrees")),
    "heading off by 90 degrees": Mistake(_yaw(lambda yaw: yaw - math.pi / 2), ("box_yaw", "90 degrees")),
    "heading off by 180 degrees": Mistake(_yaw(lambda yaw: yaw + math.pi), ("box_yaw", "180 degrees")),
    "heading of the other sign": Mistake(_yaw(torch.neg), ("box_yaw", "opposite sign")),
    "heading of a LiDAR": Mistake(_yaw(lambda yaw: -yaw - math.pi / 2), ("box_yaw", "LiDAR")),
    "lengths as l w h": Mistake(_order(2, 1, 0), ("box_order", "l w h")),
    "lengths as w l h": Mistake(_order(1, 2, 0), ("box_order", "w l h")),
    "lengths as l h w": Mistake(_order(2, 0, 1), ("box_order", "l h w")),
    "lengths as h l w": Mistake(_order(0, 2, 1), ("box_order", "h l w")),
    "axes of a LiDAR": Mistake(_location(_permuted(3, -1, -2)), ("box_axes", "LiDAR")),
    "y up": Mistake(_location(_permuted(1, -2, 3)), ("box_axes", "y up")),
    "OpenGL's axes": Mistake(_location(_permuted(1, -2, -3)), ("box_axes", "OpenGL")),
    "z up, y forward": Mistake(_location(_permuted(1, 3, -2)), ("box_axes", "z up, y forward")),
    "x to the left": Mistake(_location(_permuted(-1, 2, 3)), ("box_axes", "x to the left")),
    "centre, w l h and heading of nuScenes": Mistake(
        _boxes(lambda at, hwl, yaw: (_raised(at, hwl), hwl[:, [1, 2, 0]], -yaw - math.pi / 2)),
        ("box_order", "w l h"),
    ),
    "locations in millimetres": Mistake(_location(lambda at: 1000 * at), ("box_units", "multiplied by 0.001")),
    "locations in feet": Mistake(_location(lambda at: at / 0.3048), ("box_units", "multiplied by 0.3")),
    "boxes in millimetres": Mistake(_boxes(lambda at, hwl, yaw: (1000 * at, 1000 * hwl, yaw)), ("box_units", "metres")),
    "half lengths": Mistake(_boxes(lambda at, hwl, yaw: (at, hwl / 2, yaw)), ("box_units", "")),
    "K of images of half the size": Mistake(_intrinsics(0.5), ("principal_point", "multiply fx, fy, cx and cy by 2.0")),
    "K of images of twice the size": Mistake(
        _intrinsics(2.0), ("principal_point", "multiply fx, fy, cx and cy by 0.5")
    ),
    "focal length 0.8 times too short": Mistake(_focal(0.8), ("focal_length", "multiplied by 1.25")),
    "focal length 1.25 times too long": Mistake(_focal(1.25), ("focal_length", "multiplied by 0.8")),
    "K of the raw cameras": Mistake(_raw_intrinsics, ("raw_intrinsics", "P[:, :3]"), True),
    "focal length in millimetres": Mistake(_focal(0.005), ("focal_length", "millimetres")),
    "fy half of fx": Mistake(_intrinsics(0.5, 1), ("focal_length", "resized images")),
    "baseline 1.5 times too long": Mistake(_baseline(1.5), ("distance_scale", "the baseline is wrong")),
    "baseline 0.6 times too short": Mistake(_baseline(0.6), ("distance_scale", "the baseline is wrong")),
    "baseline in millimetres": Mistake(_baseline(1000.0), ("baseline_length", "metres")),
    "left and right images swapped": Mistake(_images(lambda left, right: (right, left)), ("images_swapped", "swap")),
    "left image given twice": Mistake(_images(lambda left, _: (left, left)), ("same_image", "copies"), True),
    "right images mirrored": Mistake(
        _images(lambda left, right: (left, right.flip(3))), ("image_mirrored", "mirror"), True
    ),
    "right images of another frame": Mistake(
        _images(lambda left, right: (left, right.roll(1, dims=0))), ("different_scenes|not_rectified", ""), True
    ),
    "right images 2 px lower": Mistake(
        _images(lambda left, right: (left, right.roll(2, dims=2))), ("not_rectified", "rectify"), True
    ),
    "right images negative": Mistake(
        _images(lambda left, right: (left, 1 - right)), ("grey_levels", "are dark in the other")
    ),
    "right images of red and blue exchanged": Mistake(
        _images(lambda left, right: (left, right.flip(1))), ("grey_levels", "red and blue exchanged")
    ),
    "images of 12 bits in 8": Mistake(
        _images(lambda left, right: (left / 16, right / 16)), ("grey_levels", "are darker than")
    ),
    "masks written row by row": Mistake(
        _masks(lambda masks: masks.reshape(len(masks), masks.shape[2], masks.shape[1]).transpose(1, 2)),
        ("masks_elsewhere", "row by row"),
    ),
    "left and right masks swapped": Mistake(_sides, ("masks_swapped", "swap the two sides")),
    "masks mirrored": Mistake(_masks(lambda masks: masks.flip(2)), ("masks_elsewhere", "mirror")),
    "masks shifted by 80 px": Mistake(
        _masks(lambda masks: masks.roll(80, dims=2)), ("masks_elsewhere", "shifted by (")
    ),
    "masks of half the size": Mistake(_masks(lambda masks: masks[:, ::2, ::2]), ("mask_size", "resize the masks")),
    "masks in another order": Mistake(_other_order, ("masks_elsewhere", "in the order of the boxes")),
}


def scene(root: Path, detections: Path, masks: Path, count: int = 6, first: int = 0) -> Scene:
    """Some frames of a data set as one batch."""
    dataset = open_dataset("kitti", root, detections, masks, ground="camera_height")
    frames, found = collate([dataset.load(frame_id) for frame_id in dataset.frame_ids[first : first + count]])
    # 2D boxes are made as by `Detections.from_boxes`, because those of a file may be projections of the labels.
    return frames, replace(found, box_2d=found.mask_left.box_2d.to(found.box_2d))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="folder that holds training")
    parser.add_argument("--detections", type=Path, required=True, metavar="DIR", help="KITTI result files")
    parser.add_argument("--masks", type=Path, metavar="DIR", help="default: training/masks of the data")
    parser.add_argument("--frames", type=int, default=6, metavar="N", help="frames in a batch (default: 6)")
    args = parser.parse_args()
    correct = scene(args.data, args.detections, args.masks or args.data / "training" / "masks", args.frames)
    print(f"correct: {check_scene(*correct)}\n")
    print("| mistake | named | what is said | cure |\n|---|---|---|---|")
    for name, mistake in MISTAKES.items():
        report = answer(mistake, correct)
        said = "; ".join(f"`{finding.check}`: {finding.measured}" for finding in report.findings) or "nothing"
        cure = report.findings[0].cure if report.findings else ""
        print(f"| {name} | {'yes' if named(mistake, report) else 'NO'} | {said} | {cure} |", flush=True)


if __name__ == "__main__":
    main()
