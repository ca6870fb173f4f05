"""A data set in KITTI's layout refined into a folder from Python, and its results read back.

    python examples/kitti_files.py [--out DIR]

The data set is the one frame that comes with the package; put your own paths in its place.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import directshape_torch
from directshape_torch import DirectShapeRefiner
from directshape_torch.batch.refine_dataset import refine_dataset
from directshape_torch.io.kitti_labels import read_objects
from directshape_torch.io.result_files import read_shapes
from directshape_torch.io.run_folder import result_path, shapes_path
from directshape_torch.io.stereo_dataset import open_dataset

ROOT = Path(directshape_torch.__file__).parent / "assets" / "demo"  # holds training/image_2, image_3, calib, ...


def main(out_dir: Path) -> list[str]:
    """Refine every frame, and say of every car of the first one where it is now."""
    dataset = open_dataset(
        "kitti",
        ROOT,
        ROOT / "detections" / "noisy_stereo",  # KITTI result files: NNNNNN.txt, here or in data/
        ROOT / "training" / "masks",  # COCO results a frame: NNNNNN.json
    )
    summary = refine_dataset(dataset, DirectShapeRefiner(), out_dir)
    print(f"{len(summary.frames)} frames, failed: {summary.failed or 'none'}")

    frame_id = dataset.frame_ids[0]
    objects = read_objects(result_path(out_dir, frame_id))  # a line for each line of the detections, in their order
    shapes = read_shapes(shapes_path(out_dir, frame_id))  # all else: docs/file_formats.md
    lines = []
    for row, number in enumerate(shapes.input_lines.tolist()):
        x, y, z = objects[number - 1].location_ref
        better = shapes.probabilities_better[row]
        where = f"({x:.2f}, {y:.2f}, {z:.2f}) m"
        lines.append(f"line {number}: {shapes.statuses[row]}, {where}, better with probability {better:.2f}")
    print("\n".join(lines))
    return lines


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("kitti_files_out"))
    main(parser.parse_args().out)
