"""`residnet new`: a complete config of a fit from logs alone, with a comment at each guess.

What drives the vessel is chosen among channels that say the same.
"""

from __future__ import annotations

import os
import re
import shlex
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.config import validate
from residnet.core.errors import DataError, ResidnetError, UsageError
from residnet.core.files import write_owned
from residnet.core.layout import ALIVE, ROLL, SIX, Live
from residnet.core.log import Log
from residnet.core.names import ACCELERATION, BOW_WIND, CHANNEL_UNITS, STATE, WIND_INPUTS
from residnet.core.ownership import require_replaceable
from residnet.core.progress import say
from residnet.data.doctor import inspect
from residnet.data.drafting.channels import CHANNELS
from residnet.data.drafting.questions import Answer, Marks, commented
from residnet.data.drafting.reading import INPUTS, log_files, read_drafted
from residnet.data.drafting.words import PLANES, input_channel, state_channel, words_of
from residnet.data.motion import MotionConfig, complete_motion
from residnet.data.readers.quantities import COSINE, QUATERNION, SINE
from residnet.data.split import SPLITS, called_splits, divided, stretch_of, without_copies

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
        unused: what the logs hold and the config does not use, and what would mislead a fit.
    """

    config: dict[str, Any]
    guesses: tuple[tuple[str, str], ...]
    text: str
    unused: tuple[str, ...] = ()

    def save(self, file: Path | str) -> Path:
        """Write the config as YAML with its comments; returns the path of the file.

        Raises:
            UsageError: where the file cannot be written, or is not residnet's to replace.
        """
        path = Path(file)
        with write_owned(path) as partial:
            partial.write_text(self.text, encoding="utf-8")
        return path


def new_config(
    logs: Sequence[Path], out: Path, answer: Answer | None, *, overwrite: bool
) -> list[str]:
    """Write a config for logs; returns what the terminal shows.

    Args:
        answer: asks the user; None takes every default.

    Raises:
        UsageError: where the file exists already, or a path does not.
        DataError: where no log can be used.
    """
    if out.suffix not in (".yaml", ".yml"):
        raise UsageError(f"--out {out}: a config is a YAML file; name it {out}.yaml")
    if out.exists() and not overwrite:
        raise UsageError(f"--out {out}: exists; give --overwrite, or another name")
    require_replaceable(out)
    plain = unicodedata.normalize("NFKD", out.stem).encode("ascii", "ignore").decode()
    name = re.sub(r"[^A-Za-z0-9_.-]+", "_", plain).strip("_.-") or "my_boat"
    draft = drafted(logs, out.parent, name, answer)
    file, count = draft.save(out), len(draft.guesses)
    lines = [f"{key}: {why}" for key, why in draft.guesses[:_SHOWN]]
    if count > _SHOWN:
        lines.append(f"and {count - _SHOWN} more, marked in the file")
    if count == 1:
        lines.insert(0, "one value is a guess, marked in the file:")
    elif count:
        lines.insert(0, f"{count} values are guesses, each marked in the file:")
    return [
        *lines,
        *draft.unused,
        f"config: {file}",
        f"next: residnet run {shlex.quote(str(file))}",
    ]


def drafted(paths: Sequence[Path], folder: Path, name: str, answer: Answer | None = None) -> Draft:
    """Return a config for logs that the task `fit` runs as it is.

    Args:
        folder: where the config will lie; its paths start from there.
        answer: answers questions; None takes every default and marks it.

    Raises:
        UsageError: where a path does not exist, or nothing drives the vessel in the logs.
        DataError: where no log can be used.
    """
    marks = Marks(answer)
    read = _Read(log_files(paths), marks)
    inputs = driving(list(read.whole.values()), marks)
    if not inputs:
        held = ", ".join(next(iter(read.whole.values())).channels)
        marks.guess(
            INPUTS,
            "no channel of the logs is a rudder, a propeller or another command (they hold"
            f" {held}): a model without them can only predict how the vessel coasts; name the"
            " columns that drive it",
        )
    elif lacking := lacks(inputs, read.live):
        marks.guess(
            INPUTS,
            f"nothing among the inputs {lacking} the vessel; where a column that no channel takes"
            " does, name it under data.reader.channels",
        )
    inputs = read.keep(inputs, marks)
    live = read.live
    told, doubts = _doubts(list(read.logs.values()), inputs)
    # torch takes 190 MB, which do not stand beside what the doctor takes of a long log
    from residnet.identification.recipe import Preparation, integrator, judging
    from residnet.tasks.fit import FitConfig

    chosen = Preparation.of(list(read.whole.values()), inputs, live)
    signals = {"inputs": list(inputs)}
    if not live.planar:
        signals["velocities"] = list(live.velocities)
        marks.guess(("signals", "velocities"), live.text)
    signals |= {"exogenous": list(chosen.exogenous)} if chosen.exogenous else {}
    measured = {name for log in read.logs.values() for name in log.channels}
    deep = [name for name in SIX.moving if name in measured and name not in ROLL.moving]
    if deep and not live.spatial:
        text = f"{', '.join(deep)}: left out: six degrees of freedom need depth, pitch and roll"
        marks.note(CHANNELS, f"{text} angles, and u and v or a position, that move in all logs")
    if not chosen.exogenous and all(
        {*WIND_INPUTS} <= {*log.channels} for log in read.logs.values()
    ):
        marks.note(CHANNELS, "the wind is left out: its loads need u, v, r and a measured heading")
    preparation = chosen.content()
    for text in doubts:
        marks.note(("data",), f"data doctor: {text}")
    if "frozen" in told:
        where = {"channels": list(live.channels)} if live.dead else {}
        preparation |= {"masks": [{"kind": "frozen", **where}]}
    usable = read.usable((*inputs, *chosen.exogenous), preparation)
    root, parts = _split(read, usable, folder, marks)
    if not called_splits(list(usable.values())):
        # a split that the folders tell stays as it is
        _judge_long_ones(parts, chosen.memory, marks)
    split = {name: [entry for entry, *_ in members] for name, members in parts.items()}
    splits = {name: [log for _, log, _ in members] for name, members in parts.items()}
    lasting = {name: [time for *_, time in members] for name, members in parts.items()}
    judged = judging(splits, lasting, chosen.memory, live)
    marks.note(("prepare", "grid"), chosen.reason)
    marks.note(
        ("evaluation", "protocols"),
        f"free runs as long as most logs hold; {judged['selection']} chooses, on validation logs",
    )
    marks.note(("evaluation", "scales"), "standard deviations over training and validation logs")
    marks.note(("recipe",), "a portfolio of models, whose terms and sizes follow from the logs")
    config = {
        "task": "fit",
        "name": name,
        "description": f"Drafted by residnet new from {len(usable)} logs",
        "data": {"kind": "measured", "reader": read.reader, "split": {"root": root, **split}},
        "prepare": preparation,
        "signals": signals,
        "integrator": integrator(live),
        "recipe": "standard",
        "export": {"models": []},
        "evaluation": judged,
    }
    validate(config, FitConfig, "draft", folder)
    guesses = tuple((".".join(key), text) for key, text in marks.guesses)
    unused = [text for key, text in marks.notes if key[-1] == "channels" or key == ("data",)]
    left_out = [f"left out: {path.name}: {why}" for path, why in read.left_out.items()]
    text = commented(config, marks.comments, read.head())
    return Draft(config, guesses, text, (*left_out, *unused))


def _doubts(logs: Sequence[Log], inputs: Sequence[str]) -> tuple[set[str], list[str]]:
    """Return the codes of what the data doctor finds in some of the logs, and its words."""
    told: dict[str, list[str]] = {}
    doubts = []
    for log in logs[:: max(1, len(logs) // _INSPECTED)]:
        try:
            found = inspect(log, [name for name in inputs if name in log.channels])
        except ResidnetError as error:
            doubts.append(f"{log.name}: {error}")
            continue
        for finding in found.findings:
            if finding.level != "note" or finding.code == "roll":
                told.setdefault(finding.code, []).append(f"{log.name}: {finding.text}")
    for texts in told.values():
        more = f" (and {len(texts) - 1} more logs)" if len(texts) > 1 else ""
        doubts.append(f"{texts[0][:300]}{more}")
    return {*told}, doubts


class _Read:
    """The logs of a draft.

    Attributes:
        reader: `data.reader` of the config.
        live: velocities that most of the logs tell.
        logs: path -> log, in SI, as the reader gives it.
        whole: path -> the same with the motion at every sample.
        left_out: path -> why it is not used.
        lasting: path -> the longest time in s without a gap that preparing leaves of it.
        longest: returns that of any part of a log, in SI as the reader gives it.
    """

    longest: Callable[[Log], float]

    def __init__(self, paths: Sequence[Path], marks: Marks) -> None:
        self.lasting: dict[Path, float] = {}
        read = read_drafted(paths, marks)
        self.reader = read.reader
        self.left_out = {path: str(error) for path, error in read.left_out.items()}
        self.logs: dict[Path, Log] = {}
        self.whole: dict[Path, Log] = {}
        # parts that are not sure to be of one moment would teach a wrong answer
        unsure = {
            path: finding["text"]
            for path, log in read.logs.items()
            for finding in log.meta.get("findings", ())
            if finding["code"] == "joined" and finding["level"] == "will mislead"
        }
        unsure = unsure if len(unsure) < len(read.logs) else {}
        self.left_out |= unsure
        told = [Live.told(log.channels) for log in read.logs.values()]
        self.live = max(told, key=lambda one: (told.count(one), len(one.velocities)))
        for path, log in read.logs.items():
            if path in unsure:
                continue
            try:
                self.whole[path], self.logs[path] = (
                    complete_motion(log, MotionConfig(), self.live),
                    log,
                )
            except ResidnetError as error:
                self.left_out[path] = str(error)
        if not self.whole:
            # what the names of columns did not tell may be what is missing
            untold = "; ".join(text for _, text in marks.notes if text.startswith(_UNTOLD))
            reason = next(iter(self.left_out.values()))
            raise DataError(f"{reason} ({untold})" if untold else reason)

    def keep(self, inputs: Sequence[str], marks: Marks) -> tuple[str, ...]:
        """Rename chosen forces to tau_x, tau_y, tau_n, drop channels that nothing uses; returns the
        inputs.
        """
        new = {
            name: next((f for f in ("tau_x", "tau_y", "tau_n") if name.startswith(f"{f}_")), name)
            for name in inputs
        }
        if channels := self.reader.get("channels"):
            layout = SIX if self.live.spatial else ROLL
            state = [*layout.names, *WIND_INPUTS, *BOW_WIND]
            state += [f"{name}{part}" for name in state for part in (COSINE, SINE)]
            state += [] if "x" in channels else ["latitude", "longitude"]
            state += [] if "psi" in channels else QUATERNION
            self.reader["channels"] = {
                new.get(name, name): entry
                for name, entry in channels.items()
                if name in state or name in new
            }
            marks.rename(CHANNELS, {name: new.get(name, name) for name in (*state, *new)})
        for logs in (self.logs, self.whole):
            for path, log in logs.items():
                changed = {new.get(key, key): values for key, values in log.channels.items()}
                units = {new.get(key, key): unit for key, unit in log.units.items()}
                logs[path] = log.replace(channels=changed, units=units)
        return tuple(new.values())

    def usable(self, columns: Sequence[str], preparation: Mapping[str, Any]) -> dict[Path, Log]:
        """Return the logs that can be prepared; the others are left out with the reason."""
        from residnet.data.prepare import PrepareConfig
        from residnet.identification.recipe import longest_time

        config = validate(dict(preparation), PrepareConfig, "draft")
        self.longest = lambda log: longest_time(log, columns, config, self.live)
        out: dict[Path, Log] = {}
        for path, log in self.logs.items():
            try:
                self.lasting[path] = self.longest(log)
                if self.lasting[path]:
                    out[path] = self.whole[path]
                else:
                    self.left_out[path] = "no stretch is as long as the window of the derivative"
            except ResidnetError as error:
                self.left_out[path] = str(error)
        if not out:
            raise DataError(next(iter(self.left_out.values())))
        kept = {log.name for log in without_copies(list(out.values()))}
        copies = [path for path, log in out.items() if log.name not in kept]
        self.left_out |= dict.fromkeys(copies, "its rows are a copy of part of another log")
        return {path: log for path, log in out.items() if path not in copies}

    def head(self) -> list[str]:
        """Return the lines at the top of the config."""
        lines = [
            "Drafted by `residnet new` from the logs alone. Lines with 'guess' say what the logs do"
            " not tell, and why this value was taken: read them before the results are trusted."
        ]
        lines += [f"left out: {path.name}: {reason}" for path, reason in self.left_out.items()]
        if made := next(iter(self.whole.values())).meta.get("smoothed"):
            lines.append(
                f"{', '.join(made)} are not measured at every sample: a smoother makes them from"
                " position and heading. Where the antenna stands off the vessel's centre, or its"
                " positions come late, add prepare.motion: {antenna: {x: ..., y: ...}, delay: ...}."
            )
        if made := next(iter(self.whole.values())).meta.get("integrated"):
            lines.append(
                f"{', '.join(made)} are not measured: they are integrated from the velocities, and"
                " errors of position and heading are those of integrated velocities."
            )
        say(f"{len(self.logs)} logs were read, {len(self.left_out)} left out")
        return lines


_Part = tuple[Any, Log, float]
"""Entry of a split in a config, its log with the whole motion, and the longest time in s without a
gap that preparing leaves of it."""


def _split(
    read: _Read, usable: Mapping[Path, Log], folder: Path, marks: Marks
) -> tuple[str, dict[str, list[_Part]]]:
    """Return the folder of the logs and their split.

    Raises:
        DataError: where nothing that can be prepared is left of the logs for a split.
    """
    paths = {log.name: path for path, log in usable.items()}
    common = Path(os.path.commonpath([path.resolve().parent for path in usable]))
    near = os.path.relpath(common, folder.resolve())
    # absolute where it lies far from the config
    root = common.as_posix() if near.count("..") > 2 else Path(near).as_posix()
    why = (
        "of each five logs, in the order of their manoeuvres, one is for validation and one for the"
        " test, of eight logs or more three at least"
    )
    if called_splits(list(usable.values())):
        why = "folders or files are called after the splits"
    parts: dict[str, list[_Part]] = {split: [] for split in SPLITS}
    for split, logs in divided(list(usable.values())).items():
        for log in logs:
            ends = log.meta.get("stretch")
            # the name of a stretch begins with that of its log, and may with a shorter one
            own = [n for n in paths if n == log.name or (ends and log.name.startswith(n))]
            path = paths[max(own, key=len)]
            entry: Any = path.resolve().relative_to(common).as_posix()
            time = read.lasting[path]
            if ends:
                why, source = "few logs: each is cut in time", usable[path]
                entry = {"log": entry}
                entry |= {"from": f"{ends[0]:.13g} s"} if ends[0] > source.t[0] else {}
                entry |= {"to": f"{ends[1]:.13g} s"} if ends[1] < source.t[-1] else {}
                try:
                    time = read.longest(stretch_of(read.logs[path], *ends))
                except DataError:
                    time = 0.0
            if time:
                parts[split].append((entry, log, time))
            else:
                text = f"{log.name} is left out: its gaps leave no stretch to learn from"
                marks.note(("data", "split"), text)
        if logs and not parts[split]:
            raise DataError(
                f"the logs hold nothing for {split}: in {', '.join(log.name for log in logs)[:120]}"
                " no stretch without a gap is as long as the window of the derivative; fill gaps"
                " that may be interpolated, or give longer logs"
            )
    marks.guess(("data", "split"), f"{why}; logs of one day may be alike, so check the choice")
    return root, parts


def _judge_long_ones(parts: dict[str, list[_Part]], memory: float, marks: Marks) -> None:
    """Learn from the logs that are too short to be judged on, but for the last one of a split."""
    from residnet.identification.recipe import protocols, window_length

    for name in SPLITS[1:]:
        laid = protocols(window_length([time for *_, time in parts[name]], memory)).values()
        shortest = 1.2 * min(float(entry["length"].split()[0]) for entry in laid)
        for part in list(parts[name]):
            if part[2] < shortest and len(parts[name]) > 1:
                parts[name].remove(part)
                parts["train"].append(part)
                marks.note(("data", "split"), f"{part[1].name} is too short to be judged on")


_PASSIVE = (
    *(*STATE, *ACCELERATION, *SIX.moving, "latitude", "longitude", *QUATERNION),
    *(*WIND_INPUTS, *BOW_WIND, "current_north", "current_east"),
)
_STILL = 2e-3
"""Spread of an input, as a share of its size, below which it stays where it is."""
_SAME = 0.9995
"""Correlation from which two inputs count as one."""
_MOST = 8
"""Most inputs that a drafted config takes."""
_FORCES = ("tau_x", "tau_y", "tau_n")


def driving(logs: Sequence[Log], marks: Marks) -> tuple[str, ...]:
    """Return the channels that drive the vessel; empty where the logs hold none.

    Those that stay where they are, what was ordered beside what was measured, and one of two that
    move alike are left out.

    Args:
        logs: in SI.
        marks: is told what was left out and why.
    """
    values = {
        name: np.concatenate([log[name] for log in logs])
        for name in logs[0].channels
        if name not in _PASSIVE and all(name in log.channels for log in logs)
    }
    # the signals of a control loop: of e_yaw, r_yaw, u_yaw and y_yaw the second drives the vessel
    loops = {
        n[2:] for n in values if n.startswith("y_") and {f"u{n[1:]}", f"r{n[1:]}"} <= {*values}
    }
    own = {f"{signal}_{loop}" for loop in loops for signal in "eruy"}
    acting = [
        name
        for name in values
        if (name in own and name[0] == "u") or (name not in own and _acts(name, marks))
    ]
    if loops:
        marks.guess(
            INPUTS, f"u_{min(loops)} is taken as what a controller asks for, by the names beside it"
        )
    names = [name for name in acting if _moves(name, values[name], marks)]
    names = _measured(_forces(logs, names, marks), marks)
    out: list[str] = []
    for name in names:
        twin = next((other for other in out if _alike(values[name], values[other])), None)
        if twin is None:
            out.append(name)
            continue
        if name in CHANNEL_UNITS and twin not in CHANNEL_UNITS:
            # an angle or revolutions say more than a share or pulses
            out[out.index(twin)], name, twin = name, twin, name
        marks.guess(INPUTS, f"{name} moves as {twin} does in every log, and is left out")
    if len(out) > _MOST:
        marks.guess(INPUTS, f"of {len(out)} possible inputs the first {_MOST} are taken")
    return tuple(out[:_MOST])


def _acts(name: str, marks: Marks) -> bool:
    """Return whether the name of a channel does not say that it measures something else."""
    words = words_of(name)
    if input_channel(words) is not None:
        return True
    passive = not words.lacks("voltage", "age", "depth", "index", "machinery")
    if passive or state_channel(words) is not None:
        marks.note(INPUTS, f"{name} is left out: by its name it drives nothing")
        return False
    marks.guess(INPUTS, f"{name} is taken, though its name does not say what it drives")
    return True


def _moves(name: str, values: np.ndarray, marks: Marks) -> bool:
    known = values[np.isfinite(values)]
    if known.size > 1 and float(np.std(known)) > _STILL * float(np.abs(known).max()):
        return True
    level = float(np.median(known)) if known.size else 0.0
    marks.guess(INPUTS, f"{name} stays at {level:.4g}: its effect cannot be told, it is left out")
    return False


def _forces(logs: Sequence[Log], names: Sequence[str], marks: Marks) -> list[str]:
    """Return one set of forces where there are any; it stands for all actuators."""
    sets: dict[str, list[str]] = {}
    for name in names:
        force = next((f for f in _FORCES if name == f or name.startswith(f"{f}_")), None)
        if force is not None:
            sets.setdefault(name.removeprefix(force), []).append(name)
    shares = {tuple(found): _explained(logs, found) for found in sets.values() if len(found) > 1}
    if not shares:
        return list(names)
    told = ", ".join(f"{', '.join(found)}: {share:.2f}" for found, share in shares.items())
    marks.guess(
        INPUTS, f"forces stand for all actuators; share of the accelerations explained: {told}"
    )
    return list(max(shares.items(), key=lambda pair: pair[1])[0])


def _explained(logs: Sequence[Log], names: Sequence[str]) -> float:
    """Return the mean share of the accelerations that velocities and inputs explain in a line."""
    rows, grown = [], []
    for log in logs:
        wanted = [name for name in (*STATE[3:], *names) if name in log.channels]
        if len(wanted) < 3 + len(names):
            continue
        table = log.stack(wanted)
        span = max(1, round(1.0 / float(np.median(np.diff(log.t)))))
        known = np.isfinite(table).all(axis=1)
        both = known[span:] & known[:-span]
        rows.append(table[:-span][both])
        grown.append((table[span:, :3] - table[:-span, :3])[both])
    if not rows or sum(map(len, rows)) < 50:
        return 0.0
    x, y = np.concatenate(rows), np.concatenate(grown)
    x = np.column_stack(((x - x.mean(0)) / np.maximum(x.std(0), 1e-12), np.ones(len(x))))
    left = y - x @ np.linalg.lstsq(x, y, rcond=1e-9)[0]
    return float((1.0 - left.var(axis=0) / np.maximum(y.var(axis=0), 1e-300)).mean())


def _measured(names: Sequence[str], marks: Marks) -> list[str]:
    """Return the channels without commands whose outcome is measured, and thrust beside turns."""
    turning = [name for name in names if name == "n" or name.startswith("n_")]
    out = []
    for name in names:
        bare = name.removeprefix("cmd_")
        partners = [bare, f"n_{bare}"] if bare != name else []
        found = next((other for other in partners if other in names and other != name), None)
        if found is not None:
            marks.guess(INPUTS, f"{found} is taken as measured, and not what was ordered ({name})")
        elif name.removesuffix("_rate") in {*names} - {name}:
            marks.note(INPUTS, f"{name} is left out beside {name.removesuffix('_rate')}")
        elif name.removeprefix("cmd_").startswith("thrust") and turning:
            marks.note(INPUTS, f"{name} is left out beside {turning[0]}: it follows from it")
        else:
            out.append(name)
    return out


def _alike(a: np.ndarray, b: np.ndarray) -> bool:
    known = np.isfinite(a) & np.isfinite(b)
    if known.sum() < 10 or min(float(np.std(a[known])), float(np.std(b[known]))) == 0.0:
        return False
    return abs(float(np.corrcoef(a[known], b[known])[0, 1])) > _SAME


def lacks(names: Sequence[str], live: Live = ALIVE) -> str:
    """Return what no input does, `drives` or `steers`; empty where both are done.

    A vessel that does not turn needs none that steers, one that does not move none that drives.

    Forces, thrusters that turn, and several thrusters do both.
    """
    plain = [name.removeprefix("cmd_") for name in names if not PLANES.match(name)]
    steering = [name.startswith("delta") for name in plain]
    driving = [name in ("n", "thrust", "throttle") for name in plain]
    # one whose name says neither may do either
    rest = [n for n, s, d in zip(plain, steering, driving, strict=True) if not (s or d)]
    both = any(name.startswith(("tau", "azimuth", "nozzle")) for name in rest)
    if both or any(steering) + any(driving) + len(rest) > 1:
        return ""
    lacking = "drives" if any(steering) else "steers"
    return lacking if {"drives": live.moves, "steers": live.turns}[lacking] else ""
