"""A small file of every format, who reads it, and ways to damage it."""

from __future__ import annotations

import io
import json
import random
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from helpers.kitti_folder import FRAMES
from helpers.layouts import write_folder
from helpers.quick_runs import dataset, refine
from helpers.shape_arrays import shape_arrays

from directshape_torch import load_config
from directshape_torch.batch.run_results import read_run_results
from directshape_torch.batch.run_status import format_status, read_status
from directshape_torch.diagnosis.trust_model import load_trust_model
from directshape_torch.evaluation.car_identity import CarIdentity, CarTracks, read_tracks, write_tracks
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.io.disparity_files import read_disparity, write_disparity
from directshape_torch.io.open_dataset import open_dataset
from directshape_torch.io.result_files import read_shapes, write_shapes
from directshape_torch.io.timestamp_files import read_timestamps
from directshape_torch.io.tracking_files import read_tracking_objects
from directshape_torch.report.frame_inputs import InputSources
from directshape_torch.report.make_report import make_report
from directshape_torch.shape.load_prior import BUNDLED_PRIORS, load_prior

ASSETS = Path(load_prior.__code__.co_filename).parents[1] / "assets"
FRAME = FRAMES[0]


@dataclass(frozen=True)
class Sample:
    """A whole file, and what reads it and all that follows from it."""

    path: Path
    read: Callable[[], object]


def samples(kitti: Path, folder: Path) -> dict[str, Sample]:
    """By format; `kitti` is copied and stays as it is."""
    root = Path(shutil.copytree(kitti, folder / "kitti"))
    write_folder(root, folder / "plain", FRAMES)
    refine(root, folder / "out", overlays=True)

    def frame() -> object:
        data = dataset(root)
        data.input_files(FRAME)
        return data.load(FRAME)

    def plain() -> object:
        return open_dataset("folder", folder / "plain").load(FRAME)

    def status() -> str:
        return format_status(read_status(folder / "out"))

    def report() -> object:
        return make_report(folder / "out", folder / "page.html", InputSources(), load_prior(root / "prior.npz"))

    (folder / "tracking.txt").write_text("".join(f"{n} 1 Car 0 0 0 0 0 9 9 1.5 1.6 3.9 1 1.6 20 0\n" for n in range(3)))
    (folder / "times.txt").write_text("2011-09-26 13:02:25.964389445\n" * 3)
    write_tracks(folder / "tracks.json", CarTracks({(FRAME, 1): CarIdentity("a", "b")}))
    write_shapes(folder / "shapes.npz", shape_arrays(2))
    write_disparity(folder / "disparity.png", np.full((12, 16), 7.5))
    DisparityField.constant(-0.4, (160, 120), torch.eye(3), torch.eye(3), torch.eye(4)).save(folder / "field.json")
    for name in ("neural_prior.safetensors", "trust_model.json", "configs/fast.yaml"):
        shutil.copyfile(ASSETS / name, folder / Path(name).name)
    readers: dict[str, tuple[Path, Callable[[Path], object]]] = {
        "times": (folder / "times.txt", read_timestamps),
        "tracking": (folder / "tracking.txt", read_tracking_objects),
        "tracks": (folder / "tracks.json", read_tracks),
        "shapes": (folder / "shapes.npz", read_shapes),
        "disparity": (folder / "disparity.png", read_disparity),
        "field": (folder / "field.json", DisparityField.load),
        "network": (folder / "neural_prior.safetensors", load_prior),
        "prior": (root / "prior.npz", load_prior),
        "trust": (folder / "trust_model.json", load_trust_model),
        "settings": (folder / "fast.yaml", load_config),
    }
    found = {name: Sample(path, lambda path=path, read=read: read(path)) for name, (path, read) in readers.items()}
    training = root / "training"
    of_frame = {
        "image": training / "image_2" / f"{FRAME}.png",
        "calibration": training / "calib" / f"{FRAME}.txt",
        "plane": training / "planes" / f"{FRAME}.txt",
        "labels": training / "label_2" / f"{FRAME}.txt",
        "detections": root / "detections" / "data" / f"{FRAME}.txt",
        "masks": root / "masks" / f"{FRAME}.json",
    }
    found |= {name: Sample(path, frame) for name, path in of_frame.items()}
    found |= {
        "rig": Sample(folder / "plain" / "rig.json", plain),
        "frame": Sample(folder / "plain" / "frames" / f"{FRAME}.json", plain),
        "summary": Sample(folder / "out" / "summary.json", lambda: refine(root, folder / "out", overlays=True)),
        "results": Sample(folder / "out" / "summary.json", lambda: read_run_results(folder / "out")),
        "report": Sample(folder / "out" / "summary.json", report),
        "run": Sample(folder / "out" / "run.json", status),
    }
    assert set(BUNDLED_PRIORS) == {"pca", "neural"}
    return found


ODD: tuple[Any, ...] = (
    None, True, -1, 0, 0.5, 1e300, 10**17, 10**400, "", "x", "\ud800", "9" * 5000, [], {}, [[]], [None], {"a": {}},
    ["x"] * 500, float("nan"), float("inf"), "../../etc", [1, 2, 3, 4], 2**31, 2**63,
)  # fmt: skip
WORDS = ("", "nan", "inf", "-1", "1e400", "9" * 5000, "\u0663", "0x10", "1_0", "x", "\x00", "-0", "1e30", "\xa0", "# y")


def damaged(content: bytes, name: str, chance: random.Random) -> bytes:
    """Content with one thing wrong, in its bytes or in its structure."""
    if chance.random() < 0.3:
        return _bytes(content, chance)
    if name.endswith(".json"):
        value = json.loads(content)
        for _ in range(chance.choice((1, 1, 2))):
            value = _node(value, chance)
        # As other programs write it: NaN, and letters that are none.
        return json.dumps(value).encode()
    if name.endswith(".npz"):
        return _archive(content, chance)
    if name.endswith((".txt", ".yaml")):
        return _text(content.decode(), chance)
    return _bytes(content, chance)


def _bytes(content: bytes, chance: random.Random) -> bytes:
    place, kind = chance.randrange(len(content) + 1), chance.randrange(5)
    noise = bytes(chance.randrange(256) for _ in range(chance.choice((1, 4, 40))))
    return (
        content[:place],
        content[:place] + noise + content[place:],
        content[:place] + noise + content[place + len(noise) :],
        content[:place] + content[place + len(noise) :],
        content[place:] + content[:place],
    )[kind]


def _node(value: Any, chance: random.Random) -> Any:
    """With an odd value in the place of one within it, a key too many or one too few."""
    if not isinstance(value, (dict, list)) or not value or chance.random() < 0.15:
        return chance.choice(ODD)
    keys = list(value) if isinstance(value, dict) else list(range(len(value)))
    key, changed = chance.choice(keys), value.copy()
    match chance.randrange(8):
        case 0:
            del changed[key]
        case 1 if isinstance(value, dict):
            changed[chance.choice(("", "new", "../x", "\ud800"))] = changed[key]
        case 1:
            changed += changed[:1] * chance.choice((1, 50))
        case _:
            changed[key] = _node(value[key], chance)
    return changed


def _archive(content: bytes, chance: random.Random) -> bytes:
    with np.load(io.BytesIO(content)) as archive:
        arrays = {name: archive[name] for name in archive.files}
    name = chance.choice(list(arrays))
    array = arrays[name]
    odd = (
        None,
        np.array("x"),
        np.array(["x", "yy"]),
        np.array(7),
        np.array(np.nan),
        np.zeros(0),
        np.zeros((0, 4, 4)),
        array[..., None],
        array.astype("U9") if array.dtype.kind != "U" else array.astype("S9"),
        array.astype(bool) if array.dtype.kind in "fi" else array,
        np.full_like(array, np.nan) if array.dtype.kind == "f" else array[:0] if array.ndim else array,
        np.zeros(3, "M8[s]"),
        np.zeros(2, [("a", "f4")]),
        array.astype(complex) if array.dtype.kind in "fi" else array,
    )
    value = chance.choice(odd)
    arrays |= {name: value} if value is not None else {}
    if value is None:
        del arrays[name]
    file = io.BytesIO()
    if chance.random() < 0.1:
        arrays["new"] = array
    np.savez(file, **arrays)
    if chance.random() < 0.1:
        with zipfile.ZipFile(file, "a") as archive:
            archive.writestr("extra", b"x")
    return file.getvalue()


def _text(text: str, chance: random.Random) -> bytes:
    lines = text.split("\n")
    row = chance.randrange(len(lines))
    words = lines[row].split(" ")
    place = chance.randrange(len(words))
    match chance.randrange(5):
        case 0:
            del words[place]
        case 1:
            words.insert(place, chance.choice(WORDS))
        case _:
            words[place] = chance.choice(WORDS)
    lines[row] = " ".join(words)
    if chance.random() < 0.2:
        lines[row : row + 1] = [lines[row]] * chance.choice((0, 2, 30))
    return "\n".join(lines).encode(chance.choice(("utf-8", "utf-8", "utf-16", "latin-1")), "replace")
