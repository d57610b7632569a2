"""Replay: the inputs of a recorded log from its initial state, on any plant or learned model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, final

import numpy as np
import torch
from pydantic import Field, PrivateAttr
from torch import Tensor

from residnet.core.config import ExistingPath
from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.core.names import STATE, VELOCITY, nearest
from residnet.dynamics.rollout import Source
from residnet.manoeuvres.base import Helm, Manoeuvre


class Replay(Manoeuvre):
    """The recorded inputs, each held until the next sample, from the recorded initial state.

    It lasts as long as the log unless `duration` is less.

    Attributes:
        log: file of the log; canonical, or any that the reader of the programme reads.
        channels: channel of the log that is taken for an input or state of the vessel, by the
            latter's name; the one of the same name where absent (`{cmd_port: n_port}` replays
            measured revolutions as commands).
    """

    kind: Literal["replay"] = "replay"
    log: ExistingPath
    channels: dict[str, str] = Field(default_factory=dict)
    _recorded: Log | None = PrivateAttr(default=None)

    def take(self, log: Log) -> None:
        """Take a log that was read already."""
        self._recorded = log

    @property
    def recorded(self) -> Log:
        """The log that is replayed.

        Raises:
            UsageError: where the file is not canonical and was not read before.
        """
        if self._recorded is None:
            self._recorded = Log.load(self.log)
        return self._recorded

    def channel(self, name: str) -> np.ndarray | None:
        """Return what the log has for an input or state of the vessel, [T].

        None where it has nothing.

        Raises:
            UsageError: where `channels` names a channel that the log does not have.
        """
        channel = self.channels.get(name, name)
        if channel in self.recorded.channels:
            return self.recorded[channel]
        if name in self.channels:
            raise UsageError(
                f"replay.channels: log {self.recorded.name} has no channel"
                f" '{channel}'{nearest(channel, self.recorded.channels)}"
            )
        return None

    def lasts(self, duration: float) -> float:
        """Return the seconds that the log lasts, or `self.duration` where that is less."""
        span = float(self.recorded.t[-1] - self.recorded.t[0])
        return span if self.duration is None else min(span, self.duration)

    def begin(self, x: Tensor, state: tuple[str, ...]) -> Tensor:
        """Return the state [nx] at the log's first sample.

        What the log does not have stays as it is in x [nx].

        Raises:
            UsageError: where the log lacks position, heading or a velocity.
            DataError: where the first sample of one is empty.
        """
        out = x.clone()
        for i, name in enumerate(state):
            values = self.channel(name)
            if values is not None:
                filled = np.flatnonzero(np.isfinite(values))
                if filled.size == 0:
                    raise DataError(
                        f"log {self.recorded.name}: channel '{name}' is empty; a replay starts from"
                        " its first value"
                    )
                out[i] = float(values[filled[0]])
            elif name in STATE:
                raise UsageError(
                    f"log {self.recorded.name}: no channel '{name}', which a replay starts"
                    f" from{nearest(name, self.recorded.channels)}"
                )
        return out

    def inputs(self, helm: Helm, t: Tensor) -> Tensor:
        """Return the inputs [T, m] at times t [T].

        Exogenous columns that the log does not have are NaN.

        Raises:
            UsageError: where the log lacks a command.
        """
        no_demand = torch.zeros(1, dtype=torch.float64)
        commands = helm.demand(no_demand, no_demand).shape[-1]
        clock = self.recorded.t - self.recorded.t[0]
        out = np.full((t.numel(), len(helm.inputs)), np.nan)
        for i, name in enumerate(helm.inputs):
            values = self.channel(name)
            if values is None and i < commands:
                raise UsageError(
                    f"log {self.recorded.name}: no channel '{name}', which the vessel is commanded"
                    " with; name one that it has in replay.channels; it has"
                    f" {', '.join(self.recorded.channels)}"
                )
            if values is not None and np.isfinite(values).any():
                known = np.isfinite(values)
                at = np.searchsorted(clock[known], t.numpy() + 1e-9, side="right") - 1
                out[:, i] = values[known][at.clip(min=0)]
        return torch.from_numpy(out)

    def indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        """Return how far the motion is from the recorded one.

        These are root mean square errors of u, v, r, and the errors of position and heading at the
        end.
        """
        clock = self.recorded.t - self.recorded.t[0]
        errors: dict[str, np.ndarray] = {}
        for name in STATE:
            values = self.channel(name)
            assert values is not None, "a replay does not begin without it"
            known = np.isfinite(values)
            errors[name] = log[name] - np.interp(log.t - log.t[0], clock[known], values[known])
        found: dict[str, Any] = {
            f"rmse_{name}": float(np.sqrt(np.mean(errors[name] ** 2))) for name in VELOCITY
        }
        distance = float(np.hypot(errors["x"][-1], errors["y"][-1]))
        return found | {
            "position_error_end": distance,
            "heading_error_end": float(abs((errors["psi"][-1] + np.pi) % (2 * np.pi) - np.pi)),
        }

    @classmethod
    def source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        """Return the playback of the recorded inputs."""
        return RecordedSource(
            torch.stack([m.inputs(helm, t) for m in manoeuvres if isinstance(m, Replay)])
        )


@final
class RecordedSource(Source):
    """A source of given inputs [B, T, m]; where they are NaN, what the surroundings give."""

    def __init__(self, values: Tensor) -> None:
        super().__init__()
        self.values = values

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        given = self.values[:, k].to(w.dtype)
        return torch.where(torch.isnan(given), w, given), memory
