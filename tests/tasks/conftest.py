"""A run that takes seconds, made once for all tests of the tasks."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from tiny import TINY, call


@pytest.fixture(scope="session")
def tiny_config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The configuration as a file."""
    path = tmp_path_factory.mktemp("config") / "tiny.yaml"
    path.write_text(yaml.safe_dump(TINY, sort_keys=False))
    return path


@pytest.fixture(scope="session")
def tiny_run(tiny_config: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run."""
    out = tmp_path_factory.mktemp("runs") / "tiny"
    with pytest.MonkeyPatch.context() as patch:
        assert call(patch, "run", tiny_config, "--out", out) == 0
    return out


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give all tests of the one finished run to one process, which then makes it once."""
    for item in items:
        if "tiny_run" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.xdist_group("tiny_run"))
