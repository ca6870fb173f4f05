"""Opens a stereo data set by the name of its layout."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal, Unpack, get_args

from directshape_torch.errors import InputError
from directshape_torch.io.folder_layout import FolderLayout
from directshape_torch.io.frame_layout import FrameLayout
from directshape_torch.io.instance_masks import MaskSource
from directshape_torch.io.kitti_layout import object_layout, raw_layout, stereo2015_layout, tracking_layout
from directshape_torch.io.stereo_files import DatasetOptions, FileStereoDataset

LayoutName = Literal["kitti", "raw", "tracking", "stereo2015", "folder"]
_LAYOUTS: dict[LayoutName, Callable[..., FrameLayout]] = {
    "kitti": object_layout,
    "raw": raw_layout,
    "tracking": tracking_layout,
    "stereo2015": stereo2015_layout,
    "folder": FolderLayout,
}


def open_dataset(
    layout: LayoutName,
    root: Path | str,
    detections_dir: Path | str | None = None,
    masks: Path | str | MaskSource | None = None,
    **options: Unpack[DatasetOptions],
) -> FileStereoDataset:
    """The data set of that layout (docs/inputs.md).

    Args:
        layout: "kitti" (object benchmark), "raw", "tracking", "stereo2015" or "folder".
        root: folder of the data.
        detections_dir: folder of detections; None for "folder" only: `root/frames`.
        masks: folder of masks, a `MaskSource`, or None: those of a "folder", else none.
        options: see `FileStereoDataset`: split, frames, classes, ground, camera_height_m, disparity_field,
            disparity_dir, lidar_dir, dtype.

    Raises:
        DataFormatError: a folder is missing or not laid out so.
        InputError: an unknown layout, no detections, or no frames.
    """
    if layout not in get_args(LayoutName):
        raise InputError("layout", f"one of {', '.join(get_args(LayoutName))}", repr(layout))
    if detections_dir is None and layout != "folder":
        raise InputError("detections", f"a folder of detections for the layout {layout!r}", "none", "--detections DIR")
    return FileStereoDataset(_LAYOUTS[layout](root, detections_dir), masks, **options)
