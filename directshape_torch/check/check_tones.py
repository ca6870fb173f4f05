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
    """The most severe finding from the levels of two images (H, W, 3), of each and compared, or none."""
    greys = {"left": left @ _GREY, "right": right @ _GREY}
    for side, grey in greys.items():
        if finding := _check_side(grey, f"{where}, {side} image"):
            return [finding]
    rows = [grey.mean(axis=1) for grey in greys.values()]
    correlation = float(np.corrcoef(*rows)[0, 1]) if min(row.std() for row in rows) > 1 else 1.0
    if correlation < _LEAST_CORRELATION:
        measured = f"rows that are bright in one image are dark in the other (correlation {correlation:.2f})"
        return [_tones("error", where, measured, "invert the image that is a negative: 255 - image")]
    colours = [image.mean(axis=1) for image in (left, right)]
    as_they_are, exchanged = (float(np.abs(colours[0] - other).mean()) for other in (colours[1], colours[1][:, ::-1]))
    if accepted((-as_they_are, -exchanged), max(_EXCHANGED_SHARE * as_they_are, _EXCHANGED_LEVELS)):
        measured = (
            f"colours differ by {as_they_are:.1f} levels between the images, and by {exchanged:.1f} with red and blue "
            "exchanged in one of them"
        )
        return [_tones("warning", where, measured, "give both images as RGB: OpenCV reads BGR, image[..., ::-1]")]
    quantiles = [np.percentile(grey, _QUANTILES) for grey in greys.values()]
    apart = float(np.abs(quantiles[0] - quantiles[1]).max())
    if apart > _MOST_APART:
        medians = " and ".join(f"{quantile[2]:.0f}" for quantile in quantiles)
        measured = f"grey levels differ by up to {apart:.0f} between the images (medians {medians})"
        cure = "expose and convert both cameras alike: gain, gamma, number of bits"
        return [_tones("warning", where, measured, cure)]
    return []


def _check_side(grey: Floats, where: str) -> Finding | None:
    brightest, spread = float(np.percentile(grey, 99)), float(grey.std())
    saturated = float((grey > 253).mean())
    if spread < _LEAST_SPREAD and brightest >= _DARK_LEVEL:
        cure = "check the file: the image shows nothing"
        return _tones("error", where, f"grey levels spread by {spread:.1f} alone", cure)
    if brightest < _DARK_LEVEL:
        measured = f"99 % of the pixels are darker than {brightest:.0f} of 255"
        cure = "use the whole range: images of 10 or 12 bits are scaled to 8 or 16 before they are written"
        return _tones("warning", where, measured, cure)
    if saturated > _MOST_SATURATED:
        measured = f"{saturated:.0%} of the pixels are white".replace("%", " %")
        cure = "check exposure and conversion: what is white has no texture to compare"
        return _tones("warning", where, measured, cure)
    return None


def _tones(severity: Severity, where: str, measured: str, cure: str) -> Finding:
    return found("grey_levels", where, measured, severity=severity, cure=cure)
