"""Fixtures that load a made config from text."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from made_configs import Failure, Fit

from residnet.core.config import load_config
from residnet.core.errors import ConfigError


@pytest.fixture
def load(tmp_path: Path) -> Callable[..., Fit]:
    """Loads a `Fit` from YAML text below `task: fit` (which is line 1)."""

    def _load(text: str = "", *overrides: str) -> Fit:
        path = tmp_path / "run.yaml"
        path.write_text("task: fit\n" + text, encoding="utf-8")
        return load_config(path, overrides, Fit)

    return _load


@pytest.fixture
def failure(load: Callable[..., Fit], tmp_path: Path) -> Failure:
    """Message of the error that a config gives, without the folder."""

    def _failure(text: str = "", *overrides: str) -> str:
        with pytest.raises(ConfigError) as caught:
            load(text, *overrides)
        message = str(caught.value)
        assert "\n" not in message
        assert caught.value.exit_code == 2
        return message.replace(f"{tmp_path}{os.sep}", "")

    return _failure
