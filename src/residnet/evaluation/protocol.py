"""Protocols, which define the windows of free runs, and scales of the errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from residnet.core.config import Config, Metres, MetresPerSecond, Radians, RadiansPerSecond, Seconds
from residnet.core.errors import DataError
from residnet.core.layout import PLANAR_LAYOUT, ROLL_LAYOUT, SIX_DOF_LAYOUT
from residnet.core.names import suggest_name
from residnet.core.stretches import find_run_bounds

if TYPE_CHECKING:
    from residnet.preprocessing.prepare import PreparedLog


@dataclass(frozen=True)
class Window:
    """A free run over samples start .. stop-1 of a log, the first of them the initial state.

    Attributes:
        log_index: index of the log.
        start: index of the sample of the initial state.
        stop: index after the last sample.
        history_start: first sample of the measured past that may warm up a memory.
        initial_velocities: initial values of the dynamic states [n].
    """

    log_index: int
    start: int
    stop: int
    history_start: int
    initial_velocities: np.ndarray


class WindowProtocol(Config):
    """A protocol of back-to-back windows of equal length.

    A start on an unusable sample moves to the next usable one; an incomplete window at the end is
    dropped. The initial state is measured.

    Attributes:
        kind: `windows`.
        length: length of a window in s.
        first: start of the first window after the log's start, in s.
        history: measured time before a window that may initialise a memory, in s.
    """

    kind: Literal["windows"] = "windows"
    length: Seconds = Field(gt=0)
    first: Seconds = Field(default=5.0, ge=0)
    history: Seconds = Field(default=5.0, ge=0)

    def make_windows(self, log: PreparedLog, log_index: int, dt: float) -> list[Window]:
        """Return the windows of one log; empty if it is too short."""
        return self._place_windows(log, log_index, dt, self.length)

    def make_overlapping_windows(
        self, log: PreparedLog, log_index: int, dt: float, interval: float | None = None
    ) -> list[Window]:
        """Return windows of the same length with starts every `interval` seconds.

        The default is a quarter of the length. A few logs have too few back-to-back windows for a
        choice between models. An incomplete window at the end of a log is dropped.
        """
        interval = self.length / 4 if interval is None else min(interval, self.length)
        return self._place_windows(log, log_index, dt, interval)

    def _place_windows(
        self, log: PreparedLog, log_index: int, dt: float, interval: float
    ) -> list[Window]:
        """Return windows of a log whose starts are `interval` seconds apart."""
        n_steps = round(self.length / dt)
        start = round(self.first / dt)
        windows = []
        start_stride = max(round(interval / dt), 1)
        _, segment_ends = find_run_bounds(log.segment)
        while start + n_steps < len(log):
            while start < len(log) and not log.usable[start]:
                start += 1
            if start + n_steps >= len(log):
                break
            if segment_ends[start] <= start + n_steps:
                # a gap within the window: inputs are missing there
                start = int(segment_ends[start])
                continue
            # the history must not extend beyond the gap before this segment
            history_start = max(
                start - round(self.history / dt),
                int(np.searchsorted(segment_ends, segment_ends[start])),
            )
            windows.append(
                Window(
                    log_index,
                    start,
                    start + n_steps + 1,
                    history_start,
                    log.y[start, log.dof.dynamic_columns].copy(),
                )
            )
            start += start_stride
        return windows


class ManoeuvreProtocol(Config):
    """A protocol with one free run over each segment of a log without gaps.

    The initial velocities are the mean over the first seconds, which also initialise a memory;
    scoring starts after them. Segments without a usable sample are omitted.

    Attributes:
        kind: `manoeuvre`.
        initial: time over which the initial velocities are averaged, in s.
        shortest: shortest length of a segment, in s; shorter ones are omitted.
    """

    kind: Literal["manoeuvre"] = "manoeuvre"
    initial: Seconds = Field(default=0.5, gt=0)
    shortest: Seconds = Field(default=5.0, gt=0)

    def make_windows(self, log: PreparedLog, log_index: int, dt: float) -> list[Window]:
        """Return one window per segment."""
        n_initial = max(round(self.initial / dt), 1)
        windows = []
        _, segment_ends = find_run_bounds(log.segment)
        segment_start = 0
        while segment_start < len(log):
            if log.segment[segment_start] < 0:
                segment_start += 1
                continue
            segment_stop = int(segment_ends[segment_start])
            if (
                segment_stop - segment_start > max(n_initial + 1, round(self.shortest / dt))
                and log.usable[segment_start + n_initial : segment_stop].any()
            ):
                windows.append(
                    Window(
                        log_index,
                        segment_start + n_initial,
                        segment_stop,
                        segment_start,
                        log.y[
                            segment_start : segment_start + n_initial, log.dof.dynamic_columns
                        ].mean(0),
                    )
                )
            segment_start = segment_stop
        return windows

    def make_overlapping_windows(
        self, log: PreparedLog, log_index: int, dt: float, interval: float | None = None
    ) -> list[Window]:
        """Return the same windows as `make_windows`: a manoeuvre is one free run from its start."""
        return self.make_windows(log, log_index, dt)


ProtocolConfig = Annotated[WindowProtocol | ManoeuvreProtocol, Field(discriminator="kind")]


def longest_segment_length(log: PreparedLog) -> int:
    """Return the number of samples of the longest segment without a gap."""
    return int((find_run_bounds(log.segment)[1] - np.arange(len(log))).max())


def make_windows(
    protocol: WindowProtocol | ManoeuvreProtocol,
    logs: Sequence[PreparedLog],
    dt: float,
    protocol_name: str,
    *,
    is_overlapping: bool = False,
) -> list[Window]:
    """Return the windows of a protocol over several logs.

    Args:
        protocol: the protocol.
        logs: prepared logs.
        dt: time step in s.
        protocol_name: name of the protocol, for the message.
        is_overlapping: whether windows overlap, see `make_overlapping_windows`.

    Raises:
        DataError: if no log is long enough for a window.
    """
    make_log_windows = (
        protocol.make_overlapping_windows if is_overlapping else protocol.make_windows
    )
    windows = [
        window
        for log_index, log in enumerate(logs)
        for window in make_log_windows(log, log_index, dt)
    ]
    if not windows:
        longest_log = max(logs, key=len)
        longest_segment = max(map(longest_segment_length, logs))
        raise DataError(
            f"protocol {protocol_name}: none of {len(logs)} '{logs[0].split}' logs holds a"
            f" window; the longest, {longest_log.log.name}, lasts {len(longest_log) * dt:.1f} s,"
            f" and the longest stretch without a gap {longest_segment * dt:.1f} s; use longer logs,"
            " fill gaps that may be interpolated, or shorten the protocol"
        )
    return windows


class Scales(Config):
    """Scales of the errors, the denominators of the NRMSE: typical spreads of the measured motion.

    Each velocity that the model predicts (`signals.velocities`) has a scale. The same scales apply
    to other logs on which the run is evaluated, so that errors remain comparable.

    Attributes:
        u: scale of the surge velocity in m/s.
        v: scale of the sway velocity in m/s.
        r: scale of the yaw rate in rad/s.
        p: scale of the roll rate in rad/s, for models with roll.
        phi: scale of the roll angle in rad, for models with roll.
        w: scale of the heave velocity in m/s, for models of six degrees of freedom.
        q: scale of the pitch rate in rad/s, for models of six degrees of freedom.
        z: scale of the depth in m, for models of six degrees of freedom.
        theta: scale of the pitch angle in rad, for models of six degrees of freedom.
    """

    u: Annotated[MetresPerSecond, Field(gt=0)] | None = None
    v: Annotated[MetresPerSecond, Field(gt=0)] | None = None
    r: Annotated[RadiansPerSecond, Field(gt=0)] | None = None
    p: Annotated[RadiansPerSecond, Field(gt=0)] | None = None
    phi: Annotated[Radians, Field(gt=0)] | None = None
    w: Annotated[MetresPerSecond, Field(gt=0)] | None = None
    q: Annotated[RadiansPerSecond, Field(gt=0)] | None = None
    z: Annotated[Metres, Field(gt=0)] | None = None
    theta: Annotated[Radians, Field(gt=0)] | None = None

    def to_array(self) -> np.ndarray:
        """Return the scales of the dynamic states as one array [n], SI; 1 without a scale."""
        layout = (
            SIX_DOF_LAYOUT
            if self.w is not None
            else PLANAR_LAYOUT
            if self.p is None
            else ROLL_LAYOUT
        )
        return np.array([self.to_dict().get(name, 1.0) for name in layout.dynamic_states])

    def to_dict(self) -> dict[str, float]:
        """Return the scales by the name of the dynamic state."""
        scales_by_name = {name: getattr(self, name) for name in SIX_DOF_LAYOUT.dynamic_states}
        return {name: float(value) for name, value in scales_by_name.items() if value is not None}


class EvaluationConfig(Config):
    """Settings of the evaluation: protocols and scales.

    Attributes:
        protocols: protocols by name, as in metrics.json.
        selection: the protocol whose mean NRMSE over the validation windows selects models and
            stops training early.
        scales: denominators of the NRMSE.
        groups: named sets of manoeuvre kinds with rows of their own.
        divergence: a free run has diverged if a velocity exceeds this multiple of its largest
            training value.
        splits: splits to evaluate.
    """

    protocols: dict[str, ProtocolConfig] = Field(min_length=1)
    selection: str
    scales: Scales
    groups: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    divergence: float = Field(default=3.0, gt=1)
    splits: tuple[Literal["train", "validation", "test"], ...] = ("train", "validation", "test")

    @model_validator(mode="after")
    def check_names(self) -> EvaluationConfig:
        if self.selection not in self.protocols:
            raise ValueError(
                f"selection '{self.selection}' is not a"
                f" protocol{suggest_name(self.selection, self.protocols)}"
            )
        if "validation" not in self.splits:
            raise ValueError("splits must contain 'validation': models are selected on it")
        return self
