"""The doctor on logs with one known illness each."""

from __future__ import annotations

import json

import numpy as np
import pytest
from known_logs import wavy

from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.data.doctor import Finding, Report, inspect, inspect_together, inspection, summary
from residnet.data.masks import Frozen


def changed(log: Log, **channels: np.ndarray) -> Log:
    return log.replace(channels={**log.channels, **channels})


def one(report: Report, code: str) -> Finding:
    (finding,) = report.find(code)
    return finding


def test_a_healthy_log_has_nothing_but_information() -> None:
    report = inspect(wavy())
    assert [finding.text for finding in report.findings if finding.level != "note"] == []
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
        assert ("trails" if lag > 0 else "leads") in finding.text
        assert finding.figures["lag"] == pytest.approx(lag, abs=0.05)


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
    assert "v positive to port" in one(inspect(changed(log, v=-log["v"])), "frames").text
    turned = one(inspect(changed(log, r=-log["r"])), "follows_r")
    assert turned.level == "will mislead"
    assert "opposite sign" in turned.text
    degrees = inspect(changed(log, r=np.degrees(log["r"])))
    assert "check its unit (deg taken as rad)" in one(degrees, "follows_r").text
    knots = inspect(changed(log, u=log["u"] / 0.5144, v=log["v"] / 0.5144))
    assert one(knots, "frames").level == "will mislead"
    assert "knots taken as m/s" in one(knots, "frames").text
    assert one(knots, "frames").figures["speed_ratio"] == pytest.approx(1.944, abs=0.01)
    strange = inspect(changed(log, r=np.random.default_rng(0).normal(size=50).repeat(40) * 0.05))
    assert "not describe one motion" in one(strange, "follows_r").text


def test_a_compass_offset_and_a_gyro_bias_are_measured() -> None:
    log = wavy()
    offset = one(inspect(changed(log, psi=log["psi"] + np.radians(8.0))), "frames")
    assert offset.level == "will mislead"
    assert np.degrees(offset.figures["offset"]) == pytest.approx(-8.0, abs=0.1)
    drift = one(inspect(changed(log, r=log["r"] - np.radians(0.1))), "yaw_drift")
    assert drift.level == "will mislead"
    assert np.degrees(drift.figures["bias"]) == pytest.approx(0.1, rel=0.02)
    assert np.degrees(drift.figures["end"]) == pytest.approx(20.0, rel=0.02)
    assert (
        one(inspect(changed(log, r=log["r"] - np.radians(2.0))), "yaw_drift").level
        == "will mislead"
    )


def test_freezes_jumps_and_repeats() -> None:
    log = wavy()
    x, y, u = log["x"].copy(), log["y"].copy(), log["u"].copy()
    x[500:520], y[500:520] = x[500], y[500]
    u[1500:] += 0.5
    x[1200:] += 1.0
    report = inspect(changed(log, x=x, y=y, u=u))
    assert one(report, "frozen").figures["share"] == pytest.approx((20 + 19) / 2000)
    assert one(report, "jump").figures["t"] == pytest.approx(150.0)
    jump = one(report, "position_jump")
    assert (jump.figures["count"], jump.figures["t"]) == (1, pytest.approx(120.0))
    assert jump.figures["largest"] == pytest.approx(1.0, rel=0.01)
    slow = Log(
        "slow", log.t, {name: np.repeat(values[::4], 4) for name, values in log.channels.items()}
    )
    assert one(inspect(slow), "repeated_rows").figures["share"] == pytest.approx(0.75, abs=0.01)


def test_clock_faults() -> None:
    log = wavy()
    keep = np.r_[0:500, 560:2000]
    gap = Log("gap", log.t[keep], {name: values[keep] for name, values in log.channels.items()})
    figures = one(inspect(gap), "gaps").figures
    assert (figures["count"], figures["longest"]) == (1, pytest.approx(6.1))
    shaken = log.replace(t=log.t + np.random.default_rng(0).uniform(-0.03, 0.03, len(log)))
    assert one(inspect(shaken), "clock").level == "will mislead"
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
    r[75::150] += 1.0
    report = inspect(changed(log, u=u, v=v, r=r))
    assert one(report, "nan").figures["share"] == pytest.approx(0.15)
    assert [finding.figures["limit"] for finding in report.find("clipping")] == [-0.3, 0.3]
    assert one(report, "outliers").figures["share"] == pytest.approx(13 / 2000)
    mostly = log["u"].copy()
    mostly[:1200] = np.nan
    assert inspect(changed(log, u=mostly)).misled


def test_excitation() -> None:
    log = wavy()
    n = np.full(len(log), 10.0)
    twin = inspect(changed(log, n=n, delta_stbd=log["delta"].copy()))
    assert "n stays at 10" in one(twin, "constant").text
    assert one(twin, "condition").figures["condition"] > 1e6
    assert "delta" in one(twin, "condition").text.split(";")[1]
    straight = {name: np.zeros(len(log)) for name in ("y", "psi", "v", "r")}
    still = {**straight, "x": 2.0 * log.t, "u": np.full(len(log), 2.0), "delta": log["delta"]}
    assert one(inspect_together([Log("straight", log.t, still)]), "no_excitation").level == "fatal"
    steps = inspect(changed(log, delta=np.sign(log["delta"])))
    assert one(steps, "input_jump").figures["share_of_range"] == pytest.approx(1.0)
    stopped = {name: np.where(log.t < 60.0, 0.0, log[name]) for name in "uv"}
    assert one(inspect(changed(log, **stopped)), "slow").figures["share"] == pytest.approx(0.3)
    resting = one(
        inspect(changed(log, **stopped, r=np.where(log.t < 60.0, 0.0, log["r"]))), "standing"
    )
    assert resting.level == "will mislead"
    assert resting.figures["share"] == pytest.approx(0.3, abs=0.01)


def test_a_log_without_position_says_so() -> None:
    log = wavy()
    report = inspect(Log("short", log.t, {name: log[name] for name in ("u", "v", "r", "delta")}))
    assert "no x, y, psi" in one(report, "frames_unchecked").text
    assert one(report, "absent").level == "note"
    assert not report.misled


@pytest.mark.parametrize("size", [2, 3, 20, 60])
def test_short_logs_are_examined_as_far_as_they_go(size: int) -> None:
    log = wavy()
    report = inspect(
        Log("short", log.t[:size], {name: values[:size] for name, values in log.channels.items()})
    )
    assert f"7 channels, {size} samples" in one(report, "channels").text
    assert one(report, "clock").figures["span"] == pytest.approx(0.1 * (size - 1))
    assert {
        finding.text.split()[0]: finding.figures["max"] for finding in report.find("range")
    } == {name: log[name][:size].max() for name in ("u", "v", "r", "delta")}
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


def test_what_a_reader_noticed_is_told_and_masked_samples_excuse() -> None:
    log = wavy()
    x, y = log["x"].copy(), log["y"].copy()
    x[500:520], y[500:520] = x[500], y[500]
    sick = changed(log, x=x, y=y).replace(
        meta={
            "findings": [
                {"level": "will mislead", "code": "latency", "text": "late", "figures": {"s": 0.9}}
            ]
        }
    )
    plain, masked = inspect(sick), inspect(sick, masks=[Frozen()])
    assert one(plain, "latency").figures == {"s": 0.9}
    assert one(plain, "frozen").level == "will mislead"
    assert one(masked, "frozen").level == "note"
    assert one(masked, "latency").level == "will mislead"
    assert inspect(log, masks=[Frozen()]).findings == inspect(log).findings


def test_steering_that_turns_to_port_or_comes_late_is_seen() -> None:
    t = np.arange(0.0, 300.0, 0.1)
    steer = 0.3 * np.sign(np.sin(0.11 * t) + 0.5 * np.sin(0.31 * t))
    r = np.zeros(t.size)
    for i in range(1, t.size):
        r[i] = r[i - 1] + 0.1 * (0.1 * steer[i - 1] - 0.5 * r[i - 1])
    r += np.random.default_rng(0).normal(0.0, 1e-3, t.size)
    log = Log("yaw", t, {"r": r, "delta": steer})
    (fine,) = inspect(log).find("rudder_sign")
    assert fine.level == "note"
    assert fine.figures["effect"] == pytest.approx(0.1, rel=0.05)
    assert one(inspect(changed(log, delta=-steer)), "rudder_sign").level == "will mislead"
    late = one(inspect(changed(log, delta=np.interp(t - 2.0, t, steer))), "acausal")
    assert late.figures["lag"] == pytest.approx(-2.0, abs=0.2)


def test_lever_arm_and_current_are_measured() -> None:
    log = wavy()
    c, s = np.cos(log["psi"]), np.sin(log["psi"])
    arm = one(
        inspect(changed(log, x=log["x"] - 0.99 * c + 0.4 * s, y=log["y"] - 0.99 * s - 0.4 * c)),
        "lever_arm",
    )
    assert [arm.figures["value_1"], arm.figures["value_2"]] == pytest.approx(
        [-0.99, -0.4], abs=0.01
    )
    current = one(
        inspect(changed(log, x=log["x"] + 0.4 * log.t, y=log["y"] - 0.1 * log.t)), "current"
    )
    assert [current.figures["value_1"], current.figures["value_2"]] == pytest.approx(
        [0.4, -0.1], abs=0.01
    )


def test_relative_wind_is_told_from_true_wind() -> None:
    log = wavy()
    gusts = 0.3 * np.sin(0.17 * log.t) + 0.2 * np.sin(0.71 * log.t)
    for relative in (False, True):
        direction = 1.0 + gusts - (log["psi"] if relative else 0.0)
        report = inspect(changed(log, wind_dir=direction), inputs=["delta", "wind_dir"])
        assert bool(report.find("relative_wind")) == relative


def test_logs_beside_each_other() -> None:
    log = wavy()
    noise = np.random.default_rng(1)
    noisy = {
        name: values + 1e-3 * noise.standard_normal(len(log))
        for name, values in log.channels.items()
    }
    whole = Log("whole", log.t, noisy)
    part = Log("part", log.t[:500], {name: values[700:1200] for name, values in noisy.items()})
    first = Log("first", log.t[:900] + 50.0, {name: values[:900] for name, values in noisy.items()})
    second = Log(
        "second", log.t[900:] + 50.0, {name: values[900:] for name, values in noisy.items()}
    )
    copied = one(inspect_together([whole, part]), "copied_part")
    assert "part is in 100 % a copy of rows 700 to 1199 of whole" in copied.text
    assert copied.level == "will mislead"
    assert (
        one(
            inspect_together([whole, part], splits={"whole": "train", "part": "test"}),
            "copied_part",
        ).level
        == "fatal"
    )
    assert (
        one(inspect_together([whole, whole.replace(name="again")]), "duplicate_log").figures["rows"]
        == 2000.0
    )
    assert (
        "second goes on where first ends"
        in one(inspect_together([second, first]), "continued").text
    )
    torn = inspect_together([first, second], splits={"first": "train", "second": "test"})
    assert "they stand in train and test" in one(torn, "continued").text
    other = Log(
        "other",
        log.t,
        {
            name: values + 1e-3 * noise.standard_normal(len(log))
            for name, values in log.channels.items()
            if name != "delta"
        },
    )
    same = other.replace(channels={**other.channels, "delta": noisy["delta"]})
    assert one(inspect_together([whole, same]), "same_commands").level == "note"
    fast = same.replace(name="fast", channels={**same.channels, "u": same["u"] + 0.6})
    outside = one(
        inspect_together([whole, fast], splits={"whole": "train", "fast": "test"}), "extrapolation"
    )
    assert outside.level == "will mislead"
    assert outside.figures["share"] > 0.5


def test_the_report_as_json_has_every_finding() -> None:
    log = wavy()
    reports = [inspect(log), inspect(changed(log, psi=-log["psi"]))]
    content = json.loads(json.dumps(inspection(reports, inspect_together([log]))))
    assert content["schema"] == "residnet.inspection/1"
    assert [entry["misled"] for entry in content["logs"]] == [False, True]
    assert content["misled"]
    for entry, report in zip(content["logs"], reports, strict=True):
        assert [finding["text"] for finding in entry["findings"]] == [
            finding.text for finding in report.findings
        ]
        assert {finding["level"] for finding in entry["findings"]} <= {
            "note",
            "will mislead",
            "fatal",
        }


def test_the_tally_counts_logs_and_names_what_to_fix_first() -> None:
    log = wavy()
    sick = changed(log, psi=-log["psi"]).replace(name="sick")
    clean, ill = (
        inspection([inspect(one) for one in logs], Report("together", ()))
        for logs in ([log], [log, sick])
    )
    assert summary(clean).misled == 0
    assert summary(clean).lines == ["Data doctor: nothing in the log would mislead a fit."]
    counted = summary(ill)
    assert (counted.logs, counted.misled) == (2, 1)
    assert counted.tally.startswith("Data doctor: 1 of 2 logs hold something")
    assert counted.first.startswith("First fix this: sick: ")
    assert [ill["tally"], ill["first"]] == counted.lines


def test_a_jump_behind_a_gap_is_told_at_its_samples() -> None:
    log = wavy()
    x = log["x"].copy()
    x[1200:] += 1.0
    keep = np.r_[0:500, 560:2000]
    sick = changed(log, x=x)
    gap = Log("gap", sick.t[keep], {name: values[keep] for name, values in sick.channels.items()})
    finding = one(inspect(gap), "position_jump")
    assert finding.at is not None
    assert finding.at.shape == gap.t.shape
