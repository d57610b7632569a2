"""Choose the inputs of a model from names and values of channels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from residnet.core.layout import SIX_DOF_LAYOUT, SURGE_SWAY_YAW, DegreesOfFreedom
from residnet.core.log import Log
from residnet.core.names import (
    ACCELERATION_NAMES,
    BOW_WIND_CHANNELS,
    CHANNEL_UNITS,
    STATE_NAMES,
    WIND_INPUTS,
)
from residnet.io.drafting.questions import INPUTS_KEY, DraftNotes
from residnet.io.header_vocabulary import (
    PLANE_PATTERN,
    match_input_channel,
    match_state_channel,
    parse_name,
)
from residnet.io.readers.quantities import QUATERNION

_NON_INPUT_CHANNELS = (
    *(
        *STATE_NAMES,
        *ACCELERATION_NAMES,
        *SIX_DOF_LAYOUT.dynamic_states,
        "latitude",
        "longitude",
        *QUATERNION,
    ),
    *(*WIND_INPUTS, *BOW_WIND_CHANNELS, "current_north", "current_east"),
)
_MIN_RELATIVE_STD = 2e-3
"""Standard deviation of an input, relative to its magnitude, below which it is constant."""
_MIN_DUPLICATE_CORRELATION = 0.9995
"""Correlation above which two inputs are considered identical."""
_MAX_INPUTS = 8
"""Maximum number of inputs of a drafted config."""
_FORCE_CHANNELS = ("tau_x", "tau_y", "tau_n")


def choose_inputs(logs: Sequence[Log], draft_notes: DraftNotes) -> tuple[str, ...]:
    """Select the input channels of the model; empty if the logs contain none.

    Constant channels, commands whose outcome is measured, and one of two identical channels are
    not selected.

    Args:
        logs: logs in SI units.
        draft_notes: receives the reasons for channels that are not selected.
    """
    values = {
        name: np.concatenate([log[name] for log in logs])
        for name in logs[0].channels
        if name not in _NON_INPUT_CHANNELS and all(name in log.channels for log in logs)
    }
    # signals of a control loop: of e_yaw, r_yaw, u_yaw and y_yaw only u_yaw is an input
    control_loops = {
        n[2:] for n in values if n.startswith("y_") and {f"u{n[1:]}", f"r{n[1:]}"} <= {*values}
    }
    loop_signals = {f"{signal}_{loop}" for loop in control_loops for signal in "eruy"}
    actuator_names = [
        name
        for name in values
        if (name in loop_signals and name[0] == "u")
        or (name not in loop_signals and _is_actuator_name(name, draft_notes))
    ]
    if control_loops:
        draft_notes.add_guess(
            INPUTS_KEY,
            f"u_{min(control_loops)} is taken as the output of a controller, because of the names"
            " of other channels",
        )
    names = [name for name in actuator_names if _is_excited(name, values[name], draft_notes)]
    names = _prefer_measured_inputs(_choose_force_set(logs, names, draft_notes), draft_notes)
    inputs: list[str] = []
    for name in names:
        duplicate = next(
            (
                selected_input
                for selected_input in inputs
                if _are_duplicates(values[name], values[selected_input])
            ),
            None,
        )
        if duplicate is None:
            inputs.append(name)
            continue
        if name in CHANNEL_UNITS and duplicate not in CHANNEL_UNITS:
            # an angle or a shaft speed is more informative than a share or a pulse width
            inputs[inputs.index(duplicate)], name, duplicate = name, duplicate, name
        draft_notes.add_guess(
            INPUTS_KEY,
            f"{name} moves as {duplicate} does in every log: its effect cannot be separated from"
            f" that of {duplicate}",
        )
    if len(inputs) > _MAX_INPUTS:
        draft_notes.add_guess(
            INPUTS_KEY, f"of {len(inputs)} possible inputs the first {_MAX_INPUTS} are taken"
        )
    return tuple(inputs[:_MAX_INPUTS])


def find_unexcited_inputs(logs: Sequence[Log], inputs: Sequence[str]) -> dict[str, str]:
    """Return actuators that the logs held at one value, or in proportion to a selected input.

    Their effect cannot be identified. They remain inputs of the model, so that it can flag other
    values. Only channels whose name says that they are actuators count.

    Args:
        logs: logs in SI units.
        inputs: selected inputs.

    Returns:
        Name of each such input -> its values in the logs, as text.
    """
    unexcited: dict[str, str] = {}
    for name in logs[0].channels if inputs else ():
        measured_names = {name.removeprefix("cmd_"), f"n_{name.removeprefix('cmd_')}"} - {name}
        if (
            name in (*_NON_INPUT_CHANNELS, *inputs)
            or not all(name in log.channels for log in logs)
            or match_input_channel(parse_name(name)) is None
            or measured_names & {*inputs, *unexcited}
            or len(inputs) + len(unexcited) >= _MAX_INPUTS
        ):
            continue
        values = np.concatenate([log[name] for log in logs])
        if not np.isfinite(values).all():
            continue
        level = float(np.median(values))
        if not _is_varying(values):
            unexcited[name] = f"{name} stays at {level:.4g}: other values are flagged as outside"
            continue
        for input_name in inputs:
            # the same command in another unit is no actuator of its own
            is_same_kind = name.split("_")[0] == input_name.split("_")[0]
            if not is_same_kind or logs[0].units[name] != logs[0].units[input_name]:
                continue
            input_values = np.concatenate([log[input_name] for log in logs])
            if _are_duplicates(values, input_values):
                unexcited[name] = (
                    f"{name} moves as {input_name} does: values that do not are flagged as outside"
                )
                break
    return unexcited


def find_inputs_held_in_training(
    splits: Mapping[str, Sequence[Log]], inputs: Sequence[str]
) -> dict[str, str]:
    """Return selected inputs that only logs outside the training split vary, or vary separately.

    The training logs do not identify their effect, so that they become unexcited inputs.

    Args:
        splits: logs in SI units by split.
        inputs: selected inputs, all of which vary in some log.

    Returns:
        Name of each such input -> its values in the training logs, as text.
    """
    values = {name: np.concatenate([log[name] for log in splits["train"]]) for name in inputs}
    other_logs = [log for split, logs in splits.items() if split != "train" for log in logs]
    held: dict[str, str] = {}
    for number, name in enumerate(inputs):
        finite_values = values[name][np.isfinite(values[name])]
        duplicates = [
            other
            for other in inputs[:number]
            if other not in held and _are_duplicates(values[name], values[other])
        ]
        if not _is_varying(finite_values):
            level = float(np.median(finite_values)) if finite_values.size else 0.0
            relation = f"is constant at {level:.4g}"
            varying_logs = [log.name for log in other_logs if _is_varying(log[name])]
        elif duplicates:
            relation = f"moves as {duplicates[0]} does"
            varying_logs = [
                log.name for log in other_logs if not _are_duplicates(log[name], log[duplicates[0]])
            ]
        else:
            continue
        examples = ", ".join(varying_logs[:3]) or "other logs"
        held[name] = (
            f"{name} {relation} in the training logs: its effect is not identified, and other"
            f" values are flagged as outside; train on {examples} to identify it"
        )
    return held


def _is_actuator_name(name: str, draft_notes: DraftNotes) -> bool:
    """Return whether the name of a channel allows that it is an input."""
    parsed_name = parse_name(name)
    if match_input_channel(parsed_name) is not None:
        return True
    is_passive = not parsed_name.has_none("voltage", "age", "depth", "index", "machinery")
    if is_passive or match_state_channel(parsed_name) is not None:
        draft_notes.add_note(
            INPUTS_KEY, f"{name} is not used: its name is not that of an actuator or a command"
        )
        return False
    draft_notes.add_guess(
        INPUTS_KEY, f"{name} is used, although its name does not identify an actuator"
    )
    return True


def _is_varying(values: np.ndarray) -> bool:
    """Return whether the finite values of an input are not constant."""
    values = values[np.isfinite(values)]
    return values.size > 1 and bool(
        np.std(values) > _MIN_RELATIVE_STD * float(np.abs(values).max())
    )


def _is_excited(name: str, values: np.ndarray, draft_notes: DraftNotes) -> bool:
    finite_values = values[np.isfinite(values)]
    if _is_varying(finite_values):
        return True
    level = float(np.median(finite_values)) if finite_values.size else 0.0
    draft_notes.add_guess(
        INPUTS_KEY, f"{name} stays at {level:.4g}: its effect cannot be identified"
    )
    return False


def _choose_force_set(
    logs: Sequence[Log], names: Sequence[str], draft_notes: DraftNotes
) -> list[str]:
    """Return one set of force channels, which replaces all actuators; empty without forces."""
    force_sets: dict[str, list[str]] = {}
    for name in names:
        force = next((f for f in _FORCE_CHANNELS if name == f or name.startswith(f"{f}_")), None)
        if force is not None:
            force_sets.setdefault(name.removeprefix(force), []).append(name)
    explained_shares = {
        tuple(force_names): _explained_variance(logs, force_names)
        for force_names in force_sets.values()
        if len(force_names) > 1
    }
    if not explained_shares:
        return list(names)
    shares_text = ", ".join(
        f"{', '.join(force_names)}: {share:.2f}" for force_names, share in explained_shares.items()
    )
    draft_notes.add_guess(
        INPUTS_KEY,
        f"forces replace all actuators; explained share of the accelerations: {shares_text}",
    )
    return list(max(explained_shares.items(), key=lambda pair: pair[1])[0])


def _explained_variance(logs: Sequence[Log], names: Sequence[str]) -> float:
    """Return the mean R² of a linear regression of the accelerations on velocities and inputs."""
    rows = []
    velocity_changes = []
    for log in logs:
        columns = [name for name in (*STATE_NAMES[3:], *names) if name in log.channels]
        if len(columns) < 3 + len(names):
            continue
        table = log.stack(columns)
        horizon = max(1, round(1.0 / float(np.median(np.diff(log.t)))))
        is_finite = np.isfinite(table).all(axis=1)
        is_usable = is_finite[horizon:] & is_finite[:-horizon]
        rows.append(table[:-horizon][is_usable])
        velocity_changes.append((table[horizon:, :3] - table[:-horizon, :3])[is_usable])
    if not rows or sum(map(len, rows)) < 50:
        return 0.0
    regressors = np.concatenate(rows)
    responses = np.concatenate(velocity_changes)
    regressors = np.column_stack(
        (
            (regressors - regressors.mean(0)) / np.maximum(regressors.std(0), 1e-12),
            np.ones(len(regressors)),
        )
    )
    residual = responses - regressors @ np.linalg.lstsq(regressors, responses, rcond=1e-9)[0]
    return float((1.0 - residual.var(axis=0) / np.maximum(responses.var(axis=0), 1e-300)).mean())


def _prefer_measured_inputs(names: Sequence[str], draft_notes: DraftNotes) -> list[str]:
    """Remove commands whose outcome is measured, and thrust if the shaft speed is measured."""
    shaft_inputs = [name for name in names if name == "n" or name.startswith("n_")]
    selected = []
    for name in names:
        base_name = name.removeprefix("cmd_")
        measured_names = [base_name, f"n_{base_name}"] if base_name != name else []
        measured_name = next(
            (
                measured_candidate
                for measured_candidate in measured_names
                if measured_candidate in names and measured_candidate != name
            ),
            None,
        )
        if measured_name is not None:
            draft_notes.add_guess(
                INPUTS_KEY,
                f"the measured {measured_name} is used instead of the command {name}",
            )
        elif name.removesuffix("_rate") in {*names} - {name}:
            draft_notes.add_note(
                INPUTS_KEY, f"{name} is not used: it is the rate of {name.removesuffix('_rate')}"
            )
        elif name.removeprefix("cmd_").startswith("thrust") and shaft_inputs:
            draft_notes.add_note(
                INPUTS_KEY, f"{name} is not used: it is the thrust due to {shaft_inputs[0]}"
            )
        else:
            selected.append(name)
    return selected


def _are_duplicates(first: np.ndarray, second: np.ndarray) -> bool:
    is_finite = np.isfinite(first) & np.isfinite(second)
    if (
        is_finite.sum() < 10
        or min(float(np.std(first[is_finite])), float(np.std(second[is_finite]))) == 0.0
    ):
        return False
    return (
        abs(float(np.corrcoef(first[is_finite], second[is_finite])[0, 1]))
        > _MIN_DUPLICATE_CORRELATION
    )


def missing_control(names: Sequence[str], dof: DegreesOfFreedom = SURGE_SWAY_YAW) -> str:
    """Return the missing effect of the inputs, `propels` or `steers`; empty if none is missing.

    A vessel without yaw needs no input that steers, a vessel without surge none that propels.
    Forces, azimuth thrusters and several thrusters have both effects.
    """
    base_names = [name.removeprefix("cmd_") for name in names if not PLANE_PATTERN.match(name)]
    is_steering = [name.startswith("delta") for name in base_names]
    is_driving = [name in ("n", "thrust", "throttle") for name in base_names]
    # an input with an unknown name may have either effect
    undetermined = [
        n for n, s, d in zip(base_names, is_steering, is_driving, strict=True) if not (s or d)
    ]
    has_both = any(name.startswith(("tau", "azimuth", "nozzle")) for name in undetermined)
    if has_both or any(is_steering) + any(is_driving) + len(undetermined) > 1:
        return ""
    missing = "propels" if any(is_steering) else "steers"
    return missing if {"propels": dof.has_position, "steers": dof.has_heading}[missing] else ""
