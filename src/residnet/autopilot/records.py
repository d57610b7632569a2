"""Typed contents of the JSON files that the tasks `autopilot`, `course` and `roll` write.

The keys are a contract with other programs; values are in SI units and rad.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import ConfigDict, Field

from residnet.autopilot.heading.evaluation_config import EvaluationConditions, StepTestConfig
from residnet.autopilot.heading.predictive import AnyController, PredictiveConfig
from residnet.core.records import FileRecord, Record
from residnet.identification.records import EpochRow

ControllerKind = Literal[
    "policy",
    "network",
    "constants",
    "law",
    "untrained",
    "network_off",
    "classical",
    "predictive",
    "floor",
]
"""Roles of controllers in a comparison.

Trained policies: a `policy` adds a network to a classical law, a `network` contains no law, and
`constants` is a law whose constants were trained. A `law` is a classical law that is exported as a
policy without training. Ablations of a policy: `untrained` is the policy before its training,
`network_off` the trained policy without its network. References: `classical` laws with tuned
constants, the `predictive` autopilot of Gouletas 2020, and the `floor`, a law that knows the
nominal vessel exactly.
"""
CardSchema = Literal["residnet.policy_card/1", "residnet.course_card/1"]
"""Formats of the model card of a controller."""


class ControlMetrics(Record):
    """Common keys of the metrics.json of tasks that compare controllers.

    Attributes:
        run: name of the run.
        channels: metric -> its unit.
    """

    schema_name: Literal["residnet.metrics/1"] = Field(alias="schema")
    run: str
    channels: dict[str, str]


# metrics.json of the task `autopilot`


class Distribution(Record):
    """Distribution of a metric over simulations.

    Attributes:
        mean: arithmetic mean.
        median: median.
        p95: 95th percentile.
        max: largest value.
    """

    mean: float
    median: float
    p95: float
    max: float


class HeadingRow(Record):
    """Metrics of one controller of heading or depth in the simulations of one test.

    Metrics of the heading error are in rad; those of a depth error are in m.

    Attributes:
        model: name of the controller.
        kind: role of the controller.
        split: `simulated`.
        protocol: name of the test: nominal, corners, random, bias, wind, sea, quiet, conditions, or
            `beyond_` and the name of further conditions.
        cost: cost in s of a change of the reference, for tests with random conditions.
        time_outside: part of the cost for the time outside the band in s.
        settling: time in s of the last entry into the band around the new reference.
        overshoot: largest error beyond the new reference, in rad or m.
        iae: integral of the absolute error in rad s or m s.
        travel: travel of the rudder command in rad.
        energy: integral of the square of the rudder command in rad^2 s.
        heading_rms: root mean square of the heading error in waves.
        rudder_rms: root mean square of the rudder angle in waves, in rad.
        heel_rms: root mean square of the roll angle in waves in rad, for vessels that roll.
        heading_swing: peak-to-peak error at the end of noise-free simulations.
        rudder_swing: peak-to-peak rudder command in rad at the end of noise-free simulations.
        unsettled: number of simulations that end outside the band.
        cycling: number of noise-free simulations with a limit cycle.
        n: number of simulations.
        diverged: number of simulations with a NaN.
        error_end: largest absolute error at the end of the simulations.
    """

    model: str
    kind: ControllerKind
    split: Literal["simulated"]
    protocol: str
    cost: Distribution | None = None
    time_outside: Distribution | None = None
    settling: Distribution | None = None
    overshoot: Distribution | None = None
    iae: Distribution | None = None
    travel: Distribution | None = None
    energy: Distribution | None = None
    heading_rms: Distribution | None = None
    rudder_rms: Distribution | None = None
    heel_rms: Distribution | None = None
    heading_swing: Distribution | None = None
    rudder_swing: Distribution | None = None
    unsettled: int | None = None
    cycling: int | None = None
    n: int
    diverged: int | None = None
    error_end: float | None = None

    @property
    def mean_cost(self) -> float:
        """Mean of `cost`, for a row of a test that has it."""
        assert self.cost is not None
        return self.cost.mean

    @property
    def max_settling(self) -> float:
        """Largest of `settling`, for a row of a test that has it."""
        assert self.settling is not None
        return self.settling.max


class SimulatedSettings(Record):
    """Settings of an autopilot run as simulated, with all times scaled by `pace`.

    Attributes:
        test: step test of all controllers.
        conditions: operating conditions of tuning, training and evaluation; None for none.
    """

    test: StepTestConfig
    conditions: EvaluationConditions | None = None


class AutopilotMetricsFile(ControlMetrics, FileRecord):
    """metrics.json of the task `autopilot`: metrics of all controllers in all tests.

    Attributes:
        floor: name of the controller that knows the vessel exactly; None without one.
        flown: settings as simulated.
        rows: metrics of one controller in one test each.
    """

    floor: str | None
    flown: SimulatedSettings
    rows: tuple[HeadingRow, ...] = Field(min_length=1)


# controllers.json of the task `autopilot`


class TurningParameters(Record):
    """Parameters of Nomoto's model T r_dot + r = K delta, as in controllers.json.

    Attributes:
        gain: K in 1/s.
        time: T in s.
        speed: speed in m/s at which K and T hold.
        righting: restoring of the pitch angle for vessels that dive, in 1/s^2.
    """

    gain: float
    time: float
    speed: float
    righting: float


class ControllerNotes(Record):
    """Notes on the tuning or training of a controller; trained ones have further keys.

    Attributes:
        config: settings of a classical law with its tuned constants, or of a predictive autopilot.
        cost: mean cost of the tuned law in s.
        tried: number of sets of constants that the tuning simulated.
        seconds: duration of the tuning or training in s.
    """

    model_config = ConfigDict(extra="allow")

    config: AnyController | PredictiveConfig | None = None
    cost: float | None = None
    tried: int | None = None
    seconds: float | None = None


class PolicyNotes(FileRecord):
    """fit.json of a policy: notes on its training; there are further keys.

    Attributes:
        start_validation: mean cost in s over the validation simulations before the training.
        training_history: mean cost by epoch.
    """

    model_config = ConfigDict(extra="allow")

    start_validation: float
    training_history: tuple[EpochRow, ...] = Field(alias="curve")


class ControllersFile(FileRecord):
    """controllers.json: the controllers of a run of the task `autopilot` with their constants.

    Attributes:
        turning: Nomoto's model of the vessel.
        controllers: notes by the name of the controller.
    """

    schema_name: Literal["residnet.controllers/1"] = Field(alias="schema")
    turning: TurningParameters
    controllers: dict[str, ControllerNotes]


# metrics.json of the task `course`


class CourseRow(Record):
    """Metrics of one controller and guidance with the nominal vessel on one course.

    Attributes:
        model: name of the controller.
        kind: role of the controller.
        guidance: `course` for the guidance along the plan, or the kind of line of sight.
        split: `simulated`.
        protocol: rule for passing the buoys.
        finished: whether the end of the course was reached within the duration.
        course_time: duration of the course in s.
        reference_time: duration in s of the reference course at the service speed.
        ratio: course time divided by the reference time.
        ratio_turning: course time divided by the duration of the reference course at the speed in
            the tightest turn, which is lower for vessels that lose speed in turns.
        cross_track_rms: root mean square of the cross-track error in m.
        cross_track_max: largest absolute cross-track error in m.
        travel: travel of the rudder command in rad.
        tightest_turn: smallest radius of the track in m.
        distances: smallest distance to each buoy in m.
        entered: number of circles that were entered, under the rule `enter`.
        right_side: number of buoys passed on their side, under the rule `sides`.
        clear: number of buoys passed outside their circles, under the rule `sides`.
        clearance: smallest distance in m outside a circle, under the rule `sides`.
        passed: whether all buoys were passed according to the rule.
        margin: smallest depth in m inside a circle that was entered, or smallest distance in m
            outside a circle that was passed.
        n: number of buoys of the course.
    """

    model: str
    kind: ControllerKind
    guidance: str
    split: Literal["simulated"]
    protocol: str
    finished: bool
    course_time: float
    reference_time: float
    ratio: float
    ratio_turning: float
    cross_track_rms: float
    cross_track_max: float
    travel: float
    tightest_turn: float
    distances: tuple[float, ...]
    entered: int | None = None
    right_side: int | None = None
    clear: int | None = None
    clearance: float | None = None
    passed: bool
    margin: float
    n: int


class CourseEnsembleRow(Record):
    """Metrics of one controller and guidance with random vessels and currents on one course.

    An unfinished simulation counts with its duration.

    Attributes:
        model: name of the controller.
        kind: role of the controller.
        guidance: `course` for the guidance along the plan, or the kind of line of sight.
        protocol: rule for passing the buoys.
        reference_time: duration in s of the reference course at the service speed.
        split: `spread`.
        n: number of simulations.
        passed: fraction of the simulations that passed all buoys according to the rule.
        finished: fraction of the simulations that reached the end of the course.
        ratio: median of the course time divided by the reference time.
        ratio_worst: largest ratio of the course time to the reference time.
        margin: median of `CourseRow.margin` over the simulations in m.
        margin_worst: smallest of these margins in m.
        cross_track_rms: median of the root mean square cross-track errors in m.
    """

    model: str
    kind: ControllerKind
    guidance: str
    protocol: str
    reference_time: float
    split: Literal["spread"]
    n: int
    passed: float
    finished: float
    ratio: float
    ratio_worst: float
    margin: float
    margin_worst: float
    cross_track_rms: float


AnyCourseRow = Annotated[CourseRow | CourseEnsembleRow, Field(discriminator="split")]
"""A row of metrics.json of the task `course`."""


class SmallestTurn(Record):
    """The smallest steady turn of the vessel, at full rudder.

    Attributes:
        radius: radius of the track in m.
        speed: speed in the turn in m/s.
        yaw_rate: yaw rate in rad/s.
        step: time step of its simulation in s.
    """

    radius: float
    speed: float
    yaw_rate: float
    step: float


class BuoyFeasibility(Record):
    """Comparison of the radius of a buoy's circle with the smallest turn of the vessel.

    Attributes:
        buoy: number of the buoy, from 1 on.
        radius: radius of the circle in m.
        smallest: radius of the smallest steady turn in m.
        possible: whether the vessel can follow the circle.
    """

    buoy: int
    radius: float
    smallest: float
    possible: bool


class CourseMetricsFile(ControlMetrics, FileRecord):
    """metrics.json of the task `course`: metrics of all controllers on all courses.

    Attributes:
        speed: service speed of the vessel in m/s.
        rudder: rudder limit in rad.
        smallest: the smallest steady turn.
        feasibility: comparison of each buoy's circle with this turn.
        rows: metrics of one controller on one course each.
    """

    speed: float
    rudder: float
    smallest: SmallestTurn
    feasibility: tuple[BuoyFeasibility, ...]
    rows: tuple[AnyCourseRow, ...] = Field(min_length=1)


# metrics.json of the task `roll`


class RollRow(Record):
    """Metrics of one controller in one sea state and direction of the waves.

    Attributes:
        model: name of the controller.
        kind: role of the controller.
        split: `simulated`.
        sea_state: sea state.
        direction: direction to which the waves travel relative to the course, in rad.
        height: significant wave height in m.
        period: peak period in s.
        n: number of realisations.
        roll_rms: root mean square of the roll angle in rad.
        roll_reduction: relative reduction of this value against heading control alone.
        heading_rms: root mean square of the heading error in rad.
        rudder_rms: root mean square of the rudder angle in rad.
        fin_rms: root mean square of the fin angle in rad.
        is_judged: whether the vessel rolls more than the sensor noise without roll reduction.
    """

    model: str
    kind: ControllerKind
    split: Literal["simulated"]
    sea_state: int
    direction: float
    height: float
    period: float
    n: int
    roll_rms: float
    roll_reduction: float
    heading_rms: float
    rudder_rms: float
    fin_rms: float
    is_judged: bool


class RollTotal(Record):
    """Metrics of one controller over all directions of one sea state, or over all seas.

    Attributes:
        model: name of the controller.
        sea_state: sea state; null for all.
        roll_rms: root mean square of the roll angle in rad.
        roll_reduction: relative reduction of this value against heading control alone.
        heading_rms: root mean square of the heading error in rad.
    """

    model: str
    sea_state: int | None
    roll_rms: float
    roll_reduction: float
    heading_rms: float


class RollController(Record):
    """A controller of roll and heading.

    Attributes:
        model: name of the controller.
        kind: role of the controller.
        gains: constants of its law by name; angles in rad, rates in rad/s.
        tuning_cost: mean cost in the seas of the tuning, or of the validation for a trained one, in
            deg^2/m^2.
        start_cost: mean cost in the validation seas before the training; null for a tuned law.
        judged_cost: mean cost in the judging seas in deg^2/m^2.
        seconds: duration of the tuning or training in s.
    """

    model: str
    kind: ControllerKind
    gains: dict[str, float]
    tuning_cost: float
    start_cost: float | None
    judged_cost: float
    seconds: float


class RelativeChange(Record):
    """Relative difference of a pooled RMS value of the policy from that of the classical law.

    Attributes:
        value: the relative difference.
        interval: 95 % confidence interval by bootstrap over the realisations of every sea.
    """

    value: float
    interval: tuple[float, float]


class RollComparison(Record):
    """Comparison of the policy with the best classical combination in the same waves.

    Attributes:
        policy: name of the policy.
        classical: name of the classical combination with the lowest cost in the judging seas.
        roll: relative difference of the RMS roll angle over all seas.
        heading: relative difference of the RMS heading error over all seas.
        tolerance: relative increase of the heading error that counts as the same.
        is_as_good: whether the policy rolls at most as much with the same heading error.
        n_seas: number of judged seas.
        n_less_roll: number of judged seas in which the policy rolls less.
        n_larger_heading: number of judged seas in which its heading error is larger.
    """

    policy: str
    classical: str
    roll: RelativeChange
    heading: RelativeChange
    tolerance: float
    is_as_good: bool
    n_seas: int
    n_less_roll: int
    n_larger_heading: int


class RollMetricsFile(ControlMetrics, FileRecord):
    """metrics.json of the task `roll`: metrics of all controllers in all seas.

    Attributes:
        speed: speed of the vessel in m/s.
        comparison: comparison of the policy with the best classical combination.
        controllers: the controllers with their constants.
        totals: metrics by sea state and over all seas.
        rows: metrics of one controller in one sea each.
    """

    speed: float
    comparison: RollComparison
    controllers: tuple[RollController, ...] = Field(min_length=1)
    totals: tuple[RollTotal, ...] = Field(min_length=1)
    rows: tuple[RollRow, ...] = Field(min_length=1)


# model card of an exported controller


class MeasuredQuantity(Record):
    """A measurement of a controller.

    Attributes:
        name: name of the channel.
        unit: unit of the channel.
        range: smallest and largest accepted value.
    """

    name: str
    unit: str
    range: tuple[float, float]


class ReferenceQuantity(Record):
    """The reference of a controller.

    Attributes:
        name: `heading` or `depth`.
        unit: unit of the reference.
    """

    name: str
    unit: str


class CommandLimits(Record):
    """The command of a controller.

    Attributes:
        name: name of the command.
        unit: unit of the command.
        limit: largest absolute value.
        rate: largest rate per second; None for no limit.
    """

    name: str
    unit: str
    limit: float
    rate: float | None


class CourseStart(Record):
    """Start of a planned course.

    Attributes:
        north: north coordinate in m.
        east: east coordinate in m.
        heading: heading in rad.
    """

    north: float
    east: float
    heading: float


class SteeringParameters(Record):
    """Parameters of Nomoto's model T r_dot + r = K delta, as in the model card of a controller.

    Attributes:
        K: gain in 1/s.
        T: time constant in s.
        speed: speed in m/s at which K and T hold.
    """

    K: float
    T: float
    speed: float


class ControllerCard(Record):
    """Entries of the model card of a policy or of a policy with a course.

    Further entries describe the structure of the policy, its vessel and its training.

    Attributes:
        policy: name of the policy.
        measured: measurements in the order of the input y.
        reference: reference of a policy; absent for a course.
        start: start of the course; absent for a policy.
        length: length of the course in m; absent for a policy.
        lookahead: look-ahead distance of the guidance in m; absent for a policy.
        memory: names of the entries of the memory s.
        fault: condition under which the policy returns the fault flag, and its command then.
        command: the command and its limits.
        dt: time step in s.
        turning: Nomoto's model of the vessel.
        frame: axes and signs.
        versions: versions of the packages.
        exported: time of the export in UTC.
        metrics: rows of metrics.json of this policy.
    """

    model_config = ConfigDict(extra="allow")

    schema_name: CardSchema = Field(alias="schema")
    policy: str
    measured: tuple[MeasuredQuantity, ...]
    reference: tuple[ReferenceQuantity, ...] | None = None
    start: CourseStart | None = None
    length: float | None = None
    lookahead: float | None = None
    memory: tuple[str, ...]
    fault: str
    command: tuple[CommandLimits, ...]
    dt: float
    turning: SteeringParameters
    frame: str
    versions: dict[str, str]
    exported: str
    metrics: tuple[HeadingRow | CourseRow | CourseEnsembleRow, ...]
