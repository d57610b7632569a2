"""Relations that hold for every vessel: what is read, prepared and fitted follows a change of logs.

Logs that are turned, moved, mirrored, later, in other units, with columns in another order, twice,
in parts or with a channel more tell of the same vessel, to the digits that arithmetic leaves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from random_vessels import KINDS, random_logs

from residnet.baselines.regressors_config import RegressorsConfig
from residnet.core.config import validate_config
from residnet.core.log import Log
from residnet.core.samples import Samples
from residnet.core.units import si_unit, to_si, unit_names
from residnet.io.readers import ReaderConfig
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.prepare import PrepareConfig, prepare_log
from residnet.preprocessing.samples import make_samples

EXACT = 1e-9
WINDOW = 8
# a failing case is one of few, and small already
GENERATED = (Phase.explicit, Phase.generate)
drawn = settings(max_examples=6, deadline=None, derandomize=True, phases=GENERATED)
vessels = st.tuples(st.sampled_from(KINDS), st.integers(0, 1))


@cache
def logs_of(vessel: tuple[str, int]) -> tuple[Log, ...]:
    kind, seed = vessel
    return tuple(random_logs(kind, seed, 1)[0])


def inputs_of(log: Log) -> list[str]:
    return [name for name in log.channels if name not in ("x", "y", "psi", "u", "v", "r")]


def prepared(logs: Sequence[Log], inputs: Sequence[str]) -> Samples:
    """Samples on the clock of the first log."""
    step = float(np.median(np.diff(logs[0].t)))
    derivative = {"kind": "savitzky_golay", "window": WINDOW * step, "order": 2}
    config = validate_config(
        {"grid": {"step": step}, "derivative": derivative}, PrepareConfig, "test"
    )
    signals = SignalsConfig(inputs=tuple(inputs)).build()
    return make_samples([prepare_log(log, "train", inputs, config) for log in logs], signals)


def fitted(data: Samples) -> np.ndarray:
    """The accelerations that a linear baseline, found from samples, gives for them [N, 3]."""
    config = RegressorsConfig()
    baseline = config.build(data.names)
    config.fit_preferred(baseline, data)
    return np.asarray(baseline(data.z).numpy())


def changed(log: Log, **channels: np.ndarray) -> Log:
    return log.replace(channels={**log.channels, **channels})


def turned(log: Log, angle: float) -> Log:
    place = (log["x"] + 1j * log["y"]) * np.exp(1j * angle)
    return changed(log, x=place.real, y=place.imag, psi=log["psi"] + angle)


def mirrored(log: Log) -> Log:
    turning = [name for name in ("y", "psi", "v", "r", "delta") if name in log.channels]
    sides = {"n_port": "n_stbd", "n_stbd": "n_port"} if "n_port" in log.channels else {}
    swapped = {name: log[other] for name, other in sides.items()}
    return changed(log, **{name: -log[name] for name in turning}, **swapped)


def with_more(log: Log, by: float) -> Log:
    idle = np.where(np.arange(len(log)) % 3 > 0, np.nan, by)
    return log.replace(channels={**log.channels, "tank": idle}, units={**log.units, "tank": "-"})


def ordered(log: Log) -> Log:
    return log.replace(channels={name: log[name] for name in reversed(log.channels)})


Logs = Sequence[Log]
RELATIONS: dict[str, Callable[[Logs, float], Logs]] = {
    "turned": lambda logs, by: [turned(log, by) for log in logs],
    "moved": lambda logs, by: [
        changed(log, x=log["x"] + 100.0 * by, y=log["y"] - 70.0 * by) for log in logs
    ],
    "later": lambda logs, by: [log.replace(t=log.t + 64.0 * np.round(8.0 * by)) for log in logs],
    "columns in another order": lambda logs, by: [ordered(log) for log in logs],
    "a channel more": lambda logs, by: [with_more(log, by) for log in logs],
    "mirrored": lambda logs, by: [mirrored(log) for log in logs],
    "twice": lambda logs, by: [*logs, *logs],
    "in another order": lambda logs, by: logs[::-1],
}


@pytest.mark.parametrize("name", RELATIONS)
@given(vessel=vessels, by=st.floats(-3.0, 3.0))
@drawn
def test_inspection_and_fit_are_invariant_to_equivalent_logs(
    name: str, vessel: tuple[str, int], by: float
) -> None:
    logs = logs_of(vessel)
    inputs = inputs_of(logs[0])
    one, other = (prepared(each, inputs) for each in (logs, RELATIONS[name](logs, by)))
    side = np.array([1.0, -1.0, -1.0]) if name == "mirrored" else 1.0
    ends = np.cumsum([len(log) for log in logs[::-1]])[:-1]
    # inputs stand behind the velocities; those of a mirrored vessel are others
    columns = slice(3) if name == "mirrored" else slice(None)
    for first, second in (
        (one.z[:, columns], other.z[:, columns]),
        (one.target, other.target),
        (fitted(one), fitted(other)),
    ):
        again = np.asarray(second)
        if name == "in another order":
            again = np.concatenate(np.split(again, ends)[::-1])
        now = np.asarray(first) * side
        np.testing.assert_allclose(again[: len(now)], now, rtol=EXACT, atol=EXACT)


@given(vessel=vessels, share=st.floats(0.3, 0.7))
@drawn
def test_fit_of_a_split_log_equals_that_of_the_log(vessel: tuple[str, int], share: float) -> None:
    """Within half a window of an end, the derivative is that of the last whole window."""
    log = logs_of(vessel)[1]
    inputs = inputs_of(log)
    at = round(share * len(log))
    whole = prepared([log], inputs)
    parts = prepared([log.select_rows(slice(0, at)), log.select_rows(slice(at, None))], inputs)
    assert len(parts.z) == len(whole.z) == len(log)
    away = np.abs(np.arange(len(log)) - at + 0.5) > WINDOW / 2
    assert away.sum() == len(log) - WINDOW
    for one, other in ((parts.z, whole.z), (parts.target, whole.target)):
        np.testing.assert_allclose(one[away], other[away], rtol=EXACT, atol=EXACT)


@given(vessel=vessels, data=st.data())
@drawn
def test_readers_are_invariant_to_units_and_column_order(
    vessel: tuple[str, int], data: st.DataObject
) -> None:
    log = logs_of(vessel)[2]
    table = {"t": log.t - log.t[0]}
    channels = {}
    for name in data.draw(st.permutations([*log.channels])):
        alike = [unit for unit in unit_names() if si_unit(unit) == log.units[name]]
        unit = data.draw(st.sampled_from(alike))
        table[f"the {name}"] = log[name] / to_si(unit, log.units[name])
        channels[name] = {"column": f"the {name}", "unit": unit}
    columns = data.draw(st.permutations([*table]))
    settings = {"kind": "csv", "time": {"column": "t"}, "channels": channels}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        pd.DataFrame(table)[columns].to_csv(path, index=False)
        read = validate_config(settings, ReaderConfig, "test").build().read(path)
    for name in log.channels:
        apart = read[name] - log[name]
        apart -= 2.0 * np.pi * np.round(apart / (2.0 * np.pi)) * (name == "psi")
        size = max(1.0, float(np.abs(log[name]).max()))
        assert np.abs(apart).max() <= EXACT * size, name


def sailed(rows: int, helm: float) -> Log:
    """A boat that weaves at 10 Hz, its rate late by .6 s, with a jump and spikes in it; with a mean
    rudder angle `helm` in rad it turns round many times.
    """
    random = np.random.default_rng(3)
    t = 0.1 * np.arange(rows)
    delta = helm + 0.3 * np.sign(np.sin(0.11 * t) + 0.4 * np.sin(0.041 * t))
    r, u = np.zeros(rows), 4.0 + 0.5 * np.sin(0.013 * t)
    for k in range(rows - 1):
        r[k + 1] = r[k] + 0.1 * (0.4 * delta[k] - r[k])
    v = -2.0 * r
    psi = np.append(0.0, np.cumsum(0.05 * (r[1:] + r[:-1])))
    ground = (u + 1j * v) * np.exp(1j * psi)
    place = np.append(0.0, np.cumsum(0.05 * (ground[1:] + ground[:-1])))
    place[rows // 3 :] += 30.0
    late = np.interp(t - 0.6, t, r)
    channels = {"x": place.real, "y": place.imag, "psi": psi, "u": u, "v": v, "r": late}
    size = {"x": 0.05, "y": 0.05, "psi": 3e-3, "u": 0.02, "v": 0.02, "r": 3e-3}
    channels = {n: x + size[n] * random.standard_normal(rows) for n, x in channels.items()}
    channels["u"][[rows // 5, rows // 2]] += 5.0
    return Log("long", t, {**channels, "delta": delta})


@pytest.mark.parametrize(("helm", "gap"), [(0.03, 0), (0.0, 900)])
def test_inspect_log_of_a_long_log_equals_that_of_its_subsample(
    monkeypatch: pytest.MonkeyPatch, helm: float, gap: int
) -> None:
    from residnet.preprocessing import channel_values as channels
    from residnet.quality import inspect_log, statistics

    log = sailed(24_000 + gap, helm)
    # far from the stretches
    log = log.select_rows(np.r_[0:8_500, 8_500 + gap : len(log)])
    whole = inspect_log(log, ["delta"])
    monkeypatch.setattr(statistics, "_MAX_SUBSAMPLE", 12_000)
    monkeypatch.setattr(channels, "_MAX_SUBSAMPLE", 6_000)
    few = statistics.LogStatistics(log).subsample
    assert len(few) == 12_000
    assert np.flatnonzero(np.isnan(few["r"])).tolist() == list(range(0, 12_000, 2_400))
    told = inspect_log(log, ["delta"])
    assert [(one.level, one.code) for one in told.findings] == [
        (one.level, one.code) for one in whole.findings
    ]
    assert {"lag", "position_jump", "spikes"} <= {one.code for one in told.findings}
    for one, other in zip(told.findings, whole.findings, strict=True):
        assert (one.sample_mask is None) == (other.sample_mask is None)
        if one.sample_mask is not None and other.sample_mask is not None:
            assert np.mean(one.sample_mask != other.sample_mask) < 1e-3
        size = {name: one.figures[name] for name in {"size", "count"} & {*one.figures}}
        assert size == pytest.approx(
            {name: other.figures[name] for name in size}, rel=0.1, abs=0.02
        )


def test_finding_effects_of_a_repair_use_the_subsample(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from residnet.quality import Finding, statistics
    from residnet.quality.effects import FindingEffects

    log, off = sailed(24_000, 0.0), 0.3
    log = log.replace(channels={**log.channels, "psi": log["psi"] + off})

    def repair(log: Log) -> Log:
        return log.replace(channels={**log.channels, "psi": log["psi"] - off})

    finding = Finding("will mislead", "heading", "", repair=repair)
    found = []
    for longest in (12_000, 30_000):
        monkeypatch.setattr(statistics, "_MAX_SUBSAMPLE", longest)
        effects = FindingEffects(statistics.LogStatistics(log, ["delta"]))
        found.append(effects.measure(finding).effect)
    assert found[0] == pytest.approx(found[1], rel=0.2)
    assert found[1] == pytest.approx(2.0 * np.sin(off / 2.0), rel=0.5)
