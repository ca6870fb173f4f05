"""What went into a run, as far as it is still at hand; a file that has changed since is not used, and said to be so."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from directshape_torch.errors import DataFormatError
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.run_folder import FrameResult
from directshape_torch.io.run_manifest import hash_file
from directshape_torch.io.stereo_dataset import LoadedFrame, StereoDataset

_WORDS = {"image_left": "left image", "image_right": "right image", "ground_plane": "ground plane"}


@dataclass
class InputReader:
    """Reads inputs of the frames of a run and keeps in mind what it could not use."""

    dataset: StereoDataset | None = None  # the frames of the run, or None where nobody said where they lie
    has_detections: bool = False  # whether its detections are those that went in; else others stand in for them
    # What is wrong, and with which frames.
    problems: defaultdict[str, set[str]] = field(default_factory=lambda: defaultdict(set))

    def notes(self, num_frames: int) -> list[str]:
        """What could not be used, as sentences."""
        return [f"{what} ({len(ids)} of {num_frames} frames)" for what, ids in sorted(self.problems.items())]

    def detections(self, result: FrameResult) -> list[KittiObject] | None:
        """All lines that went in."""
        if self.dataset is None or not self.has_detections:
            return None
        usable = self._are_unchanged(result, {"detections": self.dataset.layout.files(result.frame_id).detections})
        return self.dataset.objects(result.frame_id) if usable else None

    def labels(self, frame_id: str) -> list[KittiObject] | None:
        """The ground truth, which no run reads and so no hash can tell."""
        return None if self.dataset is None else self.dataset.layout.files(frame_id).read_labels()

    def read(self, result: FrameResult) -> LoadedFrame | None:
        """Images, camera, ground and masks of a frame, if they are those that went in."""
        if self.dataset is None:
            return None
        try:
            files = self.dataset.input_files(result.frame_id)
        except DataFormatError as error:
            # The list of a frame's masks is itself a file.
            self.problems[f"{error.path.name} not found or damaged"].add(result.frame_id)
            found = self.dataset.layout.files(result.frame_id)
            self._are_unchanged(result, {"image_left": found.left, "image_right": found.right})
            return None
        # Of `detections` what stands in cannot be the same.
        kept = {role: path for role, path in files.items() if role != "detections" or self.has_detections}
        return self.dataset.load(result.frame_id) if self._are_unchanged(result, kept) else None

    def _are_unchanged(self, result: FrameResult, files: Mapping[str, Path]) -> bool:
        """Whether the files are those that the run read."""
        found = [self._problem(role, path, result.record.inputs.get(role)) for role, path in files.items()]
        for problem in found:
            if problem is not None:
                self.problems[problem].add(result.frame_id)
        return not any(found)

    def _problem(self, role: str, path: Path, known: str | None) -> str | None:
        name = "masks" if role.startswith("masks_") else _WORDS.get(role, role)
        if not path.is_file():
            return f"{name} not found"
        if known is not None and known != hash_file(path):
            return f"{name} not used: the file has changed since the run"
        return None
