"""What compiling costs, measured where it counts: in a process that has not compiled anything yet.

    python -m directshape_torch.benchmark.compile_probe --preset default --mode compiled [--data ROOT]

Refines a few frames of different sizes twice and prints one line of JSON. `compile_cost` runs it with a fresh and then
with a kept TORCHINDUCTOR_CACHE_DIR.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from directshape_torch.batch.timing import peak_memory_mb
from directshape_torch.benchmark.presets import make_refiner
from directshape_torch.benchmark.workloads import first_scene, with_cars
from directshape_torch.compile import num_forms
from directshape_torch.io.frame_collation import collate
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.refiner import DirectShapeRefiner


@dataclass(frozen=True)
class ProbeResult:
    """What a process prints.

    Attributes:
        first_s: of the first call of every frame together, compilation included.
        again_s: of the second call of each.
        graphs: that were compiled, or loaded, in the first pass; 0 when nothing is compiled.
        graphs_again: in the second pass and for another number of cars, which should need none.
        peak_memory_mb: of the whole process, libraries included; None where the system does not tell.
    """

    first_s: float
    again_s: float
    graphs: int
    graphs_again: int
    peak_memory_mb: float | None

    @property
    def compile_s(self) -> float:
        return self.first_s - self.again_s


def probe(refiner: DirectShapeRefiner, frames: Sequence[LoadedFrame]) -> ProbeResult:
    """Refine every frame, then every frame again and as many cars as there were not before."""
    before = num_forms()
    first_s = _refine_all(refiner, frames)
    graphs = num_forms()
    again_s = _refine_all(refiner, frames)
    refiner(*with_cars(frames, len(frames[0].detections) + 2))
    return ProbeResult(first_s, again_s, graphs - before, num_forms() - graphs, peak_memory_mb())


def _refine_all(refiner: DirectShapeRefiner, frames: Sequence[LoadedFrame]) -> float:
    start = time.perf_counter()
    for loaded in frames:
        refiner(*collate([loaded]))
    return time.perf_counter() - start


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the command line and print the measurement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="default")
    parser.add_argument("--mode", default="compiled")
    parser.add_argument("--data", type=Path, metavar="ROOT")
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--threads", type=int)
    args = parser.parse_args(arguments)
    if args.threads is not None:
        torch.set_num_threads(args.threads)
    frames = first_scene(args.data, args.frames).frames
    print(json.dumps(asdict(probe(make_refiner(args.preset, args.mode), frames))))


if __name__ == "__main__":
    main()
