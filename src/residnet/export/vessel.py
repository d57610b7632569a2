"""Exported vessel model: guarded step, model card and parity check of every file.

The file of a format is loaded and compared with the model: 2,000 steps from a warmed-up memory,
tracks with step changes of the inputs, and invalid inputs, states and memories.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from typing import Any, final

import numpy as np
import torch
from torch import Tensor, nn

from residnet.core.errors import ExportError
from residnet.core.layout import SURGE
from residnet.core.progress import log_message
from residnet.core.version import __version__
from residnet.dynamics.domain_config import (
    describe_domain,
)
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.engine.rollout import Rollout, trace_rollout
from residnet.evaluation.records import MetricsRow
from residnet.export import base
from residnet.export.base import Exportable, LoadedExport, NumberArray, RoundingError
from residnet.export.guard import GuardedDynamics, hold_measured
from residnet.export.torchscript import get_size, require_shape, trace_function
from residnet.heads.base import ResidualHead
from residnet.physics.signals_config import SignalsConfig

PARITY_STEPS = 2000
"""Number of steps of the parity check, in which errors of the memory would accumulate."""
PAST_STEPS = 50
"""Number of measured steps from which the memory is initialised."""
_SWEEP_SHARES = (0.8, 0.4, 0.2)
"""Shares of the training range over which all inputs are swept together, tried in this order."""
_N_TRACKS = 16
"""Number of tracks with jumping inputs; eight were found too few to find growing rounding errors.
"""
_STEPS_PER_INPUT = 20
"""Number of steps between jumps of the inputs."""
_FRAME_TEXT = (
    "NED; body axes x forward, y starboard, z down; psi unwrapped, clockwise from north; wind_dir"
    " is where the wind comes from"
)
_BAD_INPUT_RULES = (
    "NaN is replaced by the value under `substitute`, a value outside `state_ranges` by the nearest"
    " value of its training range; a memory that is not finite or outside the bounds of the head is"
    " reset; a next state outside `state_ranges` is limited to them; in all these cases `outside`"
    " is true"
)
_WAVE_LOADS_TEXT = (
    "none: the model has no input for wave loads and computes none; it has the mean"
    " motion of the logs, with or without waves"
)
_BAND_TEXT = (
    "half widths of the {:.3g} % prediction intervals of a free run for each channel, by number of"
    " steps since the measured state, independent of the motion; interpolate between the steps;"
    " beyond the last step they are extrapolated in proportion to time, without calibration; that"
    " of the position is the radius of a circle around the predicted position"
)


_DOMAIN_TEXT = (
    "`outside` is true where a velocity or an input is beyond its training_range, where an input"
    " deviates from its relation by more than the tolerance, and where the density of velocities"
    " and inputs, |F v(z)|^2 with the monomials v of the scaled channels z up to the degree,"
    " exceeds the limit"
)


def _input_role(signals: SignalsConfig, name: str) -> str:
    """Return the role of an input of a model in its model card."""
    if name in signals.unexcited:
        return "unexcited"
    return "command" if name in signals.inputs else "exogenous"


def _describe_domain(spec: ModelSpec) -> dict[str, Any] | None:
    """Return the model card entry on relations and density; None for models without them."""
    domain = spec.domain
    if domain is None:
        return None
    return {
        "about": _DOMAIN_TEXT,
        "in_words": describe_domain(domain, spec.signals.channel_units()),
        "degree": domain.degree,
        **domain.model_dump(mode="json", exclude={"factor"}),
    }


class GuardedVesselModule(nn.Module):
    """The interface of a controller; all tensors are float32, SI and radians.

    Bad inputs and memories give a flag and a finite result (`residnet.export.guard`). Tensors of a
    wrong shape are refused, never broadcast; other precisions are converted.

    TorchScript compiles this class. The code of the model is only traced, so that heads and
    baselines may use Python that TorchScript does not support.
    """

    def __init__(self, model: HybridDynamics, spec: ModelSpec) -> None:
        super().__init__()
        model = copy.deepcopy(model).requires_grad_(False)
        guard = GuardedDynamics(model, spec)
        self.n_inputs = len(spec.signals.input_columns)
        self.n_states = len(spec.signals.dof.state_names)
        self.n_state = model.n_state
        # two rows, since a batch of one would hide mixed-up rows
        sizes = (self.n_states, self.n_inputs, self.n_state)
        examples = tuple(torch.zeros(2, size) for size in sizes)
        what = f"model {spec.name}"
        self.guarded_step = trace_function(guard.flagged_step, examples, what)
        self.next_memory = trace_function(
            lambda x, w, s: model.mark_measured(model.step(x, w, s)[1]), examples, what
        )
        self.ranges = guard.ranges
        self.of_state = guard.state_ranges
        band_table = spec.band
        band_steps = torch.ones(1)
        band_widths = torch.full((1, len(spec.signals.dof.layout.band_channels)), torch.inf)
        if band_table is not None:
            band_steps = torch.tensor(band_table.steps)
            band_widths = torch.tensor(band_table.columns).T
        self.band_steps = nn.Buffer(band_steps)
        self.band_widths = nn.Buffer(band_widths)

    @torch.jit.export
    def band(self, k: int) -> Tensor:
        """Return the half widths [c] k steps after a measurement.

        Channels are u, v, r, heading and position, then p and phi for vessels with roll. The half
        widths are zero at k = 0, grow in proportion to time beyond the calibrated horizon, and are
        infinite for a model without band.
        """
        band_steps = self.band_steps.float()
        band_widths = self.band_widths.float()
        if k <= 0:
            return torch.zeros_like(band_widths[0])
        last_index = band_steps.shape[0] - 1
        if k >= int(band_steps[last_index]):
            return band_widths[last_index] * (float(k) / float(band_steps[last_index]))
        upper_index = int((band_steps <= k).sum())
        fraction = (float(k) - float(band_steps[upper_index - 1])) / float(
            band_steps[upper_index] - band_steps[upper_index - 1]
        )
        return band_widths[upper_index - 1] + fraction * (
            band_widths[upper_index] - band_widths[upper_index - 1]
        )

    @torch.jit.export
    def initial_state(self, batch: int) -> Tensor:
        """Return the memory s [batch, n_state] without a past."""
        return torch.zeros(batch, self.n_state)

    @torch.jit.export
    def warmup(self, y_history: Tensor, w_history: Tensor) -> Tensor:
        """Return the memory s [B, n_state] after a measured past.

        Invalid samples are replaced by the last valid sample before them.

        Args:
            y_history: states [B, T, 3 + n], oldest first.
            w_history: inputs [B, T, m], oldest first.
        """
        n_rows = get_size(y_history, 3, 0)
        n_steps = get_size(y_history, 3, 1)
        require_shape("y_history", y_history, [n_rows, n_steps, self.n_states])
        require_shape("w_history", w_history, [n_rows, n_steps, self.n_inputs])
        s = torch.zeros(n_rows, self.n_state)
        if n_steps == 0 or self.n_state == 0:
            return s
        y, w = y_history.float(), w_history.float()
        good = self.ranges.is_accepted(torch.cat((y, w), dim=-1))
        y, w = hold_measured(y, w, good)
        for k in range(n_steps):
            s = self.next_memory(y[:, k], w[:, k], s)
        known = (good.any(dim=1) & torch.isfinite(s).all(dim=-1)).unsqueeze(-1)
        return torch.where(known, s, torch.zeros_like(s))

    @torch.jit.export
    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the state [B, 3 + n] and memory after one step under inputs w [B, m], and a flag.

        `outside` [B] is True for rows with a velocity or input beyond the training range or outside
        the operating domain, an entry or memory that is not finite, or a corrected result.
        """
        n_rows = get_size(x, 2, 0)
        require_shape("x", x, [n_rows, self.n_states])
        require_shape("w", w, [n_rows, self.n_inputs])
        require_shape("s", s, [n_rows, self.n_state])
        found: tuple[Tensor, Tensor, Tensor] = self.guarded_step(x.float(), w.float(), s.float())
        return found

    @torch.jit.export
    def rollout(self, x0: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Simulate from x0 [B, 3 + n] under inputs w [B, T, m].

        Returns:
            States [B, T+1, 3 + n], memory [B, n_state] after the last step, and the flag `outside`
            [B, T] of each step.
        """
        n_rows = get_size(x0, 2, 0)
        n_steps = get_size(w, 3, 1)
        require_shape("x0", x0, [n_rows, self.n_states])
        require_shape("w", w, [n_rows, n_steps, self.n_inputs])
        require_shape("s", s, [n_rows, self.n_state])
        x, w, s = x0.float(), w.float(), s.float()
        states = [self.of_state.replace_unaccepted(x)]
        flags = [torch.zeros(n_rows, 0, dtype=torch.bool)]
        # the first step gets the original x0, so that its flag shows invalid entries
        for k in range(n_steps):
            x, s, outside = self.guarded_step(x, w[:, k], s)
            states.append(x)
            flags.append(outside.unsqueeze(1))
        return torch.stack(states, dim=1), s, torch.cat(flags, dim=1)

    def forward(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `step` returns."""
        return self.step(x, w, s)


class _GuardedVesselStep(nn.Module):
    """The guarded step, for formats with a single function."""

    def __init__(self, model: HybridDynamics, spec: ModelSpec) -> None:
        super().__init__()
        self.guarded = GuardedDynamics(model, spec)

    def forward(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        next_state, memory, outside = self.guarded.flagged_step(x, w, s)
        # without a memory the step returns its argument, which torch.export does not allow
        return next_state, memory.clone(), outside


@final
class ExportedVessel(Exportable):
    """A vessel model; the given model is not modified.

    Args:
        spec: description of the model.
        model: the model.
        metrics: rows of metrics.json of this model, for the model card.
    """

    results = ("x_after", "s_after", "outside")
    flags = ("outside",)
    methods = ("initial_state", "warmup", "step", "rollout", "band")

    def __init__(
        self, spec: ModelSpec, model: HybridDynamics, metrics: Sequence[MetricsRow] = ()
    ) -> None:
        for submodule in model.modules():
            if isinstance(submodule, ResidualHead) and submodule.export_error:
                raise ExportError(
                    f"model {spec.name}: {submodule.export_error}; export another model"
                )
        self.spec = spec
        self.metrics = metrics
        self.model = copy.deepcopy(model).eval().requires_grad_(False)
        self.name = spec.name
        self.label = f"model {spec.name}"
        self.dt = spec.dt
        self.state_names = spec.signals.dof.state_names
        n_inputs = len(spec.signals.input_columns)
        self.arguments = (("x", len(self.state_names)), ("w", n_inputs), ("s", model.n_state))
        # the reference run is expensive and the same for all formats
        self._reference_runs: dict[torch.dtype, tuple[Tensor, Tensor, Tensor]] = {}
        self._sweep_share = _SWEEP_SHARES[0]

    def to_precision(self, dtype: torch.dtype) -> HybridDynamics:
        """Return a copy of the model with parameters of type `dtype`."""
        return copy.deepcopy(self.model).to(dtype)

    def guard_model(self, dtype: torch.dtype) -> GuardedDynamics:
        """Return a copy of the model whose step is finite for all inputs and flags invalid ones."""
        return GuardedDynamics(self.to_precision(dtype), self.spec).to(dtype).eval()

    def build_module(self, dtype: torch.dtype) -> nn.Module:
        return GuardedVesselModule(self.to_precision(dtype), self.spec).eval()

    def build_step_module(self, dtype: torch.dtype) -> nn.Module:
        return _GuardedVesselStep(self.to_precision(dtype), self.spec).to(dtype).eval()

    def require_finite_numbers(self) -> None:
        # infinite limits are allowed if they are infinite in the unfitted model too
        initial_state = self.spec.build().state_dict()
        for name, value in self.model.state_dict().items():
            is_invalid = ~torch.isfinite(value)
            if name in initial_state and initial_state[name].shape == value.shape:
                is_invalid &= ~(torch.isinf(value) & (initial_state[name].to(value.dtype) == value))
            if bool(is_invalid.any()):
                raise ExportError(
                    f"{self.label}: {name} holds {float(value[is_invalid][0])}; fit the model again"
                )

    def card_contents(self) -> dict[str, Any]:
        spec = self.spec
        band = self.spec.band
        units = spec.signals.channel_units()
        dof = spec.signals.dof
        guard_ranges = GuardedDynamics(self.model, spec).ranges
        accepted = torch.stack(
            (guard_ranges.accepted_lower, guard_ranges.accepted_upper), dim=1
        ).tolist()
        band_entry: dict[str, Any] | None = None
        if band is not None:
            horizon = band.steps[-1] * spec.dt
            widths = band.model_dump(mode="json", exclude_none=True)
            band_entry = {
                "about": _BAND_TEXT.format(100.0 * band.level),
                "horizon": horizon,
                **widths,
            }
        return {
            "schema": "residnet.card/1",
            "model": spec.name,
            "states": [{"name": name, "unit": units[name]} for name in self.state_names],
            "inputs": [
                {
                    "name": name,
                    "unit": units[name],
                    "role": _input_role(spec.signals, name),
                }
                for name in spec.signals.input_columns
            ],
            "wave_loads": _WAVE_LOADS_TEXT,
            "inputs_held": {
                "start": "the sample at the step's start",
                "mean": "the mean of the samples at the step's start and end",
            }[spec.hold],
            "memory": self.model.n_state,
            # only for ensembles, whose members otherwise continue from their own velocities
            **(
                {"measured_state": "set memory entry 0 to 0 before a step from a measured state"}
                if self.model.has_prediction_flag
                else {}
            ),
            "dt": spec.dt,
            "integrator": spec.integrator,
            "frame": _FRAME_TEXT,
            # only for models that differ from the usual three degrees of freedom
            **(
                {}
                if dof.is_planar
                else {"velocities": list(dof.velocities), "about": dof.description}
            ),
            "training_range": {name: list(limits) for name, limits in spec.ranges.items()},
            "operating_domain": _describe_domain(spec),
            "bad_inputs": {
                "rules": _BAD_INPUT_RULES,
                "accepted": dict(zip(units, accepted, strict=True)),
                "substitute": dict(zip(units, guard_ranges.midpoint.tolist(), strict=True)),
            },
            "baseline": spec.baseline.model_dump(mode="json"),
            "head": None if spec.head is None else spec.head.model_dump(mode="json"),
            "members": [
                member.model_dump(mode="json", include={"name", "baseline", "head"})
                for member in spec.members
            ],
            "member_weights": [list(weights) for weights in spec.weights],
            "band": band_entry,
            "metrics": [row.model_dump(mode="json", exclude_unset=True) for row in self.metrics],
            "versions": {"residnet": __version__, "torch": torch.__version__},
            "exported": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        }

    def check_parity(
        self, loaded: LoadedExport, subject: str, dtype: torch.dtype, tolerance: float | None = None
    ) -> dict[str, Any]:
        """Check the parity of a file for good and bad inputs; returns the model card entries on it.

        Raises:
            RoundingError: if the track depends on rounding in this precision.
            ExportError: if the file is wrong for another reason or the model leaves the accepted
                range.
        """
        is_single = dtype == torch.float32
        if tolerance is None:
            tolerance = base.SINGLE_TOLERANCE if is_single else base.DOUBLE_TOLERANCE
        range_shares = self.check_long_run(loaded, subject, dtype, tolerance)
        # sums in another order may round differently in double precision too
        if loaded.reorders_sums and (is_single or tolerance > base.DOUBLE_TOLERANCE):
            self.check_tracks(loaded, subject, dtype, tolerance)
        self.check_bad_inputs(loaded, subject, dtype)
        return {"steps": PARITY_STEPS, "sweep": self._sweep_share, "share_of_range": range_shares}

    def parity_inputs(
        self, dtype: torch.dtype, sweep_share: float = _SWEEP_SHARES[0]
    ) -> tuple[Tensor, Tensor]:
        """Return states of the past [1, 50, nx] and inputs [1, 50 + steps, m] of the parity check.

        The inputs are slow sines over a share of the training range about its middle, so that the
        run stays within the training data.
        """
        spec = self.spec
        lower = torch.tensor(spec.low, dtype=dtype)
        upper = torch.tensor(spec.high, dtype=dtype)
        step_index = torch.arange(PARITY_STEPS + PAST_STEPS, dtype=dtype)
        n_dof = self.model.dof
        sweep_phase = torch.arange(lower.numel() - n_dof, dtype=dtype)
        range_share = 0.5 + 0.5 * sweep_share * torch.sin(
            0.02 * (1 + 0.37 * sweep_phase)[None] * step_index[:, None] + sweep_phase[None]
        )
        w = (lower[n_dof:] + range_share * (upper - lower)[n_dof:]).unsqueeze(0)
        states = torch.zeros(1, PAST_STEPS, len(self.state_names), dtype=dtype)
        states[:, :, SURGE] = 0.5 * (lower[0] + upper[0])
        return states, w

    def run_reference(self, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
        """Return the result of `parity_inputs` and the states [1, steps + 1, nx] of the free run.

        Varying all inputs at once may exceed the conditions of logs that varied few at a time.
        Therefore the widest sweep of `_SWEEP_SHARES` is used that keeps the states within the
        accepted range.

        Raises:
            ExportError: if every sweep leaves the accepted range; names the first step and channel.
        """
        if dtype in self._reference_runs:
            return self._reference_runs[dtype]
        model = self.to_precision(dtype)
        state_ranges = GuardedDynamics(self.model, self.spec).state_ranges
        accepted_lower = state_ranges.accepted_lower
        accepted_upper = state_ranges.accepted_upper
        for sweep_share in _SWEEP_SHARES:
            y, w = self.parity_inputs(dtype, sweep_share)
            with torch.no_grad():
                s0 = model.warmup(y, w[:, :PAST_STEPS])
                states = Rollout(model)(y[:, -1], w[:, PAST_STEPS:], s0)[0]
            is_outside = ~((states[0] >= accepted_lower) & (states[0] <= accepted_upper))
            if not bool(is_outside.any()):
                self._reference_runs[dtype] = (y, w, states)
                self._sweep_share = sweep_share
                return self._reference_runs[dtype]
            log_message(
                f"{self.label}: its free run leaves what exports accept while all inputs sweep"
                f" {sweep_share:.0%} of the training range at once"
            )
        step_index = int(is_outside.any(dim=1).to(torch.int).argmax())
        state_index = int(is_outside[step_index].to(torch.int).argmax())
        raise ExportError(
            f"{self.label}: diverges in the export's free run, though its inputs keep to the middle"
            f" {_SWEEP_SHARES[-1]:.0%} of the training range: {self.state_names[state_index]} is"
            f" {float(states[0, step_index, state_index]):.3g} after"
            f" {step_index * self.spec.dt:g} s, accepted"
            f" {float(accepted_lower[state_index]):.3g} to"
            f" {float(accepted_upper[state_index]):.3g}; not exported, choose another model"
        )

    def check_long_run(
        self, loaded: LoadedExport, subject: str, dtype: torch.dtype, tolerance: float
    ) -> dict[str, float]:
        """Return the largest difference of each state to the model, relative to its range.

        Raises:
            RoundingError: if a difference is larger than allowed.
            ExportError: if the model itself leaves the accepted range.
        """
        y, w, eager_states = self.run_reference(dtype)
        past_states = y[0].numpy()
        inputs = w[0].numpy()
        s = self.warm_up_memory(loaded, past_states, inputs[:PAST_STEPS])
        x = past_states[-1].copy()
        rollout_states = loaded.rollout(x, inputs[PAST_STEPS:], s)
        stepped_states = [x]
        for w_now in inputs[PAST_STEPS:]:
            x, s, _ = loaded.step(x, w_now, s)
            stepped_states.append(x)
        states = eager_states[0].numpy()
        state_range = np.maximum(np.ptp(states, axis=0), 1e-6)
        differences = np.abs(np.stack(stepped_states) - states)
        if rollout_states is not None:
            differences = np.maximum(differences, np.abs(rollout_states - states))
        max_shares = differences.max(axis=0) / state_range
        range_shares = dict(zip(self.state_names, max_shares.tolist(), strict=True))
        if not bool((max_shares <= tolerance).all()):
            raise RoundingError(
                f"{self.label}: {subject} differs from the model by {range_shares} of each"
                f" channel's range"
                f" over {PARITY_STEPS} steps; allowed {tolerance:g}"
            )
        return range_shares

    def warm_up_memory(self, loaded: LoadedExport, y: NumberArray, w: NumberArray) -> NumberArray:
        """Return the memory after states [T, 3 + n] and inputs [T, m] of a measured past.

        Formats without `warmup` use steps, after each of which the memory is marked for a measured
        state. An invalid sample is replaced by the last valid sample before it, or by the first
        valid sample after it.
        """
        loaded_memory = loaded.initial_memory(y, w)
        if loaded_memory is not None:
            return loaded_memory
        ranges = GuardedDynamics(self.model, self.spec).ranges
        is_good = ranges.is_accepted(torch.from_numpy(np.concatenate((y, w), axis=1))).tolist()
        s = np.zeros(self.model.n_state, y.dtype)
        sample_index = is_good.index(True) if any(is_good) else 0
        for k in range(len(y) if any(is_good) else 0):
            sample_index = k if is_good[k] else sample_index
            s = loaded.step(y[sample_index], w[sample_index], s)[1]
            s = self.model.mark_measured(torch.from_numpy(s[None]))[0].numpy()
        return s

    def check_tracks(
        self, loaded: LoadedExport, subject: str, dtype: torch.dtype, tolerance: float
    ) -> None:
        """Refuse a precision whose rounding errors grow, on tracks with jumping inputs.

        A format computes sums in another order than torch. With little damping the growth of these
        rounding errors varies between tracks, so that several are simulated from random states.

        Raises:
            RoundingError: if a difference is larger than the tolerance.
        """
        generator = torch.Generator().manual_seed(1)
        guarded = self.guard_model(dtype)
        lower, upper = (
            torch.tensor(limits, dtype=dtype) for limits in (self.spec.low, self.spec.high)
        )
        track_shape = (_N_TRACKS, PARITY_STEPS // _STEPS_PER_INPUT + 1, lower.numel())
        track_inputs = lower + torch.rand(track_shape, generator=generator).to(dtype) * (
            upper - lower
        )
        n_dof = guarded.dof
        w = track_inputs[:, :, n_dof:].repeat_interleave(_STEPS_PER_INPUT, dim=1)[:, :PARITY_STEPS]
        # the last column of the guarded state is the flag
        x0 = torch.cat(
            (torch.zeros(_N_TRACKS, 3), track_inputs[:, 0, :n_dof], torch.zeros(_N_TRACKS, 1)),
            dim=1,
        )
        x0, s0 = x0.to(dtype), guarded.initial_state(_N_TRACKS).to(dtype)
        with torch.no_grad():
            expected = trace_rollout(Rollout(guarded), PARITY_STEPS)(x0, w, s0)[0]
        states = expected[..., : len(self.state_names)].numpy()
        x, s = x0[:, : len(self.state_names)].numpy(), s0.numpy()
        stepped_states = [x]
        for k in range(PARITY_STEPS):
            x, s, _ = loaded.step_rows(x, w[:, k].numpy(), s)
            stepped_states.append(x)
        state_range = np.maximum(np.ptp(states, axis=1), 1e-6)
        max_share = float(
            (np.abs(np.stack(stepped_states, axis=1) - states).max(axis=1) / state_range).max()
        )
        if not max_share <= tolerance:
            raise RoundingError(
                f"{self.label}: {subject} differs from the model by {max_share:.2g} of a state's"
                f" range over"
                f" {PARITY_STEPS} steps; allowed {tolerance:g}"
            )

    def check_bad_inputs(self, loaded: LoadedExport, subject: str, dtype: torch.dtype) -> None:
        """Check that bad inputs, states and memories give the same results as the guarded model.

        Raises:
            ExportError: if a result differs; names the first entry and its value.
        """
        guarded = self.guard_model(dtype)
        past_states, w = self.parity_inputs(dtype)
        memory = guarded.warmup(past_states, w[:, :PAST_STEPS])[0]
        good_values = torch.cat((past_states[0, -1], w[0, PAST_STEPS], memory))
        columns = self.spec.signals.input_columns
        names = [*self.state_names, *columns, *(f"memory {i}" for i in range(memory.numel()))]
        n_measured = len(self.state_names) + len(columns)
        # of a long memory only the first, middle and last entries are tested, to save time
        memory_indices = {n_measured, len(names) // 2, len(names) - 1}
        tested_indices = [i for i in range(len(names)) if i < n_measured or i in memory_indices]
        bad_values = (torch.nan, torch.inf, -torch.inf, 1e30, -1e30)
        cases = [(i, value) for i in tested_indices for value in bad_values]
        case_values = good_values.repeat(len(cases), 1)
        for case_row, (i, value) in zip(case_values, cases, strict=True):
            case_row[i] = value
        x0, w0, s0 = case_values.split([len(self.state_names), len(columns), memory.numel()], dim=1)
        with torch.no_grad():
            expected = guarded.flagged_step(x0, w0, s0)
        for k, (i, value) in enumerate(cases):
            x, s, outside = loaded.step(x0[k].numpy(), w0[k].numpy(), s0[k].numpy())
            is_equal = (
                np.allclose(x, expected[0][k].numpy(), rtol=1e-4, atol=1e-4)
                and np.allclose(s, expected[1][k].numpy(), rtol=1e-3, atol=1e-3)
                and bool(outside) == bool(expected[2][k])
            )
            if not is_equal:
                raise ExportError(
                    f"{self.label}: {subject} answers {names[i]} = {value} with {x.tolist()},"
                    f" outside"
                    f" {bool(outside)}; the model with {expected[0][k].tolist()},"
                    f" {bool(expected[2][k])}"
                )
