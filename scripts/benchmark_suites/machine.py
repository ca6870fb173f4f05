"""What a benchmark ran on: processor, threads, versions, compiler, graphics card."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import torch

from directshape_torch.batch.refine_dataset import package_version


@dataclass(frozen=True)
class Machine:
    """A machine and its software.

    Attributes:
        processor: model name.
        cores: that this process may use.
        threads: of PyTorch's operations.
        system: operating system and its version.
        python, torch, directshape_torch: versions.
        compiler: first line of the C++ compiler's `--version`, or None where there is none.
        gpu: name of the first graphics card and CUDA's version, or None.
        load: mean number of processes that wanted to run in the minute before, or None where the system does not tell.
    """

    processor: str
    cores: int
    threads: int
    system: str
    python: str
    torch: str
    directshape_torch: str
    compiler: str | None
    gpu: str | None
    load: float | None

    @property
    def is_busy(self) -> bool:
        """Whether more wants to run than our own threads, of which there are as many as cores at most."""
        return self.load is not None and self.load >= self.cores + 0.5

    def __str__(self) -> str:
        load = "" if self.load is None else f", load {self.load:g}"
        versions = [f"Python {self.python}", f"PyTorch {self.torch}", self.compiler or "no C++ compiler"]
        return (
            f"{self.processor}, {self.cores} cores, {self.threads} threads of PyTorch{load}\n"
            f"{', '.join([*versions, self.gpu or 'no graphics card'])}"
        )


def describe_machine() -> Machine:
    """The machine of this process, now."""
    gpu = f"{torch.cuda.get_device_name(0)}, CUDA {torch.version.cuda}" if torch.cuda.is_available() else None
    return Machine(
        processor=_processor(),
        cores=len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        threads=torch.get_num_threads(),
        system=f"{platform.system()} {platform.release()} {platform.machine()}",
        python=platform.python_version(),
        torch=torch.__version__,
        directshape_torch=package_version(),
        compiler=_compiler(),
        gpu=gpu,
        load=round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
    )


def _compiler() -> str | None:
    """Version line of the C++ compiler that `torch.compile` would call, or None."""
    for name in (os.environ.get("CXX"), "g++", "clang++", "c++"):
        path = shutil.which(name) if name else None
        if path is not None:
            answer = subprocess.run([path, "--version"], capture_output=True, text=True, check=False)
            return answer.stdout.partition("\n")[0] or path
    return None


def _processor() -> str:
    """Linux hides the model's name from `platform`."""
    listing = Path("/proc/cpuinfo")
    lines = listing.read_text(encoding="utf-8").splitlines() if listing.is_file() else []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or "unknown")
