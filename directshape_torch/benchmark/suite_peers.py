"""Suite `peers`: the same problem written for other libraries, each optional, at equal final cost."""

from __future__ import annotations

import importlib

from directshape_torch.benchmark.rows import Row, SuiteResult
from directshape_torch.benchmark.settings import SuiteSettings

_SUITE = "peers"


def run_peers_suite(settings: SuiteSettings) -> SuiteResult:
    """The rows that `peers.run_peers` finds."""
    peers = importlib.import_module("directshape_torch.benchmark.peers")
    rows: tuple[Row, ...] = tuple(peers.run_peers(settings))
    return SuiteResult(_SUITE, rows)
