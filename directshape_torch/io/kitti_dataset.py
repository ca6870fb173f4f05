"""Stereo frames in KITTI's object layout, with detections and masks, as the tensors a refinement takes."""

from __future__ import annotations

from pathlib import Path
from typing import Unpack

from directshape_torch.io.instance_masks import MaskSource
from directshape_torch.io.kitti_layout import object_layout
from directshape_torch.io.stereo_files import DatasetOptions, FileStereoDataset


class KittiStereoDataset(FileStereoDataset):
    """Frames of `root/training` (image_2, image_3, calib, label_2, planes) with a detector's results and masks.

    Args:
        root: folder that holds `training`.
        detections_dir: folder of `NNNNNN.txt` result files, or the one above a folder `data` with them.
        masks: folder of masks (see `mask_source`), a `MaskSource`, or None: then no car has a mask.
        options: `split`, `frames`, `classes`, `ground`, `camera_height_m`, `disparity_field`, `disparity_dir`,
            `lidar_dir`, `dtype`, as `FileStereoDataset` has them.

    Raises:
        DataFormatError: a folder or the split file is missing.
        InputError: no frames, frames without a detection file, or an unknown `ground`.
    """

    def __init__(
        self,
        root: Path | str,
        detections_dir: Path | str,
        masks: Path | str | MaskSource | None = None,
        **options: Unpack[DatasetOptions],
    ) -> None:
        super().__init__(object_layout(root, detections_dir), masks, **options)
