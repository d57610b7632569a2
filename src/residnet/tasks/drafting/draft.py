"""A complete config of a fit from logs alone, with a comment wherever it is a guess."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from residnet.core.config import validate
from residnet.core.errors import DataError, ResidnetError, UsageError
from residnet.core.log import Log
from residnet.core.progress import say
from residnet.data.division import divided, without_copies
from residnet.data.doctor import inspect
from residnet.data.drafting.channels import CHANNELS
from residnet.data.drafting.questions import Answer, Marks
from residnet.data.drafting.reading import INPUTS, log_files, read_drafted
from residnet.data.motion import MotionConfig, complete_motion
from residnet.data.prepare import PrepareConfig, prepare
from residnet.data.readers.quantities import QUATERNION
from residnet.identification.recipe import Preparation, judging, protocols, window_length
from residnet.tasks.drafting import recipe
from residnet.tasks.drafting.inputs import driving, lacks
from residnet.tasks.drafting.yaml_text import commented
from residnet.tasks.fit import FitConfig

_UNTOLD = ("columns that no channel takes", "columns of text", "fields that no channel takes")
_INSPECTED = 12
"""Logs that the data doctor looks at."""
_SHOWN = 12
"""Guesses that the terminal shows."""


@dataclass(frozen=True)
class Draft:
    """A config that runs, and what of it is a guess.

    Attributes:
        config: the content of the YAML file.
        guesses: key -> why its value is a guess.
        text: the YAML with its comments.
    """

    config: dict[str, Any]
    guesses: tuple[tuple[str, str], ...]
    text: str

    def save(self, file: Path | str) -> Path:
        """Write the config as YAML with its comments; returns the path of the file.

        Raises:
            UsageError: where the file cannot be written.
        """
        path = Path(file)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(self.text, encoding="utf-8")
        except OSError as error:
            raise UsageError(f"{path}: cannot be written ({error.strerror})") from error
        return path


def drafted(
    paths: Sequence[Path],
    folder: Path,
    name: str,
    answer: Answer | None = None,
    *,
    standard: bool = False,
) -> Draft:
    """Return a config for logs that the task `fit` runs as it is.

    Args:
        paths: files, folders and bags.
        folder: where the config will lie; its paths start from there.
        name: of the run.
        answer: answers questions; None takes every default and marks it.
        standard: propose the standard recipe in place of a few models that are fitted sooner.

    Raises:
        UsageError: where a path does not exist, or nothing drives the vessel in the logs.
        DataError: where no log can be used.
    """
    marks = Marks(answer)
    read = _completed(log_files(paths, folders=True), marks)
    inputs = driving(list(read.whole.values()), marks)
    if not inputs:
        held = ", ".join(next(iter(read.whole.values())).channels)
        marks.guess(
            INPUTS,
            "no channel of the logs is a rudder, a propeller or another command (they hold"
            f" {held}): a model without them can only predict how the vessel coasts; name the"
            " columns that drive it",
        )
    elif lacking := lacks(inputs):
        marks.guess(
            INPUTS,
            f"nothing among the inputs {lacking} the vessel; where a column that no channel takes"
            " does, name it under data.reader.channels",
        )
    renamed, inputs = _plain_names(read, inputs, marks)
    return _assembled(renamed, inputs, folder, name, marks, standard)


@dataclass
class _Logs:
    """The logs of a draft.

    Attributes:
        reader: `data.reader` of the config.
        logs: path -> log, in SI, as the reader gives it.
        whole: path -> the same with the motion at every sample.
        left_out: path -> why it is not used.
    """

    reader: dict[str, Any]
    logs: dict[Path, Log]
    whole: dict[Path, Log]
    left_out: dict[Path, str]


def _completed(paths: Sequence[Path], marks: Marks) -> _Logs:
    read = read_drafted(paths, marks)
    left_out = {path: str(error) for path, error in read.left_out.items()}
    whole: dict[Path, Log] = {}
    for path, log in read.logs.items():
        try:
            whole[path] = complete_motion(log, MotionConfig())
        except ResidnetError as error:
            left_out[path] = str(error)
    if not whole:
        # what the names of columns did not tell may be what is missing
        untold = "; ".join(text for _, text in marks.notes if text.startswith(_UNTOLD))
        reason = next(iter(left_out.values()))
        raise DataError(f"{reason} ({untold})" if untold else reason)
    return _Logs(read.reader, {path: read.logs[path] for path in whole}, whole, left_out)


def _plain_names(read: _Logs, inputs: Sequence[str], marks: Marks) -> tuple[_Logs, tuple[str, ...]]:
    """Rename chosen forces to tau_x, tau_y, tau_n, and drop channels that nothing uses."""
    new = {name: name for name in inputs}
    for name in inputs:
        for force in ("tau_x", "tau_y", "tau_n"):
            if name.startswith(f"{force}_"):
                new[name] = force
    channels = read.reader.get("channels")
    state = ["x", "y", "psi", "u", "v", "r", "wind_speed", "wind_dir"]
    if channels:
        if "x" not in channels:
            state += ["latitude", "longitude"]
        if "psi" not in channels:
            state += QUATERNION
        kept = {
            new.get(name, name): entry
            for name, entry in channels.items()
            if name in state or name in new
        }
        read.reader["channels"] = kept
        marks.rename(CHANNELS, {name: new.get(name, name) for name in (*state, *new)})
    for logs in (read.logs, read.whole):
        for path, log in list(logs.items()):
            changed = {new.get(key, key): values for key, values in log.channels.items()}
            units = {new.get(key, key): unit for key, unit in log.units.items()}
            logs[path] = log.replace(channels=changed, units=units)
    return read, tuple(new.values())


def _assembled(
    read: _Logs,
    inputs: tuple[str, ...],
    folder: Path,
    name: str,
    marks: Marks,
    standard: bool,
) -> Draft:
    whole = list(read.whole.values())
    time = Preparation.of(whole, inputs)
    wind = time.exogenous
    codes = _findings(list(read.logs.values()), inputs, marks)
    preparation = time.content() | ({"masks": [{"kind": "frozen"}]} if "frozen" in codes else {})
    usable = _usable(read, (*inputs, *wind), preparation)
    split, splits = _split(read, usable, folder, marks)
    judged = [splits[name] for name in ("validation", "test")]
    length = window_length(judged, time.memory)
    split, splits = _long_enough(split, splits, length, marks)
    samples = int(sum(log.t[-1] - log.t[0] for log in splits["train"]) / time.step)
    recipe.mark_timing(time, length, marks)
    thrown = [name for name, entry in read.reader.get("channels", {}).items() if "scale" in entry]
    plan = recipe.models(inputs, bool(wind), time, length, samples, thrown)
    if standard and inputs:
        plan = {"recipe": "standard"}
        marks.note(("recipe",), "eight models or so, whose terms and sizes follow from the logs")
    marks.note(("evaluation", "scales"), "standard deviations over training and validation logs")
    config = {
        "task": "fit",
        "name": name,
        "description": f"Drafted by residnet new from {len(usable)} logs",
        "data": {"kind": "measured", "reader": read.reader, "split": split},
        "prepare": preparation,
        "signals": {"inputs": list(inputs), **({"exogenous": list(wind)} if wind else {})},
        "integrator": "semi_implicit_euler",
        **plan,
        "export": {"models": []},
        "evaluation": judging(splits, length),
    }
    validate(config, FitConfig, "draft", folder)
    head = _head(read, marks)
    guesses = tuple((".".join(key), text) for key, text in marks.guesses)
    return Draft(config, guesses, commented(config, marks.comments, head))


def _findings(logs: Sequence[Log], inputs: Sequence[str], marks: Marks) -> set[str]:
    """Return the codes of what the data doctor finds, and write its findings down."""
    codes: set[str] = set()
    told: dict[str, list[str]] = {}
    for log in logs[:: max(1, len(logs) // _INSPECTED)]:
        try:
            found = inspect(log, [name for name in inputs if name in log.channels])
        except ResidnetError as error:
            marks.note(("data",), f"data doctor: {log.name}: {error}")
            continue
        for finding in found.findings:
            if finding.level != "note":
                codes.add(finding.code)
                told.setdefault(finding.code, []).append(f"{log.name}: {finding.text}")
    for texts in told.values():
        more = f" (and {len(texts) - 1} more logs)" if len(texts) > 1 else ""
        marks.note(("data",), f"data doctor: {texts[0][:300]}{more}")
    return codes


def _usable(read: _Logs, columns: Sequence[str], preparation: Mapping[str, Any]) -> dict[Path, Log]:
    """Return the logs that can be prepared; the others are left out with the reason."""
    config = validate(dict(preparation), PrepareConfig, "draft")
    out: dict[Path, Log] = {}
    for path, log in read.logs.items():
        try:
            prepared = prepare(log, "train", columns, config)
        except ResidnetError as error:
            read.left_out[path] = str(error)
            continue
        if prepared.good.any():
            out[path] = read.whole[path]
        else:
            read.left_out[path] = "no stretch is as long as the window of the derivative"
    if not out:
        raise DataError(next(iter(read.left_out.values())))
    kept = {log.name for log in without_copies(list(out.values()))}
    for path, log in list(out.items()):
        if log.name not in kept:
            read.left_out[path] = "its rows are a copy of part of another log"
            del out[path]
    return out


def _split(
    read: _Logs, usable: Mapping[Path, Log], folder: Path, marks: Marks
) -> tuple[dict[str, Any], dict[str, list[Log]]]:
    """Return the split as a config has it, and its logs with their whole motion."""
    splits = divided(list(usable.values()))
    paths = {log.name: path for path, log in usable.items()}
    common = Path(os.path.commonpath([path.resolve().parent for path in usable]))
    root = _relative(common, folder)
    entries: dict[str, list[Any]] = {}
    for split, logs in splits.items():
        entries[split] = []
        for log in logs:
            ends = log.meta.get("stretch")
            # the name of a stretch begins with that of its log, and may with a shorter one
            own = [n for n in paths if n == log.name or (ends and log.name.startswith(n))]
            path = paths[max(own, key=len)]
            entry: Any = path.resolve().relative_to(common).as_posix()
            if ends:
                source = usable[path]
                entry = {"log": entry}
                entry |= {"from": f"{ends[0]:.13g} s"} if ends[0] > source.t[0] else {}
                entry |= {"to": f"{ends[1]:.13g} s"} if ends[1] < source.t[-1] else {}
            entries[split].append(entry)
    cut = any(isinstance(entry, dict) for found in entries.values() for entry in found)
    why = (
        "few logs: each is cut in time"
        if cut
        else "of each five logs, in the order of their manoeuvres, one is for validation and one"
        " for the test"
    )
    marks.guess(("data", "split"), f"{why}; logs of one day may be alike, so check the choice")
    return {"root": root, **entries}, splits


def _relative(path: Path, folder: Path) -> str:
    """Return a path as seen from a folder, absolute where it lies far from it."""
    near = os.path.relpath(path, folder.resolve())
    return path.as_posix() if near.count("..") > 2 else Path(near).as_posix()


def _long_enough(
    split: dict[str, Any], splits: dict[str, list[Log]], length: float, marks: Marks
) -> tuple[dict[str, Any], dict[str, list[Log]]]:
    shortest = 1.2 * min(float(entry["length"].split()[0]) for entry in protocols(length).values())
    for name in ("validation", "test"):
        for entry, log in list(zip(split[name], splits[name], strict=True)):
            if log.t[-1] - log.t[0] >= shortest or len(split[name]) == 1:
                continue
            split[name].remove(entry)
            splits[name] = [other for other in splits[name] if other is not log]
            split["train"].append(entry)
            splits["train"].append(log)
            marks.note(("data", "split"), f"{log.name} is too short to be judged on")
    return split, splits


def _head(read: _Logs, marks: Marks) -> list[str]:
    lines = [
        "Drafted by `residnet new` from the logs alone. Lines with 'guess' say what the logs do not"
        " tell, and why this value was taken: read them before the results are trusted."
    ]
    for path, reason in read.left_out.items():
        lines.append(f"left out: {path.name}: {reason}")
    if "smoothed" in next(iter(read.whole.values())).meta:
        names = ", ".join(next(iter(read.whole.values())).meta["smoothed"])
        lines.append(
            f"{names} are not measured at every sample: a smoother makes them from position and"
            " heading. Where the antenna stands off the vessel's centre, or its positions come"
            " late, add prepare.motion: {antenna: {x: ..., y: ...}, delay: ...}."
        )
    say(f"{len(read.logs)} logs were read, {len(read.left_out)} left out")
    return lines


def new_config(
    logs: Sequence[Path],
    out: Path,
    answer: Answer | None,
    *,
    overwrite: bool,
    standard: bool = False,
) -> list[str]:
    """Write a config for logs; returns what the terminal shows.

    Args:
        logs: files, folders and bags.
        out: file to write.
        answer: asks the user; None takes every default.
        overwrite: replace the file.
        standard: propose the standard recipe.

    Raises:
        UsageError: where the file exists already, or a path does not.
        DataError: where no log can be used.
    """
    if out.suffix not in (".yaml", ".yml"):
        raise UsageError(f"--out {out}: a config is a YAML file; name it {out}.yaml")
    if out.exists() and not overwrite:
        raise UsageError(f"--out {out}: exists; give --overwrite, or another name")
    name = re.sub(r"[^A-Za-z0-9_.-]+", "_", out.stem).strip("_.-") or "my_boat"
    draft = drafted(logs, out.parent, name, answer, standard=standard)
    file = draft.save(out)
    lines = [f"{key}: {why}" for key, why in draft.guesses[:_SHOWN]]
    if len(draft.guesses) > _SHOWN:
        lines.append(f"and {len(draft.guesses) - _SHOWN} more, marked in the file")
    count = len(draft.guesses)
    head = f"{count} values are guesses, each marked in the file:" if lines else ""
    head = "one value is a guess, marked in the file:" if count == 1 else head
    return [*([head] if head else []), *lines, f"config: {file}", f"next: residnet run {file}"]
