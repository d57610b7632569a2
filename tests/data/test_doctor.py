"""The doctor on logs with one known illness each."""

from __future__ import annotations

import numpy as np
import pytest
from known_logs import wavy

from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.data.doctor import Finding, Report, inspect


def changed(log: Log, **channels: np.ndarray) -> Log:
    return log.replace(channels={**log.channels, **channels})


def one(report: Report, code: str) -> Finding:
    (finding,) = report.find(code)
    return finding


def test_a_healthy_log_has_nothing_but_information() -> None:
    report = inspect(wavy())
    assert [finding.text for finding in report.findings if finding.level != "info"] == []
    assert not report.misled
    assert one(report, "clock").figures["rate"] == pytest.approx(10.0)
    assert one(report, "frames").figures["coherence"] == pytest.approx(1.0, abs=1e-3)
    for name in "uvr":
        figures = one(report, f"follows_{name}").figures
        assert figures["correlation"] > 0.999
        assert figures["gain"] == pytest.approx(1.0, abs=0.01)
        assert figures["lag"] == pytest.approx(0.0, abs=0.02)
    assert abs(one(report, "yaw_drift").figures["end"]) < 1e-3
    assert all("\n" not in line and line.startswith("wavy: ") for line in report.lines())


@pytest.mark.parametrize("lag", [-0.5, 0.63, 1.2])
def test_lags_are_measured_in_seconds(lag: float) -> None:
    report = inspect(wavy(lag=lag))
    for name in "uvr":
        finding = one(report, f"follows_{name}")
        assert finding.level == "warning"
        assert ("trails" if lag > 0 else "leads") in finding.text
        assert finding.figures["lag"] == pytest.approx(lag, abs=0.05)
    assert not report.misled


def test_wrong_conventions_are_named() -> None:
    log = wavy()
    cases = {
        "frame: enu": changed(log, psi=np.pi / 2 - log["psi"]),
        "psi counted counter-clockwise (sign: -1)": changed(log, psi=-log["psi"]),
        "x and y exchanged": changed(log, x=log["y"], y=log["x"]),
        "y positive to the west": changed(log, y=-log["y"]),
        "u positive astern": changed(log, u=-log["u"]),
        "sign turned": changed(log, u=-log["u"], v=-log["v"]),
        "+70.0 deg added to psi": changed(log, psi=log["psi"] - np.radians(70.0)),
    }
    for words, sick in cases.items():
        report = inspect(sick)
        assert report.misled
        assert words in one(report, "frames").text
        assert one(report, "frames").figures["best_coherence"] == pytest.approx(1.0, abs=1e-3)


def test_one_channel_of_the_wrong_sign_or_unit_is_named() -> None:
    log = wavy()
    for name, sick in {"v": changed(log, v=-log["v"]), "r": changed(log, r=-log["r"])}.items():
        assert one(inspect(sick), f"follows_{name}").level == "error"
        assert "opposite sign" in one(inspect(sick), f"follows_{name}").text
    degrees = inspect(changed(log, r=np.degrees(log["r"])))
    assert "check its unit" in one(degrees, "follows_r").text
    knots = inspect(changed(log, u=log["u"] / 0.5144, v=log["v"] / 0.5144))
    assert one(knots, "frames").level == "error"
    assert one(knots, "frames").figures["speed_ratio"] == pytest.approx(1.944, abs=0.01)
    strange = inspect(changed(log, r=np.random.default_rng(0).normal(size=50).repeat(40) * 0.05))
    assert "not describe one motion" in one(strange, "follows_r").text


def test_a_compass_offset_and_a_gyro_bias_are_measured() -> None:
    log = wavy()
    offset = one(inspect(changed(log, psi=log["psi"] + np.radians(8.0))), "frames")
    assert offset.level == "warning"
    assert np.degrees(offset.figures["offset"]) == pytest.approx(-8.0, abs=0.1)
    drift = one(inspect(changed(log, r=log["r"] - np.radians(0.1))), "yaw_drift")
    assert drift.level == "warning"
    assert np.degrees(drift.figures["bias"]) == pytest.approx(0.1, rel=0.02)
    assert np.degrees(drift.figures["end"]) == pytest.approx(20.0, rel=0.02)
    assert one(inspect(changed(log, r=log["r"] - np.radians(2.0))), "yaw_drift").level == "error"


def test_freezes_jumps_and_repeats() -> None:
    log = wavy()
    x, y, u = log["x"].copy(), log["y"].copy(), log["u"].copy()
    x[500:520], y[500:520] = x[500], y[500]
    u[1500:] += 0.5
    report = inspect(changed(log, x=x, y=y, u=u))
    assert one(report, "frozen").figures["share"] == pytest.approx((20 + 19) / 2000)
    assert one(report, "jump").figures["t"] == pytest.approx(150.0)
    jump = one(report, "position_jump")
    assert jump.figures["t"] == pytest.approx(52.0)
    assert jump.figures["largest"] == pytest.approx(np.hypot(*(log[c][520] - log[c][500] for c in "xy")), rel=0.1)
    slow = Log("slow", log.t, {name: np.repeat(values[::4], 4) for name, values in log.channels.items()})
    assert one(inspect(slow), "repeated_rows").figures["share"] == pytest.approx(0.75, abs=0.01)


def test_clock_faults() -> None:
    log = wavy()
    keep = np.r_[0:500, 560:2000]
    gap = Log("gap", log.t[keep], {name: values[keep] for name, values in log.channels.items()})
    figures = one(inspect(gap), "gaps").figures
    assert (figures["count"], figures["longest"]) == (1, pytest.approx(6.1))
    shaken = log.replace(t=log.t + np.random.default_rng(0).uniform(-0.03, 0.03, len(log)))
    assert one(inspect(shaken), "clock").level == "warning"
    jumped = log.t.copy()
    jumped[1000:] += 1.7e9
    report = inspect(log.replace(t=jumped))
    assert report.misled
    assert "check the unit of time" in one(report, "clock_span").text


def test_missing_outlying_and_clipped_values() -> None:
    log = wavy()
    u, v, r = log["u"].copy(), log["v"].copy(), log["r"].copy()
    u[:300] = np.nan
    v = np.clip(v, -0.3, 0.3)
    r[::150] += 1.0
    report = inspect(changed(log, u=u, v=v, r=r))
    assert one(report, "nan").figures["share"] == pytest.approx(0.15)
    assert "v is exactly at its limits -0.3 m/s or 0.3 m/s" in one(report, "clipping").text
    assert one(report, "outliers").figures["share"] == pytest.approx(14 / 2000)
    mostly = log["u"].copy()
    mostly[:1200] = np.nan
    assert inspect(changed(log, u=mostly)).misled


def test_excitation() -> None:
    log = wavy()
    n = np.full(len(log), 10.0)
    twin = inspect(changed(log, n=n, delta_stbd=log["delta"].copy()))
    assert "n stays at 10" in one(twin, "constant").text
    assert one(twin, "condition").level == "error"
    assert "delta" in one(twin, "condition").text.split(";")[1]
    straight = {name: np.zeros(len(log)) for name in ("y", "psi", "v", "r")}
    still = inspect(Log("straight", log.t, {**straight, "x": 2.0 * log.t, "u": np.full(len(log), 2.0), "delta": log["delta"]}))
    assert one(still, "no_motion").level == "error"
    steps = inspect(changed(log, delta=np.sign(log["delta"])))
    assert one(steps, "input_jump").figures["share_of_range"] == pytest.approx(1.0)
    stopped = {name: np.where(log.t < 60.0, 0.0, log[name]) for name in "uv"}
    assert one(inspect(changed(log, **stopped)), "standing").figures["share"] == pytest.approx(0.3)


def test_a_log_without_position_says_so() -> None:
    log = wavy()
    report = inspect(Log("short", log.t, {name: log[name] for name in ("u", "v", "r", "delta")}))
    assert "no x, y, psi" in one(report, "frames_unchecked").text
    assert one(report, "absent").level == "warning"
    assert not report.misled


@pytest.mark.parametrize("size", [2, 3, 20, 60])
def test_short_logs_are_examined_as_far_as_they_go(size: int) -> None:
    log = wavy()
    report = inspect(Log("short", log.t[:size], {name: values[:size] for name, values in log.channels.items()}))
    assert f"7 channels, {size} samples" in one(report, "channels").text
    assert one(report, "clock").figures["span"] == pytest.approx(0.1 * (size - 1))
    assert {finding.text.split()[0]: finding.figures["max"] for finding in report.find("range")} == {
        name: log[name][:size].max() for name in ("u", "v", "r", "delta")
    }
    # frames need 50 samples, and each extreme that is reached once is no clipping
    assert bool(report.find("frames")) == (size >= 50)
    assert bool(report.find("frames_unchecked")) == (size < 50)
    assert report.find("clipping") == ()
    assert not report.misled


def test_faults() -> None:
    with pytest.raises(DataError, match="at least 2"):
        inspect(Log("a", np.zeros(1), {"u": np.ones(1)}))
    with pytest.raises(DataError, match="channel u holds no number"):
        inspect(Log("a", np.arange(2.0), {"u": np.full(2, np.nan)}))
    with pytest.raises(UsageError, match="no channel 'rudder'"):
        inspect(wavy(), inputs=["rudder"])
