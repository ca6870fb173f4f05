"""The process that `helpers` starts: compiles the function that its parent asks for on standard input."""

from __future__ import annotations

import pickle
import sys

from directshape_torch.compilation.request import CompileRequest


def main() -> None:
    """Compile what was asked for into the store."""
    # From the parent process alone: no file of anybody's is unpickled.
    request: CompileRequest = pickle.load(sys.stdin.buffer)
    request.compile_elsewhere()


if __name__ == "__main__":
    main()
