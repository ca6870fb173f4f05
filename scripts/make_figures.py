"""This script makes the figures of README.md, docs/results.md, docs/no_boxes.md and docs/failures.md anew.

    python scripts/make_figures.py --out out/figures         # about an hour of two cores
    python scripts/make_figures.py --only masks_rendered     # some commands

The data lie in DIRECTSHAPE_DATA. The words of each command, from which it can be given by itself, are below. Some need
what others wrote before. OUT/COMMIT/NAME.txt keeps what a command has printed, so that a second call does not run it
again. `OUT/COMMIT/figures.md` joins what has been printed. A row of a refinement has the cars of the labels that count,
with a mask, the mean BEV IoU before and after, the share that fell by more than 0.05, and the share of axes that are
right within 20 degrees.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import shlex
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from command_line import run_command

from directshape_torch.batch.refine_dataset import package_version
from directshape_torch.errors import DirectShapeError, InputError
from directshape_torch.evaluation.comparison import compare_results
from directshape_torch.evaluation.tables import number
from directshape_torch.files.atomic_files import write_text

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Refinement:
    """A `Refinement` is a call of `directshape refine` whose boxes are compared with labels."""

    data: str
    masks: str
    detections: str | None = None
    words: str = ""

    def command(self, out: str) -> str:
        given = "" if self.detections is None else f"--detections {self.detections} "
        return f"-m directshape_torch refine --data {self.data} --masks {self.masks} {given}--out {out} {self.words}"


A, B, R = "{data}/kitti15", "{data}/kitti", "{data}/rendered"
K15, K, EXACT, DEGRADED = f"{A}/training/masks", f"{B}/training/masks", f"{R}/training/masks", f"{R}/masks_degraded"
_UNKNOWN = "--rig none --set rig.disparity_sigma_px=0.3"
_LIDAR = "--rig {out}/lidar_rig.json"
_IMAGES_ALONE = (
    "--set priors.detector_weight=0 acceptance.min_probability_better=0 acceptance.min_probability_not_worse=0"
)
_EXACT_RIG = "--rig none --set search=off rig.disparity_sigma_px=0"

GIVEN_BOXES = {
    "k15_pointrcnn": Refinement(A, K15, f"{A}/detections/pointrcnn"),
    "k15_stereo": Refinement(A, K15, f"{A}/detections/noisy_stereo"),
    "k15_mono": Refinement(A, K15, f"{A}/detections/noisy_mono"),
    "k_pointrcnn": Refinement(B, K, f"{B}/detections/pointrcnn"),
    "k_stereo": Refinement(B, K, f"{B}/detections/noisy_stereo"),
    "k_mono": Refinement(B, K, f"{B}/detections/noisy_mono"),
    "k_stereo_left_masks": Refinement(B, "{out}/left_masks", f"{B}/detections/noisy_stereo", "--set search=off"),
    "k15_pointrcnn_no_rig": Refinement(A, K15, f"{A}/detections/pointrcnn", f"{_UNKNOWN} search=off"),
    "k15_stereo_no_rig": Refinement(A, K15, f"{A}/detections/noisy_stereo", f"{_UNKNOWN} search=off"),
    "k15_pointrcnn_exact_rig": Refinement(A, K15, f"{A}/detections/pointrcnn", _EXACT_RIG),
    "k15_stereo_exact_rig": Refinement(A, K15, f"{A}/detections/noisy_stereo", _EXACT_RIG),
    "rendered_stereo": Refinement(R, EXACT, f"{R}/detections/stereo"),
    "rendered_stereo_images_alone": Refinement(R, EXACT, f"{R}/detections/stereo", _IMAGES_ALONE),
    "rendered_mono_degraded": Refinement(R, DEGRADED, f"{R}/detections/mono"),
}
MASKS_ALONE = {
    "masks_k15_22": Refinement(A, K15, None, "--split {out}/22.txt"),
    "masks_k15_22_lidar_rig": Refinement(A, K15, None, f"--split {{out}}/22.txt {_LIDAR}"),
    "masks_k15_22_unknown_rig": Refinement(A, K15, None, f"--split {{out}}/22.txt {_UNKNOWN}"),
    "masks_k15_22_free_sizes": Refinement(A, K15, None, "--split {out}/22.txt --set priors.dimensions_weight=0"),
    "masks_k15_6": Refinement(A, K15, None, "--split {out}/6.txt --rig {out}/masks_k15_22/rig.json"),
    "masks_k15_lidar_rig": Refinement(A, K15, None, _LIDAR),
    "masks_k": Refinement(B, K),
    "masks_k_lidar_rig": Refinement(B, K, None, _LIDAR),
    "masks_k_unknown_rig": Refinement(B, K, None, _UNKNOWN),
    "masks_rendered": Refinement(R, EXACT),
    "masks_rendered_exact_rig": Refinement(R, EXACT, None, "--rig none"),
    "masks_rendered_free_sizes": Refinement(R, EXACT, None, "--set priors.dimensions_weight=0"),
    "masks_degraded": Refinement(R, DEGRADED),
    "masks_degraded_exact_rig": Refinement(R, DEGRADED, None, "--rig none"),
}
_TRUST = "scripts/calibrate_trust.py --workers {workers} --out {out}/"
_POSE = f"scripts/reproduce_tables.py pose --data {R} --masks {EXACT} --rows geometric paper combined 'images alone'"
_ABLATION = "scripts/reproduce_tables.py ablation"
_SHAPES = f"-m directshape_torch evaluate-shape --data {R} --detections {R}/detections/stereo --masks {EXACT} --refined"
OTHERS = {
    "trust": f"{_TRUST}trust --cars {A} {A}/detections/pointrcnn {K15} --cars {A} stereo {K15} --cars {A} mono {K15} "
    f"--cars {A} {A}/detections/biased_mono {K15} --cars {B} {B}/detections/pointrcnn {K} --cars {B} stereo {K} "
    f"--cars {B} mono {K} --cars {R} {R}/detections/stereo {EXACT} --cars {R} {R}/detections/mono {DEGRADED}",
    "trust_by_frame": f"{_TRUST}by_frame --by-frame --cars {A} {A}/detections/pointrcnn {K15} "
    f"--cars {A} {A}/detections/noisy_stereo {K15} --cars {A} {A}/detections/noisy_mono {K15}",
    "lidar_rig": f"-m directshape_torch calibrate-rig --data {A} --from disparity --out {{out}}/lidar_rig.json",
    "wrong_boxes": f"scripts/wrong_boxes.py --data {R} --detections {R}/detections/stereo --masks {EXACT}",
    "paper_stereo": f"{_POSE} --detections {R}/detections/stereo --out {{out}}/paper_stereo",
    "paper_mono": f"{_POSE} --detections {R}/detections/mono --out {{out}}/paper_mono",
    "ablation_near": f"{_ABLATION} --data {R} --masks {EXACT} --detections {R}/detections/stereo --out {{out}}/near",
    "ablation_far": f"{_ABLATION} --data {R} --masks {EXACT} --detections {R}/detections/mono --out {{out}}/far",
    "ablation_kitti": f"{_ABLATION} --data {B} --masks {K} --detections {B}/detections/noisy_stereo --out {{out}}/k",
    "heading": f"scripts/calibrate_heading.py --run {A} {{out}}/masks_k15_lidar_rig "
    f"--run {B} {{out}}/masks_k_lidar_rig --run {R} {{out}}/masks_rendered --run {R} {{out}}/masks_degraded",
    "shapes": f"{_SHAPES} {{out}}/rendered_stereo",
    "shapes_images_alone": f"{_SHAPES} {{out}}/rendered_stereo_images_alone",
}
REFINEMENTS = {**GIVEN_BOXES, **MASKS_ALONE}
# Commands of one group run side by side; each group needs files of those before it.
GROUPS = (
    ("lidar_rig",),
    tuple(name for name in REFINEMENTS if name != "masks_k15_6"),
    ("masks_k15_6", "wrong_boxes", "heading", "shapes", "shapes_images_alone", "paper_stereo", "paper_mono"),
    ("ablation_near", "ablation_far", "ablation_kitti"),
    ("trust_by_frame",),
    ("trust",),
)
NAMES = tuple(name for group in GROUPS for name in group)


def run(args: argparse.Namespace) -> None:
    """Run the commands that have not been run, and join what all have printed.

    Raises:
        InputError: DIRECTSHAPE_DATA is not set, or a name is none of the commands.
        DirectShapeError: a command failed; OUT/NAME.err has what it said.
    """
    data, version = os.environ.get("DIRECTSHAPE_DATA"), commit()
    if not data:
        raise InputError("DIRECTSHAPE_DATA", "the folder of kitti15, kitti and rendered", "nothing")
    if version.endswith("-dirty"):
        raise InputError("the checkout", "the files of its commit", "files that differ", "commit them")
    out = args.out.resolve() / version
    if unknown := set(args.only or ()) - set(NAMES):
        raise InputError("--only", f"names among {', '.join(NAMES)}", ", ".join(sorted(unknown)))
    write_inputs(Path(data), out)
    for group in GROUPS:
        names = [name for name in group if args.only is None or name in args.only]
        made = partial(make, data=data, out=out, workers=args.workers)
        with ThreadPoolExecutor(args.workers) as pool:
            list(pool.map(made, [name for name in names if not (out / f"{name}.txt").exists()]))
    kept = {name: out / f"{name}.txt" for name in NAMES}
    printed = {name: path.read_text(encoding="utf-8") for name, path in kept.items() if path.exists()}
    rows = ["| | cars | before | after | worse | axis right |", "|---|---|---|---|---|---|"]
    rows += [printed[name].strip() for name in REFINEMENTS if name in printed]
    parts = [f"Commit {version}", "\n".join(rows)]
    parts += [f"## {name}\n\n{printed[name].strip()}" for name in OTHERS if name in printed]
    write_text(out / "figures.md", "\n\n".join(parts) + "\n")
    print((out / "figures.md").read_text(encoding="utf-8"), end="")


def write_inputs(data: Path, out: Path) -> None:
    """Write the lists of frames, and masks of left images alone."""
    with (data / "kitti15" / "frames.csv").open(encoding="utf-8") as file:
        drives = {row["name"]: row["drive"] for row in csv.DictReader(file)}
    of_day = [name for name, drive in drives.items() if drive.startswith("2011_09_26")]
    sixth = [name for name in of_day if "_0014_" in drives[name]]
    write_text(out / "22.txt", "".join(f"{name}\n" for name in of_day if name not in sixth))
    write_text(out / "6.txt", "".join(f"{name}\n" for name in sixth))
    for path in (data / "kitti" / "training" / "masks").glob("*.json"):
        masks = [mask for mask in json.loads(path.read_text(encoding="utf-8")) if mask["image"] == "left"]
        write_text(out / "left_masks" / path.name, json.dumps(masks))


def make(name: str, data: str, out: Path, workers: int) -> None:
    """Keep what a command prints, which is a row of the table for a refinement."""
    refinement = REFINEMENTS.get(name)
    template = OTHERS[name] if refinement is None else refinement.command(f"{{out}}/{name}")
    words = [word.format(data=data, out=out, workers=workers) for word in shlex.split(template)]
    print(f"{name} begins", file=sys.stderr, flush=True)
    env = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, *words], cwd=ROOT, env=env, capture_output=True, text=True, check=False)
    if done.returncode:
        write_text(out / f"{name}.err", done.stderr)
        raise DirectShapeError(f"{name} failed with exit code {done.returncode}; see {out / name}.err")
    write_text(out / f"{name}.txt", done.stdout if refinement is None else row(name, refinement, Path(data), out))


def row(name: str, refinement: Refinement, data: Path, out: Path) -> str:
    """The line of a refinement in the table."""
    before = None if refinement.detections is None else refinement.detections.format(data=data)
    labels = Path(refinement.data.format(data=data)) / "training" / "label_2"
    found = compare_results(labels, before, out / name / "data", shapes_dir=out / name)
    iou, axis = found.overall.metrics["bev_iou_mean"], found.overall.metrics["yaw_axis_good_share"]
    worse = found.overall.worse_share
    cells = [name, str(found.overall.num_detections), "" if iou.before is None else number("", iou.before.value)]
    cells += [number("", iou.after.value), "" if worse is None else number("%", worse.value)]
    return f"| {' | '.join([*cells, number('%', axis.after.value)])} |\n"


def commit() -> str:
    """The commit of this checkout, with "-dirty" where files differ from it; the version if there is no repository."""
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--exclude=*"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    return found.stdout.strip() or f"version {package_version()}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", help=f"of {', '.join(NAMES)}; default: all")
    parser.add_argument("--workers", type=int, default=2, help="commands side by side (default %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out/figures"), metavar="DIR", help="default: %(default)s")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
