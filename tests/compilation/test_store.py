"""What one process compiled, the next one loads whole: same values, nothing traced; damaged files are made anew."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch._inductor.config
from helpers.compiled_lookup import SIZES, nearest_inputs, nearest_values, needs_compiler
from torch._inductor.runtime import cache_dir_utils

from directshape_torch.compilation import store as stored
from directshape_torch.compilation.form import CompiledForm
from directshape_torch.compilation.inputs import varying_dimensions
from directshape_torch.compilation.store import load, store, stored_file
from directshape_torch.shape.compiled_march import sample_grids

VARIANT = ("float32", (-1, 3))
FUNCTION = sample_grids.plain
VARYING = varying_dimensions(nearest_values, SIZES)


class Stored:
    """In place of a form that has been compiled."""

    def to_bytes(self) -> bytes:
        return b"form"


@pytest.fixture
def _folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(cache_dir_utils, "cache_dir", lambda: str(tmp_path))


@pytest.mark.usefixtures("_folder")
class TestFiles:
    def test_a_form_is_found_for_the_same_variant_and_number_only(self) -> None:
        assert stored_file(FUNCTION, VARIANT) is None
        store(Stored(), FUNCTION, VARIANT)
        assert stored_file(FUNCTION, VARIANT) is not None
        assert stored_file(FUNCTION, (*VARIANT, "else")) is None
        assert stored_file(FUNCTION, VARIANT, 1) is None

    def test_of_a_function_whose_sources_are_not_known_nothing_is_kept(self, tmp_path: Path) -> None:
        store(Stored(), nearest_values, VARIANT)
        assert stored_file(nearest_values, VARIANT) is None
        assert list(tmp_path.iterdir()) == []

    def test_other_versions_and_sources_do_not_find_it(self, monkeypatch) -> None:
        store(Stored(), FUNCTION, VARIANT)
        stored._fingerprint.cache_clear()
        monkeypatch.setattr(stored, "_package_version", lambda: "another")
        assert stored_file(FUNCTION, VARIANT) is None
        stored._fingerprint.cache_clear()

    @pytest.mark.parametrize("setting", [{"force_disable_caches": True}, {"fx_graph_cache": False}])
    def test_nothing_is_kept_where_the_caches_are_off(self, setting) -> None:
        with torch._inductor.config.patch(setting):
            store(Stored(), FUNCTION, VARIANT)
        assert stored_file(FUNCTION, VARIANT) is None
        store(Stored(), FUNCTION, VARIANT)
        with torch._inductor.config.patch(setting):
            assert stored_file(FUNCTION, VARIANT) is None

    def test_a_damaged_file_is_as_good_as_none_and_the_log_names_it(self, caplog, tmp_path: Path) -> None:
        store(Stored(), FUNCTION, VARIANT)
        assert load(FUNCTION, VARIANT) is None
        assert str(tmp_path) in caplog.text
        assert "cannot be used" in caplog.text
        # Once in a process; it may be sound to another, and what is compiled here takes its place.
        assert load(FUNCTION, VARIANT) is None
        assert caplog.text.count("cannot be used") == 1
        store(Stored(), FUNCTION, VARIANT)
        assert stored_file(FUNCTION, VARIANT) is not None

    @pytest.mark.skipif(not hasattr(os, "getuid"), reason="no owners of files on this system")
    def test_a_file_that_others_may_write_is_not_read(self, tmp_path: Path) -> None:
        store(Stored(), FUNCTION, VARIANT)
        (path,) = (path for path in tmp_path.rglob("*") if path.is_file())
        path.chmod(0o666)
        assert stored_file(FUNCTION, VARIANT) is None

    def test_sources_that_changed_since_they_were_imported_keep_nothing(self, monkeypatch) -> None:
        monkeypatch.setattr(stored, "_IMPORTED", 0.0)
        stored._fingerprint.cache_clear()
        store(Stored(), FUNCTION, VARIANT)
        stored._fingerprint.cache_clear()
        monkeypatch.undo()
        assert stored_file(FUNCTION, VARIANT) is None

    def test_other_settings_of_the_compiler_do_not_find_it(self) -> None:
        store(Stored(), FUNCTION, VARIANT)
        for setting in ({"cpp.simdlen": 256}, {"max_fusion_size": 3}):
            with torch._inductor.config.patch(setting):
                assert stored_file(FUNCTION, VARIANT) is None
        assert stored_file(FUNCTION, VARIANT) is not None

    def test_a_form_that_cannot_be_written_leaves_no_file(self, tmp_path: Path) -> None:
        class Unwritable(Stored):
            def to_bytes(self) -> bytes:
                raise ValueError("no bytes")

        store(Unwritable(), FUNCTION, VARIANT)
        assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_a_folder_that_cannot_be_written_is_no_error(monkeypatch, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    monkeypatch.setattr(cache_dir_utils, "cache_dir", lambda: str(file))
    store(Stored(), FUNCTION, VARIANT)
    assert stored_file(FUNCTION, VARIANT) is None


def test_a_cache_folder_that_cannot_be_made_is_no_error(monkeypatch) -> None:
    def none() -> str:
        raise FileNotFoundError(2, "No such file or directory", "/no/such")

    monkeypatch.setattr(cache_dir_utils, "cache_dir", none)
    store(Stored(), FUNCTION, VARIANT)
    assert stored_file(FUNCTION, VARIANT) is None


@needs_compiler
def test_a_form_holds_for_other_sizes_and_for_nothing_else() -> None:
    compiled = CompiledForm.of(nearest_values, nearest_inputs(5, 3), VARYING)
    for form in (compiled, CompiledForm.from_bytes(compiled.to_bytes())):
        inputs = nearest_inputs(130, 2)
        assert form.fits(inputs)
        for value, expected in zip(form(inputs), nearest_values(*inputs), strict=True):
            torch.testing.assert_close(value, expected)
        points, grid, car = inputs
        assert not form.fits((points, torch.rand(2, 5, 4), car))
        assert not form.fits((points.double(), grid, car))


@needs_compiler
@pytest.mark.usefixtures("_folder")
def test_caches_that_are_off_do_not_keep_it_from_being_compiled(tmp_path: Path) -> None:
    with torch._inductor.config.patch(force_disable_caches=True):
        form = CompiledForm.of(nearest_values, nearest_inputs(5, 3), VARYING)
        store(form, FUNCTION, VARIANT)
    assert form.fits(nearest_inputs(9, 2))
    assert not (tmp_path / "directshape_torch").exists()


PROCESS = """
import json, sys, torch
from torch._dynamo.utils import counters
from directshape_torch.compilation.regions import compiling
from directshape_torch.shape.compiled_march import RayRows, sample_grids
from directshape_torch.shape.pca_prior import PCAShapePrior
prior = PCAShapePrior.load_bundled()
torch.manual_seed(0)
rays = RayRows.of(torch.tensor([[0.0, -0.7, -9.0]]).expand(40, 3), torch.rand(40, 3), torch.zeros(40).long())
field = prior.bind(prior.initial_code(2)).field
with compiling("on", 1):
    sampled = sample_grids(*field, rays.rays_obj, rays.object_index, prior.bounds_obj, 4)
sums = [x.double().sum().item() for x in sampled]
print(json.dumps([sample_grids.num_variants, counters["stats"]["unique_graphs"], sums]))
"""


@needs_compiler
def test_a_later_process_traces_nothing(tmp_path: Path) -> None:
    environment = {**os.environ, "TORCHINDUCTOR_CACHE_DIR": str(tmp_path), "OMP_NUM_THREADS": "1"}
    # Warnings of PyTorch's own parts are no reason to do without.
    command, said = [sys.executable, "-W", "error", "-c", PROCESS], []
    for threads in "1", "1", "2":
        environment["OMP_NUM_THREADS"] = threads
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        said.append(json.loads(done.stdout))
    assert [graphs for _, graphs, _ in said] == [1, 0, 0]
    assert said[0][0] == said[1][0] == said[2][0] == 1
    assert said[0][2] == said[1][2] == said[2][2]
