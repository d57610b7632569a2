"""Discovery of the golden runs: a test that takes `golden_file` runs once for every file of its
module's GROUP.

`RESIDNET_GOLDEN` names the folder; a module sets `GROUP = "g4_wamv"` and reads its set-up from the
file's name, so that further files need no new code.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

NAMES = "*.csv.gz"


def golden_files(group: str) -> list[Path]:
    """Files of one group; empty where RESIDNET_GOLDEN is not set or has no such group."""
    folder = os.environ.get("RESIDNET_GOLDEN")
    return sorted((Path(folder) / group).glob(NAMES)) if folder else []


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """One run of the test per file, named by it."""
    if "golden_file" not in metafunc.fixturenames:
        return
    group = metafunc.module.GROUP
    # a test may be meant for some of the files only
    wanted = getattr(metafunc.function, "only", lambda path: True)
    files = [path for path in golden_files(group) if wanted(path)]
    reason = f"no golden files: set RESIDNET_GOLDEN to the folder that holds {group}/{NAMES}"
    values: list[Any] = [*files] or [pytest.param(None, marks=pytest.mark.skip(reason=reason))]
    metafunc.parametrize(
        "golden_file",
        values,
        ids=[path.name.removesuffix(".csv.gz") for path in files] or ["none"],
        scope="module",
    )
