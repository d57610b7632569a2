"""The same files give the same channel map through every door of residnet."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any

import foreign_tables
import numpy as np
import pandas as pd
import pytest
import yaml
from foreign_tables import Style

import residnet
from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.tasks.inspection import inspect_logs

DEGREES = {"psi": "deg", "r": "deg/s", "delta": "deg", "n": "rpm"}
GERMAN = {"psi": "°", "u": "kn", "v": "kn", "r": "°/min", "delta": "°", "n": "U/min"}
STYLES = {
    "English with units": Style(units=DEGREES, signs=("delta",)),
    "no units": Style(told=False, units=DEGREES),
    "German": Style("German", GERMAN, delimiter=";", decimal=",", dates="%d.%m.%Y %H:%M:%S,%f"),
    "Unix milliseconds": Style(units=DEGREES),
}


@pytest.fixture
def logs(ship_logs: list[Log]) -> list[Log]:
    return ship_logs


@pytest.fixture(params=STYLES)
def files(request: pytest.FixtureRequest, logs: list[Log], tmp_path: Path) -> list[Path]:
    found = foreign_tables.write(logs, tmp_path / "logs", STYLES[request.param])
    if request.param == "Unix milliseconds":
        for file in found:
            table = pd.read_csv(file)
            table["time"] = 1_717_000_000_000 + np.rint(1e3 * table["time"]).astype(int)
            table.to_csv(file, index=False)
    return found


def _told(work: Callable[..., object], files: Sequence[Path]) -> dict[str, Any]:
    """The map that a function of Python reports to whoever listens."""
    lines: list[str] = []
    work(files, lambda told: lines.append(told.message))
    begun = next(i for i, line in enumerate(lines) if "channel map as guessed" in line)
    drafted = takewhile(lambda line: line.startswith("  "), lines[begun + 1 :])
    text = "\n".join(line.removeprefix("  ") for line in drafted)
    return dict(yaml.safe_load(text)["data"]["reader"])


def _doors(files: Sequence[Path]) -> dict[str, dict[str, Any]]:
    shown = inspect_logs(files, None).text.partition("paste into a config:\n")[2]
    return {
        "new": residnet.draft(files).config["data"]["reader"],
        "inspect": yaml.safe_load(shown)["data"]["reader"],
        "read_logs": _told(lambda f, hear: residnet.read_logs(f, progress=hear), files),
        "fit": _told(lambda f, hear: residnet.prepare(f, ["delta", "n"], progress=hear), files),
    }


def test_one_map_from_every_door(files: list[Path], logs: list[Log]) -> None:
    found = _doors(files)
    for door, reader in found.items():
        assert reader == found["new"], door
    for log, truth in zip(residnet.read_logs(files), logs, strict=True):
        for name in ("x", "y", "u", "v", "r", "delta", "n"):
            size = float(np.abs(truth[name]).max()) + 1e-3
            np.testing.assert_allclose(log[name], truth[name], atol=1e-6 * size, err_msg=name)


def test_no_log_is_lost_for_a_roll_that_not_all_of_them_hold(tmp_path: Path) -> None:
    t = np.arange(0.0, 20.0, 0.1)
    for number in range(3):
        table = pd.DataFrame({"t": t, "surge [m/s]": 1.0 + 0.1 * np.sin(t), "rudder [deg]": t % 7})
        table["roll [deg]"] = np.nan if number == 1 else 3.0 * np.sin(t)
        table.to_csv(tmp_path / f"run_{number}.csv", index=False)
    logs = residnet.read_logs(tmp_path)
    assert [sorted(log.channels) for log in logs] == [["delta", "u"]] * 3
    (tmp_path / "stopped.csv").write_text("t,surge [m/s],rudder [deg]\n")
    with pytest.raises(DataError, match="no row of numbers below it"):
        residnet.read_logs(tmp_path / "stopped.csv")
