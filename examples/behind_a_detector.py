"""The refiner as the last stage of a detector: tensors in, tensors out, no files in between.

    python examples/behind_a_detector.py

`RefinedDetector` is what you would copy. Your own network stands where `StoredDetector` stands here: it plays back
the noisy boxes and the masks of the frame that comes with the package.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

import directshape_torch
from directshape_torch import Detections, DirectShapeRefiner, FrameBatch, GroundPlane, RefinementResult, StereoCamera
from directshape_torch.geometry.box_formats import poses_to_boxes
from directshape_torch.io.kitti_labels import poses_cam
from directshape_torch.io.stereo_dataset import StereoDataset, open_dataset

DEMO = Path(directshape_torch.__file__).parent / "assets" / "demo"


@dataclass(frozen=True)
class DetectorOutput:
    """What a stereo detector with a mask head gives for F frames: N cars in all.

    Attributes:
        frame_index: (N,) the frame of each car.
        boxes: (N, 7) as MMDetection3D has them in a camera frame: x, y, z, length, height, width, heading.
        box_2d: (N, 4) u_min, v_min, u_max, v_max in the left image, pixels.
        score: (N,).
        mask_left, mask_right: (N, H, W) foreground probability in [0, 1]; left ones are needed, all zero for none.
    """

    frame_index: Tensor
    boxes: Tensor
    box_2d: Tensor
    score: Tensor
    mask_left: Tensor
    mask_right: Tensor


class RefinedDetector(nn.Module):
    """A detector whose boxes are refined to poses and shapes before they are returned."""

    def __init__(self, detector: nn.Module, refiner: DirectShapeRefiner) -> None:
        super().__init__()
        self.detector = detector
        self.refiner = refiner

    def forward(
        self,
        images_left: Tensor,  # (F, 3, H, W) RGB in [0, 1]
        images_right: Tensor,  # (F, 3, H, W)
        P_left: Tensor,  # (F, 3, 4) projections, pixels
        P_right: Tensor,  # (F, 3, 4)
        ground: GroundPlane,
    ) -> tuple[DetectorOutput, RefinementResult]:
        """The detector's boxes, and for each of them a refined pose, a shape and a status."""
        found: DetectorOutput = self.detector(images_left, images_right)
        camera = StereoCamera.from_projections(P_left, P_right)  # or from_intrinsics(K, baseline)
        frames = FrameBatch.from_images(images_left, images_right, camera, ground)
        detections = Detections.from_boxes(
            found.boxes,
            "mmdet3d_camera",
            mask_left=found.mask_left,
            mask_right=found.mask_right,
            frame_index=found.frame_index,
            score=found.score,
            box_2d=found.box_2d,
        )
        return found, self.refiner(frames, detections)


class StoredDetector(nn.Module):
    """Stands in for a network: gives the detections and masks of the bundled frame, whatever it is shown."""

    def __init__(self, dataset: StereoDataset) -> None:
        super().__init__()
        loaded = dataset.load(dataset.frame_ids[0])
        lines = [loaded.input_objects[row] for row in loaded.row_of_detection]
        poses = poses_cam(lines, loaded.frame.camera.t_cam_ref[0])
        self.output = DetectorOutput(
            frame_index=torch.zeros(len(lines), dtype=torch.int64),
            boxes=poses_to_boxes(poses, loaded.detections.dimensions_hwl, "mmdet3d_camera"),
            box_2d=loaded.detections.box_2d,
            score=torch.tensor([line.score or 0.0 for line in lines]),
            mask_left=loaded.detections.mask_left.dense(),
            mask_right=loaded.detections.mask_right.dense(),
        )

    def forward(self, images_left: Tensor, images_right: Tensor) -> DetectorOutput:
        """The stored output."""
        return self.output


def main() -> tuple[DetectorOutput, RefinementResult]:
    """Refine the bundled frame and print what came out."""
    dataset = open_dataset("kitti", DEMO, DEMO / "detections" / "noisy_stereo", DEMO / "training" / "masks")
    frame = dataset.load(dataset.frame_ids[0]).frame
    P_left, P_right = _projections(frame.camera)
    pipeline = RefinedDetector(StoredDetector(dataset), DirectShapeRefiner())
    found, result = pipeline(frame.images_left, frame.images_right, P_left, P_right, frame.ground)

    boxes = result.to_boxes("mmdet3d_camera")  # of the refined shapes, as the detector writes them
    for car, one in enumerate(result):
        before, after = (_text(each[car, :3]) for each in (found.boxes, boxes))
        print(f"car {car}: {before} -> {after} m, {one.status[0].name}, depth sigma {one.sigma_xyz_yaw[0, 2]:.2f} m")
    refined = result.refined.nonzero()[:, 0].tolist()
    if refined:
        mesh = result.mesh(refined[0])  # a trimesh.Trimesh in the left camera frame
        print(f"the surface of car {refined[0]} has {len(mesh.faces)} triangles and {mesh.volume:.1f} m^3")
    return found, result


def _text(point: Tensor) -> str:
    return ", ".join(f"{coordinate:6.2f}" for coordinate in point.tolist())


def _projections(camera: StereoCamera) -> tuple[Tensor, Tensor]:
    """P2 and P3 of a camera, as data sets and rigs usually give them."""
    t_left = camera.t_cam_ref[..., None]
    t_right = t_left + camera.T_right_cam[:, :3, 3:]
    P_left = torch.cat([camera.K_left, camera.K_left @ t_left], dim=-1)
    P_right = torch.cat([camera.K_right, camera.K_right @ t_right], dim=-1)
    return P_left, P_right


if __name__ == "__main__":
    main()
