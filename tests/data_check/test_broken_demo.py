"""The bundled frame broken in every way that is known, and what is said about it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers.broken_data import BREAKS, copy_data

import directshape_torch
from directshape_torch.data_check import check_dataset as checks
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.scene_check import check_images
from directshape_torch.scene_check.finding import CheckReport

DEMO = Path(directshape_torch.__file__).parent / "assets" / "demo"


def once(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same images give the same answer: matching is the slow part and most breaks leave the images alone."""
    answers: dict[tuple[str, ...], Any] = {}

    def remembered(*images: Any) -> Any:
        key = tuple(hashlib.sha256(image.tobytes()).hexdigest() for image in images)
        if key not in answers:
            answers[key] = function(*images)
        return answers[key]

    return remembered


@pytest.fixture(scope="module", autouse=True)
def match_once() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(check_images, "match_pair", once(check_images.match_pair))
        yield


@pytest.fixture(scope="module")
def report_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str | None], CheckReport]:
    """What is said of the frame broken in a way, or of the intact one; each worked out once."""
    reports: dict[str | None, CheckReport] = {}

    def report(name: str | None) -> CheckReport:
        if name not in reports:
            detections, masks = DEMO / "detections" / "noisy_stereo" / "data", DEMO / "training" / "masks"
            root = copy_data(DEMO, detections, masks, tmp_path_factory.mktemp("data") / "data")
            if name is not None:
                BREAKS[name].apply(root)
            reports[name] = checks.check_dataset(open_dataset("kitti", root, root / "detections", root / "masks"))
        return reports[name]

    return report


def test_the_intact_frame_has_no_finding(report_of: Callable[[str | None], CheckReport]) -> None:
    report = report_of(None)
    assert report.findings == ()
    assert (report.num_frames, report.num_checked, report.num_cars, report.exit_code) == (1, 1, 6, 0)


# Where one mistake must be one finding: what follows from it is not reported as further ones.
ALONE = {
    "left and right images swapped",
    "right image turned by 0.3 degrees",
    "box centre for bottom",
    "order l w h",
    "masks of the other side",
    "baseline not times focal length",
}


@pytest.mark.parametrize("name", sorted(BREAKS))
def test_a_break_is_found(name: str, report_of: Callable[[str | None], CheckReport]) -> None:
    report = report_of(name)
    found = {finding.check for finding in report.findings}
    assert found & BREAKS[name].checks, f"found only {found}"
    for finding in report.findings:
        assert all((finding.where, finding.measured, finding.expected, finding.cure))
    if name in ALONE:
        assert found == BREAKS[name].checks
        assert report.exit_code == 1
