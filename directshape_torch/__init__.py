"""Joint 3D pose and shape refinement of cars from stereo images (DirectShape), in PyTorch."""

from directshape_torch.batch.fit_shape import ShapeFit, fit_shape
from directshape_torch.check.check_scene import check_scene
from directshape_torch.check.finding import CheckReport, Finding
from directshape_torch.config import RefinerConfig
from directshape_torch.errors import (
    ConfigError,
    DataFormatError,
    DirectShapeError,
    InputError,
    MeshError,
    MissingDependencyError,
    ResumeError,
)
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.geometry.ground_plane import GroundPlane
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.config_files import load_config
from directshape_torch.refinement.disparity_profile import DisparityProfile
from directshape_torch.refinement.observability import Observability
from directshape_torch.refinement.quality import FitQuality
from directshape_torch.refinement.result import KittiBoxes, RefinementResult
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.rig.estimate import RigEstimate
from directshape_torch.scene.detections import Detections, Occluders
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.scene.masks import MaskCrops
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.status import Status


def __getattr__(name: str) -> str:
    """`__version__`, looked up only when it is asked for."""
    if name == "__version__":
        from directshape_torch.batch.refine_dataset import package_version

        return package_version()
    raise AttributeError(f"module 'directshape_torch' has no attribute {name!r}")


__all__ = [
    "CheckReport",
    "ConfigError",
    "DataFormatError",
    "Detections",
    "DirectShapeError",
    "DirectShapeRefiner",
    "DisparityField",
    "DisparityProfile",
    "Finding",
    "FitQuality",
    "FrameBatch",
    "GroundPlane",
    "InputError",
    "KittiBoxes",
    "MaskCrops",
    "MeshError",
    "MissingDependencyError",
    "Observability",
    "Occluders",
    "PCAShapePrior",
    "RefinementResult",
    "RefinerConfig",
    "ResumeError",
    "RigEstimate",
    "ShapeFit",
    "ShapePrior",
    "Status",
    "StereoCamera",
    "check_scene",
    "fit_shape",
    "load_config",
]
