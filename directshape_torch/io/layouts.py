"""This module has one reader for all layouts of data sets; a table of file names describes each layout."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.files.find_files import found, visible_files
from directshape_torch.io.frame_layout import FrameFiles, candidates, existing_folder, first_existing, image_stems
from directshape_torch.io.image_files import find_image


@dataclass(frozen=True)
class Patterns:
    """A `Patterns` has the paths of the files of a sequence, relative to its folder.

    In names `{stem}` stands for the frame's name in its sequence, `{sequence}` for the name of the sequence, and
    `{scene}` for the part of a stem before "_". All files except images and calibration are optional.
    """

    # Images, without ending.
    left: str
    right: str
    calibration: str  # file with P2 and P3, or P_rect_02 and P_rect_03; or `rig.json`
    plane: str = "planes/{stem}.txt"
    labels: str = ""  # one file for each frame, or without `{stem}` one of the tracking benchmark; "" for none
    velo_to_cam: str = ""  # file that gives the pose of the LiDAR; "" if the calibration does
    # Times and camera poses of a sequence, one line for each frame from frame 0 on; "" for none.
    times: str = ""
    trajectory: str = ""
    detections: str = "NNNNNN.txt"  # names of the detection files, for messages
    first: str = ""  # end of a name that files may omit
    follow_each_other: bool = True  # whether the frames are consecutive


OBJECT = Patterns(
    "image_2/{stem}", "image_3/{stem}", "calib/{stem}.txt", labels="label_2/{stem}.txt", follow_each_other=False
)
STEREO_2015 = Patterns(
    "image_2/{stem}",
    "image_3/{stem}",
    "calib_cam_to_cam/{scene}.txt",
    detections="NNNNNN_10.txt",
    first="_10",
    follow_each_other=False,
)
# The detection files contain all parts of a frame that have no file of their own here.
FOLDER = Patterns("left/{stem}", "right/{stem}", "rig.json", detections="ID.json")
TRACKING_SEQUENCE = Patterns(
    "image_02/{stem}",
    "image_03/{stem}",
    "calib.txt",
    labels="label_02.txt",
    times="times.txt",
    trajectory="poses.txt",
)
TRACKING = Patterns(
    "image_02/{sequence}/{stem}",
    "image_03/{sequence}/{stem}",
    "calib/{sequence}.txt",
    "planes/{sequence}/{stem}.txt",
    "label_02/{sequence}.txt",
    times="times/{sequence}.txt",
    trajectory="poses/{sequence}.txt",
)
ODOMETRY = Patterns(
    "sequences/{sequence}/image_2/{stem}",
    "sequences/{sequence}/image_3/{stem}",
    "sequences/{sequence}/calib.txt",
    "sequences/{sequence}/planes/{stem}.txt",
    times="sequences/{sequence}/times.txt",
    trajectory="poses/{sequence}.txt",
)
# The calibration is in the folder of the day, or in the drive itself.
RAW_OF_DAY = Patterns(
    "{sequence}/image_02/data/{stem}",
    "{sequence}/image_03/data/{stem}",
    "calib_cam_to_cam.txt",
    "{sequence}/planes/{stem}.txt",
    velo_to_cam="calib_velo_to_cam.txt",
    times="{sequence}/image_02/timestamps.txt",
    trajectory="{sequence}/poses.txt",
    detections="NNNNNNNNNN.txt",
)
RAW = replace(
    RAW_OF_DAY,
    calibration="{sequence}/calib_cam_to_cam.txt",
    velo_to_cam="{sequence}/calib_velo_to_cam.txt",
)


class Layout:
    """A `Layout` is one sequence, whose frames have the names of their images, or several with the prefix `SEQUENCE_`.

    Args:
        sequences: folder and file names of each sequence; the name is "" for a benchmark without sequences.
        detections_dir: folder with `NNNNNN.txt` or `data/NNNNNN.txt` (one sequence), or for several
            `SEQUENCE/NNNNNN.txt`, `SEQUENCE/data/NNNNNN.txt` or `data/SEQUENCE_NNNNNN.txt`. Both may also have
            `SEQUENCE.txt`, a result or label file of the tracking benchmark. None means that boxes are made of masks.
        single: whether frame names have no prefix.
    """

    def __init__(
        self, sequences: Mapping[str, tuple[Path, Patterns]], detections_dir: Path | str | None, *, single: bool = True
    ) -> None:
        self.detections_dir = (
            None if detections_dir is None else existing_folder(Path(detections_dir), "is no folder of detections")
        )
        self._sequences, self._single = sequences, single
        patterns = next(iter(sequences.values()))[1]
        self._ending = Path(patterns.detections).suffix
        self.sequence = next(iter(sequences)) if single else ""
        self.detection_file_name = patterns.detections + ("" if "" in sequences else " or SEQUENCE.txt")

    def frame_ids(self) -> list[str]:
        """The frames with a detection file, or all frames of a sequence that has one of the tracking benchmark.

        Without a folder of detections they are all frames that have a left image.
        """
        folder = self.detections_dir
        if folder is None:
            return self.image_ids()
        stems = self._detection_stems(folder)
        return [self._join(name, stem) for name in sorted(self._sequences) for stem in self._stems(folder, name, stems)]

    def image_ids(self) -> list[str]:
        """The frames that have a left image."""
        return [self._join(name, stem) for name in sorted(self._sequences) for stem in self._image_stems(name)]

    def files(self, frame_id: str) -> FrameFiles:
        name, stem = self._split(frame_id)
        base, patterns = self._sequences[name]
        without_end = stem.removesuffix(patterns.first)
        names = (stem, without_end) if self._single else (f"{name}/{stem}", frame_id)

        def path(pattern: str, stem: str = stem) -> Path:
            return base / pattern.format(sequence=name, stem=stem, scene=stem.partition("_")[0])

        def known(pattern: str) -> Path | None:
            return found(path(pattern)) if pattern else None

        left, right = path(patterns.left), path(patterns.right)
        detections = None
        if self.detections_dir is not None:
            places = candidates(self.detections_dir, [*names, name] if name else names, [self._ending])
            detections = first_existing([*places, self.detections_dir / f"{names[0]}{self._ending}"])
        return FrameFiles(
            left=find_image(left.parent, left.name),
            right=find_image(right.parent, right.name),
            calibration=first_existing([path(patterns.calibration)]),
            detections=detections,
            names=tuple(dict.fromkeys(names)),
            plane=first_existing([path(patterns.plane), path(patterns.plane, without_end)]),
            labels=known(patterns.labels),
            velo_to_cam=path(patterns.velo_to_cam) if patterns.velo_to_cam else None,
            times=known(patterns.times),
            trajectory=known(patterns.trajectory),
        )

    def sequence_of(self, frame_id: str) -> str | None:
        name, _ = self._split(frame_id)
        follow_each_other = self._sequences[name][1].follow_each_other
        return None if not follow_each_other else "" if self._single else name

    def _split(self, frame_id: str) -> tuple[str, str]:
        """The name of a frame's sequence and the name of the frame in it."""
        if self._single:
            return next(iter(self._sequences)), frame_id
        name, _, stem = frame_id.rpartition("_")
        if name not in self._sequences:
            raise InputError("frame_id", "SEQUENCE_NNNNNN with a sequence of the data", repr(frame_id))
        return name, stem

    def _stems(self, folder: Path, name: str, all_stems: list[str]) -> list[str]:
        """The frames of a sequence that have detections; `all_stems` are names directly in the detections folder."""
        if name and any(path.is_file() for path in candidates(folder, [name], [self._ending])):
            return self._image_stems(name)
        if self._single:
            first = self._sequences[name][1].first
            return sorted({f"{stem}{first}" if "_" not in stem else stem for stem in all_stems})
        prefix = f"{name}_"
        found = set(self._detection_stems(folder / name))
        found |= {stem.removeprefix(prefix) for stem in all_stems if stem.startswith(prefix)}
        return sorted(found)

    def _detection_stems(self, folder: Path) -> list[str]:
        """Names without ending of the result files in a folder, or in its subfolder `data` if there is one, sorted.

        A name without digits, such as README.txt, is only a frame if an image has the same name.
        """
        nested = folder / "data"
        stems = [path.stem for path in visible_files(nested if nested.is_dir() else folder, [self._ending])]
        return sorted(stem for stem in stems if any(map(str.isdigit, stem)) or self._has_image(stem))

    def _has_image(self, stem: str) -> bool:
        return any(stem in self._image_stems(name) for name in self._sequences)

    def _image_stems(self, name: str) -> list[str]:
        base, patterns = self._sequences[name]
        return image_stems(base / patterns.left.format(sequence=name, stem=""))

    def _join(self, name: str, stem: str) -> str:
        return stem if self._single else f"{name}_{stem}"


def object_layout(root: Path | str, detections_dir: Path | str | None) -> Layout:
    """KITTI's object benchmark with image_2, image_3, calib, label_2 and planes; detections are separate.

    The folders lie in `root/training`, else in `root/testing`, else in `root`.
    """
    training = Path(root) / "training"
    # Errors about missing parts then name files in the training folder.
    base = _split_with(Path(root), "image_2") or (training if training.is_dir() else None)
    if base is None:
        problem = "holds no image_2, training/image_2 or testing/image_2 in KITTI's layout"
        raise DataFormatError(root, problem, cure="check the path or --layout")
    return Layout({"": (base, OBJECT)}, detections_dir)


def _split_with(root: Path, folder: str) -> Path | None:
    """The first of `root/training`, `root/testing` and `root` that contains the given folder, or None."""
    return next((base for base in (root / "training", root / "testing", root) if (base / folder).is_dir()), None)


def odometry_layout(root: Path | str, detections_dir: Path | str | None) -> Layout:
    """KITTI's odometry benchmark in colour.

    It has `root/sequences/NN` with image_2, image_3, calib.txt and times.txt, and `root/poses/NN.txt`. `root/dataset`
    may replace `root`, and `root` may be the folder of one sequence.
    """
    root = Path(root)
    if (root / "image_2").is_dir():
        whole = root.resolve()
        return Layout({whole.name: (whole.parents[1], ODOMETRY)}, detections_dir)
    for base in (root, root / "dataset"):
        names = sorted(path.parent.name for path in base.glob("sequences/[!.]*/image_2"))
        if names:
            return Layout(dict.fromkeys(names, (base, ODOMETRY)), detections_dir, single=False)
    raise DataFormatError(
        root,
        "holds no [dataset/]sequences/NN/image_2 as KITTI's odometry data in colour",
        cure="give the folder above 'sequences', or one sequence, or another --layout",
    )


def stereo2015_layout(root: Path | str, detections_dir: Path | str | None) -> Layout:
    """KITTI Stereo 2015 (and Scene Flow 2015): two consecutive pairs of each scene, `NNNNNN_10` and `NNNNNN_11`.

    They are in `root/training`, `root/testing` or `root`. Detections, masks and planes of the first pair may be named
    `NNNNNN`.
    """
    base = _split_with(Path(root), "calib_cam_to_cam")
    if base is None:
        problem = "holds no [training/]calib_cam_to_cam as KITTI Stereo 2015 does"
        raise DataFormatError(root, problem, cure="check the path or --layout")
    return Layout({"": (base, STEREO_2015)}, detections_dir)


def tracking_layout(root: Path | str, detections_dir: Path | str | None) -> Layout:
    """A sequence of KITTI's tracking benchmark, or the whole benchmark.

    A sequence is `root/image_02/NNNNNN.png`, `image_03`, `calib.txt`, `label_02.txt`, `planes`. The benchmark is
    `root/training`, `root/testing` or `root` with `image_02/SEQUENCE/NNNNNN.png`, `image_03`, `calib/SEQUENCE.txt` ..
    """
    root = Path(root)
    if image_stems(root / "image_02"):
        return Layout({root.resolve().name: (root, TRACKING_SEQUENCE)}, detections_dir)
    base = _split_with(root, "image_02") or root
    names = sorted(path.name for path in (base / "image_02").glob("[!.]*") if path.is_dir())
    if not names:
        raise DataFormatError(
            root,
            "holds neither image_02/NNNNNN.png nor [training/ or testing/]image_02/SEQUENCE/NNNNNN.png",
            cure="give a sequence or the folder of KITTI's tracking benchmark, or another --layout",
        )
    return Layout(dict.fromkeys(names, (base, TRACKING)), detections_dir, single=False)


def raw_layout(root: Path | str, detections_dir: Path | str | None) -> Layout:
    """A rectified drive of KITTI's raw data, or a folder of such drives of one or several days.

    A drive is `root/image_02/data/NNNNNNNNNN.png` and `image_03`, with `calib_cam_to_cam.txt` in it or in the folder
    above.
    """
    root = Path(root)
    single = (root / "image_02" / "data").is_dir()
    found = {path.parents[1] for depth in ("[!.]*", "[!.]*/[!.]*") for path in root.glob(f"{depth}/image_02/data")}
    drives = [root] if single else sorted(found)
    if not drives:
        raise DataFormatError(
            root,
            "holds neither image_02/data nor drives with image_02/data",
            cure="give a folder such as 2011_09_26_drive_0005_sync or the one above it, or another --layout",
        )
    return Layout(dict(map(_drive, drives)), detections_dir, single=single)


def _drive(folder: Path) -> tuple[str, tuple[Path, Patterns]]:
    whole = folder.resolve()
    # The folder keeps its given name if possible, because paths would otherwise not begin with the root.
    base = folder.parent if folder.name == whole.name else whole.parent
    inside = (folder / "calib_cam_to_cam.txt").is_file()
    return whole.name, (base, RAW if inside else RAW_OF_DAY)


def folder_layout(root: Path | str, frames_dir: Path | str | None = None) -> Layout:
    """A plain folder: `root/left`, `root/right`, `root/rig.json` and `root/frames/ID.json`, or `frames_dir/ID.json`.

    Without a folder of frames there are no detections.
    """
    root = Path(root)
    for name in ("left", "right"):
        existing_folder(root / name, "is no folder of images", "see docs/inputs.md, or give another --layout")
    frames = root / "frames"
    return Layout({"": (root, FOLDER)}, frames if frames_dir is None and frames.is_dir() else frames_dir)
