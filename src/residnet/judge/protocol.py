"""What models are judged by: protocols, which stretches of a log they predict, and scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from residnet.core.config import Config, Metres, MetresPerSecond, Radians, RadiansPerSecond, Seconds
from residnet.core.errors import DataError
from residnet.core.layout import PLANAR, ROLL, SIX
from residnet.core.names import nearest
from residnet.core.stretches import stretch_bounds
from residnet.data.prepare import Prepared


@dataclass(frozen=True)
class Window:
    """A free run over samples start .. stop-1 of a log, the first of them the initial state.

    Attributes:
        log: number of the log.
        start: sample of the initial state.
        stop: one past the last sample.
        past: first sample of the measured past that may warm up a memory.
        nu: initially, what moves [n].
    """

    log: int
    start: int
    stop: int
    past: int
    nu: np.ndarray


class Windows(Config):
    """A protocol of back-to-back windows of one length, as for the measured tanker.

    A start on a sample that is not usable moves on to the first that is; an incomplete tail is
    dropped. The initial state is measured.

    Attributes:
        kind: `windows`.
        length: of a window in s.
        first: start of the first window after the log's start, in s.
        history: time before a window that may warm up a memory, in s.
    """

    kind: Literal["windows"] = "windows"
    length: Seconds = Field(gt=0)
    first: Seconds = Field(default=5.0, ge=0)
    history: Seconds = Field(default=5.0, ge=0)

    def windows(self, log: Prepared, number: int, step: float) -> list[Window]:
        """Return the windows of one log; none where it is too short."""
        return self._laid(log, number, step, self.length)

    def overlapping(
        self, log: Prepared, number: int, step: float, every: float | None = None
    ) -> list[Window]:
        """Return windows of the same length that start every so often, in s.

        Every quarter of a length where not given, for choices among models: back-to-back windows of
        a few logs are few; what is left of a log behind the last one tells nothing.
        """
        every = self.length / 4 if every is None else min(every, self.length)
        return self._laid(log, number, step, every)

    def _laid(self, log: Prepared, number: int, step: float, every: float) -> list[Window]:
        steps, start, out = round(self.length / step), round(self.first / step), []
        apart = max(round(every / step), 1)
        _, end = stretch_bounds(log.piece)
        while start + steps < len(log):
            while start < len(log) and not log.usable[start]:
                start += 1
            if start + steps >= len(log):
                break
            if end[start] <= start + steps:
                # a break inside: nothing can be simulated across it
                start = int(end[start])
                continue
            # a break ends the past that may warm up a memory
            past = max(start - round(self.history / step), int(np.searchsorted(end, end[start])))
            out.append(
                Window(
                    number, start, start + steps + 1, past, log.y[start, log.live.columns].copy()
                )
            )
            start += apart
        return out


class WholeManoeuvre(Config):
    """A protocol that takes every uninterrupted stretch of a log as one free run.

    The initial velocities are the mean of the first seconds, which also warm up a memory; scoring
    starts after them. Stretches without a sample to score are left out.

    Attributes:
        kind: `manoeuvre`.
        initial: how long the initial velocities are averaged, in s.
        shortest: shorter stretches are left out, in s.
    """

    kind: Literal["manoeuvre"] = "manoeuvre"
    initial: Seconds = Field(default=0.5, gt=0)
    shortest: Seconds = Field(default=5.0, gt=0)

    def windows(self, log: Prepared, number: int, step: float) -> list[Window]:
        """Return one window per stretch."""
        lead, out = max(round(self.initial / step), 1), []
        _, end = stretch_bounds(log.piece)
        begin = 0
        while begin < len(log):
            if log.piece[begin] < 0:
                begin += 1
                continue
            stop = int(end[begin])
            if (
                stop - begin > max(lead + 1, round(self.shortest / step))
                and log.usable[begin + lead : stop].any()
            ):
                out.append(
                    Window(
                        number,
                        begin + lead,
                        stop,
                        begin,
                        log.y[begin : begin + lead, log.live.columns].mean(0),
                    )
                )
            begin = stop
        return out

    def overlapping(
        self, log: Prepared, number: int, step: float, every: float | None = None
    ) -> list[Window]:
        """Return the windows themselves: a manoeuvre is one free run from its beginning."""
        return self.windows(log, number, step)


ProtocolConfig = Annotated[Windows | WholeManoeuvre, Field(discriminator="kind")]


def longest_stretch(log: Prepared) -> int:
    """Return the samples of the longest stretch without a gap, which no free run goes across."""
    return int((stretch_bounds(log.piece)[1] - np.arange(len(log))).max())


def all_windows(
    protocol: Windows | WholeManoeuvre,
    logs: Sequence[Prepared],
    step: float,
    name: str,
    *,
    dense: bool = False,
) -> list[Window]:
    """Return the windows of a protocol over several logs.

    Args:
        name: of the protocol.
        dense: whether they overlap, see `Windows.overlapping`.

    Raises:
        DataError: where no log is long enough for a single one.
    """
    laid = protocol.overlapping if dense else protocol.windows
    out = [window for number, log in enumerate(logs) for window in laid(log, number, step)]
    if not out:
        longest = max(logs, key=len)
        whole = max(map(longest_stretch, logs))
        raise DataError(
            f"protocol {name}: none of {len(logs)} '{logs[0].split}' logs holds a window; the"
            f" longest, {longest.log.name}, lasts {len(longest) * step:.1f} s, and the longest"
            f" stretch without a gap {whole * step:.1f} s; give longer logs, fill gaps that may be"
            " interpolated, or shorten the protocol"
        )
    return out


class Scales(Config):
    """Scales that nrmse divides by: typical spreads of the measured velocities.

    Other logs that a run is evaluated on are judged by the same scales. Each velocity that the
    model moves (`signals.velocities`) has one.

    Attributes:
        u: of the surge velocity in m/s.
        v: of the sway velocity in m/s.
        r: of the yaw rate in rad/s.
        p: of the roll rate in rad/s, for models that roll.
        phi: of the roll angle in rad, with p.
        w: of the heave velocity in m/s, for models of six degrees of freedom.
        q: of the pitch rate in rad/s, for these.
        z: of the depth in m, for these.
        theta: of the pitch angle in rad, for these.
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

    def array(self) -> np.ndarray:
        """Return the scales of what moves as one array [n], SI; 1 without a scale."""
        layout = SIX if self.w is not None else PLANAR if self.p is None else ROLL
        return np.array([self.named().get(name, 1.0) for name in layout.moving])

    def named(self) -> dict[str, float]:
        """Return the scales by the name of what moves."""
        found = {name: getattr(self, name) for name in SIX.moving}
        return {name: float(value) for name, value in found.items() if value is not None}


class EvaluationConfig(Config):
    """Settings of the evaluation: protocols and scales.

    Attributes:
        protocols: by name; the name stands in metrics.json.
        selection: the protocol whose mean nrmse over the validation windows chooses between models
            and stops training early.
        scales: what nrmse divides by.
        groups: named sets of manoeuvre kinds that get rows of their own.
        divergence: a free run diverges where a velocity exceeds this many times its largest
            training value.
        splits: which splits are evaluated.
    """

    protocols: dict[str, ProtocolConfig] = Field(min_length=1)
    selection: str
    scales: Scales
    groups: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    divergence: float = Field(default=3.0, gt=1)
    splits: tuple[Literal["train", "validation", "test"], ...] = ("train", "validation", "test")

    @model_validator(mode="after")
    def _names(self) -> EvaluationConfig:
        if self.selection not in self.protocols:
            raise ValueError(
                f"selection '{self.selection}' is not a"
                f" protocol{nearest(self.selection, self.protocols)}"
            )
        if "validation" not in self.splits:
            raise ValueError("splits must contain 'validation': models are selected on it")
        return self
