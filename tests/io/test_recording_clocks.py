"""Times, clocks and traffic of recordings, each fault planted by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from printed_times import EPOCH, printed

from residnet.core.errors import DataError, UsageError
from residnet.io.readers.recording import Recording, Series
from residnet.io.readers.timestamps import parse_numbers, parse_texts
from residnet.io.readers.topics import align_clocks, topic_statistics

RNG = np.random.default_rng(7)


def recording(*series: Series) -> Recording:
    return Recording(Path("made"), {one.name: one for one in series}, EPOCH * 10**9)


def topic(
    name: str,
    t: np.ndarray,
    stamp: np.ndarray | None = None,
    arrival: np.ndarray | None = None,
    **fields: np.ndarray,
) -> Series:
    return Series(name, "", fields or {"a": np.sin(t)}, stamp, arrival)


def codes(one: Series) -> list[str]:
    return [entry["code"] for entry in one.remarks]


@pytest.mark.parametrize("step", [1_000_000, 70_533_347, 1_077_000_003])
@pytest.mark.parametrize("style", ["padded", "unpadded", "trimmed"])
def test_fractions_are_read_as_they_were_meant(style: str, step: int) -> None:
    ns = EPOCH * 10**9 + step * np.arange(400) + (0 if style == "trimmed" else 7)
    stamps = parse_texts(printed(ns, style))
    np.testing.assert_array_equal(stamps.ns, ns)
    assert (len(stamps.remarks) == 1) == (style == "unpadded")


def test_zones_unix_times_and_plain_seconds() -> None:
    zoned = parse_texts(
        np.array(["2025-04-11T11:15:45.5+02:00", "2025-04-11T09:15:46Z"], dtype=object)
    )
    np.testing.assert_array_equal(np.diff(zoned.ns), [5 * 10**8])
    for scale in (1, 10**3, 10**6, 10**9):
        whole = parse_numbers(np.array([EPOCH, EPOCH + 2], dtype=np.int64) * scale)
        np.testing.assert_array_equal(whole.ns, np.array([EPOCH, EPOCH + 2]) * 10**9)
        assert whole.is_absolute
    plain = parse_texts(np.array(["-0.5", "0.25", "1e1"], dtype=object))
    np.testing.assert_array_equal(plain.ns, [-5 * 10**8, 25 * 10**7, 10**10])
    np.testing.assert_array_equal(
        parse_texts(np.array(["-0.5", "12.25"], dtype=object)).ns, [-5 * 10**8, 1225 * 10**7]
    )
    assert not plain.is_absolute
    with pytest.raises(DataError, match="row 2 is no date or time"):
        parse_texts(np.array(["2025-04-11 09:15:45", "soon"], dtype=object))
    with pytest.raises(DataError, match="is no date"):
        parse_texts(np.array(["2025-13-11 09:15:45"], dtype=object))


@pytest.mark.parametrize(
    ("form", "ahead"),
    [
        ("2025-04-11T09:15:{}.{}Z", 0),
        ("2025-04-11 09:15:{},{}+02:00", 2),
        ("11.04.2025 9:15:{}:{}", 0),
        ("2025 / 04 / 11 9:15:{}.{} am", 0),
        ("2025年4月11日 9時15分{}.{}秒", 0),
    ],
)
def test_dates_whose_seconds_repeat_over_rows(form: str, ahead: int) -> None:
    tenths = np.arange(0, 300, 7)
    texts = np.array([form.format(f"{n // 10:02d}", n % 10) for n in tenths], dtype=object)
    start = np.datetime64("2025-04-11T09:15:00", "ns").astype(np.int64)
    expected = start - ahead * 3600 * 10**9 + tenths * 10**8
    np.testing.assert_array_equal(parse_texts(texts, has_only_dates=True).ns, expected)
    for end in (".5", " :20"):
        with pytest.raises(DataError, match="row 3 is no date or time"):
            parse_texts(np.array([*texts[:2], texts[0] + end], dtype=object), has_only_dates=True)


# clocks


@pytest.mark.parametrize(
    ("offset", "expected"),
    [
        (7200.0, {"time_zone"}),
        (-34200.0, {"time_zone"}),
        (7203.5, {"time_zone", "clock_offset"}),
        (-0.4, {"clock_offset"}),
        (0.0, set()),
    ],
)
def test_the_recorders_clock_is_brought_to_the_stamps(offset: float, expected: set[str]) -> None:
    t = 0.1 * np.arange(500)
    late = RNG.exponential(2e-3, t.size)
    settled = align_clocks(
        recording(topic("gps", t, t, t + offset + late), topic("rpm", t, None, t + offset)), {}
    )
    assert {entry["code"] for entry in settled.remarks} == expected
    # what has no stamp is as true as the quickest message
    np.testing.assert_allclose(settled["rpm"].clock, t, atol=1e-3)
    np.testing.assert_array_equal(settled["gps"].clock, t)


def test_one_sender_with_another_clock_is_named_and_delays_correct_it() -> None:
    t = 0.1 * np.arange(500)
    made = recording(
        *(
            topic(name, t, t + ahead, t + 1e-3)
            for name, ahead in [("a", 0.0), ("b", 0.0), ("c", -0.6)]
        )
    )
    settled = align_clocks(made, {"/c": -0.6})
    assert "clock_offset" in codes(settled["c"])
    assert "clock_offset" not in codes(settled["a"])
    np.testing.assert_allclose(settled["c"].clock, t, atol=1e-12)
    assert codes(settled["c"])[-1] == "delay_corrected"


def test_estimated_delay_of_a_topic_without_stamps() -> None:
    t = 0.1 * np.arange(500)
    late = 0.05 + RNG.exponential(1e-3, t.size)
    settled = align_clocks(
        recording(topic("gps", t, t, t + late), topic("rpm", t, None, t + 0.05)), {"rpm": None}
    )
    np.testing.assert_allclose(settled["rpm"].clock, t, atol=3e-3)


def test_order_of_rows() -> None:
    t = 0.1 * np.arange(300)
    swapped = t.copy()
    swapped[[50, 51]] = swapped[[51, 50]]
    restarted = np.concatenate((t[:200], t[:100]))
    doubled = np.repeat(t, 2)
    values = np.repeat(np.sin(t), 2)
    shared = values + np.tile([0.0, 1.0], t.size)
    made = recording(
        topic("late", t, swapped),
        topic("restart", t, restarted),
        topic("bad_stamps", t, restarted, t + 0.01),
        topic("copies", t, doubled, None, a=values),
        topic("shared", t, doubled, None, a=shared),
        topic("empty_stamps", t, np.zeros(300), t),
    )
    settled = align_clocks(made, {}, 0.0).series
    assert all((np.diff(one.clock) > 0).all() for name, one in settled.items() if name != "restart")
    assert codes(settled["late"]) == ["out_of_order"]
    assert (settled["restart"].remarks[0]["level"], codes(settled["restart"])[0]) == (
        "fatal",
        "time_runs_backwards",
    )
    assert "stamps_run_backwards" in codes(settled["bad_stamps"])
    assert codes(settled["copies"]) == ["duplicate_rows"]
    assert codes(settled["shared"]) == ["repeated_stamps"]
    np.testing.assert_allclose(settled["shared"]["a"], np.sin(t) + 1.0)
    assert codes(settled["empty_stamps"]) == ["empty_stamps"]


# traffic


def seen(one: Series) -> set[str]:
    return {entry["code"] for entry in topic_statistics(one) if entry["level"] != "note"}


@pytest.mark.parametrize("seed", range(4))
def test_several_publishers_are_told_from_noise_and_rounding(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t = 0.05 * np.arange(2000)
    slow = np.cumsum(rng.normal(size=t.size)) * 0.05
    # clean topics: smooth, noisy, rounded to two values, held for several rows, jitter
    clean = [
        slow,
        slow + rng.normal(size=t.size),
        np.round(0.2 * slow),
        np.round(rng.random(t.size)),
        np.repeat(slow[::5], 5),
        np.sign(np.sin(t)),
    ]
    for values in clean:
        assert not seen(topic("a", t, t + 5e-3 * rng.random(t.size), None, a=values))
    # two trains of messages at their own rates and levels
    a, b = np.arange(0.0, 100.0, 0.05), np.arange(0.013, 100.0, 0.031)
    both = np.concatenate((a, b))
    level = np.concatenate((np.interp(a, t, slow), np.interp(b, t, slow) + 5.0))
    order = np.argsort(both)
    # one train beside another of the same rate
    twin = np.sort(np.concatenate((t, t + 0.02)))
    assert seen(topic("a", t, both[order], None, a=level[order])) == {"several_publishers"}
    assert seen(topic("a", t, twin, None, a=np.stack((slow, slow + 4.0), axis=1).reshape(-1))) == {
        "several_publishers"
    }


def test_senders_tell_publishers_apart() -> None:
    t = 0.1 * np.arange(100)
    sender = np.array(["bow", "stern"] * 50, dtype=object)
    assert [entry["code"] for entry in topic_statistics(topic("none", np.zeros(0)))] == [
        "empty_topic"
    ]
    one = Series("heading", "", {"a": np.where(sender == "bow", 1.0, 2.0)}, t, None, sender)
    assert seen(one) == {"several_publishers"}
    assert (one.rows_of_sender("bow")["a"] == 1.0).all()
    with pytest.raises(UsageError, match="no rows of sender 'midship'"):
        one.rows_of_sender("midship")


def test_what_a_recording_holds_is_told_where_no_channel_is_found() -> None:
    t = np.arange(5.0)
    series = [
        Series("/chatter", "std_msgs/msg/String", {}, t),
        Series("tank", "", {"level": t, "volts": t}, t),
    ]
    whole = Recording(Path("run"), {one.name: one for one in series})
    assert whole.contents_description == "/chatter (String), tank (level, volts)"
    many = Recording(Path("run"), {f"s{i}": series[0] for i in range(23)})
    assert many.contents_description.endswith("s19 (String), and 3 more")
    assert Recording(Path("run"), {}).contents_description == "nothing"
