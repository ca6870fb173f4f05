"""The residual disparity field of a data set's rig: given, fitted from the data set's own truth, or none."""

from __future__ import annotations

from pathlib import Path

from directshape_torch.errors import DataFormatError
from directshape_torch.io.kitti_calibration import read_calibration
from directshape_torch.rig.estimate import RigEstimate
from directshape_torch.rig.frames_with_truth import TruthSource, add_truth, observe_frame, truth_files
from directshape_torch.rig.rig_file import save_rigs

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
    rigs: list[RigEstimate] = []
    add_truth(rigs, source, frames)
    save_rigs(path, rigs)
    return path


def _has_one_rig(calib: Path) -> bool:
    rigs = {(c.P2.tobytes(), c.P3.tobytes()) for c in map(read_calibration, sorted(calib.glob("*.txt")))}
    return len(rigs) == 1
