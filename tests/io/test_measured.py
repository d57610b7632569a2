"""The data layer on measured logs: skipped where RESIDNET_DATA does not name a folder that holds
them.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from residnet_tasks.import_logs import ImportConfig

from residnet.core.config import load_config, validate_config
from residnet.core.errors import DataError
from residnet.core.files import find_config_folder
from residnet.core.log import Log
from residnet.io.readers import ReaderConfig
from residnet.io.split import SplitConfig, check_leaks
from residnet.preprocessing.align import GridConfig, align_to_grid
from residnet.quality import inspect_log

DATA = Path(os.environ.get("RESIDNET_DATA", "nowhere"))
MOTION = {"x": "m", "y": "m", "psi": "rad", "u": "m/s", "v": "m/s", "r": "rad/s"}
UNITS = {**MOTION, "n": "1/s", "delta": "rad", "wind_speed": "m/s", "wind_dir": "rad"}
ESSO = {
    **{"x": "x_position_mid [m]", "y": "y_position_mid [m]", "psi": "psi_hat [rad]"},
    **{"u": "u_velo [m/s]", "v": "vm_velo [m/s]", "r": "r_angvelo [rad/s]"},
    **{"n": "n_prop [rps]", "delta": "delta_rudder [rad]"},
    **{"wind_speed": "wind_velo_true [m/s]", "wind_dir": "wind_dir_true [rad]"},
}


def needs(folder: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(not (DATA / folder).is_dir(), reason=f"no {folder} in {DATA}")


def read(path: Path, columns: dict[str, str], time: str) -> Log:
    channels = {name: {"column": one, "unit": UNITS[name]} for name, one in columns.items()}
    config = {"kind": "csv", "time": {"column": time}, "channels": channels, "manoeuvre": "folder"}
    return validate_config(config, ReaderConfig, "test").build().read(path)


@pytest.fixture(scope="module")
def logs() -> dict[str, list[Log]]:
    if not (DATA / "esso_osaka").is_dir():
        pytest.skip(f"no esso_osaka in {DATA}")
    file = {"file": str(DATA / "esso_osaka" / "split.yaml")}
    files = validate_config(file, SplitConfig, "test").resolve_paths()
    return {split: [read(path, ESSO, "t [s]") for path in paths] for split, paths in files.items()}


def test_logs_are_on_the_grid_and_stay_as_published(logs: dict[str, list[Log]]) -> None:
    assert [len(logs[split]) for split in ("train", "validation", "test")] == [21, 5, 6]
    for log in logs["test"]:
        table = pd.read_csv(log.meta["source"])
        out = align_to_grid(log, GridConfig(step=0.1, held=("n", "delta")))
        np.testing.assert_array_equal(out.t, table["t [s]"])
        for name in ("x", "u", "n", "delta"):
            np.testing.assert_array_equal(out[name], table[ESSO[name]])
        np.testing.assert_allclose(np.cos(out["psi"]), np.cos(table["psi_hat [rad]"]), atol=1e-12)
        assert np.abs(np.diff(out["psi"])).max() < 0.2
    assert {log.manoeuvre for log in logs["test"]} == {"random", "turning", "zigzag", "berthing"}


def test_the_copied_file_is_caught_and_the_published_split_passes(
    logs: dict[str, list[Log]],
) -> None:
    check_leaks(logs)
    copy = DATA / "esso_osaka" / "turning" / "turn_cut_14-Sep-2020_15_58_08.csv"
    with pytest.raises(DataError, match="share 2869 identical rows"):
        check_leaks({**logs, "test": [*logs["test"], read(copy, ESSO, "t [s]")]})


def identify_velocity_delay(log: Log) -> tuple[float, float]:
    """Identify the filter from increments of the position to the velocities in earth axes.

    Returns:
        Delay of slow motions in s, and the share of the velocities that no filter explains.
    """
    is_measured = np.isfinite(log.stack([*MOTION])).all(axis=1)
    x, y, psi, u, v = (
        np.interp(log.t, log.t[is_measured], log[name][is_measured])
        for name in ("x", "y", "psi", "u", "v")
    )
    step = float(np.median(np.diff(log.t)))
    velocity = (np.exp(1j * psi) * (u + 1j * v))[100:-100]
    increments = np.diff(x + 1j * y, prepend=x[0] + 1j * y[0]) / step
    lags = np.arange(-20, 80)
    columns = np.stack([np.roll(increments, lag)[100:-100] for lag in lags], axis=1)
    columns = np.concatenate((columns.real, columns.imag))
    response = np.concatenate((velocity.real, velocity.imag))
    # impulse responses of filters are smooth
    roughness = 0.02 * np.sqrt(response.size) * np.diff(np.eye(lags.size), 2, axis=0)
    impulse_response = np.linalg.lstsq(
        np.concatenate((columns, roughness)), np.append(response, np.zeros(lags.size - 2))
    )[0]
    residual = response - columns @ impulse_response
    # an increment is the velocity half a sample before its end
    delay = (lags + 0.5) @ impulse_response / impulse_response.sum() * step
    return float(delay), float(residual.std() / response.std())


@pytest.mark.long
def test_the_doctor_finds_the_known_illnesses(logs: dict[str, list[Log]]) -> None:
    # u, v were published as filtered differences of the positions: to .1 % one linear filter
    # explains them, whose delay is that of all motions slower than its time constant of 1 s
    filters = [identify_velocity_delay(log) for log in logs["train"]]
    assert max(unexplained for _, unexplained in filters) < 1e-3
    delays = [delay for delay, _ in filters]
    assert np.ptp(delays) < 0.05
    lags = []
    gyro = {}
    freezes = []
    for log in [log for part in logs.values() for log in part]:
        report = inspect_log(log)
        assert not any(finding.level == "fatal" for finding in report.findings), report.to_lines()
        (frames,) = report.find_by_code("frames")
        assert (frames.level, frames.figures["coherence"] > 0.97) == ("note", True)
        trailing = [
            finding
            for code in ("lag", "lag_xy")
            for finding in report.find_by_code(code)
            if finding.text.startswith(("u", "v", "x"))
        ]
        assert trailing or log.manoeuvre == "berthing"
        lags += [abs(finding.figures["value_1"]) for finding in trailing]
        gyro[log.name] = np.degrees(report.find_by_code("yaw_drift")[0].figures["end"])
        frozen = [one for one in report.find_by_code("frozen") if one.text.startswith("position")]
        freezes += [finding.figures["share"] for finding in frozen]
    assert np.median(lags) == pytest.approx(np.median(delays), abs=0.02)
    assert gyro.pop("random_31-Jul-2020_12_48_39") == pytest.approx(29.3, abs=0.2)
    assert max(abs(drift) for drift in gyro.values()) < 13.0
    assert len(freezes) == 30
    assert max(freezes) < 0.06


@pytest.mark.long
@needs("kvlcc2")
def test_tank_data_are_consistent_and_their_mistakes_would_be_seen() -> None:
    columns = {**dict(zip(MOTION, MOTION, strict=True)), "delta": "delta", "n": "rev"}
    for path in sorted((DATA / "kvlcc2").glob("*.csv")):
        raw = read(path, columns, "t")
        loud = {finding.code for finding in inspect_log(raw).findings if finding.level != "note"}
        # published with the trailing edge to port positive
        assert "rudder_sign" in loud
        log = raw.replace(channels={**raw.channels, "delta": -raw["delta"]})
        report = inspect_log(log)
        said = [finding.code for finding in report.findings if finding.level != "note"]
        assert "rudder_sign" not in said, report.to_lines()
        assert report.find_by_code("frames")[0].figures["coherence"] > 0.9999
        assert not report.find_by_code("yaw_rate")
        assert all(finding.figures["size"] < 0.1 for finding in report.find_by_code("lag"))
        exchanged = log.replace(channels={**log.channels, "x": log["y"], "y": log["x"]})
        assert inspect_log(exchanged).has_problems


@needs("milliampere/raw_nlp1")
def test_the_ferrys_raw_topics_become_the_table_made_by_hand() -> None:
    file = find_config_folder().parent / "examples/residnet_tasks/configs/milliampere_raw.yaml"
    task: ImportConfig = load_config(file, [], ImportConfig)
    log = task.reader.build().read(DATA / "milliampere" / "raw_nlp1")
    table = pd.read_csv(DATA / "milliampere" / "nlp1.csv")
    assert np.ptp(np.diff(log.t)) < 1e-9
    assert log.t[1] == pytest.approx(0.1)
    by_hand = np.rint(10.0 * table["gps_utc_s_of_day"].to_numpy()).astype(int)
    ours = np.rint((log.meta["epoch"] % 86400.0 + log.t) * 10.0).astype(int)
    rows = np.searchsorted(ours, by_hand)
    assert (ours[rows] == by_hand).all()
    most = {"u": 0.02, "v": 0.02, "r": 0.02, "psi": np.radians(0.5), "x": 0.035, "y": 0.035}
    for name, limit in most.items():
        apart = log[name][rows] - table[{"x": "north", "y": "east"}.get(name, name)].to_numpy()
        assert np.sqrt(np.mean(apart**2)) < limit, name
    # what was mended on the way is said
    said = {finding["code"]: finding for finding in log.meta["findings"]}
    assert {*said} >= {
        *("unpadded_fraction", "time_zone", "latency", "empty_topic", "empty_columns"),
        *("not_numbers", "several_publishers", "quaternion_flips"),
    }
    assert said["time_zone"]["figures"]["offset"] == 7200.0
    assert "control_action" in said["several_publishers"]["text"]
