"""A vessel model as it is exported: its guarded step, its card, and what is checked of every file.

A format's file is loaded back and driven beside the model itself: 2,000 steps from a warmed-up
memory, tracks whose inputs jump, then inputs, states and memories that no vessel has.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping, Sequence
from typing import Any, final

import numpy as np
import torch
from torch import Tensor, nn

from residnet.core.errors import ExportError
from residnet.core.layout import SURGE
from residnet.core.progress import say
from residnet.core.version import __version__
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout, trace_rollout
from residnet.dynamics.store import ModelSpec
from residnet.export import base
from residnet.export.base import Exported, Loaded, Numbers, RoundingError
from residnet.export.guard import GuardedDynamics, hold_measured
from residnet.export.torchscript import require_shape, size, trace_function
from residnet.heads.base import ResidualHead

PARITY_STEPS = 2000
"""Steps over which an export must follow the model: long enough for its memory to drift."""
PAST = 50
"""Steps of measured past that warm the memory up."""
_SWEEPS = (0.8, 0.4, 0.2)
"""Shares of the training range that inputs sweep together."""
_TRACKS, _HELD = 16, 20
"""Tracks whose inputs jump, and steps between the jumps: eight may all miss what grows."""
_FRAME = (
    "NED; body axes x forward, y starboard, z down; psi unwrapped, clockwise from north; wind_dir"
    " is where the wind comes from"
)
_RULES = (
    "an entry that is no number becomes the one under `substitute`, any other beyond `accepted` the"
    " nearest value of its training range; a memory that is not finite or beyond what the head can"
    " have begins anew; a step that would leave `accepted` is held at its edge; `outside` is then"
    " true"
)
_BAND = (
    "half widths of the errors of a free run so many steps after a measured state, whatever the run"
    " is like; between the steps they are interpolated, and beyond the last they grow in proportion"
    " to time, without any promise; the position's is the radius about the predicted one"
)


class ExportedModel(nn.Module):
    """What a controller sees; all tensors are float32, SI and radians.

    Bad inputs and memories are treated as `residnet.export.base` says: a flag and a finite answer.
    Tensors of a wrong shape are refused, never broadcast; other precisions are converted.

    TorchScript compiles this class. The model's own code is only traced, so that heads and
    baselines may be written in any Python.
    """

    def __init__(self, model: HybridDynamics, spec: ModelSpec) -> None:
        super().__init__()
        model = copy.deepcopy(model).requires_grad_(False)
        guard = GuardedDynamics(model, spec)
        self.inputs = len(spec.signals.columns)
        self.states = len(spec.signals.live.states)
        self.n_state = model.n_state
        # two rows: a batch of one would hide where the rows of a batch are confused
        sizes = (self.states, self.inputs, self.n_state)
        examples = tuple(torch.zeros(2, size) for size in sizes)
        what = f"model {spec.name}"
        self.guarded_step = trace_function(guard.flagged_step, examples, what)
        self.next_memory = trace_function(lambda x, w, s: model.step(x, w, s)[1], examples, what)
        self.ranges, self.of_state = guard.ranges, guard.of_state
        known = spec.band
        steps, widths = (
            torch.ones(1),
            torch.full((1, len(spec.signals.live.layout.banded)), torch.inf),
        )
        if known is not None:
            steps, widths = torch.tensor(known.steps), torch.tensor(known.columns).T
        self.band_steps, self.band_widths = nn.Buffer(steps), nn.Buffer(widths)

    @torch.jit.export
    def band(self, k: int) -> Tensor:
        """Return the half widths [c] k steps after a measurement.

        They are of u, v, r, heading and position, then of p and phi where the vessel rolls. They
        are zero at k = 0, grow in proportion to time beyond the calibrated horizon, and are
        infinite where the model has no band.
        """
        steps, widths = self.band_steps.float(), self.band_widths.float()
        if k <= 0:
            return torch.zeros_like(widths[0])
        last = steps.shape[0] - 1
        if k >= int(steps[last]):
            return widths[last] * (float(k) / float(steps[last]))
        after = int((steps <= k).sum())
        share = (float(k) - float(steps[after - 1])) / float(steps[after] - steps[after - 1])
        return widths[after - 1] + share * (widths[after] - widths[after - 1])

    @torch.jit.export
    def initial_state(self, batch: int) -> Tensor:
        """Return the memory s [batch, n_state] without a past."""
        return torch.zeros(batch, self.n_state)

    @torch.jit.export
    def warmup(self, y_history: Tensor, w_history: Tensor) -> Tensor:
        """Return the memory s [B, n_state] that a measured past leaves.

        Samples that are no measurements are left out: the last one before them stands for them.

        Args:
            y_history: states [B, T, 3 + n], oldest first.
            w_history: inputs [B, T, m], oldest first.
        """
        rows, steps = size(y_history, 3, 0), size(y_history, 3, 1)
        require_shape("y_history", y_history, [rows, steps, self.states])
        require_shape("w_history", w_history, [rows, steps, self.inputs])
        s = torch.zeros(rows, self.n_state)
        if steps == 0 or self.n_state == 0:
            return s
        y, w = y_history.float(), w_history.float()
        good = self.ranges.accepted(torch.cat((y, w), dim=-1))
        y, w = hold_measured(y, w, good)
        for k in range(steps):
            s = self.next_memory(y[:, k], w[:, k], s)
        known = (good.any(dim=1) & torch.isfinite(s).all(dim=-1)).unsqueeze(-1)
        return torch.where(known, s, torch.zeros_like(s))

    @torch.jit.export
    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the state [B, 3 + n] and memory after one step under inputs w [B, m], and a flag.

        `outside` [B] is True where a velocity or an input is beyond the training range, an entry or
        the memory is not finite, or the step was held.
        """
        rows = size(x, 2, 0)
        require_shape("x", x, [rows, self.states])
        require_shape("w", w, [rows, self.inputs])
        require_shape("s", s, [rows, self.n_state])
        found: tuple[Tensor, Tensor, Tensor] = self.guarded_step(x.float(), w.float(), s.float())
        return found

    @torch.jit.export
    def rollout(self, x0: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the states [B, T+1, 3 + n] from x0 [B, 3 + n] on under inputs w [B, T, m].

        Behind them stand the memory [B, n_state] after the last step and `outside` [B, T], the flag
        of each step.
        """
        rows, steps = size(x0, 2, 0), size(w, 3, 1)
        require_shape("x0", x0, [rows, self.states])
        require_shape("w", w, [rows, steps, self.inputs])
        require_shape("s", s, [rows, self.n_state])
        x, w, s = x0.float(), w.float(), s.float()
        states, flags = [self.of_state.replaced(x)], [torch.zeros(rows, 0, dtype=torch.bool)]
        # the first step sees x0 as it was given, for its flag
        for k in range(steps):
            x, s, outside = self.guarded_step(x, w[:, k], s)
            states.append(x)
            flags.append(outside.unsqueeze(1))
        return torch.stack(states, dim=1), s, torch.cat(flags, dim=1)

    def forward(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `step` returns."""
        return self.step(x, w, s)


class _Step(nn.Module):
    """The guarded step, for formats that hold one function."""

    def __init__(self, model: HybridDynamics, spec: ModelSpec) -> None:
        super().__init__()
        self.guarded = GuardedDynamics(model, spec)

    def forward(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        after, memory, outside = self.guarded.flagged_step(x, w, s)
        # a result that is an argument is no result of its own
        return after, memory.clone(), outside


@final
class ExportedVessel(Exported):
    """A vessel model, whose own numbers are left alone.

    Args:
        metrics: rows of metrics.json of this model, for the card.
    """

    results = ("x_after", "s_after", "outside")
    flags = ("outside",)
    methods = ("initial_state", "warmup", "step", "rollout", "band")

    def __init__(
        self, spec: ModelSpec, model: HybridDynamics, metrics: Sequence[Mapping[str, Any]] = ()
    ) -> None:
        for part in model.modules():
            if isinstance(part, ResidualHead) and part.refusal:
                raise ExportError(f"model {spec.name}: {part.refusal}; export another model")
        self.spec, self.metrics = spec, metrics
        self.model = copy.deepcopy(model).eval().requires_grad_(False)
        self.name, self.what, self.dt = spec.name, f"model {spec.name}", spec.dt
        self.states, inputs = spec.signals.live.states, len(spec.signals.columns)
        self.arguments = (("x", len(self.states)), ("w", inputs), ("s", model.n_state))
        # what is written and what is read back are compared with one run
        self._free: dict[torch.dtype, tuple[Tensor, Tensor, Tensor]] = {}
        self._swept = _SWEEPS[0]

    def at(self, dtype: torch.dtype) -> HybridDynamics:
        """Return the model in a precision."""
        return copy.deepcopy(self.model).to(dtype)

    def guarded(self, dtype: torch.dtype) -> GuardedDynamics:
        """Return the model behind its guard."""
        return GuardedDynamics(self.at(dtype), self.spec).to(dtype).eval()

    def module(self, dtype: torch.dtype) -> nn.Module:
        return ExportedModel(self.at(dtype), self.spec).eval()

    def graph(self, dtype: torch.dtype) -> nn.Module:
        return _Step(self.at(dtype), self.spec).to(dtype).eval()

    def require_numbers(self) -> None:
        # limits of what has no limits are infinite from the start
        fresh = self.spec.build().state_dict()
        for name, value in self.model.state_dict().items():
            wrong = ~torch.isfinite(value)
            if name in fresh and fresh[name].shape == value.shape:
                wrong &= ~(torch.isinf(value) & (fresh[name].to(value.dtype) == value))
            if bool(wrong.any()):
                raise ExportError(
                    f"{self.what}: {name} holds {float(value[wrong][0])}, so it is no model; fit it"
                    " again"
                )

    def contents(self) -> dict[str, Any]:
        spec, band = self.spec, self.spec.band
        units, live = spec.signals.units(), spec.signals.live
        known = GuardedDynamics(self.model, spec).ranges
        accepted = torch.stack((known.least, known.most), dim=1).tolist()
        table: dict[str, Any] | None = None
        if band is not None:
            horizon = band.steps[-1] * spec.dt
            widths = band.model_dump(mode="json", exclude_none=True)
            table = {"about": _BAND, "horizon": horizon, **widths}
        return {
            "schema": "residnet.card/1",
            "model": spec.name,
            "states": [{"name": name, "unit": units[name]} for name in self.states],
            "inputs": [
                {
                    "name": name,
                    "unit": units[name],
                    "role": "command" if name in spec.signals.inputs else "exogenous",
                }
                for name in spec.signals.columns
            ],
            "inputs_held": {
                "start": "the sample at the step's start",
                "mean": "the mean of the samples at the step's start and end",
            }[spec.hold],
            "memory": self.model.n_state,
            "dt": spec.dt,
            "integrator": spec.integrator,
            "frame": _FRAME,
            # of a model of all velocities there is nothing to say
            **({} if live.planar else {"velocities": list(live.velocities), "about": live.text}),
            "training_range": {name: list(limits) for name, limits in spec.ranges.items()},
            "bad_inputs": {
                "rules": _RULES,
                "accepted": dict(zip(units, accepted, strict=True)),
                "substitute": dict(zip(units, known.middle.tolist(), strict=True)),
            },
            "baseline": spec.baseline.model_dump(mode="json"),
            "head": None if spec.head is None else spec.head.model_dump(mode="json"),
            "members": [
                member.model_dump(mode="json", include={"name", "baseline", "head"})
                for member in spec.members
            ],
            "band": table,
            "metrics": [dict(row) for row in self.metrics],
            "versions": {"residnet": __version__, "torch": torch.__version__},
            "exported": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        }

    def check(
        self, loaded: Loaded, what: str, dtype: torch.dtype, tolerance: float | None = None
    ) -> dict[str, Any]:
        """Return what the card says of the parity, once a file answers good and bad inputs.

        Raises:
            RoundingError: where the precision does not determine the track.
            ExportError: where the file is wrong otherwise, or the model leaves what is accepted.
        """
        single = dtype == torch.float32
        if tolerance is None:
            tolerance = base.SINGLE if single else base.DOUBLE
        shares = self.require_parity(loaded, what, dtype, tolerance)
        # a library that adds up in another order may round otherwise in double precision too
        if loaded.reorders and (single or tolerance > base.DOUBLE):
            self.require_tracks(loaded, what, dtype, tolerance)
        self.require_defined(loaded, what, dtype)
        return {"steps": PARITY_STEPS, "sweep": self._swept, "share_of_range": shares}

    def drive(self, dtype: torch.dtype, share: float = _SWEEPS[0]) -> tuple[Tensor, Tensor]:
        """Return states of the past [1, 50, nx] and inputs [1, 50 + steps, m] of the parity check.

        Inputs sweep a share of the training range about its middle as slow sines, so that the run
        passes through what the model knows.
        """
        spec = self.spec
        low, high = torch.tensor(spec.low, dtype=dtype), torch.tensor(spec.high, dtype=dtype)
        steps = torch.arange(PARITY_STEPS + PAST, dtype=dtype)
        n = self.model.dof
        phase = torch.arange(low.numel() - n, dtype=dtype)
        sweep = 0.5 + 0.5 * share * torch.sin(
            0.02 * (1 + 0.37 * phase)[None] * steps[:, None] + phase[None]
        )
        w = (low[n:] + sweep * (high - low)[n:]).unsqueeze(0)
        y = torch.zeros(1, PAST, len(self.states), dtype=dtype)
        y[:, :, SURGE] = 0.5 * (low[0] + high[0])
        return y, w

    def free_run(self, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `drive` returns, and the states [1, steps + 1, nx] of the model's free run.

        All inputs at once may ask for more than logs that moved some of them at a time: the sweep
        is the widest of `_SWEEPS` under which the states stay within what exports accept.

        Raises:
            ExportError: where it leaves that under each; the first step and channel beyond.
        """
        if dtype in self._free:
            return self._free[dtype]
        model = self.at(dtype)
        accepted = GuardedDynamics(self.model, self.spec).of_state
        least, most = accepted.least, accepted.most
        for share in _SWEEPS:
            y, w = self.drive(dtype, share)
            with torch.no_grad():
                s0 = model.warmup(y, w[:, :PAST])
                states = Rollout(model)(y[:, -1], w[:, PAST:], s0)[0]
            wrong = ~((states[0] >= least) & (states[0] <= most))
            if not bool(wrong.any()):
                self._free[dtype], self._swept = (y, w, states), share
                return self._free[dtype]
            say(
                f"{self.what}: its free run leaves what exports accept while all inputs sweep"
                f" {share:.0%} of the training range at once"
            )
        k = int(wrong.any(dim=1).to(torch.int).argmax())
        i = int(wrong[k].to(torch.int).argmax())
        raise ExportError(
            f"{self.what}: diverges in the export's free run, though its inputs keep to the middle"
            f" {_SWEEPS[-1]:.0%} of the training range: {self.states[i]} is"
            f" {float(states[0, k, i]):.3g} after {k * self.spec.dt:g} s, accepted"
            f" {float(least[i]):.3g} to {float(most[i]):.3g}; not exported, choose another model"
        )

    def require_parity(
        self, loaded: Loaded, what: str, dtype: torch.dtype, tolerance: float
    ) -> dict[str, float]:
        """Return the largest difference of each state from the model's, as a share of its range.

        Raises:
            RoundingError: where a share is larger than allowed.
            ExportError: where the model itself leaves what exports accept.
        """
        y, w, eager = self.free_run(dtype)
        past, inputs = y[0].numpy(), w[0].numpy()
        s = self.memory(loaded, past, inputs[:PAST])
        x = past[-1].copy()
        together = loaded.rollout(x, inputs[PAST:], s)
        path = [x]
        for w_now in inputs[PAST:]:
            x, s, _ = loaded.step(x, w_now, s)
            path.append(x)
        states = eager[0].numpy()
        span = np.maximum(np.ptp(states, axis=0), 1e-6)
        off = np.abs(np.stack(path) - states)
        if together is not None:
            off = np.maximum(off, np.abs(together - states))
        worst = off.max(axis=0) / span
        shares = dict(zip(self.states, worst.tolist(), strict=True))
        if not bool((worst <= tolerance).all()):
            raise RoundingError(
                f"{self.what}: {what} differs from the model by {shares} of each channel's range"
                f" over {PARITY_STEPS} steps; allowed {tolerance:g}"
            )
        return shares

    def memory(self, loaded: Loaded, y: Numbers, w: Numbers) -> Numbers:
        """Return the memory that states [T, 3 + n] and inputs [T, m] of a measured past leave.

        Where a format has only steps, these are taken. In the place of a sample that is no
        measurement stands the last one before it that is, or else the first one behind it.
        """
        found = loaded.memory(y, w)
        if found is not None:
            return found
        ranges = GuardedDynamics(self.model, self.spec).ranges
        good = ranges.accepted(torch.from_numpy(np.concatenate((y, w), axis=1))).tolist()
        s, at = np.zeros(self.model.n_state, y.dtype), good.index(True) if any(good) else 0
        for k in range(len(y) if any(good) else 0):
            at = k if good[k] else at
            s = loaded.step(y[at], w[at], s)[1]
        return s

    def require_tracks(
        self, loaded: Loaded, what: str, dtype: torch.dtype, tolerance: float
    ) -> None:
        """Refuse a precision whose rounding grows, on tracks whose inputs jump within the range.

        A format adds up in another order than torch. Where a model hardly damps, what that rounds
        otherwise differs much from track to track, so there are several, each from a state of its
        own.

        Raises:
            RoundingError: where a state of a track differs by more.
        """
        generator = torch.Generator().manual_seed(1)
        guard = self.guarded(dtype)
        low, high = (torch.tensor(bound, dtype=dtype) for bound in (self.spec.low, self.spec.high))
        places = (_TRACKS, PARITY_STEPS // _HELD + 1, low.numel())
        seen = low + torch.rand(places, generator=generator).to(dtype) * (high - low)
        n = guard.dof
        w = seen[:, :, n:].repeat_interleave(_HELD, dim=1)[:, :PARITY_STEPS]
        # the last column is the guard's flag
        x0 = torch.cat((torch.zeros(_TRACKS, 3), seen[:, 0, :n], torch.zeros(_TRACKS, 1)), dim=1)
        x0, s0 = x0.to(dtype), guard.initial_state(_TRACKS).to(dtype)
        with torch.no_grad():
            wanted = trace_rollout(Rollout(guard), PARITY_STEPS)(x0, w, s0)[0]
        states = wanted[..., : len(self.states)].numpy()
        x, s = x0[:, : len(self.states)].numpy(), s0.numpy()
        path = [x]
        for k in range(PARITY_STEPS):
            x, s, _ = loaded.rows(x, w[:, k].numpy(), s)
            path.append(x)
        span = np.maximum(np.ptp(states, axis=1), 1e-6)
        worst = float((np.abs(np.stack(path, axis=1) - states).max(axis=1) / span).max())
        if not worst <= tolerance:
            raise RoundingError(
                f"{self.what}: {what} differs from the model by {worst:.2g} of a state's range over"
                f" {PARITY_STEPS} steps; allowed {tolerance:g}"
            )

    def require_defined(self, loaded: Loaded, what: str, dtype: torch.dtype) -> None:
        """Refuse what answers bad inputs, states or memories otherwise than the model's guard.

        Raises:
            ExportError: that names the first entry and its value.
        """
        guarded = self.guarded(dtype)
        y, w = self.drive(dtype)
        memory = guarded.warmup(y, w[:, :PAST])[0]
        good = torch.cat((y[0, -1], w[0, PAST], memory))
        columns = self.spec.signals.columns
        names = [*self.states, *columns, *(f"memory {i}" for i in range(memory.numel()))]
        measured = len(self.states) + len(columns)
        # a long memory is wrong in its first, its middle and its last entry
        ends = {measured, len(names) // 2, len(names) - 1}
        places = [i for i in range(len(names)) if i < measured or i in ends]
        bad = (torch.nan, torch.inf, -torch.inf, 1e30, -1e30)
        cases = [(i, value) for i in places for value in bad]
        rows = good.repeat(len(cases), 1)
        for row, (i, value) in zip(rows, cases, strict=True):
            row[i] = value
        x0, w0, s0 = rows.split([len(self.states), len(columns), memory.numel()], dim=1)
        with torch.no_grad():
            wanted = guarded.flagged_step(x0, w0, s0)
        for k, (i, value) in enumerate(cases):
            x, s, outside = loaded.step(x0[k].numpy(), w0[k].numpy(), s0[k].numpy())
            same = (
                np.allclose(x, wanted[0][k].numpy(), rtol=1e-4, atol=1e-4)
                and np.allclose(s, wanted[1][k].numpy(), rtol=1e-3, atol=1e-3)
                and bool(outside) == bool(wanted[2][k])
            )
            if not same:
                raise ExportError(
                    f"{self.what}: {what} answers {names[i]} = {value} with {x.tolist()}, outside"
                    f" {bool(outside)}; the model with {wanted[0][k].tolist()},"
                    f" {bool(wanted[2][k])}"
                )
