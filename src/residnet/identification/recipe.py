"""The standard recipe: a portfolio of models whose settings follow from logs and protocols."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.baselines.sets import (
    HULL_TERMS,
    ROLL_TERMS,
    WIND_TERMS,
    ChannelRoles,
    submerged_terms,
)
from residnet.core.layout import SURGE_SWAY_YAW, DegreesOfFreedom
from residnet.core.log import Log
from residnet.core.model_names import CONSTANT_VELOCITY, ENSEMBLE
from residnet.core.names import (
    BOW_WIND_CHANNELS,
    CHANNEL_UNITS,
    FORCE_CHANNELS,
    WIND_CHANNELS,
    WIND_INPUTS,
    azimuth_thrusters,
)
from residnet.core.stretches import find_runs
from residnet.dynamics.time_steps import Integrator
from residnet.evaluation.protocol import EvaluationConfig, WindowProtocol, longest_segment_length
from residnet.physics.symmetry import get_dof, violates_symmetry
from residnet.preprocessing.channel_values import bridge_spikes
from residnet.preprocessing.masks import MaskRule, apply_masks, find_scored_samples
from residnet.preprocessing.motion import remove_pauses
from residnet.preprocessing.prepare import TAIL_SHARE, PrepareConfig, PreparedLog, prepare_log

if TYPE_CHECKING:
    from residnet.core.samples import Samples
    from residnet.regression.pair_symmetry import PairSymmetry

_MIN_RELATIVE_SPREAD = 1e-3
"""Smallest spread of a varying channel, as a share of its magnitude."""
_MIN_ASTERN_SHARE = 0.01
"""Smallest share of samples of each sign for an input to count as reversing."""
_MAX_SEGMENT_SHARE = 0.6
"""Largest length of a free run relative to a typical segment, so that starts can vary."""
_DEFAULT_FREE_RUN_LENGTH = 60.0
"""Length of a free run in s if no log determines it."""


@dataclass(frozen=True)
class TrainingDataSummary:
    """Properties of the training logs that determine the portfolio of the recipe.

    Attributes:
        channel_names: channels of the models.
        varying_channels: inputs, forces and wind channels that vary in the training logs.
        reversing_inputs: inputs with both signs.
        dt: time step, s.
        free_run_length: length of the free runs that select models, s.
        history: measured past available to a free run, s.
        median_segment_duration: half of the training samples are in gap-free segments of at least
            this duration, s.
        n_samples: number of training samples.
        roll_time_per_radian: natural period of roll divided by 2 pi, s; infinite without roll.
        asymmetric_pairs: pairs of inputs whose effects are not mirror images of each other; with
            any of them, models and training windows are not mirrored.
        relay_inputs: inputs that switch between the ends of their ranges, as in zigzags.
    """

    channel_names: tuple[str, ...]
    varying_channels: tuple[str, ...]
    reversing_inputs: tuple[str, ...]
    dt: float
    free_run_length: float
    history: float
    median_segment_duration: float
    n_samples: int
    roll_time_per_radian: float = math.inf
    asymmetric_pairs: tuple[PairSymmetry, ...] = ()
    relay_inputs: tuple[str, ...] = ()

    @classmethod
    def from_channel_names(cls, channel_names: tuple[str, ...]) -> TrainingDataSummary:
        """Return assumed properties before any log is read: all inputs vary, in long logs."""
        return cls(
            channel_names,
            _input_names(channel_names),
            (),
            0.1,
            _DEFAULT_FREE_RUN_LENGTH,
            0.1 * _DEFAULT_FREE_RUN_LENGTH,
            math.inf,
            20_000,
        )

    @classmethod
    def from_logs(
        cls, samples: Samples, logs: Sequence[PreparedLog], evaluation: EvaluationConfig, dt: float
    ) -> TrainingDataSummary:
        """Return the properties of training logs and of the selection protocol.

        Args:
            samples: training samples.
            logs: training logs.
            evaluation: protocols.
            dt: time step of the grid, s.
        """
        # imported late: a config must load fast, and this module imports SciPy
        from residnet.identification.symmetry import find_asymmetric_pairs

        channel_values = samples.z
        channel_names = samples.names
        std = channel_values.std(0, correction=0)
        max_abs = channel_values.abs().amax(0)
        varying_channels = [
            name
            for name in _input_names(channel_names)
            if std[channel_names.index(name)]
            > _MIN_RELATIVE_SPREAD * max_abs[channel_names.index(name)]
        ]
        reversing_inputs = []
        for name in varying_channels:
            values = channel_values[:, channel_names.index(name)]
            sign_shares = [float(has_sign.double().mean()) for has_sign in (values > 0, values < 0)]
            reversing_inputs += [name] if min(sign_shares) > _MIN_ASTERN_SHARE else []
        free_run_length, history = _free_run_length(logs, evaluation, dt)
        segment_lengths = np.concatenate(
            [np.diff(np.stack(find_runs(log.segment)), axis=0).flatten() for log in logs]
        )
        # median weighted by length (N50): most samples are in segments of at least this length
        sorted_lengths = np.sort(segment_lengths)[::-1]
        median_segment_length = sorted_lengths[
            np.searchsorted(np.cumsum(sorted_lengths), 0.5 * sorted_lengths.sum())
        ]
        median_segment_duration = float(median_segment_length) * dt
        roll_time_per_radian = math.inf
        if "p" in channel_names:
            angle_std, rate_std = (float(std[channel_names.index(name)]) for name in ("phi", "p"))
            # for an oscillation phi = a sin(omega t) the ratio of the deviations is 1 / omega
            roll_time_per_radian = angle_std / max(rate_std, 1e-9)
        return cls(
            channel_names,
            tuple(varying_channels),
            tuple(reversing_inputs),
            dt,
            free_run_length,
            history,
            median_segment_duration,
            len(samples),
            roll_time_per_radian,
            tuple(find_asymmetric_pairs(samples)),
            tuple(_find_relay_inputs(samples, varying_channels)),
        )

    @property
    def max_free_run_length(self) -> float:
        """Length in s of the longest useful free runs that fit into a typical segment."""
        return min(self.free_run_length, _MAX_SEGMENT_SHARE * self.median_segment_duration)

    @property
    def varying_inputs(self) -> tuple[str, ...]:
        """Varying inputs, or the forces computed from them; without the wind."""
        return tuple(name for name in self.varying_channels if name not in WIND_CHANNELS)

    @property
    def has_wind(self) -> bool:
        """Whether a wind channel varies in the logs."""
        return any(name in WIND_CHANNELS for name in self.varying_channels)


def _input_names(channel_names: Sequence[str]) -> tuple[str, ...]:
    has_forces = "tau_x" in channel_names
    return tuple(
        name
        for name in channel_names
        if name not in get_dof(channel_names).dynamic_states
        and (not has_forces or name in FORCE_CHANNELS or name in WIND_CHANNELS)
    )


def _free_run_length(
    logs: Sequence[PreparedLog], evaluation: EvaluationConfig, dt: float
) -> tuple[float, float]:
    """Return length and measured history in s of the free runs of the selection protocol."""
    protocol = evaluation.protocols[evaluation.selection]
    if isinstance(protocol, WindowProtocol):
        return protocol.length, protocol.history
    window_lengths = [
        window.stop - window.start
        for log_index, log in enumerate(logs)
        for window in protocol.make_windows(log, log_index, dt)
    ]
    return (
        float(np.median(window_lengths)) * dt if window_lengths else _DEFAULT_FREE_RUN_LENGTH
    ), protocol.initial


_LONG_LOG_TERMS = ("u^2 v", "u^2 r", "v^2", "r^2")
"""Terms that only long logs determine."""
LONG_TRAINING_DURATION = 1200.0
"""Total length in s from which training logs count as long."""
_MIN_PROPELLERS_WITHOUT_RACE = 3
"""Number of propellers from which rudders get no propeller-race terms, which would be too many."""


def make_hull_terms(data_summary: TrainingDataSummary) -> list[str] | dict[str, list[str]]:
    """Return the terms of a manoeuvring model: hull, propellers, rudders and wind.

    Rudders are recognised by name. Every other input is treated as a propeller with a force that is
    linear and quadratic in it and decreases with the inflow. Inputs that are forces are terms
    themselves.

    With short logs an axis has only the terms of a mirror-symmetric vessel and the asymmetry of a
    single propeller, which are half of the coefficients. Long logs have all terms in all axes.
    """
    terms = _all_terms(data_summary)
    if has_long_logs(data_summary):
        return terms
    return _symmetric_terms(terms, data_summary)


def _symmetric_terms(
    terms: Sequence[str], data_summary: TrainingDataSummary
) -> dict[str, list[str]]:
    """Return the terms of a mirror-symmetric vessel and the asymmetry of a propeller, by axis."""
    asymmetric_terms = ("1", *(f"{name}|{name}|" for name in data_summary.varying_inputs))
    return {
        axis: [
            term
            for term in terms
            if term in asymmetric_terms
            or not violates_symmetry(term, axis_index, data_summary.channel_names)
        ]
        for axis_index, axis in enumerate(get_dof(data_summary.channel_names).layout.velocities)
    }


def make_model_test_terms(data_summary: TrainingDataSummary) -> dict[str, list[str]]:
    """Return the terms of a hull for tests of a model basin.

    In addition to those of `make_hull_terms` for short logs, the lift of a rudder saturates with
    the cube of its angle, and drift, turning and rudder angle cause resistance. Turning circles at
    35 deg and zigzags at 10 deg have rudder effects that a linear lift cannot both represent: with
    it, the first overshoot of a Mariner's 10/10 zigzag was 7.2 deg instead of 5.2 deg.
    """
    dynamic_states = get_dof(data_summary.channel_names).dynamic_states
    rudders = _classify_inputs(data_summary)[1] if "u" in dynamic_states else []
    additional_terms = [
        *(f"{name}^2" for name in ("v", "r") if name in dynamic_states),
        *(f"u|u| {name}^{power}" for name in rudders for power in (2, 3)),
    ]
    return _symmetric_terms([*_all_terms(data_summary), *additional_terms], data_summary)


def make_full_hull_terms(data_summary: TrainingDataSummary) -> list[str]:
    """Return the terms of long logs: hull, wind, saturation and drag of rudders, in all axes."""
    _, rudders, propellers = _classify_inputs(data_summary)
    additional_terms = ["wind_mag r", "wind_u r"] if data_summary.has_wind else []
    additional_terms += [
        *_LONG_LOG_TERMS,
        *(term for name in propellers for term in (f"{name} v", f"{name} r")),
    ]
    return [
        *_all_terms(data_summary),
        *additional_terms,
        *(t for name in rudders for t in _large_angle_terms(name, propellers)),
    ]


def has_long_logs(data_summary: TrainingDataSummary) -> bool:
    """Return whether the training logs determine a hull with many terms."""
    return data_summary.n_samples * data_summary.dt >= LONG_TRAINING_DURATION


def _classify_inputs(data_summary: TrainingDataSummary) -> tuple[list[str], list[str], list[str]]:
    """Return the varying inputs as forces, rudders and propellers, without azimuth thrusters."""
    forces = [name for name in data_summary.varying_inputs if name in FORCE_CHANNELS]
    rotatable_thrusters = azimuth_thrusters(data_summary.varying_inputs)
    remaining_inputs = [
        input_name
        for input_name in data_summary.varying_inputs
        if input_name not in (*forces, *rotatable_thrusters, *rotatable_thrusters.values())
    ]
    rudders = [name for name in remaining_inputs if _is_rudder(name)]
    return forces, rudders, [name for name in remaining_inputs if name not in rudders]


def _all_terms(data_summary: TrainingDataSummary) -> list[str]:
    """Return the terms of a hull, without distinguishing axes.

    An azimuth thruster has forces ahead and to the side; its thrust decreases with the inflow.
    """
    forces, rudders, propellers = _classify_inputs(data_summary)
    rotatable_thrusters = azimuth_thrusters(data_summary.varying_inputs)
    dof = get_dof(data_summary.channel_names)
    dynamic_states = dof.dynamic_states
    if dof.is_six_dof:
        return submerged_terms(
            ChannelRoles(dof.active_states, (*forces, *propellers), tuple(rudders), (), False)
        )
    return [
        *(
            "1",
            *dynamic_states,
            *HULL_TERMS,
            *(ROLL_TERMS if "p" in dynamic_states else ()),
            *forces,
        ),
        *(
            f"{inflow_term} {trigonometric_function}({angle})"
            for angle, rev_name in rotatable_thrusters.items()
            for inflow_term in (f"{rev_name}|{rev_name}|", f"u |{rev_name}|")[
                : 1 + ("u" in dynamic_states)
            ]
            for trigonometric_function in ("cos", "sin")
        ),
        *(
            term
            for name in propellers
            for term in _propeller_terms(name, name in data_summary.reversing_inputs)
        ),
        *(term for name in rudders for term in _rudder_terms(name, propellers, data_summary)),
        *(WIND_TERMS if data_summary.has_wind else ()),
    ]


def _is_rudder(name: str) -> bool:
    base_name = name.removeprefix("cmd_")
    return base_name.startswith(("delta", "rudder", "azimuth"))


def _propeller_terms(name: str, is_reversing: bool) -> list[str]:
    """Return the terms of a propeller; a reversing one has a different thrust astern."""
    astern_terms = [f"{name}^2", f"{name} u"] if is_reversing else []
    return [name, f"{name}|{name}|", f"|{name}| u", *astern_terms]


def _rudder_terms(
    name: str, propellers: Sequence[str], data_summary: TrainingDataSummary
) -> list[str]:
    """Return the lift of a rudder in the inflow due to speed and propellers.

    Without a measured speed a typical speed is assumed.
    """
    if "u" in get_dof(data_summary.channel_names).fixed_states:
        return [name, f"{name}|{name}|", *(f"{n}|{n}| {name}" for n in propellers)]
    if len(propellers) >= _MIN_PROPELLERS_WITHOUT_RACE:
        return [name, f"u|u| {name}"]
    race_terms = [f"{n}|{n}| {name}" for n in propellers] + [f"u {n} {name}" for n in propellers]
    return [
        f"u|u| {name}",
        *race_terms,
        *(f"{n}^2 {name}" for n in propellers if n in data_summary.reversing_inputs),
    ]


def _large_angle_terms(name: str, propellers: Sequence[str]) -> list[str]:
    """Return terms for the saturation of the lift of a rudder at large angles, and for its drag."""
    if len(propellers) != 1:
        return [name, f"u|u| {name}|{name}|", f"u|u| |{name}|"]
    race_terms = (f"{propellers[0]}|{propellers[0]}|", f"u {propellers[0]}")
    return [
        name,
        *(f"{inflow_term} {name}|{name}|" for inflow_term in race_terms),
        *(f"{inflow_term} |{name}|" for inflow_term in race_terms),
    ]


_NETWORK_STEPS_PER_RUN = 100
"""Number of network steps in a free run of the protocol's length."""
_STEP_PER_ROLL_RADIAN = 0.5
"""Largest step of the networks in radians of a roll oscillation."""
_REFIT_STEPS = 200
"""Smallest number of steps of the free runs of a refit."""


def _find_relay_inputs(samples: Samples, names: Sequence[str]) -> list[str]:
    """Return the channels that the training logs switch between the ends of their ranges."""
    # imported late: a config must load fast
    from residnet.quality.feedback import find_relay_inputs

    if not names:
        return []
    # the samples of a log are consecutive
    log_starts = np.flatnonzero(np.diff(samples.group.numpy())) + 1
    parts = {
        name: np.split(samples.z[:, samples.names.index(name)].numpy(), log_starts)
        for name in names
    }
    n_logs = len(log_starts) + 1
    return find_relay_inputs(
        [{name: parts[name][k] for name in names} for k in range(n_logs)], names
    )


def make_refit_settings(data_summary: TrainingDataSummary) -> dict[str, Any]:
    """Return the settings of the refit of a baseline; long logs get a weaker prior.

    So do logs with relays: accelerations are smoothed at each switch, which biases least squares.
    With a strong prior the hull of a boat in zigzags turned 12 % too slowly at small rudder angles.
    """
    horizon = min(
        data_summary.max_free_run_length,
        max(0.2 * data_summary.free_run_length, _REFIT_STEPS * data_summary.dt),
    )
    return {
        "horizon": round_to_three_digits(horizon),
        "every": round_to_three_digits(0.5 * horizon),
        "prior": 1e-2
        if has_long_logs(data_summary)
        or get_dof(data_summary.channel_names).is_six_dof
        or data_summary.relay_inputs
        else 1.0,
        "asymmetric": 0.0 if data_summary.asymmetric_pairs else 0.05,
    }


def round_to_three_digits(value: float) -> float:
    """Return a number rounded to three significant digits, for readable configs."""
    return float(f"{value:.3g}")


def compute_network_step(data_summary: TrainingDataSummary) -> float:
    """Return the time step of the networks in s: a fixed number of steps per free run.

    Roll gets at least twelve steps per period, to avoid aliasing.
    """
    n_grid_steps = (
        min(
            data_summary.free_run_length / _NETWORK_STEPS_PER_RUN,
            _STEP_PER_ROLL_RADIAN * data_summary.roll_time_per_radian,
        )
        / data_summary.dt
    )
    return data_summary.dt * max(1, round(n_grid_steps))


def count_networks(data_summary: TrainingDataSummary) -> int:
    """Return the number of networks in an ensemble, which short logs need to be larger."""
    return 4 if has_long_logs(data_summary) else 6


PART_KEYS = (
    "baseline", "baselines", "refit", "heads", "base_of", "ensembles", "means", "training",
)  # fmt: skip
"""Config keys of a fit that the recipe sets."""
SINGLE_MODEL_NAME = "hull"
"""Name of the model that is used where a single model is required."""
CANDIDATE_HEADS = ("plsr", "mlp", "lstm")
"""Heads on the linear baseline, which join the ensemble if its validation error decreases."""
_MIN_FREE_RUNS_FOR_NETWORKS = 10
"""Length of the training logs, as a multiple of a free run, from which `mlp` and `lstm` are fitted.
Chosen by hand."""
_HEAD_BASELINES = {"hull_network": SINGLE_MODEL_NAME, "network": CONSTANT_VELOCITY}
"""Baselines of the networks."""


def has_enough_logs_for_networks(data_summary: TrainingDataSummary) -> bool:
    """Return whether the training logs are long enough for `mlp` and `lstm`."""
    return (
        data_summary.n_samples * data_summary.dt
        >= _MIN_FREE_RUNS_FOR_NETWORKS * data_summary.free_run_length
    )


def make_portfolio(
    data_summary: TrainingDataSummary, *, has_model_tests: bool = False
) -> dict[str, Any]:
    """Return baselines, refits, heads and ensembles of the recipe by name.

    `baseline` is linear and `hull` nonlinear in velocities and inputs, both refitted; long logs
    allow more terms of the hull. `hull_network` holds recurrent networks on the hull, and for long
    logs `network` the same number of black-box networks. The ensemble of hull and networks is the
    predictor. `plsr`, `mlp` and `lstm` are heads on the linear baseline and candidates for the
    ensemble.

    Args:
        data_summary: properties of the logs; assumed values before they are read.
        has_model_tests: whether the logs are tests of a model basin, which are clean and whose
            vessel has the asymmetry of a single propeller.
    """
    network_config = {
        "kind": "recurrent",
        "members": count_networks(data_summary),
        "hidden_size": 48 if has_long_logs(data_summary) else 32,
        "step": round_to_three_digits(compute_network_step(data_summary)),
        "restoring": True,
        "margin": 0.0,
    }
    heads: dict[str, dict[str, Any]] = {"hull_network": network_config} | (
        {"network": network_config} if has_long_logs(data_summary) else {}
    )
    recurrent_heads = tuple(heads)
    heads |= {"plsr": {"kind": "plsr"}}
    if has_enough_logs_for_networks(data_summary):
        heads |= {
            "mlp": {"kind": "mlp", "hidden": [32, 32]},
            "lstm": {"kind": "lstm", "hidden_size": 24, "readout": 32},
        }
    regressors: list[str] | dict[str, list[str]]
    if has_model_tests:
        regressors = make_model_test_terms(data_summary)
    elif has_long_logs(data_summary):
        regressors = make_full_hull_terms(data_summary)
    else:
        regressors = make_hull_terms(data_summary)
    refit_settings = make_refit_settings(data_summary)
    if has_model_tests:
        # shrinking the asymmetry to zero gave zigzags to port and starboard equal overshoots, which
        # a single propeller makes different
        refit_settings |= {"prior": 1.0, "asymmetric": 0.0}
    ridge = 1e-6 if get_dof(data_summary.channel_names).is_six_dof else 1e-4
    wind_channels = ["wind_u", "wind_v"] if data_summary.has_wind else []
    dynamic_states = [
        name for name in get_dof(data_summary.channel_names).dynamic_states if name != "z"
    ]
    return {
        "baseline": _regressor_settings(
            1e-6, ["1", *dynamic_states, *data_summary.varying_inputs, *wind_channels]
        ),
        "baselines": {SINGLE_MODEL_NAME: _regressor_settings(ridge, regressors)},
        "refit": dict.fromkeys(("baseline", SINGLE_MODEL_NAME), refit_settings),
        "heads": heads,
        "base_of": {
            name: baseline_name for name, baseline_name in _HEAD_BASELINES.items() if name in heads
        },
        "ensembles": {},
        "means": {ENSEMBLE: (SINGLE_MODEL_NAME, *recurrent_heads)},
        # the schedule of every network follows from the logs
        "training": {},
    }


def _regressor_settings(ridge: float, terms: list[str] | dict[str, list[str]]) -> dict[str, Any]:
    """Return settings of a dissipative regressor baseline with bounded free runs."""
    stability_settings = {"dissipative": True, "bounded": True}
    return {"kind": "regressors", "ridge": ridge, "terms": terms, **stability_settings}


_WINDOW_LENGTHS = (100.0, 60.0, 40.0, 30.0, 20.0, 10.0, 5.0, 2.0, 1.0)
"""Possible lengths of free runs in s: round values, which name the protocols."""
_MIN_LENGTH_RATIO = 1.15
"""Smallest ratio of the duration of a log to a free run, for a choice of starts."""
_N_PROBED_SAMPLES = 40_000
"""Number of first samples of a long log that are searched for segments."""


@dataclass(frozen=True)
class PreparationPlan:
    """Preparation settings that follow from the logs.

    Attributes:
        sample_interval: typical sample interval of the logs, s.
        correlation_time: correlation time of `correlated_quantity`, s.
        grid_step: time step of the grid, s.
        derivative_window: window of the derivative filter, s.
        held_inputs: inputs that are constant most of the time, as commands are.
        input_hold: whether the input of a step is the sample at its `start` or the `mean` of its
            ends.
        wind_channels: channels of the true wind, if every log has them.
        correlated_quantity: quantity of the correlation time: yaw rate, or speed without yaw rates.
        has_roll: whether the vessel rolls.
    """

    sample_interval: float
    correlation_time: float
    grid_step: float
    derivative_window: float
    held_inputs: tuple[str, ...]
    input_hold: str
    wind_channels: tuple[str, ...]
    correlated_quantity: str = "yaw rate"
    has_roll: bool = False

    @classmethod
    def from_logs(
        cls,
        logs: Sequence[Log],
        inputs: Sequence[str],
        dof: DegreesOfFreedom = SURGE_SWAY_YAW,
        masks: Sequence[MaskRule] = (),
    ) -> PreparationPlan:
        """Return how logs that hold velocities are prepared for models with these inputs.

        Args:
            logs: logs with velocities.
            inputs: input channels of the models.
            dof: degrees of freedom of the models.
            masks: rules that exclude samples.
        """
        logs = [blank_masked_samples(log, masks, dof) for log in logs]
        sample_interval = float(np.median([np.median(np.diff(log.t)) for log in logs]))
        correlation_times = [_correlation_time(log) for log in logs]
        correlation_time = float(
            np.median(
                [time for time in correlation_times if np.isfinite(time)]
                or [20.0 * sample_interval]
            )
        )
        # roll is faster than yaw, so that it limits the time step
        roll_correlation_times = (
            [_correlation_time(log, ("phi",)) for log in logs] if dof.has_roll else []
        )
        shortest_time = min(
            correlation_time,
            float(
                np.median(
                    [time for time in roll_correlation_times if np.isfinite(time)]
                    or [correlation_time]
                )
            ),
        )
        grid_step = float(
            f"{sample_interval * max(1, int(shortest_time / 40.0 / sample_interval)):.4g}"
        )
        # an odd number of samples, as a symmetric filter needs
        window_samples = min(max(5, 2 * round(0.5 * shortest_time / 5.0 / grid_step) + 1), 41)
        held_inputs = tuple(name for name in inputs if _is_held(logs, name))
        # True wind is resolved in body axes by the heading. A heading integrated from r drifts,
        # unless the wind relative to the bow is measured too.
        has_wind = not dof.fixed_states and all(
            {*WIND_INPUTS} <= {*log.channels}
            and (
                "psi" not in log.meta.get("integrated", ())
                or {*BOW_WIND_CHANNELS} & {*log.channels}
            )
            for log in logs
        )
        return cls(
            sample_interval,
            correlation_time,
            grid_step,
            float(f"{window_samples * grid_step:.6g}"),
            held_inputs,
            "start" if len(held_inputs) == len(inputs) else "mean",
            WIND_INPUTS if has_wind else (),
            "yaw rate" if dof.has_heading else "speed",
            dof.has_roll,
        )

    @property
    def reason(self) -> str:
        """The reason of the time constants, for the drafted config."""
        return (
            f"logs have a sample interval of {self.sample_interval:.3g} s and a correlation time of"
            f" the {self.correlated_quantity} of {self.correlation_time:.3g} s"
        )

    def to_config(self) -> dict[str, Any]:
        """Return the settings `prepare` of a config.

        For vessels that roll, regressors are means over the derivative window (`beside`), so that
        roll angle and roll acceleration are filtered equally.
        """
        grid: dict[str, Any] = {"step": f"{self.grid_step:g} s"}
        grid |= {"held": list(self.held_inputs)} if self.held_inputs else {}
        window = f"{self.derivative_window:g} s"
        derivative = {"kind": "savitzky_golay", "window": window, "order": 2}
        roll_settings = {"beside": "means"} if self.has_roll else {}
        return {"grid": grid, "derivative": derivative, "hold": self.input_hold, **roll_settings}


def _is_held(logs: Sequence[Log], name: str) -> bool:
    constant_shares = [float(np.mean(np.diff(log[name]) == 0.0)) for log in logs if len(log) > 1]
    return bool(constant_shares) and float(np.median(constant_shares)) > 0.9


def choose_integrator(dof: DegreesOfFreedom) -> Integrator:
    """Return the integration scheme of a drafted model.

    A vessel in six degrees of freedom oscillates within few steps, and a first-order scheme adds
    numerical damping: the hull of a BlueROV2 had 2.0 to 2.8 times the error of the plant with
    `semi_implicit_euler`, and 1.1 to 1.4 times with `rk4`.
    """
    return "rk4" if dof.is_six_dof else "semi_implicit_euler"


def longest_usable_duration(
    log: Log, input_names: Sequence[str], config: PrepareConfig, dof: DegreesOfFreedom
) -> float:
    """Return the duration in s of the longest gap-free segment of a prepared log.

    It is 0 without usable samples. Only the first part of a long log is searched, unless it is
    too short for the longest free run.

    Args:
        log: log as read.
        input_names: inputs of the model.
        config: preparation settings.
        dof: degrees of freedom of the model.

    Raises:
        DataError: if no sample is usable.
    """
    longest_duration = 0.0
    for log_part in (log.select_rows(slice(_N_PROBED_SAMPLES)), log)[
        : 1 + (len(log) > _N_PROBED_SAMPLES)
    ]:
        prepared = prepare_log(log_part, "train", input_names, config, dof)
        if prepared.trainable.any():
            longest_duration = longest_segment_length(prepared) * config.grid.step
        if longest_duration >= _MIN_LENGTH_RATIO * _WINDOW_LENGTHS[0]:
            break
    return longest_duration


def make_evaluation_settings(
    splits: Mapping[str, Sequence[Log]],
    usable_durations: Mapping[str, Sequence[float]],
    correlation_time: float,
    masks: Sequence[MaskRule] = (),
    dof: DegreesOfFreedom = SURGE_SWAY_YAW,
) -> dict[str, Any]:
    """Return protocols, selection and scales of a config, for logs by split.

    Test logs do not influence the selection protocol: if they are shorter than its free runs, a
    shorter protocol is added for them. The scales follow from the training logs.

    Args:
        splits: `train`, `validation` and `test`.
        usable_durations: duration of the longest gap-free segment of each log, s.
        correlation_time: correlation time of the motion, s.
        masks: rules that exclude samples from the scales.
        dof: degrees of freedom of the model.
    """
    window_duration = choose_window_length(
        usable_durations["validation"] or usable_durations["train"], correlation_time
    )
    protocol_settings = make_protocols(window_duration)
    evaluation_settings = {
        "selection": next(iter(protocol_settings)),
        "scales": make_scales(splits["train"], masks, dof),
    }
    if (
        usable_durations["test"]
        and (
            test_window_duration := choose_window_length(usable_durations["test"], correlation_time)
        )
        < window_duration
    ):
        protocol_settings |= {
            name: protocol
            for name, protocol in make_protocols(test_window_duration).items()
            if name not in protocol_settings
        }
    return {"protocols": protocol_settings, **evaluation_settings}


def _correlation_time(log: Log, names: Sequence[str] = ("r", "u", "v")) -> float:
    """Return the time in s at which the autocorrelation of the yaw rate falls below 1/e.

    If the yaw rate is white noise, the speed is used; in general the first named channel with a
    correlation beyond one sample.
    """
    for name in names:
        values = log[name] if name in log.channels else log.t[:0]
        is_finite = np.isfinite(values)
        if is_finite.sum() < 50:
            continue
        t = log.t[is_finite]
        centred_values = values[is_finite] - values[is_finite].mean()
        dt = float(np.median(np.diff(t)))
        elapsed = remove_pauses(t)
        resampled = np.interp(np.arange(0.0, elapsed[-1], dt), elapsed, centred_values)[:20_000]
        # zero padding to twice the length: linear instead of circular autocorrelation
        # (Wiener-Khinchin)
        power_spectrum = np.abs(np.fft.rfft(resampled, 2 * resampled.size)) ** 2
        correlation = np.fft.irfft(power_spectrum)[: resampled.size]
        low_correlation_lags = np.flatnonzero(correlation < correlation[0] / np.e)
        if low_correlation_lags.size and low_correlation_lags[0] > 1:
            return float(low_correlation_lags[0] * dt)
    return float("nan")


def choose_window_length(usable_durations: Sequence[float], correlation_time: float) -> float:
    """Return a length in s of free runs that fits into most of the logs.

    Args:
        usable_durations: longest duration in s without a gap of each log; if empty, the length is
            half a second.
        correlation_time: correlation time of the motion, s.
    """
    sorted_durations = sorted(usable_durations) or [1.0]
    # three quarters of the logs are at least this long
    lower_quartile = sorted_durations[int(0.25 * (len(sorted_durations) - 1))]
    possible_lengths = [
        length for length in _WINDOW_LENGTHS if _MIN_LENGTH_RATIO * length <= lower_quartile
    ] or [0.5 * lower_quartile]
    return next(
        # a free run over many correlation times adds no information about the dynamics
        (length for length in possible_lengths if length <= 15.0 * correlation_time),
        possible_lengths[-1],
    )


def make_protocols(window_duration: float) -> dict[str, Any]:
    """Return two protocols: free runs of a length, and of at most 0.4 times this length."""
    short_length = max(
        (length for length in _WINDOW_LENGTHS if length <= 0.4 * window_duration),
        default=0.5 * window_duration,
    )
    first_start = min(5.0, 0.1 * window_duration)
    return {
        f"T{duration:g}".replace(".", "_"): {
            "kind": "windows",
            "length": f"{duration:g} s",
            "first": f"{first_start:g} s",
            "history": f"{first_start:g} s",
        }
        for duration in (window_duration, short_length)
    }


def make_scales(
    logs: Sequence[Log], masks: Sequence[MaskRule] = (), dof: DegreesOfFreedom = SURGE_SWAY_YAW
) -> dict[str, Any]:
    """Return the scale of each dynamic state in display units: its winsorized standard deviation.

    Samples that are excluded from fits and scores (`masks`, spikes) do not count.

    Args:
        logs: training logs.
        masks: rules that exclude samples.
        dof: degrees of freedom of the model.
    """
    min_scale = 1e-4
    scored_logs = [blank_masked_samples(log, masks, dof) for log in logs]
    scale_texts = {}
    for name in dof.active_states:
        samples = np.concatenate([log[name] for log in scored_logs])
        scale = max(compute_winsorized_std(samples), min_scale)
        unit = CHANNEL_UNITS[name]
        display_value = np.degrees(scale) if unit.startswith("rad") else scale
        scale_texts[name] = f"{display_value:.3g} {unit.replace('rad', 'deg')}"
    return scale_texts


def blank_masked_samples(log: Log, masks: Sequence[MaskRule], dof: DegreesOfFreedom) -> Log:
    """Return a log whose dynamic states are NaN at spikes and at samples that rules exclude."""
    masked_log = apply_masks(bridge_spikes(log, dof.active_states), masks)
    is_scored = find_scored_samples(masked_log)
    if is_scored.all():
        return log
    scored_states = {
        name: np.where(is_scored, masked_log[name], np.nan)
        for name in dof.active_states
        if name in masked_log.channels
    }
    return masked_log.replace(channels={**masked_log.channels, **scored_states})


def compute_winsorized_std(values: np.ndarray, tail_share: float = TAIL_SHARE) -> float:
    """Return the standard deviation of values [T], limited to two quantiles; NaN is ignored.

    Values beyond the quantiles `tail_share` and 1 - `tail_share` are replaced by these quantiles
    (Wilcox 2012, Introduction to Robust Estimation and Hypothesis Testing, section 2.4). At least
    one value at either end is replaced, so that a single outlier has no influence in short logs.
    """
    finite_values = values[np.isfinite(values)]
    if not finite_values.size:
        return 0.0
    # both quantiles are samples, rounded inwards
    lower = np.quantile(finite_values, tail_share, method="higher")
    upper = np.quantile(finite_values, 1.0 - tail_share, method="lower")
    return float(np.clip(finite_values, lower, max(lower, upper)).std())
