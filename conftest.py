"""Modules of the package whose doctests need a library that only the benchmark's `peers` suite asks for."""

from importlib.util import find_spec

collect_ignore = [
    f"directshape_torch/benchmark/peers_{library}.py" for library in ("pypose", "theseus") if find_spec(library) is None
]
