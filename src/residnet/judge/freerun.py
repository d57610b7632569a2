"""The free-run evaluator: every model over every window of a protocol, in one batch."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from residnet.core.columns import tilted
from residnet.core.frames import rotated, turn_between, wrap_array
from residnet.core.layout import ALIVE, ATTITUDE, HEADING, POSE, POSITION, Live, levelled
from residnet.data.prepare import Prepared
from residnet.dynamics.base import Dynamics
from residnet.dynamics.free_runs import compiled
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.judge.band import Band, by_channel
from residnet.judge.protocol import Window

_LONGER = 4
"""Times its own length that a window may be kept going beside longer ones."""
_LARGEST = 30_000_000
"""Numbers that the windows of a batch may hold."""
_OWN = 2.0
"""Times what the vessel itself did in a window that a prediction may reach."""


@dataclass(frozen=True)
class Candidate:
    """A model to evaluate.

    Attributes:
        name: unique in a run.
        kind: zero, baseline, head, truth or ensemble.
        model: the dynamics; float64 parameters are run in float64.
        state: names of the columns of the model's state; those of the prepared logs where empty.
            What is not among these (actuators) starts from the log's channel.
        inputs: channels of the log that make w; None for the prepared inputs.
        idle: inputs after those that are held at zero (disturbances that the model is not told
            about).
        reference: name of the model that this one is compared with, window by window; None for
            none.
        ranges: smallest and largest training value of each velocity and input; empty where they
            are not known.
        bands: of its free runs by protocol; empty where there are none.
        members: models beside it whose free runs it is the mean of; empty for none.
        unlike: models beside it that lie apart where the logs of the fit do not tell the motion;
            empty for none.
    """

    name: str
    kind: str
    model: Dynamics
    state: tuple[str, ...] = ()
    inputs: tuple[str, ...] | None = None
    idle: int = 0
    reference: str | None = None
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    bands: Mapping[str, Band] = field(default_factory=dict)
    members: tuple[str, ...] = ()
    unlike: tuple[str, ...] = ()


@dataclass(frozen=True)
class Prediction:
    """A prediction of one model for one window.

    States [L, 3 + n] hold what moves in the model and the pose integrated from it; `diverged`
    says whether the free run ran away. `spread` [L - 1, c] is the standard deviation between unlike
    models by channel of a band, from the first step on; None where there are none.
    """

    states: np.ndarray
    diverged: bool
    spread: np.ndarray | None = None


@dataclass(frozen=True)
class FreeRun:
    """The free runs of all models over all windows of one protocol and split.

    predictions[model][i] belongs to windows[i].
    """

    protocol: str
    split: str
    windows: list[Window]
    predictions: dict[str, list[Prediction]] = field(default_factory=dict)


@dataclass(frozen=True)
class Errors:
    """Errors of one model's free runs, the samples of all W windows one after the other.

    u, v and the position are scored over usable samples; r, the heading and the roll, which no
    position sensor disturbs, over all.

    Attributes:
        error: predicted minus measured states [N, 3 + n]; psi within half a turn.
        usable: which samples are [N].
        counts: samples of each window [W].
        live: velocities that the logs tell; others are zero, and no error counts.
        attitude: angle of the rotation between the attitudes [N]; None on the surface.
    """

    error: np.ndarray
    usable: np.ndarray
    counts: np.ndarray
    live: Live = ALIVE
    attitude: np.ndarray | None = None

    @classmethod
    def of(
        cls, windows: Sequence[Window], predictions: Sequence[Prediction], logs: Sequence[Prepared]
    ) -> Errors:
        """Return the errors of predictions over windows of logs."""
        rows = [(logs[window.log], slice(window.start, window.stop)) for window in windows]
        found = np.concatenate([one.states for one in predictions])
        wanted = np.concatenate([log.y[part] for log, part in rows])
        error = found - wanted
        # a turn too many is no error of where the vessel points
        error[:, HEADING] = wrap_array(error[:, HEADING])
        live, attitude = logs[windows[0].log].live, None
        if live.spatial:
            roll = live.states.index("phi")
            error[:, roll] = wrap_array(error[:, roll])
            attitude = turn_between(found[:, ATTITUDE], wanted[:, ATTITUDE])
        return cls(
            error,
            np.concatenate([log.usable[part] for log, part in rows]),
            np.array([window.stop - window.start for window in windows]),
            live,
            attitude,
        )

    def nrmse(self, scales: np.ndarray) -> np.ndarray:
        """Return the mean over the live velocities of rmse / scale of each window [W]."""
        return np.asarray((self.rmse / scales).take(self.live.axes, axis=1).mean(1))

    @property
    def begins(self) -> np.ndarray:
        """First sample of each window [W]."""
        return np.asarray(np.cumsum(self.counts) - self.counts)

    @property
    def scored(self) -> np.ndarray:
        """Whether each of what moves counts at each sample [N, n]."""
        turning = [np.ones_like(self.usable)] * (self.live.size - 2)
        return np.stack((self.usable, self.usable, *turning), axis=1)

    @property
    def velocities(self) -> np.ndarray:
        """Errors of what moves [N, n], zero where they do not count."""
        return np.asarray(np.where(self.scored, self.error[:, self.live.columns], 0.0))

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Return the mean of values [N, n] over each window's samples that count [W, n]."""
        with np.errstate(invalid="ignore"):
            sums = np.add.reduceat(values, self.begins)
            return np.asarray(sums / np.add.reduceat(self.scored.astype(float), self.begins))

    @property
    def rmse(self) -> np.ndarray:
        """Root mean square errors of what moves of each window [W, n]."""
        return np.asarray(np.sqrt(self.mean(self.velocities**2)))

    @property
    def mae(self) -> np.ndarray:
        """Mean absolute errors of what moves of each window [W, n]."""
        return self.mean(np.abs(self.velocities))

    def ends(self, rows: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Return the sizes [W] of the errors of the pose by name, see `Live.ends`.

        Args:
            rows: samples [W]; None for the last of each window.
        """
        last = self.begins + self.counts - 1 if rows is None else rows
        at, turned = self.error[last], None if self.attitude is None else self.attitude[last]
        return sizes_of(at, self.live, turned)

    @property
    def samples(self) -> np.ndarray:
        """Usable samples of each window [W]."""
        return np.asarray(np.add.reduceat(self.usable.astype(int), self.begins))


def free_run(
    candidates: Sequence[Candidate],
    windows: Sequence[Window],
    logs: Sequence[Prepared],
    step: float,
    limit: np.ndarray,
    dtype: torch.dtype = torch.float64,
) -> dict[str, list[Prediction]]:
    """Free-run every candidate over every window.

    A window whose prediction is not finite, or whose velocities exceed both `limit` [n] and twice
    what the vessel itself did in it, has diverged and holds the prediction of `zero`, velocities
    held, instead. Beyond a negative limit everything has diverged.
    """
    names = {candidate.name for candidate in candidates}
    means = [one for one in candidates if one.members and set(one.members) <= names]
    out = {
        candidate.name: _run(candidate, windows, logs, step, limit, dtype)
        for candidate in candidates
        if candidate not in means
    }
    for mean in means:
        beside = [*zip(*(out[name] for name in mean.members), strict=True)]
        # where a member was replaced, what it really did is in nobody's prediction
        alone = [i for i, each in enumerate(beside) if any(one.diverged for one in each)]
        found = iter(_run(mean, [windows[i] for i in alone], logs, step, limit, dtype))
        out[mean.name] = []
        for i, each in enumerate(beside):
            states = [one.states for one in each]
            nu = np.mean(states, axis=0)
            nu = nu if logs[0].live.spatial else nu[:, logs[0].live.columns]
            own = next(found) if i in alone else _prediction(windows[i], nu, logs, step, limit)
            out[mean.name].append(own)
    apart: dict[tuple[str, ...], list[np.ndarray]] = {}
    for one in candidates:
        if len(one.unlike) > 1 and set(one.unlike) <= names:
            if one.unlike not in apart:
                beside = [*zip(*(out[name] for name in one.unlike), strict=True)]
                apart[one.unlike] = [spread_of([each.states for each in some]) for some in beside]
            both = zip(out[one.name], apart[one.unlike], strict=True)
            out[one.name] = [replace(own, spread=spread) for own, spread in both]
    return {candidate.name: out[candidate.name] for candidate in candidates}


def spread_of(states: Sequence[np.ndarray]) -> np.ndarray:
    """Return the standard deviation [L, c] between models' states [L + 1, 3 + n] after the first.

    Its columns are the channels of a band; that of the position is per axis, mean over both.
    """
    spread = np.stack([one[1:] for one in states]).std(axis=0, ddof=1)
    return by_channel(spread, np.sqrt(0.5 * (spread[:, POSITION] ** 2).sum(axis=1)))


def _run(
    candidate: Candidate,
    windows: Sequence[Window],
    logs: Sequence[Prepared],
    step: float,
    limit: np.ndarray,
    dtype: torch.dtype,
) -> list[Prediction]:
    tables = {n: _inputs(candidate, logs[n]) for n in {window.log for window in windows}}
    # a copy: a validation in float32 must not round the model that it validates
    model = copy.deepcopy(candidate.model).to("cpu", dtype).eval()
    # the pose is integrated from the velocities below, or composed of rotations by the model
    model.positions = model.spatial
    live = logs[0].live
    names = candidate.state or live.states
    wanted = live.states if model.spatial else live.moving
    columns = [names.index(name) for name in wanted]
    out: dict[int, Prediction] = {}
    width = len(names) + sum(table.shape[1] for table in list(tables.values())[:1])
    for rows in _batches(windows, width):
        members = [windows[row] for row in rows]
        x0 = np.stack([_initial(candidate, window, logs[window.log]) for window in members])
        nu = _simulated(model, members, x0, logs, tables, dtype)[:, :, columns].double().numpy()
        for row, window, found in zip(rows, members, nu, strict=True):
            out[row] = _prediction(window, found[: _length(window)], logs, step, limit)
    return [out[row] for row in range(len(windows))]


def _length(window: Window) -> int:
    return window.stop - window.start


def _batches(windows: Sequence[Window], width: int) -> Iterator[list[int]]:
    """Yield the windows that are run together, by their numbers.

    Steps cost much the same for one row or many, so that long and short windows run side by side,
    as long as none is kept going for far more than its own length and memory suffices.

    Args:
        width: numbers that each row keeps for each step.
    """
    order = sorted(range(len(windows)), key=lambda row: -_length(windows[row]))
    batch: list[int] = []
    for row in order:
        longest = _length(windows[batch[0]]) if batch else 0
        if batch and (
            _LONGER * _length(windows[row]) < longest
            or (len(batch) + 1) * longest * width > _LARGEST
        ):
            yield batch
            batch = []
        batch.append(row)
    if batch:
        yield batch


def _simulated(
    model: Dynamics,
    windows: Sequence[Window],
    x0: np.ndarray,
    logs: Sequence[Prepared],
    tables: Mapping[int, np.ndarray],
    dtype: torch.dtype,
) -> torch.Tensor:
    """Return the states [W, L, nx] of windows that run together, each from its row of x0."""
    longest = max(map(_length, windows))
    ahead = np.stack(
        [
            tables[w.log][np.minimum(np.arange(w.start, w.start + longest - 1), w.stop - 1)]
            for w in windows
        ]
    )
    with torch.no_grad():
        s = model.initial_state(len(windows)).to(dtype)
        if isinstance(model, HybridDynamics):
            lengths = np.array([window.start - window.past for window in windows])
            for length in np.unique(lengths):
                rows = np.flatnonzero(lengths == length)
                members = [windows[i] for i in rows.tolist()]
                y = np.stack([logs[window.log].y[window.past : window.start] for window in members])
                w = np.stack([tables[window.log][window.past : window.start] for window in members])
                s[torch.from_numpy(rows)] = model.warmup(
                    torch.from_numpy(y).to(dtype), torch.from_numpy(w).to(dtype)
                )
        states, _, _ = compiled(Rollout(model), longest)(
            torch.from_numpy(x0).to(dtype), torch.from_numpy(ahead).to(dtype), s
        )
    found: torch.Tensor = states
    return found


def _prediction(
    window: Window, run: np.ndarray, logs: Sequence[Prepared], step: float, limit: np.ndarray
) -> Prediction:
    """Return states [L, 3 + n] or what moves [L, n] with its pose; of `zero` if it ran away."""
    log, rows = logs[window.log], slice(window.start, window.stop)
    nu = run[:, -log.live.size :]
    recorded = np.abs(log.y[rows, log.live.columns][log.usable[rows]])
    # short training logs may hold far less than the window, and then it is the vessel that exceeds
    own = _OWN * recorded.max(0, initial=0.0)
    limit = np.where(limit < 0.0, limit, np.maximum(limit, own))
    bad = not np.isfinite(nu).all() or bool((np.abs(nu) > limit).any())
    if bad:
        nu = np.tile(window.nu, (len(nu), 1))
    if not bad and nu.shape != run.shape:
        return Prediction(run, bad)
    pose = integrate(logs[window.log].y[window.start, POSE], nu, step)
    return Prediction(np.concatenate((pose, nu), axis=1), bad)


def _inputs(candidate: Candidate, log: Prepared) -> np.ndarray:
    if candidate.inputs is None:
        return log.w
    known = log.log.stack(candidate.inputs)
    return np.concatenate((known, np.zeros((len(log), candidate.idle))), axis=1)


def _initial(candidate: Candidate, window: Window, log: Prepared) -> np.ndarray:
    states = log.live.states
    known = dict(zip(states, (*log.y[window.start, POSE], *window.nu), strict=True))
    names = candidate.state or states
    return np.array([known[n] if n in known else log.log[n][window.start] for n in names])


def sizes_of(error: np.ndarray, live: Live, turned: np.ndarray | None) -> dict[str, np.ndarray]:
    """Return the sizes [W] of errors of the pose by name, see `Live.ends`.

    Args:
        error: of states [W, 3 + n], psi within half a turn.
        turned: angles between attitudes [W]; None on the surface.
    """
    out = {"position": np.hypot(*error[:, POSITION].T), "heading": np.abs(error[:, HEADING])}
    if turned is not None:
        out |= {"depth": np.abs(error[:, live.states.index("z")]), "attitude": turned}
    return {name: out[name] for name in live.ends}


def drift(y: np.ndarray, live: Live, step: float) -> dict[str, np.ndarray]:
    """Return how far integrated measured velocities end from the measured pose, by name [W].

    See `Live.ends`.

    Args:
        y: measured states [W, L, 3 + n].
        step: between samples in s.
    """
    error = np.zeros_like(y[:, -1])
    for row, one in zip(error, y, strict=True):
        row[POSE] = integrate(one[0, POSE], one[:, live.columns], step)[-1] - one[-1, POSE]
    error[:, HEADING] = wrap_array(error[:, HEADING])
    if not live.spatial:
        return sizes_of(error, live, None)
    down = tilted(torch.from_numpy(y[:, :, live.columns]))[2].numpy()
    way = np.trapezoid(down, dx=step, axis=1)
    depth = live.states.index("z")
    error[:, depth] = way - (y[:, -1, depth] - y[:, 0, depth])
    rate = torch.from_numpy(y[:, :, [live.states.index(name) for name in "pqr"]])
    angles = torch.from_numpy(y[:, 0, ATTITUDE])
    for turn in (0.5 * step * (rate[:, 1:] + rate[:, :-1])).unbind(1):
        angles = rotated(angles, turn)
    return sizes_of(error, live, turn_between(angles.numpy(), y[:, -1, ATTITUDE]))


def integrate(pose: np.ndarray, nu: np.ndarray, step: float) -> np.ndarray:
    """Return the pose [L, 3] from its first value [3] and what moves [L, n].

    By the trapezoidal rule, heading first, then position.
    """

    def trapezoid(start: float, rate: np.ndarray) -> np.ndarray:
        return start + np.concatenate(([0.0], np.cumsum(0.5 * step * (rate[1:] + rate[:-1]))))

    nu = levelled(nu)
    psi = trapezoid(pose[2], nu[:, 2])
    north = nu[:, 0] * np.cos(psi) - nu[:, 1] * np.sin(psi)
    east = nu[:, 0] * np.sin(psi) + nu[:, 1] * np.cos(psi)
    return np.stack((trapezoid(pose[0], north), trapezoid(pose[1], east), psi), axis=1)
