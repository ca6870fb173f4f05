"""The residual disparity field of a data set's rig: given, fitted from the data set's own truth, or none."""

from __future__ import annotations

from pathlib import Path

from directshape_torch.rig.disparity_observations import concatenate
from directshape_torch.rig.fit_disparity_field import fit_disparity_field
from directshape_torch.rig.frames_with_truth import TruthSource, check_one_rig, observe_frame, truth_files
from directshape_torch.errors import DataFormatError
from directshape_torch.io.kitti_calibration import read_calibration

# One frame fits the field; more cost time only.
_FRAMES = 5


def field_file(root: Path, source: TruthSource, out: Path) -> Path | None:
    """A field fitted from the first frames that have this kind of truth, kept in `out`; None where it cannot be.

    A field belongs to one rig: where the calibrations of the data set differ (a full KITTI), or where there is no such
    truth, there is none.

    Args:
        root: folder that holds `training`.
        source: "disparity" (training/disp_occ_0) or "lidar" (training/velodyne).
        out: folder to keep it in.
    """
    path = out / f"{root.name}-{source}.json"
    if path.is_file():
        return path
    try:
        files = truth_files(root, source)
    except DataFormatError:
        # No truth of this kind, which is no fault of the data set.
        return None
    if not _has_one_rig(root / "training" / "calib"):
        return None
    frames = [observe_frame(root, frame_id, file, source) for frame_id, file in list(files.items())[:_FRAMES]]
    check_one_rig(frames)
    observations = concatenate([frame.observations for frame in frames])
    names = tuple(frame.frame_id for frame in frames)
    out.mkdir(parents=True, exist_ok=True)
    fit_disparity_field(observations, frames[0].size_wh, frames[0].camera, source, names).field.save(path)
    return path


def _has_one_rig(calib: Path) -> bool:
    rigs = {(c.P2.tobytes(), c.P3.tobytes()) for c in map(read_calibration, sorted(calib.glob("*.txt")))}
    return len(rigs) == 1
