"""This module runs `--against CHECKOUT`: times and operations of this version, relative to another version.

Each version has its own process, and the two are asked in turn for processor time, so that other load on the machine
slows down both. The module uses only parts that every version of this project has: frames, default settings, the
refiner.

    PYTHONPATH=CHECKOUT:scripts python -m benchmark_suites.checkouts

This command runs one such process. It prints its scenes and then answers each line `SCENE FIRST COUNT`, a call of COUNT
frames, with the seconds of the call. If the line ends in `operations`, it answers with their number, and if it ends in
`masks`, with the seconds of a call that makes its boxes of the masks.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any

import torch

from benchmark_suites.measures import Row, Spread, count_operations
from benchmark_suites.workloads import load_scenes
from directshape_torch import Detections, DirectShapeRefiner, FrameBatch
from directshape_torch.errors import DirectShapeError, InputError
from directshape_torch.io.frame_collation import collate

_SINGLE_FRAMES, _BATCH_FRAMES = 3, 8
_ROUNDS = 7


def against_rows(checkout: Path, data_root: Path | None, quick: bool = False) -> Iterator[Row]:
    """Ratios of time and operations, this version over the other, for single frames and for 8 in a call.

    Raises:
        InputError: the folder has no version of this package.
        DirectShapeError: a version failed.
    """
    if not (checkout / "directshape_torch" / "__init__.py").is_file():
        raise InputError("--against", "a checkout of this project", str(checkout))
    here = Path(__file__).resolve().parents[2]
    rounds = 1 if quick else _ROUNDS
    with _version(here, data_root) as ours, _version(checkout.resolve(), data_root) as theirs:
        scenes = ours.answer()
        theirs.answer()
        for number, (scene, count) in enumerate(scenes):
            calls = {f"{scene}, one frame in a call": [(f, 1) for f in range(min(count, _SINGLE_FRAMES))]}
            if not quick:
                calls[f"{scene}, {_BATCH_FRAMES} frames in a call"] = [(0, _BATCH_FRAMES)]
            for what, frames in calls.items():
                asked = [f"{number} {first} {size}" for first, size in frames]
                for words, ending in (("time", ""), ("time from masks alone over given boxes", " masks")):
                    seconds = [pair for line in asked for pair in _seconds(ours, theirs, line, ending, rounds)]
                    note = " over ".join(f"{1e3 * median(side):.0f} ms" for side in zip(*seconds, strict=True))
                    yield Row(f"{what}, {words}", Spread.of([a / b for a, b in seconds]), note)
                found = [[version.ask(f"{line} operations") for line in asked] for version in (ours, theirs)]
                note = f"{' '.join(map(str, found[0]))} over {' '.join(map(str, found[1]))}"
                yield Row(f"{what}, operations", Spread.of([a / b for a, b in zip(*found, strict=True)]), note)


def _seconds(ours: _Version, theirs: _Version, line: str, ending: str, rounds: int) -> Iterator[tuple[float, float]]:
    """Times of calls in turn, with alternating order, after a first call that is not measured.

    This version is asked a line with an ending, and the other version the line alone.
    """
    for number in range(rounds + 1):
        order = ((ours, ending), (theirs, "")) if number % 2 else ((theirs, ""), (ours, ending))
        seconds = {version: version.ask(line + end) for version, end in order}
        if number:
            yield seconds[ours], seconds[theirs]


class _Version:
    """A `_Version` is the process of one version."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def ask(self, line: str) -> Any:
        """The answer to a line."""
        assert self._process.stdin is not None
        print(line, file=self._process.stdin, flush=True)
        return self.answer()

    def answer(self) -> Any:
        """The next output of the process."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise DirectShapeError(f"the process of {self._process.args!r} has ended; its errors are above")
        return json.loads(line)


@contextmanager
def _version(root: Path, data_root: Path | None) -> Iterator[_Version]:
    scripts = Path(__file__).resolve().parents[1]
    command = [sys.executable, "-m", "benchmark_suites.checkouts", "--threads", str(torch.get_num_threads())]
    command += ["--data", str(data_root.resolve())] if data_root else []
    # The process starts in the root, because the start folder of a module comes first in its path.
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(root), str(scripts)))}
    with subprocess.Popen(
        command, cwd=root, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield _Version(process)


def _from_masks(frames: FrameBatch, given: Detections) -> tuple[FrameBatch, Detections]:
    """The inputs of a call without given boxes."""
    masks = given.mask_left, given.mask_right
    return frames, Detections.from_masks(frames, *masks, frame_index=given.frame_index)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one version: answer lines until there are no more."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, metavar="ROOT")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args(arguments)
    torch.set_num_threads(args.threads)
    scenes = load_scenes(args.data, _BATCH_FRAMES)
    refiner = DirectShapeRefiner()
    print(json.dumps([(scene.name, len(scene.frames)) for scene in scenes]), flush=True)
    for line in sys.stdin:
        number, first, count, *ending = line.split()
        frames = scenes[int(number)].frames
        inputs = collate([frames[n % len(frames)] for n in range(int(first), int(first) + int(count))])
        if ending == ["operations"]:
            print(count_operations(lambda: refiner(*inputs)), flush=True)  # noqa: B023
            continue
        start = time.process_time()
        refiner(*(_from_masks(*inputs) if ending else inputs))
        print(time.process_time() - start, flush=True)


if __name__ == "__main__":
    main()
