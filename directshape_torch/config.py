"""Settings: one frozen dataclass per concern, units in the names. The defaults are `configs/default.yaml`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from directshape_torch.config_ranges import check_ranges


@dataclass(frozen=True)
class StageConfig:
    """One stage, coarse to fine.

    Attributes:
        contour_width_px: softness of the projected contour; zeta = f / (z_input * contour_width_px).
        image_level: pyramid level of the photometric term; 0 is full resolution.
        max_iterations: Gauss-Newton iterations at most.
        unknowns: which of them move: "both", "pose" or "shape".
        over_relaxation: steps are so many times as long as Gauss-Newton's, but after one that did not pay. Reweighted
            terms bend less than their matrix says, so that plain steps (1, the paper's) stop short.
    """

    contour_width_px: float = 0.5
    image_level: int = 0
    max_iterations: int = 20
    unknowns: Literal["both", "pose", "shape"] = "both"
    over_relaxation: float = 1.0


@dataclass(frozen=True)
class SolverConfig:
    """Damping, acceptance and convergence of the Gauss-Newton loop.

    Attributes:
        initial_damping: Marquardt's mu at the start of a stage; 0 is pure Gauss-Newton.
        damping_decrease, damping_increase: factors after an accepted and a refused step.
        min_damping, max_damping: bounds of mu; a car refused at the upper bound has converged.
        accept_every_step: accept uphill steps too and return the best state seen (the paper's way).
        cost_tolerance: relative decrease of the cost below which a car has converged.
        step_tolerance: largest step, as a share of the trust region, below which a car has converged.
        block_iterations: iterations between two looks at which cars go on.
        max_step_translation_m, max_step_rotation_rad, max_step_code: trust region; the whole step is scaled.
        max_code: bound of |code|, in standard deviations.
        jacobian: "analytic" (hand-derived) or "autograd" (forward mode, several times slower; but for the priors beside
            followed rays, which stay hand-derived): the same steps.
        rays: "tracked" (each ray follows its closest point and its surface from iteration to iteration) or "marched"
            (each ray is sampled anew at each state: the slow reference).
    """

    initial_damping: float = 1e-2
    damping_decrease: float = 0.3
    damping_increase: float = 8.0
    min_damping: float = 1e-7
    max_damping: float = 1e5
    accept_every_step: bool = False
    cost_tolerance: float = 1e-3
    step_tolerance: float = 1e-3
    block_iterations: int = 4
    max_step_translation_m: float = 0.5
    max_step_rotation_rad: float = 0.15
    max_step_code: float = 1.0
    max_code: float = 3.0
    jacobian: Literal["analytic", "autograd"] = "analytic"
    rays: Literal["tracked", "marched"] = "tracked"


@dataclass(frozen=True)
class RigConfig:
    """What is known beforehand of the stereo rig.

    Attributes:
        disparity_sigma_px: standard deviation of the rig's disparity about its calibration, the same for all pixels of
            a car, so that no residual shows it; it enters covariance, sigmas and probabilities, not the estimate. 0 for
            a perfect rig; about 0.1 where a residual disparity field was fitted, 0.5 and more where none was.
    """

    disparity_sigma_px: float = 0.0


@dataclass(frozen=True)
class BackwardConfig:
    """Gradients through the refinement, for training in front of it.

    Attributes:
        mode: "none" (no graph), "unroll" (repeats the last iterations), "implicit" (implicit function theorem at the
            final stage) or "implicit_gauss_newton" (the same with the Gauss-Newton matrix: cheaper, biased).
        unroll_iterations: how many of the last iterations are repeated.
        max_remaining_step: implicit modes give no gradient to cars whose next Newton step would exceed this share of
            the trust region.
    """

    mode: Literal["none", "unroll", "implicit", "implicit_gauss_newton"] = "none"
    unroll_iterations: int = 5
    max_remaining_step: float = 0.1


@dataclass(frozen=True)
class SilhouetteConfig:
    """Silhouette term, left and right.

    Attributes:
        weight: lambda_silh.
        form: "closest_approach" (default) or "product" (the paper's; it dilates the contour).
        samples_per_ray: coarse samples inside the prior's bounds.
        probability_floor: foreground probabilities are clamped to [floor, 1 - floor].
        residual_floor: smallest residual in the reweighting 1/r.
        min_zeta_per_m, max_zeta_per_m: bounds of zeta.
        saturation: |zeta * sdf| beyond which the projection counts as certain and has no gradient (closest approach
            only).
    """

    weight: float = 12.0
    form: Literal["closest_approach", "product"] = "closest_approach"
    samples_per_ray: int = 24
    probability_floor: float = 0.01
    residual_floor: float = 0.01
    min_zeta_per_m: float = 4.0
    max_zeta_per_m: float = 400.0
    saturation: float = 16.0


@dataclass(frozen=True)
class PhotometricConfig:
    """Photometric term, left to right, in grey levels 0..255.

    Attributes:
        weight: factor of the term (the paper: 1).
        huber_grey_levels: corner of the Huber norm (gamma).
        gradient_constant_grey_levels: c of the gradient weight c^2 / (c^2 + |grad I_l|^2).
        lost_grey_levels: a pixel of the set that loses its hit or leaves the right image pays the Huber norm of this.
        truncated: residuals beyond lost_grey_levels (reflections, wrong matches) cost no more than a lost pixel.
        pixel_set: "hit" (the paper) or "hit_and_mask" (hit and p_fg > 0.5).
        min_ray_cosine: rays closer to the surface's tangent are grazing and lost.
        brightness: how that of the two images is matched, car by car at the start of each stage: "gain" (a factor),
            "affine" (a factor and an offset, for cameras of different black level or contrast) or "none" (the paper).
        patch: residuals of a neighbourhood of eight pixels as they are ("plain", the paper), without its brightness
            ("zero_mean") or without its brightness and contrast ("normalised"), wherever in the image they change.
        contrast_floor_grey_levels: standard deviation that a neighbourhood has at least for "normalised".
    """

    weight: float = 1.0
    huber_grey_levels: float = 9.0
    gradient_constant_grey_levels: float = 50.0
    lost_grey_levels: float = 15.0
    truncated: bool = False
    pixel_set: Literal["hit", "hit_and_mask"] = "hit_and_mask"
    min_ray_cosine: float = 0.1
    brightness: Literal["none", "gain", "affine"] = "gain"
    patch: Literal["plain", "zero_mean", "normalised"] = "plain"
    contrast_floor_grey_levels: float = 5.0


@dataclass(frozen=True)
class PointCloudConfig:
    """Point cloud from dense stereo, for the methods "geometric" (Engelmann et al., GCPR 2016) and "combined".

    Attributes:
        weight: factor of the mean Huber norm of the signed distances, per square metre, for "geometric".
        combined_weight: the same for "combined": beside the images less is better.
        huber_m: corner of the Huber norm.
        matcher: disparity where the frames bring none: "sgbm" (OpenCV) or "elas" (optional package).
        pixels: points of the left instance "mask" where there is one, else of the 2D box; or always of the "box".
        min_height_m, max_height_m: points between these heights above the ground plane count.
        max_distance_m: and within this distance of the detection's centre, along the ground.
        min_points: with fewer of them "geometric" leaves the car alone (status too_few_points) and "combined" has the
            images only.
        max_points: of more, every n-th is used.
        order: "alternating" (pose, then shape, as in the paper by Engelmann et al.) or "joint", for "geometric"; the
            other methods follow `stages`.
        rounds: of the alternation at most; once the cost has settled the rest changes nothing.
        max_iterations: Gauss-Newton iterations of one half of a round, or of the joint refinement.
    """

    weight: float = 300.0
    combined_weight: float = 30.0
    huber_m: float = 0.1
    matcher: Literal["sgbm", "elas"] = "sgbm"
    pixels: Literal["mask", "box"] = "mask"
    min_height_m: float = 0.1
    max_height_m: float = 3.0
    max_distance_m: float = 2.5
    min_points: int = 200
    max_points: int = 1000
    order: Literal["alternating", "joint"] = "alternating"
    rounds: int = 8
    max_iterations: int = 4


@dataclass(frozen=True)
class PriorConfig:
    """Priors on shape and pose.

    Attributes:
        shape_weight: lambda_1, on the whitened code.
        height_weight: lambda_2, on the object origin's height above the ground plane in metres.
        tilt_weight: lambda_3.
        tilt_form: "normal" (two components of the ground normal in the object frame) or "cosine" (the paper's, whose
            Jacobian vanishes at its optimum).
        dimensions_weight: on the difference between the shape's dimensions and the detector's, in units of
            dimensions_sigma_m; 0 switches it off (the paper).
        dimensions_sigma_m: standard deviation of the detector's height, width and length.
        pose_weight: on the difference between the pose and the detector's, in units of the detector's standard
            deviations: those of the detections where they have some, else those below; without either it does nothing.
        pose_sigma_along_share, pose_sigma_along_m: standard deviation of the detector's position along the viewing ray
            on the ground, as a share of the distance and in metres (both: the root of the sum of squares); 0 for not
            known, as in the next three.
        pose_sigma_across_m: across the viewing ray, on the ground.
        pose_sigma_vertical_m: along the camera's y axis.
        pose_sigma_yaw_deg: of the heading.
    """

    shape_weight: float = 0.15
    height_weight: float = 10.0
    tilt_weight: float = 1000.0
    tilt_form: Literal["normal", "cosine"] = "normal"
    dimensions_weight: float = 0.5
    dimensions_sigma_m: tuple[float, float, float] = (0.1, 0.1, 0.4)
    pose_weight: float = 0.2
    pose_sigma_along_share: float = 0.0
    pose_sigma_along_m: float = 0.0
    pose_sigma_across_m: float = 0.0
    pose_sigma_vertical_m: float = 0.0
    pose_sigma_yaw_deg: float = 0.0


@dataclass(frozen=True)
class SamplingConfig:
    """Which pixels are used.

    Attributes:
        mode: "adaptive" (both rounds of the paper), "round_one", "uniform" or "dense".
        mode_right: the same for the right image, whose pixels serve the silhouette alone; "as_left": that of the left.
        density: share of the region's pixels.
        min_pixels, max_pixels: bounds of the number of cells.
        region_margin_px, region_margin_share: the region is grown by the larger of the two.
        occlusion_order: "depth" (default) or "box_bottom" (the paper).
        min_usable_pixels: cars with fewer pixels get the status too_few_pixels.
        occlusion: leave out pixels that a nearer instance hides.
    """

    mode: Literal["adaptive", "round_one", "uniform", "dense"] = "adaptive"
    mode_right: Literal["as_left", "adaptive", "round_one", "uniform", "dense"] = "uniform"
    density: float = 0.05
    min_pixels: int = 400
    max_pixels: int = 1000
    region_margin_px: float = 4.0
    region_margin_share: float = 0.1
    occlusion_order: Literal["depth", "box_bottom"] = "depth"
    min_usable_pixels: int = 20
    occlusion: bool = True


@dataclass(frozen=True)
class SearchConfig:
    """States tried before the first step; the cheapest one is kept (the input is always among them).

    Attributes:
        disparity_offsets_px: the car is moved along its viewing ray by these disparities.
        yaw_offsets_deg: and turned by these angles.
    """

    disparity_offsets_px: tuple[float, ...] = ()
    yaw_offsets_deg: tuple[float, ...] = ()


@dataclass(frozen=True)
class AcceptanceConfig:
    """Which results are returned; the input stands in for the others (status not_trusted).

    Attributes:
        min_probability_better: of overlapping the true box more than the input does, seen from above, as far as the
            course of the refinement tells (docs/results.md, "When to trust a result").
        min_probability_not_worse: of not falling short of the input's overlap by more than 0.05. 0 and 0 return every
            result.
    """

    min_probability_better: float = 0.0
    min_probability_not_worse: float = 0.8


@dataclass(frozen=True)
class RefinerConfig:
    """Everything `DirectShapeRefiner` can be told.

    Attributes:
        method: terms of the energy: "direct" (images), "geometric" (the rival's: point cloud) or "combined" (both).
        compile: compile the hot functions: "on", "off", or "auto" where there is a C++ compiler and the job, or the
            process so far if nobody knows, has at least 3000 cars. Results differ in the last digits, so a choice
            makes runs repeatable to the bit, whatever came before them.
    """

    method: Literal["direct", "geometric", "combined"] = "direct"
    compile: Literal["auto", "on", "off"] = "auto"
    stages: tuple[StageConfig, ...] = (
        StageConfig(contour_width_px=2.0, image_level=1, max_iterations=6, over_relaxation=1.6),
        StageConfig(contour_width_px=0.5, image_level=0, max_iterations=6, over_relaxation=1.6),
    )
    solver: SolverConfig = field(default_factory=SolverConfig)
    silhouette: SilhouetteConfig = field(default_factory=SilhouetteConfig)
    photometric: PhotometricConfig = field(default_factory=PhotometricConfig)
    point_cloud: PointCloudConfig = field(default_factory=PointCloudConfig)
    priors: PriorConfig = field(default_factory=PriorConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    search: SearchConfig = field(default_factory=SearchConfig)
    rig: RigConfig = field(default_factory=RigConfig)
    acceptance: AcceptanceConfig = field(default_factory=AcceptanceConfig)
    backward: BackwardConfig = field(default_factory=BackwardConfig)

    def __post_init__(self) -> None:
        check_ranges(self)
