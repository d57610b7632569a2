"""Masks against sample-by-sample rules."""

from __future__ import annotations

import numpy as np
import pytest
from known_logs import frozen_by_loop
from pydantic import TypeAdapter

from residnet.core.config import validate
from residnet.core.errors import ConfigError, UsageError
from residnet.core.log import Log
from residnet.data.masks import (
    Frozen,
    Gap,
    Hampel,
    InputJump,
    Jump,
    MaskConfig,
    Missing,
    Outlier,
    apply_masks,
    hard_mask,
    scored,
    segments,
)


def log_of(t: np.ndarray | None = None, **channels: object) -> Log:
    arrays = {name: np.asarray(values, dtype=float) for name, values in channels.items()}
    size = next(iter(arrays.values())).size
    return Log("made", np.arange(size) * 0.1 if t is None else t, arrays)


def test_frozen_equals_an_independent_loop_on_random_logs() -> None:
    rng = np.random.default_rng(1)
    for start in (0.0, 1176.1, 3223.7):
        for _ in range(150):
            size = int(rng.integers(1, 150))
            x, y = np.cumsum(rng.random(size) < 0.12), np.cumsum(rng.random(size) < 0.05)
            log = log_of(np.round(start + 0.1 * np.arange(size), 1), x=x, y=y)
            np.testing.assert_array_equal(Frozen().apply(log), frozen_by_loop(x, y))


def test_frozen_without_aftermath_marks_the_equal_samples_only() -> None:
    x = np.array([0.0, 1, 2, 2, 2, 2, 3, 4, 4, 5])
    assert np.flatnonzero(Frozen(samples=3, after=0.0).apply(log_of(x=x, y=x))).tolist() == [
        2,
        3,
        4,
        5,
    ]
    assert not Frozen(samples=4).apply(log_of(x=x, y=x)).any()
    assert not Frozen(samples=3).apply(log_of(x=x, y=np.arange(10))).any()


def test_a_slow_receiver_is_frozen_where_it_repeats_itself_for_several_of_its_own_steps() -> None:
    last = np.arange(600) // 10 * 10.0
    assert not Frozen().apply(log_of(x=last, y=last)).any()
    last[300:370] = 300.0
    found = np.flatnonzero(Frozen(after=0.0).apply(log_of(x=last, y=last)))
    assert (found[0], found[-1]) == (300, 369)


def test_gap_marks_the_sample_after_it_and_splits_there() -> None:
    log = apply_masks(
        log_of(np.array([0.0, 0.1, 0.2, 0.9, 1.0, 1.1]), u=np.ones(6)), [Gap(longest=0.2)]
    )
    assert np.flatnonzero(log.masks["hard:gap"]).tolist() == [3]
    assert segments(log).tolist() == [0, 0, 0, -1, 1, 1]
    assert not log_of(np.array([0.0, 0.1, 0.3]), u=np.ones(3)).masks


def test_a_step_as_long_as_allowed_is_no_gap() -> None:
    t = np.array([1.1, 1.2, 1.5])
    assert not Gap(longest=0.3).apply(log_of(t, u=np.ones(3))).any()


def test_missing_looks_at_the_channels_that_it_is_given() -> None:
    log = log_of(u=[1, np.nan, 1, 1], v=[1, 1, 1, np.nan])
    assert Missing().apply(log).tolist() == [False, True, False, True]
    assert Missing(channels=("v",)).apply(log).tolist() == [False, False, False, True]
    with pytest.raises(UsageError, match="no channel 'w'"):
        Missing(channels=("w",)).apply(log)


def test_jump_counts_samples_on_either_side() -> None:
    u = np.array([0.0, 0, 0, 5, 5, 5, 5, 5])
    assert np.flatnonzero(Jump(channel="u", limit=1.0).apply(log_of(u=u))).tolist() == [2, 3]
    assert np.flatnonzero(
        Jump(channel="u", limit=1.0, before=0, after=3).apply(log_of(u=u))
    ).tolist() == [3, 4, 5]
    assert not Jump(channel="u", limit=5.0).apply(log_of(u=u)).any()


def test_a_wrapped_angle_does_not_jump() -> None:
    log = log_of(wind_dir=np.radians([350.0, 358.0, 2.0, 10.0, 100.0]))
    assert np.flatnonzero(Jump(channel="wind_dir", limit=np.radians(20.0)).apply(log)).tolist() == [
        3,
        4,
    ]


def test_outliers_are_found_and_noise_ramps_and_steps_are_not() -> None:
    rng = np.random.default_rng(2)
    noise = rng.normal(size=4000)
    spiked = noise.copy()
    spiked[[700, 2500]] += 15.0
    found = Outlier(channels=("u",)).apply(log_of(u=spiked))
    assert found[[700, 2500]].all()
    assert Outlier(channels=("u",)).apply(log_of(u=noise)).mean() < 0.004
    ramp = np.linspace(0.0, 7.0, 300)
    step = np.repeat([0.0, 1.0], 150)
    assert not Outlier(channels=("u", "v")).apply(log_of(u=ramp, v=step)).any()
    step[40] = 0.5
    assert np.flatnonzero(Outlier(channels=("v",)).apply(log_of(v=step))).tolist() == [40]


def test_the_rule_of_document_002_taken_literally_never_fires() -> None:
    # why the sample itself is left out: in a window of 10 the largest possible distance is 9 /
    # sqrt(10) standard deviations
    window = np.zeros(10)
    window[5] = 1e6
    assert abs(window[5] - window.mean()) / window.std(ddof=1) == pytest.approx(9.0 / np.sqrt(10.0))
    assert Outlier(channels=("u",)).apply(log_of(u=np.append(window, np.zeros(10))))[5]


def hampel_by_loop(values: np.ndarray, sigmas: float, samples: int) -> np.ndarray:
    """The rule of the Hampel mask, sample by sample, for finite values; odd reflection beyond the
    ends.
    """
    half, size = samples // 2, values.size

    def at(i: int) -> float:
        return (
            2 * values[0] - values[-i]
            if i < 0
            else 2 * values[-1] - values[2 * size - 2 - i]
            if i >= size
            else values[i]
        )

    bent = [
        values[i] - np.median([(at(i - k) + at(i + k)) / 2 for k in range(1, 2 * half + 1)])
        for i in range(size)
    ]
    mirrored = [
        [
            bent[abs(j)] if j < size else bent[2 * size - 2 - j]
            for j in range(i - half, i + half + 1)
        ]
        for i in range(size)
    ]
    medians = [np.median(window) for window in mirrored]
    spreads = [
        1.4826 * np.median(np.abs(np.array(window) - median))
        for window, median in zip(mirrored, medians, strict=True)
    ]
    distances = [abs(b - median) for b, median in zip(bent, medians, strict=True)]
    floor = max(
        1.4826 * np.median(distances), 2.0 * np.quantile([d for d in distances if d > 0], 0.1)
    )
    return np.array(
        [
            d > sigmas * max(floor, s, abs(m))
            for d, s, m in zip(distances, spreads, medians, strict=True)
        ]
    )


def test_hampel_equals_an_independent_loop_on_random_logs() -> None:
    rng = np.random.default_rng(4)
    for samples in (7, 11):
        for _ in range(20):
            u = np.cumsum(rng.normal(size=120)) + rng.normal(size=120)
            u[rng.choice(120, 4)] += rng.normal(0.0, 20.0, 4)
            found = Hampel(channels=("u",), sigmas=4.0, samples=samples).apply(log_of(u=u))
            np.testing.assert_array_equal(found, hampel_by_loop(u, 4.0, samples))


def test_hampel_finds_grouped_outliers_where_the_moving_rule_is_blind_and_leaves_motion() -> None:
    rng = np.random.default_rng(5)
    t = np.arange(4000) * 0.1
    motion = np.sin(0.3 * t) + 3.0 * t
    u = motion + rng.normal(0.0, 0.02, t.size)
    assert Hampel(channels=("u",)).apply(log_of(u=u)).sum() == 0
    assert Hampel(channels=("u",)).apply(log_of(u=motion)).sum() == 0
    bad = np.array([500, 501, 502, 1700, 1702, 3000])
    u[bad] += 0.5
    found = Hampel(channels=("u",)).apply(log_of(u=u))
    assert np.flatnonzero(found).tolist() == bad.tolist()
    assert not Outlier(channels=("u",)).apply(log_of(u=u))[bad].all()
    turned = np.angle(np.exp(1j * (0.4 * t)))
    assert not Hampel(channels=("psi",)).apply(log_of(psi=turned)).any()


def test_outliers_beside_missing_samples() -> None:
    u = np.sin(np.arange(100) * 0.1)
    u[50], u[49] = 10.0, np.nan
    assert np.flatnonzero(Outlier(channels=("u",)).apply(log_of(u=u))).tolist() == [50]
    assert not Outlier(channels=("u",)).apply(log_of(u=np.arange(5))).any()


def test_input_jump_masks_seconds_around_the_step() -> None:
    delta = np.where(np.arange(60) < 30, 0.0, 0.5)
    rule = InputJump(channels=("delta",), limit=0.1, before=0.5, after=1.0)
    assert np.flatnonzero(rule.apply(log_of(delta=delta))).tolist() == list(range(25, 41))
    assert (
        not InputJump(channels=("delta",), limit=0.6, before=0.5, after=1.0)
        .apply(log_of(delta=delta))
        .any()
    )


def test_reasons_tell_hard_soft_and_rate_masks_apart() -> None:
    u = np.array([0.0, 0, 0, 5, 5, 5, 5, np.nan, 5, 5])
    rules = [
        Jump(channel="u", limit=1.0),
        Missing(),
        InputJump(channels=("u",), limit=1.0, before=0.0, after=0.2),
    ]
    log = apply_masks(log_of(u=u), rules)
    assert set(log.masks) == {"jump", "hard:nan", "rate:input_jump"}
    assert [rule.hard for rule in rules] == [False, True, False]
    assert np.flatnonzero(hard_mask(log)).tolist() == [7]
    assert np.flatnonzero(~scored(log)).tolist() == [2, 3, 7]
    assert np.flatnonzero(~log.usable).tolist() == [2, 3, 4, 5, 7]
    assert segments(log).tolist() == [0, 0, 0, 0, 0, 0, 0, -1, 1, 1]


def test_rules_of_one_kind_share_a_mask_and_older_masks_stay() -> None:
    log = log_of(u=[0, 9, 9, 9], v=[0, 0, 0, 9]).replace(
        masks={"jump": np.array([True, False, False, False]), "mine": np.ones(4, dtype=bool)}
    )
    log = apply_masks(
        log, [Jump(channel="u", limit=1.0, before=0), Jump(channel="v", limit=1.0, before=0)]
    )
    assert log.masks["jump"].tolist() == [True, True, False, True]
    assert log.masks["mine"].all()


def test_a_log_without_hard_masks_is_one_piece() -> None:
    assert segments(log_of(u=np.ones(3))).tolist() == [0, 0, 0]


def test_configs_read_quantities_and_refuse_nonsense() -> None:
    rule = validate({"kind": "frozen", "after": "500 ms"}, MaskConfig, "test")
    assert rule == Frozen(after=0.5)
    assert {"frozen", "gap", "nan", "jump", "outlier", "hampel", "spike", "input_jump"} == set(
        TypeAdapter(MaskConfig).json_schema()["discriminator"]["mapping"],
    )
    for faulty in (
        {"kind": "gap"},
        {"kind": "gap", "longest": 0},
        {"kind": "gaps", "longest": 1},
        {"kind": "outlier", "channels": []},
    ):
        with pytest.raises(ConfigError):
            validate(faulty, MaskConfig, "test")
