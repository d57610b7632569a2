"""Typed contents of the JSON files that an evaluation writes into a run folder, one model per file.

A writer builds the record, so that a key or a type that the format does not have fails there. The
keys are a contract with other programs; values are in SI units and rad.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from residnet.core.model_names import FORMER_NAMES
from residnet.core.records import FileRecord, Record

ByChannel = dict[str, float]
"""A number for each channel."""
CurveByChannel = dict[str, tuple[float, ...]]
"""Numbers for each channel, one for each horizon or measure."""
Interval = tuple[float, float]
"""Lower and upper limit."""
ModelKind = Literal["constant_velocity", "baseline", "head", "plant", "ensemble"]
"""Kinds of models."""


class BlockCount(Record):
    """The blocks that a bootstrap resamples or a selection pairs.

    Attributes:
        of: kind of block: all windows of a log (`logs`), or a part of a log.
        count: number of blocks.
    """

    of: Literal["logs", "windows", "stretches", "segments"]
    count: int


class PairedDifference(Record):
    """The difference of the mean errors of two models over the same windows.

    Attributes:
        to: name of the reference model.
        nrmse_mean: model minus reference; negative if the model is better.
        ci95: 95 % confidence interval; None if there are too few logs.
        excludes_zero: whether the interval excludes zero.
        ratio: error of the model over the error of the reference; None if the latter is zero.
        worse: whether the ratio is above 1.05.
    """

    to: str
    nrmse_mean: float
    ci95: Interval | None
    excludes_zero: bool
    ratio: float | None
    worse: bool


class MetricsRow(Record):
    """Free-run errors of one model over the windows of one split, protocol and kind of manoeuvre.

    Attributes:
        model: name of the model.
        kind: kind of model.
        split: train, validation, test or external.
        protocol: name of the protocol, for example `T100`.
        manoeuvre: `all`, one kind, or a group of kinds that the config names.
        windows: number of windows.
        n: number of scored samples.
        diverged: number of diverged windows; they count with the constant-velocity error.
        rmse: mean over the windows of the root mean square error of each velocity.
        mae: mean over the windows of the mean absolute error of each velocity.
        nrmse: `rmse` divided by the scales of the config, and the `mean` over the velocities.
        rmse_ci95: bootstrap 95 % confidence intervals of `rmse`; None if there are too few windows.
        nrmse_mean_ci95: interval of the mean of `nrmse`.
        ci95_blocks: the blocks that were resampled.
        position_error_end: distance in m at the end of a window, mean over the windows.
        position_error_end_ci95: 95 % confidence interval of `position_error_end`.
        heading_error_end: heading error in rad at the end of a window, mean over the windows.
        heading_error_end_ci95: 95 % confidence interval of `heading_error_end`.
        depth_error_end: depth error in m at the end of a window, for vessels that dive.
        depth_error_end_ci95: 95 % confidence interval of `depth_error_end`.
        attitude_error_end: attitude error in rad at the end of a window, for vessels that dive.
        attitude_error_end_ci95: 95 % confidence interval of `attitude_error_end`.
        difference: paired difference from the reference model of this model.
        band_coverage: fraction of the samples within the prediction interval by channel, the `mean`
            of the channels, and `whole`: the fraction of windows that are entirely within the
            simultaneous interval.
        band_score: mean interval score in units of the constant-velocity error.
        band_score_constant: interval score of an interval of constant width.
        selected: whether validation data chose this single model; None where nothing was chosen.
    """

    model: str
    kind: ModelKind
    split: str
    protocol: str
    manoeuvre: str
    windows: int
    n: int
    diverged: int
    rmse: ByChannel
    mae: ByChannel
    nrmse: ByChannel
    rmse_ci95: dict[str, Interval | None]
    nrmse_mean_ci95: Interval | None
    ci95_blocks: BlockCount | None
    position_error_end: float | None = None
    position_error_end_ci95: Interval | None = None
    heading_error_end: float | None = None
    heading_error_end_ci95: Interval | None = None
    depth_error_end: float | None = None
    depth_error_end_ci95: Interval | None = None
    attitude_error_end: float | None = None
    attitude_error_end_ci95: Interval | None = None
    difference: PairedDifference | None = None
    band_coverage: ByChannel | None = None
    band_score: float | None = None
    band_score_constant: float | None = None
    selected: bool | None = None

    @field_validator("kind", mode="before")
    @classmethod
    def _refuse_former_kinds(cls, kind: object) -> object:
        if kind in FORMER_NAMES:
            raise ValueError(
                f"an earlier version wrote '{kind}', which is '{FORMER_NAMES[str(kind)]}' today"
            )
        return kind

    @property
    def mean_nrmse(self) -> float:
        """The mean of `nrmse` over the velocities."""
        return self.nrmse["mean"]

    @property
    def final_pose_errors(self) -> dict[str, float]:
        """The pose errors at the end of a window by name (`POSE_ERROR_UNITS`)."""
        errors = {
            "position": self.position_error_end,
            "heading": self.heading_error_end,
            "depth": self.depth_error_end,
            "attitude": self.attitude_error_end,
        }
        return {name: error for name, error in errors.items() if error is not None}

    @property
    def final_pose_intervals(self) -> dict[str, Interval | None]:
        """The 95 % confidence intervals of `final_pose_errors`; None if there are too few logs."""
        intervals = {
            "position": self.position_error_end_ci95,
            "heading": self.heading_error_end_ci95,
            "depth": self.depth_error_end_ci95,
            "attitude": self.attitude_error_end_ci95,
        }
        return {name: intervals[name] for name in self.final_pose_errors}


class MetricsFile(FileRecord):
    """metrics.json of a fit or of an evaluation on other logs.

    Attributes:
        run: name of the run.
        channels: unit of each state.
        scales: scale of each velocity, the denominators of `nrmse`.
        selected: name of the single model that validation data chose.
        selected_ensemble: name of the best ensemble; None without ensembles.
        predictor: name of the model that is reported first and exported by default.
        rows: errors by model, split, protocol and kind of manoeuvre.
    """

    schema_name: Literal["residnet.metrics/1"] = Field(alias="schema")
    run: str
    channels: dict[str, str]
    scales: ByChannel
    selected: str
    selected_ensemble: str | None
    predictor: str
    rows: tuple[MetricsRow, ...]


class SelectionRow(Record):
    """A candidate of the model selection.

    Attributes:
        model: name of the model.
        family: complexity class, see `evaluation.selection.MODEL_FAMILIES`.
        parameters: number of parameters.
        nrmse_mean: mean validation error.
        ratio: geometric mean over the blocks of the error ratio to the selected model.
        standard_error: standard error of the logarithm of `ratio`.
        diverged: number of diverged validation windows.
        sound: whether the model passed all checks.
        faults: failed checks.
    """

    model: str
    family: str
    parameters: int
    nrmse_mean: float
    ratio: float
    standard_error: float
    diverged: int
    sound: bool
    faults: tuple[str, ...]


class SelectionFile(FileRecord):
    """selection.json: the chosen models and the reason.

    Attributes:
        selected: name of the chosen single model.
        selected_ensemble: name of the best ensemble; None without ensembles.
        predictor: name of the model that is reported first.
        reason: one sentence on the choice of the single model.
        blocks: blocks of validation data over which errors were paired.
        models: all candidates.
    """

    schema_name: Literal["residnet.selection/2"] = Field(alias="schema")
    selected: str
    selected_ensemble: str | None
    predictor: str
    reason: str
    blocks: BlockCount
    models: tuple[SelectionRow, ...]


class Activity(Record):
    """Dependence of the width of a prediction interval on the motion of the run.

    Attributes:
        measures: velocities and accelerations whose mean squares measure the motion.
        floor: smallest value of each measure.
        centre: mean logarithm of each measure.
        spread: standard deviation of the logarithm of each measure.
        slope: slope of the log width against the standardised measures, by channel.
    """

    measures: tuple[str, ...]
    floor: tuple[float, ...]
    centre: tuple[float, ...]
    spread: tuple[float, ...]
    slope: CurveByChannel


class DistanceEffect(Record):
    """Growth of the width of a prediction interval with the distance to the training data.

    The distance is the running mean of half the logarithm of the inverse Christoffel function over
    its mean in the training data.

    Attributes:
        threshold: distance above which the width grows.
        largest: largest distance at the end of a calibration run.
        slope: slope of the log width above the threshold, by channel; None if the training logs
            have fewer than three kinds of manoeuvres, so that the width is independent of it.
    """

    threshold: float
    largest: float
    slope: ByChannel | None


class BandRow(Record):
    """Prediction intervals of the free runs of one model under one protocol, by channel.

    Attributes:
        level: nominal coverage.
        step: time step in s.
        horizon: longest calibrated horizon in s.
        logs: number of logs that calibrated the intervals.
        independent_scores: equivalent number of independent calibration scores.
        cautions: sentences on the limits of the intervals.
        steps: horizons in time steps; the half widths and `usual_spread` have one value for each.
        half_width: half widths for a run of typical motion.
        half_width_of_any_run: half widths that do not depend on the motion of the run.
        whole_run_factor: factor on the half widths for a whole run.
        constant_half_width: half widths of intervals of constant width.
        score_unit: root mean square constant-velocity errors, the unit of interval scores.
        activity: dependence of the width on the motion.
        usual_spread: typical disagreement of the members of an ensemble; None for other models.
        distance: effect of the distance to the training data, from kinds of manoeuvres that the fit
            did not contain; None without a density of the training data.
    """

    level: float
    step: float
    horizon: float
    logs: int
    independent_scores: float
    cautions: tuple[str, ...]
    steps: tuple[float, ...]
    half_width: CurveByChannel
    half_width_of_any_run: CurveByChannel
    whole_run_factor: ByChannel
    constant_half_width: ByChannel
    score_unit: ByChannel
    activity: Activity
    usual_spread: CurveByChannel | None
    distance: DistanceEffect | None = None


class BandsFile(FileRecord):
    """bands.json: prediction intervals of free runs.

    Attributes:
        run: name of the run.
        models: intervals by model and protocol.
    """

    schema_name: Literal["residnet.bands/1"] = Field(alias="schema")
    run: str
    models: dict[str, dict[str, BandRow]]


class MaeDifference(Record):
    """Paired difference of the mean absolute one-step residuals of two models.

    Attributes:
        to: name of the reference model.
        mae: model minus reference; negative if the model is better.
        ci95: 95 % confidence interval; None if there are too few samples.
        excludes_zero: whether the interval excludes zero.
        ratio: residual of the model over that of the reference; None if the latter is zero.
    """

    to: str
    mae: float
    ci95: Interval | None
    excludes_zero: bool
    ratio: float | None


class GoodnessRow(Record):
    """Goodness of fit of one model on one axis; criteria of Halvorsen 2019, section 9.

    Attributes:
        model: name of the model.
        kind: kind of model.
        axis: name of the acceleration.
        samples: number of samples.
        parameters: number of fitted parameters of this axis.
        rmse: root mean square residual.
        r2: coefficient of determination; None if the target is constant.
        r2_adjusted: coefficient of determination, adjusted for the number of parameters.
        cp: Mallows' C_p.
        aic: Akaike's criterion; None without noise.
        bic: Bayesian criterion; None without noise.
        mae: mean absolute residual.
        mae_ci95: block-bootstrap 95 % interval of `mae`; None if there are too few samples.
        mae_ci95_independent: 95 % interval of `mae` for independent samples.
        block_seconds: length of a bootstrap block in s.
        mean: mean residual.
        mean_ci95: block-bootstrap 95 % interval of `mean`.
        effective: effective sample size: number of independent samples whose mean would have the
            same variance.
        autocorrelation: autocorrelation of the residuals at lags of 1, 2, ... samples.
        ljung_box: statistic of the test for white residuals.
        white_p: p-value of `ljung_box` for white residuals.
        difference: paired difference from the reference model.
    """

    model: str
    kind: ModelKind
    axis: str
    samples: int
    parameters: float
    rmse: float
    r2: float | None
    r2_adjusted: float | None
    cp: float
    aic: float | None
    bic: float | None
    mae: float
    mae_ci95: Interval | None
    mae_ci95_independent: Interval | None
    block_seconds: float
    mean: float
    mean_ci95: Interval | None
    effective: float
    autocorrelation: tuple[float, ...]
    ljung_box: float
    white_p: float
    difference: MaeDifference | None = None


class GoodnessFile(FileRecord):
    """goodness.json: one-step residuals along measured states.

    Attributes:
        run: name of the run.
        lags: number of lags of the autocorrelation.
        step: time step in s.
        splits: rows by split.
    """

    schema_name: Literal["residnet.goodness/1"] = Field(alias="schema")
    run: str
    lags: int
    step: float
    splits: dict[str, tuple[GoodnessRow, ...]]


SANITY_CHECKS = ("damping", "stability", "symmetry", "bounded")
"""The physical checks, in the order in which they are made."""


class SanityRow(Record):
    """The result of one physical check of one model.

    Attributes:
        model: name of the model.
        check: one of `SANITY_CHECKS`.
        ok: whether the model passed; None where the check does not apply or could not be made.
        text: one sentence with figures.
        fault: why the model is unsound, in a few words; empty if the finding is only reported.
    """

    model: str
    check: str
    ok: bool | None
    text: str
    fault: str = ""


class SanityFile(FileRecord):
    """sanity.json: results of the physical checks.

    Attributes:
        findings: results by model and check.
    """

    schema_name: Literal["residnet.sanity/1"] = Field(alias="schema")
    findings: tuple[SanityRow, ...]
