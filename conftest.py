"""What tests and doctests share: a folder of their own for compiled code, and what is left out."""

import atexit
import os
import shutil
import tempfile
from importlib.util import find_spec

# Doctests of modules that need a library that only the benchmark's `peers` suite asks for.
collect_ignore = [
    f"directshape_torch/benchmark/peers_{library}.py" for library in ("pypose", "theseus") if find_spec(library) is None
]

# Before anything is compiled: tests must neither find nor leave anything in the user's cache. Processes that a session
# starts share the folder.
if "directshape_tests_" not in os.environ.get("TORCHINDUCTOR_CACHE_DIR", ""):
    os.environ["TORCHINDUCTOR_CACHE_DIR"] = tempfile.mkdtemp(prefix="directshape_tests_")
    atexit.register(shutil.rmtree, os.environ["TORCHINDUCTOR_CACHE_DIR"], ignore_errors=True)
