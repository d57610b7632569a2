"""A run folder read back: configuration, metrics, rollouts and what stands beside them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.config import load_mapping
from residnet.core.errors import DataError, UsageError
from residnet.core.files import file_stem, read_table
from residnet.core.format import SHOWN_UNITS, shown_unit
from residnet.core.frames import wrap_array
from residnet.core.layout import ALIVE, SIX, Live
from residnet.core.names import CHANNEL_UNITS, END_UNITS, to_si
from residnet.core.run_loader import read_json_value, require_listed
from residnet.core.units import known_unit
from residnet.judge.assessment import Assessment
from residnet.judge.metrics import INPUT, columns_of
from residnet.judge.verdict import by_windows

if TYPE_CHECKING:
    import pandas as pd

Content = Mapping[str, Any]
"""What a JSON object holds."""
_FOCUS = ("test", "external", "validation", "train")
"""Splits by how much they say about data that no fit has seen."""

_FINDING_KEYS = ("level", "code", "text", "action")
"""What the card of an export says of a finding of doctor.json."""


@dataclass(frozen=True)
class StoredWindow:
    """A free run of one log over one window under every model.

    Attributes:
        log: name of the log.
        manoeuvre: its kind.
        protocol: name of the protocol.
        number: of the window in its log, from 0.
        t: [T] in s.
        usable: [T], whether u, v and the position are scored.
        measured: [T, 3 + n] of the columns of `columns_of(live)` in SI and rad.
        predicted: the same by model.
        diverged: by model.
        inputs: values [T] by name, SI and rad; empty where the run has stored none.
        low: lower limits of the band [T, 3 + n] by model; empty where no model has one.
        high: upper limits likewise.
        live: velocities that the logs tell; the others are zero.
    """

    log: str
    manoeuvre: str
    protocol: str
    number: int
    t: np.ndarray
    usable: np.ndarray
    measured: np.ndarray
    predicted: dict[str, np.ndarray]
    diverged: dict[str, bool]
    inputs: dict[str, np.ndarray] = field(default_factory=dict)
    low: dict[str, np.ndarray] = field(default_factory=dict)
    high: dict[str, np.ndarray] = field(default_factory=dict)
    live: Live = ALIVE

    def errors(self, model: str) -> pd.DataFrame:
        """Return what a model is off by [T] in SI and rad, `x` standing for the distance in place.

        u, v and the position are NaN where they are not scored; of angles, whole turns do not
        count.
        """
        import pandas as pd

        names = columns_of(self.live)
        error = pd.DataFrame(self.predicted[model] - self.measured, columns=names)
        for angle in {"psi", "phi"}.intersection(names):
            error[angle] = wrap_array(error[angle].to_numpy())
        error["x"] = np.hypot(error["x"], error.pop("y"))
        error.loc[~self.usable, ["u", "v", "x"]] = np.nan
        return error

    def rmse(self, model: str) -> np.ndarray:
        """Return the root mean square errors [n] of what moves, over the samples that count."""
        found = self.errors(model)[list(self.live.moving)].pow(2).mean().pow(0.5)
        return found.to_numpy()

    def nrmse(self, model: str, scales: Mapping[str, float]) -> float:
        """Return the mean over the channels of `scales` of the error over the scale."""
        columns = [self.live.moving.index(name) for name in scales]
        return float((self.rmse(model)[columns] / [*scales.values()]).mean())


class RunFiles:
    """The contents of a run folder of any task, or of what `residnet evaluate` writes.

    Parts that a folder does not have are empty. What belongs to a fit (`rows`, `kinds`, `row` and
    so on) needs its metrics.json.
    """

    def __init__(self, path: Path) -> None:
        """Look at a folder; files are read when they are first needed.

        Raises:
            UsageError: where there is no such folder.
        """
        if not path.is_dir():
            raise UsageError(f"{path}: no such folder; give the folder of a run")
        self.path = path

    def json(self, name: str) -> Any:
        """Return what a JSON file of the folder holds, an empty object where there is none.

        Raises:
            UsageError: if the file cannot be read.
        """
        path = self.path / name
        if not os.path.lexists(path):
            return {}
        require_listed(self.path, name)
        return read_json_value(path, self.path)

    def frame(self, name: str) -> Any:
        """Return a parquet file of the folder as a pandas table, None where there is none."""
        path = self.path / name
        if not os.path.lexists(path):
            return None
        require_listed(self.path, name)
        return read_table(path)

    def assessment(self, judged: tuple[str, Sequence[str]] | None = None) -> Assessment:
        """Return what the run says of its model and of its logs, for the card of an export.

        Args:
            judged: level and sentences of the verdict on the model; None for those of the run.

        Raises:
            DataError: where a file of the run cannot be read.
        """
        summary, inspection = self.json("summary.json"), self.json("doctor.json")
        level, verdict = judged or (summary.get("level") or "", summary.get("verdict") or [])
        findings = None
        if inspection:
            logs = [(log["name"], log["findings"]) for log in inspection.get("logs") or []]
            logs.append(("", inspection.get("together") or []))
            findings = [
                {"log": log or None, **{key: row[key] for key in _FINDING_KEYS}}
                for log, rows in logs
                for row in rows
                if row["level"] != "note"
            ]
        split: dict[str, list[str]] = {}
        for entry in self.quality:
            split.setdefault(str(entry["split"]), []).append(str(entry["log"]))
        return Assessment(level, tuple(verdict), findings, split or None)

    @cached_property
    def metrics(self) -> Content:
        """The contents of metrics.json.

        Raises:
            UsageError: where the folder holds none.
            DataError: where it cannot be read.
        """
        path = self.path / "metrics.json"
        if not path.is_file():
            raise UsageError(
                f"{self.path}: no metrics.json here; give the folder of a finished run"
            )
        content = self.json("metrics.json")
        if not isinstance(content, dict) or not content.get("rows"):
            raise DataError(f"{path}: holds no rows")
        return content

    @property
    def rows(self) -> Sequence[Content]:
        """The rows of metrics.json."""
        rows: Sequence[Content] = self.metrics["rows"]
        return rows

    @cached_property
    def resolved(self) -> Content:
        """The configuration of the run."""
        path = self.path / "resolved.yaml"
        return load_mapping(path) if path.is_file() else {}

    @cached_property
    def quality(self) -> Sequence[Content]:
        """What each log holds (data_quality.json)."""
        return self.json("data_quality.json") or []

    @cached_property
    def provenance(self) -> Content:
        """How the run was made (provenance.json)."""
        provenance: Content = self.json("provenance.json")
        return provenance

    @cached_property
    def limits(self) -> Content:
        """What limits the models (limits.json)."""
        limits: Content = self.json("limits.json")
        return limits

    @property
    def title(self) -> str:
        """The name of the run, else that of its folder."""
        return str(self.resolved.get("name") or self.path.name)

    @property
    def description(self) -> str:
        """What the run was made for."""
        return str(self.resolved.get("description") or "")

    @cached_property
    def kinds(self) -> dict[str, str]:
        """The kind (zero, baseline, head, truth, ...) of each model, in the order of metrics.json.

        Reductions refer to the first baseline; the others are `further` models, judged like heads.
        """
        kinds = {row["model"]: row.get("kind", "head") for row in self.rows}
        first = next((model for model, kind in kinds.items() if kind == "baseline"), None)
        return {
            model: "further" if kind == "baseline" and model != first else kind
            for model, kind in kinds.items()
        }

    @cached_property
    def selected(self) -> str | None:
        """The model chosen on validation data, None where none was."""
        chosen = [row["model"] for row in self.rows if row.get("selected")]
        return self.metrics.get("selected") or (chosen[0] if chosen else None)

    @cached_property
    def predictor(self) -> str | None:
        """The model that is reported first; the selected one where no other is named."""
        return self.metrics.get("predictor") or self.selected

    @cached_property
    def baseline(self) -> str | None:
        """The model that reductions refer to."""
        return next((model for model, kind in self.kinds.items() if kind == "baseline"), None)

    @cached_property
    def truth(self) -> str | None:
        """The plant that made the data, where they are simulated."""
        return next((model for model, kind in self.kinds.items() if kind == "truth"), None)

    @cached_property
    def heads(self) -> list[str]:
        """The models that are neither zero, baseline nor truth, the predictor first."""
        heads = [
            model for model, kind in self.kinds.items() if kind not in ("zero", "baseline", "truth")
        ]
        return sorted(heads, key=lambda model: (model != self.predictor, model != self.selected))

    @cached_property
    def lead(self) -> str:
        """The model that a report is on: the predictor, else the first head or the baseline."""
        names = [self.predictor, *self.heads, self.baseline, *self.kinds]
        return next(name for name in names if name is not None and name in self.kinds)

    @cached_property
    def splits(self) -> list[str]:
        """The splits of the rows, in their order."""
        return list(dict.fromkeys(row["split"] for row in self.rows))

    @cached_property
    def focus(self) -> str:
        """The split that the report speaks of: test where there is one."""
        return next((split for split in _FOCUS if split in self.splits), self.splits[0])

    @cached_property
    def sides(self) -> list[str]:
        """The splits that stand side by side: train, where there is one, and the focus."""
        return [split for split in ("train",) if split in self.splits and split != self.focus] + [
            self.focus
        ]

    @cached_property
    def protocols(self) -> list[str]:
        """The protocols of the rows, the one by which the focus is judged first."""
        return by_windows(self.rows, self.focus, self.evaluation.get("selection", ""))

    @property
    def deciding(self) -> str:
        """The protocol that chose between the models."""
        return str(self.evaluation.get("selection") or self.protocols[0])

    @cached_property
    def main(self) -> str:
        """The protocol of the first screen: the first whose free runs have one length, if any has.

        That which selects comes first.
        """
        kinds = self.evaluation.get("protocols") or {}
        timed = [name for name in self.protocols if (kinds.get(name) or {}).get("length")]
        return (timed or self.protocols)[0]

    @cached_property
    def horizon(self) -> str:
        """When the errors of the main protocol are taken: after so many seconds, or at the end."""
        length = ((self.evaluation.get("protocols") or {}).get(self.main) or {}).get("length")
        return f"after {length:g} s" if length else "at the end"

    @property
    def evaluation(self) -> Content:
        """The section `evaluation` of the configuration."""
        return self.resolved.get("evaluation") or {}

    @cached_property
    def channels(self) -> list[str]:
        """The channels that are scored."""
        return [name for name in self.rows[0]["rmse"] if name != "mean"]

    @cached_property
    def live(self) -> Live:
        """The velocities that the logs tell; models leave the others at zero."""
        return Live(tuple(name for name in SIX.velocities if name in self.channels))

    @property
    def place(self) -> str:
        """What an error of the position is called: without a heading it is that of a distance."""
        return "position" if self.live.turns else "distance run"

    @cached_property
    def ends(self) -> list[str]:
        """What of `END_UNITS` is scored at the end of free runs."""
        return [end for end in END_UNITS if f"{end}_error_end" in self.rows[0]]

    def end(self, end: str) -> tuple[str, str, float]:
        """Return name, unit and the factor to it from SI of an error at the end of free runs."""
        return self.place if end == "position" else end, *shown_unit(END_UNITS[end])

    def row(
        self, model: str | None, split: str, protocol: str, manoeuvre: str = "all"
    ) -> Content | None:
        """Return a row of metrics.json, None where there is none."""
        wanted = (model, split, protocol, manoeuvre)
        return next(
            (
                row
                for row in self.rows
                if (row["model"], row["split"], row["protocol"], row.get("manoeuvre", "all"))
                == wanted
            ),
            None,
        )

    def manoeuvres(self, split: str, protocol: str) -> list[str]:
        """Return the kinds and named groups of manoeuvres that have rows, without `all`."""
        names = [
            row.get("manoeuvre", "all")
            for row in self.rows
            if row["split"] == split and row["protocol"] == protocol
        ]
        return [name for name in dict.fromkeys(names) if name != "all"]

    def label(self, model: str) -> str:
        """Return the name of a model in tables, with its role where it has a special one."""
        if self.kinds.get(model) == "truth":
            return f"{model} (plant)"
        if model == self.predictor != self.selected:
            return f"{model} (predictor)"
        return f"{model} (selected)" if model == self.selected else model

    def unit(self, channel: str) -> tuple[str, float]:
        """Return the unit in which a channel is shown and the factor to it from SI.

        It is that of the log's channel map, and degrees where that has radians.
        """
        reader = (self.resolved.get("data") or {}).get("reader") or {}
        given = (reader.get("channels") or {}).get(channel) or {}
        if unit := given.get("unit"):
            known = known_unit(unit, CHANNEL_UNITS.get(channel))
            return shown_unit(known) if known in SHOWN_UNITS else (known, 1.0 / to_si(known))
        return shown_unit(self.si(channel))

    def si(self, channel: str) -> str:
        """Return the SI unit of a channel, `-` where it is not known."""
        known = self.metrics.get("channels") or {}
        return str(known.get(channel) or CHANNEL_UNITS.get(channel, "-"))

    def card(self, model: str) -> Content:
        """Return what models/<model>/model.json holds."""
        card: Content = self.json(f"models/{model}/model.json")
        return card

    def fit(self, model: str) -> Content:
        """Return what models/<model>/fit.json holds."""
        notes: Content = self.json(f"models/{model}/fit.json")
        return notes

    def windows(self, split: str) -> list[StoredWindow]:
        """Return all stored free runs of a split, in the order of the file names."""
        kinds = {file_stem(entry["log"]): entry.get("manoeuvre") for entry in self.quality}
        return [
            window
            for path in sorted((self.path / "rollouts" / split).glob("*.parquet"))
            for window in windows_of(
                read_table(path), path.stem, str(kinds.get(path.stem) or "unknown"), self.live
            )
        ]


def windows_of(table: pd.DataFrame, log: str, manoeuvre: str, live: Live) -> list[StoredWindow]:
    """Return the free runs of a log by protocol and number, from its stored rollouts."""
    out: list[StoredWindow] = []
    names = columns_of(live)
    for (protocol, number), group in table.groupby(["protocol", "window"], sort=True):
        parts = {str(model): part for model, part in group.groupby("model", sort=False)}
        first = next(iter(parts.values()))
        out.append(
            StoredWindow(
                log=log,
                manoeuvre=manoeuvre,
                protocol=str(protocol),
                number=int(str(number)),
                t=first["t"].to_numpy(float),
                usable=first["usable"].to_numpy(bool),
                measured=first[list(names)].to_numpy(float),
                predicted={
                    model: part[[f"{name}_hat" for name in names]].to_numpy(float)
                    for model, part in parts.items()
                },
                diverged={model: bool(part["diverged"].any()) for model, part in parts.items()},
                inputs={
                    name.removeprefix(INPUT): first[name].to_numpy(float)
                    for name in table.columns
                    if name.startswith(INPUT)
                },
                low=_limits(parts, names, "low"),
                high=_limits(parts, names, "high"),
                live=live,
            )
        )
    return out


def _limits(parts: Mapping[str, Any], columns: Sequence[str], ending: str) -> dict[str, np.ndarray]:
    """Return one limit of the bands [T, 3 + n] of those models of a stored window that have any."""
    names = [f"{name}_{ending}" for name in columns]
    return {
        model: part[names].to_numpy(float)
        for model, part in parts.items()
        if names[0] in part and bool(part[names[0]].notna().all())
    }
