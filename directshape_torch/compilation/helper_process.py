"""The process that `helpers` starts: compiles the function that its parent asks for on standard input."""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading

from directshape_torch.compilation.request import CompileRequest


def main() -> None:
    """Compile what was asked for into the store."""
    # From the parent process alone: no file of anybody's is unpickled.
    request: CompileRequest = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    request.compile_elsewhere()


def _end_with_parent() -> None:
    """When the parent's end of the pipe is closed, however the parent ended; with a C++ compiler that runs."""
    # Not by `sys.stdin`, whose lock this thread would still hold when the process ends by itself.
    while os.read(0, 4096):
        pass
    if hasattr(os, "killpg"):
        os.killpg(0, signal.SIGKILL)
    os._exit(1)


if __name__ == "__main__":
    main()
