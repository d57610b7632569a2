"""The table of instrument errors of a log: clean logs, planted errors, currents, report."""

from __future__ import annotations

import numpy as np
import pytest
from simulated_motion import BOATS, simulate_motion

from residnet.core.log import Log
from residnet.quality.compatibility import analyse_compatibility
from residnet.report.sections.data import compatibility_tables

TIMES = np.arange(0.0, 149.0, 0.2)


def make_log(
    boat: str = "catamaran",
    *,
    current: tuple[float, float] = (0.0, 0.0),
    rate_bias: float = 0.0,
    lever_arm: float = 0.0,
    is_earth_fixed: bool = False,
) -> Log:
    """Return a log whose u, v are through the water where a current is given."""
    rng = np.random.default_rng(11)
    motion = simulate_motion(BOATS[boat], rng, duration=150.0, current=current)
    channels = {name: motion.sample(name, TIMES) for name in ("x", "y", "psi", "u", "v", "r")}
    direction = np.exp(1j * channels["psi"])
    channels["x"] = channels["x"] + lever_arm * direction.real
    channels["y"] = channels["y"] + lever_arm * direction.imag
    channels["r"] = channels["r"] + rate_bias
    if is_earth_fixed:
        velocity = (channels["u"] + 1j * channels["v"]) * direction
        channels |= {"u": velocity.real, "v": velocity.imag}
    stds = {"x": 0.05, "y": 0.05, "psi": 0.01, "u": 0.03, "v": 0.03, "r": 0.01}
    noisy = {name: v + rng.normal(0.0, stds[name], v.size) for name, v in channels.items()}
    return Log("run", TIMES, noisy)


@pytest.mark.parametrize(
    "boat",
    [pytest.param(boat, marks=[] if boat == "catamaran" else [pytest.mark.long]) for boat in BOATS],
)
def test_clean_logs_have_no_significant_error(boat: str) -> None:
    row = analyse_compatibility(make_log(boat))
    assert row.meaning == "as declared"
    assert [error.name for error in row.errors if error.is_significant] == []
    assert row.current is not None
    assert not row.current.is_significant


def test_planted_errors_are_significant() -> None:
    row = analyse_compatibility(make_log(rate_bias=0.02, lever_arm=1.5))
    errors = {error.name: error for error in row.errors}
    for name, truth in (("yaw rate bias", 0.02), ("position forward", 1.5)):
        assert errors[name].is_significant
        assert abs(errors[name].value - truth) < 4.0 * errors[name].standard_error


def test_a_current_is_significant_and_estimated() -> None:
    row = analyse_compatibility(make_log(current=(0.25, -0.1)))
    assert row.current is not None
    assert row.current.is_significant
    assert row.current.north == pytest.approx(0.25, abs=4.0 * row.current.standard_error)
    assert row.meaning == "u, v through the water, with a current"
    assert "significant" in str(compatibility_tables([row])[-1].__dict__)


def test_earth_fixed_velocities_win_by_a_margin() -> None:
    row = analyse_compatibility(make_log(is_earth_fixed=True))
    assert row.meaning == "u, v in earth axes"
    assert row.margin > 100.0


def test_logs_without_pose_give_a_reason() -> None:
    log = make_log()
    without = log.replace(channels={name: log[name] for name in ("u", "v", "r")})
    assert analyse_compatibility(without).reason == "no x, y, psi"
