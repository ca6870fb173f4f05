"""Wrong use of the commands gives exit code 2, one line with the expectation, and no files."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.finished_run import FinishedRun

from directshape_torch.cli.demo import DEMO_FOLDER
from directshape_torch.cli.main import main

EXPORT = "export {run} --prior {root}/prior.safetensors --out {out}"
REPORT = "report {run} --html {out}/page.html"
INSPECT = "inspect --out {out}"
PRIOR = "build-prior --meshes {meshes} --out {out}/car.safetensors"
REFINE = "refine --data {root} --detections {root}/detections --out {out} --prior {root}/prior.safetensors --device cpu"
FILE = "{root}/prior.safetensors"
DEMO_MASKS = f"calibrate-rig --data {DEMO_FOLDER} --masks {DEMO_FOLDER}/training/masks"
MASKED = f"{REFINE} --masks {{root}}/masks"

CASES = [
    (f"{EXPORT} --format rerun", "--data: expected the data set of the run, for the pictures of a recording"),
    (f"{EXPORT} --format ply --masks x", "--data: expected the data set of the run, because of --masks"),
    (f"{EXPORT} --format ply --masks-left x", "because of --masks-left"),
    (f"{EXPORT} --format ply --frames 7", "frames: expected finished frames of"),
    (f"{EXPORT} --format ply --prior pca", "--prior: expected the prior of the run"),
    ("export {root} --format kitti --out {out}", "summary.json: is missing"),
    (f"{REPORT} --frames 1 9", "got 9"),
    (f"{REPORT} --max-frames -1", "most_frames"),
    (f"{REPORT} --detections .", "--data"),
    (f"{REPORT} --rig field.json", "--data"),
    (f"{REPORT} --prior neural", "the prior of the run"),
    (f"{REPORT} --data nowhere", "training"),
    (f"{REPORT} --masks a --masks-left b --data {{root}}", "either a folder (--masks DIR) or COCO files"),
    ("report {root} --html {out}/page.html", "summary.json"),
    ("status {root}", "no run of 'directshape refine' is or was here"),
    (INSPECT, "something to inspect"),
    (f"{INSPECT} --demo --frames 7", "such as 000000, got 7"),
    (f"{INSPECT} --demo --car 9", "car of frame 000000: 1, 2, 3, 4, 5, 6, got 9"),
    (f"{INSPECT} --demo --data x", "bundled frame alone"),
    (f"{INSPECT} --data {DEMO_FOLDER}", "give --frames ID"),
    (f"{INSPECT} --demo --prior nowhere.npz", "nowhere.npz"),
    (f"{INSPECT} --demo --car 2 --set sampling.min_usable_pixels=100000", "too_few_pixels"),
    ("build-prior --meshes nowhere --out {out}/car.safetensors", "--meshes: expected a folder"),
    (f"{PRIOR} --pattern *.glb", "none in"),
    (f"{PRIOR} --num-codes 9 --up-axis=-y --spacing 0.2", "more than --num-codes = 9 usable meshes"),
    (f"{PRIOR} --spacing 3", "--spacing"),
    (PRIOR.replace("car.safetensors", "car.json"), "--out: expected another ending than .json, which is that of the"),
    ("calibrate-rig --data {root} --out {out}/rig.png", "--out: expected another ending than .png"),
    (REFINE, "--masks: expected either a folder"),
    (f"{MASKED} --masks-left x.json", "got both"),
    (REFINE.replace("--out {out}", "--out {root}/detections --masks {root}/masks"), "it would overwrite its own input"),
    *(
        (words.replace("{out}", FILE), "expected a folder, which is made where it is missing, got the file")
        for words in (
            MASKED,
            f"{INSPECT} --demo",
            f"{INSPECT}/figures --demo",
            f"{EXPORT} --format ply",
            "fit-shape --data x --lidar x --boxes x --out {out}",
            "calibrate-rig --data {root} --out {out}/rig.json",
            PRIOR,
            f"report {{run}} --html {FILE}/page.html",
        )
    ),
    ("calibrate-rig --data {root} --out {root}", "--out: expected a file, got the folder"),
    (
        "check-data --data {root} --detections {root}/detections --json {root}",
        "--json: expected a file, got the folder",
    ),
    (f"evaluate --labels {{root}} --results {{root}} --json {FILE}/a.json", "--json: expected a folder, which is made"),
    ("report {run} --html {root}", "--html: expected a file, got the folder"),
    (f"{MASKED} --prior pcaa", "directshape build-prior; bundled ones are pca and neural"),
    (f"{MASKED} --threads 0", "threads: expected at least 1, got 0"),
    (f"{MASKED} --batch-frames 0", "batch_frames: expected at least 1, got 0"),
    (MASKED.replace("{out}", "s3://bucket/out"), "expected a folder of a file system, got s3:/bucket/out; mount it"),
    (f"{MASKED} --lidar nowhere", "nowhere: is no folder of LiDAR scans"),
    (
        f"{MASKED} --disparity x",
        "--disparity: expected settings that fit points, got point_cloud.weight 0; add --config",
    ),
    (f"{MASKED} --config geometric --disparity nowhere", "is no folder of disparity maps"),
    (
        "check-data --data {root} --detections {root}/detections --masks {root}/masks --frames 77",
        "such as 000000, got 77",
    ),
    (
        "evaluate --labels {root}/training/label_2 --results {root}/training/label_2",
        "000000.txt, line 1: a result without score: ",
    ),
    (f"compare --labels {DEMO_FOLDER}/training/label_2 --after nowhere", "nowhere: is no folder of result files"),
    (f"{DEMO_MASKS.replace('calibrate-rig', 'refine')} --classes Van --out {{out}}", "classes: expected Car"),
    (f"{DEMO_MASKS} --out {{out}}/a.json", "--detections: expected boxes of a detector, got none; --from detections"),
    (
        f"{DEMO_MASKS} --detections {DEMO_FOLDER}/detections/noisy_stereo --from sizes --out {{out}}/a.json",
        "--detections: expected none, got some",
    ),
    (
        f"evaluate --type Truc --labels {DEMO_FOLDER}/training/label_2 --results {DEMO_FOLDER}/detections/noisy_stereo",
        "a class of these files: Car, got Truc",
    ),
]


@pytest.fixture(scope="session")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("meshes")
    (folder / "broken.obj").write_text("v 0 0 0\n")
    return folder


@pytest.mark.parametrize(("words", "said"), CASES)
def test_one_line_says_it(
    finished: FinishedRun, meshes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: str, said: str
) -> None:
    places = {"run": finished.out, "root": finished.root, "meshes": meshes, "out": tmp_path / "out"}
    assert main([word.format(**places) for word in words.split()]) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    line = shown.err.splitlines()[-1]
    assert line.startswith("directshape: error: ")
    assert said in line
    assert words.startswith(("build-prior", "inspect")) or len(shown.err.splitlines()) == 1, "work before its error"
    assert not list(tmp_path.iterdir())
