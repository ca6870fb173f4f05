"""How many frames a second do N workers refine, and what do 100 000 frames cost?

Runs `directshape refine` over the same frames with each number of workers, into folders that are removed again, and
compares the results byte for byte. Without `--data` the frames are copies of the bundled demo frame, which has more
cars than most. Both figures are given: from the start of the command to its end, and once every worker is at work.

    python scripts/measure_throughput.py --workers 1 2 --frames-of-demo 24 --out throughput.json
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from command_line import run_command

from directshape_torch.batch.options import RefineOptions, WorkerOptions
from directshape_torch.batch.refine_dataset import refine_dataset
from directshape_torch.cli.data_options import add_data_options, dataset_of
from directshape_torch.cli.demo import DEMO_FOLDER
from directshape_torch.cli.refine import make_refiner
from directshape_torch.errors import DirectShapeError
from directshape_torch.files.atomic_files import write_json
from directshape_torch.io.kitti_dataset import KittiStereoDataset
from directshape_torch.io.stereo_dataset import StereoDataset
from directshape_torch.refiner import DirectShapeRefiner

FRAMES_OF_A_BIG_RUN = 100_000


@dataclass(frozen=True)
class Throughput:
    """One run.

    Attributes:
        where: "processes", or a Ray cluster.
        workers: processes side by side.
        threads: of each.
        frames: of the run.
        cars: in them.
        wall_s: from the start of the run to its end, the start of the workers included.
        frames_per_s: in that time.
        steady_frames_per_s: after as many frames have ended as there are workers.
        refine_ms_per_frame: of the refinement alone, in its worker.
        cpu_ms_per_frame: of the processor, reading and writing included; hardly depends on what else the machine does.
        peak_memory_mb: of the largest worker.
        load_before: runnable processes of the machine in the minute before; else figures are not worth much.
    """

    where: str
    workers: int
    threads: int
    frames: int
    cars: int
    wall_s: float
    frames_per_s: float
    steady_frames_per_s: float
    refine_ms_per_frame: float
    cpu_ms_per_frame: float
    peak_memory_mb: float
    load_before: float

    @property
    def core_hours_of_a_big_run(self) -> float:
        """For 100 000 such frames, on cores like these."""
        return FRAMES_OF_A_BIG_RUN / self.steady_frames_per_s * self.workers * self.threads / 3600


class Clock:
    """Notes when each frame ends."""

    def __init__(self) -> None:
        self.ends_s: list[float] = []

    def started(self, frame_ids: Sequence[str]) -> None:
        """Nothing."""

    def finished(self, frame_id: str, failure: str | None) -> None:
        """A time; a failed frame would spoil the measurement."""
        if failure is not None:
            raise DirectShapeError(f"frame {frame_id} failed: {failure}")
        self.ends_s.append(time.perf_counter())

    def steady_rate(self, workers: int) -> float:
        """Frames a second after the first of each worker."""
        rest = self.ends_s[workers - 1 :]
        return (len(rest) - 1) / (rest[-1] - rest[0]) if len(rest) > 1 else float("nan")


def demo_copies(root: Path, num_frames: int) -> StereoDataset:
    """The demo frame under as many names."""
    source_id = next((DEMO_FOLDER / "training" / "image_2").iterdir()).stem
    for path in sorted(DEMO_FOLDER.rglob(f"{source_id}*")):
        for number in range(num_frames):
            copy = root / path.relative_to(DEMO_FOLDER).with_name(path.name.replace(source_id, f"{number:06d}"))
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copy)
    return KittiStereoDataset(root, root / "detections" / "noisy_stereo", root / "training" / "masks")


def measure(
    dataset: StereoDataset, refiner: DirectShapeRefiner, out_dir: Path, options: RefineOptions, who: WorkerOptions
) -> Throughput:
    """Run once, into an empty folder."""
    clock, load = Clock(), os.getloadavg()[0]
    start = time.perf_counter()
    timings = refine_dataset(dataset, refiner, out_dir, options, clock, who).timings
    wall_s = time.perf_counter() - start
    return Throughput(
        where=who.ray or "processes",
        workers=timings.workers,
        threads=timings.threads,
        frames=timings.num_frames,
        cars=timings.num_cars,
        wall_s=round(wall_s, 2),
        frames_per_s=round(timings.num_frames / wall_s, 3),
        steady_frames_per_s=round(clock.steady_rate(timings.workers), 3),
        refine_ms_per_frame=round(timings.ms_per_frame or float("nan"), 1),
        cpu_ms_per_frame=round(1000 * timings.cpu_s / timings.num_frames, 1),
        peak_memory_mb=round(timings.peak_mb or float("nan"), 1),
        load_before=round(load, 2),
    )


def results(folder: Path) -> dict[str, bytes]:
    """The files that must not depend on who did the work."""
    names = sorted(path for kind in ("data", "shapes") for path in (folder / kind).iterdir())
    return {str(path.relative_to(folder)): path.read_bytes() for path in names}


def table(rows: Sequence[Throughput]) -> str:
    """What the program prints."""
    columns: dict[str, Callable[[Throughput], str]] = {
        "workers": lambda row: f"{row.workers}",
        "threads": lambda row: f"{row.threads}",
        "frames/s": lambda row: f"{row.frames_per_s:.2f}",
        "steady": lambda row: f"{row.steady_frames_per_s:.2f}",
        "speed-up": lambda row: f"{row.steady_frames_per_s / rows[0].steady_frames_per_s:.2f}",
        "refine ms": lambda row: f"{row.refine_ms_per_frame:.0f}",
        "CPU ms": lambda row: f"{row.cpu_ms_per_frame:.0f}",
        "MB": lambda row: f"{row.peak_memory_mb:.0f}",
        "load before": lambda row: f"{row.load_before:.1f}",
        "core hours per 100 000": lambda row: f"{row.core_hours_of_a_big_run:.1f}",
    }
    lines = ["  ".join(columns)]
    lines += ["  ".join(cell(row).rjust(len(name)) for name, cell in columns.items()) for row in rows]
    return "\n".join(lines)


def run(args: argparse.Namespace) -> int:
    """Measure, compare, print; 1 where results differ."""
    refiner = make_refiner(args.config, args.set, None, args.device)
    options = RefineOptions(batch_frames=args.batch_frames)
    rows, contents = [], []
    with tempfile.TemporaryDirectory() as folder:
        dataset = demo_copies(Path(folder), args.frames_of_demo) if args.data is None else dataset_of(args)
        for number, workers in enumerate(args.workers):
            out_dir = Path(folder) / f"out_{number}"
            who = WorkerOptions(workers, args.threads, args.ray)
            rows.append(measure(dataset, refiner, out_dir, options, who))
            contents.append(results(out_dir))
            print(table(rows[-1:]) if number == 0 else table(rows).splitlines()[-1], flush=True)
    is_same = all(content == contents[0] for content in contents)
    print(f"results of all runs the same byte for byte: {'yes' if is_same else 'NO'}")
    if args.out is not None:
        write_json(args.out, {"cores": os.cpu_count(), "same_bytes": is_same, "runs": [asdict(row) for row in rows]})
    return 0 if is_same else 1


def make_parser() -> argparse.ArgumentParser:
    """The options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_data_options(parser, required=False)
    parser.add_argument("--frames-of-demo", type=int, default=24, metavar="N", help="copies, without --data")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2], metavar="N", help="one run for each number")
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="of each worker")
    parser.add_argument("--batch-frames", type=int, default=1, metavar="N", help="frames in a call")
    parser.add_argument("--ray", metavar="ADDRESS|local", help="on Ray instead of processes of this machine")
    parser.add_argument("--config", metavar="FILE|NAME", help="settings of the refinement")
    parser.add_argument("--set", action="extend", nargs="+", default=[], metavar="KEY=VALUE", help="single settings")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the figures as JSON")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """The program."""
    return run_command(make_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
