"""What a refinement is given: cameras, ground planes, frames and detections, as plain tensors.

Knows no data set and no solver. Frames of a call are numbered `0 .. F-1`; objects carry the number of their frame.
Everything is in the left camera frame (`cam`): x right, y down, z forward, metres; pixels are (u, v) = (column, row)
with the centre of the top-left pixel at (0, 0).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import NoneType
from typing import Annotated

import torch
from kornia.geometry import camera as kornia_camera
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.geometry.box_formats import BoxFormat, boxes_to_poses
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.geometry.se3 import from_rotation_translation
from directshape_torch.numerics.checks import (
    Dense,
    TensorRecord,
    check_alike,
    check_positive,
    check_rotation,
    check_shape,
    check_sigmas,
    check_stored,
    is_no_rotation,
)

# Of B cars in an image: (B, H, W), or (H, W) and None for each.
Masks = Tensor | Sequence[Tensor | None]

# Resampling by cubic kernels overshoots by a quarter at an edge; normalised images and 0..255 go far beyond.
_BRIGHTEST = 1.5
_DARKEST = -0.5
# Of rectified cameras: 1e-4 radians move a pixel by 0.07 at a focal length of 700, and KITTI's stand askew by 0.5 %.
_LARGEST_TURN = 1e-4
_LARGEST_OFFSET = 0.05  # of the baseline


@dataclass(frozen=True)
class StereoCamera(TensorRecord):
    """Calibration of the F rectified stereo frames of a call.

    Attributes:
        K_left: intrinsics of the left camera, (F, 3, 3), pixels.
        K_right: intrinsics of the right camera, (F, 3, 3), pixels.
        T_right_cam: left camera to right camera, (F, 4, 4), metres. Any rigid transform: KITTI's right camera is also
            2.7 mm off vertically.
        t_cam_ref: `x_cam = x_ref + t_cam_ref`, (F, 3): `ref` is the frame of labels and result files (KITTI: rectified
            camera 0). Zero where there is no such frame.
        disparity_field: residual disparity of the rig (measured minus true), or None.

    Raises:
        InputError: wrong shapes, numbers that are not finite, a rotation that is none, or a right camera that is not
            to the right of the left one.
    """

    K_left: Annotated[Tensor, Dense("F", 3, 3)]
    K_right: Annotated[Tensor, Dense("F", 3, 3)]
    T_right_cam: Annotated[Tensor, Dense("F", 4, 4)]
    t_cam_ref: Annotated[Tensor, Dense("F", 3)]
    disparity_field: DisparityField | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_type("disparity_field", self.disparity_field, (DisparityField, NoneType))
        for name in ("K_left", "K_right", "T_right_cam", "t_cam_ref"):
            if not bool(getattr(self, name).isfinite().all()):
                raise InputError(name, "finite numbers", "NaN or infinity", "check the calibration of every frame")
        check_rotation("T_right_cam", self.T_right_cam)
        if (self.baseline <= 0).any():
            raise InputError(
                "T_right_cam",
                "a right camera to the right of the left one (positive baseline)",
                f"baseline {self.baseline.min().item():.4f} m",
                "swap the two cameras, or the sign of the baseline",
            )

    @classmethod
    def from_intrinsics(
        cls,
        K: Tensor,  # (3, 3) or (F, 3, 3)
        baseline_m: float | Tensor,  # or (F,)
        K_right: Tensor | None = None,
        disparity_field: DisparityField | None = None,
    ) -> StereoCamera:
        """Of an ideal rectified pair: parallel cameras side by side, and labels in the frame of the left one.

        Args:
            K: intrinsics of the images, pixels; one matrix for one frame, or one for each of F frames.
            baseline_m: distance of the two cameras, metres, positive.
            K_right: of the right images where they differ.
            disparity_field: residual disparity of the rig (measured minus true), or None.

        Raises:
            InputError: other shapes or types, intrinsics that are not `[[fx, s, cx], [0, fy, cy], [0, 0, 1]]` with
                positive focal lengths, or a baseline that is not above 0.

        Examples:
            >>> K = torch.tensor([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
            >>> StereoCamera.from_intrinsics(K, 0.54).baseline
            tensor([0.5400])
        """
        K_left = _intrinsics("K", K)
        of_right = K_left.clone() if K_right is None else _intrinsics("K_right", K_right).expand_as(K_left).clone()
        baseline = torch.as_tensor(baseline_m, dtype=K_left.dtype, device=K_left.device)
        if baseline.ndim > 1 or (baseline.ndim == 1 and len(baseline) != len(K_left)):
            got = str(tuple(baseline.shape))
            raise InputError("baseline_m", f"a number, or {len(K_left)} of them", f"shape {got}", "in metres")
        T_right_cam = torch.eye(4).to(K_left).repeat(len(K_left), 1, 1)
        T_right_cam[:, 0, 3] = -baseline
        return cls(K_left.clone(), of_right, T_right_cam, torch.zeros_like(K_left[:, 0]), disparity_field)

    @classmethod
    def from_projections(
        cls,
        P_left: Tensor,  # (F, 3, 4)
        P_right: Tensor,  # (F, 3, 4)
        disparity_field: DisparityField | None = None,
    ) -> StereoCamera:
        """From KITTI's P2 and P3: `K = P[:, :3]`, `t_left = K^-1 P2[:, 3]`, `T_right_cam = [I, t_right - t_left]`.

        Raises:
            InputError: wrong shapes or types, a K that has no inverse, or a right camera that is not to the right of
                the left one.

        Examples:
            >>> K = torch.tensor([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
            >>> shift = torch.tensor([[-378.0], [0.0], [0.0]])
            >>> P_left = torch.cat([K, torch.zeros(3, 1)], dim=1)[None]
            >>> P_right = torch.cat([K, shift], dim=1)[None]
            >>> StereoCamera.from_projections(P_left, P_right).baseline
            tensor([0.5400])
        """
        check_shape("P_left", P_left, ("F", 3, 4))
        check_shape("P_right", P_right, (len(P_left), 3, 4))
        if P_left.dtype not in (torch.float32, torch.float64):
            raise InputError("P_left", "float32 or float64", str(P_left.dtype), "convert it with .float() or .double()")
        check_alike("P_right", P_right, "P_left", P_left)
        check_stored("P_left", P_left)
        K_left, K_right = P_left[..., :3], P_right[..., :3]
        t_left, t_right = _translation("P_left", P_left), _translation("P_right", P_right)
        T_right_cam = torch.eye(4, dtype=P_left.dtype, device=P_left.device).repeat(len(P_left), 1, 1)
        T_right_cam[:, :3, 3] = t_right - t_left
        return cls(K_left.clone(), K_right.clone(), T_right_cam, t_left, disparity_field)

    @classmethod
    def from_kornia(
        cls,
        left: kornia_camera.PinholeCamera | kornia_camera.StereoCamera,
        right: kornia_camera.PinholeCamera | None = None,
        disparity_field: DisparityField | None = None,
    ) -> StereoCamera:
        """From a rectified pair of kornia's `PinholeCamera`, or from its `StereoCamera`, of F frames each.

        Pixels and axes are the same there: centres at integers, x right, y down, z forward. Extrinsics (world to
        camera) and projections are taken to be in metres. Of a pair, `T_right_cam` is kept and the world is not: `ref`
        is the left camera itself. The height and width of the images belong to `FrameBatch.sizes`. Dtype, device and
        gradients are kept.

        Args:
            left: of the left images: a `StereoCamera`, which has both, or intrinsics and extrinsics (F, 4, 4).
            right: likewise of the right images; None beside a `StereoCamera`.
            disparity_field: residual disparity of the rig (measured minus true), or None.

        Raises:
            InputError: other types, a pair whose batch, image size, dtype or device differ, a rotation that is none,
                cameras that are not rectified (turned by more than 1e-4 radians, or displaced by more than 5 % of the
                baseline in height or depth), or a right camera that is not to the right of the left one.

        Examples:
            >>> K, T_right_cam = torch.eye(4)[None], torch.eye(4)[None].clone()
            >>> K[0, 0, 0] = K[0, 1, 1] = 700.0
            >>> T_right_cam[0, 0, 3] = -0.54
            >>> height, width = torch.tensor([375]), torch.tensor([1242])
            >>> left = kornia_camera.PinholeCamera(K, torch.eye(4)[None], height, width)
            >>> right = kornia_camera.PinholeCamera(K, T_right_cam, height, width)
            >>> StereoCamera.from_kornia(left, right).baseline
            tensor([0.5400])
        """
        if isinstance(left, kornia_camera.StereoCamera):
            if right is not None:
                raise InputError("right", "None beside kornia's StereoCamera, which has both", type(right).__name__)
            return cls.from_projections(left.rectified_left_camera, left.rectified_right_camera, disparity_field)
        pair = _pinhole("left", left), _pinhole("right", right)
        _check_alike(*pair)
        T_right_cam = _between_rectified(*pair)
        K_left, K_right = (camera.intrinsics[:, :3, :3].clone() for camera in pair)
        return cls(K_left, K_right, T_right_cam, torch.zeros_like(T_right_cam[:, :3, 3]), disparity_field)

    @property
    def num_frames(self) -> int:
        return len(self.K_left)

    @property
    def baseline(self) -> Tensor:
        """Distance of the right camera along the left camera's x axis, (F,), metres, positive."""
        return -self.T_right_cam[:, 0, 3]

    @property
    def T_cam_ref(self) -> Tensor:
        """The frame of labels and result files to the left camera, (F, 4, 4)."""
        return from_rotation_translation(torch.eye(3).to(self.t_cam_ref).expand_as(self.K_left), self.t_cam_ref)


@dataclass(frozen=True)
class GroundPlane(TensorRecord):
    """One ground plane a frame: `normal . x_cam + offset = 0`, unit normal pointing up (negative y).

    Attributes:
        normal: (F, 3).
        offset: (F,), metres; the height of the camera above the ground, negative where the plane is that of a hill
            above it. NaN: cars of that frame fail.
        source: where each plane came from, F entries: "file", "stereo", "camera_height", or the caller's own word.
    """

    normal: Annotated[Tensor, Dense("F", 3)]
    offset: Annotated[Tensor, Dense("F")]
    source: tuple[str, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_words("source", self.source, len(self.normal), "entries")
        downwards = self.normal[:, 1] >= 0
        not_unit = (self.normal.norm(dim=-1) - 1).abs() > 1e-3
        # One wait for the device for both of them. NaN passes: it fails the cars of its own frame.
        if not bool((downwards | not_unit).any()):
            return
        if downwards.any():
            raise InputError(
                "normal", "a normal pointing up (negative y)", str(self.normal.tolist()), "flip the plane's signs"
            )
        raise InputError("normal", "unit length", str(self.normal.norm(dim=-1).tolist()), "divide the plane by it")

    @classmethod
    def from_camera_height(cls, height_m: float, num_frames: int = 1) -> GroundPlane:
        """A level ground `height_m` below the camera, for rigs without plane files.

        Raises:
            InputError: a height that is not above 0, or infinite.

        Examples:
            >>> GroundPlane.from_camera_height(1.65).offset
            tensor([1.6500])
        """
        check_positive("height_m", height_m, "give the camera's height above the road, in metres")
        normal = torch.tensor([[0.0, -1.0, 0.0]]).repeat(num_frames, 1)
        return cls(normal, torch.full((num_frames,), float(height_m)), ("camera_height",) * num_frames)


@dataclass(frozen=True)
class FrameBatch(TensorRecord):
    """F stereo frames, padded at the right and bottom to one size.

    Attributes:
        images_left: (F, 3, H, W), RGB in [0, 1].
        images_right: (F, 3, H, W).
        sizes: (F, 2) int64 or int32 (height, width) of each frame without padding.
        camera: calibration of the frames.
        ground: a ground plane for each frame, in the left camera frame.
        frame_ids: a name for each frame.
        disparity: (F, H, W) measured `u_left - u_right` of the left pixels, NaN where unknown, for the methods that fit
            a point cloud; None: they match the images themselves.
        points_cam: (F, P, 3) points of a LiDAR in the left camera frame, metres, NaN where a frame has fewer than P,
            for `terms.lidar`; None: nobody has measured any.
    """

    images_left: Annotated[Tensor, Dense("F", 3, "H", "W", kind="image", cure="stack images as (F, 3, H, W) in [0, 1]")]
    images_right: Annotated[Tensor, Dense("F", 3, "H", "W", kind="image")]
    sizes: Annotated[Tensor, Dense("F", 2, kind="index")]
    camera: StereoCamera
    ground: GroundPlane
    frame_ids: tuple[str, ...]
    disparity: Annotated[Tensor | None, Dense("F", "H", "W")] = None
    points_cam: Annotated[Tensor | None, Dense("F", "P", 3)] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        num_frames, _, height, width = self.images_left.shape
        _check_brightness("images_left", self.images_left)
        _check_brightness("images_right", self.images_right)
        _check_words("frame_ids", self.frame_ids, num_frames, "names")
        _check_type("camera", self.camera, (StereoCamera,))
        _check_type("ground", self.ground, (GroundPlane,))
        for name, count in (("camera", self.camera.num_frames), ("ground", len(self.ground.normal))):
            if count != num_frames:
                raise InputError(name, f"{num_frames} frames", f"{count}")
        if num_frames and bool(((self.sizes > self.sizes.new_tensor([height, width])) | (self.sizes < 1)).any()):
            raise InputError("sizes", f"(height, width) within (1..{height}, 1..{width})", str(self.sizes.tolist()))
        field = self.camera.disparity_field
        if field is not None:
            for k in range(num_frames):
                h, w = (int(n) for n in self.sizes[k])
                field.check_rig((w, h), self.camera.K_left[k], self.camera.K_right[k], self.camera.T_right_cam[k])

    @classmethod
    def from_images(
        cls,
        images_left: Tensor,  # (F, 3, H, W), or (3, H, W) of one frame
        images_right: Tensor,
        camera: StereoCamera,
        ground: GroundPlane | float = 1.65,
        frame_ids: Sequence[str] | None = None,
    ) -> FrameBatch:
        """Frames without padding, of RGB images in floating point in [0, 1] or uint8.

        Args:
            images_left, images_right: rectified pairs.
            camera: of F frames, or of one for all of them.
            ground: planes, or the height of the camera above a level road, metres.
            frame_ids: names; default "000000" and on.

        Raises:
            InputError: what the class raises.

        Examples:
            >>> K = torch.tensor([[700.0, 0.0, 200.0], [0.0, 700.0, 60.0], [0.0, 0.0, 1.0]])
            >>> image = torch.zeros(3, 120, 400, dtype=torch.uint8)
            >>> frames = FrameBatch.from_images(image, image, StereoCamera.from_intrinsics(K, 0.54), ground=1.65)
            >>> frames.sizes, frames.frame_ids
            (tensor([[120, 400]]), ('000000',))
        """
        left, right = (
            _as_images(name, images, camera.K_left)
            for name, images in (("images_left", images_left), ("images_right", images_right))
        )
        count, like = len(left), camera.K_left
        if camera.num_frames == 1 and camera.disparity_field is None:
            camera = StereoCamera(
                camera.K_left.expand(count, 3, 3),
                camera.K_right.expand(count, 3, 3),
                camera.T_right_cam.expand(count, 4, 4),
                camera.t_cam_ref.expand(count, 3),
            )
        if not isinstance(ground, GroundPlane):
            ground = GroundPlane.from_camera_height(ground, count).to(like.device, like.dtype)
        sizes = torch.tensor([left.shape[2:]] * count, device=left.device).reshape(count, 2)
        names = tuple(f"{number:06d}" for number in range(count)) if frame_ids is None else tuple(frame_ids)
        return cls(left, right, sizes, camera, ground, names)

    def __len__(self) -> int:
        return len(self.images_left)


@dataclass(frozen=True)
class Occluders(TensorRecord):
    """M further instances (any class) that may hide cars; the detections themselves need not be repeated here.

    Attributes:
        frame_index: (M,) int64 or int32.
        mask_left, mask_right: (M, H, W), bool or foreground probability in [0, 1]; 0 beyond the frame's own size.
        depth_m: (M,) distance along the optical axis, NaN where unknown.
        bottom_v: (M,) lower edge of the 2D box in the left image, pixels.
    """

    frame_index: Annotated[Tensor, Dense("M", kind="index")]
    mask_left: Annotated[Tensor, Dense("M", "H", "W", kind="mask")]
    mask_right: Annotated[Tensor, Dense("M", "H", "W", kind="mask")]
    depth_m: Annotated[Tensor, Dense("M")]
    bottom_v: Annotated[Tensor, Dense("M")]


@dataclass(frozen=True)
class Detections(TensorRecord):
    """B rough 3D boxes with instance masks, over all frames of a call, in any order.

    Attributes:
        frame_index: (B,) int64 or int32, the frame of each object.
        T_cam_obj: (B, 4, 4) initial pose, object to left camera (KITTI's object frame: x forward, y down, origin on
            the ground under the box centre). A row with NaN is a car that is not refined.
        dimensions_hwl: (B, 3) height, width, length of the initial box, metres, above 0; a car with NaN fails alone.
        box_2d: (B, 4) left-image box (u_min, v_min, u_max, v_max), pixels.
        score: (B,) the detector's score, any scale.
        mask_left, mask_right: (B, H, W) foreground probability in [0, 1], floating point or bool. 0 beyond the frame's
            own size, for extents and areas of masks count the padding too.
        has_mask_left, has_mask_right: (B,) bool; a mask that is absent is never read.
        occluders: other instances that may hide the cars, or None.
        pose_sigma: (B, 4) standard deviations of the detector's own error: along the viewing ray of the object origin
            (in the plane of the camera's x and z axes), across it in that plane, along the camera's y axis (metres),
            and of the heading (radians). Infinity where not known. None: the settings' (`priors.pose_sigma_*`), if any;
            collated with frames that have some, infinity stands for none.
        offset_sigma_px: (B,) standard deviation of the rig's disparity at each car about its calibration, pixels of
            full resolution; 0 where it is known. None: the settings' (`rig.disparity_sigma_px`); collated with frames
            that have some, 0 stands for none.

    Raises:
        InputError: wrong shapes or types, a rotation that is none, dimensions or standard deviations that are not
            above 0, or an `offset_sigma_px` that is below 0 or not finite. Masks with values above 1.5 (logits, 0..255)
            are refused when they are read, in a refinement.
    """

    frame_index: Annotated[Tensor, Dense("B", kind="index")]
    T_cam_obj: Annotated[Tensor, Dense("B", 4, 4)]
    dimensions_hwl: Annotated[Tensor, Dense("B", 3)]
    box_2d: Annotated[Tensor, Dense("B", 4)]
    score: Annotated[Tensor, Dense("B")]
    mask_left: Annotated[Tensor, Dense("B", "H", "W", kind="mask", cure="absent masks: zeros, and has_mask_left False")]
    mask_right: Annotated[
        Tensor, Dense("B", "H", "W", kind="mask", cure="absent masks: zeros, and has_mask_right False")
    ]
    has_mask_left: Annotated[Tensor, Dense("B", kind="flags")]
    has_mask_right: Annotated[Tensor, Dense("B", kind="flags")]
    occluders: Occluders | None = None
    pose_sigma: Annotated[Tensor | None, Dense("B", 4)] = None
    offset_sigma_px: Annotated[Tensor | None, Dense("B")] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_type("occluders", self.occluders, (Occluders, NoneType))
        has_pose = self.T_cam_obj.isfinite().flatten(1).all(dim=1)
        T_known = torch.where(has_pose[:, None, None], self.T_cam_obj, torch.eye(4).to(self.T_cam_obj))
        # One wait for the device for both. Dimensions that are NaN pass: they fail their own car.
        if bool((is_no_rotation(T_known) | (self.dimensions_hwl <= 0).any(dim=1).to(T_known.device)).any()):
            check_rotation("T_cam_obj", T_known)
            _raise_not_positive("dimensions_hwl", self.dimensions_hwl)
        if self.pose_sigma is not None:
            check_sigmas("pose_sigma", self.pose_sigma)
        if self.offset_sigma_px is not None:
            wrong = (~((self.offset_sigma_px >= 0) & self.offset_sigma_px.isfinite())).nonzero()[:, 0].tolist()
            if wrong:
                got = f"{float(self.offset_sigma_px[wrong[0]]):g} in row {wrong[0]}"
                cure = "give 0 for cars at which the rig's disparity is known"
                raise InputError("offset_sigma_px", "finite standard deviations of at least 0, pixels", got, cure)

    @classmethod
    def from_boxes(
        cls,
        boxes: Tensor,  # (B, 7) or (B, 8, 3)
        convention: BoxFormat = "kitti",
        *,
        mask_left: Masks | None = None,
        mask_right: Masks | None = None,
        has_mask_left: Tensor | None = None,
        has_mask_right: Tensor | None = None,
        frame_index: Tensor | None = None,
        score: Tensor | None = None,
        box_2d: Tensor | None = None,
        T_cam_boxes: Tensor | None = None,
        occluders: Occluders | None = None,
        pose_sigma: Tensor | None = None,
    ) -> Detections:
        """From boxes as a detector writes them, and the masks that there are.

        Args:
            boxes: x, y, z, three sizes and heading, or corners, in metres and radians; what they mean, and in which
                order, says the convention (`directshape_torch.geometry.box_formats`).
            convention: "kitti", "mmdet3d_camera", "mmdet3d_lidar", "nuscenes" or "opencv".
            mask_left, mask_right: (B, H, W) bool, uint8 (0 and 1, or 0..255) or foreground probability; or B entries
                that are (H, W) or None. One of the two images is enough.
            has_mask_left, has_mask_right: (B,) bool; default: where a mask has any pixel.
            frame_index: (B,) default all 0.
            score: (B,) default all 1.
            box_2d: (B, 4) u_min, v_min, u_max, v_max of the left image; default: around the left mask, or
                where there is none around the right one, which is as high.
            T_cam_boxes: rigid motion from the frame of the boxes to the left camera, (4, 4) or (B, 4, 4). Camera
                conventions do without where the boxes are in the left camera's frame; boxes in KITTI's own frame of
                labels bring `camera.T_cam_ref`; LiDAR boxes need camera_from_lidar.
            occluders, pose_sigma: as in the class.

        Raises:
            InputError: no masks at all, LiDAR boxes without `T_cam_boxes`, corners that make no box, and what the class
                raises.

        Examples:
            >>> boxes = torch.tensor([[1.0, 0.85, 20.0, 4.0, 1.6, 1.5, 0.3]])
            >>> mask = torch.zeros(1, 120, 400, dtype=torch.uint8)
            >>> mask[0, 50:80, 100:180] = 255
            >>> detections = Detections.from_boxes(boxes, "opencv", mask_left=mask)
            >>> detections.T_cam_obj[0, :3, 3], detections.box_2d
            (tensor([ 1.0000,  1.6000, 20.0000]), tensor([[100.,  50., 179.,  79.]]))
        """
        T_cam_obj, dimensions_hwl = boxes_to_poses(boxes, convention, T_cam_boxes)
        count, given = len(boxes), {"mask_left": mask_left, "mask_right": mask_right}
        stacked = {name: _stacked(name, masks, count) for name, masks in given.items() if masks is not None}
        if not stacked:
            cure = "give mask_left, mask_right, or both; a car without a mask cannot be refined"
            raise InputError("mask_left", f"masks of {count} cars in one image at least", "None", cure)
        none = torch.zeros_like(next(iter(stacked.values())), dtype=torch.bool)
        left, right = (stacked.get(name, none) for name in given)
        has_left = left.flatten(1).any(dim=1) if has_mask_left is None else has_mask_left
        has_right = right.flatten(1).any(dim=1) if has_mask_right is None else has_mask_right
        if box_2d is None:
            box_2d = torch.where(left.flatten(1).any(dim=1)[:, None], boxes_around(left), boxes_around(right)).to(boxes)
        return cls(
            frame_index=torch.zeros(count, dtype=torch.long, device=boxes.device)
            if frame_index is None
            else frame_index,
            T_cam_obj=T_cam_obj,
            dimensions_hwl=dimensions_hwl,
            box_2d=box_2d,
            score=boxes.new_ones(count) if score is None else score,
            mask_left=left,
            mask_right=right,
            has_mask_left=has_left,
            has_mask_right=has_right,
            occluders=occluders,
            pose_sigma=pose_sigma,
        )

    def __len__(self) -> int:
        return len(self.frame_index)


def _as_images(name: str, images: Tensor, like: Tensor) -> Tensor:
    """RGB (F, 3, H, W) in [0, 1], of the dtype of `like` where they were bytes."""
    shape = (3, "H", "W") if isinstance(images, Tensor) and images.ndim == 3 else ("F", 3, "H", "W")
    is_bytes = isinstance(images, Tensor) and images.dtype == torch.uint8
    check_shape(name, images, shape, "colours come first: image.permute(2, 0, 1)", "number" if is_bytes else "image")
    images = images if images.ndim == 4 else images[None]
    return images.to(like.dtype) / 255 if is_bytes else images


def _stacked(name: str, masks: Masks, count: int) -> Tensor:
    """Masks (B, H, W) in bool or floating point."""
    if not isinstance(masks, Tensor):
        present = [mask for mask in masks if mask is not None]
        if len(masks) != count or not present or len({mask.shape for mask in present}) > 1:
            got = f"{len(masks)} entries of sizes {sorted({tuple(mask.shape) for mask in present})}"
            raise InputError(name, f"{count} masks of one size (H, W), or None where a car has none", got)
        masks = torch.stack([torch.zeros_like(present[0]) if mask is None else mask for mask in masks])
    if masks.dtype == torch.uint8:
        check_shape(name, masks, (count, "H", "W"))
        # 0 and 1, or shades of grey.
        return masks.bool() if not masks.numel() or int(masks.max()) <= 1 else masks.float() / 255
    check_shape(name, masks, (count, "H", "W"), kind="mask")
    return masks


def boxes_around(
    masks: Tensor,  # (B, H, W)
) -> Tensor:
    """u_min, v_min, u_max, v_max (B, 4) of the pixels above 0.5, float64; NaN without any."""
    inside = masks if masks.dtype == torch.bool else masks > 0.5
    spans = []
    for axis in (1, 2):  # columns, then rows
        seen = inside.any(dim=axis).int()
        first, last = seen.argmax(dim=1), seen.shape[1] - 1 - seen.flip(1).argmax(dim=1)
        spans.append(torch.stack([first, last], dim=1).double())
    box = torch.stack(spans, dim=2).flatten(1)
    return torch.where(inside.flatten(1).any(dim=1)[:, None], box, torch.nan)


def _intrinsics(name: str, K: Tensor) -> Tensor:
    """Of F frames, (F, 3, 3)."""
    shape = (3, 3) if isinstance(K, Tensor) and K.ndim == 2 else ("F", 3, 3)
    check_shape(name, K, shape, kind="floating")
    K = K if K.ndim == 3 else K[None]
    last_row = K.new_tensor([0.0, 0.0, 1.0])
    if not bool(((K[:, 2] == last_row).all(1) & (K[:, 1, 0] == 0) & (K[:, 0, 0] > 0) & (K[:, 1, 1] > 0)).all()):
        raise InputError(name, "[[fx, s, cx], [0, fy, cy], [0, 0, 1]], pixels", f"{K.tolist()}", "mind its transpose")
    return K


def _check_type(name: str, value: object, kinds: tuple[type, ...]) -> None:
    if not isinstance(value, kinds):
        raise InputError(name, f"a {kinds[0].__name__}", type(value).__name__)


def _check_words(name: str, words: object, count: int, what: str) -> None:
    if not isinstance(words, (tuple, list)) or not all(isinstance(word, str) for word in words):
        raise InputError(name, f"a tuple of {count} {what}", type(words).__name__)
    if len(words) != count:
        raise InputError(name, f"{count} {what}", f"{len(words)}")


def _raise_not_positive(
    name: str,
    dimensions: Tensor,  # (B, 3)
) -> None:
    row = int((dimensions <= 0).any(dim=1).int().argmax())
    got = f"{dimensions[row].tolist()} in row {row}"
    raise InputError(name, "height, width and length above 0, metres", got, "leave out objects without a 3D box")


def _translation(
    name: str,
    P: Tensor,  # (F, 3, 4)
) -> Tensor:
    """`K^-1 P[:, 3]`, (F, 3)."""
    try:
        t: Tensor = torch.linalg.solve(P[..., :3], P[..., 3:])[..., 0]
        return t
    except torch.linalg.LinAlgError as error:  # type: ignore[attr-defined]
        cure = "give the projections of the rectified cameras (KITTI: P2 and P3)"
        raise InputError(name, "intrinsics K = P[:, :3] that can be inverted", "a singular K", cure) from error


def _pinhole(name: str, camera: object) -> kornia_camera.PinholeCamera:
    if not isinstance(camera, kornia_camera.PinholeCamera):
        expected = "kornia's PinholeCamera" + (" beside the left one" if name == "right" else " or StereoCamera")
        raise InputError(name, expected, type(camera).__name__, "for matrices there is from_projections")
    check_shape(f"{name}.intrinsics", camera.intrinsics, ("F", 4, 4), "give one camera a frame")
    check_shape(f"{name}.rt_matrix", camera.rt_matrix, (len(camera.intrinsics), 3, 4), "give one camera a frame")
    if camera.intrinsics.dtype not in (torch.float32, torch.float64):
        raise InputError(name, "float32 or float64", str(camera.intrinsics.dtype), "convert its matrices")
    check_rotation(name, camera.rt_matrix)
    return camera


def _check_alike(left: kornia_camera.PinholeCamera, right: kornia_camera.PinholeCamera) -> None:
    for what, of in (
        ("frames", lambda camera: camera.batch_size),
        ("dtype", lambda camera: camera.intrinsics.dtype),
        ("device", lambda camera: camera.device()),
        ("(height, width)", lambda camera: torch.stack([camera.height, camera.width], dim=1).tolist()),
    ):
        if of(left) != of(right):
            cure = "give both cameras of every frame, of images rectified to one size"
            raise InputError("right", f"the {what} of the left camera: {of(left)}", f"{of(right)}", cure)


def _between_rectified(left: kornia_camera.PinholeCamera, right: kornia_camera.PinholeCamera) -> Tensor:
    """`T_right_cam` (F, 4, 4), in float64 on the way: their world may be far away."""
    R = right.rotation_matrix.double() @ left.rotation_matrix.double().mT
    t = (right.translation_vector.double() - R @ left.translation_vector.double())[..., 0]
    turn = (R - torch.eye(3).to(R)).detach().abs().amax(dim=(1, 2))
    offset = t.detach()[:, 1:].abs().amax(dim=1)
    askew = (turn > _LARGEST_TURN) | (offset > _LARGEST_OFFSET * t.detach()[:, 0].abs())
    if askew.any():
        row = int(askew.int().argmax())
        got = f"a turn by {turn[row]:.2g} and a translation by {[round(x, 4) for x in t[row].tolist()]} m in row {row}"
        cure = "rectify the images, and give the cameras of the rectified ones (cv2.stereoRectify)"
        raise InputError("right", "a rectified pair: parallel cameras, side by side", got, cure)
    return from_rotation_translation(R, t).to(right.intrinsics.dtype)


def _check_brightness(name: str, images: Tensor) -> None:
    """Values that are not finite are left to the refinement, which fails the cars that need them."""
    if not images.numel():
        return
    values = images.detach()
    darkest, brightest = torch.stack(values.aminmax()).tolist()
    if not math.isfinite(brightest - darkest):
        # One NaN hides all other values, but to copy the images for that is worth it only where there is one.
        finite = values.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
        darkest, brightest = torch.stack(finite.aminmax()).tolist()
    if darkest < _DARKEST:
        cure = "undo the normalisation: images are RGB in [0, 1]"
        raise InputError(name, "values in [0, 1]", f"a value of {darkest:g}", cure)
    if brightest > _BRIGHTEST:
        raise InputError(name, "values in [0, 1]", f"a value of {brightest:g}", "divide by 255")
