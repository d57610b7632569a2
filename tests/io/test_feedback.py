"""Feedback in inputs: closed loops without excitation against open loop, relays and set points."""

from __future__ import annotations

import numpy as np
import pytest
from steered_logs import Steering, steered_log

from residnet.quality import inspect_log_set
from residnet.quality.feedback import (
    MAX_FEEDBACK_SHARE,
    cross_validated_r2,
    detect_feedback,
    find_relay_inputs,
    response_time,
)


@pytest.mark.parametrize("steering", ["steps", "zigzag", "set_points"])
@pytest.mark.parametrize("n_logs", [1, 4])
def test_excited_inputs_are_not_reported(steering: Steering, n_logs: int) -> None:
    logs = [dict(steered_log(steering, seed).channels) for seed in range(n_logs)]
    found = detect_feedback(logs, ["delta"], 0.1)
    assert [one.name for one in found] == ["delta"]
    assert not found[0].is_closed_loop
    if steering == "zigzag":
        assert found[0].relay_share > 0.3
    else:
        assert found[0].share < 0.5 * MAX_FEEDBACK_SHARE


@pytest.mark.parametrize(
    ("steerings", "relays"),
    [
        (["zigzag"] * 4, ["delta"]),
        # one log of steps among four shows other commands
        (["zigzag", "zigzag", "zigzag", "steps"], []),
        (["steps"] * 2, []),
        (["controller"] * 2, []),
        (["set_points"] * 2, []),
    ],
)
def test_find_relay_inputs_names_a_rudder_that_all_logs_switch(
    steerings: list[Steering], relays: list[str]
) -> None:
    logs = [dict(steered_log(steering, seed).channels) for seed, steering in enumerate(steerings)]
    # a shaft speed has two levels in each log, which it does not switch often
    logs = [log | {"n": np.repeat([8.0, 12.0], 1500)} for log in logs]
    assert find_relay_inputs(logs, ["n", "delta"]) == relays
    assert find_relay_inputs([{"n": np.full(100, 5.0)}], ["n"]) == []


@pytest.mark.parametrize("n_logs", [1, 4])
def test_a_controller_without_excitation_is_reported(n_logs: int) -> None:
    logs = [dict(steered_log("controller", seed).channels) for seed in range(n_logs)]
    found = detect_feedback(logs, ["delta"], 0.1)
    assert found[0].source == "the heading"
    assert found[0].relay_share < 0.1
    assert found[0].is_closed_loop


def test_the_inspection_of_logs_of_a_controller_gives_an_advice() -> None:
    logs = [steered_log("controller", seed) for seed in range(3)]
    found = inspect_log_set(logs).find_by_code("feedback")
    assert [one.level for one in found] == ["will mislead"]
    assert "delta follows the heading" in found[0].text
    assert "zigzag" in found[0].action
    assert not inspect_log_set([steered_log("zigzag", seed) for seed in range(3)]).find_by_code(
        "feedback"
    )


def test_logs_that_are_too_short_or_lack_a_yaw_rate_give_nothing() -> None:
    short = {name: values[:30] for name, values in steered_log("zigzag", 0).channels.items()}
    assert detect_feedback([short, short], ["delta"], 0.1) == []
    assert detect_feedback([{"delta": short["delta"]}], ["delta"], 0.1) == []
    assert detect_feedback([], ["delta"], 0.1) == []


def test_a_constant_input_is_omitted() -> None:
    logs = [{**steered_log("steps", seed).channels, "n": np.full(3000, 12.0)} for seed in (0, 1)]
    assert [one.name for one in detect_feedback(logs, ["n", "delta"], 0.1)] == ["delta"]


def test_cross_validated_r2_is_at_most_zero_without_a_common_relation() -> None:
    random = np.random.default_rng(0)
    x = [random.standard_normal((200, 2)) for _ in range(3)]
    assert cross_validated_r2(x, [part @ [1.0, -2.0] for part in x]) == pytest.approx(1.0, abs=1e-4)
    # the relation of each log is that of no other
    y = [sign * part[:, 0] for sign, part in zip((1.0, -1.0, 1.0), x, strict=True)]
    assert cross_validated_r2(x, y) < 0.0


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_response_time_of_a_first_order_process(noise: float) -> None:
    random = np.random.default_rng(1)
    values = np.zeros(20_000)
    for k in range(1, len(values)):
        values[k] = 0.98 * values[k - 1] + 0.2 * random.standard_normal()
    # half of the autocorrelation exp(-t / 5 s) is left after 3.5 s
    time = response_time([values + noise * random.standard_normal(len(values))], 0.1)
    assert time == pytest.approx(3.5, rel=0.35)
