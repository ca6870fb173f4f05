"""The layout of KITTI's object benchmark, which the others of KITTI vary."""

from __future__ import annotations

from pathlib import Path

from directshape_torch.errors import DataFormatError
from directshape_torch.io.frame_layout import detection_stems, existing_folder, first_disparity
from directshape_torch.io.image_files import find_image
from directshape_torch.io.instance_masks import file_of_frame
from directshape_torch.io.kitti_labels import KittiObject, read_objects
from directshape_torch.io.kitti_text_layout import KittiTextLayout


class KittiObjectLayout(KittiTextLayout):
    """`root/training` with image_2, image_3, calib, label_2, planes; detections apart.

    Args:
        root: folder that holds `training`.
        detections_dir: folder of `NNNNNN.txt` result files, or the one above a folder `data` with them.

    Raises:
        DataFormatError: a folder is missing.
    """

    detection_file_name = "NNNNNN.txt"

    def __init__(self, root: Path | str, detections_dir: Path | str) -> None:
        self.training = Path(root) / "training"
        if not self.training.is_dir():
            raise DataFormatError(root, "holds no folder 'training' in KITTI's layout", cure="check the path")
        self.detections_dir = existing_folder(Path(detections_dir), "is no folder of detections")

    def frame_ids(self) -> list[str]:
        """Every frame that has a detection file."""
        return detection_stems(self.detections_dir)

    def frame_id(self, number: int) -> str:
        """Six digits."""
        return f"{number:06d}"

    def images(self, frame_id: str) -> tuple[Path, Path]:
        """Left and right image."""
        return find_image(self.training / "image_2", frame_id), find_image(self.training / "image_3", frame_id)

    def calibration_path(self, frame_id: str) -> Path:
        """One calibration a frame."""
        return self.training / "calib" / f"{frame_id}.txt"

    def plane_file(self, frame_id: str) -> Path:
        """One plane a frame."""
        return self.training / "planes" / f"{frame_id}.txt"

    def scan_file(self, frame_id: str) -> Path:
        """One scan a frame."""
        return self.training / "velodyne" / f"{frame_id}.bin"

    def detection_path(self, frame_id: str) -> Path:
        """One file a frame."""
        return file_of_frame(self.detections_dir, f"{frame_id}.txt")

    def objects(self, frame_id: str) -> list[KittiObject]:
        """The detections of a frame."""
        return read_objects(self.detection_path(frame_id))

    def labels(self, frame_id: str) -> list[KittiObject] | None:
        """The label file, where there is one."""
        path = self.training / "label_2" / f"{frame_id}.txt"
        return read_objects(path, with_score=False) if path.is_file() else None

    def disparity_path(self, folder: Path, frame_id: str) -> Path:
        """The map of the first pair of a scene, or of the frame."""
        return first_disparity(folder, frame_id)
