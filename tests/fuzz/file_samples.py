"""This module has a small file of every format that the program reads, with its reader."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import trimesh
from helpers.kitti_folder import FRAMES, write_disparity
from helpers.layouts import SEQUENCE, write_folder, write_raw, write_sequence
from helpers.quick_runs import dataset, refine
from helpers.shape_arrays import shape_arrays
from helpers.synthetic_scene import cached_street

from directshape_torch import load_config
from directshape_torch.batch.run_summary import RunTimings, digit_warnings
from directshape_torch.errors import MeshError
from directshape_torch.files.mesh_files import MESH_SUFFIXES, read_mesh
from directshape_torch.io.image_files import read_disparity
from directshape_torch.io.instance_masks import MaskSource
from directshape_torch.io.kitti_calibration import read_calibration
from directshape_torch.io.kitti_labels import read_tracking_objects
from directshape_torch.io.mask_files import CocoFileMasks, InstancePngMasks
from directshape_torch.io.motion_files import read_poses, read_times
from directshape_torch.io.result_files import read_shapes, write_shapes
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.io.run_status import format_status, read_status
from directshape_torch.io.stereo_dataset import LayoutName, open_dataset
from directshape_torch.io.velodyne import read_scan
from directshape_torch.rig.estimate import RigEstimate
from directshape_torch.rig.rig_file import load_rigs, save_rigs
from directshape_torch.shape.load_prior import BUNDLED_PRIORS, load_prior
from directshape_torch.shape.mesh_to_sdf import GridSpec, MeshOptions, load_mesh_obj, mesh_to_sdf
from directshape_torch.visualize.make_report import make_report
from directshape_torch.visualize.overlay import overlay_of_frame
from directshape_torch.visualize.run_frames import RunInputs

ASSETS = Path(load_prior.__code__.co_filename).parents[1] / "assets"
FRAME = FRAMES[0]
VELODYNE = "R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"


@dataclass(frozen=True)
class Sample:
    """A `Sample` is a complete file with the function that reads it and uses the content.

    Attributes:
        path: path of the file.
        read: function that reads the file.
        is_exact: whether damage is an error; other readers skip what they cannot use, and report how much.
    """

    path: Path
    read: Callable[[], object]
    is_exact: bool = True


def samples(kitti: Path, folder: Path) -> dict[str, Sample]:
    """Samples by format; `kitti` is copied and stays unchanged."""
    assert set(BUNDLED_PRIORS) == {"pca", "neural"}
    root = Path(shutil.copytree(kitti, folder / "kitti"))
    found = {
        name: Sample(path, partial(read, path))
        for name, (path, read) in (_by_themselves(root, folder) | _masks(root, folder)).items()
    }
    return found | _frames(root, folder) | _runs(root, folder / "out")


def _by_themselves(root: Path, folder: Path) -> dict[str, tuple[Path, Callable[[Path], object]]]:
    """Files that one function reads."""
    (folder / "tracking.txt").write_text("".join(f"{n} 1 Car 0 0 0 0 0 9 9 1.5 1.6 3.9 1 1.6 20 0\n" for n in range(3)))
    (folder / "times.txt").write_text("2011-09-26 13:02:44.94\n2011-09-26 13:02:45.05\n2011-09-26 13:02:45.15\n")
    (folder / "poses.txt").write_text("0.8 0 0.6 1 0 1 0 2 -0.6 0 0.8 3\n" * 3)
    (folder / "split.txt").write_text("".join(f"{name}\n" for name in FRAMES))
    write_shapes(folder / "shapes.npz", shape_arrays(2))
    write_disparity(folder / "disparity.png", np.full((12, 16), 7.5))
    street = cached_street()[1]
    rig = RigEstimate.of_frames(street.frames)
    rig.update(street.frames, street.detections)
    save_rigs(folder / "rigs.json", [rig])
    calibration = folder / "lidar_calibration.txt"
    calibration.write_text((root / "training" / "calib" / f"{FRAME}.txt").read_text() + VELODYNE)
    np.linspace(-9, 9, 40, dtype="<f4").tofile(folder / "scan.bin")
    for name in ("neural_prior.safetensors", "configs/fast.yaml"):
        shutil.copyfile(ASSETS / name, folder / Path(name).name)
    corners = "v 0 0 0\nv 4 0 0\nv 0 2 0\nv 0 0 2\n"
    (folder / "mesh.obj").write_text(f"{corners}f 1 2 3\nf 1 4 2\nf 2 4 3\nf 1 3 4\n")
    for suffix in ("ply", "glb", "off", "stl"):
        trimesh.Trimesh(*read_mesh(folder / "mesh.obj"), process=False).export(folder / f"mesh.{suffix}")

    def scan(path: Path) -> object:
        return read_scan(path, read_calibration(calibration))

    def solid(path: Path) -> object:
        grid, options = GridSpec.for_cars(0.5), MeshOptions(voxel_m=0.1, are_cars=False)
        with suppress(MeshError):
            return mesh_to_sdf(load_mesh_obj(path, options), grid, options)
        return None

    return {
        "tracking": (folder / "tracking.txt", read_tracking_objects),
        "shapes": (folder / "shapes.npz", read_shapes),
        "disparity": (folder / "disparity.png", read_disparity),
        "rigs": (folder / "rigs.json", lambda path: [(each.field, str(each)) for each in load_rigs(path)]),
        "split": (folder / "split.txt", lambda path: dataset(root, split=path).frame_ids),
        "scan": (folder / "scan.bin", scan),
        "network": (folder / "neural_prior.safetensors", load_prior),
        "prior": (root / "prior.safetensors", load_prior),
        "times": (folder / "times.txt", read_times),
        "poses": (folder / "poses.txt", read_poses),
        **{f"mesh {suffix[1:]}": (folder / f"mesh{suffix}", solid) for suffix in MESH_SUFFIXES},
        "settings": (folder / "fast.yaml", load_config),
    }


def _masks(root: Path, folder: Path) -> dict[str, tuple[Path, Callable[[Path], object]]]:
    """Masks of the whole set in one file, and as instance numbers in an image."""
    entries = json.loads((root / "masks" / f"{FRAME}.json").read_text())
    coco, ids = folder / "left.json", folder / "instance_2" / f"{FRAME}.png"
    left = [{"image_id": 0, "bbox": [1, 1, 9, 9], "score": 0.5} | e for e in entries if e["image"] == "left"]
    coco.write_text(json.dumps(left))
    ids.parent.mkdir()
    size_hw = (int(entries[0]["segmentation"]["size"][0]), int(entries[0]["segmentation"]["size"][1]))
    image = np.zeros(size_hw, np.uint16)
    image[10:30, 20:60], image[40:50, 20:60] = 1001, 2003
    cv2.imwrite(str(ids), image)

    def read(source: MaskSource) -> object:
        return source.files(FRAME), source.read(FRAME, size_hw)

    return {
        "coco": (coco, lambda path: read(CocoFileMasks(path, None))),
        "instances": (ids, lambda path: read(InstancePngMasks(path.parent.parent))),
    }


def _frames(root: Path, folder: Path) -> dict[str, Sample]:
    """Files of a frame in layouts that have their own files."""
    training, plain, sequence = root / "training", folder / "plain", folder / "tracking"
    write_folder(root, plain, FRAMES)
    drive = write_raw(root, folder / "raw", FRAMES)
    write_sequence(root, sequence, FRAMES, single=False)
    detections = {"raw": folder / "raw_boxes", "tracking": folder / "tracking_boxes" / SEQUENCE}
    for layout, name in (("raw", f"{0:010d}"), ("tracking", f"{0:06d}")):
        detections[layout].mkdir(parents=True)
        shutil.copyfile(root / "detections" / "data" / f"{FRAME}.txt", detections[layout] / f"{name}.txt")

    def kitti() -> object:
        data = dataset(root)
        data.input_files(FRAME)
        return data.load(FRAME)

    def other(layout: LayoutName, data: Path, boxes: Path | None) -> object:
        found = open_dataset(layout, data, boxes)
        return found.load(found.frame_ids[0])

    of_kitti = {
        "image": training / "image_2" / f"{FRAME}.png",
        "calibration": training / "calib" / f"{FRAME}.txt",
        "plane": training / "planes" / f"{FRAME}.txt",
        "labels": training / "label_2" / f"{FRAME}.txt",
        "detections": root / "detections" / "data" / f"{FRAME}.txt",
        "masks": root / "masks" / f"{FRAME}.json",
    }
    of_plain, of_raw = partial(other, "folder", plain, None), partial(other, "raw", drive, detections["raw"])
    of_sequence = partial(other, "tracking", sequence, detections["tracking"].parent)
    return {name: Sample(path, kitti) for name, path in of_kitti.items()} | {
        "rig": Sample(plain / "rig.json", of_plain),
        "frame": Sample(plain / "frames" / f"{FRAME}.json", of_plain),
        "raw calibration": Sample(drive.parent / "calib_cam_to_cam.txt", of_raw),
        "sequence calibration": Sample(sequence / "training" / "calib" / f"{SEQUENCE}.txt", of_sequence),
    }


def _runs(root: Path, out: Path) -> dict[str, Sample]:
    """Files of a run, with the readers that resume or use them."""
    refine(root, out, draw=overlay_of_frame)

    def report() -> object:
        return make_report(RunInputs(RunFolder(out), load_prior(root / "prior.safetensors")), out.parent / "page.html")

    def resumed() -> object:
        return refine(root, out, draw=overlay_of_frame)

    return {
        "summary": Sample(out / "summary.json", resumed),
        "results": Sample(out / "summary.json", lambda: RunFolder(out)),
        "report": Sample(out / "summary.json", report),
        "status": Sample(out / "summary.json", lambda: format_status(read_status(out))),
        "timings": Sample(out / "timings.json", lambda: digit_warnings(out, RunTimings()), is_exact=False),
        "results of a frame": Sample(out / "shapes" / f"{FRAME}.npz", lambda: RunFolder(out).read(FRAME)),
    }
