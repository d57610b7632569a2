"""Typed contents of the JSON files that an evaluation writes into a run folder, one model per file.

A writer builds the record, so that a key or a type that the format does not have fails there. The
keys are a contract with other programs; values are in SI units and rad.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field, JsonValue, field_validator

from residnet.core.layout import SIX_DOF_LAYOUT
from residnet.core.model_names import FORMER_NAMES
from residnet.core.records import FileRecord, FileRows, Record

ByChannel = dict[str, float]
"""A number for each channel."""
CurveByChannel = dict[str, tuple[float, ...]]
"""Numbers for each channel, one for each horizon or measure."""
Interval = tuple[float, float]
"""Lower and upper limit."""
ModelKind = Literal["constant_velocity", "baseline", "head", "plant", "ensemble"]
"""Kinds of models."""

# metrics.json


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


# selection.json


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


# limits.json


class PoseErrors(Record):
    """Mean pose errors at a horizon, with 95 % prediction intervals of the mean over new logs.

    Attributes:
        position: distance in m.
        heading: heading error in rad.
        depth: depth error in m, of a vessel that dives.
        attitude: attitude error in rad, of a vessel that dives.
        intervals: interval of each error; None if there are too few logs.
    """

    position: float | None = None
    heading: float | None = None
    depth: float | None = None
    attitude: float | None = None
    intervals: dict[str, Interval | None]

    @property
    def by_name(self) -> dict[str, float]:
        """The errors by name (`POSE_ERROR_UNITS`), without those that are not defined."""
        errors = {
            "position": self.position,
            "heading": self.heading,
            "depth": self.depth,
            "attitude": self.attitude,
        }
        return {name: error for name, error in errors.items() if error is not None}


class HorizonRow(Record):
    """Pose errors of all models after one horizon.

    Attributes:
        seconds: the horizon in s.
        windows: number of windows that reach it.
        logs: number of logs that these windows come from.
        logs_of_spread: number of logs that estimate the spread between logs of the prediction
            intervals, with those of other splits; 0 without intervals and in runs of earlier
            versions.
        slowest: smallest mean speed of a window in m/s.
        fastest: largest mean speed of a window in m/s.
        sailed: mean distance travelled in m.
        floor: errors of the integrated measured velocities, which even exact velocities of a model
            would have.
        models: errors by model.
        change_from_constant_velocity: by model and pose error, the paired 95 % confidence interval
            of its mean error minus that of the constant-velocity model, SI; None if there are too
            few logs. Empty without a constant-velocity model, and in runs of earlier versions.
    """

    seconds: float
    windows: int
    logs: int
    logs_of_spread: int = 0
    slowest: float
    fastest: float
    sailed: float
    floor: PoseErrors
    models: dict[str, PoseErrors]
    change_from_constant_velocity: dict[str, dict[str, Interval | None]] = Field(
        default_factory=dict
    )


class ClassErrors(Record):
    """Error of a model over the windows of one class.

    Attributes:
        nrmse_mean: mean error.
        difference: paired difference from the reference model; None without one.
    """

    nrmse_mean: float
    difference: PairedDifference | None


class ClassRow(Record):
    """Errors over the windows of one third of the range of speed or wind speed.

    Attributes:
        by: quantity that defines the classes: speed of the vessel, or true wind speed.
        low: smallest mean of a window in m/s.
        high: largest mean of a window in m/s.
        windows: number of windows.
        models: errors by model.
    """

    by: Literal["speed", "wind"]
    low: float
    high: float
    windows: int
    models: dict[str, ClassErrors]


class WorstWindow(Record):
    """A window with one of the largest errors of a model.

    Attributes:
        log: name of the log.
        manoeuvre: kind of manoeuvre.
        t: start of the window in the log in s.
        nrmse: error of the window.
        rmse: root mean square error of each velocity.
        position_error_end: distance in m at the end of the window.
        heading_error_end: heading error in rad at the end of the window.
        depth_error_end: depth error in m at the end of the window.
        attitude_error_end: attitude error in rad at the end of the window.
    """

    log: str
    manoeuvre: str
    t: float
    nrmse: float
    rmse: ByChannel
    position_error_end: float | None = None
    heading_error_end: float | None = None
    depth_error_end: float | None = None
    attitude_error_end: float | None = None

    @property
    def final_pose_error(self) -> float | None:
        """The pose error that ranks the windows: the first one that the model determines."""
        errors = (
            self.position_error_end,
            self.heading_error_end,
            self.depth_error_end,
            self.attitude_error_end,
        )
        return next((error for error in errors if error is not None), None)


class OutsideRange(Record):
    """Share of samples outside the training range.

    Attributes:
        share: share of the samples with any channel outside; None if the range is unknown.
        channels: share of each channel that is outside.
    """

    share: float | None = None
    channels: ByChannel = Field(default_factory=dict)


class KinematicErrors(Record):
    """Pose errors of the integrated measured velocities, mean and root mean square over windows.

    All are absent if some velocities were not measured.

    Attributes:
        windows: number of windows.
        position_mean: mean distance in m at the end of a window.
        position_rms: root mean square distance in m at the end of a window.
        heading_mean: mean heading error in rad at the end of a window.
        heading_rms: root mean square heading error in rad at the end of a window.
        depth_mean: mean depth error in m at the end of a window.
        depth_rms: root mean square depth error in m at the end of a window.
        attitude_mean: mean attitude error in rad at the end of a window.
        attitude_rms: root mean square attitude error in rad at the end of a window.
    """

    windows: int = 0
    position_mean: float | None = None
    position_rms: float | None = None
    heading_mean: float | None = None
    heading_rms: float | None = None
    depth_mean: float | None = None
    depth_rms: float | None = None
    attitude_mean: float | None = None
    attitude_rms: float | None = None

    @property
    def means(self) -> dict[str, float]:
        """The mean errors by name (`POSE_ERROR_UNITS`)."""
        errors = {
            "position": self.position_mean,
            "heading": self.heading_mean,
            "depth": self.depth_mean,
            "attitude": self.attitude_mean,
        }
        return {name: error for name, error in errors.items() if error is not None}


class ProtocolLimits(Record):
    """Limits of the models under one protocol of one split.

    Attributes:
        kinematics: pose errors of the integrated measured velocities.
        bands: errors by class of speed and wind speed.
        worst: the windows with the largest errors, by model.
        compared: paired differences by model and reference model.
        outside: share of the samples outside the training range.
        horizons: pose errors by horizon.
        beyond_calibration: share of the windows that are farther from the training data than any
            run that calibrated the prediction intervals, by model.
    """

    kinematics: KinematicErrors
    bands: tuple[ClassRow, ...]
    worst: dict[str, tuple[WorstWindow, ...]]
    compared: dict[str, dict[str, PairedDifference | None]]
    outside: OutsideRange
    horizons: tuple[HorizonRow, ...]
    beyond_calibration: dict[str, float] = Field(default_factory=dict)


class RepeatTolerance(Record):
    """Largest differences of two runs that count as repeated.

    Attributes:
        command_share_of_range: root mean square difference of each command over its range.
        start: difference of each initial velocity.
    """

    command_share_of_range: float
    start: ByChannel


class RepeatDifferences(Record):
    """Mean differences between the two runs of a repeated pair, in SI units and rad.

    Attributes:
        pairs: number of pairs.
        u: root mean square difference of the surge velocity over a window.
        v: the same of the sway velocity.
        r: the same of the yaw rate.
        p: the same of the roll rate.
        phi: the same of the roll angle.
        w: the same of the heave velocity.
        q: the same of the pitch rate.
        z: the same of the depth.
        theta: the same of the pitch angle.
        position: distance of the ends of the runs in m, each relative to its start.
        heading: difference of the headings at the end in rad.
        nrmse: mean of the differences over the scales.
    """

    pairs: int
    u: float | None = None
    v: float | None = None
    r: float | None = None
    p: float | None = None
    phi: float | None = None
    w: float | None = None
    q: float | None = None
    z: float | None = None
    theta: float | None = None
    position: float | None = None
    heading: float | None = None
    nrmse: float | None = None

    @property
    def by_channel(self) -> ByChannel:
        """The differences of the velocities of the model, by channel."""
        differences: dict[str, float | None] = {
            name: getattr(self, name) for name in SIX_DOF_LAYOUT.dynamic_states
        }
        return {name: value for name, value in differences.items() if value is not None}

    @property
    def final_pose(self) -> dict[str, float]:
        """The differences of the pose at the end by name (`POSE_ERROR_UNITS`)."""
        errors = {"position": self.position, "heading": self.heading}
        return {name: error for name, error in errors.items() if error is not None}


class Repeatability(RepeatDifferences):
    """Differences between repeated manoeuvres of one protocol; absent without pairs.

    Attributes:
        tolerance: how much two runs may differ to count as repeated.
        logs: number of logs with a pair.
        manoeuvres: differences of repeated runs by kind of manoeuvre.
    """

    tolerance: RepeatTolerance
    logs: int
    manoeuvres: dict[str, RepeatDifferences] = Field(default_factory=dict)


class LimitsFile(FileRecord):
    """limits.json: errors by horizon, class and window.

    Attributes:
        run: name of the run.
        splits: limits of the models by split and protocol.
        repeatability: differences between repeated manoeuvres by protocol.
    """

    schema_name: Literal["residnet.limits/1"] = Field(alias="schema")
    run: str
    splits: dict[str, dict[str, ProtocolLimits]]
    repeatability: dict[str, Repeatability]

    def find(self, split: str, protocol: str) -> ProtocolLimits | None:
        """Return the limits under one protocol of one split; None without windows."""
        return self.splits.get(split, {}).get(protocol)


# bands.json


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


# goodness.json


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


# sanity.json


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


# excitation.json


class InputExcitationRow(Record):
    """Excitation in the training logs of one input that is a regressor of the model.

    Attributes:
        name: name of the input.
        low: smallest value, SI.
        high: largest value, SI.
        std: standard deviation, SI.
        bandwidth: frequency in Hz below which 95 % of its power lies; None for a constant input.
        variance_inflation: ratio by which velocities and other inputs increase the variance of the
            estimated effect, by leave-one-log-out regression.
        feedback_source: quantity that a controller may have fed back; None if it cannot be
            assessed.
        feedback_share: share of the input that feedback explains beyond its effects.
        effect_share: share of the input that the velocities before and after it explain.
        state: excited; held at one value; set by feedback without excitation; or collinear with
            velocities and other inputs.
        text: the state in words.
    """

    name: str
    low: float
    high: float
    std: float
    bandwidth: float | None
    variance_inflation: float
    feedback_source: str | None
    feedback_share: float | None
    effect_share: float | None
    state: Literal["excited", "held", "feedback", "collinear"]
    text: str


class DirectionRow(Record):
    """Excitation of the sum or the difference of two inputs of the same kind.

    Attributes:
        name: the direction in words.
        inputs: names of the inputs.
        ratio: standard deviation relative to the larger one of sum and difference.
        is_excited: whether the logs excite the direction.
        text: the result in words.
    """

    name: str
    inputs: tuple[str, str]
    ratio: float
    is_excited: bool
    text: str


class ExcitationFile(FileRecord):
    """excitation.json: what the training logs excite, and feedback in training and test logs.

    Attributes:
        run: name of the run.
        inputs: inputs that are regressors of the model.
        directions: sums and differences of inputs of the same kind.
        closed_loop_test_inputs: inputs of the test logs that feedback sets.
        domain: sentences on the relations of the operating domain.
    """

    schema_name: Literal["residnet.excitation/1"] = Field(alias="schema")
    run: str
    inputs: tuple[InputExcitationRow, ...]
    directions: tuple[DirectionRow, ...]
    closed_loop_test_inputs: tuple[str, ...]
    domain: tuple[str, ...]


# booklet.json


class BookletIndex(Record):
    """A manoeuvring index.

    Attributes:
        value: index for the fitted parameters, in the scale of the logs.
        ship: index for the fitted parameters, in the scale of the ship.
        draws: number of parameter draws for which the index exists.
        interval: prediction interval over the draws and the model error of repeated trials.
        repeated_trials: number of repeated trials in the model error; absent if it is unknown.
        lengths: index in lengths of the hull.
        measured: index of the measured manoeuvre.
        difference: simulated minus measured index.
        limit: limit of IMO in the scale of the ship.
        kept: whether the limit is met.
        kept_share: share of the predictive distribution that meets the limit.
    """

    value: float
    ship: float
    draws: int
    interval: Interval | None = None
    repeated_trials: int | None = None
    lengths: float | None = None
    measured: float | None = None
    difference: float | None = None
    limit: float | None = None
    kept: bool | None = None
    kept_share: float | None = None


class BookletRow(Record):
    """Indices of one manoeuvre.

    Attributes:
        name: name of the manoeuvre or of the repeated log.
        manoeuvre: kind of manoeuvre.
        demand: settings of the manoeuvre.
        split: split of the repeated log; empty for a standard manoeuvre.
        faults: number of parameter draws that did not end the manoeuvre.
        indices: indices by name.
    """

    name: str
    manoeuvre: str
    demand: dict[str, JsonValue]
    split: str
    faults: int
    indices: dict[str, BookletIndex]


class BookletFile(FileRecord):
    """booklet.json: manoeuvring indices with intervals.

    Attributes:
        model: name of the model.
        length: length of the hull in m in the scale of the logs.
        scale: scale of the ship over the scale of the logs.
        draws: number of parameter draws.
        level: level of the intervals.
        units: unit of each index.
        pages: indices by manoeuvre.
        remarks: manoeuvres that the model could not complete, with their reasons.
    """

    schema_name: Literal["residnet.booklet/1"] = Field(alias="schema")
    model: str
    length: float
    scale: float
    draws: int
    level: float
    units: dict[str, str]
    pages: tuple[BookletRow, ...]
    remarks: tuple[str, ...] = ()


# indices.json


class IndexLimit(Record):
    """The limit of IMO of an index.

    Attributes:
        limit: the limit.
        kept: whether it is met.
    """

    limit: float
    kept: bool


class FlightIndices(Record):
    """Manoeuvring indices of one simulated manoeuvre.

    Attributes:
        log: name of the log.
        manoeuvre: kind of manoeuvre.
        craft: name of the vessel or model.
        fault: why the manoeuvre did not end as intended; None if it did.
        timed_out: whether it ended by its longest duration.
        indices: values by name in SI units and rad; a list for a spiral. `<name>_lengths` is an
            index in lengths of the hull.
        limits: limits of IMO by name of the index.
    """

    log: str
    manoeuvre: str
    craft: str
    fault: str | None
    timed_out: bool
    indices: dict[str, float | tuple[float, ...]]
    limits: dict[str, IndexLimit]

    @property
    def scalar_indices(self) -> dict[str, BookletIndex]:
        """The indices that are numbers, with their lengths and limits."""
        entries = {}
        for name, value in self.indices.items():
            if isinstance(value, tuple) or name.endswith("_lengths"):
                continue
            lengths = self.indices.get(f"{name}_lengths")
            limit = self.limits.get(name)
            entries[name] = BookletIndex(
                value=value,
                ship=value,
                draws=0,
                lengths=None if isinstance(lengths, tuple) else lengths,
                limit=None if limit is None else limit.limit,
                kept=None if limit is None else limit.kept,
            )
        return entries


class IndicesFile(FileRecord):
    """indices.json: manoeuvring indices of simulated manoeuvres.

    Attributes:
        run: name of the run.
        length: length of the hull in m; None if it is unknown.
        units: unit of each index.
        rows: indices by manoeuvre and vessel.
    """

    schema_name: Literal["residnet.indices/1"] = Field(alias="schema")
    run: str
    length: float | None
    units: dict[str, str]
    rows: tuple[FlightIndices, ...]


# data_quality.json


class LogQuality(Record):
    """The samples of one prepared log.

    Attributes:
        log: name of the log.
        split: train, validation, test or external.
        manoeuvre: kind of manoeuvre.
        seconds: duration in s.
        samples: number of samples.
        usable: share of the samples at which velocities and position are scored.
        learned_from: fraction of the samples that have smoothed states and accelerations, from
            which models learn.
        masked: share of the samples that each mask excludes.
        largest: largest magnitude of each state over the usable samples.
        integrated: pose channels that were integrated from the velocities.
    """

    log: str
    split: str
    manoeuvre: str
    seconds: float
    samples: int
    usable: float
    learned_from: float
    masked: ByChannel
    largest: ByChannel
    integrated: tuple[str, ...] = ()


class DataQualityFile(FileRows[LogQuality]):
    """data_quality.json: the samples of each log."""
