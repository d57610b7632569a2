"""The doctor on logs whose truth is known in closed form, and what it says of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from known_logs import wavy
from planted import FAULTS
from simulated_motion import BOATS, simulate_motion

from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.preprocessing.channel_values import (
    bridge_spikes,
    find_spikes,
    is_fill_value,
    is_implausible,
)
from residnet.preprocessing.masks import FrozenMask
from residnet.quality import (
    CHECKS,
    STAGE_DESCRIPTIONS,
    Finding,
    InspectionReport,
    build_inspection,
    inspect_log,
    inspect_log_set,
    kinematics,
    summarize_inspection,
)
from residnet.quality.between import with_derived_velocities
from residnet.quality.findings import run_checks
from residnet.quality.kinematics import estimate_position_causes, estimate_yaw_causes
from residnet.quality.records import InspectionFile
from residnet.quality.statistics import LogStatistics

LOG = wavy()
PSI, T = LOG["psi"], LOG.t
RANDOM = np.random.default_rng(0)


def changed(log: Log = LOG, /, **channels: np.ndarray) -> Log:
    return log.replace(channels={**log.channels, **channels})


def rows(log: Log, part: slice | np.ndarray, name: str = "part", start: float = 0.0) -> Log:
    channels = {key: values[part] for key, values in log.channels.items()}
    return Log(name, log.t[part] + start, channels)


def one(report: InspectionReport, code: str) -> Finding:
    (finding,) = report.find_by_code(code)
    return finding


def stepped(values: np.ndarray, at: int, by: float) -> np.ndarray:
    return values + by * (np.arange(values.size) >= at)


def held(*names: str) -> dict[str, np.ndarray]:
    at = np.arange(len(LOG))
    return {n: np.where((at > 500) & (at < 520), LOG[n][500], LOG[n]) for n in names}


def test_inspect_log_of_a_valid_log_gives_notes_only() -> None:
    report = inspect_log(LOG)
    assert [finding.text for finding in report.findings if finding.level != "note"] == []
    assert one(report, "clock").figures["rate"] == pytest.approx(10.0)
    assert one(report, "frames").figures["coherence"] == pytest.approx(1.0, abs=1e-3)
    assert {finding.code for finding in report.findings}.isdisjoint({"gain", "lag", "yaw_rate"})
    assert abs(one(report, "yaw_drift").figures["end"]) < 1e-3
    assert all("\n" not in line and line.startswith("wavy: ") for line in report.to_lines())


ARM = -0.99 * np.exp(1j * PSI) - 0.4j * np.exp(1j * PSI)
KNOTS = changed(u=LOG["u"] / 0.5144, v=LOG["v"] / 0.5144)
SHAKEN = LOG.replace(t=T + RANDOM.uniform(-0.03, 0.03, len(LOG)))
SLOW = rows(LOG, slice(None, None, 10))
SHAKEN_SLOW = SLOW.replace(t=SLOW.t + RANDOM.uniform(-0.45, 0.45, len(SLOW)))
GAP = rows(LOG, np.r_[0:500, 560:2000])
TWIN = changed(n=np.full(len(LOG), 10.0), delta_stbd=LOG["delta"].copy())
STOPPED = {name: np.where(T < 60.0, 0.0, LOG[name]) for name in "uvr"}
NO_POSE = Log("short", T, {name: LOG[name] for name in ("u", "v", "r", "delta")})
BAD = np.arange(75, 2000, 150)
NOISE = np.random.default_rng(1).normal(0.0, 0.01, LOG["v"].size)
TURN = 2.0 * np.pi
WRAPS = float((np.abs(np.diff(PSI % TURN)) > 3.0).sum())
# a level is what the fault does to a fit: what changes nothing is a note
TOLD: list[tuple[Log, str, str, str, dict[str, float]]] = [
    # frames, signs, units
    (changed(psi=np.pi / 2 - PSI), "frames", "will mislead", "frame: enu", {"best_coherence": 1}),
    (changed(psi=-PSI), "frames", "will mislead", "psi counted counter-clockwise (sign: -1)", {}),
    (changed(x=LOG["y"], y=LOG["x"]), "frames", "will mislead", "x and y exchanged", {}),
    (changed(y=-LOG["y"]), "frames", "will mislead", "y positive to the west", {}),
    (changed(u=-LOG["u"]), "frames", "will mislead", "u positive astern", {}),
    (changed(u=-LOG["u"], v=-LOG["v"]), "frames", "will mislead", "reversed sign", {}),
    (changed(v=-LOG["v"]), "frames", "will mislead", "v positive to port", {}),
    (changed(psi=PSI - 1.2), "frames", "will mislead", "+68.8 deg added", {"best_offset": 1.2}),
    (KNOTS, "frames", "will mislead", "kn taken as m/s", {"speed_ratio": 1.944}),
    (changed(psi=PSI + 0.14), "frames", "will mislead", "compass offset", {"offset": -0.14}),
    (
        changed(r=9.0 * np.sign(LOG["r"])),
        "impossible_rate",
        "will mislead",
        "than a vessel can",
        {},
    ),
    (changed(r=-LOG["r"]), "gain", "will mislead", "sign is wrong", {"value_1": -2}),
    (changed(r=np.degrees(LOG["r"])), "gain", "will mislead", "deg/s taken as rad/s", {}),
    (changed(r=0.0 * LOG["r"]), "yaw_rate", "will mislead", "gyro is dead", {"correlation": 0}),
    (changed(r=RANDOM.normal(size=50).repeat(40) / 20), "yaw_rate", "fatal", "one motion", {}),
    (
        changed(phi=0.1 * np.sin(0.5 * T), p=-0.05 * np.cos(0.5 * T)),
        "roll_rate",
        "will mislead",
        "phi moves by -1 times",
        {},
    ),
    # biases, arms, currents
    (changed(r=LOG["r"] - 0.002), "yaw_drift", "will mislead", "", {"bias": 0.002, "end": 0.4}),
    (
        changed(x=LOG["x"] + ARM.real, y=LOG["y"] + ARM.imag),
        "lever_arm",
        "note",
        "forward and to starboard",
        {"value_1": -0.99, "value_2": -0.4},
    ),
    (
        changed(x=LOG["x"] + 0.4 * T, y=LOG["y"] - 0.1 * T),
        "current",
        "will mislead",
        "moves north and east",
        {"value_1": 0.4, "value_2": -0.1},
    ),
    # values
    (changed(**held("x", "y")), "frozen", "will mislead", "position", {"share": 39 / 2000}),
    (changed(u=stepped(LOG["u"], 1500, 0.5)), "jump", "will mislead", "u changes", {"t": 150}),
    (changed(x=stepped(LOG["x"], 1200, 1.0)), "position_jump", "note", "", {"largest": 1}),
    (changed(psi=stepped(PSI, 900, 0.3)), "heading_jump", "will mislead", "17.", {"t": 90}),
    (changed(psi=PSI % TURN), "heading_wrap", "will mislead", "continuous", {"count": WRAPS}),
    (
        Log("slow", T, {name: np.repeat(v[::4], 4) for name, v in LOG.channels.items()}),
        "repeated_rows",
        "will mislead",
        "logged twice",
        {"share": 0.75},
    ),
    (changed(u=np.where(T < 30, np.nan, LOG["u"])), "nan", "note", "", {"share": 0.15}),
    (changed(u=np.where(T < 120, np.nan, LOG["u"])), "nan", "fatal", "60 %", {"longest": 120}),
    (changed(v=np.minimum(LOG["v"], 0.3)), "clipping", "note", "exactly", {"limit": 0.3}),
    (
        changed(r=LOG["r"] + 1.0 * np.isin(np.arange(2000), BAD)),
        "outliers",
        "note",
        "13 samples of r",
        {"share": 13 / 2000},
    ),
    (changed(u=np.round(LOG["u"], 1)), "resolution", "will mislead", "0.1 m/s", {"levels": 10}),
    (changed(v=np.round(NOISE, 3)), "resolution", "note", "0.001 m/s", {"levels": 33}),
    # clock
    (GAP, "gaps", "note", "1 gaps", {"count": 1, "longest": 6.1, "lost": 6.0}),
    (changed(u=np.repeat(LOG["u"][::2], 2)), "held", "note", "once in 2 samples", {"every": 2}),
    (SHAKEN, "clock", "note", "steps vary", {"rate": 10.0}),
    (SHAKEN_SLOW, "clock", "will mislead", "steps vary", {"rate": 1.0}),
    (LOG.replace(t=stepped(T, 1000, 1.7e9)), "clock_span", "fatal", "unit of time", {}),
    (LOG.replace(t=np.where(T == 50.0, 49.9, T)), "duplicate_rows", "fatal", "repeat", {}),
    (LOG.replace(t=np.where(T > 99.95, T - 9, T)), "time_backwards", "fatal", "backwards", {}),
    (LOG.replace(t=np.where(T > 199, np.nan, T)), "time_missing", "fatal", "no time", {"count": 9}),
    # channels that are not there
    (NO_POSE, "frames_unchecked", "note", "no x, y, psi", {}),
    (NO_POSE, "absent", "note", "", {}),
    # inputs and excitation
    (TWIN, "constant", "note", "n is constant at 10", {}),
    (changed(**STOPPED), "standing", "will mislead", "at rest for 30 %", {"share": 0.3}),
    (changed(wind_dir=1.0 - PSI), "relative_wind", "will mislead", "contains psi", {"slope": -1}),
    (changed(delta=np.degrees(LOG["delta"])), "unit", "will mislead", "more than any rudder", {}),
]


@pytest.mark.parametrize(("log", "code", "level", "words", "figures"), TOLD)
def test_inspect_log_reports_a_planted_fault_with_figures(
    log: Log, code: str, level: str, words: str, figures: dict[str, float]
) -> None:
    found = [f for f in inspect_log(log).findings if f.code == code and words in f.text]
    assert found, inspect_log(log).to_lines()
    assert found[0].level == level
    assert {name: found[0].figures[name] for name in figures} == pytest.approx(figures, rel=0.03)
    assert found[0].action or level != "will mislead"
    if found[0].sample_mask is not None:
        assert found[0].sample_mask.shape == log.t.shape


def test_checks_above_a_note_have_planted_faults() -> None:
    # groups of causes are named one by one
    named = {"position_causes", "yaw_causes", "contradicts", "extrapolation"}
    # tests/io/test_feedback.py, tests/io/test_consensus.py
    named |= {"feedback", "contradicts_dead"}
    named |= {code for fault in FAULTS for code in fault.codes} | {row[1] for row in TOLD}
    assert {check.code for check in CHECKS if check.level != "note"} <= named
    assert {check.stage for check in CHECKS} == STAGE_DESCRIPTIONS.keys()


@pytest.mark.parametrize("lag", [-0.5, 0.63])
def test_estimate_position_causes_measures_lags_in_seconds(lag: float) -> None:
    findings = inspect_log(wavy(lag=lag)).find_by_code("lag")
    assert [finding.text.split(" by")[0] for finding in findings] == (
        ["u, v trail the position", "r trails psi"]
        if lag > 0
        else ["u, v lead the position", "r leads psi"]
    )
    for finding in findings:
        assert finding.figures["value_1"] == pytest.approx(lag, abs=0.05)


@pytest.mark.parametrize(
    ("boat", "delays"),
    [
        ("dinghy", (0.0, 0.0)),
        ("catamaran", (0.0, 0.0)),
        ("dinghy", (0.0, 0.8)),
        ("catamaran", (0.0, 0.8)),
        ("dinghy", (0.65, 0.65)),
        ("catamaran", (0.65, 0.65)),
        ("dinghy", (1.2, 0.3)),
        ("catamaran", (1.2, 0.3)),
    ],
)
def test_estimate_position_causes_separates_clocks(boat: str, delays: tuple[float, float]) -> None:
    estimates = []
    t = np.arange(3.0, 300.0, 0.1)
    for seed in range(4):
        random = np.random.default_rng(seed)
        motion = simulate_motion(BOATS[boat], random, duration=306.0)
        channels = {name: motion.sample(name, t) for name in ("x", "y", "r")}
        channels |= {name: motion.sample(name, t - delays[0]) for name in ("u", "v")}
        channels["psi"] = motion.sample("psi", t - delays[1])
        noise = {"x": 0.05, "y": 0.05, "psi": 0.005, "u": 0.02, "v": 0.02, "r": 0.003}
        channels = {
            name: values + noise[name] * random.standard_normal(t.size)
            for name, values in channels.items()
        }
        causes = estimate_position_causes(LogStatistics(Log(boat, t, channels)))
        assert any(delays) or causes == {}
        sizes = {name: cause.estimates[0] for name, cause in causes.items()}
        common = sizes.get("lag_xy", 0.0)
        surge_delay = sizes.get("lag", 0.0) - common
        estimates.append((surge_delay, sizes.get("lag_psi", 0.0) - common))
        assert not any(name.startswith("gain") for name in causes)
    assert np.array(estimates) == pytest.approx(np.tile(delays, (4, 1)), abs=0.03, rel=0.05)


# the drift of the tanker is too small against the noise of its sway velocity
@pytest.mark.parametrize("boat", ["catamaran", "tanker"])
def test_a_course_is_told_from_a_delayed_heading(boat: str) -> None:
    t = np.arange(3.0, 150.0, 0.2)
    for seed in range(3):
        random = np.random.default_rng(seed)
        motion = simulate_motion(BOATS[boat], random, duration=156.0)
        channels = {name: motion.sample(name, t) for name in ("x", "y", "u", "v", "r")}
        course = motion.sample("psi", t) + np.arctan2(channels["v"], channels["u"])
        channels |= {
            name: channels[name] + std * random.standard_normal(t.size)
            for name, std in {"x": 0.05, "y": 0.05, "u": 0.02, "v": 0.02, "r": 0.003}.items()
        }
        angles = [course, *(motion.sample("psi", t - delay) for delay in (0.0, 0.5, 1.0, -0.7))]
        logs = [Log(boat, t, {**channels, "psi": angle}) for angle in angles]
        is_course = ["course" in estimate_yaw_causes(LogStatistics(log)) for log in logs]
        assert is_course == [boat == "catamaran"] + 4 * [False]
        if not is_course[0]:
            continue
        # one cause instead of a wrong sway velocity and delays
        found = {f.code for f in inspect_log(logs[0]).findings if f.level == "will mislead"}
        assert "course" in found
        assert not any(code.startswith(("gain", "lag")) for code in found)


def test_inspect_log_reports_a_sway_velocity_of_another_motion() -> None:
    (finding,) = inspect_log(changed(v=0.4 * np.sin(0.17 * T))).find_by_code("gain_v")
    assert "v does not follow position and heading" in finding.text
    assert "leave it out" in finding.action


def test_a_reset_of_the_pose_has_no_delays_and_scales_as_causes() -> None:
    is_after = T >= 90.0
    pose = (LOG["x"] + 1j * LOG["y"] - LOG["x"][900] - 1j * LOG["y"][900]) * np.exp(1.7j)
    pose = np.where(is_after, pose, LOG["x"] + 1j * LOG["y"])
    log = changed(x=pose.real, y=pose.imag, psi=PSI + 1.7 * is_after)
    codes = {f.code for f in inspect_log(log).findings if f.level == "will mislead"}
    assert codes == {"heading_jump", "position_jump"}


def test_check_relative_wind_accepts_a_true_wind() -> None:
    gusts = 0.3 * np.sin(0.17 * T) + 0.2 * np.sin(0.71 * T)
    assert not inspect_log(changed(wind_dir=1.0 + gusts)).find_by_code("relative_wind")


def test_inspect_log_locates_a_jump_after_a_gap() -> None:
    log = rows(changed(x=stepped(LOG["x"], 1200, 1.0)), np.r_[0:500, 560:2000])
    at = one(inspect_log(log), "position_jump").sample_mask
    assert at is not None
    assert set(np.round(log.t[at], 1)) == {119.9, 120.0}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("way", ["zero", "constant", "half unknown", "rare", "moored"])
def test_inspect_log_with_constant_channels_completes(way: str) -> None:
    ways = {
        "zero": lambda v: 0.0 * v,
        "constant": lambda v: np.full_like(v, v[20]),
        "half unknown": lambda v: np.where(T > 100.0, np.nan, v),
        "rare": lambda v: np.where(np.arange(v.size) % 10, np.nan, v),
    }
    sick = [{n: ways[way](v)} for n, v in LOG.channels.items()] if way in ways else []
    still = {name: np.full(len(LOG), 0.1 * (name in ("x", "y", "psi"))) for name in LOG.channels}
    for channels in [
        *sick,
        still | {"delta": LOG["delta"]},
        *([sick[0] | sick[1]] if sick else []),
    ]:
        # reports may say what they like: to end with one is what counts
        assert inspect_log(changed(**channels), inputs=["delta"]).to_lines(), channels.keys()


@pytest.mark.parametrize("size", [2, 3, 20, 60])
def test_inspect_log_of_short_logs_completes(size: int) -> None:
    report = inspect_log(rows(LOG, slice(size)))
    assert f"7 channels, {size} samples" in one(report, "channels").text
    assert one(report, "clock").figures["span"] == pytest.approx(0.1 * (size - 1))
    extremes = {f.text.split()[0]: f.figures["max"] for f in report.find_by_code("range")}
    assert extremes == {name: LOG[name][:size].max() for name in ("u", "v", "r", "delta")}
    # frames need 50 samples, and each extreme that is reached once is no clipping
    assert bool(report.find_by_code("frames")) == (size >= 50)
    assert bool(report.find_by_code("frames_unchecked")) == (size < 50)
    assert not report.find_by_code("clipping")
    assert not report.has_problems


@pytest.mark.parametrize(
    ("log", "inputs", "error", "words"),
    [
        (rows(LOG, slice(1)), None, DataError, "at least 2"),
        (changed(u=np.full(2000, np.nan)), None, DataError, "channel u holds no number"),
        (LOG, ["rudder"], UsageError, "no channel 'rudder'"),
    ],
)
def test_inspect_log_refuses_unusable_logs(log: Log, inputs: Any, error: type, words: str) -> None:
    with pytest.raises(error, match=words):
        inspect_log(log, inputs)


def test_inspect_log_includes_remarks_and_downgrades_masked_samples() -> None:
    noted = {"level": "will mislead", "code": "latency", "text": "late", "figures": {"s": 0.9}}
    sick = changed(**held("x", "y")).replace(meta={"findings": [noted]})
    plain = inspect_log(sick)
    masked = inspect_log(sick, masks=[FrozenMask()])
    assert one(plain, "latency").figures == {"s": 0.9}
    assert [one(report, "frozen").level for report in (plain, masked)] == ["will mislead", "note"]
    assert one(masked, "latency").level == "will mislead"
    assert inspect_log(LOG, masks=[FrozenMask()]).findings == inspect_log(LOG).findings


@pytest.mark.parametrize("hull", [True, False])
def test_horizontal_motion_accepts_both_yaw_rate_conventions(*, hull: bool) -> None:
    phi = 0.4 - 1.2 * LOG["r"]
    level = np.cos(phi) if hull else 1.0
    log = changed(phi=phi, p=np.gradient(phi, T), r=LOG["r"] / level, v=LOG["v"] / level)
    found = inspect_log(log).findings
    assert [finding.text for finding in found if finding.level != "note"] == []


def test_check_stuck_actuators_accepts_a_slow_gear() -> None:
    demand = np.radians(20.0) * np.sign(np.sin(0.4 * T))
    angle = [0.0]
    for wanted in demand[1:]:
        angle.append(angle[-1] + np.clip(wanted - angle[-1], -0.004, 0.004))
    gear = np.array(angle) + RANDOM.normal(scale=0.0015, size=T.size)
    assert not inspect_log(changed(cmd_delta=demand, delta=gear)).find_by_code("stuck")
    rests = np.where((T > 60.0) & (T < 80.0), gear[600], gear)
    assert inspect_log(changed(cmd_delta=demand, delta=rests)).find_by_code("stuck")


def test_finding_effects_measure_the_change_of_the_motion() -> None:
    heading = one(inspect_log(changed(psi=LOG["psi"] + 0.2)), "heading")
    # positions and integrated velocities differ by the chord of the angle
    assert heading.effect == pytest.approx(2.0 * np.sin(0.1), rel=0.2)
    lags = inspect_log(wavy(lag=0.25)).find_by_code("lag")
    assert [(finding.level, finding.effect) for finding in lags] == [("note", 0.0)] * 2


def answering(delta: np.ndarray, late: float, gain: float = 0.3, time: float = 1.2) -> Log:
    """A first-order answer in yaw to a rudder [T] that was given `late` s before."""
    t = 0.1 * np.arange(delta.size)
    acting = np.interp(t - late, t, delta)
    r = np.zeros(delta.size)
    for k in range(delta.size - 1):
        r[k + 1] = r[k] + 0.1 / time * (gain * acting[k] - r[k])
    noise = np.random.default_rng(5).normal(0.0, 2e-4, (2, delta.size))
    return Log("one", t, {"u": 1.0 + noise[0], "r": r + noise[1], "delta": delta})


STEPS = np.repeat(np.random.default_rng(3).uniform(-0.4, 0.4, 40), 20)


def test_check_rudder_sign_and_delay_of_the_response() -> None:
    fine = one(inspect_log(answering(STEPS, 0.0)), "rudder_sign")
    assert fine.level == "note"
    # yaw acceleration per rad of rudder is gain over time
    assert fine.figures["effect"] == pytest.approx(0.25, rel=0.05)
    turned = inspect_log(answering(STEPS, 0.0, gain=-0.3)).find_by_code("rudder_sign")
    assert {finding.level for finding in turned} == {"will mislead"}
    # commands to two sides steer by their difference
    log = answering(STEPS, 0.0)
    pair = {"cmd_thrust_port": np.ones(len(log)), "cmd_thrust_stbd": np.sqrt(1.0 + log["delta"])}
    (crossed,) = inspect_log(
        Log("two", log.t, {**pair, "u": log["u"], "r": log["r"]})
    ).find_by_code("rudder_sign")
    assert (crossed.level, crossed.action[:8]) == ("will mislead", "exchange")
    for early in (0.8, 1.6):
        late = one(inspect_log(answering(STEPS, -early)), "acausal")
        assert late.level == "will mislead"
        assert late.figures["lag"] == pytest.approx(-early, abs=0.25)


def test_frozen_check_accepts_few_printed_digits() -> None:
    random = np.random.default_rng(3)
    t = 0.13 * np.arange(3000)
    psi = 0.4 + 0.2 * np.sin(0.05 * t)
    path = np.cumsum(1.7 * np.exp(1j * psi)) * 0.13 - 60.0
    printed = np.vectorize(lambda value: float(f"{value:.3e}"))
    channels = {"x": path.real, "y": path.imag}
    channels = {n: printed(v + 0.05 * random.normal(size=t.size)) for n, v in channels.items()}
    assert not inspect_log(Log("printed", t, {**channels, "psi": psi}), ()).find_by_code("frozen")


@pytest.mark.parametrize(("n_lost", "fix"), [(4, "no action is needed"), (40, "split the log")])
def test_check_gaps_accepts_a_few_lost_rows_of_a_fast_recorder(n_lost: int, fix: str) -> None:
    t = 0.01 * np.arange(3000)
    is_present = (t < 10.0) | (t > 10.0 + 0.01 * n_lost)
    log = Log("fast", t[is_present], {"u": 1.0 + 0.2 * np.sin(0.3 * t[is_present])})
    assert fix in one(inspect_log(log), "gaps").action


def test_a_gap_in_time_is_no_jump_and_no_motion() -> None:
    is_logged = (T < 80.0) | (T > 88.0)
    log = LOG.select_rows(np.flatnonzero(is_logged))
    r = np.where(log.t > 88.0, log["r"] + 0.4 * np.ptp(LOG["r"]), log["r"])
    channels = {**log.channels, "r": r}
    assert not inspect_log(log.replace(channels=channels)).find_by_code("jump")
    pose = {name: log[name].copy() for name in ("x", "y", "psi")}
    pose["x"][:50] = np.nan
    derived = with_derived_velocities(LogStatistics(log.replace(channels=pose), ()))
    is_known = np.isfinite(derived["u"])
    assert not is_known[:50].any()
    is_known[:60] = is_known[-10:] = False
    np.testing.assert_allclose(derived["u"][is_known], log["u"][is_known], atol=0.1)
    assert is_known.mean() > 0.9


def test_a_speed_that_is_slower_than_its_log_is_no_repeated_row() -> None:
    random = np.random.default_rng(2)
    speed = np.repeat(1.0 + 0.1 * random.normal(size=500), [1, 1, 1, 1, 2] * 100)
    command = np.cumsum(random.integers(0, 2, speed.size)) / 300.0
    channels = {"u": speed, "cmd_port": command, "cmd_stbd": command}
    log = Log("run", 0.1 * np.arange(speed.size), channels)
    assert not inspect_log(log, ("cmd_port", "cmd_stbd")).find_by_code("repeated_rows")
    log = log.replace(channels={**channels, "v": -speed})
    assert inspect_log(log, ("cmd_port", "cmd_stbd")).find_by_code("repeated_rows")


def test_check_repeated_rows_accepts_chance_repeats() -> None:
    u = RANDOM.standard_normal(2000).round(4)
    u[501] = u[500]
    assert not inspect_log(Log("one", T, {"u": u, "delta": np.ones(2000)})).find_by_code(
        "repeated_rows"
    )


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_check_rudder_sign_accepts_a_turning_circle_with_speed_loss(side: float) -> None:
    t, r = np.arange(0.0, 900.0), np.zeros(900)
    delta = side * np.clip((t - 60.0) / 14.0, 0.0, 1.0) * np.radians(35.0)
    speed = np.where(t < 60.0, 14.0, 6.0 + 8.0 * np.exp(-(t - 60.0) / 150.0))
    for k in range(t.size - 1):
        r[k + 1] = r[k] + 0.15 * (0.009 * speed[k] * delta[k] - r[k])
    r += np.random.default_rng(5).normal(0.0, 2e-4, r.size)
    good = one(inspect_log(Log("circle", t, {"r": r, "delta": delta})), "rudder_sign")
    assert good.level == "note"
    wrong = one(inspect_log(Log("circle", t, {"r": r, "delta": -delta})), "rudder_sign")
    assert wrong.level == "will mislead"


@pytest.mark.parametrize(("period", "late"), [(5.8, 0.1), (8.4, 0.4), (11.0, 0.4), (11.0, 0.1)])
def test_the_delay_of_a_periodic_manoeuvre_is_causal(period: float, late: float) -> None:
    zigzag = 0.35 * np.clip(8.0 * np.sin(0.2 * np.pi * np.arange(800) / period), -1.0, 1.0)
    report = inspect_log(answering(zigzag, late))
    assert one(report, "rudder_sign").figures["lag"] == pytest.approx(late, abs=0.25)
    assert not report.find_by_code("acausal")


def twin(port: float, stbd: float, yaw: float, speed: float) -> Log:
    """A vessel with two propellers and no rudder at steady revolutions."""
    noise = np.random.default_rng(0)
    size = 600
    u, r = speed + 0.01 * noise.normal(size=size), yaw + 0.002 * noise.normal(size=size)
    turns = {"n_port": np.full(size, port), "n_stbd": np.full(size, stbd)}
    return Log("twin", 0.1 * np.arange(size), {"u": u, "r": r, **turns})


@pytest.mark.parametrize(
    ("log", "said"),
    [
        (twin(-10.0, 30.0, -0.3, 0.8), []),  # it turns to port because one runs astern
        (twin(-20.0, 20.0, 0.0, 1.2), ["propeller_sign"]),  # it would turn, and does not
        (twin(-20.0, -20.0, 0.0, 1.2), ["propeller_sign"] * 2),
        (twin(34.0, 34.0, 0.0, 1.9), []),  # who does not steer does not turn
        (twin(1200.0, 600.0, -0.3, 1.2), ["unit", "unit"]),
        (twin(0.8, 30.0, -0.3, 0.9), []),  # one hardly turns, the other drives
    ],
)
def test_check_rudder_sign_uses_the_difference_of_two_propellers(log: Log, said: list[str]) -> None:
    found = run_checks("actuators", LogStatistics(log, ["n_port", "n_stbd"]))
    assert [finding.code for finding in found] == said


def test_estimate_causes_of_pure_noise_finds_no_gain() -> None:
    # on the spot a lever arm can stand for the steady part, and then noise decides on the scale
    t = 0.05 * np.arange(1200)
    u, v, r = np.outer((0.03, 0.033, -0.19), 1.0 - np.exp(-t / 0.8))
    psi, x, y = (
        np.append(0.0, np.cumsum(0.025 * (rate[1:] + rate[:-1]))) for rate in (r, 0 * r, 0 * r)
    )
    ground = np.exp(1j * psi) * (u + 1j * v)
    place = np.append(0.0, np.cumsum(0.025 * (ground[1:] + ground[:-1])))
    for seed in range(10):
        noise = np.random.default_rng(seed).standard_normal((3, t.size)) * [[0.03], [0.03], [0.003]]
        seen = dict(zip("uvr", np.stack((u, v, r)) + noise, strict=True))
        log = Log("spot", t, {"x": x + place.real, "y": y + place.imag, "psi": psi, **seen})
        causes = estimate_position_causes(LogStatistics(log))
        gains = [causes[name].estimates for name in causes if name.startswith("gain")]
        assert np.abs(np.concatenate([[0.0], *gains])).max() < 0.3, seed


def test_check_position_causes_ignores_noise_of_v() -> None:
    random = np.random.default_rng(1)
    t = 0.1 * np.arange(400)
    noise = {"u": 0.005, "v": 0.005, "r": 0.002, "psi": 0.003}
    moving = {"x": 0.05 * t, "y": 0.0 * t, "u": 0.05 + 0.0 * t, "delta": np.sin(t)}
    told = {name: moving.get(name, 0.0 * t) for name in ("x", "y", "psi", "u", "v", "r", "delta")}
    log = Log(
        "slow", t, {n: c + noise.get(n, 0.0) * random.normal(size=400) for n, c in told.items()}
    )
    assert not inspect_log(log, ["delta"]).find_by_code("gain_v")


def test_find_spikes_and_fill_values() -> None:
    assert find_spikes(LOG) == {}
    assert bridge_spikes(LOG) is LOG
    shown = np.full(len(LOG), 132.0)
    shown[[300, 701]] = 131.0, 133.0
    assert "delta" not in find_spikes(changed(delta=shown))
    u = LOG["u"].copy()
    u[700] = -999.0
    clean = bridge_spikes(changed(u=u))
    assert clean.meta["spikes"] == {"u": 1}
    assert np.flatnonzero(clean.masks["spike"]).tolist() == [700]
    assert clean["u"][700] == pytest.approx(0.5 * (u[699] + u[701]))
    values = np.linspace(900.0, 1100.0, 201)
    assert not is_fill_value(values).any()
    values[3], values[7] = -9999.0, np.float32(9.96921e36)
    assert np.flatnonzero(is_fill_value(values)).tolist() == [3, 7]
    assert is_implausible(np.array([3.0, 1e4, np.nan]), "m/s").tolist() == [False, True, False]


NOISY = changed(**{n: v + 1e-3 * RANDOM.standard_normal(2000) for n, v in LOG.channels.items()})
WHOLE = rows(NOISY, slice(None), "whole")
PART = rows(NOISY, slice(700, 1200))
FIRST, SECOND = (
    rows(NOISY, part, name, 50.0)
    for name, part in (("first", slice(900)), ("second", slice(900, 2000)))
)
OTHER = changed(**{n: v + 1e-3 * RANDOM.standard_normal(2000) for n, v in LOG.channels.items()})
SAME = changed(OTHER, delta=NOISY["delta"])
FAST = changed(SAME, u=SAME["u"] + 0.6).replace(name="fast")
STRAIGHT = {name: np.zeros(2000) for name in ("y", "psi", "v", "r")}
DULL = Log("dull", T, {**STRAIGHT, "x": 2.0 * T, "u": np.full(2000, 2.0), "delta": LOG["delta"]})
ROUND, OTHER_ROUND = (changed(one, r=np.abs(one["r"])) for one in (LOG, OTHER))
AHEAD, OTHER_AHEAD = (changed(one, r=1e-3 * RANDOM.standard_normal(2000)) for one in (LOG, OTHER))
TRAIN_TEST = {"whole": "train", "part": "test", "fast": "test", "first": "train", "second": "test"}


@pytest.mark.parametrize(
    ("logs", "splits", "code", "level", "words"),
    [
        ([WHOLE, PART], {}, "copied_part", "will mislead", "100 % a copy of rows 700 to 1199 of w"),
        ([WHOLE, PART], TRAIN_TEST, "copied_part", "fatal", "(train and test)"),
        ([WHOLE, PART], {"whole": "train"}, "copied_part", "note", "part is in"),
        ([WHOLE, WHOLE.replace(name="b")], {}, "duplicate_log", "will mislead", "are the same"),
        (
            [SECOND, FIRST],
            {},
            "continued",
            "note",
            "second continues where first ends, 0.10 s later",
        ),
        ([FIRST, SECOND], TRAIN_TEST, "continued", "note", "belong to train and test"),
        ([WHOLE, SAME], {}, "same_commands", "note", "(delta) over 2000 samples"),
        ([WHOLE, FAST], TRAIN_TEST, "extrapolation", "will mislead", "u of fast (test) lies out"),
        ([DULL], {}, "no_excitation", "fatal", "no velocity varies beyond its noise"),
        ([ROUND, OTHER_ROUND], {}, "one_side", "will mislead", "all of 2 logs turn to starboard"),
        ([ROUND], {}, "one_side", "note", "turns to the other side"),
        ([AHEAD, OTHER_AHEAD], {}, "one_side", "will mislead", "steering cannot be learned"),
    ],
)
def test_inspect_log_set_reports_planted_faults(
    logs: list[Log], splits: dict[str, str], code: str, level: str, words: str
) -> None:
    found = inspect_log_set(logs, splits=splits).find_by_code(code)
    assert [finding.level for finding in found][:1] == [level]
    assert words in found[0].text


def test_summarize_inspection_counts_and_ranks_findings() -> None:
    sick = changed(psi=-PSI).replace(name="sick")
    reports = [inspect_log(LOG), inspect_log(sick)]
    inspection = build_inspection(reports, inspect_log_set([LOG]))
    inspection = InspectionFile.model_validate_json(inspection.to_json_text())
    assert [entry.misled for entry in inspection.logs] == [False, True]
    for entry, report in zip(inspection.logs, reports, strict=True):
        texts = [(finding.text, finding.level) for finding in entry.findings]
        assert texts == [(finding.text, finding.level) for finding in report.findings]
    clean = summarize_inspection(build_inspection(reports[:1], InspectionReport("together", ())))
    assert clean.sentences == ["Data checks: nothing in the log would mislead a fit."]
    counted = summarize_inspection(inspection)
    assert (counted.n_logs, counted.n_logs_with_problems) == (2, 1)
    assert counted.tally.startswith("Data checks: 1 of 2 logs has faults")
    assert counted.first_action.startswith("First fix this: sick: ")
    assert [inspection.tally, inspection.first] == counted.sentences


@pytest.mark.parametrize("slow", [0.5, 3.0])
def test_check_rudder_sign_uses_samples_with_known_speed(*, slow: float) -> None:
    """Where a speed fails the last one known is none: the rudder may seem to be reversed."""
    t = np.arange(0.0, 180.0, 0.2)
    u = np.where(t < 90.0, slow, 2.0)
    delta = 0.2 * np.sign(np.sin(0.3 * t))
    r = np.zeros(t.size)
    for k in range(t.size - 1):
        turn = 0.18 * u[k] ** 2 * delta[k] - 0.8 * u[k] * r[k] - 0.9 * r[k] * abs(r[k])
        r[k + 1] = r[k] + 0.2 * turn
    noise = 0.003 * np.random.default_rng(0).standard_normal(t.size)
    channels = {"u": np.where(t < 90.0, u, np.nan), "r": r + noise, "delta": delta}
    (said,) = inspect_log(Log("log", t, channels)).find_by_code("rudder_sign")
    assert said.level == "note"
    assert said.figures["effect"] == pytest.approx(0.18 * slow**2, rel=0.2)


@pytest.mark.parametrize("seed", [0, 14, 34, 35])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_check_rudder_sign_does_not_contradict_coarsely_sampled_turns(
    seed: int, side: float
) -> None:
    """A sample each half second: the smoother spans the response of a small boat."""
    random = np.random.default_rng(seed)
    t = np.arange(0.0, 72.0, 0.05)
    delta = np.repeat(random.uniform(-0.44, 0.44, 12), 120)
    n = np.repeat(random.uniform(10.0, 25.0, 8), 180)
    motion = np.zeros((t.size, 3))
    motion[0, 0] = 1.2
    for k in range(t.size - 1):
        u, v, r = motion[k]
        race = 0.6 * u * u + 0.002 * n[k] ** 2
        surge = 0.0009 * n[k] ** 2 - 0.3 * u * abs(u) + 0.5 * v * r
        sway = -0.9 * v - 0.6 * u * r - 0.25 * race * delta[k]
        yaw = -r - 0.8 * r * abs(r) - 0.6 * u * v + 0.6 * race * delta[k]
        motion[k + 1] = motion[k] + 0.05 * np.array([surge, sway, yaw])
    u, v, r = motion[::10].T + random.normal(0.0, 0.004, (3, 144))
    channels = {"u": u, "v": v, "r": r, "n": n[::10], "delta": side * delta[::10]}
    found = inspect_log(Log("boat", t[::10], channels)).find_by_code("rudder_sign")
    contradiction = "starboard" if side < 0.0 else "port"
    assert not [finding for finding in found if contradiction in finding.text]


def test_check_extrapolation_notes_channels_that_do_not_drive_the_vessel() -> None:
    logs = [
        changed(log, e_heading=np.full(2000, value)) for log, value in ((WHOLE, 0.0), (SAME, 1.0))
    ]
    splits = {logs[0].name: "train", "other": "test"}
    logs[1] = logs[1].replace(name="other")
    for inputs, level in ((["delta"], "note"), (["delta", "e_heading"], "will mislead")):
        found = inspect_log_set(logs, inputs, splits).find_by_code("extrapolation")
        assert [f.level for f in found if f.text.startswith("e_heading")] == [level]


def test_channels_with_the_noise_of_rounding_are_not_interpolated() -> None:
    # slopes change by one step of the last digit, and stay for 1.2 s now and then
    random = np.random.default_rng(4)
    is_steady = np.arange(1200) % 60 < 14
    slopes = np.where(is_steady, 50.0, 50.0 + random.integers(-1, 2, (2, 1200)))
    psi, x = 0.01 * np.cumsum(slopes, axis=1).round()
    channels = {"psi": np.radians(psi), "x": 0.1 * x}
    log = Log("simulated", 0.1 * np.arange(1200), channels)
    assert not inspect_log(log, ()).find_by_code("interpolated")


@pytest.mark.parametrize("names", [("x", "y", "psi"), ("psi",)])
def test_interpolated_stretch_of_several_noisy_channels(names: tuple[str, ...]) -> None:
    random = np.random.default_rng(4)
    channels = {n: LOG[n] + 0.02 * random.normal(size=T.size) for n in ("x", "y", "psi")}
    ends = np.array([100, 180])
    for name in names:
        channels[name][100:181] = np.interp(T[100:181], T[ends], channels[name][ends])
    findings = inspect_log(Log("filled", T, channels), ()).find_by_code("interpolated")
    # a single channel is also straight by its resolution
    assert len(findings) == (len(names) > 1)
    if findings:
        assert findings[0].figures["t"] == pytest.approx(T[100], abs=0.3)


def test_a_heading_without_positions_shows_sign_and_bias_of_a_gyro() -> None:
    rates = {"sign": -LOG["r"], "bias": LOG["r"] + np.radians(1.0)}
    for code, name in (("gain", "sign"), ("yaw_drift", "bias")):
        channels = {"psi": PSI, "r": rates[name], "u": LOG["u"], "v": LOG["v"]}
        findings = inspect_log(Log("no_gps", T, channels), ()).find_by_code(code)
        assert [finding.level for finding in findings] == ["will mislead"]


def test_no_delay_is_tried_where_the_regression_has_no_lag(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_arguments: object) -> tuple[str, int]:
        raise AssertionError("a delay was tried")

    monkeypatch.setattr(kinematics, "_select_clock", refuse)
    random = np.random.default_rng(7)
    antenna = 3.0 * np.exp(1j * PSI)
    noise = 0.05 * random.normal(size=(2, T.size))
    channels = {"x": LOG["x"] + antenna.real + noise[0], "y": LOG["y"] + antenna.imag + noise[1]}
    statistics = LogStatistics(LOG.replace(channels={**LOG.channels, **channels}))
    causes = estimate_position_causes(statistics)
    assert [*causes] == ["lever_arm"]
    assert causes["lever_arm"].estimates[0] == pytest.approx(3.0, abs=0.1)
