"""This module defines the result of a refinement."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from numbers import Integral
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from directshape_torch.errors import InputError, MissingDependencyError, shown
from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import alpha_from_kitti, box_corners, rotation_y_from_pose
from directshape_torch.geometry.box_formats import BoxFormat, poses_to_boxes
from directshape_torch.numerics.checks import check_alike
from directshape_torch.numerics.conversion import working_dtype
from directshape_torch.numerics.full_precision import full_precision
from directshape_torch.numerics.records import CarRecord, Dense
from directshape_torch.refinement.disparity_profile import DisparityProfile
from directshape_torch.refinement.fusion import DetectorComparison, level_boxes
from directshape_torch.refinement.observability import Observability
from directshape_torch.refinement.quality import FitQuality, is_front_known
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.shape.zero_level import sdf_to_mesh
from directshape_torch.status import Status, counted, is_refined

if TYPE_CHECKING:
    import trimesh

Frame = Literal["ref", "cam"]
# A printed result shows this many cars. One that got better with a probability below the second number is doubtful.
_PRINTED_CARS, _DOUBTFUL_BELOW = 40, 0.5


@dataclass(frozen=True)
class KittiBoxes:
    """These boxes in KITTI's convention are measured on the refined zero level.

    Attributes:
        dimensions_hwl: (B, 3) height, width, length, metres.
        location_ref: (B, 3) bottom centre in the reference frame of labels, metres.
        rotation_y: (B,) radians.
        alpha: (B,) radians.
    """

    dimensions_hwl: Tensor
    location_ref: Tensor
    rotation_y: Tensor
    alpha: Tensor


@dataclass(frozen=True, repr=False)
class RefinementResult(CarRecord):
    """This is the outcome of a refinement of B cars, in the order of the detections.

    A result can be indexed by a number, a slice, a list of numbers or one boolean for each car, which gives another
    result. `for car in result` gives results of one car. `.to(...)`, `.cpu()` and `.detach()` work as for tensors.
    Poses, codes and boxes have the dtype of the inputs (float32, float64). Costs, covariances and all figures of
    quality are float64. Statuses and iterations are int64.

    Attributes:
        T_cam_obj: (B, 4, 4) refined poses, or the input poses where the status says that the car was not refined.
        code: (B, K) shape codes, in standard deviations.
        status_code: (B,) integer, see `status`.
        iterations: (B,) Gauss-Newton iterations. Those of `rescued` cars, and their cost history, are of both starts.
        term_names: names of the T terms.
        cost_before, cost_after: (B, T) cost of each term for input and output, both at the final stage. They are NaN
            for cars that took no part in the refinement. For `not_trusted` cars they belong to the refinement that was
            not returned. The input of `rescued` cars is the box that was made of their mask.
        covariance: (B, 6 + K, 6 + K) covariance in the tangent `(v, omega, dcode)` of the object frame, uncalibrated
            (relative). It is NaN for cars that were not refined.
        covariance_xyz_yaw: (B, 4, 4) covariance of the returned box's place (x, y, z) in the reference frame and of its
            heading, calibrated, in metres and radians; see `sigma_xyz_yaw`.
        cost_history: (B, n) cost after each iteration, NaN where a car took no part. Costs of different stages cannot
            be compared. A stage begins when the slowest car of the batch has ended the previous stage.
        quality: agreement of each refined car with masks and images.
        observability: which directions the view of a car does not show; `observability.words()` describes them.
        profile: photometric cost over the disparity at input and end. For `not_trusted` cars the end is the state that
            was not returned.
        comparison: how far the images' box and the detector's box of each refined car are apart, and what is known of
            the box that combines both.
        input_dimensions_hwl: (B, 3) dimensions of the detections, metres.
        ground_source: where the ground plane of each car's frame came from, B entries.
        t_cam_ref: (B, 3) shift between the frames: `x_cam = x_ref + t_cam_ref`.
        track_part: (B,) int64, 0 for cars that share their shape with other views of their track. If a track was split,
            because its views cannot show one car, this is the number of the part. It is -1 for shapes of one view.
        prior: the family of shapes.

    Examples:
        >>> import pathlib
        >>> import directshape_torch as ds
        >>> from directshape_torch.io.stereo_dataset import open_dataset
        >>> demo = pathlib.Path(ds.__file__).parent / "assets" / "demo"
        >>> inputs = open_dataset("kitti", demo, demo / "detections" / "noisy_stereo", demo / "training" / "masks")
        >>> frame = inputs.load("000000")
        >>> result = ds.DirectShapeRefiner(config=ds.load_config("fast"))(frame.frame, frame.detections)
        >>> len(result), len(result[0]), len(result[:3])
        (6, 1, 3)
        >>> result.to_boxes("opencv").shape, result.corners().shape
        (torch.Size([6, 7]), torch.Size([6, 8, 3]))
    """

    T_cam_obj: Annotated[Tensor, Dense("B", 4, 4)]
    code: Annotated[Tensor, Dense("B", "K")]
    status_code: Annotated[Tensor, Dense("B", kind="index")]
    iterations: Annotated[Tensor, Dense("B", kind="index")]
    term_names: tuple[str, ...]
    cost_before: Annotated[Tensor, Dense("B", "T")]
    cost_after: Annotated[Tensor, Dense("B", "T")]
    covariance: Annotated[Tensor, Dense("B", "D", "D")]
    covariance_xyz_yaw: Annotated[Tensor, Dense("B", 4, 4)]
    cost_history: Annotated[Tensor, Dense("B", "iterations")]
    quality: FitQuality
    observability: Observability
    profile: DisparityProfile
    comparison: DetectorComparison
    input_dimensions_hwl: Annotated[Tensor, Dense("B", 3)]
    ground_source: tuple[str, ...]
    t_cam_ref: Annotated[Tensor, Dense("B", 3)]
    track_part: Annotated[Tensor, Dense("B", kind="index")]
    prior: ShapePrior

    def __len__(self) -> int:
        return len(self.T_cam_obj)

    def __getitem__(self, index: int | slice | Tensor | list[int] | NDArray[Any]) -> Self:
        """The result of some of the cars.

        Raises:
            InputError: no such car, or not one boolean for each car.
        """
        return self.rows(_chosen_rows(index, len(self)))

    def __iter__(self) -> Iterator[Self]:
        """Iterate over results of one car each."""
        return (self[row] for row in range(len(self)))

    def rows(self, index: Tensor) -> Self:
        """The result of the cars `index` (M,), in the order of `index`."""
        sources = tuple(self.ground_source[row] for row in index.tolist())
        return replace(super().rows(index), ground_source=sources)

    def to(self, device: torch.device | torch.dtype | str | None = None, dtype: torch.dtype | None = None) -> Self:
        """The result on another device, or with poses, codes and shapes of another dtype; a changed prior is a copy.

        Raises:
            InputError: half precision, which cannot hold a pose.
        """
        if isinstance(device, torch.dtype):
            device, dtype = None, device
        if dtype is not None and dtype != working_dtype(dtype):
            raise InputError("dtype", "float32 or float64", str(dtype), "convert what to_boxes gives instead")
        moved = super().to(device)
        if dtype is not None:
            like_input = ("T_cam_obj", "code", "input_dimensions_hwl", "t_cam_ref")
            moved = replace(moved, **{name: getattr(moved, name).to(dtype) for name in like_input})
        return replace(moved, prior=_moved_prior(self.prior, moved.T_cam_obj))

    def numpy(self) -> dict[str, NDArray[Any]]:
        """All tensors as arrays by the names of `state_dict`, boxes in the reference frame, and arrays of words."""
        boxes = {f"boxes.{name}": x for name, x in vars(self.boxes()).items()}
        tensors = {**self.detach().cpu().state_dict(), **boxes}
        words = {
            "status": [status.name for status in self.status],
            "term_names": list(self.term_names),
            "ground_source": list(self.ground_source),
        }
        arrays = {name: np.array(each, dtype=np.str_) for name, each in words.items()}
        return {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()} | arrays

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Tensor], prior: ShapePrior | None = None) -> Self:
        """The result whose `state_dict()` this is, read back by `torch.load(weights_only=True)` or safetensors.

        Args:
            state: the tensors by their names.
            prior: the shapes of the result, which its state does not hold. Default: the bundled shapes.

        Raises:
            InputError: a tensor is missing or none of its kind, the prior has another number of codes, or a refined car
                has no finite box and standard deviations.
        """
        shapes = PCAShapePrior.load_bundled() if prior is None else prior
        result = cls._from_state(state, prior=shapes)
        if result.code.shape[1] != shapes.num_codes:
            expected = f"the prior of the result, with {result.code.shape[1]} codes"
            raise InputError("prior", expected, f"one with {shapes.num_codes}", "give the prior of the refiner")
        _check_state(result)
        result = replace(result, prior=_moved_prior(shapes, result.T_cam_obj))
        _check_refined(result.detach())
        return result

    def __repr__(self) -> str:
        """Print counts of the statuses, the meaning of each refusing status, and a table of up to 40 cars.

        If there are more cars, those that were not refined or that got better with a probability below 0.5 are chosen
        first.
        """
        lines = [f"RefinementResult of {len(self)} cars ({self.T_cam_obj.dtype}, {self.T_cam_obj.device})"]
        if not len(self):
            return f"{lines[0]}\n  no cars"
        counts = Counter(self.status)
        lines.append(f"  {counted({status.name: count for status, count in counts.items()})}")
        lines += [f"  {status.name}: {status.value}" for status, _ in counts.most_common() if not status.is_refined]
        shown, left_out = self._printed_rows()
        lines.append("  car      x      y      z  heading  length  mask IoU  better  not worse  status")
        chosen = self.detach()[shown].cpu()
        boxes, quality = chosen.to_boxes("kitti").tolist(), chosen.quality
        is_known = [is_front_known(probability) for probability in quality.probability_heading.tolist()]
        figures = (quality.mask_iou_left, quality.probability_better, quality.probability_not_worse)
        columns = shown.tolist(), boxes, is_known, chosen.status, *(figure.tolist() for figure in figures)
        for row, (x, y, z, _, _, length, heading), known, status, iou, better, not_worse in zip(*columns, strict=True):
            lines.append(
                f"  {row:3d} {x:6.2f} {y:6.2f} {z:6.2f} {heading:8.2f}{' ' if known else '?'}{length:7.2f} {iou:9.2f} "
                f"{better:7.2f} {not_worse:10.2f}  {status.name}"
            )
        if not all(is_known):
            lines.append("  ? either end may be the front (quality.probability_heading)")
        return "\n".join(lines + left_out)

    def _printed_rows(self) -> tuple[Tensor, list[str]]:
        """Rows (N,) of the cars that a print shows, and a sentence on the cars that it leaves out, if there are any."""
        doubtful = (~self.refined | (self.quality.probability_better.detach() < _DOUBTFUL_BELOW)).cpu()
        # The sort is stable: doubtful cars come first, and both groups keep the order of the detections.
        order = torch.argsort(~doubtful, stable=True)
        shown = order[:_PRINTED_CARS].sort().values
        left_out, num_doubtful = len(self) - len(shown), int(doubtful.sum()) - int(doubtful[shown].sum())
        if not left_out:
            return shown, []
        kinds = f"{num_doubtful} of them not refined or doubtful" if num_doubtful else "all refined, none doubtful"
        words = f"{left_out} more cars are not shown, {kinds} (better below {_DOUBTFUL_BELOW})"
        return shown, [f"  {words}; result[rows] shows others"]

    @property
    def status(self) -> list[Status]:
        """Status of each car; `status.value` is its message."""
        return [Status.from_code(code) for code in self.status_code.tolist()]

    @property
    def refined(self) -> Tensor:
        """Whether (B,) the state of each car is a refined one."""
        return is_refined(self.status_code)

    @property
    def T_ref_obj(self) -> Tensor:
        """Poses (B, 4, 4) in the reference frame of labels and result files."""
        shift = torch.zeros_like(self.T_cam_obj)
        shift[:, :3, 3] = self.t_cam_ref
        return self.T_cam_obj - shift

    def boxes(self) -> KittiBoxes:
        """KITTI boxes of the refined zero level, with sub-voxel precision.

        Cars that were not refined have the detector's box.

        The location is `T_ref_obj` of the level's bottom centre (mid x, max y, mid z), not the object origin.
        """
        T_ref_box, dimensions = self._boxes("ref")
        location, rotation_y = T_ref_box[:, :3, 3], rotation_y_from_pose(T_ref_box)
        return KittiBoxes(dimensions, location, rotation_y, alpha_from_kitti(location, rotation_y))

    def to_boxes(
        self, convention: BoxFormat = "kitti", frame: Frame = "cam", T_cam_boxes: Tensor | None = None
    ) -> Tensor:
        """Boxes (B, 7) as numbers in the convention of a detector, which `Detections.from_boxes` takes.

        Args:
            convention: order and meaning of the numbers, see `directshape_torch.geometry.box_formats`.
            frame: "cam" (left camera) or "ref" (reference frame of labels), for camera conventions.
            T_cam_boxes: rigid motion (4, 4) or (B, 4, 4) to the left camera from the frame that the boxes shall have.
                It is needed for LiDAR conventions and replaces `frame`.

        Raises:
            InputError: an unknown convention or frame, or a LiDAR convention without `T_cam_boxes`.
        """
        T_frame_box, dimensions = self._boxes("cam" if T_cam_boxes is not None else frame)
        return poses_to_boxes(T_frame_box, dimensions, convention, T_cam_boxes)

    def corners(self, frame: Frame = "cam") -> Tensor:
        """Corners (B, 8, 3) of the boxes in the order of KITTI's devkit, which `Detections.from_boxes` reads.

        The four corners on the ground come first, from front left to front right and round the box, then the four
        corners above them.

        Raises:
            InputError: a frame that is neither "cam" nor "ref".
        """
        return box_corners(*self._boxes(frame))

    @full_precision()
    def _boxes(self, frame: str) -> tuple[Tensor, Tensor]:
        """Poses (B, 4, 4) of the boxes with origins in the middle of the bottom faces, and dimensions (B, 3)."""
        if frame not in ("ref", "cam"):
            raise InputError("frame", "'cam' or 'ref'", repr(frame))
        T = self.T_ref_obj if frame == "ref" else self.T_cam_obj
        # A car that was not refined keeps the detector's dimensions, not the mean shape's.
        rows = self.refined.nonzero()[:, 0]
        bottom, hwl = level_boxes(self.prior, T[rows], self.code[rows])
        dimensions = self.input_dimensions_hwl.index_copy(0, rows, hwl)
        return se3.from_rotation_translation(T[:, :3, :3], T[:, :3, 3].index_copy(0, rows, bottom)), dimensions

    @property
    def sigma_xyz_yaw(self) -> Tensor:
        """Standard deviations (B, 4) of the box's place in `ref` and of its heading, metres and radians.

        They are NaN for cars that were not refined. They are scales of Student's t of 4 degrees of freedom, fitted to
        cars with labels (docs/results.md), within which 63 % of the errors lie. They include a rig's own disparity
        error as far as the covariance of its field, `rig.disparity_sigma_px` or `Detections.offset_sigma_px` describes
        it.
        """
        return self.covariance_xyz_yaw.diagonal(dim1=1, dim2=2).sqrt()

    @full_precision()
    def mesh(self, index: int) -> trimesh.Trimesh:
        """Surface of one car in the left camera frame, in metres, with outward normals.

        Raises:
            InputError: no such car.
        """
        if not (isinstance(index, Integral) and -len(self) <= index < len(self)):
            raise InputError(
                "index", f"a car of 0..{len(self) - 1}" if len(self) else "no car", f"{shown(index)}: {len(self)} cars"
            )
        values = self.prior.values(self.code[index][None])[0]
        return sdf_to_mesh(values, self.prior.origin, self.prior.spacing_m, T_cam_obj=self.T_cam_obj[index])

    def meshes(self, kind: Literal["trimesh", "pytorch3d"] = "trimesh") -> Any:
        """Surfaces of all cars in the left camera frame: a list of `trimesh.Trimesh`, or one PyTorch3D `Meshes`.

        Cars that were not refined have the mean shape, at the pose of the detector. No gradients flow into meshes.

        Raises:
            InputError: another kind.
            MissingDependencyError: PyTorch3D is asked for and not installed.
        """
        if kind == "trimesh":
            return [self.mesh(row) for row in range(len(self))]
        if kind != "pytorch3d":
            raise InputError("kind", "'trimesh' or 'pytorch3d'", repr(kind))
        try:
            from pytorch3d.structures import Meshes
        except ImportError as error:
            raise MissingDependencyError("pytorch3d", "", 'meshes("pytorch3d")') from error
        like, surfaces = self.T_cam_obj, self.meshes()
        return Meshes(
            verts=[torch.as_tensor(np.array(mesh.vertices)).to(like) for mesh in surfaces],
            faces=[torch.as_tensor(np.array(mesh.faces)).long().to(like.device) for mesh in surfaces],
        )


def _check_state(result: RefinementResult) -> None:
    """Raise `InputError` for words, dtypes or statuses that do not fit; shapes of tensors are checked elsewhere."""
    for name in ("code", "input_dimensions_hwl", "t_cam_ref"):
        check_alike(f"state['{name}']", getattr(result, name), "state['T_cam_obj']", result.T_cam_obj)
    words = {"term_names": result.cost_after.shape[1], "ground_source": len(result)}
    for name, count in words.items():
        if len(getattr(result, name)) != count:
            raise InputError(f"state[{name!r}]", f"{count} words", f"{len(getattr(result, name))}")
    if bool(((result.status_code < 0) | (result.status_code >= len(Status))).any()):
        raise InputError("state['status_code']", f"numbers of 0..{len(Status) - 1}", f"{result.status_code.tolist()}")


def _check_refined(result: RefinementResult) -> None:
    """Raise `InputError` unless refined cars have finite figures, as results of the refiner do."""
    figures = (result.code, result.cost_after, *vars(result.boxes()).values(), result.covariance, result.sigma_xyz_yaw)
    finite = torch.stack([x[:, None].isfinite().flatten(1).all(dim=1) for x in figures]).all(dim=0)
    wrong = (result.refined & ~finite).nonzero().flatten().tolist()
    if wrong:
        expected = "finite boxes and standard deviations of refined cars"
        raise InputError("state", expected, f"none of cars {wrong}", "save result.state_dict() with its own prior")


def _chosen_rows(index: object, count: int) -> Tensor:
    """Numbers of the cars that an index selects by the rules of NumPy."""
    try:
        given = index.detach().cpu().numpy() if isinstance(index, Tensor) else index
        # PyTorch does not support negative strides.
        rows = torch.from_numpy(np.atleast_1d(np.arange(count)[given]).copy())  # type: ignore[call-overload]
        if rows.ndim > 1:
            raise IndexError("an index with several axes")
    except (IndexError, TypeError, ValueError, RuntimeError) as error:
        words = f"a slice, {count} booleans, or cars of 0..{count - 1}" if count else "a slice, for there is no car"
        raise InputError("index", words, shown(index)) from error
    return rows


def _moved_prior(prior: ShapePrior, like: Tensor) -> ShapePrior:
    """The prior with dtype and device of `like`; it is copied only if dtype or device differ."""
    origin = prior.origin
    if not isinstance(prior, nn.Module) or (origin.dtype, origin.device) == (like.dtype, like.device):
        return prior
    moved: ShapePrior = copy.deepcopy(prior).to(like)
    return moved
