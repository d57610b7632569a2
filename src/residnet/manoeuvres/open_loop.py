"""Manoeuvres of demands that are known in advance: steps, levels, random steps, sines, replays.

Source: Woo et al. 2018, section 4.2.2.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, PrivateAttr, model_validator

from residnet.core.config import Config, ExistingPath, Hertz, Seconds
from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.core.names import STATE_NAMES, VELOCITY_NAMES, suggest_name
from residnet.manoeuvres.base import (
    Helm,
    Manoeuvre,
    ManoeuvreFamily,
    Range,
    ScheduledManoeuvre,
    require_dive,
    sample_uniform,
)
from residnet.physics.plant_channels import PlantChannels

if TYPE_CHECKING:
    from torch import Tensor

    from residnet.engine.rollout import Source


class ConstantInput(ScheduledManoeuvre):
    """Constant propulsion and steering commands, for steady speeds and turns.

    Attributes:
        drive: fraction of the full propulsion command, -1 to 1.
        steer: fraction of the full steering command, -1 to 1; positive turns to starboard.
    """

    kind: Literal["constant"] = "constant"
    drive: float = Field(ge=-1, le=1)
    steer: float = Field(ge=-1, le=1)

    def demands_at(self, t: Tensor) -> tuple[Tensor, Tensor]:
        import torch

        return torch.full_like(t, self.drive), torch.full_like(t, self.steer)


class ConstantFamily(Config):
    """All combinations of several propulsion and steering commands.

    Attributes:
        drive: fractions of the full propulsion command, -1 to 1.
        steer: fractions of the full steering command, -1 to 1.
    """

    kind: Literal["constant"] = "constant"
    drive: tuple[float, ...] = Field(min_length=1)
    steer: tuple[float, ...] = Field(min_length=1)

    def sample_all(self, generator: np.random.Generator, duration: float) -> list[Manoeuvre]:
        """Return one manoeuvre per combination, without random draws."""
        return [ConstantInput(drive=d, steer=s) for d, s in product(self.drive, self.steer)]


class AccelerationDeceleration(ScheduledManoeuvre):
    """Steps of the propulsion command straight ahead.

    Attributes:
        times: start of each level in s, ascending.
        levels: fraction of the full propulsion command of each level, -1 to 1.
    """

    kind: Literal["acceleration_deceleration"] = "acceleration_deceleration"
    times: tuple[Seconds, ...] = Field(min_length=1)
    levels: tuple[float, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _check_levels(self) -> AccelerationDeceleration:
        if len(self.times) != len(self.levels) or list(self.times) != sorted(self.times):
            raise ValueError("times and levels need the same number of entries, times ascending")
        return self

    def demands_at(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return the stepped propulsion command [T] and a zero steering command [T].

        The propulsion command is zero before the first time.
        """
        import torch

        index = torch.searchsorted(torch.tensor(self.times, dtype=t.dtype), t, right=True)
        return torch.tensor((0.0, *self.levels), dtype=t.dtype)[index], torch.zeros_like(t)


class AccelerationDecelerationFamily(ManoeuvreFamily):
    """Random steps between a high and a low level, each drawn uniformly in its range.

    High and low levels alternate. The first high level is the drawn one, the next two are 3/4 and
    1/2 of it, and so on in turn.

    Attributes:
        high: range of the high level of the propulsion command.
        low: range of the low level of the propulsion command.
        hold: range of the time for which a level is held in s.
    """

    kind: Literal["acceleration_deceleration"] = "acceleration_deceleration"
    high: Range = (0.4, 1.0)
    low: Range = (0.0, 0.3)
    hold: tuple[Seconds, Seconds] = (6.0, 12.0)

    def sample_one(self, generator: np.random.Generator, duration: float) -> Manoeuvre:
        level_index = np.arange(int(duration / self.hold[0]) + 2)
        high_level = sample_uniform(generator, self.high)
        low_level = sample_uniform(generator, self.low)
        hold_times = generator.uniform(*self.hold, size=level_index.size)
        times = np.concatenate(([0.0], np.cumsum(hold_times)[:-1]))
        peaks = high_level * np.array([1.0, 0.75, 0.5])[(level_index // 2) % 3]
        levels = np.where(level_index % 2 == 0, peaks, low_level)
        is_within = times < duration
        return AccelerationDeceleration(
            times=tuple(times[is_within].tolist()), levels=tuple(levels[is_within].tolist())
        )


_STEP_PATTERN = (1.0, 1.0, 1.0, -1.0, -1.0, 1.0, -1.0)
"""Sign of the steering in each unit of the 3-2-1-1 pattern."""


class ThreeTwoOneOne(ScheduledManoeuvre):
    """The 3-2-1-1 pattern: steering steps of 3, 2, 1 and 1 units to alternating sides.

    The pattern excites a broad band of frequencies. The steering command is zero afterwards.

    Attributes:
        drive: fraction of the full propulsion command, -1 to 1.
        steer: fraction of the full steering command, -1 to 1; positive turns to starboard first.
        start: time at which the steering begins in s, after an approach straight ahead.
        unit: duration of the shortest step in s.
        repeat: whether the pattern is repeated until the end.
    """

    kind: Literal["three_two_one_one"] = "three_two_one_one"
    drive: float = Field(ge=-1, le=1)
    steer: float = Field(ge=-1, le=1)
    start: Seconds = Field(default=5.0, ge=0)
    unit: Seconds = Field(gt=0)
    repeat: bool = True

    def demands_at(self, t: Tensor) -> tuple[Tensor, Tensor]:
        import torch

        # rounding of the grid times must not select the previous unit
        unit_index = torch.floor((t - self.start) / self.unit + 1e-9).long()
        pattern = torch.tensor(_STEP_PATTERN, dtype=t.dtype)
        steer = self.steer * pattern[unit_index.clamp(min=0) % len(_STEP_PATTERN)]
        is_active = (unit_index >= 0) & (self.repeat | (unit_index < len(_STEP_PATTERN)))
        return torch.full_like(t, self.drive), torch.where(is_active, steer, torch.zeros_like(t))


class ThreeTwoOneOneFamily(ManoeuvreFamily):
    """Repeated 3-2-1-1 manoeuvres with unit and commands uniform in their ranges.

    Attributes:
        unit: range of the shortest step in s.
        steer: range of the fraction of the full steering command.
        drive: range of the fraction of the full propulsion command.
        start: time at which the steering begins in s.
    """

    kind: Literal["three_two_one_one"] = "three_two_one_one"
    unit: tuple[Seconds, Seconds] = (2.0, 4.0)
    steer: Range = (0.4, 1.0)
    drive: Range = (0.1, 0.9)
    start: Seconds = 5.0

    def sample_one(self, generator: np.random.Generator, duration: float) -> Manoeuvre:
        unit, steer, drive = (
            sample_uniform(generator, limits) for limits in (self.unit, self.steer, self.drive)
        )
        return ThreeTwoOneOne(unit=unit, steer=steer, drive=drive, start=self.start)


def _check_band(band: tuple[float, float]) -> tuple[float, float]:
    if not 0 < band[0] < band[1]:
        raise ValueError(
            "a band needs a lower and a higher frequency above zero, got"
            f" {band[0]:g} Hz to {band[1]:g} Hz"
        )
    return band


FrequencyBand = Annotated[tuple[Hertz, Hertz], AfterValidator(_check_band)]
"""Lowest and highest frequency."""
# indices of the independent random waves of a manoeuvre: one for each demand, then one for each
# command of the vessel; they select the random numbers of a wave
_DRIVE, _STEER, _SWAY, _DIVE, _FIRST_COMMAND_WAVE = range(5)


class Excitation(ScheduledManoeuvre, ABC):
    """Random demands over a band of frequencies.

    Attributes:
        drive: mean propulsion command.
        drive_amplitude: largest deviation of the propulsion command from its mean.
        steer_amplitude: largest steering command to either side.
        sway_amplitude: largest sway force to either side as a share of its limit, for vessels whose
            commands are forces.
        dive_amplitude: largest dive to either side, for vessels that dive.
        own_amplitude: amplitude of an additional independent wave of each command, as a share of
            the full steering command, which makes the effects of several thrusters distinguishable.
        band: frequencies that are excited.
        seed: seed of the random waves.
        start: time at which the waves begin, after an approach with the mean propulsion command.
    """

    drive: float = Field(ge=-1, le=1)
    drive_amplitude: float = Field(default=0.0, ge=0, le=2)
    steer_amplitude: float = Field(default=0.0, ge=0, le=1)
    sway_amplitude: float = Field(default=0.0, ge=0, le=1)
    dive_amplitude: float = Field(default=0.0, ge=0, le=1)
    own_amplitude: float = Field(default=0.0, ge=0, le=1)
    band: FrequencyBand
    seed: int = Field(default=0, ge=0)
    start: Seconds = Field(default=5.0, ge=0)

    @abstractmethod
    def _demand_wave(self, t: Tensor, wave_index: int) -> Tensor:
        """Return a wave [T] between -1 and 1 at times t [T] since the start in s."""

    def _delayed_wave(self, t: Tensor, wave_index: int) -> Tensor:
        """Return a wave [T] at times t [T] in s, zero before the start."""
        import torch

        wave = self._demand_wave((t - self.start).clamp(min=0.0), wave_index)
        return torch.where(t >= self.start - 1e-9, wave, torch.zeros_like(t))

    def demands_at(self, t: Tensor) -> tuple[Tensor, Tensor]:
        drive = self.drive + self.drive_amplitude * self._delayed_wave(t, _DRIVE)
        return drive.clamp(-1.0, 1.0), self.steer_amplitude * self._delayed_wave(t, _STEER)

    def check_vessel(self, channels: PlantChannels) -> None:
        if self.dive_amplitude:
            require_dive(can_dive=channels.can_dive)
        if self.sway_amplitude:
            _require_side_force(channels.max_side_force, channels.input_names)

    @classmethod
    def build_source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        """Return the source of the demands, with sway forces and waves of single commands if any.

        Raises:
            UsageError: if a sway force is demanded of a vessel whose commands are not forces.
        """
        import torch

        from residnet.manoeuvres.sources import ScheduleSource

        excitations = [manoeuvre for manoeuvre in manoeuvres if isinstance(manoeuvre, Excitation)]
        drive, steer = map(torch.stack, zip(*(m.demands_at(t) for m in excitations), strict=True))
        dive = torch.stack([m.dive_amplitude * m._delayed_wave(t, _DIVE) for m in excitations])
        commands = helm.commands_for(drive, steer, *([dive] if bool(dive.any()) else []))
        sway = torch.stack([m.sway_amplitude * m._delayed_wave(t, _SWAY) for m in excitations])
        if bool(sway.any()):
            max_side_force = _require_side_force(helm.side_force, helm.inputs)
            commands[..., helm.inputs.index("tau_y")] += max_side_force * sway
        if any(m.own_amplitude for m in excitations):
            full_commands = helm.demand(
                torch.zeros_like(steer[0, :1]), torch.ones_like(steer[0, :1])
            ).abs()
            if helm.dive_commands is not None:
                full_commands = torch.maximum(full_commands, helm.dive_commands.abs())
            # the amplitude is relative to the full steering command or full dive command
            for i in range(commands.shape[-1]):
                waves = [
                    m.own_amplitude * m._delayed_wave(t, _FIRST_COMMAND_WAVE + i)
                    for m in excitations
                ]
                commands[..., i] += full_commands[0, i] * torch.stack(waves)
        return ScheduleSource(commands)


def _require_side_force(max_side_force: float | None, input_names: Sequence[str]) -> float:
    """Return the largest sway force in N.

    Raises:
        UsageError: if the commands of the vessel are no forces.
    """
    if max_side_force is None or "tau_y" not in input_names:
        raise UsageError(
            "sway_amplitude: a manoeuvre demands a sway force, but the commands of the"
            f" vessel, {', '.join(input_names[:2])}, are not forces; remove it"
        )
    return max_side_force


class RandomSteps(Excitation):
    """Steps of propulsion and steering commands to random levels.

    Levels are uniform within their amplitudes and last for half a period of a random frequency in
    the band.
    """

    kind: Literal["random_steps"] = "random_steps"

    def _demand_wave(self, t: Tensor, wave_index: int) -> Tensor:
        import torch

        generator = np.random.default_rng([self.seed, wave_index])
        duration = float(t[-1])
        times = [0.0]
        levels = [generator.uniform(-1.0, 1.0)]
        while times[-1] <= duration:
            times.append(times[-1] + 0.5 / generator.uniform(*self.band))
            levels.append(generator.uniform(-1.0, 1.0))
        # index of the last switching time before each sample; the tolerance is for rounding
        index = torch.searchsorted(torch.tensor(times, dtype=t.dtype), t + 1e-9, right=True) - 1
        return torch.tensor(levels, dtype=t.dtype)[index]


class MultiSine(Excitation):
    """Sums of sines at frequencies with logarithmic spacing in the band.

    The demands have different frequencies, so that they are uncorrelated. Of 20 random sets of
    phases, the one with the lowest peak over ten periods of the lowest frequency is used, so that
    the signal has the largest energy for its amplitude. Later values beyond this peak are clipped.

    Attributes:
        tones: number of frequencies of each demand.
    """

    kind: Literal["multi_sine"] = "multi_sine"
    tones: int = Field(default=8, ge=2, le=200)

    def _demand_wave(self, t: Tensor, wave_index: int) -> Tensor:
        import torch

        # frequencies are assigned to the demands in turn
        n_demands = 3 if self.sway_amplitude else 2
        n_demands = max(n_demands, wave_index + 1)
        frequencies = np.geomspace(*self.band, n_demands * self.tones)[
            wave_index % n_demands :: n_demands
        ]
        generator = np.random.default_rng([self.seed, wave_index])
        # the sampling resolves the highest frequency with 20 samples per period
        trial_times = np.arange(
            0.0, 10.0 / self.band[0], min(0.05 / self.band[1], 0.005 / self.band[0])
        )
        angle = 2.0 * math.pi * trial_times[:, None] * frequencies
        best_phases = np.zeros(self.tones)
        lowest_peak = math.inf
        for _ in range(20):
            phases = generator.uniform(0.0, 2.0 * math.pi, self.tones)
            peak = float(np.abs(np.sin(angle + phases).sum(axis=1)).max())
            if peak < lowest_peak:
                best_phases = phases
                lowest_peak = peak
        frequency_tensor, phase_tensor = (
            torch.from_numpy(part).to(t.dtype) for part in (frequencies, best_phases)
        )
        argument = 2.0 * math.pi * t.unsqueeze(-1) * frequency_tensor + phase_tensor
        return (torch.sin(argument).sum(-1) / lowest_peak).clamp(-1.0, 1.0)


class ExcitationFamily(ManoeuvreFamily):
    """Random excitations, whose means and amplitudes are uniform in their ranges.

    Attributes:
        drive: range of the mean propulsion command.
        drive_amplitude: range of the amplitude of the propulsion command.
        steer_amplitude: range of the amplitude of the steering command.
        sway_amplitude: range of the amplitude of the sway force as a share of its limit, for
            vessels whose commands are forces.
        dive_amplitude: range of the amplitude of the dive, for vessels that dive.
        own_amplitude: range of the amplitude of an independent wave of each command.
        band: lowest and highest excited frequency in Hz.
        start: time at which the waves begin in s.
    """

    drive: Range = (0.3, 0.7)
    drive_amplitude: Range = (0.0, 0.3)
    steer_amplitude: Range = (0.2, 1.0)
    sway_amplitude: Range = (0.0, 0.0)
    dive_amplitude: Range = (0.0, 0.0)
    own_amplitude: Range = (0.0, 0.0)
    band: FrequencyBand = (0.02, 0.2)
    start: Seconds = 5.0

    def _sample_common(self, generator: np.random.Generator) -> dict[str, Any]:
        """Draw the settings that all kinds of excitation have in common."""
        settings: dict[str, Any] = {
            name: sample_uniform(generator, getattr(self, name))
            for name in ("drive", "drive_amplitude", "steer_amplitude")
        }
        settings |= {"band": self.band, "seed": int(generator.integers(2**31)), "start": self.start}
        # unused amplitudes are not drawn, so that the random numbers of earlier configs are
        # unchanged
        for name in ("sway_amplitude", "dive_amplitude", "own_amplitude"):
            if getattr(self, name)[1] > 0:
                settings[name] = sample_uniform(generator, getattr(self, name))
        return settings


class RandomStepsFamily(ExcitationFamily):
    """Random steps with means and amplitudes uniform in their ranges."""

    kind: Literal["random_steps"] = "random_steps"

    def sample_one(self, generator: np.random.Generator, duration: float) -> Manoeuvre:
        return RandomSteps.model_validate(self._sample_common(generator))


class MultiSineFamily(ExcitationFamily):
    """Multi-sines with means and amplitudes uniform in their ranges.

    Attributes:
        tones: number of frequencies of each demand.
    """

    kind: Literal["multi_sine"] = "multi_sine"
    tones: int = Field(default=8, ge=2, le=200)

    def sample_one(self, generator: np.random.Generator, duration: float) -> Manoeuvre:
        return MultiSine.model_validate(self._sample_common(generator) | {"tones": self.tones})


class Replay(Manoeuvre):
    """Replay of recorded inputs with zero-order hold, from the recorded initial state.

    It lasts as long as the log, or `duration` if that is shorter.

    Attributes:
        log: file of the log, canonical or in a format that the reader of the task reads.
        channels: channel of the log for an input or state of the vessel, by the name of the latter,
            if the names differ (`{cmd_port: n_port}` replays measured revolutions as commands).
    """

    kind: Literal["replay"] = "replay"
    log: ExistingPath
    channels: dict[str, str] = Field(default_factory=dict)
    _recorded: Log | None = PrivateAttr(default=None)

    def use_log(self, log: Log) -> None:
        """Set the log, which was read before, instead of reading the file."""
        self._recorded = log

    @property
    def recorded(self) -> Log:
        """The log that is replayed.

        Raises:
            UsageError: if the file is not canonical and was not read before.
        """
        if self._recorded is None:
            self._recorded = Log.load(self.log)
        return self._recorded

    def recorded_values(self, name: str) -> np.ndarray | None:
        """Return the channel [T] of the log for an input or state of the vessel; None without one.

        Raises:
            UsageError: if `channels` names a channel that the log does not have.
        """
        channel = self.channels.get(name, name)
        if channel in self.recorded.channels:
            return self.recorded[channel]
        if name in self.channels:
            raise UsageError(
                f"replay.channels: log {self.recorded.name} has no channel"
                f" '{channel}'{suggest_name(channel, self.recorded.channels)}"
            )
        return None

    def duration_within(self, duration: float) -> float:
        """Return the duration of the log in s, or `self.duration` if that is shorter."""
        log_duration = float(self.recorded.t[-1] - self.recorded.t[0])
        return log_duration if self.duration is None else min(log_duration, self.duration)

    def initial_state(self, x: Tensor, state: tuple[str, ...]) -> Tensor:
        """Return the state [nx] at the first sample of the log.

        States that the log does not have are those of x [nx].

        Raises:
            UsageError: if the log lacks position, heading or a velocity.
            DataError: if one of them has no value.
        """
        initial_state = x.clone()
        for i, name in enumerate(state):
            values = self.recorded_values(name)
            if values is not None:
                finite_samples = np.flatnonzero(np.isfinite(values))
                if finite_samples.size == 0:
                    raise DataError(
                        f"log {self.recorded.name}: channel '{name}' is empty; a replay needs its"
                        " first value"
                    )
                initial_state[i] = float(values[finite_samples[0]])
            elif name in STATE_NAMES:
                raise UsageError(
                    f"log {self.recorded.name}: no channel '{name}', which a replay needs for its"
                    f" initial state{suggest_name(name, self.recorded.channels)}"
                )
        return initial_state

    def recorded_inputs(self, helm: Helm, t: Tensor) -> Tensor:
        """Return the inputs [T, m] at times t [T].

        Exogenous inputs that the log does not have are NaN.

        Raises:
            UsageError: if the log lacks a command.
        """
        import torch

        no_demand = torch.zeros(1, dtype=torch.float64)
        n_commands = helm.demand(no_demand, no_demand).shape[-1]
        log_time = self.recorded.t - self.recorded.t[0]
        input_values = np.full((t.numel(), len(helm.inputs)), np.nan)
        for i, name in enumerate(helm.inputs):
            values = self.recorded_values(name)
            if values is None and i < n_commands:
                raise UsageError(
                    f"log {self.recorded.name}: no channel '{name}', a command of the vessel; map"
                    " one of its channels to it in replay.channels:"
                    f" {', '.join(self.recorded.channels)}"
                )
            if values is not None and np.isfinite(values).any():
                is_known = np.isfinite(values)
                sample_index = (
                    # zero-order hold: the last recorded value before each step
                    np.searchsorted(log_time[is_known], t.numpy() + 1e-9, side="right") - 1
                )
                input_values[:, i] = values[is_known][sample_index.clip(min=0)]
        return torch.from_numpy(input_values)

    def compute_indices(self, log: Log, length: float | None = None) -> dict[str, Any]:
        """Return the errors of the motion relative to the recorded one.

        These are the root mean square errors of u, v and r, and the final errors of position and
        heading.
        """
        log_time = self.recorded.t - self.recorded.t[0]
        errors: dict[str, np.ndarray] = {}
        for name in STATE_NAMES:
            values = self.recorded_values(name)
            assert values is not None, "initial_state requires it"
            is_known = np.isfinite(values)
            errors[name] = log[name] - np.interp(
                log.t - log.t[0], log_time[is_known], values[is_known]
            )
        velocity_errors: dict[str, Any] = {
            f"rmse_{name}": float(np.sqrt(np.mean(errors[name] ** 2))) for name in VELOCITY_NAMES
        }
        distance = float(np.hypot(errors["x"][-1], errors["y"][-1]))
        return velocity_errors | {
            "position_error_end": distance,
            "heading_error_end": float(abs((errors["psi"][-1] + np.pi) % (2 * np.pi) - np.pi)),
        }

    @classmethod
    def build_source(cls, manoeuvres: Sequence[Manoeuvre], helm: Helm, t: Tensor) -> Source:
        import torch

        from residnet.manoeuvres.sources import RecordedSource

        return RecordedSource(
            torch.stack([m.recorded_inputs(helm, t) for m in manoeuvres if isinstance(m, Replay)])
        )
