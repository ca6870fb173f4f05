"""This script compares gradients through refinements with finite differences, in every mode with every option.

Each input of a refinement is moved along one direction, and the weighted sum of a car's outputs is differentiated
twice: by the backward mode, and by central differences of the refinement itself, at two steps. If the two steps differ
by more than 5 %, the refinement jumps there, and the pair is excluded and counted. Errors are relative to the
differences. A car to which a mode gives no gradient, with a warning, is excluded and counted too.

Cars are those of the bundled frame, unchanged except for fewer pixels, or two of a small drawn street whose iterations
converge to the root of the gradient, as the implicit modes need. All values are float64.

    python scripts/check_backward.py --out backward
    python scripts/check_backward.py --scene street --option default "silhouette.form=product" --mode implicit

The table is printed and written as `backward.md`; docs/gradients.md summarises it.
"""

from __future__ import annotations

import argparse
import copy
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from command_line import run_command
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

from helpers.synthetic_scene import cached_street, disturbed

from directshape_torch import Detections, DirectShapeRefiner, FrameBatch, PCAShapePrior, RefinerConfig, load_config
from directshape_torch.errors import ConfigError
from directshape_torch.files.atomic_files import write_text
from directshape_torch.geometry.box3d import pose_from_kitti, rotation_y_from_pose
from directshape_torch.laboratory.scenes import load_scene, select_detections
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.solver.differentiate import NotStationaryWarning

MODES = ("unroll", "implicit", "implicit_gauss_newton")
THINNED = (
    "backward.unroll_iterations=1000",
    "sampling.min_pixels=150",
    "sampling.max_pixels=150",
    "acceptance.min_probability_better=0",
    "acceptance.min_probability_not_worse=0",
    "rig.disparity_sigma_px=0",
    # The weights of images and detector are constants of the derivatives.
    "priors.detector_weight=0",
)
_POINTS_ALONE = (
    "silhouette.weight=0",
    "photometric.weight=0",
    "point_cloud.weight=300",
    "point_cloud.min_points=20",
)
# These are the changes of the default settings for each row of the table.
OPTIONS: dict[str, tuple[str, ...]] = {
    "default": (),
    "brightness none": ("photometric.brightness=none",),
    "brightness affine": ("photometric.brightness=affine",),
    "silhouette product": ("silhouette.form=product",),
    "pixel set hit": ("photometric.pixel_set=hit",),
    "tilt cosine": ("priors.tilt_form=cosine",),
    "unknown offset": ("rig.disparity_sigma_px=0.3",),
    "plain steps": (
        "stages=[{contour_width_px: 2.0, image_level: 1, max_iterations: 6}, {contour_width_px: 0.5, image_level: 0, "
        "max_iterations: 6}]",
    ),
    "points alone, in turn": (
        *_POINTS_ALONE,
        f"stages=[{', '.join(['{max_iterations: 4, unknowns: pose}', '{max_iterations: 4, unknowns: shape}'] * 8)}]",
    ),
    "points alone": (*_POINTS_ALONE, "stages=[{max_iterations: 4}]"),
    "points beside images": ("point_cloud.weight=30", "point_cloud.min_points=20"),
}
# These settings take undamped steps to the root of the gradient, on masks of few pixels.
SETTLED = (
    "stages=[{contour_width_px: 2.0, image_level: 1, max_iterations: 10}, {contour_width_px: 1.0, image_level: 0, "
    "max_iterations: 40}]",
    "solver.cost_tolerance=0",
    "solver.step_tolerance=1e-9",
    "solver.accept_every_step=true",
    "solver.initial_damping=0",
    "silhouette.samples_per_ray=32",
    "priors.dimensions_weight=1",
    "sampling.mode_right=adaptive",
    "acceptance.min_probability_better=0",
    "acceptance.min_probability_not_worse=0",
    "backward.unroll_iterations=1000",
)
_STEP, _SMALLER_STEP = 1e-6, 2.5e-7
_KINK = 0.05


@dataclass(frozen=True)
class Scene:
    """A `Scene` has the cars, their settings without the options, and the directions in which inputs are moved."""

    frames: FrameBatch
    detections: Detections
    prior: PCAShapePrior
    settings: Sequence[str]
    directions: Mapping[str, Tensor]

    @classmethod
    def of_demo(cls, num_cars: int) -> Scene:
        """The first cars of the bundled frame."""
        loaded = load_scene(None, None, None, None)
        found = loaded.detections.to(dtype=torch.float64)
        detections = select_detections(found, torch.arange(num_cars))
        frames = loaded.frame.to(dtype=torch.float64)
        return cls._of(frames, detections, PCAShapePrior.load_bundled().double(), THINNED)

    @classmethod
    def of_street(cls, num_cars: int) -> Scene:
        """The cars of the street that the tests draw."""
        prior, street = cached_street()
        detections = select_detections(disturbed(street.detections), torch.arange(min(num_cars, 2)))
        return cls._of(street.frames, detections, prior, SETTLED)

    @classmethod
    def _of(cls, frames: FrameBatch, detections: Detections, prior: PCAShapePrior, settings: Sequence[str]) -> Scene:
        """A scene with standard deviations of the detector and unclamped masks, since clamping has no gradient."""
        sigma = detections.score.new_tensor([0.6, 0.2, 0.1, 0.1]).expand(len(detections), 4)
        left, right = (x.dense().clamp(0.1, 0.9) for x in (detections.mask_left, detections.mask_right))
        detections = replace(detections, pose_sigma=sigma, mask_left=left, mask_right=right)
        generator = torch.Generator().manual_seed(5)
        inputs = {"left image": frames.images_left, "right image": frames.images_right, "masks": left}
        noise = {name: 0.05 * torch.randn(x.shape, generator=generator, dtype=x.dtype) for name, x in inputs.items()}
        return cls(frames, detections, prior, settings, noise)


SCENES: dict[str, Callable[[int], Scene]] = {"bundled": Scene.of_demo, "street": Scene.of_street}
BOX = ("x", "y", "z", "heading", "height", "width", "length")
INPUTS = (*BOX, "pose_sigma", "left image", "right image", "masks", "prior mean", "prior basis", "term weight")


def refined(scene: Scene, config: RefinerConfig, by: Mapping[str, Tensor]) -> RefinementResult:
    """The result with inputs moved by `by[name]`, which is (B,) for the box, else one number."""
    frames, d = scene.frames, scene.detections
    at = {name: by.get(name, torch.zeros((), dtype=torch.float64)) for name in INPUTS}
    shift = torch.stack([at[name].expand(len(d)) for name in BOX], dim=1)
    location = d.T_cam_obj[:, :3, 3] + shift[:, :3]
    T_cam_obj = pose_from_kitti(location, rotation_y_from_pose(d.T_cam_obj) + shift[:, 3])
    detections = replace(
        d,
        T_cam_obj=T_cam_obj,
        dimensions_hwl=d.dimensions_hwl + shift[:, 4:],
        pose_sigma=None if d.pose_sigma is None else d.pose_sigma * (1 + at["pose_sigma"]),
        mask_left=d.mask_left.dense() + at["masks"] * scene.directions["masks"],
    )
    frames = replace(
        frames,
        images_left=frames.images_left + at["left image"] * scene.directions["left image"],
        images_right=frames.images_right + at["right image"] * scene.directions["right image"],
    )
    prior = copy.deepcopy(scene.prior)
    prior.mean = prior.mean + at["prior mean"]
    prior.basis = prior.basis * (1 + at["prior basis"])
    refiner = DirectShapeRefiner(prior, config)
    weighted = "silhouette_left" if config.fits_images else "point_cloud"
    return refiner(frames, detections, {weighted: (1 + at["term weight"]).expand(len(d))})


def outputs(result: RefinementResult) -> Tensor:
    """One number (B,) for each car that depends on its position, heading and shape."""
    weight = torch.linspace(0.5, 1.0, result.code.shape[1], dtype=result.code.dtype)
    place = result.T_cam_obj[:, :3, 3].sum(dim=1) + 2 * rotation_y_from_pose(result.T_cam_obj)
    return place + 0.3 * (result.code * weight).sum(dim=1)


def differences(scene: Scene, config: RefinerConfig, step: float, inputs: Sequence[str] = INPUTS) -> Tensor:
    """Central differences (inputs, B) of the refinement itself."""

    def at(name: str, by: float) -> Tensor:
        with torch.no_grad():
            return outputs(refined(scene, config, {name: torch.tensor(by, dtype=torch.float64)}))

    return torch.stack([(at(name, step) - at(name, -step)) / (2 * step) for name in inputs])


def gradients(scene: Scene, config: RefinerConfig, inputs: Sequence[str] = INPUTS) -> Tensor:
    """Gradients (inputs, B) of the backward mode."""
    zero = torch.zeros((), dtype=torch.float64)
    by = {name: zero.clone().requires_grad_() for name in inputs}
    found = outputs(refined(scene, config, by))
    columns = []
    for car in range(len(found)):
        leaves = list(by.values())
        columns.append(torch.stack(torch.autograd.grad(found[car], leaves, retain_graph=True, materialize_grads=True)))
    return torch.stack(columns, dim=1)


@dataclass(frozen=True)
class Row:
    """A `Row` has an option's differences at two steps, each (inputs, B), and gradients by mode, None if refused."""

    option: str
    numeric: Tensor
    numeric_smaller: Tensor
    gradients: Mapping[str, Tensor | None]

    @property
    def smooth(self) -> Tensor:
        """Whether both differences agree (inputs, B)."""
        scale = self.numeric.abs().maximum(self.numeric_smaller.abs())
        return (self.numeric - self.numeric_smaller).abs() <= _KINK * scale + 1e-7

    def errors(self, mode: str) -> str:
        """Text with the errors of the box and of the other inputs, over cars that have a gradient."""
        found = self.gradients[mode]
        if found is None:
            return "refused"
        # Errors are relative to the differences, but absolute for differences below a thousandth.
        error = (found - self.numeric_smaller).abs() / self.numeric_smaller.abs().clamp_min(1e-3)
        has_gradient = (found != 0).any(dim=0)
        counted = self.smooth & has_gradient
        parts = (slice(None, len(BOX)), slice(len(BOX), None))
        numbers = [
            f"{float(x.median()):.0e} / {float(x.max()):.0e}" for x in (error[p][counted[p]] for p in parts) if len(x)
        ]
        lost = int((~has_gradient).sum())
        return ", ".join([*numbers, *([f"{lost} without"] if lost else [])])

    def cells(self) -> list[str]:
        """The cells of the table."""
        counts = (str(int(part.sum())) for part in (self.smooth, ~self.smooth))
        return [self.option, *counts, *(self.errors(mode) for mode in self.gradients)]


def study(scene: Scene, options: Sequence[str], modes: Sequence[str], report: Callable[[str], None]) -> list[Row]:
    """The rows of all options."""
    rows = []
    for option in options:
        settings = [*scene.settings, *OPTIONS.get(option, (option,) if "=" in option else ())]
        # A mode is set, because modes march their rays under `no_grad` too.
        config = load_config(None, [*settings, "backward.mode=unroll"])
        numeric, smaller = (differences(scene, config, step) for step in (_STEP, _SMALLER_STEP))
        rows.append(Row(option, numeric, smaller, {mode: _by_mode(scene, settings, mode) for mode in modes}))
        report(" | ".join(rows[-1].cells()))
    return rows


def _by_mode(scene: Scene, settings: Sequence[str], mode: str) -> Tensor | None:
    try:
        config = load_config(None, [*settings, f"backward.mode={mode}"])
    except ConfigError:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotStationaryWarning)
        return gradients(scene, config)


def as_markdown(rows: Sequence[Row]) -> str:
    """The table of docs/gradients.md: median / largest error of the box, and of the other inputs."""
    header = ("option", "pairs", "at jumps", *rows[0].gradients)
    lines = [header, ("---",) * len(header), *(row.cells() for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def run(args: argparse.Namespace) -> None:
    """Study the gradients, print and write."""
    scene = SCENES[args.scene](args.cars)
    rows = study(scene, args.option, args.mode, lambda line: print(line, file=sys.stderr))
    print(as_markdown(rows), end="")
    if args.out is not None:
        write_text(args.out / "backward.md", as_markdown(rows))


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--option", nargs="+", default=list(OPTIONS), metavar="NAME", help="default all; or KEY=VALUE")
    parser.add_argument("--mode", nargs="+", default=list(MODES), choices=MODES, help="default all")
    parser.add_argument("--scene", choices=tuple(SCENES), default="bundled", help="default bundled")
    parser.add_argument("--cars", type=int, default=2, metavar="N", help="of the scene (default 2)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="for backward.md")
    torch.set_num_threads(1)
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
