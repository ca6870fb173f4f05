"""Results are read back as refined boxes, and files that are damaged or do not belong together are refused."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.finished_run import FinishedRun
from helpers.shape_arrays import shape_arrays

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.files.array_files import write_npz
from directshape_torch.io.kitti_labels import read_objects
from directshape_torch.io.result_files import ShapeArrays, read_shapes, write_result_text, write_shapes
from directshape_torch.io.run_folder import RunFolder

CAR = "Car -1.00 -1 -2.2941 766.19 174.53 1241.00 374.00 1.5047 1.6292 4.0765 2.4780 1.5201 4.3034 -1.7716 0.90000"
WALKER = "Pedestrian  0 0 0.5 1 2 3 4 1.8 0.6 0.6 1 1.7 9 0 1e-3\t"
BOX = (-2.0, 1.5, 1.61, 3.9, 2.5, -1e-6, 4.25, -1.75)


def test_nothing_refined_is_a_copy_byte_for_byte(tmp_path: Path) -> None:
    content = f"{CAR}\r\n{WALKER}\r\n".encode()
    (tmp_path / "in.txt").write_bytes(content)
    write_result_text(tmp_path / "out.txt", read_objects(tmp_path / "in.txt"), {})
    assert (tmp_path / "out.txt").read_bytes() == content
    write_result_text(tmp_path / "out.txt", read_objects(tmp_path / "in.txt"), {0: BOX})
    assert all(line.endswith(b"\r") for line in (tmp_path / "out.txt").read_bytes().split(b"\n")[:-1])


def test_wrong_refinements_leave_no_file(tmp_path: Path) -> None:
    (tmp_path / "in.txt").write_text(CAR)
    objects = read_objects(tmp_path / "in.txt")
    with pytest.raises(InputError, match=r"refined: expected indices of the 1 input lines, got \[1\]"):
        write_result_text(tmp_path / "out.txt", objects, {1: BOX})
    with pytest.raises(InputError, match="refined: expected finite numbers"):
        write_result_text(tmp_path / "out.txt", objects, {0: (float("nan"), *BOX[1:])})
    assert not (tmp_path / "out.txt").exists()


@pytest.mark.parametrize("num_cars", [0, 1, 3])
def test_shapes_round_trip_and_equal_bytes(tmp_path: Path, num_cars: int) -> None:
    written = shape_arrays(num_cars)
    write_shapes(tmp_path / "a.npz", written)
    write_shapes(tmp_path / "b.npz", written)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    read = read_shapes(tmp_path / "a.npz")
    for entry in dataclasses.fields(ShapeArrays):
        before, after = getattr(written, entry.name), getattr(read, entry.name)
        if isinstance(before, np.ndarray):
            assert before.dtype == after.dtype
            np.testing.assert_array_equal(before, after)
        else:
            assert before == after
    with np.load(tmp_path / "a.npz", allow_pickle=False) as archive:
        assert int(archive["schema_version"]) == 5


def test_shapes_of_wrong_size() -> None:
    with pytest.raises(InputError, match=r"covariances: expected shape \(3, 11, 11\), got \(3, 5, 5\)"):
        dataclasses.replace(shape_arrays(3), covariances=np.zeros((3, 5, 5)))
    with pytest.raises(InputError, match=r"statuses: expected shape \(3,\), got \(2,\)"):
        dataclasses.replace(shape_arrays(3), statuses=("converged", "no_mask"))


def test_files_that_are_no_shapes(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with pytest.raises(DataFormatError, match=r"a\.npz: cannot be read"):
        read_shapes(path)
    write_npz(path, {"codes": np.zeros(3)})
    with pytest.raises(DataFormatError, match="has shape schema None, this version reads 5"):
        read_shapes(path)
    write_npz(path, {"schema_version": np.array(1)})
    with pytest.raises(DataFormatError, match="has shape schema 1, this version reads 5"):
        read_shapes(path)
    write_npz(path, {"schema_version": np.array(5), "codes": np.zeros(3)})
    with pytest.raises(DataFormatError, match="has been changed since it was written"):
        read_shapes(path)


def test_files_that_do_not_fit_together_are_named(finished: FinishedRun, tmp_path: Path) -> None:
    out = Path(shutil.copytree(finished.out, tmp_path / "out"))
    result = out / "data" / "000000.txt"
    result.write_text("".join(result.read_text().splitlines(keepends=True)[:1]))
    with pytest.raises(DataFormatError, match=r"data/000000.txt: has been changed, or does not belong to .*npz"):
        RunFolder(out).read("000000")
