"""The layouts of data sets: one reader, to which each of them is a table of file names."""

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
    """Where the files of a sequence are, below its folder.

    In names `{stem}` stands for the frame's name in its sequence, `{sequence}` for the name of that, and `{scene}` for
    what comes before the "_" of a stem. All but images and calibration may be missing.
    """

    # Images, without ending.
    left: str
    right: str
    calibration: str  # file with P2 and P3, or P_rect_02 and P_rect_03; or `rig.json`
    plane: str = "planes/{stem}.txt"
    labels: str = ""  # a file a frame, or without `{stem}` one of the tracking benchmark; "": there are none
    velo_to_cam: str = ""  # file that places the LiDAR; "": the calibration does
    # Times and camera poses of a sequence, a line each from frame 0 on; "": there are none.
    times: str = ""
    trajectory: str = ""
    detections: str = "NNNNNN.txt"  # what their files are called
    first: str = ""  # end of a name that files may leave out
    follow_each_other: bool = True  # whether the frames do


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
# Everything that is not in these files is in the one of the detections.
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
# In the folder of the day, and with a calibration in the drive itself.
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
    """One sequence, whose frames are called as their images are, or several, with `SEQUENCE_` before that.

    Args:
        sequences: for each its folder and the names in it; the single one of a benchmark without sequences is "".
        detections_dir: holds `NNNNNN.txt` or `data/NNNNNN.txt` (one sequence), or for several `SEQUENCE/NNNNNN.txt`,
            `SEQUENCE/data/NNNNNN.txt` or `data/SEQUENCE_NNNNNN.txt`; in either case also `SEQUENCE.txt`, a result or
            label file of the tracking benchmark.
        single: whether there is no prefix.
    """

    def __init__(
        self, sequences: Mapping[str, tuple[Path, Patterns]], detections_dir: Path | str, *, single: bool = True
    ) -> None:
        self.detections_dir = existing_folder(Path(detections_dir), "is no folder of detections")
        self._sequences, self._single = sequences, single
        patterns = next(iter(sequences.values()))[1]
        self._ending = Path(patterns.detections).suffix
        self.sequence = next(iter(sequences)) if single else ""
        self.detection_file_name = patterns.detections + ("" if "" in sequences else " or SEQUENCE.txt")

    def frame_ids(self) -> list[str]:
        """The frames with a detection file, or all of the sequences that have one of the tracking benchmark."""
        stems = self._detection_stems(self.detections_dir)
        return [self._join(name, stem) for name in sorted(self._sequences) for stem in self._stems(name, stems)]

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
        places = candidates(self.detections_dir, [*names, name] if name else names, [self._ending])
        return FrameFiles(
            left=find_image(left.parent, left.name),
            right=find_image(right.parent, right.name),
            calibration=first_existing([path(patterns.calibration)]),
            detections=first_existing([*places, self.detections_dir / f"{names[0]}{self._ending}"]),
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
        """Names of a frame's sequence, and of the frame in it."""
        if self._single:
            return next(iter(self._sequences)), frame_id
        name, _, stem = frame_id.rpartition("_")
        if name not in self._sequences:
            raise InputError("frame_id", "SEQUENCE_NNNNNN with a sequence of the data", repr(frame_id))
        return name, stem

    def _stems(self, name: str, all_stems: list[str]) -> list[str]:
        """The frames of a sequence that have detections, of which `all_stems` lie directly in their folder."""
        if name and any(path.is_file() for path in candidates(self.detections_dir, [name], [self._ending])):
            return self._image_stems(name)
        if self._single:
            first = self._sequences[name][1].first
            return sorted({f"{stem}{first}" if "_" not in stem else stem for stem in all_stems})
        prefix = f"{name}_"
        found = set(self._detection_stems(self.detections_dir / name))
        found |= {stem.removeprefix(prefix) for stem in all_stems if stem.startswith(prefix)}
        return sorted(found)

    def _detection_stems(self, folder: Path) -> list[str]:
        """Names without ending of the result files in a folder, or in its folder `data` where there is one, sorted.

        What has no digit in its name, README.txt, is no frame unless there is an image of that name.
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


def object_layout(root: Path | str, detections_dir: Path | str) -> Layout:
    """KITTI's object benchmark: `root/training`, else `root/testing`, else `root` itself with image_2, image_3, calib,
    label_2, planes; detections apart.
    """
    training = Path(root) / "training"
    # What a training folder lacks is said of its files.
    base = _split_with(Path(root), "image_2") or (training if training.is_dir() else None)
    if base is None:
        problem = "holds no image_2, training/image_2 or testing/image_2 in KITTI's layout"
        raise DataFormatError(root, problem, cure="check the path or --layout")
    return Layout({"": (base, OBJECT)}, detections_dir)


def _split_with(root: Path, folder: str) -> Path | None:
    """Of `root/training`, `root/testing` and `root` the first with such a folder in it."""
    return next((base for base in (root / "training", root / "testing", root) if (base / folder).is_dir()), None)


def odometry_layout(root: Path | str, detections_dir: Path | str) -> Layout:
    """KITTI's odometry benchmark in colour: `root/sequences/NN` with image_2, image_3, calib.txt and times.txt, and
    `root/poses/NN.txt`; `root/dataset` will do for `root`, and so will the folder of one sequence.
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


def stereo2015_layout(root: Path | str, detections_dir: Path | str) -> Layout:
    """KITTI Stereo 2015 (and Scene Flow 2015): two consecutive pairs a scene, `NNNNNN_10` and `NNNNNN_11`, in
    `root/training`, `root/testing` or `root`. Detections, masks and planes of the first may be called `NNNNNN`, too.
    """
    base = _split_with(Path(root), "calib_cam_to_cam")
    if base is None:
        problem = "holds no [training/]calib_cam_to_cam as KITTI Stereo 2015 does"
        raise DataFormatError(root, problem, cure="check the path or --layout")
    return Layout({"": (base, STEREO_2015)}, detections_dir)


def tracking_layout(root: Path | str, detections_dir: Path | str) -> Layout:
    """A tracking sequence (`root/image_02/NNNNNN.png`, `image_03`, `calib.txt`, `label_02.txt`, `planes`), or the
    benchmark (`root/training`, `root/testing` or `root` with `image_02/SEQUENCE/NNNNNN.png`, `image_03`,
    `calib/SEQUENCE.txt` ..).
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


def raw_layout(root: Path | str, detections_dir: Path | str) -> Layout:
    """A rectified drive of KITTI's raw data (`root/image_02/data/NNNNNNNNNN.png`, `image_03`; calibration in
    `calib_cam_to_cam.txt` beside or in it), or a folder of such drives, of one day or of days.
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
    # As it was named where that is possible, or paths would not begin like the root.
    base = folder.parent if folder.name == whole.name else whole.parent
    inside = (folder / "calib_cam_to_cam.txt").is_file()
    return whole.name, (base, RAW if inside else RAW_OF_DAY)


def folder_layout(root: Path | str, frames_dir: Path | str | None = None) -> Layout:
    """A plain folder: `root/left`, `root/right`, `root/rig.json` and `root/frames/ID.json`, or `frames_dir/ID.json`."""
    root = Path(root)
    for name in ("left", "right"):
        existing_folder(root / name, "is no folder of images", "see docs/inputs.md, or give another --layout")
    return Layout({"": (root, FOLDER)}, root / "frames" if frames_dir is None else frames_dir)
