"""Every shipped config has a row of overrides for continuous integration, and the row is valid."""

from __future__ import annotations

from pathlib import Path

import pytest
import short_configs

from residnet.core.files import find_config_folder
from residnet.tasks.registry import load_task

CONFIGS = sorted(
    path.relative_to(find_config_folder()).with_suffix("").as_posix()
    for path in find_config_folder().rglob("*.yaml")
    if path.parent.name != "vessels"
)


def test_every_config_has_a_row_and_every_row_a_config() -> None:
    assert short_configs.list_shipped_configs() == CONFIGS
    assert {*short_configs.SPECIFIC_OVERRIDES, *short_configs.AFTER} <= set(CONFIGS)


@pytest.mark.parametrize("name", CONFIGS)
def test_the_overrides_of_a_row_are_valid(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RESIDNET_DATA", str(tmp_path))
    row = short_configs.shorten_config(name)
    if row.after:
        (tmp_path / row.after).mkdir()
    given = [override.replace("{runs}", str(tmp_path)) for override in row.overrides]
    assert load_task(find_config_folder() / f"{name}.yaml", given).name


def test_what_cannot_run_is_skipped_and_what_fails_has_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RESIDNET_DATA", str(tmp_path))
    result = short_configs.run_config("kvlcc2", tmp_path)
    assert (result.state, result.reason) == ("skipped", "no RESIDNET_DATA/kvlcc2")
    wrong = short_configs.ShortConfig(("trials=3",))
    monkeypatch.setattr(short_configs, "shorten_config", lambda _: wrong)
    result = short_configs.run_config("wam_v_trials", tmp_path)
    assert result.state == "FAILED"
    assert "unknown key" in result.reason
