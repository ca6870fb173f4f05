"""What a method is made of: its terms, and the stages in which they are minimised."""

from __future__ import annotations

from directshape_torch.config import RefinerConfig, StageConfig
from directshape_torch.energy.car_batch import CarBatch
from directshape_torch.energy.direct_terms import direct_terms
from directshape_torch.energy.geometric_terms import combined_terms, geometric_terms
from directshape_torch.energy.term import Term
from directshape_torch.errors import ConfigError
from directshape_torch.observation.packing import Observation
from directshape_torch.scene import Detections, FrameBatch
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.stereo_matching.car_points import PointSamples

# Those of "point_cloud" hold for the methods with points, the first two for the others.
_WEIGHTS = "silhouette.weight, photometric.weight, point_cloud.weight or combined_weight, priors.*_weight"


def method_terms(
    config: RefinerConfig,
    prior: ShapePrior,
    frames: FrameBatch,
    detections: Detections,
    cars: CarBatch,
    observation: Observation,
    points: PointSamples | None,
) -> list[Term]:
    """The terms of `config.method`.

    Args:
        config, prior, frames, detections, cars, observation: as for `direct_terms`.
        points: stereo points of the cars; None for the method "direct".

    Raises:
        ConfigError: every term has weight zero, so there is nothing to minimise.
    """
    if config.method == "geometric" and points is not None:
        terms = geometric_terms(config, prior, cars, points)
    else:
        terms = direct_terms(config, prior, frames, detections, cars, observation)
        terms = terms if points is None else combined_terms(config, terms, points)
    if not terms:
        raise ConfigError(f"method {config.method}: expected a term of weight above 0, got none: {_WEIGHTS}")
    return terms


def method_stages(config: RefinerConfig) -> list[StageConfig]:
    """The stages of `config.method`: rounds of its own for "geometric", else those of the configuration.

    Example:
        >>> from directshape_torch.config_files import load_config
        >>> stages = method_stages(load_config(None, ["method=geometric", "point_cloud.rounds=2"]))
        >>> [stage.unknowns for stage in stages]
        ['pose', 'shape', 'pose', 'shape']
    """
    if config.method != "geometric":
        return list(config.stages)
    # Contour and pyramid level mean nothing to a point cloud: the last stage's, for whoever draws or measures.
    last, cloud = config.stages[-1], config.point_cloud
    pose_stage, shape_stage, joint_stage = (
        StageConfig(last.contour_width_px, last.image_level, cloud.max_iterations, unknowns=unknowns)
        for unknowns in ("pose", "shape", "both")
    )
    return [pose_stage, shape_stage] * cloud.rounds if cloud.order == "alternating" else [joint_stage]
