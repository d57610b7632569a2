"""A run that takes seconds, made once for all tests of the tasks."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import yaml
from made_once import made_once
from tiny import TINY, call

from residnet.export import vessel


@pytest.fixture(scope="session")
def tiny_config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The configuration as a file."""
    path = tmp_path_factory.mktemp("config") / "tiny.yaml"
    path.write_text(yaml.safe_dump(TINY, sort_keys=False))
    return path


@pytest.fixture(scope="session")
def tiny_run(tiny_config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, a copy for each process."""

    def make(folder: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(vessel, "PARITY_STEPS", 60)
            assert call(patch, "run", tiny_config, "--out", folder) == 0

    out = tmp_path_factory.mktemp("runs") / "tiny"
    shutil.copytree(made_once(tmp_path_factory, "tiny", make), out)
    return out
