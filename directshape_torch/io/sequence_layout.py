"""Sequences of stereo frames: KITTI's tracking benchmark and its raw recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.io.frame_layout import (
    detection_stems,
    existing_folder,
    first_disparity,
    first_existing,
    image_stems,
)
from directshape_torch.io.image_files import find_image
from directshape_torch.io.instance_masks import InstanceMask, MaskSource, file_of_frame
from directshape_torch.io.kitti_calibration import KittiCalibration, read_velo_to_cam
from directshape_torch.io.kitti_labels import KittiObject, read_objects
from directshape_torch.io.kitti_text_layout import KittiTextLayout
from directshape_torch.io.mask_files import FrameJsonMasks, mask_source
from directshape_torch.io.timestamp_files import read_timestamps
from directshape_torch.io.tracking_files import read_tracking_objects


@dataclass(frozen=True)
class SequenceFolders:
    """Where the files of one sequence are.

    Attributes:
        name: of the sequence, such as "0005" or "2011_09_26_drive_0005_sync".
        left, right: folders of images.
        calibration: file with P2 and P3, or P_rect_02 and P_rect_03.
        planes: folder of plane files, which need not exist.
        scans: folder of LiDAR scans, which need not exist.
        labels: label file of the tracking benchmark, which need not exist; None where the layout has none.
        velo_to_cam: file that places the LiDAR; None: the calibration does.
    """

    name: str
    left: Path
    right: Path
    calibration: Path
    planes: Path
    scans: Path
    labels: Path | None = None
    velo_to_cam: Path | None = None


class SequenceLayout(KittiTextLayout):
    """One sequence, whose frames are called as their images are, or several, with `SEQUENCE_` before that.

    Args:
        sequences: see `tracking_sequences` and `raw_sequences`.
        detections_dir: holds `NNNNNN.txt` or `data/NNNNNN.txt` (one sequence), or for several `SEQUENCE/NNNNNN.txt`,
            `SEQUENCE/data/NNNNNN.txt` or `data/SEQUENCE_NNNNNN.txt`; in either case also `SEQUENCE.txt`, a result or
            label file of the tracking benchmark.
        single: whether there is no prefix.
        digits: of a frame's number.

    Raises:
        DataFormatError: there is no such folder.
    """

    detection_file_name = "NNNNNN.txt or SEQUENCE.txt"

    def __init__(
        self, sequences: Sequence[SequenceFolders], detections_dir: Path | str, *, single: bool, digits: int
    ) -> None:
        self.detections_dir = existing_folder(Path(detections_dir), "is no folder of detections")
        self._sequences = {sequence.name: sequence for sequence in sequences}
        self._single, self._digits = single, digits
        self._tracking: dict[Path, dict[int, list[KittiObject]]] = {}
        self._times_s: dict[Path, list[float]] = {}

    def frame_ids(self) -> list[str]:
        """The frames with a detection file, or all of the sequences that have one of the tracking benchmark."""
        stems = detection_stems(self.detections_dir)
        return [self._join(name, stem) for name in sorted(self._sequences) for stem in self._stems(name, stems)]

    def frame_id(self, number: int) -> str:
        """Of one sequence; of several, a number alone names no frame."""
        if not self._single:
            known = next(iter(sorted(self._sequences)))
            raise InputError(
                "frames",
                f"names as {self._join(known, self._stem(number))}, for there are several sequences",
                f"{number}",
            )
        return self._stem(number)

    def images(self, frame_id: str) -> tuple[Path, Path]:
        """Left and right image."""
        sequence, stem = self._split(frame_id)
        return find_image(sequence.left, stem), find_image(sequence.right, stem)

    def calibration_path(self, frame_id: str) -> Path:
        """One calibration a sequence, or a day."""
        return self._split(frame_id)[0].calibration

    def plane_file(self, frame_id: str) -> Path:
        """One plane a frame."""
        sequence, stem = self._split(frame_id)
        return sequence.planes / f"{stem}.txt"

    def scan_file(self, frame_id: str) -> Path:
        """One scan a frame."""
        sequence, stem = self._split(frame_id)
        return sequence.scans / f"{stem}.bin"

    def scan(self, frame_id: str) -> tuple[Path, KittiCalibration] | None:
        """Raw recordings have a file of its own for the place of the LiDAR; without it a scan is of no use."""
        velo_to_cam = self._split(frame_id)[0].velo_to_cam
        return None if velo_to_cam is not None and not velo_to_cam.is_file() else super().scan(frame_id)

    def lidar_files(self, folder: Path, frame_id: str) -> dict[str, Path]:
        """`folder/NNNNNN.bin`, of several sequences `folder/SEQUENCE/NNNNNN.bin`; raw: the scanner's place too."""
        sequence, stem = self._split(frame_id)
        place = {} if sequence.velo_to_cam is None else {"lidar_calibration": sequence.velo_to_cam}
        return {"lidar": (folder if self._single else folder / sequence.name) / f"{stem}.bin", **place}

    def lidar_calibration(self, frame_id: str) -> KittiCalibration:
        """The matrices of the calibration file, in raw recordings with those of the file beside it."""
        calibration, velo_to_cam = self.calibration(frame_id), self._split(frame_id)[0].velo_to_cam
        return (
            calibration if velo_to_cam is None else replace(calibration, Tr_velo_to_cam=read_velo_to_cam(velo_to_cam))
        )

    def detection_path(self, frame_id: str) -> Path:
        """The frame's own file where there is one, else its sequence's."""
        sequence, stem = self._split(frame_id)
        own = [] if self._single else [file_of_frame(self.detections_dir / sequence.name, f"{stem}.txt")]
        own.append(file_of_frame(self.detections_dir, f"{frame_id}.txt"))
        whole = file_of_frame(self.detections_dir, f"{sequence.name}.txt")
        return first_existing([*own, whole])

    def objects(self, frame_id: str) -> list[KittiObject]:
        """The detections of a frame."""
        path = self.detection_path(frame_id)
        sequence, stem = self._split(frame_id)
        return self._tracked(path, stem) if path.stem == sequence.name else read_objects(path)

    def labels(self, frame_id: str) -> list[KittiObject] | None:
        """Those of the sequence's label file, where there is one."""
        sequence, stem = self._split(frame_id)
        if sequence.labels is None or not sequence.labels.is_file():
            return None
        return self._tracked(sequence.labels, stem)

    def sequence_of(self, frame_id: str) -> str:
        """The prefix of the frame, where there are several sequences."""
        return "" if self._single else self._split(frame_id)[0].name

    def disparity_path(self, folder: Path, frame_id: str) -> Path:
        """`folder/NNNNNN.png`, and of several sequences `folder/SEQUENCE/NNNNNN.png`."""
        sequence, stem = self._split(frame_id)
        return first_disparity(folder if self._single else folder / sequence.name, stem)

    def times_s(self, frame_id: str) -> tuple[float, float] | None:
        """From `timestamps.txt` beside the folders of images, as raw recordings have them."""
        sequence, stem = self._split(frame_id)
        both = [folder.parent / "timestamps.txt" for folder in (sequence.left, sequence.right)]
        if sequence.labels is not None or not all(path.is_file() for path in both):
            return None
        left_s, right_s = (self._time(path, int(stem)) for path in both)
        return left_s, right_s

    def masks(self, directory: Path | None) -> MaskSource | None:
        """See `mask_source` for one sequence, `SequenceMasks` for several."""
        if directory is None or self._single:
            return super().masks(directory)
        return SequenceMasks(existing_folder(directory, "is not a folder of masks"), tuple(self._sequences))

    def _stems(self, name: str, all_stems: list[str]) -> list[str]:
        """The frames of a sequence that have detections, of which `all_stems` lie directly in their folder."""
        sequence = self._sequences[name]
        if file_of_frame(self.detections_dir, f"{name}.txt").is_file():
            return image_stems(sequence.left)
        if self._single:
            return all_stems
        prefix = f"{name}_"
        found = set(detection_stems(self.detections_dir / name))
        found |= {stem.removeprefix(prefix) for stem in all_stems if stem.startswith(prefix)}
        return sorted(found)

    def _tracked(self, path: Path, stem: str) -> list[KittiObject]:
        """The lines of one frame; such files hold a whole sequence, so each is read once."""
        if path not in self._tracking:
            self._tracking[path] = read_tracking_objects(path)
        return self._tracking[path].get(int(stem), [])

    def _time(self, path: Path, number: int) -> float:
        if path not in self._times_s:
            self._times_s[path] = read_timestamps(path)
        times_s = self._times_s[path]
        if number >= len(times_s):
            raise DataFormatError(path, f"has {len(times_s)} times, none for frame {number}", cure="one line a frame")
        return times_s[number]

    def _stem(self, number: int) -> str:
        return f"{number:0{self._digits}d}"

    def _join(self, name: str, stem: str) -> str:
        return stem if self._single else f"{name}_{stem}"

    def _split(self, frame_id: str) -> tuple[SequenceFolders, str]:
        if self._single:
            return next(iter(self._sequences.values())), frame_id
        name, _, stem = frame_id.rpartition("_")
        if name not in self._sequences:
            raise InputError("frame_id", "SEQUENCE_NNNNNN with a sequence of the data", repr(frame_id))
        return self._sequences[name], stem


@dataclass(frozen=True)
class SequenceMasks:
    """Masks of several sequences: a folder (see `mask_source`) for each, or `SEQUENCE_NNNNNN.json` for all.

    Attributes:
        directory: holds them.
        sequences: names of the sequences.
    """

    directory: Path
    sequences: tuple[str, ...]

    def read(self, frame_id: str, size_hw: tuple[int, int]) -> list[InstanceMask]:
        source, name = self._of(frame_id)
        return source.read(name, size_hw)

    def files(self, frame_id: str) -> tuple[Path, ...]:
        source, name = self._of(frame_id)
        return source.files(name)

    def _of(self, frame_id: str) -> tuple[MaskSource, str]:
        name, _, stem = frame_id.rpartition("_")
        if name in self.sequences and (self.directory / name).is_dir():
            return mask_source(self.directory / name), stem
        return FrameJsonMasks(self.directory), frame_id


def tracking_layout(root: Path | str, detections_dir: Path | str) -> SequenceLayout:
    """A tracking sequence (`root/image_02/NNNNNN.png`, `image_03`, `calib.txt`, `label_02.txt`, `planes`), or the
    benchmark (`root/training` or `root` with `image_02/SEQUENCE/NNNNNN.png`, `image_03`, `calib/SEQUENCE.txt` ..).

    Raises:
        DataFormatError: neither.
    """
    root = Path(root)
    if image_stems(root / "image_02"):
        own = SequenceFolders(
            root.resolve().name,
            root / "image_02",
            root / "image_03",
            root / "calib.txt",
            root / "planes",
            root / "velodyne",
            root / "label_02.txt",
        )
        return SequenceLayout([own], detections_dir, single=True, digits=6)
    base = root / "training" if (root / "training" / "image_02").is_dir() else root
    names = sorted(path.name for path in (base / "image_02").glob("*") if path.is_dir())
    if not names:
        raise DataFormatError(
            root,
            "holds neither image_02/NNNNNN.png nor [training/]image_02/SEQUENCE/NNNNNN.png",
            cure="give a sequence or the folder of KITTI's tracking benchmark, or another --layout",
        )
    sequences = [
        SequenceFolders(
            name,
            base / "image_02" / name,
            base / "image_03" / name,
            base / "calib" / f"{name}.txt",
            base / "planes" / name,
            base / "velodyne" / name,
            base / "label_02" / f"{name}.txt",
        )
        for name in names
    ]
    return SequenceLayout(sequences, detections_dir, single=False, digits=6)


def raw_layout(root: Path | str, detections_dir: Path | str) -> SequenceLayout:
    """A rectified drive of KITTI's raw data (`root/image_02/data/NNNNNNNNNN.png`, `image_03`; calibration in
    `calib_cam_to_cam.txt` beside or in it), or a folder of such drives, of one day or of days.

    Raises:
        DataFormatError: neither.
    """
    root = Path(root)
    if (root / "image_02" / "data").is_dir():
        return SequenceLayout([_drive(root)], detections_dir, single=True, digits=10)
    drives = sorted({path.parents[1] for depth in ("*", "*/*") for path in root.glob(f"{depth}/image_02/data")})
    if not drives:
        raise DataFormatError(
            root,
            "holds neither image_02/data nor drives with image_02/data",
            cure="give a folder such as 2011_09_26_drive_0005_sync or the one above it, or another --layout",
        )
    return SequenceLayout([_drive(drive) for drive in drives], detections_dir, single=False, digits=10)


def _drive(folder: Path) -> SequenceFolders:
    images = (folder / "image_02" / "data", folder / "image_03" / "data")
    inside = folder / "calib_cam_to_cam.txt"
    calibration = inside if inside.is_file() else folder.resolve().parent / "calib_cam_to_cam.txt"
    return SequenceFolders(
        folder.resolve().name,
        *images,
        calibration,
        folder / "planes",
        folder / "velodyne_points" / "data",
        velo_to_cam=calibration.with_name("calib_velo_to_cam.txt"),
    )
