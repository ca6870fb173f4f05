"""Masks as a network gives them (arrays), written as COCO result lists and matched to 3D boxes of another detector.

    python examples/coco_masks.py [--out DIR]

`coco_results` is what you would copy if your network does not write such lists itself; Detectron2 and mmdet do.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as coco_mask

import directshape_torch
from directshape_torch import DirectShapeRefiner, RefinementResult
from directshape_torch.io.mask_files import CocoFileMasks
from directshape_torch.io.stereo_dataset import open_dataset

ROOT = Path(directshape_torch.__file__).parent / "assets" / "demo"
DETECTIONS = ROOT / "detections" / "noisy_stereo"
CAR = 3  # COCO's category


def coco_results(image_id: int, masks: Iterable[tuple[NDArray[np.bool_], float]]) -> list[dict[str, Any]]:
    """Entries of a COCO result list from the masks (H, W) of one image and their scores."""
    entries = []
    for mask, score in masks:
        rle = coco_mask.encode(np.asfortranarray(mask.astype(np.uint8)))
        segmentation = {"size": list(rle["size"]), "counts": rle["counts"].decode("ascii")}
        entries.append({"image_id": image_id, "category_id": CAR, "score": score, "segmentation": segmentation})
    return entries


def main(out_dir: Path) -> RefinementResult:
    """Write the lists of both images of the bundled frame, then refine its boxes with them."""
    out_dir.mkdir(parents=True, exist_ok=True)
    given = open_dataset("kitti", ROOT, DETECTIONS, ROOT / "training" / "masks").load("000000").detections
    files = {}
    for side, masks in (("left", given.mask_left), ("right", given.mask_right)):
        network_output = [(mask.numpy() > 0.5, 0.9) for mask in masks if mask.any()]
        files[side] = out_dir / f"{side}.json"
        files[side].write_text(json.dumps(coco_results(0, network_output)), encoding="utf-8")

    # Which mask is of which box is found by the boxes' projections into both images.
    dataset = open_dataset("kitti", ROOT, DETECTIONS, CocoFileMasks(files["left"], files["right"]))
    loaded = dataset.load("000000")
    result = DirectShapeRefiner()(loaded.frame, loaded.detections)
    for car, status in enumerate(result.status):
        overlap = result.quality.mask_iou_left[car]
        print(f"car {car}: {status.name}, covers {overlap:.0%} of its mask and the shape together")
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("coco_masks_out"))
    main(parser.parse_args().out)
