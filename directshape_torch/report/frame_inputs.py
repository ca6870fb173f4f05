"""What went into a run, as far as it is still at hand; a file that has changed since is not used, and said to be so."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.geometry.ground_plane import plane_ref_to_cam
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.frame_detections import GivenMasks
from directshape_torch.io.frame_layout import FrameLayout
from directshape_torch.io.image_files import read_rgb
from directshape_torch.io.instance_masks import InstanceMask, MaskSource
from directshape_torch.io.kitti_calibration import camera_of_rig
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.run_folder import FrameResult
from directshape_torch.io.run_manifest import hash_file
from directshape_torch.scene import GroundPlane


@dataclass(frozen=True)
class InputSources:
    """Where the inputs of the run lie now; None where nobody said.

    Attributes:
        layout: finds images, calibration, planes, labels and detections.
        has_detections: whether the detections of that layout are those that went in.
        masks: instance masks.
        has_own_masks: whether they are the layout's, which may say what detection each belongs to.
        disparity_fields: residual disparity of the rigs.
    """

    layout: FrameLayout | None = None
    has_detections: bool = False
    masks: MaskSource | None = None
    has_own_masks: bool = False
    disparity_fields: tuple[DisparityField, ...] = ()


@dataclass(frozen=True)
class FrameInputs:
    """The inputs of one frame; None, or nothing, for what is not at hand.

    Attributes:
        image_left, image_right: (H, W, 3) RGB.
        camera: of this one frame, float32.
        ground: the plane that the run used.
        masks: of both images.
        given_masks: which of them belongs to which detection, where the layout says so.
    """

    image_left: NDArray[np.uint8] | None
    image_right: NDArray[np.uint8] | None
    camera: StereoCamera | None
    ground: GroundPlane | None
    masks: tuple[InstanceMask, ...]
    given_masks: GivenMasks | None


@dataclass
class InputReader:
    """Reads inputs of the frames of a run and keeps in mind what it could not use.

    Attributes:
        sources: where to look.
        camera_height_m: of the run's settings.
        problems: what is wrong, and with which frames.
    """

    sources: InputSources
    camera_height_m: float
    problems: defaultdict[str, set[str]] = field(default_factory=lambda: defaultdict(set))

    def detections(self, result: FrameResult) -> list[KittiObject] | None:
        """All lines that went in."""
        layout = self.sources.layout
        if layout is None or not self.sources.has_detections:
            return None
        usable = self._is_unchanged(result, "detections", layout.detection_path(result.frame_id))
        return layout.objects(result.frame_id) if usable else None

    def labels(self, frame_id: str) -> list[KittiObject] | None:
        """The ground truth, which no run reads and so no hash can tell."""
        layout = self.sources.layout
        return None if layout is None else layout.labels(frame_id)

    def read(self, result: FrameResult) -> FrameInputs:
        """Images, camera, ground and masks of a frame."""
        layout, frame_id = self.sources.layout, result.frame_id
        if layout is None:
            return FrameInputs(None, None, None, None, (), None)
        roles = ("image_left", "image_right")
        left, right = (self._image(result, *pair) for pair in zip(roles, layout.images(frame_id), strict=True))
        if left is not None and right is not None and left.shape != right.shape:
            self.problems["left and right image differ in size"].add(frame_id)
            right = None
        camera = self._camera(layout, result, left)
        ground = None if camera is None else self._ground(layout, result, camera, left, right)
        masks = () if left is None else self._masks(result, (left.shape[0], left.shape[1]))
        given = layout.given_masks(frame_id) if self.sources.has_own_masks else None
        return FrameInputs(left, right, camera, ground, masks, given)

    def _is_unchanged(self, result: FrameResult, role: str, path: Path) -> bool:
        """Whether the file is the one that the run read."""
        frame_id, known = result.frame_id, result.record.inputs.get(role)
        if not path.is_file():
            self.problems[f"{_words(role)} not found"].add(frame_id)
            return False
        if known is not None and known != hash_file(path):
            self.problems[f"{_words(role)} not used: the file has changed since the run"].add(frame_id)
            return False
        return True

    def _image(self, result: FrameResult, role: str, path: Path) -> NDArray[np.uint8] | None:
        return read_rgb(path) if self._is_unchanged(result, role, path) else None

    def _camera(self, layout: FrameLayout, result: FrameResult, left: NDArray[np.uint8] | None) -> StereoCamera | None:
        if not self._is_unchanged(result, "calibration", layout.calibration_path(result.frame_id)):
            return None
        fields = () if left is None else self.sources.disparity_fields
        size_wh = (0, 0) if left is None else (left.shape[1], left.shape[0])
        return camera_of_rig(layout.calibration(result.frame_id), fields, size_wh, torch.float32)

    def _ground(
        self,
        layout: FrameLayout,
        result: FrameResult,
        camera: StereoCamera,
        left: NDArray[np.uint8] | None,
        right: NDArray[np.uint8] | None,
    ) -> GroundPlane | None:
        """The plane of the source that the run used."""
        source, frame_id = result.shapes.ground_source, result.frame_id
        if source == "camera_height":
            return GroundPlane.from_camera_height(self.camera_height_m)
        if source == "file":
            path = layout.plane_path(frame_id)
            if path is None or not self._is_unchanged(result, "ground_plane", path):
                return None
            return _plane_from_ref(layout.plane_ref(frame_id), camera)
        if source == "stereo" and left is not None and right is not None:
            return _plane_from_stereo(left, right, camera)
        return None

    def _masks(self, result: FrameResult, size_hw: tuple[int, int]) -> tuple[InstanceMask, ...]:
        source, frame_id = self.sources.masks, result.frame_id
        if source is None:
            return ()
        try:
            paths = source.files(frame_id)
        except DataFormatError:
            # The files of a frame stand in its first one.
            self.problems["masks not found or damaged"].add(frame_id)
            return ()
        for index, path in enumerate(paths):
            if not self._is_unchanged(result, f"masks_{index}", path):
                return ()
        return tuple(source.read(frame_id, size_hw))


def _plane_from_ref(plane: NDArray[np.float64], camera: StereoCamera) -> GroundPlane:
    plane_ref = torch.from_numpy(plane)
    offset = plane_ref_to_cam(plane_ref[:3], plane_ref[3], camera.t_cam_ref[0].double())
    return GroundPlane(plane_ref[None, :3], offset[None], ("file",))


def _plane_from_stereo(left: NDArray[np.uint8], right: NDArray[np.uint8], camera: StereoCamera) -> GroundPlane | None:
    from directshape_torch.stereo_matching.plane_from_points import estimate_ground_plane

    plane = estimate_ground_plane(left, right, camera)
    if plane is None:
        return None
    normal, offset = (torch.as_tensor(part, dtype=torch.float64).reshape(-1) for part in plane)
    return GroundPlane(normal[None], offset, ("stereo",))


def _words(role: str) -> str:
    """A role of the summary's inputs as one reads it.

    Examples:
        >>> _words("image_left"), _words("masks_0")
        ('left image', 'masks')
    """
    names = {"image_left": "left image", "image_right": "right image", "ground_plane": "ground plane"}
    return "masks" if role.startswith("masks_") else names.get(role, role)
