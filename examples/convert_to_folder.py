"""From a stereo rig of one's own to the plain folder that `directshape --layout folder` reads (docs/plain_folder.md).

    python examples/convert_to_folder.py --rig mine --out folder
    directshape check-data --layout folder --data folder
    directshape refine --layout folder --data folder --out out

What `mine` holds is what many rigs have: `left/` and `right/` with images that OpenCV rectified, `stereo.yml` with P1
and P2 of cv2.stereoRectify, `boxes.json` of a detector that thinks in centres, length width height and a heading that
is 0 straight ahead, and `masks.json`, COCO results with the number of the box they belong to. Change the three
functions marked `<-` to what your own files say; the rest may stay.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np

SCHEMA_VERSION = 1


def read_rig(path: Path) -> dict[str, Any]:  # <-
    """OpenCV's P1 = [K | 0] and P2 = [K' | K' t], t = (-baseline, 0, 0) in the unit of the chessboard: metres here."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    P1, P2 = file.getNode("P1").mat(), file.getNode("P2").mat()
    size_wh = [int(n) for n in file.getNode("image_size").mat().flatten()]
    t_right_cam = np.linalg.solve(P2[:, :3], P2[:, 3])
    return {
        "schema_version": SCHEMA_VERSION,
        "image_size_wh": size_wh,
        "K_left": P1[:, :3].tolist(),
        "K_right": P2[:, :3].tolist(),
        "t_right_cam_m": t_right_cam.tolist(),
    }


def convert_box(box: dict[str, Any]) -> dict[str, Any]:  # <-
    """From centre, length width height and heading (0 ahead, counter-clockwise seen from above, radians)."""
    length, width, height = box["size_lwh"]
    x, y, z = box["center"]
    return {
        "class": box["label"].capitalize(),
        "score": box["score"],
        "dimensions_hwl_m": [height, width, length],
        # y points down, so the bottom face is half a height further.
        "bottom_center_m": [x, y + height / 2, z],
        # KITTI's heading is 0 along x, to the right, and grows clockwise seen from above.
        "rotation_y_rad": math.remainder(-box["yaw"] - math.pi / 2, 2 * math.pi),
    }


def add_masks(objects: list[dict[str, Any]], entries: list[dict[str, Any]]) -> None:  # <-
    """COCO results with `image` (left or right) and `box`, the index of their box; -1: others, which may hide cars."""
    for entry in entries:
        if entry["box"] >= 0:
            objects[entry["box"]][f"mask_{entry['image']}"] = entry["segmentation"]
        else:
            objects.append({"class": "Other", f"mask_{entry['image']}": entry["segmentation"]})


def convert(rig: Path, out: Path) -> int:
    """Write `rig.json`, `left`, `right` and `frames`; returns the number of frames."""
    boxes = json.loads((rig / "boxes.json").read_text())
    masks = json.loads((rig / "masks.json").read_text())
    (out / "frames").mkdir(parents=True, exist_ok=True)
    (out / "rig.json").write_text(json.dumps(read_rig(rig / "stereo.yml"), indent=2))
    for side in ("left", "right"):
        shutil.copytree(rig / side, out / side, dirs_exist_ok=True)
    for frame_id, found in boxes.items():
        objects = [convert_box(box) for box in found]
        add_masks(objects, masks.get(frame_id, []))
        content = {"schema_version": SCHEMA_VERSION, "objects": objects}
        (out / "frames" / f"{frame_id}.json").write_text(json.dumps(content))
    return len(boxes)


def main() -> None:
    """Convert what the options name."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rig", type=Path, required=True, metavar="DIR", help="left, right, stereo.yml, boxes.json ..")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="the plain folder")
    args = parser.parse_args()
    print(f"{convert(args.rig, args.out)} frames in {args.out}")


if __name__ == "__main__":
    main()
