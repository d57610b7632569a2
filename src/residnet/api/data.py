"""From logs to identification data: grid, masks, derivatives, splits, protocols and scales."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.api.logs import LogsGiven, read_logs
from residnet.api.values import described, hearing, plain
from residnet.core.arrays import paged
from residnet.core.config import validate
from residnet.core.errors import DataError, UsageError
from residnet.core.layout import VELOCITIES
from residnet.core.log import Log
from residnet.core.names import VELOCITY, nearest
from residnet.core.progress import ProgressCallback, report
from residnet.data.prepare import PrepareConfig, Prepared
from residnet.data.prepare import prepare as prepare_log
from residnet.data.simulated.trials import SimulatedTrials
from residnet.data.sources import DataConfig, MeasuredLogs
from residnet.data.sources import read_logs as read_splits
from residnet.data.split import SPLITS, check_leaks
from residnet.judge.config import EvaluationConfig
from residnet.physics.signals import SignalsConfig

if TYPE_CHECKING:
    import pandas as pd

_WINDOWS = (30.0, 20.0, 10.0, 5.0, 2.0, 1.0)
_SMOOTHING = 1.0
_FEWEST = 5


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
    exogenous: Sequence[str] = (),
    forces: Any = None,
    masks: Sequence[Any] = (),
    derivative: Mapping[str, Any] | None = None,
    trim: float | str = 0.0,
    hold: str = "start",
    held: Sequence[str] = (),
    protocols: Mapping[str, Any] | None = None,
    selection: str | None = None,
    scales: Mapping[str, Any] | None = None,
    groups: Mapping[str, Sequence[str]] | None = None,
    divergence: float = 3.0,
    like: Data | None = None,
    progress: ProgressCallback | None = None,
) -> Data:
    """Bring logs to a grid, smooth and differentiate them, and say what models are judged by.

    What is left out is taken from the logs: the step is their usual sampling interval; derivatives
    come from a Savitzky-Golay filter of second order over 1 s, at least five samples; models are
    judged over back-to-back windows of up to 30 s (as long as the shortest validation or test log
    allows), which also choose between models, and over whole manoeuvres; scales are the standard
    deviations of u, v and r over the usable samples of the validation logs.

    Args:
        logs: a list of logs (of each five, in the order of their manoeuvres, the third is for
            validation and the fifth for the test; at least three), a mapping from `train`,
            `validation` and `test` to logs, or the `data` section of a config.
        inputs: command channels that drive the model, in order; an empty list for a model without
            any.
        step: of the grid in s.
        exogenous: channels that nobody commands: wind_speed and wind_dir.
        forces: a vessel whose thrusters turn the inputs into tau_x, tau_y, tau_n.
        masks: rules that leave samples out, as YAML has them.
        derivative: how velocities are smoothed and differentiated, as YAML has it.
        trim: seconds left out at both ends of every log before samples are learned from.
        hold: whether an input over a step is the sample at its `start` or the `mean` of its ends.
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
        every = [log for members in splits.values() for log in members]
        if inputs is None:
            raise UsageError(
                "prepare: inputs: name the channels that drive the vessel; the first log has"
                f" {', '.join(every[0].channels)} (an empty list makes a model without commands)"
            )
        settings = {
            "inputs": list(inputs) if not isinstance(inputs, str) else inputs,
            "exogenous": exogenous,
            "forces": forces,
        }
        signals: SignalsConfig = validate(plain(settings), SignalsConfig, "prepare")
        interval = _interval(every) if step is None else step
        config: PrepareConfig = validate(
            plain(
                {
                    "grid": {"step": interval, "held": held},
                    "masks": masks,
                    "derivative": derivative or _smoothing(interval),
                    "trim": trim,
                    "hold": hold,
                }
            ),
            PrepareConfig,
            "prepare",
        )
        prepared = _prepared(splits, signals, config)
        evaluation = _evaluation(prepared, protocols, selection, scales, groups, divergence)
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
        splits = _divided(read_logs(logs))
    names = [log.name for members in splits.values() for log in members]
    if twice := [name for name in names if names.count(name) > 1]:
        raise UsageError(f"prepare: two logs are named '{twice[0]}'; rename one of them")
    check_leaks(splits)
    return splits, None


def _divided(logs: Sequence[Log]) -> dict[str, list[Log]]:
    if len(logs) < len(SPLITS):
        raise UsageError(
            f"prepare: {len(logs)} logs cannot be divided into train, validation and test; give at"
            " least three, or a mapping from splits to logs"
        )
    order = sorted(range(len(logs)), key=lambda i: logs[i].manoeuvre)
    period = min(5, len(logs))
    kinds = {period // 2: "validation", period - 1: "test"}
    out: dict[str, list[Log]] = {name: [] for name in SPLITS}
    for place, i in enumerate(order):
        out[kinds.get(place % period, "train")].append(logs[i])
    return out


def _interval(logs: Sequence[Log]) -> float:
    steps = [float(np.median(np.diff(log.t))) for log in logs if len(log) > 1]
    return float(f"{float(np.median(steps)):.6g}")


def _smoothing(step: float | str) -> dict[str, Any]:
    seconds = validate({"step": step}, _grid(), "prepare").step
    samples = max(_FEWEST, 2 * round(0.5 * _SMOOTHING / seconds) + 1)
    return {"kind": "savitzky_golay", "window": samples * seconds, "order": 2}


def _grid() -> Any:
    from residnet.data.align import GridConfig

    return GridConfig


def _evaluation(
    splits: Mapping[str, Sequence[Prepared]],
    protocols: Mapping[str, Any] | None,
    selection: str | None,
    scales: Mapping[str, Any] | None,
    groups: Mapping[str, Sequence[str]] | None,
    divergence: float,
) -> EvaluationConfig:
    judged = [log for split in ("validation", "test") for log in splits[split]]
    given = _protocols(judged) if protocols is None else plain(protocols)
    if not isinstance(given, dict):
        raise UsageError(
            f"prepare: protocols: expected a mapping by name, given {described(protocols)}"
        )
    settings = {
        "protocols": given,
        "selection": selection or next(iter(given), ""),
        "scales": _scales(splits["validation"]) if scales is None else scales,
        "groups": groups or {},
        "divergence": divergence,
    }
    config: EvaluationConfig = validate(plain(settings), EvaluationConfig, "prepare")
    return config


def _protocols(logs: Sequence[Prepared]) -> dict[str, Any]:
    shortest = min(float(log.log.t[-1] - log.log.t[0]) for log in logs)
    first = min(5.0, 0.1 * shortest)
    whole: dict[str, Any] = {"manoeuvre": {"kind": "manoeuvre"}}
    for length in _WINDOWS:
        if first + length < shortest:
            windows = {"kind": "windows", "length": length, "first": first, "history": first}
            return {f"T{length:g}": windows, **whole}
    return whole


def _scales(logs: Sequence[Prepared]) -> dict[str, float]:
    measured = np.concatenate([log.y[log.usable, VELOCITIES] for log in logs])
    spread = measured.std(axis=0)
    out = {name: float(value) for name, value in zip(VELOCITY, spread, strict=True)}
    if still := [name for name, value in out.items() if not value > 0]:
        raise DataError(
            f"prepare: {still[0]} does not vary in the validation logs, so that errors have no"
            " scale; give scales"
        )
    return out
