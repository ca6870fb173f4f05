"""Functions compiled side by side in other processes, and what happens when such a process cannot do it."""

from __future__ import annotations

import logging
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.compiled_lookup import (
    SIZES,
    PlainForm,
    compile_nothing,
    nearest_inputs,
    nearest_values,
    needs_compiler,
    new_nearest,
)
from torch._inductor.runtime import cache_dir_utils

from directshape_torch.compilation import compilable as compilable_module
from directshape_torch.compilation import helpers, together
from directshape_torch.compilation.form import CompiledForm
from directshape_torch.compilation.helpers import compiled_by_helpers, num_helpers
from directshape_torch.compilation.inputs import global_settings, varying_dimensions
from directshape_torch.compilation.regions import compiling
from directshape_torch.compilation.request import CompileRequest
from directshape_torch.compilation.store import load, stored_file
from directshape_torch.compilation.together import compiled_together
from directshape_torch.shape.compiled_march import RayRows, sample_grids
from directshape_torch.shape.pca_prior import PCAShapePrior


def march_arguments(num_rays: int = 40, num_samples: int = 4) -> tuple[object, ...]:
    prior = PCAShapePrior.load_bundled()
    centre = torch.tensor([[0.0, -0.7, -9.0]]).expand(num_rays, 3)
    direction = torch.randn(num_rays, 3) * 0.05 + torch.tensor([0.0, 0.0, 1.0])
    rays = RayRows.of(centre, direction, torch.zeros(num_rays).long())
    return (
        *prior.bind(prior.initial_code(2)).field,
        rays.rays_obj,
        rays.object_index,
        prior.bounds_obj,
        num_samples,
    )


def march_request(num_samples: int = 4) -> CompileRequest:
    variant = (*global_settings()[1:], f"{num_samples} samples")
    return CompileRequest.of(
        sample_grids.plain, variant, 0, march_arguments(num_samples=num_samples), sample_grids._varying
    )


@pytest.fixture
def _folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(cache_dir_utils, "cache_dir", lambda: str(tmp_path))


def test_a_request_is_for_other_processes_if_they_find_the_function_and_need_no_card() -> None:
    request = march_request()
    assert request.is_for_helpers()
    assert not replace(request, module="__main__").is_for_helpers()
    assert not replace(request, module="no.such.module").is_for_helpers()
    assert not replace(request, name="sample_grid").is_for_helpers()
    on_card = replace(request.arguments[0], device=torch.device("cuda"))
    assert not replace(request, arguments=(on_card,)).is_for_helpers()
    varying = varying_dimensions(nearest_values, SIZES)
    assert not CompileRequest.of(nearest_values, (), 0, nearest_inputs(5, 3), varying).is_for_helpers()


def test_other_settings_than_those_of_the_caller_are_no_setting_to_compile_with() -> None:
    with pytest.raises(RuntimeError, match="sample_grids cannot be compiled in this process: other code, or other"):
        replace(march_request(), variant=(torch.float64,)).compile_elsewhere()


@pytest.fixture
def _alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever other tests of this process have imported, and whoever has started it."""
    monkeypatch.delitem(sys.modules, "ray", raising=False)
    for name in ("RANK", "LOCAL_RANK"):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.usefixtures("_alone")
def test_helpers_are_as_many_as_there_are_other_functions_and_other_cores(monkeypatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(4), raising=False)
    assert [num_helpers(functions) for functions in (0, 1, 2, 3, 9)] == [0, 0, 1, 2, 3]
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(1), raising=False)
    assert num_helpers(3) == 0


@pytest.mark.usefixtures("_alone")
@pytest.mark.parametrize("kind", ["child", "rank", "ray", "helper"])
def test_a_process_that_is_one_of_several_workers_starts_no_helpers(kind, monkeypatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(4), raising=False)
    if kind == "child":
        monkeypatch.setattr(helpers.multiprocessing, "parent_process", object)
    elif kind == "ray":
        monkeypatch.setitem(sys.modules, "ray", object())
    else:
        monkeypatch.setenv({"rank": "RANK", "helper": helpers._IS_HELPER}[kind], "1")
    assert num_helpers(3) == 0


@needs_compiler
@pytest.mark.usefixtures("_folder")
def test_what_a_helper_compiles_is_what_is_compiled_here() -> None:
    request = march_request()
    with compiled_by_helpers([request]):
        assert stored_file(sample_grids.plain, request.variant) is None
        here = CompiledForm.of(sample_grids.plain, march_arguments(), sample_grids._varying)
    theirs = load(sample_grids.plain, request.variant)
    assert theirs is not None
    arguments = march_arguments(100)
    assert theirs.fits(arguments)
    for mine, other in zip(here(arguments), theirs(arguments), strict=True):
        assert torch.equal(mine, other)


def failing_helper(folder: Path) -> Path:
    script = folder / "python"
    script.write_text("#!/bin/sh\necho 'no module here' >&2\nexit 1\n")
    script.chmod(0o755)
    return script


@pytest.mark.usefixtures("_folder")
@pytest.mark.parametrize("command", ["false", "missing"])
def test_a_helper_that_fails_says_why_and_stops_nothing(command, monkeypatch, caplog, tmp_path: Path) -> None:
    script = failing_helper(tmp_path) if command == "false" else tmp_path / "missing"
    monkeypatch.setattr(sys, "executable", str(script))
    with caplog.at_level(logging.INFO), compiled_by_helpers([march_request()]):
        pass
    assert "compiled here instead" in caplog.text
    assert ("no module here" in caplog.text) == (command == "false")
    assert stored_file(sample_grids.plain, march_request().variant) is None


@pytest.mark.usefixtures("_folder")
def test_a_helper_that_ends_before_it_is_sent_anything_says_why(monkeypatch, caplog, tmp_path: Path) -> None:
    monkeypatch.setattr(sys, "executable", str(failing_helper(tmp_path)))
    send = helpers._send

    def send_late(process: subprocess.Popen[bytes], request: CompileRequest) -> None:
        process.wait()
        send(process, request)

    monkeypatch.setattr(helpers, "_send", send_late)
    with caplog.at_level(logging.INFO), compiled_by_helpers([march_request()]):
        pass
    assert "has not read what to compile" in caplog.text
    assert "a process that compiles failed (no module here): compiled here instead" in caplog.text


@pytest.mark.usefixtures("_folder")
def test_a_helper_that_will_not_read_is_not_waited_for(monkeypatch, caplog, tmp_path: Path) -> None:
    script, ready, ended = (tmp_path / name for name in ("python", "ready", "ended"))
    script.write_text(f"#!/bin/sh\nexec 0<&-\ntouch {ready}\nsleep 60\ntouch {ended}\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))
    send = helpers._send

    def send_late(process: subprocess.Popen[bytes], request: CompileRequest) -> None:
        while not ready.exists() and process.poll() is None:
            time.sleep(0.01)
        send(process, request)

    monkeypatch.setattr(helpers, "_send", send_late)
    with caplog.at_level(logging.INFO), compiled_by_helpers([march_request()]):
        pass
    assert "has not read what to compile" in caplog.text
    assert not ended.exists()


def endless_helper(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Path:
    """A helper that waits for a child, as for a C++ compiler; the file that the child makes if it is not ended."""
    script, ended = folder / "python", folder / "ended"
    script.write_text(f"#!/bin/sh\n(sleep 1; touch {ended}) >/dev/null 2>&1 &\nwait\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))
    return ended


@pytest.mark.usefixtures("_folder")
def test_a_helper_that_hangs_is_ended_with_all_that_it_started(monkeypatch, caplog, tmp_path: Path) -> None:
    ended = endless_helper(monkeypatch, tmp_path)
    monkeypatch.setattr(helpers, "_SECONDS", 0.05)
    with compiled_by_helpers([march_request()]):
        pass
    assert "has not ended" in caplog.text
    time.sleep(1.5)
    assert not ended.exists()


@pytest.mark.usefixtures("_folder")
def test_an_error_here_ends_the_helpers(monkeypatch, tmp_path: Path) -> None:
    ended = endless_helper(monkeypatch, tmp_path)
    with pytest.raises(KeyboardInterrupt), compiled_by_helpers([march_request()]):
        raise KeyboardInterrupt
    time.sleep(1.5)
    assert not ended.exists()


def test_a_helper_ends_when_the_pipe_from_its_parent_does() -> None:
    """Before it has compiled anything: the process that asked is gone."""
    command = [sys.executable, "-P", "-m", "directshape_torch.compilation.helper_process"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True) as helper:
        assert helper.stdin is not None
        helper.stdin.write(pickle.dumps(march_request(num_samples=96)))
        helper.stdin.close()
        assert helper.wait(timeout=120) in (-signal.SIGKILL, 1)


class TestTogether:
    """Work of two functions, with one core beside that of this process."""

    @pytest.fixture(autouse=True)
    def _one_core(self, monkeypatch) -> None:
        compile_nothing(monkeypatch)
        monkeypatch.setattr(together, "num_helpers", lambda functions: min(functions - 1, 1))

    def test_work_runs_plain_once_and_then_compiled(self) -> None:
        first, second, runs = new_nearest(), new_nearest(), []

        def work() -> torch.Tensor:
            runs.append((first.num_variants, second.num_variants))
            first(*nearest_inputs(20, 3))
            return second(*nearest_inputs(9, 2))[0]

        with compiling("on", 3):
            assert torch.equal(compiled_together(work), nearest_values(*nearest_inputs(9, 2))[0])
            compiled_together(work)
        assert runs == [(0, 0), (1, 1), (1, 1)]

    def test_nothing_is_run_twice_where_nothing_is_compiled(self) -> None:
        nearest, runs = new_nearest(), []
        for mode in ("off", "auto"):
            with compiling(mode, 3):
                compiled_together(lambda: runs.append(nearest(*nearest_inputs(20, 3))))
        compiled_together(lambda: runs.append(1))
        assert len(runs) == 3

    def test_threads_share_what_is_compiled(self, monkeypatch) -> None:
        nearest, made, results = new_nearest(), [], []

        def compile_slowly(_: CompileRequest, function: object) -> PlainForm:
            made.append(function)
            time.sleep(0.2)
            return PlainForm(function)

        def call() -> None:
            with compiling("on", 3):
                results.append(compiled_together(lambda: nearest(*nearest_inputs(20, 3))[0]))

        monkeypatch.setattr(CompileRequest, "compile", compile_slowly)
        threads = [threading.Thread(target=call) for _ in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert made == [nearest.plain]
        assert len(results) == 3

    @pytest.mark.parametrize("helper_works", [True, False])
    def test_the_last_function_is_left_to_the_helper_and_made_here_if_it_fails(self, helper_works, monkeypatch) -> None:
        first, last, asked, made = new_nearest(), new_nearest(), [], []

        class Helpers:
            def __init__(self, requests: list[CompileRequest]) -> None:
                asked.extend(requests)

            def __enter__(self) -> None: ...

            def __exit__(self, *_: object) -> None:
                if helper_works:
                    monkeypatch.setattr(compilable_module, "load", lambda function, *_: PlainForm(function))

        def compile_here(_: CompileRequest, function: object) -> PlainForm:
            made.append(function)
            return PlainForm(function)

        monkeypatch.setattr(together, "compiled_by_helpers", Helpers)
        monkeypatch.setattr(together, "can_keep", lambda _: True)
        monkeypatch.setattr(CompileRequest, "is_for_helpers", lambda _: True)
        monkeypatch.setattr(CompileRequest, "compile", compile_here)
        with compiling("on", 3):
            compiled_together(lambda: (first(*nearest_inputs(20, 3)), last(*nearest_inputs(9, 2))))
        assert len(asked) == 1
        assert made == ([first.plain] if helper_works else [first.plain, last.plain])
        assert last.num_variants == 1
