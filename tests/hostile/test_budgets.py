"""Small files that need gigabytes, never end, or have numbers that native code cannot use are refused."""

from __future__ import annotations

import io
import json
import os
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from directshape_torch.errors import ConfigError, DataFormatError, DirectShapeError
from directshape_torch.files.array_files import read_npz
from directshape_torch.files.mesh_files import read_mesh
from directshape_torch.files.read_files import read_bytes, read_json
from directshape_torch.files.text_files import read_lines, read_text
from directshape_torch.io.config_files import load_config
from directshape_torch.io.image_files import read_rgb
from directshape_torch.io.instance_masks import decode_segmentation
from directshape_torch.shape import load_prior as priors

SIZE_HW = (60, 80)
NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    "segmentation",
    [
        *([[1, 1, 5, 1, 5, corner]] for corner in (None, NAN, INF, -INF, 1e8, -1e300, 10**17, True, "5", [5])),
        [[0, 0, 9e5, 9e5] * 40000],
        *({"size": list(SIZE_HW), "counts": counts} for counts in ([4801.0], [4799.5, 0.5], [-1, 4801], [None], [[]])),
        *({"size": list(SIZE_HW), "counts": counts} for counts in (10**12, {}, "\u00e9", "o" * 10**6, "", b"")),
        *({"size": size, "counts": [4800]} for size in ([60.0, 80], [80, 60], [2**31, 2**31], [None, 80], 4800, "xy")),
        {"size": [92681, 92681], "counts": [92681 * 92681]},
    ],
    ids=lambda value: repr(value)[:40],
)
def test_segmentations(segmentation: Any) -> None:
    with pytest.raises(DataFormatError, match=r"^a\.json: entry 7: ") as caught:
        decode_segmentation(Path("a.json"), "entry 7", segmentation, SIZE_HW)
    assert len(str(caught.value)) < 1000


def png(width: int, height: int) -> bytes:
    """A black image that states any size, and has a million bytes of it."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header, pixels = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0), zlib.compress(bytes(10**6))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def jpeg(width: int, height: int) -> bytes:
    import cv2

    content = bytearray(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    frame = content.index(b"\xff\xc0")
    struct.pack_into(">HH", content, frame + 5, height, width)
    return bytes(content)


@pytest.mark.parametrize("content", [png(9000, 9000), png(2**31 - 1, 2**31 - 1), jpeg(65000, 65000), jpeg(0, 8)])
def test_images(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(
        DataFormatError, match=r"a\.png: (states 9000 x 9000 pixels|.* exceeds limit|is no whole PNG or JPEG)"
    ):
        read_rgb(path)


def archive(compression: int = zipfile.ZIP_DEFLATED, encrypted: bool = False, zeros: int = 100) -> bytes:
    """An npz of zeros."""
    content = io.BytesIO()
    with (
        zipfile.ZipFile(content, "w", compression, compresslevel=1) as file,
        file.open("a.npy", "w", force_zip64=True) as entry,
    ):
        np.lib.format.write_array_header_1_0(entry, {"descr": "|u1", "fortran_order": False, "shape": (zeros,)})
        for start in range(0, zeros, 2**24):
            entry.write(bytes(min(2**24, zeros - start)))
    if not encrypted:
        return content.getvalue()
    changed = bytearray(content.getvalue())
    for signature, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        changed[changed.rindex(signature) + offset] |= 1
    return bytes(changed)


@pytest.mark.parametrize(
    ("made", "problem"),
    [
        ({"zeros": 600 * 2**20}, "unpacked it has"),
        ({"compression": zipfile.ZIP_LZMA}, "encrypted or not compressed by deflation"),
        ({"compression": zipfile.ZIP_BZIP2}, "encrypted or not compressed by deflation"),
        ({"encrypted": True}, "encrypted or not compressed by deflation"),
    ],
    ids=["bomb", "lzma", "bzip2", "encrypted"],
)
def test_archives(tmp_path: Path, made: dict[str, Any], problem: str) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(archive(**made))
    with pytest.raises(DataFormatError, match=rf"a\.npz: is no readable npz file .*{problem}"):
        read_npz(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"layer_widths": [50000, 60000]},
        {"layer_widths": [64, 64, 10**12]},
        {"num_codes": 10**9},
        {"grid_shape": [10**4] * 3},
        {"layer_widths": 3},
        {"layer_widths": [None]},
        {"schema": [[]]},
        {"spacing_m": "x"},
    ],
    ids=str,
)
def test_networks(tmp_path: Path, changes: dict[str, Any]) -> None:
    asset, path = Path(priors.__file__).parents[1] / "assets" / "neural_prior.safetensors", tmp_path / "a.safetensors"
    with safe_open(asset, framework="pt") as file:
        description = {**json.loads(file.metadata()["description"]), **changes}
    save_file(load_file(asset), path, {"description": json.dumps(description)})
    with pytest.raises(DataFormatError, match=r"a\.safetensors: "):
        priors.load_prior(path)


@pytest.mark.parametrize("read", [read_bytes, read_json, read_npz, read_rgb, priors.load_prior, load_config])
def test_only_regular_files_are_opened(tmp_path: Path, read: Callable[[Path], object]) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero.safetensors").symlink_to("/dev/zero")
    for path in (tmp_path / "pipe", tmp_path / "zero.safetensors", tmp_path, tmp_path / "a\0b", tmp_path / "\ud800"):
        with pytest.raises((DataFormatError, ConfigError), match=r"regular file|cannot be read|is no path"):
            read(path)


@pytest.mark.parametrize(
    "read", [read_bytes, read_text, read_lines, read_json, read_npz, read_rgb, load_config, read_mesh]
)
@pytest.mark.parametrize("name", ["a.yaml", "a.safetensors", "a.obj"])
def test_files_of_nothing_but_size(tmp_path: Path, read: Callable[[Path], object], name: str) -> None:
    path = tmp_path / name
    with path.open("wb") as file:
        file.truncate(2**36)
    with pytest.raises((DataFormatError, ConfigError), match=rf"{name}: .*(at most|is no \.obj)"):
        read(path)


@pytest.mark.parametrize(
    "text", ["[" * 10**5, '{"a":' * 10**5, "9" * 5000, "[1e999]", "[NaN]", "[-Infinity]", "\xff", '"\ud800', ""]
)
def test_json(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(text.encode("latin-1", "surrogatepass") if text == "\xff" else text.encode("utf-8", "replace"))
    with pytest.raises(DataFormatError, match=r"a\.json: is not valid JSON"):
        read_json(path)


@pytest.mark.parametrize(
    "text",
    [
        "solver: \xe9".encode("latin-1"),
        b"[" * 2000,
        b"solver: 2001-99-99",
        b"solver: !!int ''",
        b"solver: " + b"9" * 5000,
        b"a: &a [x,x,x,x,x,x,x,x,x]\n"
        + b"".join(b"%c: &%c [%s]\n" % (k, k, b",".join([b"*%c" % (k - 1)] * 9)) for k in range(ord("b"), ord("z"))),
        b"stages: [" + b"7," * 10**4 + b"]",
        b"? [a]\n: b",
    ],
    ids=["latin-1", "deep", "date", "no-int", "digits", "laughs", "long", "key"],
)
def test_settings(tmp_path: Path, text: bytes) -> None:
    (tmp_path / "a.yaml").write_bytes(text)
    with pytest.raises(ConfigError, match=r"a\.yaml: ") as caught:
        load_config(tmp_path / "a.yaml")
    assert len(str(caught.value)) < 2500


def test_messages_are_short_and_keep_both_ends() -> None:
    for error in (DirectShapeError("a" * 10**6 + "end"), DataFormatError("a.txt", "b" * 10**6, cure="end")):
        assert len(str(error)) < 2500
        assert str(error).endswith("end")
