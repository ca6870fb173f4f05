"""This script renders stereo frames of a street with parametric cars, in KITTI's layout, with exact ground truth.

    pip install 'directshape_torch[render]'
    python scripts/render_demo_scene.py --out DIR --frames N --seed S [--sequence SECONDS]

Frame k has seed S + k and contains left and right images (1242 x 375), calibration, labels, ground plane, exact
instance masks (COCO RLE), a description of the scene (`meta`: exact poses and measures), and noisy detections as of a
stereo detector. With `--sequence` the frames are of one moving scene (passing parked cars, turning, overtaking or
pulling out, depending on the seed), in the layout of KITTI's tracking benchmark, with tracks, times and the camera's
motion.

Equal seeds give equal scenes; the pixels are equal with the same renderer version and variant. A frame takes minutes (6
with `--cars 4 --paths-per-pixel 1` on two busy cores). The script needs Mitsuba 3 and pyoidn.
`--variant scalar_rgb` runs as installed; `llvm_ad_rgb` (40 s with `--paths-per-pixel 4`) needs an LLVM library of
version 19 (Debian: `apt-get update && apt-get install libllvm19`), because older ones crash.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

from command_line import run_command
from demo_scene.frame import RenderSettings, render_frame, render_sequence
from demo_scene.frame_files import write_frame, write_sequence
from demo_scene.layout import sample_layout
from demo_scene.motion import sample_sequence
from demo_scene.rendering import import_mitsuba


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder that gets training/ and detections/")
    parser.add_argument("--frames", type=int, default=1, help="number of frames (default 1)")
    parser.add_argument(
        "--sequence", type=float, metavar="SECONDS", help="one moving scene, a frame every so many seconds"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the first frame (default 0)")
    parser.add_argument("--cars", type=int, choices=(4, 5, 6), default=None, help="cars a frame (default: 4 to 6)")
    parser.add_argument("--paths-per-pixel", type=int, default=16, help="samples of the path tracer (default 16)")
    parser.add_argument("--variant", default="scalar_rgb", help="Mitsuba's variant (default scalar_rgb)")
    return run_command(parser, run, arguments)


def run(options: argparse.Namespace) -> None:
    """Render and write every frame.

    Raises:
        MissingDependencyError: Mitsuba is not installed.
    """
    import_mitsuba()
    settings = RenderSettings(options.paths_per_pixel, options.variant)
    if options.sequence is not None:
        layouts = sample_sequence(options.seed, options.frames, options.sequence)
        write_sequence(options.out, f"{options.seed:04d}", list(render_sequence(layouts, settings)), options.sequence)
        return
    for k in range(options.frames):
        started = time.perf_counter()
        frame = render_frame(sample_layout(options.seed + k, options.cars), settings)
        write_frame(options.out, f"{k:06d}", frame)
        print(f"{k:06d}: {len(frame.labels)} cars, {time.perf_counter() - started:.0f} s")


if __name__ == "__main__":
    raise SystemExit(main())
