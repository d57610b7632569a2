"""Read access to a run folder: configuration, metrics, rollouts and further results."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from residnet.core.config import load_mapping
from residnet.core.errors import DataError, UsageError
from residnet.core.files import make_file_stem, read_table
from residnet.core.format import (
    DISPLAY_UNITS,
    DisplayUnit,
    display_unit,
    format_range,
    format_seconds,
)
from residnet.core.frames import wrap_angle_array
from residnet.core.layout import SIX_DOF_LAYOUT, SURGE_SWAY_YAW, DegreesOfFreedom
from residnet.core.model_names import BASELINE, CONSTANT_VELOCITY, PLANT
from residnet.core.names import CHANNEL_UNITS, POSE_ERROR_UNITS, to_si
from residnet.core.records import StoredFile
from residnet.core.run_loader import read_json_value, require_listed
from residnet.core.run_records import ProvenanceFile, SummaryFile
from residnet.core.units import canonical_unit
from residnet.evaluation.assessment import Assessment, CardFinding, name_splits
from residnet.evaluation.data_records import DataQualityFile, LogQuality
from residnet.evaluation.limits_records import HorizonRow, LimitsFile, ProtocolLimits
from residnet.evaluation.records import (
    BandRow,
    BandsFile,
    MetricsFile,
    MetricsRow,
    SanityFile,
    SanityRow,
    SelectionFile,
)
from residnet.evaluation.rollout_tables import INPUT_PREFIX, state_column_names
from residnet.evaluation.verdict import find_main_horizon, order_protocols
from residnet.identification.records import FitNotes
from residnet.quality.records import InspectionFile
from residnet.report.run_settings import (
    EvaluationSettings,
    FitRunSettings,
    ModelSettings,
    RunSettings,
    parse_settings,
    read_settings,
)

if TYPE_CHECKING:
    import pandas as pd

RecordT = TypeVar("RecordT", bound=StoredFile)
_LOG_SET_NAME = "together"
"""Name in doctor.json of the findings on the set of all logs, instead of one log."""
_SPLIT_PRIORITY = ("test", "external", "validation", "train")
"""Splits in the order in which a report prefers them: data that no fit has seen come first."""


class PoseErrorUnit(NamedTuple):
    """Label and unit of an error at the end of free runs.

    Attributes:
        label: name of the error in a report.
        unit: unit in which it is displayed.
        factor: factor from SI to this unit.
    """

    label: str
    unit: str
    factor: float


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
        """Return the errors of a model at each sample [T] in SI units and rad, by channel.

        The column `x` is the distance from the measured position. u, v and the position are NaN
        where they are not scored; errors of angles are at most half a turn.
        """
        import pandas as pd

        differences = self.predicted[model] - self.measured
        columns = dict(zip(state_column_names(self.dof), differences.T, strict=True))
        for angle in {"psi", "phi"} & columns.keys():
            columns[angle] = wrap_angle_array(columns[angle])
        # a report needs the errors of thousands of windows, for which assignments to a data frame
        # take too long
        columns["x"] = np.hypot(columns["x"], columns.pop("y"))
        for name in ("u", "v", "x"):
            columns[name] = np.where(self.usable, columns[name], np.nan)
        return pd.DataFrame(columns)

    def rmse_by_channel(self, model: str) -> np.ndarray:
        """Return the root mean square errors of the dynamic states [n], over the scored samples."""
        rmse = self.free_run_errors(model)[list(self.dof.dynamic_states)].pow(2).mean().pow(0.5)
        return rmse.to_numpy()

    def mean_nrmse(self, model: str, scales: Mapping[str, float]) -> float:
        """Return the mean of RMSE / scale over the channels of `scales`."""
        columns = [self.dof.dynamic_states.index(name) for name in scales]
        return float((self.rmse_by_channel(model)[columns] / [*scales.values()]).mean())


class RunFiles:
    """The contents of a run folder of any task, or of a folder of `residnet evaluate`.

    Parts that a folder does not have are empty. Attributes of a fit (`rows`, `find_row` and so on)
    need its metrics.json.
    """

    def __init__(self, path: Path) -> None:
        """Open a run folder; files are read on first use.

        Raises:
            UsageError: if the folder does not exist.
        """
        if not path.is_dir():
            raise UsageError(f"{path}: no such folder; give the folder of a run")
        self.path = path

    def read_parquet(self, name: str) -> pd.DataFrame | None:
        """Return a Parquet file of the folder as a data frame; None if it does not exist."""
        path = self.path / name
        if not os.path.lexists(path):
            return None
        require_listed(self.path, name)
        return read_table(path)

    def read_required_parquet(self, name: str) -> pd.DataFrame:
        """Return a Parquet file of the folder as a data frame.

        Raises:
            UsageError: if the file does not exist or is not readable.
        """
        frame = self.read_parquet(name)
        return read_table(self.path / name) if frame is None else frame

    def read_record(self, record_type: type[RecordT], name: str) -> RecordT | None:
        """Return the typed contents of a file of the folder; None if it does not exist.

        Args:
            record_type: class of the contents.
            name: path of the file within the folder.

        Raises:
            UsageError: if the file cannot be read.
        """
        return record_type.read_optional(self.path, name)

    def read_required_record(self, record_type: type[RecordT], name: str) -> RecordT:
        """Return the typed contents of a file that every run of a task has.

        Raises:
            UsageError: if there is no such file, or it cannot be read.
        """
        return self.read_record(record_type, name) or record_type.read(self.path / name, self.path)

    def assessment(self, model_verdict: tuple[str, Sequence[str]] | None = None) -> Assessment:
        """Return the assessment of the run for the metadata (model card) of an export.

        It consists of the verdict, the findings of the data checks, and the names of the logs for
        training, validation and test.

        Args:
            model_verdict: level and sentences of the verdict on the exported model; None for the
                verdict on the model that the run reports.

        Raises:
            DataError: if a file of the run cannot be read.
        """
        if model_verdict is not None:
            level, verdict = model_verdict
        else:
            summary = self.read_record(SummaryFile, "summary.json")
            level, verdict = ("", ()) if summary is None else (summary.level, summary.verdict)
        findings = None
        if self.inspection is not None:
            findings = tuple(
                CardFinding(
                    log=None if log == _LOG_SET_NAME else log,
                    level=finding.level,
                    code=finding.code,
                    text=finding.text,
                    action=finding.action,
                )
                for log, finding in self.inspection.named_findings
                if finding.level != "note"
            )
        return Assessment(
            level=level or None,
            verdict=tuple(verdict),
            findings=findings,
            split=name_splits([(entry.split, entry.log) for entry in self.quality]),
        )

    @cached_property
    def metrics(self) -> MetricsFile:
        """The contents of metrics.json of a fit.

        Raises:
            UsageError: if the folder has no such file.
            DataError: if it cannot be read, or has no rows.
        """
        metrics = self.read_record(MetricsFile, "metrics.json")
        if metrics is None:
            raise UsageError(
                f"{self.path}: no metrics.json here; give the folder of a finished run"
            )
        if not metrics.rows:
            raise DataError(f"{self.path / 'metrics.json'}: holds no rows")
        return metrics

    @property
    def rows(self) -> Sequence[MetricsRow]:
        """Errors by model, split, protocol and manoeuvre."""
        return self.metrics.rows

    def read_task_metrics(self, record_type: type[RecordT]) -> RecordT:
        """Return the contents of metrics.json of a task other than a fit.

        Args:
            record_type: class of the contents.

        Raises:
            UsageError: if the folder has no such file, or it cannot be read.
        """
        metrics = self.read_record(record_type, "metrics.json")
        if metrics is None:
            raise UsageError(
                f"{self.path}: no metrics.json here; give the folder of a finished run"
            )
        return metrics

    @cached_property
    def resolved_config(self) -> Mapping[str, object]:
        """The configuration of the run with all its keys."""
        path = self.path / "resolved.yaml"
        return load_mapping(path) if path.is_file() else {}

    @cached_property
    def settings(self) -> RunSettings:
        """The settings that the page of any task shows."""
        return read_settings(self.path, RunSettings)

    @cached_property
    def fit_settings(self) -> FitRunSettings:
        """The settings of a fit that its page shows."""
        return read_settings(self.path, FitRunSettings)

    @cached_property
    def quality(self) -> Sequence[LogQuality]:
        """Number of samples and split of each log (data_quality.json); empty without the file."""
        file = self.read_record(DataQualityFile, "data_quality.json")
        return () if file is None else file.root

    @cached_property
    def inspection(self) -> InspectionFile | None:
        """The findings of the data checks (doctor.json); None if the file does not exist."""
        return self.read_record(InspectionFile, "doctor.json")

    @cached_property
    def provenance(self) -> ProvenanceFile | None:
        """Versions, seed and input files (provenance.json); None if the file does not exist."""
        return self.read_record(ProvenanceFile, "provenance.json")

    @cached_property
    def selection(self) -> SelectionFile | None:
        """The chosen models and the reason (selection.json); None if the file does not exist."""
        return self.read_record(SelectionFile, "selection.json")

    @cached_property
    def limits(self) -> LimitsFile | None:
        """Limits of validity (limits.json); None if the file does not exist.

        They are the errors by prediction horizon, by class of speed and wind speed, and the windows
        with the largest errors.
        """
        return self.read_record(LimitsFile, "limits.json")

    def find_limits(self, protocol: str) -> ProtocolLimits | None:
        """Return the limits under a protocol of the report split; None if they are unknown."""
        return None if self.limits is None else self.limits.find(self.report_split, protocol)

    @cached_property
    def bands(self) -> Mapping[str, Mapping[str, BandRow]]:
        """Prediction intervals by model and protocol (bands.json); empty without the file."""
        file = self.read_record(BandsFile, "bands.json")
        return {} if file is None else file.models

    @cached_property
    def sanity_findings(self) -> Sequence[SanityRow]:
        """Results of the physical checks (sanity.json); empty without the file."""
        file = self.read_record(SanityFile, "sanity.json")
        return () if file is None else file.findings

    @property
    def title(self) -> str:
        """Name of the run, or of its folder if the run has no name."""
        return self.settings.name or self.path.name

    @property
    def description(self) -> str:
        """Sentence on the run from its config; empty without one."""
        return self.settings.description

    @cached_property
    def model_kinds(self) -> dict[str, str]:
        """The kind (constant_velocity, baseline, head, ensemble, plant) by model, in the order of
        metrics.json.

        Error reductions are relative to the first baseline. Other baselines have the kind
        `further`, and are treated like heads (residual models).
        """
        kinds = {row.model: row.kind for row in self.rows}
        first_baseline = next((model for model, kind in kinds.items() if kind == "baseline"), None)
        return {
            model: "further" if kind == "baseline" and model != first_baseline else kind
            for model, kind in kinds.items()
        }

    @property
    def selected(self) -> str:
        """The model that was chosen on validation data among the single models (no ensembles)."""
        return self.metrics.selected

    @property
    def predictor(self) -> str:
        """The model that is reported first, which may be an ensemble."""
        return self.metrics.predictor

    @cached_property
    def baseline(self) -> str | None:
        """The reference model of error reductions: the first baseline; None without a baseline."""
        return next((model for model, kind in self.model_kinds.items() if kind == "baseline"), None)

    @cached_property
    def plant(self) -> str | None:
        """The plant that generated the logs, if they are simulated."""
        return next((model for model, kind in self.model_kinds.items() if kind == PLANT), None)

    @cached_property
    def heads(self) -> list[str]:
        """Heads (residual models), ensembles and further baselines, the predictor first.

        These are all models but the constant-velocity model, the first baseline and the plant.
        """
        heads = [
            model
            for model, kind in self.model_kinds.items()
            if kind not in (CONSTANT_VELOCITY, BASELINE, PLANT)
        ]
        return sorted(heads, key=lambda model: (model != self.predictor, model != self.selected))

    @cached_property
    def main_model(self) -> str:
        """The model that a report evaluates: the predictor, else the first head or the baseline."""
        names = [self.predictor, *self.heads, self.baseline, *self.model_kinds]
        return next(name for name in names if name is not None and name in self.model_kinds)

    @cached_property
    def splits(self) -> list[str]:
        """The splits of the rows, in their order."""
        return list(dict.fromkeys(row.split for row in self.rows))

    @cached_property
    def report_split(self) -> str:
        """Split that the report evaluates; `test` if it exists."""
        return next((split for split in _SPLIT_PRIORITY if split in self.splits), self.splits[0])

    @cached_property
    def n_logs_of_fit_and_all(self) -> tuple[int, int]:
        """Number of evaluated logs that are among the data of the fit, and number of all logs.

        Both are 0 for the run of a fit; they are known for `residnet evaluate` on further logs.
        """
        if self.report_split != "external" or self.inspection is None:
            return 0, 0
        is_log_of_fit = [
            any(finding.code == "log_of_fit" for finding in log.findings)
            for log in self.inspection.logs
        ]
        return sum(is_log_of_fit), len(is_log_of_fit)

    @property
    def report_data_name(self) -> str:
        """Name of the data of the report; logs that trained the model are not external."""
        n_logs_of_fit, n_logs = self.n_logs_of_fit_and_all
        is_data_of_fit = n_logs_of_fit > 0 and n_logs_of_fit == n_logs
        return "data of the fit" if is_data_of_fit else f"{self.report_split} data"

    @cached_property
    def report_splits(self) -> list[str]:
        """Splits that the report compares: the training split, if any, and the report split."""
        return [
            split for split in ("train",) if split in self.splits and split != self.report_split
        ] + [self.report_split]

    @cached_property
    def protocols(self) -> list[str]:
        """The protocols of the rows; the main one, that of the verdict, comes first."""
        settings = self.evaluation.protocols
        fixed_length = [name for name, protocol in settings.items() if protocol.length is not None]
        return order_protocols(
            self.rows, self.report_split, self.evaluation.selection, fixed_length
        )

    @property
    def selection_protocol(self) -> str:
        """The protocol by whose errors models were selected."""
        return self.evaluation.selection or self.protocols[0]

    @property
    def main_protocol(self) -> str:
        """The protocol of the verdict and of the first table and figure; see `order_protocols`."""
        return self.protocols[0]

    def _window_length(self, protocol: str) -> float | None:
        """Return the length of the windows of a protocol in s; None if it has none."""
        settings = self.evaluation.protocols.get(protocol)
        return None if settings is None else settings.length

    @cached_property
    def main_horizon(self) -> HorizonRow | None:
        """The pose errors at the main horizon of the report split; None if they are unknown."""
        horizon = find_main_horizon(
            {} if self.limits is None else self.limits.splits.get(self.report_split, {}),
            self.main_protocol,
            self.main_model,
        )
        return None if horizon is None else horizon.row

    @cached_property
    def horizon_text(self) -> str:
        """When errors are compared, in words: `after 30 s` for a main horizon of 30 s.

        Without a main horizon this is the length of the windows, or `at the end` if they differ.
        """
        length = self._window_length(self.main_protocol)
        if self.main_horizon is not None:
            length = self.main_horizon.seconds
        return f"after {format_seconds(length)}" if length else "at the end"

    @property
    def evaluation(self) -> EvaluationSettings:
        """Protocols, scales and selection of the fit."""
        return self.fit_settings.evaluation

    @cached_property
    def channels(self) -> list[str]:
        """Velocities whose errors metrics.json contains."""
        return [name for name in self.rows[0].rmse if name != "mean"]

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
        """The pose errors that are scored at the end of free runs (`POSE_ERROR_UNITS`)."""
        return list(self.rows[0].final_pose_errors)

    def pose_error_unit(self, pose_error: str) -> PoseErrorUnit:
        """Return label and display unit of an error at the end of free runs."""
        label = self.position_label if pose_error == "position" else pose_error
        return PoseErrorUnit(label, *display_unit(POSE_ERROR_UNITS[pose_error]))

    def find_row(
        self, model: str | None, split: str, protocol: str, manoeuvre: str = "all"
    ) -> MetricsRow | None:
        """Return a row of metrics.json; None if it does not exist."""
        key = (model, split, protocol, manoeuvre)
        return next(
            (
                row
                for row in self.rows
                if (row.model, row.split, row.protocol, row.manoeuvre) == key
            ),
            None,
        )

    def manoeuvre_kinds(self, split: str, protocol: str) -> list[str]:
        """Return the kinds and named groups of manoeuvres that have rows, without `all`."""
        names = [
            row.manoeuvre for row in self.rows if row.split == split and row.protocol == protocol
        ]
        return [name for name in dict.fromkeys(names) if name != "all"]

    def model_label(self, model: str) -> str:
        """Return the name of a model in tables, with its role if that is special."""
        if self.model_kinds.get(model) == PLANT:
            return model if model == PLANT else f"{model} (plant)"
        if model == self.predictor != self.selected:
            return f"{model} (predictor)"
        return f"{model} (selected)" if model == self.selected else model

    def display_unit(self, channel: str) -> DisplayUnit:
        """Return the display unit of a channel.

        This is the unit in the channel map of the log, with degrees instead of radians.
        """
        data = self.settings.data
        channels = {} if data is None or data.reader is None else data.reader.channels
        if channel in channels and (unit := channels[channel].unit):
            unit_name = canonical_unit(unit, CHANNEL_UNITS.get(channel))
            return (
                display_unit(unit_name)
                if unit_name in DISPLAY_UNITS
                else DisplayUnit(unit_name, 1.0 / to_si(unit_name))
            )
        return display_unit(self.si_unit(channel))

    def si_unit(self, channel: str) -> str:
        """Return the SI unit of a channel; `-` if it is not known."""
        return self.metrics.channels.get(channel) or CHANNEL_UNITS.get(channel, "-")

    def model_settings(self, model: str) -> ModelSettings:
        """Return the description of a model (model.json); defaults if the file does not exist."""
        name = f"models/{model}/model.json"
        path = self.path / name
        if not os.path.lexists(path):
            return ModelSettings()
        require_listed(self.path, name)
        return parse_settings(read_json_value(path, self.path), ModelSettings, path)

    def describe_training_ranges(self, model: str) -> list[str]:
        """Return the training range of each velocity and input of a model with its unit.

        Empty if the folder does not hold the model.
        """
        settings = self.model_settings(model)
        names = [*self.dof.dynamic_states, *settings.signals.inputs, *settings.signals.exogenous]
        texts = []
        for name, lower, upper in zip(names, settings.low, settings.high, strict=False):
            if name in self.dof.fixed_states:
                continue
            unit, factor = self.display_unit(name)
            text = f"{name} {format_range(factor * lower, factor * upper)}"
            # dimensionless channels have the unit "-"
            texts.append(text if unit == "-" else f"{text} {unit}")
        return texts

    def fit_notes(self, model: str) -> FitNotes | None:
        """Return the notes on the fit of a model (fit.json); None if the file does not exist."""
        return self.read_record(FitNotes, f"models/{model}/fit.json")

    def read_split_windows(self, split: str) -> list[StoredWindow]:
        """Return all stored free runs of a split, in the order of the file names."""
        manoeuvre_of_log = {make_file_stem(entry.log): entry.manoeuvre for entry in self.quality}
        return [
            window
            for path in sorted((self.path / "rollouts" / split).glob("*.parquet"))
            for window in read_windows(
                read_table(path),
                path.stem,
                manoeuvre_of_log.get(path.stem) or "unknown",
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
    tables_by_model: Mapping[str, pd.DataFrame], columns: Sequence[str], suffix: str
) -> dict[str, np.ndarray]:
    """Return the lower or upper band limits [T, 3 + n] of a stored window by model."""
    names = [f"{name}_{suffix}" for name in columns]
    return {
        model: model_table[names].to_numpy(float)
        for model, model_table in tables_by_model.items()
        if names[0] in model_table and bool(model_table[names[0]].notna().all())
    }
