"""Read access to a run folder: configuration, metrics, rollouts and further results."""

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
from residnet.core.files import make_file_stem, read_table
from residnet.core.format import DISPLAY_UNITS, display_unit
from residnet.core.frames import wrap_angle_array
from residnet.core.layout import SIX_DOF_LAYOUT, SURGE_SWAY_YAW, DegreesOfFreedom
from residnet.core.model_names import BASELINE, CONSTANT_VELOCITY, PLANT
from residnet.core.names import CHANNEL_UNITS, POSE_ERROR_UNITS, to_si
from residnet.core.run_loader import read_json_value, require_listed
from residnet.core.units import canonical_unit
from residnet.evaluation.assessment import Assessment
from residnet.evaluation.metrics import INPUT_PREFIX, state_column_names
from residnet.evaluation.verdict import order_protocols

if TYPE_CHECKING:
    import pandas as pd

JsonObject = Mapping[str, Any]
"""What a JSON object holds."""
_SPLIT_PRIORITY = ("test", "external", "validation", "train")
"""Splits by how much they say about data that no fit has seen."""

_FINDING_KEYS = ("level", "code", "text", "action")
"""Keys of a finding in doctor.json that the card of an export repeats."""


@dataclass(frozen=True)
class StoredWindow:
    """Free run of every model over one window of one log.

    Attributes:
        log: name of the log.
        manoeuvre: kind of manoeuvre.
        protocol: name of the protocol.
        number: index of the window within its log, from 0.
        t: [T] in s.
        usable: mask [T] of the samples at which u, v and the position are scored.
        measured: measured pose and velocities [T, 3 + n] in SI units and rad.
        predicted: predicted pose and velocities [T, 3 + n] by model.
        diverged: whether the free run diverged, by model.
        inputs: inputs [T] by name in SI units and rad; empty if the run stored none.
        band_lower: lower limits of the prediction band [T, 3 + n] by model; empty without bands.
        band_upper: upper limits of the prediction band [T, 3 + n] by model.
        dof: degrees of freedom of the logs; all other velocities are zero.
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
    band_lower: dict[str, np.ndarray] = field(default_factory=dict)
    band_upper: dict[str, np.ndarray] = field(default_factory=dict)
    dof: DegreesOfFreedom = SURGE_SWAY_YAW

    def free_run_errors(self, model: str) -> pd.DataFrame:
        """Return what a model is off by [T] in SI and rad, `x` standing for the distance in place.

        u, v and the position are NaN where they are not scored; of angles, whole turns do not
        count.
        """
        import pandas as pd

        names = state_column_names(self.dof)
        error = pd.DataFrame(self.predicted[model] - self.measured, columns=names)
        for angle in {"psi", "phi"}.intersection(names):
            error[angle] = wrap_angle_array(error[angle].to_numpy())
        error["x"] = np.hypot(error["x"], error.pop("y"))
        error.loc[~self.usable, ["u", "v", "x"]] = np.nan
        return error

    def rmse_by_channel(self, model: str) -> np.ndarray:
        """Return the root mean square errors [n] of what moves, over the samples that count."""
        rmse = self.free_run_errors(model)[list(self.dof.dynamic_states)].pow(2).mean().pow(0.5)
        return rmse.to_numpy()

    def mean_nrmse(self, model: str, scales: Mapping[str, float]) -> float:
        """Return the mean over the channels of `scales` of the error over the scale."""
        columns = [self.dof.dynamic_states.index(name) for name in scales]
        return float((self.rmse_by_channel(model)[columns] / [*scales.values()]).mean())


class RunFiles:
    """The contents of a run folder of any task, or of what `residnet evaluate` writes.

    Parts that a folder does not have are empty. What belongs to a fit (`rows`, `kinds`, `find_row`
    and so on) needs its metrics.json.
    """

    def __init__(self, path: Path) -> None:
        """Open a run folder; files are read on first use.

        Raises:
            UsageError: if the folder does not exist.
        """
        if not path.is_dir():
            raise UsageError(f"{path}: no such folder; give the folder of a run")
        self.path = path

    def read_json(self, name: str) -> Any:
        """Return the content of a JSON file of the folder; an empty object if it does not exist.

        Raises:
            UsageError: if the file cannot be read.
        """
        path = self.path / name
        if not os.path.lexists(path):
            return {}
        require_listed(self.path, name)
        return read_json_value(path, self.path)

    def read_parquet(self, name: str) -> Any:
        """Return a Parquet file of the folder as a data frame; None if it does not exist."""
        path = self.path / name
        if not os.path.lexists(path):
            return None
        require_listed(self.path, name)
        return read_table(path)

    def assessment(self, judged: tuple[str, Sequence[str]] | None = None) -> Assessment:
        """Return verdict, data findings and log split of the run for the card of an export.

        Args:
            judged: level and sentences of the verdict on the model; None for the verdict of the
                run.

        Raises:
            DataError: if a file of the run cannot be read.
        """
        summary = self.read_json("summary.json")
        inspection = self.read_json("doctor.json")
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
    def metrics(self) -> JsonObject:
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
        content = self.read_json("metrics.json")
        if not isinstance(content, dict) or not content.get("rows"):
            raise DataError(f"{path}: holds no rows")
        return content

    @property
    def rows(self) -> Sequence[JsonObject]:
        """The rows of metrics.json."""
        rows: Sequence[JsonObject] = self.metrics["rows"]
        return rows

    @cached_property
    def resolved_config(self) -> JsonObject:
        """The configuration of the run."""
        path = self.path / "resolved.yaml"
        return load_mapping(path) if path.is_file() else {}

    @cached_property
    def quality(self) -> Sequence[JsonObject]:
        """What each log holds (data_quality.json)."""
        return self.read_json("data_quality.json") or []

    @cached_property
    def provenance(self) -> JsonObject:
        """How the run was made (provenance.json)."""
        provenance: JsonObject = self.read_json("provenance.json")
        return provenance

    @cached_property
    def limits(self) -> JsonObject:
        """What limits the models (limits.json)."""
        limits: JsonObject = self.read_json("limits.json")
        return limits

    @property
    def title(self) -> str:
        """Name of the run, or of its folder if the run has no name."""
        return str(self.resolved_config.get("name") or self.path.name)

    @property
    def description(self) -> str:
        """Description of the run."""
        return str(self.resolved_config.get("description") or "")

    @cached_property
    def model_kinds(self) -> dict[str, str]:
        """The kind (constant_velocity, baseline, head, plant, ...) of each model, in the order of
        metrics.json.

        Reductions refer to the first baseline; the others are `further` models, judged like heads.
        """
        kinds = {row["model"]: row.get("kind", "head") for row in self.rows}
        first_baseline = next((model for model, kind in kinds.items() if kind == "baseline"), None)
        return {
            model: "further" if kind == "baseline" and model != first_baseline else kind
            for model, kind in kinds.items()
        }

    @cached_property
    def selected(self) -> str | None:
        """The model chosen on validation data, None where none was."""
        selected_models = [row["model"] for row in self.rows if row.get("selected")]
        return self.metrics.get("selected") or (selected_models[0] if selected_models else None)

    @cached_property
    def predictor(self) -> str | None:
        """Model that is reported first; the selected model by default."""
        return self.metrics.get("predictor") or self.selected

    @cached_property
    def baseline(self) -> str | None:
        """The model that reductions refer to."""
        return next((model for model, kind in self.model_kinds.items() if kind == "baseline"), None)

    @cached_property
    def plant(self) -> str | None:
        """The plant that made the data, where they are simulated."""
        return next((model for model, kind in self.model_kinds.items() if kind == PLANT), None)

    @cached_property
    def heads(self) -> list[str]:
        """The models that are neither constant_velocity, baseline nor plant, the predictor
        first.
        """
        heads = [
            model
            for model, kind in self.model_kinds.items()
            if kind not in (CONSTANT_VELOCITY, BASELINE, PLANT)
        ]
        return sorted(heads, key=lambda model: (model != self.predictor, model != self.selected))

    @cached_property
    def main_model(self) -> str:
        """The model that a report is on: the predictor, else the first head or the baseline."""
        names = [self.predictor, *self.heads, self.baseline, *self.model_kinds]
        return next(name for name in names if name is not None and name in self.model_kinds)

    @cached_property
    def splits(self) -> list[str]:
        """The splits of the rows, in their order."""
        return list(dict.fromkeys(row["split"] for row in self.rows))

    @cached_property
    def report_split(self) -> str:
        """Split that the report evaluates; `test` if it exists."""
        return next((split for split in _SPLIT_PRIORITY if split in self.splits), self.splits[0])

    @cached_property
    def report_splits(self) -> list[str]:
        """Splits that the report compares: the training split, if any, and the report split."""
        return [
            split for split in ("train",) if split in self.splits and split != self.report_split
        ] + [self.report_split]

    @cached_property
    def protocols(self) -> list[str]:
        """The protocols of the rows, the one by which the focus is judged first."""
        return order_protocols(self.rows, self.report_split, self.evaluation.get("selection", ""))

    @property
    def selection_protocol(self) -> str:
        """The protocol that chose between the models."""
        return str(self.evaluation.get("selection") or self.protocols[0])

    @cached_property
    def main_protocol(self) -> str:
        """The protocol of the first screen: the first whose free runs have one length, if any has.

        That which selects comes first.
        """
        protocol_configs = self.evaluation.get("protocols") or {}
        fixed_length = [
            name for name in self.protocols if (protocol_configs.get(name) or {}).get("length")
        ]
        return (fixed_length or self.protocols)[0]

    @cached_property
    def horizon_text(self) -> str:
        """When the errors of the main protocol are taken: after so many seconds, or at the end."""
        length = ((self.evaluation.get("protocols") or {}).get(self.main_protocol) or {}).get(
            "length"
        )
        return f"after {length:g} s" if length else "at the end"

    @property
    def evaluation(self) -> JsonObject:
        """The section `evaluation` of the configuration."""
        return self.resolved_config.get("evaluation") or {}

    @cached_property
    def channels(self) -> list[str]:
        """The channels that are scored."""
        return [name for name in self.rows[0]["rmse"] if name != "mean"]

    @cached_property
    def dof(self) -> DegreesOfFreedom:
        """Degrees of freedom of the logs; models hold all other velocities at zero."""
        return DegreesOfFreedom(
            tuple(name for name in SIX_DOF_LAYOUT.velocities if name in self.channels)
        )

    @property
    def position_label(self) -> str:
        """Name of the position error; `distance` for vessels without a measured heading."""
        return "position" if self.dof.has_heading else "distance run"

    @cached_property
    def pose_errors(self) -> list[str]:
        """What of `END_UNITS` is scored at the end of free runs."""
        return [
            pose_error
            for pose_error in POSE_ERROR_UNITS
            if f"{pose_error}_error_end" in self.rows[0]
        ]

    def pose_error_unit(self, pose_error: str) -> tuple[str, str, float]:
        """Return name, unit and the factor to it from SI of an error at the end of free runs."""
        return self.position_label if pose_error == "position" else pose_error, *display_unit(
            POSE_ERROR_UNITS[pose_error]
        )

    def find_row(
        self, model: str | None, split: str, protocol: str, manoeuvre: str = "all"
    ) -> JsonObject | None:
        """Return a row of metrics.json; None if it does not exist."""
        key = (model, split, protocol, manoeuvre)
        return next(
            (
                row
                for row in self.rows
                if (row["model"], row["split"], row["protocol"], row.get("manoeuvre", "all")) == key
            ),
            None,
        )

    def manoeuvre_kinds(self, split: str, protocol: str) -> list[str]:
        """Return the kinds and named groups of manoeuvres that have rows, without `all`."""
        names = [
            row.get("manoeuvre", "all")
            for row in self.rows
            if row["split"] == split and row["protocol"] == protocol
        ]
        return [name for name in dict.fromkeys(names) if name != "all"]

    def model_label(self, model: str) -> str:
        """Return the name of a model in tables, with its role where it has a special one."""
        if self.model_kinds.get(model) == PLANT:
            return model if model == PLANT else f"{model} (plant)"
        if model == self.predictor != self.selected:
            return f"{model} (predictor)"
        return f"{model} (selected)" if model == self.selected else model

    def display_unit(self, channel: str) -> tuple[str, float]:
        """Return the display unit of a channel and the factor from SI.

        This is the unit in the channel map of the log, with degrees instead of radians.
        """
        reader = (self.resolved_config.get("data") or {}).get("reader") or {}
        channel_map = (reader.get("channels") or {}).get(channel) or {}
        if unit := channel_map.get("unit"):
            unit_name = canonical_unit(unit, CHANNEL_UNITS.get(channel))
            return (
                display_unit(unit_name)
                if unit_name in DISPLAY_UNITS
                else (unit_name, 1.0 / to_si(unit_name))
            )
        return display_unit(self.si_unit(channel))

    def si_unit(self, channel: str) -> str:
        """Return the SI unit of a channel, `-` where it is not known."""
        channel_units = self.metrics.get("channels") or {}
        return str(channel_units.get(channel) or CHANNEL_UNITS.get(channel, "-"))

    def model_card(self, model: str) -> JsonObject:
        """Return what models/<model>/model.json holds."""
        card: JsonObject = self.read_json(f"models/{model}/model.json")
        return card

    def fit_notes(self, model: str) -> JsonObject:
        """Return what models/<model>/fit.json holds."""
        notes: JsonObject = self.read_json(f"models/{model}/fit.json")
        return notes

    def read_split_windows(self, split: str) -> list[StoredWindow]:
        """Return all stored free runs of a split, in the order of the file names."""
        manoeuvre_of_log = {
            make_file_stem(entry["log"]): entry.get("manoeuvre") for entry in self.quality
        }
        return [
            window
            for path in sorted((self.path / "rollouts" / split).glob("*.parquet"))
            for window in read_windows(
                read_table(path),
                path.stem,
                str(manoeuvre_of_log.get(path.stem) or "unknown"),
                self.dof,
            )
        ]


def read_windows(
    table: pd.DataFrame, log: str, manoeuvre: str, dof: DegreesOfFreedom
) -> list[StoredWindow]:
    """Return the free runs of a log by protocol and number, from its stored rollouts."""
    windows: list[StoredWindow] = []
    names = state_column_names(dof)
    for (protocol, number), group in table.groupby(["protocol", "window"], sort=True):
        tables_by_model = {
            str(model): table_of_model
            for model, table_of_model in group.groupby("model", sort=False)
        }
        first_table = next(iter(tables_by_model.values()))
        windows.append(
            StoredWindow(
                log=log,
                manoeuvre=manoeuvre,
                protocol=str(protocol),
                number=int(str(number)),
                t=first_table["t"].to_numpy(float),
                usable=first_table["usable"].to_numpy(bool),
                measured=first_table[list(names)].to_numpy(float),
                predicted={
                    model: table_of_model[[f"{name}_hat" for name in names]].to_numpy(float)
                    for model, table_of_model in tables_by_model.items()
                },
                diverged={
                    model: bool(table_of_model["diverged"].any())
                    for model, table_of_model in tables_by_model.items()
                },
                inputs={
                    name.removeprefix(INPUT_PREFIX): first_table[name].to_numpy(float)
                    for name in table.columns
                    if name.startswith(INPUT_PREFIX)
                },
                band_lower=_band_limits(tables_by_model, names, "low"),
                band_upper=_band_limits(tables_by_model, names, "high"),
                dof=dof,
            )
        )
    return windows


def _band_limits(
    tables_by_model: Mapping[str, Any], columns: Sequence[str], suffix: str
) -> dict[str, np.ndarray]:
    """Return the lower or upper band limits [T, 3 + n] of a stored window by model."""
    names = [f"{name}_{suffix}" for name in columns]
    return {
        model: model_table[names].to_numpy(float)
        for model, model_table in tables_by_model.items()
        if names[0] in model_table and bool(model_table[names[0]].notna().all())
    }
