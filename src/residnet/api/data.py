"""Logs into Python: read, looked at by the data doctor, and prepared for a fit; configs drafted."""

from __future__ import annotations

import glob
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from residnet.api.values import PartGiven, PathGiven, described, hearing, part, path, plain
from residnet.core.arrays import paged
from residnet.core.config import validate
from residnet.core.errors import DataError, UsageError
from residnet.core.layout import Live
from residnet.core.log import Log
from residnet.core.names import nearest
from residnet.core.progress import ProgressCallback, report, say
from residnet.data.doctor import inspect as examine
from residnet.data.doctor import inspect_together
from residnet.data.drafting.questions import Marks, Question, commented
from residnet.data.drafting.reading import log_files, read_each
from residnet.data.motion import MotionConfig, complete_motion
from residnet.data.prepare import PrepareConfig, Prepared
from residnet.data.prepare import prepare as prepare_log
from residnet.data.readers import ReaderConfig
from residnet.data.simulated import SimulatedTrials
from residnet.data.sources import DataConfig, MeasuredLogs
from residnet.data.sources import read_logs as read_splits
from residnet.data.split import SPLITS, check_leaks, divided, log_names
from residnet.identification.recipe import Preparation, judging
from residnet.judge.protocol import EvaluationConfig, longest_stretch
from residnet.physics.signals import SignalsConfig
from residnet.tasks.drafting import Draft, drafted, driving

if TYPE_CHECKING:
    import pandas as pd

LogsGiven = PathGiven | Log | Sequence[PathGiven] | Sequence[Log]
"""Logs that were read, or where to read them."""
"""Recipes by name."""


def read_logs(
    source: LogsGiven,
    *,
    channels: Mapping[str, Any] | None = None,
    time: str | tuple[str, str] | Mapping[str, str] = "t",
    manoeuvre: str | None = None,
    reader: PartGiven | None = None,
    progress: ProgressCallback | None = None,
) -> list[Log]:
    """Read logs from files, patterns or folders.

    A table (csv, foreign Parquet) needs to be told what its columns are: by `channels`, or by a
    `reader` as YAML has it. Without either the reader is drafted as `draft` does it, by names,
    headers, values and physics; it is reported to `progress`, with a comment at each guess.

    Args:
        source: a path, a pattern such as `trials/*.csv`, a folder, or a list of these.
        channels: channel -> (column, unit), for example `{"u": ("speed", "kn")}`, or a mapping with
            column, unit, sign and frame as YAML has it.
        time: column that holds time, in s, or (column, unit).
        manoeuvre: kind of manoeuvre of every file; `folder` takes the name of each file's folder.
        reader: kind or settings of a reader, in place of `channels`.
        progress: is told how far the reading is.

    Returns:
        The logs in the order of the files: channels [T] in SI units and radians.

    Raises:
        UsageError: where there is no such file, or a column or unit is wrong.
        DataError: where the contents of a file cannot be used.

    Example:
        logs = residnet.read_logs("trials/*.csv", channels={"u": ("speed", "kn"), ...})
    """
    given: list[Any] = list(source) if isinstance(source, list | tuple) else [source]
    if not given:
        raise UsageError("read_logs: no log is given; name files, a pattern or a folder")
    read = [isinstance(entry, Log) for entry in given]
    if all(read):
        return given
    if any(read):
        raise UsageError("read_logs: give either paths or logs that were read, not both")
    if reader is not None and channels is not None:
        raise UsageError("read_logs: give channels or a reader, not both")
    with hearing(progress):
        files = log_files([file for entry in given for file in _matching(entry)])
        logs = dict[Path, Log]()
        settings: Any = None if reader is None else part(reader, "reader")
        if channels is not None:
            settings = {
                "kind": "parquet" if files[0].suffix == ".parquet" else "csv",
                "time": _column(time, "time", "s"),
                "channels": {name: _column(entry, name) for name, entry in channels.items()},
                "manoeuvre": manoeuvre,
            }
        if settings is None:
            for draft in read_each(files):
                for error in draft.left_out.values():
                    raise error
                if {"channels", "parts"} & set(draft.reader):
                    say(f"{next(iter(draft.logs))}: channel map as guessed, to be checked")
                    content = {"data": {"reader": draft.reader}}
                    for line in commented(content, draft.marks.comments).splitlines():
                        say(f"  {line}")
                logs |= draft.logs
        else:
            chosen = validate(plain(settings), ReaderConfig, "read_logs").build()
            for number, file in enumerate(chosen.logs_among(files)):
                report("reading logs", number, len(files))
                logs[file] = chosen.read(file)
            report("reading logs", len(files), len(files))
    names = log_names(logs)
    return [logs[file].replace(name=names[file]) for file in files if file in logs]


def _matching(entry: Any) -> list[Path]:
    file = path(entry, "read_logs")
    if file.exists() or not glob.has_magic(str(file)):
        return [file]
    found = sorted(Path(name) for name in glob.glob(str(file), recursive=True))  # noqa: PTH207
    if not found:
        raise UsageError(f"read_logs: '{file}' matches no file")
    return found


def _column(given: Any, name: str, unit: str | None = None) -> Any:
    if isinstance(given, tuple | list) and len(given) == 2:
        return {"column": given[0], "unit": given[1]}
    if isinstance(given, str) and unit is not None:
        return {"column": given, "unit": unit}
    if isinstance(given, str):
        raise UsageError(
            f"read_logs: channels: {name}: give the column and its unit, for example"
            f" ('{given}', 'm/s')"
        )
    if isinstance(given, Mapping):
        return given
    raise UsageError(f"read_logs: channels: {name}: expected (column, unit), {described(given)}")


def inspect(
    logs: LogsGiven, *, inputs: Sequence[str] | None = None, masks: Sequence[Any] = ()
) -> pd.DataFrame:
    """Look at logs as a doctor would: clocks, gaps, jumps, frames, lags, copies, excitation.

    Args:
        logs: from `read_logs`, or what it takes.
        inputs: channels that drive the vessel; all that no sensor of the motion measures where
            None.
        masks: rules that will leave samples out, as YAML has them.

    Returns:
        One row for each finding, with the columns log (`together` for what concerns several), level
        (`note`, `will mislead`, `fatal`), code, text and action. A fit would be misled where any
        level is above `note`.

    Raises:
        UsageError: where a log lacks an input, or a path is wrong.
        DataError: where a log cannot be examined.

    Example:
        findings = residnet.inspect(logs); findings[findings.level != "note"]
    """
    import pandas as pd

    members = read_logs(logs)
    settings = {"grid": {"step": 1.0}, "masks": plain(masks)}
    rules = validate(settings, PrepareConfig, "inspect").masks
    reports = [*(examine(log, inputs, rules) for log in members), inspect_together(members, inputs)]
    columns = ["level", "code", "text", "action"]
    rows = [
        [doctor.name, *(getattr(finding, name) for name in columns)]
        for doctor in reports
        for finding in doctor.findings
    ]
    return pd.DataFrame(rows, columns=["log", *columns])


def draft(
    logs: PathGiven | Sequence[PathGiven],
    *,
    name: str = "my_boat",
    folder: PathGiven = ".",
    answer: Callable[[Question], str] | None = None,
    progress: ProgressCallback | None = None,
) -> Draft:
    """Draft a complete config of a fit from logs of any format.

    Channels, units, frames, inputs, splits, protocols and scales are proposed by names, headers,
    values and physics, models by the standard recipe. What the logs do not tell is a guess, and
    marked as one.

    Args:
        logs: files, folders and bags: one, or a list of these.
        name: of the run.
        folder: where the config will lie; its paths start from there.
        answer: is given each question that the logs leave open, and returns its answer; None takes
            the defaults.
        progress: is told how far the reading is.

    Returns:
        The draft: `config` for `residnet.run`, `guesses` as pairs of key and reason, `text` as
        YAML with comments, and `save(file)`.

    Raises:
        UsageError: where a path does not exist, or nothing in the logs drives the vessel.
        DataError: where no log can be used.

    Example:
        draft = residnet.draft("trials/"); draft.save("my_boat.yaml"); residnet.run("my_boat.yaml")
    """
    given = list(logs) if isinstance(logs, list | tuple) else [logs]
    if not given:
        raise UsageError("draft: no log is given; name files, folders or bags")
    with hearing(progress):
        paths = [path(one, "draft") for one in given]
        return drafted(paths, Path(folder), name, answer)


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

        rows = [log.described(split) for split, logs in self.splits.items() for log in logs]
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
    held: Sequence[str] | None = None,
    like: Data | None = None,
    progress: ProgressCallback | None = None,
    **settings: Any,
) -> Data:
    """Bring logs to a grid, smooth and differentiate them, and say what models are judged by.

    What is left out follows from the logs, as in a config that `draft` writes: inputs by names and
    values; step and derivative by the sampling interval and by how long the yaw rate stays alike;
    models are judged over back-to-back windows of the length that most of the logs for judging
    hold, and of about a third of it; scales are the standard deviations of u, v and r over training
    and validation logs. Where logs tell some of u, v and r alone, models are of these; where all
    tell a roll angle, models roll.

    Args:
        logs: a list of logs (of each five, in the order of their manoeuvres, the third is for
            validation and the fifth for the test; fewer are cut in time), a mapping from `train`,
            `validation` and `test` to logs, or the `data` section of a config.
        inputs: command channels that drive the model, in order; an empty list for a model without
            any.
        step: of the grid in s.
        held: channels whose last value holds until the next; others are interpolated.
        like: data whose settings are taken over; all logs then form the split `external`.
        progress: is told how far the work is.
        settings: further keys of the sections `signals` (exogenous, forces, velocities),
            `prepare` (masks, derivative, motion, trim, hold, beside) and `evaluation` (protocols,
            selection, scales, groups, divergence) of a config, as YAML has them; without
            `selection` the first of `protocols` chooses between models.

    Returns:
        The data: y, smooth [T, 3 + n], nu_dot [T, n], w [T, m] of each log, float64, SI.

    Raises:
        ConfigError: where a setting is wrong.
        UsageError: where a channel is missing, or no inputs are named.
        DataError: where a log holds nothing to learn from or to predict, or splits share data.

    Example:
        data = residnet.prepare(logs, ["n_port", "n_stbd"])
    """
    with hearing(progress):
        if like is not None:
            external = read_logs(logs)  # type: ignore[arg-type]
            prepared = _prepared({"external": external}, like.signals, like.prepare)
            return Data(prepared, like.signals, like.prepare, like.evaluation)
        splits, source = _splits(logs)
        given = settings.get("velocities")
        told = [Live.told(log.channels) for members in splits.values() for log in members]
        live = Live.shared(told)
        if given is not None:
            live = validate(
                {"inputs": [], "velocities": plain(given)}, SignalsConfig, "prepare"
            ).live
        whole = {
            name: [complete_motion(log, MotionConfig(), live) for log in members]
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
        chosen = Preparation.of(every, known, live)
        if live.text:
            say(f"velocities: {live.text}")
        say(f"recipe: {chosen.reason}")
        judged: dict[str, Any] = {}
        content = chosen.content()
        grid = {"step": step, "held": held}
        content["grid"] |= {key: value for key, value in grid.items() if value is not None}
        if settings.get("protocols") is not None:
            if not isinstance(settings["protocols"], Mapping):
                given = described(settings["protocols"])
                raise UsageError(f"prepare: protocols: expected a mapping by name, given {given}")
            judged["selection"] = next(iter(settings["protocols"]), "")
        signals = {
            "inputs": taken if isinstance(taken, str) else list(taken),
            "exogenous": chosen.exogenous,
            "velocities": live.velocities,
        }
        # what no section knows is refused as an unknown key of `prepare`
        homes: Any = (
            (SignalsConfig, signals),
            (EvaluationConfig, judged),
            (PrepareConfig, content),
        )
        for key, value in settings.items():
            home = next((c for kind, c in homes if key in kind.model_fields), content)
            if value is not None:
                home[key] = value
        model = validate(plain(signals), SignalsConfig, "prepare")
        preparation = validate(plain(content), PrepareConfig, "prepare")
        prepared, step = _prepared(splits, model, preparation), preparation.grid.step
        lasting = {
            split: [longest_stretch(log) * step for log in members]
            for split, members in prepared.items()
        }
        judged = judging(whole, lasting, chosen.memory, live) | judged
        evaluation = validate(plain(judged), EvaluationConfig, "prepare")
        return Data(prepared, model, preparation, evaluation, source)


def _prepared(
    splits: Mapping[str, Sequence[Log]], signals: SignalsConfig, config: PrepareConfig
) -> dict[str, list[Prepared]]:
    done, total = 0, sum(map(len, splits.values()))
    out: dict[str, list[Prepared]] = {}
    for split, members in splits.items():
        out[split] = paged.OneByOne()
        for log in members:
            report("preparing logs", done, total)
            out[split].append(prepare_log(log, split, signals.columns, config, signals.live))
            if not out[split][-1].good.any():
                raise DataError(
                    f"log {log.name}: no stretch is as long as the derivative's window; leave the"
                    " log out or give a shorter derivative window"
                )
            done += 1
    report("preparing logs", total, total)
    return out


def _splits(logs: Any) -> tuple[dict[str, list[Log]], MeasuredLogs | SimulatedTrials | None]:
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
