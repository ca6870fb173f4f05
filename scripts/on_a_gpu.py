"""This script measures on a graphics card what matters there, and writes one page.

    python scripts/on_a_gpu.py --out gpu.md

It needs the package and the bundled frame alone. Results and gradients are compared with the CPU's; waits of the host,
memory and times are measured for several numbers of frames in a call, eager and compiled.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from benchmark import machine
from benchmark_suites.measures import count_operations, peak_tensor_bytes, time_interleaved
from benchmark_suites.workloads import demo_scene
from command_line import run_command
from torch import Tensor

from directshape_torch import Detections, DirectShapeRefiner, FrameBatch, RefinementResult, load_config
from directshape_torch.cli.options import find_device
from directshape_torch.errors import CompilationError, InputError
from directshape_torch.files.atomic_files import write_text
from directshape_torch.io.frame_collation import collate

_FRAMES_IN_A_CALL = 1, 8, 64
_ROUNDS = 5
# Sums in another order change the last digits of a step, and with them at times the number of iterations. Cars that are
# farther apart than this ended in another minimum.
_SAME_CENTRE_M = 0.01

Inputs = tuple[FrameBatch, Detections]
Line = tuple[str, str]


def run(args: argparse.Namespace) -> None:
    """Measure and write the page.

    Raises:
        InputError: the device is the CPU, or does not exist.
    """
    device = find_device(args.device)
    if device.type == "cpu":
        raise InputError("--device", "a graphics card", "cpu", "scripts/benchmark.py measures the CPU")
    deadline = time.monotonic() + 60 * args.minutes
    sizes = _FRAMES_IN_A_CALL[:1] if args.quick else _FRAMES_IN_A_CALL
    lines = ["# On a graphics card", "", machine(device), "", "| what | found |", "|---|---|"]
    parts = [partial(_results, device), partial(_gradients, device)]
    parts += [partial(_calls, device, size, "off", args.quick) for size in sizes]
    parts += [] if args.quick else [partial(_calls, device, size, "on", False) for size in sizes]
    for part in parts:
        if time.monotonic() > deadline:
            lines.append(f"| the rest | was not measured, because {args.minutes:g} minutes were over |")
            break
        for what, found in part():
            lines.append(f"| {what} | {found} |")
            print(lines[-1], flush=True)
    write_text(args.out, "\n".join([*lines, ""]))
    print(f"The page is {args.out}.")


def _results(device: torch.device) -> Iterator[Line]:
    """How many cars end as on the CPU, with given boxes and from masks alone."""
    frames, boxes = _inputs(1)
    of_masks = Detections.from_masks(frames, boxes.mask_left, frame_index=boxes.frame_index)
    for name, cars in (("given boxes", boxes), ("masks alone", of_masks)):
        expected = _call("off", "none", torch.device("cpu"))(frames, cars)
        found = _call("off", "none", device)(frames.to(device), cars.to(device))
        apart_m = (found.T_cam_obj.cpu() - expected.T_cam_obj)[:, :3, 3].norm(dim=1)
        same = sum(a is b for a, b in zip(found.status, expected.status, strict=True))
        near = int((apart_m < _SAME_CENTRE_M).sum())
        yield f"{name}: cars with the CPU's status", f"{same} of {len(expected)}"
        yield f"{name}: cars within {100 * _SAME_CENTRE_M:g} cm of the CPU's place", f"{near} of {len(expected)}"
        yield f"{name}: median distance from the CPU's place", f"{1e3 * float(apart_m.median()):.3g} mm"


def _gradients(device: torch.device) -> Iterator[Line]:
    """How far gradients by the right image are from the CPU's."""
    expected, found = (_gradient(where) for where in (torch.device("cpu"), device))
    relative = float((found - expected).norm() / expected.norm())
    yield "unrolled gradient by the right image: distance from the CPU's, over its size", f"{relative:.2g}"


def _gradient(device: torch.device) -> Tensor:
    frames, cars = _inputs(1)
    images = frames.images_right.clone().requires_grad_()
    with torch.enable_grad():
        result = _call("off", "unroll", device)(replace(frames, images_right=images).to(device), cars.to(device))
        result.T_cam_obj[result.refined].sum().backward()
    assert images.grad is not None
    return images.grad


def _calls(device: torch.device, size: int, compiled: str, quick: bool) -> Iterator[Line]:
    """Time, waits and memory of a call of several frames."""
    frames, cars = _inputs(size)
    call = partial(_call(compiled, "none", device), frames.to(device), cars.to(device))
    name = f"{size} frames, {len(cars)} cars, {'compiled' if compiled == 'on' else 'eager'}"
    begun = time.perf_counter()
    try:
        call()
    except CompilationError as error:
        yield name, str(error)
        return
    yield f"{name}: first call", f"{time.perf_counter() - begun:.1f} s"
    seconds = time_interleaved({"call": call}, 1 if quick else _ROUNDS, device)["call"]
    yield f"{name}: time", f"{1e3 * seconds:.0f} ms, {1e3 * seconds / len(cars):.2g} ms a car"
    if compiled == "off":
        yield f"{name}: operations", str(count_operations(call))
    # PyTorch keeps this record for CUDA alone.
    if device.type == "cuda":
        yield f"{name}: waits of the host", str(_waits(call))
        yield f"{name}: memory", f"{peak_tensor_bytes(call, device) / 2**20:.0f} MB"


def _waits(call: Callable[[], object]) -> int:
    """How often the host waits for the card in a call."""
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            call()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return sum("synchroniz" in str(each.message) for each in caught)


def _inputs(num_frames: int) -> Inputs:
    """The bundled frame, so many times."""
    return collate(list(demo_scene().frames) * num_frames)


def _call(compiled: str, backward: str, device: torch.device) -> Callable[[FrameBatch, Detections], RefinementResult]:
    config = load_config("default", [f"compile={compiled}", f"backward.mode={backward}"])
    return DirectShapeRefiner(config=config).to(device)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("gpu.md"), metavar="FILE", help="the page; default: gpu.md")
    parser.add_argument("--device", default="cuda", help="default: cuda")
    parser.add_argument("--minutes", type=float, default=10, metavar="N", help="nothing is begun after these minutes")
    parser.add_argument("--quick", action="store_true", help="see that everything runs; no figures to quote")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
