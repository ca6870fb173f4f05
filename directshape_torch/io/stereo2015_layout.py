"""The layout of KITTI Stereo 2015 (and Scene Flow 2015): two consecutive pairs a scene, `_10` and `_11`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from directshape_torch.errors import DataFormatError
from directshape_torch.io.frame_layout import detection_stems, existing_folder, first_existing
from directshape_torch.io.image_files import find_image
from directshape_torch.io.instance_masks import InstanceMask, MaskSource, file_of_frame
from directshape_torch.io.kitti_labels import KittiObject, read_objects
from directshape_torch.io.kitti_text_layout import KittiTextLayout
from directshape_torch.io.mask_files import InstancePngMasks, mask_source

FIRST_PAIR = "_10"


class Stereo2015Layout(KittiTextLayout):
    """`root/training` (or `testing`) with image_2, image_3 and calib_cam_to_cam; frames are called `NNNNNN_10`.

    Detections, masks and planes of the first pair may be called by the scene alone, `NNNNNN`, too.

    Args:
        root: folder that holds `training` or `testing`, or one of these.
        detections_dir: folder of result files, or the one above a folder `data` with them.

    Raises:
        DataFormatError: a folder is missing.
    """

    detection_file_name = "NNNNNN_10.txt"

    def __init__(self, root: Path | str, detections_dir: Path | str) -> None:
        candidates = [Path(root) / "training", Path(root) / "testing", Path(root)]
        found = [folder for folder in candidates if (folder / "calib_cam_to_cam").is_dir()]
        if not found:
            raise DataFormatError(
                root,
                "holds no [training/]calib_cam_to_cam as KITTI Stereo 2015 does",
                cure="check the path or --layout",
            )
        self.folder = found[0]
        self.detections_dir = existing_folder(Path(detections_dir), "is no folder of detections")

    def frame_ids(self) -> list[str]:
        """Every pair that has a detection file."""
        return sorted({_full_name(stem) for stem in detection_stems(self.detections_dir)})

    def frame_id(self, number: int) -> str:
        """The first pair of a scene."""
        return f"{number:06d}{FIRST_PAIR}"

    def images(self, frame_id: str) -> tuple[Path, Path]:
        """Left and right image."""
        return find_image(self.folder / "image_2", frame_id), find_image(self.folder / "image_3", frame_id)

    def calibration_path(self, frame_id: str) -> Path:
        """One calibration a scene."""
        return self.folder / "calib_cam_to_cam" / f"{frame_id.partition('_')[0]}.txt"

    def detection_path(self, frame_id: str) -> Path:
        """One file a pair."""
        return first_existing([file_of_frame(self.detections_dir, f"{name}.txt") for name in names_of(frame_id)])

    def objects(self, frame_id: str) -> list[KittiObject]:
        """The detections of a pair."""
        return read_objects(self.detection_path(frame_id))

    def labels(self, frame_id: str) -> list[KittiObject] | None:
        """None: the benchmark has no boxes."""
        return None

    def disparity_path(self, folder: Path, frame_id: str) -> Path:
        """As in submissions to the benchmark, `NNNNNN_10.png`."""
        return folder / f"{frame_id}.png"

    def masks(self, directory: Path | None) -> MaskSource | None:
        """See `mask_source`; no masks come with the layout itself."""
        return None if directory is None else SceneMasks(directory, mask_source(directory))

    def plane_file(self, frame_id: str) -> Path:
        """One plane a pair."""
        return first_existing([self.folder / "planes" / f"{name}.txt" for name in names_of(frame_id)])


@dataclass(frozen=True)
class SceneMasks:
    """Masks in files called by the pair, `NNNNNN_10`, or for the first pair by its scene.

    Attributes:
        directory: the folder of masks.
        source: its reader.
    """

    directory: Path
    source: MaskSource

    def read(self, frame_id: str, size_hw: tuple[int, int]) -> list[InstanceMask]:
        return self.source.read(self._name(frame_id), size_hw)

    def files(self, frame_id: str) -> tuple[Path, ...]:
        return self.source.files(self._name(frame_id))

    def _name(self, frame_id: str) -> str:
        def exists(name: str) -> bool:
            if isinstance(self.source, InstancePngMasks):
                return find_image(self.directory / self.source.folders[0], name).is_file()
            return file_of_frame(self.directory, f"{name}.json").is_file()

        return next((name for name in names_of(frame_id) if exists(name)), frame_id)


def names_of(frame_id: str) -> tuple[str, ...]:
    """What the files of a pair may be called.

    Examples:
        >>> names_of("000046_10"), names_of("000046_11")
        (('000046_10', '000046'), ('000046_11',))
    """
    return (frame_id, frame_id.removesuffix(FIRST_PAIR)) if frame_id.endswith(FIRST_PAIR) else (frame_id,)


def _full_name(stem: str) -> str:
    return stem if "_" in stem else f"{stem}{FIRST_PAIR}"
