"""From logs to identification data: grid, masks, derivatives, splits, protocols and scales."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from residnet.api.logs import LogsGiven, read_logs
from residnet.api.values import described, hearing, plain
from residnet.core.arrays import paged
from residnet.core.config import validate
from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.core.names import nearest
from residnet.core.progress import ProgressCallback, report, say
from residnet.data.division import divided
from residnet.data.drafting.questions import Marks
from residnet.data.motion import MotionConfig, complete_motion
from residnet.data.prepare import PrepareConfig, Prepared
from residnet.data.prepare import prepare as prepare_log
from residnet.data.simulated.trials import SimulatedTrials
from residnet.data.sources import DataConfig, MeasuredLogs
from residnet.data.sources import read_logs as read_splits
from residnet.data.split import SPLITS, check_leaks
from residnet.identification.recipe import Preparation, judging, window_length
from residnet.judge.protocol import EvaluationConfig
from residnet.physics.signals import SignalsConfig
from residnet.tasks.drafting.inputs import driving

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Data:
    """Logs that are ready for a fit, with what models are judged by.

    Attributes:
        splits: prepared logs by split: train, validation, test; external for further ones.
        signals: what drives the models.
        prepare: grid, masks and derivatives.
        evaluation: protocols, scales and selection.
        source: the `data` section of a config that the logs came from; None for others.
    """

    splits: Mapping[str, list[Prepared]]
    signals: SignalsConfig
    prepare: PrepareConfig
    evaluation: EvaluationConfig
    source: MeasuredLogs | SimulatedTrials | None = None

    @property
    def table(self) -> pd.DataFrame:
        """One row for each log: log, split, manoeuvre, seconds, samples, usable, learned_from."""
        import pandas as pd

        rows = [
            {
                "log": log.log.name,
                "split": split,
                "manoeuvre": log.log.manoeuvre,
                "seconds": float(log.log.t[-1] - log.log.t[0]),
                "samples": len(log),
                "usable": float(log.usable.mean()),
                "learned_from": float(log.good.mean()),
            }
            for split, logs in self.splits.items()
            for log in logs
        ]
        return pd.DataFrame(rows)

    def logs(self, split: str) -> list[Prepared]:
        """Return the prepared logs of a split.

        Raises:
            UsageError: where there is no such split.
        """
        if split not in self.splits or not self.splits[split]:
            raise UsageError(f"the data have no split '{split}'{nearest(split, self.splits)}")
        return self.splits[split]


def prepare(
    logs: LogsGiven | Mapping[str, Any],
    inputs: Sequence[str] | None = None,
    *,
    step: float | str | None = None,
    exogenous: Sequence[str] | None = None,
    forces: Any = None,
    masks: Sequence[Any] = (),
    derivative: Mapping[str, Any] | None = None,
    trim: float | str = 0.0,
    hold: str | None = None,
    held: Sequence[str] | None = None,
    protocols: Mapping[str, Any] | None = None,
    selection: str | None = None,
    scales: Mapping[str, Any] | None = None,
    groups: Mapping[str, Sequence[str]] | None = None,
    divergence: float = 3.0,
    like: Data | None = None,
    progress: ProgressCallback | None = None,
) -> Data:
    """Bring logs to a grid, smooth and differentiate them, and say what models are judged by.

    What is left out follows from the logs, as in a config that `draft` writes: inputs by names and
    values; step and derivative by the sampling interval and by how long the yaw rate stays alike;
    models are judged over back-to-back windows of the length that most of the logs for judging
    hold, and of about a third of it; scales are the standard deviations of u, v and r over training
    and validation logs.

    Args:
        logs: a list of logs (of each five, in the order of their manoeuvres, the third is for
            validation and the fifth for the test; fewer are cut in time), a mapping from `train`,
            `validation` and `test` to logs, or the `data` section of a config.
        inputs: command channels that drive the model, in order; an empty list for a model without
            any.
        step: of the grid in s.
        exogenous: channels that nobody commands: wind_speed and wind_dir, where all logs hold them.
        forces: a vessel whose thrusters turn the inputs into tau_x, tau_y, tau_n.
        masks: rules that leave samples out, as YAML has them.
        derivative: how velocities are smoothed and differentiated, as YAML has it.
        trim: seconds left out at both ends of every log before samples are learned from.
        hold: whether an input over a step is the sample at its `start` or the `mean` of its ends;
            the former where all inputs rest most of the time, as commands do.
        held: channels whose last value holds until the next; others are interpolated.
        protocols: by name, as YAML has them.
        selection: name of the protocol that chooses between models.
        scales: what nrmse divides by: u, v in m/s, r in rad/s, or texts with a unit.
        groups: named sets of manoeuvre kinds that get rows of their own.
        divergence: a free run diverges beyond this many times the largest training velocity.
        like: data whose settings are taken over; all logs then form the split `external`.
        progress: is told how far the work is.

    Returns:
        The data: y, smooth [T, 6], nu_dot [T, 3], w [T, m] of each log, float64, SI.

    Raises:
        ConfigError: where a setting is wrong.
        UsageError: where a channel is missing, or no inputs are named.
        DataError: where a log holds nothing to learn from or to predict, or splits share data.

    Example:
        data = residnet.prepare(logs, ["n_port", "n_stbd"])
    """
    with hearing(progress):
        if like is not None:
            return _external(logs, like)
        splits, source = _splits(logs)
        whole = {
            name: [complete_motion(log, MotionConfig()) for log in members]
            for name, members in splits.items()
        }
        every = [log for members in whole.values() for log in members]
        taken = driving(every, Marks()) if inputs is None else inputs
        if inputs is None and not taken:
            raise UsageError(
                "prepare: inputs: no channel of the logs is a rudder, a propeller or another"
                " command; name those that drive the vessel; the first log has"
                f" {', '.join(every[0].channels)} (an empty list makes a model without commands)"
            )
        known = [name for name in taken if all(name in log.channels for log in every)]
        chosen = Preparation.of(every, known)
        say(f"recipe: {chosen.reason}")
        settings = {
            "inputs": list(taken) if not isinstance(taken, str) else taken,
            "exogenous": chosen.exogenous if exogenous is None else exogenous,
            "forces": forces,
        }
        signals: SignalsConfig = validate(plain(settings), SignalsConfig, "prepare")
        content = chosen.content()
        grid = content["grid"] if step is None else {**content["grid"], "step": step}
        if held is not None:
            grid = {**grid, "held": held}
        config: PrepareConfig = validate(
            plain(
                {
                    "grid": grid,
                    "masks": masks,
                    "derivative": derivative or content["derivative"],
                    "trim": trim,
                    "hold": hold or content["hold"],
                }
            ),
            PrepareConfig,
            "prepare",
        )
        prepared = _prepared(splits, signals, config)
        length = window_length([whole[name] for name in SPLITS[1:]], chosen.memory)
        given = {"protocols": protocols, "selection": selection, "scales": scales}
        judged = judging(whole, length) | {k: v for k, v in given.items() if v is not None}
        if not isinstance(judged["protocols"], Mapping):
            raise UsageError(
                f"prepare: protocols: expected a mapping by name, given {described(protocols)}"
            )
        if protocols is not None and selection is None:
            judged["selection"] = next(iter(protocols), "")
        judged |= {"groups": groups or {}, "divergence": divergence}
        evaluation: EvaluationConfig = validate(plain(judged), EvaluationConfig, "prepare")
    return Data(prepared, signals, config, evaluation, source)


def _external(logs: Any, like: Data) -> Data:
    members = read_logs(logs)
    prepared = _prepared({"external": members}, like.signals, like.prepare)
    return Data(prepared, like.signals, like.prepare, like.evaluation)


def _prepared(
    splits: Mapping[str, Sequence[Log]], signals: SignalsConfig, config: PrepareConfig
) -> dict[str, list[Prepared]]:
    done, total = 0, sum(map(len, splits.values()))
    out: dict[str, list[Prepared]] = {}
    for split, members in splits.items():
        out[split] = paged.OneByOne()
        for log in members:
            report("preparing logs", done, total)
            out[split].append(prepare_log(log, split, signals.columns, config))
            if not out[split][-1].good.any():
                raise DataError(
                    f"log {log.name}: no stretch is as long as the derivative's window; leave the"
                    " log out or give a shorter derivative window"
                )
            done += 1
    report("preparing logs", total, total)
    return out


def _splits(
    logs: Any,
) -> tuple[dict[str, list[Log]], MeasuredLogs | SimulatedTrials | None]:
    if isinstance(logs, Mapping) and "kind" in logs:
        source = validate(plain(logs), DataConfig, "prepare")
        return read_splits(source), source
    if isinstance(logs, Mapping):
        for name in logs:
            if name not in SPLITS:
                raise UsageError(f"prepare: unknown split '{name}'{nearest(str(name), SPLITS)}")
        if missing := [name for name in SPLITS if name not in logs]:
            raise UsageError(f"prepare: no logs for {', '.join(missing)}")
        splits = {name: read_logs(logs[name]) for name in SPLITS}
    else:
        splits = divided(read_logs(logs))
    names = [log.name for members in splits.values() for log in members]
    if twice := [name for name in names if names.count(name) > 1]:
        raise UsageError(f"prepare: two logs are named '{twice[0]}'; rename one of them")
    check_leaks(splits)
    return splits, None
