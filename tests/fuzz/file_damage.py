"""This module makes one change in a file, in its bytes or in its content."""

from __future__ import annotations

import io
import json
import random
import struct
import zipfile
from typing import Any

import cv2
import numpy as np

ODD: tuple[Any, ...] = (
    None, True, -1, 0, 0.5, 1e300, 10**17, 10**400, "", "x", "\ud800", "9" * 5000, [], {}, [[]], [None], {"a": {}},
    ["x"] * 500, float("nan"), float("inf"), "../../etc", [1, 2, 3, 4], 2**31, 2**63,
)  # fmt: skip
WORDS = ("", "nan", "inf", "-1", "1e400", "9" * 5000, "\u0663", "0x10", "1_0", "x", "\x00", "-0", "1e30", "\xa0", "# y")


def damaged(content: bytes, name: str, chance: random.Random) -> bytes:
    """The content with one change in its bytes or in its structure."""
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
    if name.endswith(".png"):
        return _image(content, chance)
    if name.endswith(".glb"):
        return _scene(content, chance)
    if name.endswith((".txt", ".yaml", ".obj", ".off", ".jsonl")):
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
    """The value with an odd value in place of one within it, or with a key more or less."""
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


def _scene(content: bytes, chance: random.Random) -> bytes:
    """The file of a scene with a changed description and unchanged numbers."""
    (length,) = struct.unpack_from("<I", content, 12)
    text = json.dumps(_node(json.loads(content[20 : 20 + length]), chance)).encode()
    text += b" " * (-len(text) % 4)
    rest = content[20 + length :]
    return content[:8] + struct.pack("<II", 20 + len(text) + len(rest), len(text)) + content[16:20] + text + rest


def _image(content: bytes, chance: random.Random) -> bytes:
    """A complete image of another size, depth or number of channels, or with odd values."""
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None, "damage starts from a whole image"
    odd = (
        image[:-1],
        image[:1, :1],
        image.repeat(7, axis=1),
        image.swapaxes(0, 1),
        image.astype(np.uint8),
        image.astype(np.uint16) * 257,
        np.zeros_like(image),
        np.full_like(image, np.iinfo(image.dtype).max),
        image[..., 0] if image.ndim == 3 else np.stack([image] * chance.choice((3, 4)), axis=-1),
        np.arange(image.size, dtype=np.uint16).reshape(image.shape),
    )
    return bytes(cv2.imencode(".png", np.ascontiguousarray(odd[chance.randrange(len(odd))]))[1])


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
