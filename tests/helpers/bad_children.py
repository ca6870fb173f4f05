"""This module has children of the fuzzing script that never answer; it imports nothing that takes long."""

from __future__ import annotations

import os
import time
from multiprocessing.connection import Connection


def hangs(_: str, pipe: Connection) -> None:
    pipe.send("ready")
    pipe.recv()
    time.sleep(60)


def crashes(_: str, pipe: Connection) -> None:
    pipe.send("ready")
    pipe.recv()
    os._exit(9)
