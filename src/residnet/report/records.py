"""Typed contents of the result files of tasks that are read by their own report page."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, JsonValue

from residnet.core.records import FileRecord, FileRows, Record

TrialState = Literal["finished", "ended early", "failed", "unfinished"]
"""Final state of a trial of a sweep."""


class SweepTrial(Record):
    """One trial of a sweep.

    Attributes:
        number: index of the trial, starting at 0.
        state: final state.
        value: value of the objective; None without a value.
        seconds: duration of the run in s.
        fault: error message; empty without an error.
        values: value of each varied key.
    """

    number: int
    state: TrialState
    value: float | None
    seconds: float
    fault: str
    values: dict[str, JsonValue]


class SweepFile(FileRecord):
    """sweep.json: the trials of a sweep.

    Attributes:
        run: name of the sweep.
        objective: name and unit of the objective.
        minimized: whether the smallest objective is sought.
        search: kind of search.
        keys: the varied keys.
        log: keys that vary on a logarithmic scale.
        best: number of the best trial; None if no trial has an objective.
        importance: share of each key in the variance of the objective; empty for few trials.
        trials: all trials.
    """

    schema_name: Literal["residnet.sweep/1"] = Field(alias="schema")
    run: str
    objective: str
    minimized: bool
    search: str
    keys: tuple[str, ...]
    log: tuple[str, ...]
    best: int | None
    importance: dict[str, float]
    trials: tuple[SweepTrial, ...]

    @property
    def completed(self) -> list[tuple[SweepTrial, float]]:
        """Trials that ended with an objective, as pairs of trial and objective."""
        return [(trial, trial.value) for trial in self.trials if trial.value is not None]


class VariantRow(Record):
    """The error of one variant of a fit under one protocol.

    Attributes:
        variant: name of the variant.
        protocol: name of the protocol.
        seeds: number of seeds.
        windows: number of windows.
        diverged: number of windows in which a free run diverged, over all seeds.
        nrmse_mean: NRMSE of the free runs, mean over windows and seeds.
        nrmse_sd: standard deviation of the NRMSE over seeds; None for one seed.
        nrmse_range: smallest and largest NRMSE of the seeds.
        difference: mean difference from the reference variant over the same windows.
        difference_ci95: 95 % confidence interval of the difference; None for the reference variant.
        overrides: overrides of config keys that define the variant.
        seconds: mean duration of a run in s.
    """

    variant: str
    protocol: str
    seeds: int
    windows: int
    diverged: int
    nrmse_mean: float
    nrmse_sd: float | None
    nrmse_range: tuple[float, float]
    difference: float
    difference_ci95: tuple[float, float] | None
    overrides: tuple[str, ...] = ()
    seconds: float = 0.0


class VariantsFile(FileRecord):
    """variants.json: the errors of all variants of a fit.

    Attributes:
        run: name of the sweep.
        model: the compared model of each run.
        split: split of the logs.
        reference: name of the reference variant.
        rows: a row for each variant and protocol.
    """

    schema_name: Literal["residnet.variants/1"] = Field(alias="schema")
    run: str
    model: str
    split: str
    reference: str
    rows: tuple[VariantRow, ...]


class SuspectRow(Record):
    """The score test of one possible change of a vessel or a sensor.

    Attributes:
        cause: name of the change.
        score: statistic of the test.
        size: estimated size of the change.
        standard_error: standard error of the size.
        unit: unit of the size.
        explains: square of the innovations that the change explains.
    """

    cause: str
    score: float
    size: float
    standard_error: float
    unit: str
    explains: float


class MonitoredLogRow(Record):
    """The change detection over one log.

    Attributes:
        log: name of the log.
        windows: number of windows.
        alarm_after: time in s to the first alarm; None without alarm.
        threshold: score above which a change raises an alarm.
        innovation: root mean square of the whitened innovations of each channel.
        suspects: possible changes at the end of the log, the likeliest first.
    """

    log: str
    windows: int
    alarm_after: float | None
    threshold: float
    innovation: dict[str, float]
    suspects: tuple[SuspectRow, ...]


class ParameterChangeRow(Record):
    """A change of a parameter that a recursive refit identified.

    Attributes:
        cause: name of the change.
        size: estimated size of the change.
        standard_error: standard error of the size.
        unit: unit of the size.
        after_each_log: estimate after each log.
    """

    cause: str
    size: float
    standard_error: float
    unit: str
    after_each_log: tuple[float, ...]


class RefitSummary(Record):
    """The result of a recursive refit.

    Attributes:
        changes: identified changes.
        ended: reason for which the search for changes ended.
        run: folder of the new run; None if no change was identified.
        nrmse_old: mean free-run error of the old model on held-out logs; None without a run.
        nrmse_new: mean free-run error of the new model on held-out logs.
        worth_taking: whether the new model is significantly better.
    """

    changes: tuple[ParameterChangeRow, ...]
    ended: str
    run: str | None
    nrmse_old: float | None
    nrmse_new: float | None
    worth_taking: bool


class RefitRow(Record):
    """The last entry of monitor.json after a refit.

    Attributes:
        refit: result of the refit.
    """

    refit: RefitSummary


class MonitorFile(FileRows[MonitoredLogRow | RefitRow]):
    """monitor.json: the change detection over logs in chronological order, and the refit."""


class RunFigure(Record):
    """The first main figure of a run; its value is None if it is not finite."""

    name: str
    value: float | None
    unit: str


class RunRow(Record):
    """A run in the list of runs.

    Attributes:
        run: the run folder.
        task: name of the task; `unknown` if the config has none.
        state: whether the run is complete and readable.
        best: first main figure; None without one.
        age: time since the start of the run in s.
    """

    run: str
    task: str = "unknown"
    state: Literal["finished", "unfinished", "damaged"] = "unfinished"
    best: RunFigure | None = None
    age: float
