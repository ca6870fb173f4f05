"""One call of the benchmark: suites in turn, tables as they come, then files and the comparison with the baseline."""

from __future__ import annotations

import importlib
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from directshape_torch.benchmark.baseline import (
    Expected,
    compare,
    make_baseline,
    read_baseline,
    updated,
    write_baseline,
)
from directshape_torch.benchmark.machine import describe_machine
from directshape_torch.benchmark.report import BenchmarkRun, format_machine, format_suite, write_run
from directshape_torch.benchmark.rows import SuiteResult
from directshape_torch.benchmark.settings import SuiteSettings
from directshape_torch.benchmark.workloads import check_data_root
from directshape_torch.config_files import config_to_mapping, load_config
from directshape_torch.errors import InputError
from directshape_torch.io.figure_files import check_figures

_PACKAGE = "directshape_torch.benchmark"

# Module and function, imported when the suite runs: not all of them have what they need on every machine.
SUITES = {
    "cpu": ("suite_cpu", "run_cpu"),
    "gpu": ("suite_gpu", "run_gpu"),
    "scaling": ("suite_scaling", "run_scaling"),
    "kernels": ("suite_kernels", "run_kernels"),
    "peers": ("peers", "run_peers_suite"),
}

Progress = Callable[[str], None]

# Beside our own threads, of which there are as many as cores at most.
_OTHERS_LOAD = 0.5


@dataclass(frozen=True)
class BenchmarkOptions:
    """What a call of the benchmark is told.

    Attributes:
        suites: names of `SUITES`.
        data_root: folder that holds `rendered` and `kitti`, or None for the bundled frame.
        quick: cut everything short.
        json_path: file for everything that was measured, or None.
        plots_dir: folder for pictures, or None.
        baseline_path: file of the baseline.
        check: compare with it.
        write_baseline: replace its rows of these suites.
        profile: measure one refinement by stage as well.
        command_line: for the record.
    """

    suites: tuple[str, ...]
    data_root: Path | None
    quick: bool
    json_path: Path | None
    plots_dir: Path | None
    baseline_path: Path
    check: bool
    write_baseline: bool
    profile: bool
    command_line: str


def run_benchmark(options: BenchmarkOptions, progress: Progress) -> int:
    """Run the suites and print their tables; returns the exit code, 1 for a regression.

    Raises:
        InputError: a baseline is to be made of a quick run; a data folder without frames; nothing to compare.
        DataFormatError: no baseline to compare with.
        MissingDependencyError: pictures are asked for and matplotlib is not installed.
    """
    if options.write_baseline and options.quick:
        raise InputError("--write-baseline", "a run without --quick", "--quick", "quick figures are no baseline")
    baseline = read_baseline(options.baseline_path) if options.check else {}
    if options.plots_dir is not None:
        check_figures("benchmark.py --plots")
    if options.data_root is not None:
        check_data_root(options.data_root)
    if options.json_path is not None:
        _check_writable(options.json_path.parent)
    machine = describe_machine()
    print(format_machine(machine), flush=True)
    if options.quick:
        print("QUICK: everything is cut short, no figure here is to be quoted", flush=True)
    settings = SuiteSettings.make(options.data_root, options.quick, progress)
    results = []
    for name in (*(["profile"] if options.profile else []), *options.suites):
        results.append(_run_suite(name, settings))
        print(f"\n{format_suite(results[-1])}", flush=True)
    presets = {name: config_to_mapping(load_config(name)) for name in ("default", "fast")}
    run = BenchmarkRun(machine, options.command_line, presets, options.quick, tuple(results))
    _write_files(run, options)
    return _report_regressions(run, baseline) if options.check else 0


def _check_writable(folder: Path) -> None:
    """Before minutes of measuring, not after."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError("--json", "a file in a folder that can be written to", f"{folder}: {error}") from error


def _run_suite(name: str, settings: SuiteSettings) -> SuiteResult:
    module, function = ("suite_profile", "run_profile") if name == "profile" else SUITES[name]
    result = getattr(importlib.import_module(f"{_PACKAGE}.{module}"), function)(settings)
    assert isinstance(result, SuiteResult)
    return _with_note_on_load(result)


def _with_note_on_load(result: SuiteResult) -> SuiteResult:
    """Several threads that wait for one another stand still where something else has one of the cores."""
    machine = describe_machine()
    if machine.load is None or machine.load < machine.cores + _OTHERS_LOAD:
        return result
    note = (
        f"load {machine.load:.1f} on {machine.cores} cores: if something else was running, figures are not to be quoted"
    )
    return replace(result, notes=(*result.notes, note))


def _write_files(run: BenchmarkRun, options: BenchmarkOptions) -> None:
    if options.json_path is not None:
        write_run(options.json_path, run)
        print(f"\nwrote {options.json_path}")
    curves = [curve for suite in run.suites for curve in suite.curves]
    if options.plots_dir is not None and curves:
        from directshape_torch.benchmark.plots import write_plots

        for path in write_plots(options.plots_dir, curves):
            print(f"wrote {path}")
    if options.write_baseline:
        new = make_baseline(run.rows)
        if not new:
            raise InputError("--write-baseline", "suites with ratios, slopes or counts", "none of these")
        old = read_baseline(options.baseline_path) if options.baseline_path.is_file() else {}
        write_baseline(options.baseline_path, updated(old, new, [suite.suite for suite in _measured(run)]))
        print(f"wrote {options.baseline_path}")


def _report_regressions(run: BenchmarkRun, baseline: dict[str, Expected]) -> int:
    found = compare(_measured(run), baseline)
    print(f"\ncompared {found.num_compared} rows with the baseline")
    for key in found.not_measured:
        print(f"cannot be measured here: {key}")
    for sentence in found.regressions:
        print(f"regression: {sentence}")
    if found.regressions:
        return 1
    if not found.num_compared:
        raise InputError(
            "--check", "suites with rows in the baseline that can run here", "none of these", "see the notes"
        )
    print("no regression")
    return 0


def _measured(run: BenchmarkRun) -> list[SuiteResult]:
    """Suites that could run here: one without rows found nothing to run on."""
    return [suite for suite in run.suites if suite.rows]
