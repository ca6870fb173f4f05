"""Stereo frames in KITTI's object layout, with detections and masks, as the tensors a refinement takes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import torch

from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.io.instance_masks import MaskSource
from directshape_torch.io.kitti_layout import KittiObjectLayout
from directshape_torch.io.stereo_dataset import GroundSource, LoadedFrame
from directshape_torch.io.stereo_files import DEFAULT_CAMERA_HEIGHT_M, FileStereoDataset

__all__ = ["DEFAULT_CAMERA_HEIGHT_M", "GroundSource", "KittiStereoDataset", "LoadedFrame"]


class KittiStereoDataset(FileStereoDataset):
    """Frames of `root/training` (image_2, image_3, calib, label_2, planes) with a detector's results and masks.

    Args:
        root: folder that holds `training`.
        detections_dir: folder of `NNNNNN.txt` result files, or the one above a folder `data` with them.
        masks: folder of masks (see `mask_source`), a `MaskSource`, or None: then no car has a mask.
        split: file with one frame id a line; default every frame that has a detection file.
        frames: ids of the frames to use, of those.
        classes: object types to refine; other lines are copied.
        ground: where ground planes come from: "auto" is file, else stereo, else camera height; with a disparity
            field stereo comes first, for plane files share the bias of the disparities they were made from.
        camera_height_m: height of the camera above a level ground, the last resort.
        disparity_field: residual disparity of the rig, or None.
        disparity_dir: folder of `NNNNNN.png` (or `NNNNNN_10.png`) with the disparity maps of any stereo method, for the
            methods that fit a point cloud; None: they match the images themselves.
        dtype: of the tensors.

    Raises:
        DataFormatError: a folder or the split file is missing.
        InputError: no frames, frames without a detection file, or an unknown `ground`.
    """

    def __init__(
        self,
        root: Path | str,
        detections_dir: Path | str,
        masks: Path | str | MaskSource | None = None,
        *,
        split: Path | str | None = None,
        frames: Iterable[str | int] | None = None,
        classes: Sequence[str] = ("Car",),
        ground: GroundSource = "auto",
        camera_height_m: float = DEFAULT_CAMERA_HEIGHT_M,
        disparity_field: DisparityField | None = None,
        disparity_dir: Path | str | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        layout = KittiObjectLayout(root, detections_dir)
        super().__init__(
            layout,
            masks,
            split=split,
            frames=frames,
            classes=classes,
            ground=ground,
            camera_height_m=camera_height_m,
            disparity_field=disparity_field,
            disparity_dir=disparity_dir,
            dtype=dtype,
        )
        self.training = layout.training
