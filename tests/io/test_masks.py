"""Masks against sample-by-sample rules."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from residnet.core.config import validate_config
from residnet.core.errors import ConfigError, UsageError
from residnet.core.log import Log
from residnet.preprocessing.masks import (
    FrozenMask,
    GapMask,
    HampelMask,
    InputJumpMask,
    JumpMask,
    MaskConfig,
    MaskRule,
    MissingValues,
    OutlierMask,
    SpikeMask,
    apply_masks,
    find_scored_samples,
    make_hard_mask,
    number_log_segments,
)


def log_of(t: np.ndarray | None = None, **channels: Any) -> Log:
    arrays = {name: np.asarray(values, dtype=float) for name, values in channels.items()}
    size = next(iter(arrays.values())).size
    return Log("made", np.arange(size) * 0.1 if t is None else t, arrays)


RNG = np.random.default_rng(5)
TIMES = np.array([0.0, 0.1, 0.2, 0.9, 1.0, 1.1])
REST = np.array([0.0, 1, 2, 2, 2, 2, 3, 4, 4, 5])
LATER = np.round(1176.1 + 0.1 * np.arange(60), 1)
HELD = np.where((np.arange(60) > 10) & (np.arange(60) < 17), 10, np.arange(60))
SLOW = np.arange(600) // 10 * 10.0
SLOW_FROZEN = np.where((SLOW >= 300) & (SLOW < 370), 300.0, SLOW)
STEP = np.where(np.arange(60) < 30, 0.0, 0.5)
LEVELS = np.array([0.0, 0, 0, 5, 5, 5, 5, np.nan, 5, 5])
WAVE = np.sin(np.arange(100) * 0.1)
LONE = np.where(np.arange(100) == 50, 10.0, np.where(np.arange(100) == 49, np.nan, WAVE))
NOISE = RNG.normal(size=5000)
T = 0.1 * np.arange(4000)
MOTION = np.sin(0.3 * T) + 3.0 * T
SEEN = MOTION + RNG.normal(0.0, 0.02, T.size)
BAD = [500, 501, 502, 1700, 1702, 3000]
SPIKED = SEEN + 0.5 * np.isin(np.arange(T.size), BAD)
AROUND: dict[str, Any] = {"channels": ("d",), "before": 0.5, "after": 1.0}
HALF_STEP = np.where(np.arange(300) == 40, 0.5, np.repeat([0.0, 1.0], 150))


@pytest.mark.parametrize(
    ("rule", "log", "marked"),
    [
        (FrozenMask(samples=3, after=0.0), log_of(x=REST, y=REST), [2, 3, 4, 5]),
        (FrozenMask(samples=3), log_of(x=REST, y=REST), [*range(2, 10)]),
        (FrozenMask(), log_of(LATER, x=HELD, y=HELD), [*range(10, 36)]),
        (FrozenMask(samples=4), log_of(x=REST, y=REST), []),
        (FrozenMask(samples=3), log_of(x=REST, y=np.arange(10)), []),
        (FrozenMask(), log_of(x=SLOW, y=SLOW), []),
        (FrozenMask(after=0.0), log_of(x=SLOW_FROZEN, y=SLOW_FROZEN), [*range(300, 370)]),
        (GapMask(longest=0.2), log_of(TIMES, u=np.ones(6)), [3]),
        (GapMask(longest=0.3), log_of(np.array([1.1, 1.2, 1.5]), u=np.ones(3)), []),
        (MissingValues(), log_of(u=[0, np.nan, 0], v=[0, 0, np.nan]), [1, 2]),
        (MissingValues(channels=("v",)), log_of(u=[0, np.nan, 0], v=[0, 0, np.nan]), [2]),
        (
            JumpMask(channel="u", limit=1.0, before=2, after=3),
            log_of(u=STEP * 10),
            [*range(28, 33)],
        ),
        (JumpMask(channel="u", limit=5.0), log_of(u=STEP * 10), []),
        (JumpMask(channel="psi", limit=0.5), log_of(psi=[3.1, 3.14, -3.1, -3.0]), []),
        (InputJumpMask(**AROUND, limit=0.1), log_of(d=STEP), [*range(25, 41)]),
        (InputJumpMask(**AROUND, limit=0.6), log_of(d=STEP), []),
        (OutlierMask(channels=("u", "v")), log_of(u=np.linspace(0, 7, 300), v=HALF_STEP), [40]),
        (OutlierMask(channels=("u",)), log_of(u=LONE), [50]),
        (OutlierMask(channels=("u",)), log_of(u=np.arange(5)), []),
        # in a window of 10 that holds the sample itself the largest possible distance is 9 /
        # sqrt(10) standard deviations: document 002's rule taken literally never fires
        (OutlierMask(channels=("u",)), log_of(u=np.where(np.arange(20) == 5, 1e6, 0.0)), [5]),
        (HampelMask(channels=("u",)), log_of(u=SEEN), []),
        (HampelMask(channels=("u",)), log_of(u=MOTION), []),
        (HampelMask(channels=("u",)), log_of(u=SPIKED), BAD),
        (HampelMask(channels=("psi",)), log_of(psi=np.angle(np.exp(0.4j * T))), []),
        (SpikeMask(), log_of(u=np.where(np.arange(4000) == 1000, 90.0, SEEN / 100)), [1000]),
    ],
)  # fmt: skip
def test_mask_rules_mark_expected_samples(rule: MaskRule, log: Log, marked: list[int]) -> None:
    assert np.flatnonzero(rule.apply(log)).tolist() == marked


def test_outlier_rules_on_noise_and_grouped_outliers() -> None:
    assert OutlierMask(channels=("u",)).apply(log_of(u=NOISE)).mean() < 0.004
    assert not OutlierMask(channels=("u",)).apply(log_of(u=SPIKED))[BAD].all()


def hampel_by_loop(values: np.ndarray, sigmas: float, samples: int) -> np.ndarray:
    """The rule of the Hampel mask, sample by sample, for finite values; odd reflection beyond the
    ends.
    """
    half = samples // 2
    size = values.size
    left = values[2 * half : 0 : -1]
    right = values[-2 : -2 * half - 2 : -1]
    wide = np.concatenate((2 * values[0] - left, values, 2 * values[-1] - right))
    bent = [
        wide[i] - np.median([(wide[i - k] + wide[i + k]) / 2 for k in range(1, 2 * half + 1)])
        for i in range(2 * half, 2 * half + size)
    ]
    mirrored = np.array([*bent[half:0:-1], *bent, *bent[-2 : -half - 2 : -1]])
    windows = [mirrored[i : i + 2 * half + 1] for i in range(size)]
    medians = np.array([np.median(window) for window in windows])
    spreads = [1.4826 * np.median(abs(w - m)) for w, m in zip(windows, medians, strict=True)]
    far = np.abs(bent - medians)
    floor = max(1.4826 * np.median(far), 2.0 * np.quantile(far[far > 0], 0.1))
    return np.asarray(far > sigmas * np.maximum(np.maximum(floor, spreads), abs(medians)))


def test_hampel_mask_equals_a_reference_loop() -> None:
    rng = np.random.default_rng(4)
    for samples in (7, 11):
        for _ in range(10):
            u = np.cumsum(rng.normal(size=120)) + rng.normal(size=120)
            u[rng.choice(120, 4)] += rng.normal(0.0, 20.0, 4)
            found = HampelMask(channels=("u",), sigmas=4.0, samples=samples).apply(log_of(u=u))
            np.testing.assert_array_equal(found, hampel_by_loop(u, 4.0, samples))


def test_mask_reasons_distinguish_hard_soft_and_rate() -> None:
    input_jump = InputJumpMask(channels=("u",), limit=1.0, before=0.0, after=0.2)
    rules = [JumpMask(channel="u", limit=1.0), MissingValues(), input_jump]
    log = apply_masks(log_of(u=LEVELS), rules)
    assert set(log.masks) == {"jump", "hard:nan", "rate:input_jump"}
    assert [rule.is_hard for rule in rules] == [False, True, False]
    assert np.flatnonzero(make_hard_mask(log)).tolist() == [7]
    assert np.flatnonzero(~find_scored_samples(log)).tolist() == [2, 3, 7]
    assert np.flatnonzero(~log.usable).tolist() == [2, 3, 4, 5, 7]
    assert number_log_segments(log).tolist() == [0, 0, 0, 0, 0, 0, 0, -1, 1, 1]
    assert number_log_segments(log_of(u=np.ones(3))).tolist() == [0, 0, 0]


def test_apply_masks_merges_rules_of_one_kind() -> None:
    before = {"jump": np.array([True, False, False, False]), "mine": np.ones(4, dtype=bool)}
    log = log_of(u=[0, 9, 9, 9], v=[0, 0, 0, 9]).replace(masks=before)
    log = apply_masks(log, [JumpMask(channel=name, limit=1.0, before=0) for name in "uv"])
    assert log.masks["jump"].tolist() == [True, True, False, True]
    assert log.masks["mine"].all()
    with pytest.raises(UsageError, match="no channel 'w'"):
        apply_masks(log, [JumpMask(channel="w", limit=1.0)])


def test_mask_config_validates_quantities() -> None:
    assert validate_config({"kind": "frozen", "after": "500 ms"}, MaskConfig, "test") == FrozenMask(
        after=0.5
    )
    kinds = {"frozen", "gap", "nan", "jump", "outlier", "hampel", "spike", "input_jump"}
    assert kinds == set(TypeAdapter(MaskConfig).json_schema()["discriminator"]["mapping"])
    for faulty in (
        {"kind": "gap"},
        {"kind": "gap", "longest": 0},
        {"kind": "gaps", "longest": 1},
        {"kind": "outlier", "channels": []},
    ):
        with pytest.raises(ConfigError):
            validate_config(faulty, MaskConfig, "test")
