"""What the experiments run on: folders in KITTI's layout, with their detectors, masks, physical cars and stereo field.

A data set is a folder that holds

    training/image_2 image_3 calib label_2, planes (optional)
    training/masks, or instance_2 and instance_3          masks of both images (or --masks DIR)
    detections/NAME[/data]/NNNNNN.txt                     any number of detectors
    masks_degraded                                        optional: worse masks of the same cars
    training/disp_occ_0                                   optional: true disparities, for the stereo field
    tracking/DRIVE/label_02.txt                           optional: which labels show the same physical car

`find_data_sets` takes such a folder (a full KITTI) or one that holds several (DIRECTSHAPE_DATA). Many of KITTI's object
frames are frames of a tracking sequence, with the same boxes up to rounding, so boxes alone link the two.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from directshape_torch.errors import DataFormatError
from directshape_torch.evaluation.car_identity import CarIdentity, CarTracks
from directshape_torch.files.text_files import Line, read_lines
from directshape_torch.io.kitti_calibration import read_calibration
from directshape_torch.io.kitti_labels import KittiObject, parse_object, read_objects
from directshape_torch.rig.estimate import RigEstimate
from directshape_torch.rig.frames_with_truth import add_truth, observe_frame, truth_files
from directshape_torch.rig.rig_file import save_rigs

# Object labels carry two decimals, tracking labels six: half a unit of the last place, and float rounding.
_TOLERANCE_M = 0.0051

Tracked = tuple[int, KittiObject]
"""Track id and object of a tracking label with a 3D box."""


def link_drive(object_dir: Path, tracking_dir: Path) -> dict[tuple[str, int], CarIdentity]:
    """Physical cars of all object frames that are frames of one tracking sequence, by frame and label line from 1.

    Args:
        object_dir: holds `label_2`.
        tracking_dir: holds `label_02.txt`; its name is taken for that of the drive.

    Raises:
        DataFormatError: a line is no label.
    """
    frames = _tracking_labels(tracking_dir / "label_02.txt")
    drive = tracking_dir.resolve().name
    return {
        (path.stem, line): CarIdentity(f"{drive}/{track}", drive)
        for path in sorted((object_dir / "label_2").glob("*.txt"))
        for line, track in _link_frame(read_objects(path), frames).items()
    }


def _tracking_labels(path: Path) -> dict[int, list[Tracked]]:
    frames: dict[int, list[Tracked]] = {}
    for line in read_lines(path):
        frame, track, *rest = line.text.split()
        if not (frame.isdecimal() and track.lstrip("-").isdecimal()):
            problem, cure = "does not start with a frame number and a track id", "give KITTI's tracking labels"
            raise DataFormatError(path, problem, line_number=line.number, line=line.text, cure=cure)
        text = " ".join(rest)
        tracked = parse_object(path, Line(line.number, text, text))
        if tracked.has_box_3d:
            frames.setdefault(int(frame), []).append((int(track), tracked))
    return frames


def _link_frame(labels: Sequence[KittiObject], frames: dict[int, list[Tracked]]) -> dict[int, int]:
    """Links to the tracking frame that explains most labels; none if two frames do so equally well."""
    found = sorted((_link(labels, tracked) for tracked in frames.values()), key=len, reverse=True)
    return {} if not found or (len(found) > 1 and len(found[0]) == len(found[1])) else found[0]


def _link(labels: Sequence[KittiObject], tracked: Sequence[Tracked]) -> dict[int, int]:
    """Track id of each label line whose class, size and place are those of exactly one tracked object."""
    links = {}
    for label in (label for label in labels if label.has_box_3d):
        same = [track for track, other in tracked if other.type == label.type and _same_box(label, other)]
        if len(same) == 1:
            links[label.line_number] = same[0]
    return links


def _same_box(a: KittiObject, b: KittiObject) -> bool:
    difference = np.subtract((*a.location_ref, *a.hwl), (*b.location_ref, *b.hwl))
    return bool((np.abs(difference) <= _TOLERANCE_M).all())


# One frame fits the field; more cost time only.
_FRAMES = 5


def field_file(root: Path, out: Path) -> Path | None:
    """The residual disparity field of a rig by the first true disparity maps, kept in `out`; None where it cannot be.

    A field belongs to one rig: where the calibrations of the data set differ (a full KITTI), or where there are no
    true disparities, there is none.
    """
    path = out / f"{root.name}.json"
    if path.is_file():
        return path
    try:
        files = truth_files(root, "disparity")
    except DataFormatError:
        # No true disparities, which is no fault of the data set.
        return None
    if not _has_one_rig(root / "training" / "calib"):
        return None
    frames = [observe_frame(root, frame_id, file, "disparity") for frame_id, file in list(files.items())[:_FRAMES]]
    rigs: list[RigEstimate] = []
    add_truth(rigs, "disparity", frames)
    save_rigs(path, rigs)
    return path


def _has_one_rig(calib: Path) -> bool:
    rigs = {(c.P2.tobytes(), c.P3.tobytes()) for c in map(read_calibration, sorted(calib.glob("*.txt")))}
    return len(rigs) == 1


@dataclass(frozen=True)
class DataSet:
    """One data set.

    Attributes:
        name: of its folder.
        root: the folder that holds `training`.
        detections: folders of result files by the detector's name.
        masks: folder of masks, or None: then no car can be refined.
        masks_degraded: folder of worse masks, or None.
        tracks: physical cars of the labels, or None where nobody knows.
    """

    name: str
    root: Path
    detections: Mapping[str, Path]
    masks: Path | None
    masks_degraded: Path | None
    tracks: CarTracks | None

    @property
    def labels(self) -> Path:
        return self.root / "training" / "label_2"

    @property
    def has_exact_truth(self) -> bool:
        """Whether the scenes are rendered."""
        return (self.root / "training" / "points").is_dir()

    def frames_of(self, detections: Path, wanted: Iterable[str] | None = None) -> tuple[str, ...]:
        """Frames that have a detection file and labels, of the wanted ones."""
        nested = detections / "data"
        known = {path.stem for path in (nested if nested.is_dir() else detections).glob("*.txt")}
        known &= {path.stem for path in self.labels.glob("*.txt")}
        return tuple(sorted(known if wanted is None else known & set(wanted)))


def find_data_sets(root: Path, masks: Path | None = None) -> dict[str, DataSet]:
    """Data sets by name: the folder itself, or those right below it that have detections.

    Args:
        root: holds `training`, or folders that do.
        masks: instead of the masks found in a data set.

    Raises:
        DataFormatError: there is none.
    """
    folders = [root] if (root / "training").is_dir() else sorted(path for path in root.glob("*") if path.is_dir())
    found = [folder for folder in folders if (folder / "training").is_dir() and (folder / "detections").is_dir()]
    if not found:
        cure = "give a folder in KITTI's layout with detections/NAME/data, or one that holds such folders"
        raise DataFormatError(root, "holds neither training and detections nor folders that do", cure=cure)
    return {folder.name: _read(folder, masks) for folder in found}


def _read(root: Path, masks: Path | None) -> DataSet:
    return DataSet(
        name=root.name,
        root=root,
        detections={path.name: path for path in sorted((root / "detections").iterdir()) if path.is_dir()},
        masks=_masks(root) if masks is None else masks,
        masks_degraded=_folder(root / "masks_degraded"),
        tracks=_tracks(root),
    )


def _masks(root: Path) -> Path | None:
    training = root / "training"
    instances = training if (training / "instance_2").is_dir() else None
    return _folder(training / "masks") or _folder(root / "masks") or instances


def _tracks(root: Path) -> CarTracks | None:
    identities: dict[tuple[str, int], CarIdentity] = {}
    for labels in sorted((root / "tracking").glob("*/label_02.txt")):
        identities |= link_drive(root / "training", labels.parent)
    return CarTracks(identities) if identities else None


def _folder(path: Path) -> Path | None:
    return path if path.is_dir() else None
