"""The layouts of KITTI's benchmarks and recordings: one reader, to which each of them is a table of file names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.io.frame_layout import (
    FrameLayout,
    existing_folder,
    first_disparity,
    first_existing,
    image_stems,
)
from directshape_torch.io.image_files import find_image
from directshape_torch.io.instance_masks import InstanceMask, MaskSource, file_of_frame
from directshape_torch.io.kitti_calibration import KittiCalibration, read_calibration, read_plane, read_velo_to_cam
from directshape_torch.io.kitti_labels import FrameObjects, KittiObject, frame_number, read_objects
from directshape_torch.io.mask_files import mask_source
from directshape_torch.io.motion_files import of_line, read_poses, read_times


@dataclass(frozen=True)
class KittiFiles:
    """Where the files of a sequence are, below its folder.

    In names `{stem}` stands for the frame's name in its sequence, `{sequence}` for the name of that, and `{scene}` for
    what comes before the "_" of a stem. All but images and calibration may be missing.
    """

    # Images, without ending.
    left: str
    right: str
    calibration: str  # file with P2 and P3, or P_rect_02 and P_rect_03
    plane: str = "planes/{stem}.txt"
    labels: str = ""  # a file a frame, or without `{stem}` one of the tracking benchmark; "": there are none
    velo_to_cam: str = ""  # file that places the LiDAR; "": the calibration does
    # Times and camera poses of a sequence, a line each from frame 0 on; "": there are none.
    times: str = ""
    trajectory: str = ""
    digits: int = 6  # of a frame's number
    first: str = ""  # what is added to a number alone; files may leave it out


OBJECT = KittiFiles("image_2/{stem}", "image_3/{stem}", "calib/{stem}.txt", labels="label_2/{stem}.txt")
STEREO_2015 = KittiFiles("image_2/{stem}", "image_3/{stem}", "calib_cam_to_cam/{scene}.txt", first="_10")
TRACKING_SEQUENCE = KittiFiles(
    "image_02/{stem}",
    "image_03/{stem}",
    "calib.txt",
    labels="label_02.txt",
    times="times.txt",
    trajectory="poses.txt",
)
TRACKING = KittiFiles(
    "image_02/{sequence}/{stem}",
    "image_03/{sequence}/{stem}",
    "calib/{sequence}.txt",
    "planes/{sequence}/{stem}.txt",
    "label_02/{sequence}.txt",
    times="times/{sequence}.txt",
    trajectory="poses/{sequence}.txt",
)
# In the folder of the day, and with a calibration in the drive itself.
RAW_OF_DAY = KittiFiles(
    "{sequence}/image_02/data/{stem}",
    "{sequence}/image_03/data/{stem}",
    "calib_cam_to_cam.txt",
    "{sequence}/planes/{stem}.txt",
    velo_to_cam="calib_velo_to_cam.txt",
    times="{sequence}/image_02/timestamps.txt",
    trajectory="{sequence}/poses.txt",
    digits=10,
)
RAW = replace(
    RAW_OF_DAY,
    calibration="{sequence}/calib_cam_to_cam.txt",
    velo_to_cam="{sequence}/calib_velo_to_cam.txt",
)


class KittiLayout(FrameLayout):
    """One sequence, whose frames are called as their images are, or several, with `SEQUENCE_` before that.

    Args:
        sequences: for each its folder and the names in it; the single one of a benchmark without sequences is "".
        detections_dir: holds `NNNNNN.txt` or `data/NNNNNN.txt` (one sequence), or for several `SEQUENCE/NNNNNN.txt`,
            `SEQUENCE/data/NNNNNN.txt` or `data/SEQUENCE_NNNNNN.txt`; in either case also `SEQUENCE.txt`, a result or
            label file of the tracking benchmark.
        single: whether there is no prefix.
    """

    def __init__(
        self, sequences: Mapping[str, tuple[Path, KittiFiles]], detections_dir: Path | str, *, single: bool = True
    ) -> None:
        self.detections_dir = existing_folder(Path(detections_dir), "is no folder of detections")
        self._sequences, self._single = sequences, single
        self._files = next(iter(sequences.values()))[1]
        self.detection_file_name = f"{'N' * self._files.digits}{self._files.first}.txt"
        if "" not in sequences:
            self.detection_file_name += " or SEQUENCE.txt"
        self._objects = FrameObjects()
        self._motion: dict[Path, NDArray[np.float64]] = {}

    def frame_ids(self) -> list[str]:
        """The frames with a detection file, or all of the sequences that have one of the tracking benchmark."""
        stems = _text_stems(self.detections_dir)
        return [self._join(name, stem) for name in sorted(self._sequences) for stem in self._stems(name, stems)]

    def frame_id(self, number: int) -> str:
        """Of one sequence; of several, a number alone names no frame."""
        stem = f"{number:0{self._files.digits}d}{self._files.first}"
        if not self._single:
            example = self._join(min(self._sequences), stem)
            raise InputError("frames", f"names as {example}, for there are several sequences", f"{number}")
        return stem

    def images(self, frame_id: str) -> tuple[Path, Path]:
        left, right = (self._path(frame_id, name) for name in (self._files.left, self._files.right))
        return find_image(left.parent, left.name), find_image(right.parent, right.name)

    def calibration_path(self, frame_id: str) -> Path:
        return self._path(frame_id, self._split(frame_id)[2].calibration)

    def calibration(self, frame_id: str) -> KittiCalibration:
        return read_calibration(self.calibration_path(frame_id))

    def plane_path(self, frame_id: str) -> Path | None:
        path = self._plane_file(frame_id)
        return path if path.is_file() else None

    def plane_ref(self, frame_id: str) -> NDArray[np.float64]:
        return read_plane(self._plane_file(frame_id))

    def lidar_files(self, folder: Path, frame_id: str) -> dict[str, Path]:
        """`folder/NNNNNN.bin`, of several sequences `folder/SEQUENCE/NNNNNN.bin`; raw: the scanner's place too."""
        place = self._velo_to_cam(frame_id)
        scan = self._in_folder(folder, frame_id) / f"{self._split(frame_id)[3]}.bin"
        return {"lidar": scan} if place is None else {"lidar": scan, "lidar_calibration": place}

    def lidar_calibration(self, frame_id: str) -> KittiCalibration:
        """The matrices of the calibration file, in raw recordings with those of the file beside it."""
        calibration, place = self.calibration(frame_id), self._velo_to_cam(frame_id)
        return calibration if place is None else replace(calibration, Tr_velo_to_cam=read_velo_to_cam(place))

    def detection_path(self, frame_id: str) -> Path:
        """The frame's own file where there is one, else its sequence's."""
        name, _, _, stem = self._split(frame_id)
        own = [] if self._single else [file_of_frame(self.detections_dir / name, f"{stem}.txt")]
        own += [file_of_frame(self.detections_dir, f"{each}.txt") for each in self.names_of(frame_id)]
        return first_existing([*own, file_of_frame(self.detections_dir, f"{name}.txt")] if name else own)

    def objects(self, frame_id: str) -> list[KittiObject]:
        path = self.detection_path(frame_id)
        name, _, _, stem = self._split(frame_id)
        return self._objects.of_sequence(path, stem) if path.stem == name else read_objects(path)

    def labels(self, frame_id: str) -> list[KittiObject] | None:
        path, pattern = self._path(frame_id, self._files.labels), self._files.labels
        if not pattern or not path.is_file():
            return None
        if "{stem}" in pattern:
            return read_objects(path, with_score=False)
        return self._objects.of_sequence(path, self._split(frame_id)[3])

    def sequence_of(self, frame_id: str) -> str | None:
        """The prefix of the frame, where there are several sequences."""
        return None if "" in self._sequences else "" if self._single else self._split(frame_id)[0]

    def motion_files(self, frame_id: str) -> dict[str, Path]:
        names = {"times": self._files.times, "poses": self._files.trajectory}
        paths = {role: self._path(frame_id, pattern) for role, pattern in names.items() if pattern}
        return {role: path for role, path in paths.items() if path.is_file()}

    def motion(self, frame_id: str) -> tuple[float | None, NDArray[np.float64] | None]:
        """Of the line of its number in the files of its sequence, which are read once."""
        said: dict[str, NDArray[np.float64]] = {}
        for role, path in self.motion_files(frame_id).items():
            if path not in self._motion:
                self._motion[path] = read_times(path) if role == "times" else read_poses(path)
            said[role] = of_line(path, self._motion[path], frame_number(self._split(frame_id)[3]))
        return float(said["times"]) if "times" in said else None, said.get("poses")

    def disparity_path(self, folder: Path, frame_id: str) -> Path:
        """`folder/NNNNNN.png`, and of several sequences `folder/SEQUENCE/NNNNNN.png`."""
        return first_disparity(self._in_folder(folder, frame_id), self._split(frame_id)[3])

    def masks(self, directory: Path | None) -> MaskSource | None:
        return None if directory is None else KittiMasks(existing_folder(directory, "is not a folder of masks"), self)

    def masks_in(self, directory: Path, frame_id: str) -> tuple[Path, tuple[str, ...]]:
        """The folder of a frame's masks, and what they may be called there."""
        name, _, _, stem = self._split(frame_id)
        if not self._single and (directory / name).is_dir():
            return directory / name, (stem,)
        return directory, self.names_of(frame_id)

    def names_of(self, frame_id: str) -> tuple[str, ...]:
        """What the files of a frame may be called: the first pair of a scene by that alone."""
        first = self._files.first
        return (frame_id, frame_id.removesuffix(first)) if first and frame_id.endswith(first) else (frame_id,)

    def _plane_file(self, frame_id: str) -> Path:
        """The plane's, or where it would be."""
        return first_existing([self._path(frame_id, self._files.plane, name) for name in self.names_of(frame_id)])

    def _velo_to_cam(self, frame_id: str) -> Path | None:
        pattern = self._split(frame_id)[2].velo_to_cam
        return self._path(frame_id, pattern) if pattern else None

    def _in_folder(self, folder: Path, frame_id: str) -> Path:
        """Where a folder of all sequences has the files of one."""
        return folder if self._single else folder / self._split(frame_id)[0]

    def _stems(self, name: str, all_stems: list[str]) -> list[str]:
        """The frames of a sequence that have detections, of which `all_stems` lie directly in their folder."""
        if name and file_of_frame(self.detections_dir, f"{name}.txt").is_file():
            base, files = self._sequences[name]
            return image_stems(base / files.left.format(sequence=name, stem=""))
        if self._single:
            first = self._files.first
            return sorted({f"{stem}{first}" if first and "_" not in stem else stem for stem in all_stems})
        prefix = f"{name}_"
        found = set(_text_stems(self.detections_dir / name))
        found |= {stem.removeprefix(prefix) for stem in all_stems if stem.startswith(prefix)}
        return sorted(found)

    def _path(self, frame_id: str, pattern: str, named: str | None = None) -> Path:
        """The file of a frame, or one that is called otherwise."""
        name, base, _, stem = self._split(frame_id)
        stem = stem if named is None or not self._single else named
        return base / pattern.format(sequence=name, stem=stem, scene=stem.partition("_")[0])

    def _join(self, name: str, stem: str) -> str:
        return stem if self._single else f"{name}_{stem}"

    def _split(self, frame_id: str) -> tuple[str, Path, KittiFiles, str]:
        """Name, folder and files of a frame's sequence, and the frame's name in it."""
        if self._single:
            name, stem = next(iter(self._sequences)), frame_id
        else:
            name, _, stem = frame_id.rpartition("_")
        if name not in self._sequences:
            raise InputError("frame_id", "SEQUENCE_NNNNNN with a sequence of the data", repr(frame_id))
        return name, *self._sequences[name], stem


@dataclass(frozen=True)
class KittiMasks:
    """Masks of the frames of a layout: in one folder (see `mask_source`), or of several sequences in one for each."""

    directory: Path
    layout: KittiLayout

    def read(self, frame_id: str, size_hw: tuple[int, int]) -> list[InstanceMask]:
        source, name = self._of(frame_id)
        return source.read(name, size_hw)

    def files(self, frame_id: str) -> tuple[Path, ...]:
        source, name = self._of(frame_id)
        return source.files(name)

    def _of(self, frame_id: str) -> tuple[MaskSource, str]:
        folder, names = self.layout.masks_in(self.directory, frame_id)
        source = mask_source(folder)
        return source, next((name for name in names if source.path(name).is_file()), names[0])


def object_layout(root: Path | str, detections_dir: Path | str) -> KittiLayout:
    """KITTI's object benchmark: `root/training` with image_2, image_3, calib, label_2, planes; detections apart."""
    training = Path(root) / "training"
    if not training.is_dir():
        raise DataFormatError(root, "holds no folder 'training' in KITTI's layout", cure="check the path")
    return KittiLayout({"": (training, OBJECT)}, detections_dir)


def stereo2015_layout(root: Path | str, detections_dir: Path | str) -> KittiLayout:
    """KITTI Stereo 2015 (and Scene Flow 2015): two consecutive pairs a scene, `NNNNNN_10` and `NNNNNN_11`, in
    `root/training`, `root/testing` or `root`. Detections, masks and planes of the first may be called `NNNNNN`, too.
    """
    candidates = [Path(root) / "training", Path(root) / "testing", Path(root)]
    found = [folder for folder in candidates if (folder / "calib_cam_to_cam").is_dir()]
    if not found:
        problem = "holds no [training/]calib_cam_to_cam as KITTI Stereo 2015 does"
        raise DataFormatError(root, problem, cure="check the path or --layout")
    return KittiLayout({"": (found[0], STEREO_2015)}, detections_dir)


def tracking_layout(root: Path | str, detections_dir: Path | str) -> KittiLayout:
    """A tracking sequence (`root/image_02/NNNNNN.png`, `image_03`, `calib.txt`, `label_02.txt`, `planes`), or the
    benchmark (`root/training` or `root` with `image_02/SEQUENCE/NNNNNN.png`, `image_03`, `calib/SEQUENCE.txt` ..).
    """
    root = Path(root)
    if image_stems(root / "image_02"):
        return KittiLayout({root.resolve().name: (root, TRACKING_SEQUENCE)}, detections_dir)
    base = root / "training" if (root / "training" / "image_02").is_dir() else root
    names = sorted(path.name for path in (base / "image_02").glob("*") if path.is_dir())
    if not names:
        raise DataFormatError(
            root,
            "holds neither image_02/NNNNNN.png nor [training/]image_02/SEQUENCE/NNNNNN.png",
            cure="give a sequence or the folder of KITTI's tracking benchmark, or another --layout",
        )
    return KittiLayout(dict.fromkeys(names, (base, TRACKING)), detections_dir, single=False)


def raw_layout(root: Path | str, detections_dir: Path | str) -> KittiLayout:
    """A rectified drive of KITTI's raw data (`root/image_02/data/NNNNNNNNNN.png`, `image_03`; calibration in
    `calib_cam_to_cam.txt` beside or in it), or a folder of such drives, of one day or of days.
    """
    root = Path(root)
    single = (root / "image_02" / "data").is_dir()
    found = {path.parents[1] for depth in ("*", "*/*") for path in root.glob(f"{depth}/image_02/data")}
    drives = [root] if single else sorted(found)
    if not drives:
        raise DataFormatError(
            root,
            "holds neither image_02/data nor drives with image_02/data",
            cure="give a folder such as 2011_09_26_drive_0005_sync or the one above it, or another --layout",
        )
    return KittiLayout(dict(map(_drive, drives)), detections_dir, single=single)


def _drive(folder: Path) -> tuple[str, tuple[Path, KittiFiles]]:
    whole = folder.resolve()
    # As it was named where that is possible, or paths would not begin like the root.
    base = folder.parent if folder.name == whole.name else whole.parent
    inside = (folder / "calib_cam_to_cam.txt").is_file()
    return whole.name, (base, RAW if inside else RAW_OF_DAY)


def _text_stems(folder: Path) -> list[str]:
    """Names without ending of the result files in a folder, or in its folder `data` where there is one, sorted."""
    nested = folder / "data"
    return sorted(path.stem for path in (nested if nested.is_dir() else folder).glob("*.txt"))
