"""`python -m directshape_torch`: the program `directshape`."""

from __future__ import annotations

from directshape_torch.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
