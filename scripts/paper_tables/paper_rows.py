"""The paper's table of average precisions (KITTI validation set), as printed there, in percent."""

from __future__ import annotations

from dataclasses import dataclass

from paper_tables.simulated_detector import WantedAp

Figures = tuple[float, ...]


@dataclass(frozen=True)
class PaperRow:
    """A detector, and the same after the paper's refinement.

    Attributes:
        detector: its name.
        before, after: (12,) AP_BEV at 0.5 and 0.7, AP_3D at 0.5 and 0.7, each easy, moderate, hard.
    """

    detector: str
    before: Figures
    after: Figures

    @property
    def wanted(self) -> WantedAp:
        """The moderate figures of the detector itself."""
        return WantedAp(*self.before[1::3])


PAPER_ROWS = (
    PaperRow(
        "Mono3D",
        (11.70, 9.62, 9.32, 2.06, 1.91, 1.39, 9.55, 7.72, 7.23, 0.62, 0.75, 0.76),
        (23.53, 16.54, 15.30, 5.21, 4.02, 3.84, 18.88, 14.31, 11.73, 2.61, 2.09, 2.17),
    ),
    PaperRow(
        "Deep3DBox",
        (29.99, 23.74, 18.81, 9.96, 7.69, 5.29, 26.94, 20.51, 15.85, 5.82, 4.08, 3.83),
        (44.89, 29.99, 24.41, 12.35, 8.88, 7.49, 38.40, 25.39, 20.02, 6.50, 4.38, 4.04),
    ),
    PaperRow(
        "3DOP",
        (48.73, 35.20, 30.95, 12.63, 9.07, 7.12, 40.76, 28.92, 24.31, 5.38, 3.76, 3.25),
        (59.40, 39.43, 33.54, 19.98, 13.40, 11.34, 50.16, 34.66, 29.31, 11.38, 7.36, 6.34),
    ),
    PaperRow(
        "MLF",
        (55.03, 36.73, 31.27, 22.03, 13.76, 11.60, 47.88, 29.48, 26.44, 10.53, 5.69, 5.39),
        (63.10, 37.97, 31.84, 25.58, 15.25, 11.97, 55.12, 34.78, 29.44, 14.59, 8.42, 7.26),
    ),
)
