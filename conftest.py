"""What tests and doctests share: a folder of their own for compiled code."""

import atexit
import os
import shutil
import tempfile

# Before anything is compiled: tests must neither find nor leave anything in the user's cache. Processes that a session
# starts share the folder.
if "directshape_tests_" not in os.environ.get("TORCHINDUCTOR_CACHE_DIR", ""):
    os.environ["TORCHINDUCTOR_CACHE_DIR"] = tempfile.mkdtemp(prefix="directshape_tests_")
    atexit.register(shutil.rmtree, os.environ["TORCHINDUCTOR_CACHE_DIR"], ignore_errors=True)
