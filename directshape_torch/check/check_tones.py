"""This module checks whether grey levels are those of photographs and alike on both sides, as photometry needs."""

from __future__ import annotations

import numpy as np

from directshape_torch.check.car_evidence import Floats, Image
from directshape_torch.check.finding import Finding, Severity
from directshape_torch.check.hypotheses import accepted
from directshape_torch.check.mistakes import found

# For 72 real and rendered pairs the 99th percentile is at least 219, the quantiles of the sides differ by at most 15,
# at most 16 % are saturated, and the rows of the two sides correlate by at least 0.94.
_DARK_LEVEL, _LEAST_SPREAD, _MOST_SATURATED = 64.0, 4.0, 0.5
_MOST_APART, _LEAST_CORRELATION = 30.0, -0.3
# Colours must be more alike by this, as a share and in levels, if red and blue are exchanged on one side.
_EXCHANGED_SHARE, _EXCHANGED_LEVELS = 0.3, 2.0
_QUANTILES = (5, 25, 50, 75, 95)
_GREY = np.array([0.299, 0.587, 0.114])


def check_tones(left: Image, right: Image, where: str) -> list[Finding]:
    """The first finding from the levels of two images (H, W, 3), of each and compared, or none."""
    greys = {"left": left @ _GREY, "right": right @ _GREY}
    wrong = [
        (f"{where}, {side} image", *said) for side, grey in greys.items() if (said := _wrong_in_one(grey)) is not None
    ]
    if not wrong and (said := _wrong_in_both(left, right, *greys.values())) is not None:
        wrong = [(where, *said)]
    return [found("grey_levels", at, measured, severity=how, cure=cure) for at, how, measured, cure in wrong[:1]]


def _wrong_in_one(grey: Floats) -> tuple[Severity, str, str] | None:
    brightest, spread, saturated = float(np.percentile(grey, 99)), float(grey.std()), float((grey > 253).mean())
    if spread < _LEAST_SPREAD and brightest >= _DARK_LEVEL:
        return "error", f"grey levels spread by {spread:.1f} alone", "check the file: the image shows nothing"
    if brightest < _DARK_LEVEL:
        cure = "use the whole range: images of 10 or 12 bits are scaled to 8 or 16 before they are written"
        return "warning", f"99 % of the pixels are darker than {brightest:.0f} of 255", cure
    if saturated > _MOST_SATURATED:
        measured = f"{saturated:.0%} of the pixels are white".replace("%", " %")
        return "warning", measured, "check exposure and conversion: what is white has no texture to compare"
    return None


def _wrong_in_both(left: Image, right: Image, *greys: Floats) -> tuple[Severity, str, str] | None:
    rows = [grey.mean(axis=1) for grey in greys]
    correlation = float(np.corrcoef(*rows)[0, 1]) if min(row.std() for row in rows) > 1 else 1.0
    if correlation < _LEAST_CORRELATION:
        measured = f"rows that are bright in one image are dark in the other (correlation {correlation:.2f})"
        return "error", measured, "invert the image that is a negative: 255 - image"
    colours = [image.mean(axis=1) for image in (left, right)]
    given, exchanged = (float(np.abs(colours[0] - other).mean()) for other in (colours[1], colours[1][:, ::-1]))
    if accepted((-given, -exchanged), max(_EXCHANGED_SHARE * given, _EXCHANGED_LEVELS)):
        measured = f"colours differ by {given:.1f} levels between the images, and by {exchanged:.1f} with red and blue "
        cure = "give both images as RGB: OpenCV reads BGR, image[..., ::-1]"
        return "warning", f"{measured}exchanged in one of them", cure
    quantiles = [np.percentile(grey, _QUANTILES) for grey in greys]
    apart = float(np.abs(quantiles[0] - quantiles[1]).max())
    if apart <= _MOST_APART:
        return None
    medians = " and ".join(f"{quantile[2]:.0f}" for quantile in quantiles)
    measured = f"grey levels differ by up to {apart:.0f} between the images (medians {medians})"
    return "warning", measured, "expose and convert both cameras alike: gain, gamma, number of bits"
