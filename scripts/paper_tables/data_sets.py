"""What the experiments run on: folders in KITTI's layout, with their detectors, masks, physical cars and stereo field.

A data set is a folder that holds

    training/image_2 image_3 calib label_2, planes (optional)
    training/masks, or instance_2 and instance_3          masks of both images (or --masks DIR)
    detections/NAME[/data]/NNNNNN.txt                     any number of detectors
    masks_degraded                                        optional: worse masks of the same cars
    training/points or training/disp_occ_0                optional: true surfaces, for the shape table
    tracking/DRIVE/label_02.txt                           optional: which labels show the same physical car

`find_data_sets` takes such a folder (a full KITTI) or one that holds several (DIRECTSHAPE_DATA).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from directshape_torch.errors import DataFormatError
from directshape_torch.evaluation.car_identity import CarIdentity, CarTracks
from directshape_torch.evaluation.shape_scores import TruthKind
from paper_tables.physical_cars import link_drive


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
        truth: kind of the true surfaces, or None.
    """

    name: str
    root: Path
    detections: Mapping[str, Path]
    masks: Path | None
    masks_degraded: Path | None
    tracks: CarTracks | None
    truth: TruthKind | None

    @property
    def labels(self) -> Path:
        return self.root / "training" / "label_2"

    @property
    def has_exact_truth(self) -> bool:
        """Whether the scenes are rendered."""
        return self.truth == "points"

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
    training = root / "training"
    return DataSet(
        name=root.name,
        root=root,
        detections={path.name: path for path in sorted((root / "detections").iterdir()) if path.is_dir()},
        masks=_masks(root) if masks is None else masks,
        masks_degraded=_folder(root / "masks_degraded"),
        tracks=_tracks(root),
        truth=_truth(training),
    )


def _masks(root: Path) -> Path | None:
    training = root / "training"
    instances = training if (training / "instance_2").is_dir() else None
    return _folder(training / "masks") or _folder(root / "masks") or instances


def _truth(training: Path) -> TruthKind | None:
    if (training / "points").is_dir():
        return "points"
    return "disparity" if (training / "disp_occ_0").is_dir() else None


def _tracks(root: Path) -> CarTracks | None:
    identities: dict[tuple[str, int], CarIdentity] = {}
    for labels in sorted((root / "tracking").glob("*/label_02.txt")):
        identities |= link_drive(root / "training", labels.parent)
    return CarTracks(identities) if identities else None


def _folder(path: Path) -> Path | None:
    return path if path.is_dir() else None
