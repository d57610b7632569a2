"""Typed contents of limits.json: errors by horizon and class, and the repeatability of runs."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from residnet.core.layout import SIX_DOF_LAYOUT
from residnet.core.records import FileRecord, Record
from residnet.evaluation.records import ByChannel, Interval, PairedDifference


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
            of its mean error minus the error of the constant-velocity model, SI; None with too
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
