"""The contracts of models that roll, or move in six degrees of freedom, and rotations."""

from __future__ import annotations

import functools
import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from residnet.autopilot.heading.vessels import SteeredModel, SteeredPlant
from residnet.baselines.regressors_config import RegressorsConfig
from residnet.core.config import validate_config
from residnet.core.errors import ResidnetError, UsageError
from residnet.core.frames import compose_rotation, rotation_angle_between, to_earth, to_level_axes
from residnet.core.layout import (
    ATTITUDE,
    ROLL_LAYOUT,
    SIX_DOF_LAYOUT,
    DegreesOfFreedom,
    to_horizontal_plane,
)
from residnet.core.log import Log
from residnet.core.run_loader import accept_run
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import save_model
from residnet.dynamics.time_steps import Integrator
from residnet.engine.jacobian import StepJacobian
from residnet.engine.rollout import Rollout, trace_rollout
from residnet.evaluation.freerun import compute_integration_errors, integrate_pose
from residnet.heads.linear import RidgeConfig
from residnet.heads.recurrent_config import GRUEnsembleConfig
from residnet.identification.changes import PerturbedDynamics, SystemChange, make_fault_hypotheses
from residnet.identification.monitoring import (
    ChangeDetector,
    MeasuredWindow,
    MonitorConfig,
    OnlineChangeDetector,
)
from residnet.identification.recipe import PreparationPlan, choose_integrator
from residnet.manoeuvres.actuated import ActuatedDynamics, PlantActuators
from residnet.manoeuvres.base import Helm
from residnet.manoeuvres.open_loop import ConstantInput
from residnet.manoeuvres.trials import (
    SimulatedVessel,
    TrialEnvironment,
    simulate_manoeuvres,
    simulate_trials,
)
from residnet.manoeuvres.trials_config import DisturbanceConfig, SensorsConfig, SimulatedTrials
from residnet.physics.hull import SubmergedHullConfig
from residnet.physics.signals_config import SignalsConfig
from residnet.physics.vessel import load_vessel
from residnet.preprocessing.motion import MotionConfig, complete_motion
from residnet.preprocessing.prepare import PrepareConfig, prepare_log
from residnet.preprocessing.samples import make_samples
from residnet.quality import inspect_log
from residnet.simulators.ardupilot import ArduPilotBackend, assign_servos
from residnet.simulators.vehicle import load_vehicle
from residnet.testing import make_example_samples
from residnet.testing.checks import (
    EXAMPLE_TIME_STEP,
    ROLLING_SIGNALS,
    SUBMERGED_SIGNALS,
    make_example_model,
    make_example_spec,
)

PHI = ROLL_LAYOUT.state_names.index("phi")
P = ROLL_LAYOUT.state_names.index("p")
DEPTH = SIX_DOF_LAYOUT.state_names.index("z")
HULL = RegressorsConfig(sets=("fossen",), ridge=1e-4)
HEADS = [RidgeConfig(), GRUEnsembleConfig(hidden_size=6)]


def test_regressors_fit_of_roll_has_restoring_and_damping() -> None:
    samples = make_example_samples(signals=ROLLING_SIGNALS)
    config = RegressorsConfig(bounded=True, dissipative=True)
    baseline = config.build(samples.names)
    table = config.fit_preferred(baseline, samples)
    assert {entry.axis for entry in table} == {"u_dot", "v_dot", "r_dot", "p_dot"}
    assert not samples.target[:, ROLL_LAYOUT.dynamic_states.index("phi")].any()
    roll = {entry.term: entry.value for entry in table if entry.axis == "p_dot"}
    # 2 pi over the natural period of 6.76 s of document 004, Table 5.2
    assert (-roll["phi"]) ** 0.5 == pytest.approx(2 * np.pi / 6.76, rel=0.1)
    assert roll["p"] < 0.0


def started(
    head: Any, signals: SignalsConfig, scheme: Integrator, steps: int
) -> tuple[HybridDynamics, Tensor, Tensor, Tensor]:
    """A model of an integrator under way, inputs [2, T, m] that push it, and its memory."""
    spec = make_example_spec(head, signals).model_copy(update={"integrator": scheme})
    model = make_example_model(spec).double()
    n = len(signals.dof.dynamic_states)
    low = torch.tensor(spec.low).double()
    high = torch.tensor(spec.high).double()
    x = torch.zeros(2, 3 + n, dtype=torch.float64)
    x[:, 3:] = low[:n] * 0.3 + high[:n] * 0.7
    w = (low[n:] * 0.4 + high[n:] * 0.6).expand(2, steps, -1)
    return model, x, w, model.initial_state(2).double()


@pytest.mark.parametrize(("scheme", "head"), [*zip(get_args(Integrator), 2 * HEADS, strict=True)])
def test_rollout_roll_angle_follows_the_roll_rate(scheme: Integrator, head: Any) -> None:
    model, x, w, s = started(head, ROLLING_SIGNALS, scheme, 60)
    states = trace_rollout(Rollout(model), 10_000)(x, w, s)[0]
    alone = [x]
    after = x
    for k in range(60):
        after, s = model.step(after, w[:, k], s)
        alone.append(after)
    torch.testing.assert_close(states, torch.stack(alone, dim=1), rtol=0, atol=1e-9)
    moved = states[0].detach().numpy()
    rate = np.diff(moved[:, PHI]) / model.dt
    p = moved[:, P]
    # the angle's rate lies between the velocities at both ends of a step
    apart = np.abs(np.diff(p)).max() + 1e-9
    assert np.abs(rate - 0.5 * (p[1:] + p[:-1])).max() <= 0.51 * apart
    assert np.ptp(moved[:, PHI]) > 0.01
    pose = integrate_pose(moved[0, :3], moved[:, 3:], model.dt)
    np.testing.assert_allclose(moved[:, :3], pose, atol=0.05 * np.ptp(moved[:, 0]))
    nu = np.array([[1.0, 0.5, 0.2, 0.0, 1.0]])
    np.testing.assert_allclose(
        to_horizontal_plane(nu), [[1.0, 0.5 * np.cos(1.0), 0.2 * np.cos(1.0)]]
    )
    assert to_horizontal_plane(nu[:, :3]) is not nu
    np.testing.assert_array_equal(to_horizontal_plane(nu[:, :3]), nu[:, :3])


def test_compose_rotation_equals_quaternions() -> None:
    random = torch.Generator().manual_seed(0)
    angles, turn, vector = torch.randn(3, 40, 3, generator=random, dtype=torch.float64)
    angles[0] = torch.tensor([0.4, np.pi / 2, -0.3])

    def known(a: torch.Tensor) -> Rotation:
        return Rotation.from_euler("ZYX", a.numpy()[:, ::-1])

    after = compose_rotation(angles, turn)
    wanted = known(angles) * Rotation.from_rotvec(turn.numpy())
    assert float((known(after).inv() * wanted).magnitude().max()) < 1e-7
    u, v, w = vector.T
    ahead, across, down = to_level_axes(u, v, w, angles[:, 0], angles[:, 1])
    north, east = to_earth(ahead, across, angles[:, 2])
    np.testing.assert_allclose(
        torch.stack((north, east, down), dim=1), known(angles).apply(vector.numpy()), atol=1e-12
    )
    size = rotation_angle_between(angles.numpy(), after.numpy())
    full = turn.norm(dim=-1).numpy() % (2.0 * np.pi)
    np.testing.assert_allclose(size, np.minimum(full, 2.0 * np.pi - full), atol=1e-7)
    # whole turns are counted, and a loop through the vertical ends where it began
    angles = torch.zeros(1, 3, dtype=torch.float64)
    for _ in range(100):
        angles = compose_rotation(angles, torch.tensor([[0.0, 0.0, 0.1 * np.pi]]).double())
    assert float(angles[0, 2]) == pytest.approx(10 * np.pi)
    for _ in range(20):
        angles = compose_rotation(angles, torch.tensor([[0.0, 0.1 * np.pi, 0.0]]).double())
    assert rotation_angle_between(angles.numpy(), np.array([[0.0, 0.0, 10 * np.pi]]))[0] < 1e-6


@pytest.mark.parametrize(("scheme", "head"), [*zip(get_args(Integrator), 2 * HEADS, strict=True)])
def test_rollout_in_six_dof_follows_the_velocities(scheme: Integrator, head: Any) -> None:
    model, x, w, s = started(head, SUBMERGED_SIGNALS, scheme, 40)
    deep = x.clone()
    deep[:, DEPTH] += 50.0
    with torch.no_grad():
        states, other = (Rollout(model)(start, w, s)[0] for start in (x, deep))
        compiled = trace_rollout(Rollout(model), 10_000)(x, w, s)[0]
    torch.testing.assert_close(compiled, states, rtol=0, atol=1e-9)
    # what the depth is changes nothing else
    other[..., DEPTH] -= 50.0
    torch.testing.assert_close(other, states, rtol=0, atol=1e-9)
    path = states[0].numpy()
    turned = rotation_angle_between(path[1:, ATTITUDE], path[:-1, ATTITUDE])
    omega = np.linalg.norm(path[:, [7, 8, 5]], axis=1) * model.dt
    # an angle of rotation is that of the velocities at one end of a step or between both
    assert np.abs(turned - 0.5 * (omega[1:] + omega[:-1])).max() < 0.6 * np.ptp(omega)
    ground = Rotation.from_euler("ZYX", path[:, [2, 11, 10]]).apply(path[:, [3, 4, 6]])
    way = np.cumsum(0.5 * model.dt * (ground[1:] + ground[:-1]), axis=0)
    moved = path[1:, [0, 1, DEPTH]] - path[0, [0, 1, DEPTH]]
    np.testing.assert_allclose(moved, way, atol=0.06 * np.abs(way).max())


@pytest.mark.parametrize(
    "scheme",
    [
        # the two schemes of one stage are fast
        pytest.param(scheme, marks=[pytest.mark.long] if scheme in ("rk4", "heun") else [])
        for scheme in get_args(Integrator)
    ],
)
def test_step_jacobian_equals_central_differences(scheme: Integrator) -> None:
    spec = make_example_spec(None, SUBMERGED_SIGNALS)
    spec = spec.model_copy(update={"integrator": scheme, "baseline": HULL})
    model = spec.build().double()
    HULL.fit_preferred(model.baseline, make_example_samples(signals=SUBMERGED_SIGNALS))
    random = torch.Generator().manual_seed(0)
    spread = torch.tensor([0, 0, 1, 0.3, 0.1, 0.3, 0.1, 0.3, 0.3, 1, 0.6, 0.6]).double()
    x = torch.randn(3, 12, generator=random, dtype=torch.float64) * spread
    x[:, 3] += 1.5
    w = torch.tensor([[0.2, -0.1, 10.0]]).double().expand(3, 3)
    baseline: Any = model.baseline
    active = baseline.free_indices()
    s = 0.1 * torch.randn(3, 10, len(active), generator=random, dtype=torch.float64)
    by_state, by_theta = StepJacobian.of_model(model)(x, w)
    found = by_state @ s + by_theta
    start = baseline.theta.detach().flatten()[active].clone()
    size = 1e-6
    for j in range(0, len(active), 17):
        ends = []
        for sign in (1.0, -1.0):
            values = start.clone()
            moved = x.clone()
            values[j] += sign * size
            moved[:, 2:] += sign * size * s[:, :, j]
            baseline.set_free(values)
            with torch.no_grad():
                ends.append(model.step(moved, w, moved[:, :0])[0][:, 2:])
        wanted = (ends[0] - ends[1]) / (2.0 * size)
        torch.testing.assert_close(found[:, :, j].detach(), wanted, rtol=1e-6, atol=1e-6)


def test_chosen_integrator_keeps_the_amplitude_of_roll() -> None:
    """The roll of a torpedo has a period of ten steps of its logs."""
    rate = 6.3
    none = ("u v",)
    rows = dict.fromkeys(("u", "v", "r", "w", "q"), none) | {"p": ("cos(theta) sin(phi)",)}
    swing = RegressorsConfig.model_validate({"terms": rows})
    changes = {"integrator": choose_integrator(SUBMERGED_SIGNALS.dof), "baseline": swing, "dt": 0.1}
    model = make_example_spec(None, SUBMERGED_SIGNALS).model_copy(update=changes).build().double()
    baseline: Any = model.baseline
    with torch.no_grad():
        row = baseline.output_names.index("p_dot")
        baseline.theta[row, baseline.library.terms.index("cos(theta) sin(phi)")] = -(rate**2)
        x = torch.zeros(1, 12, dtype=torch.float64)
        x[0, ATTITUDE[0]] = 0.05
        run = Rollout(model)(x, torch.zeros(1, 50, 3).double(), model.initial_state(1).double())[0]
    wanted = 0.05 * np.cos(rate * 0.1 * np.arange(51))
    np.testing.assert_allclose(run[0, :, ATTITUDE[0]].numpy(), wanted, atol=0.1 * 0.05)


def test_degrees_of_freedom_from_channels() -> None:
    def told(*names: str, moving: bool = True) -> DegreesOfFreedom:
        return DegreesOfFreedom.from_channels({name: moving * np.arange(99.0) for name in names})

    assert told("x", "y", "psi", "phi").velocities == ("u", "v", "r", "p")
    assert told("x", "y", "psi", "p").is_planar
    assert told("x", "y", "psi", "phi", "p", moving=False).is_planar
    motion = 0.1 * np.sin(np.arange(0.0, 60.0, 0.1))
    noise = np.random.default_rng(0)
    for size, moves in ((0.05, True), (0.2, False)):
        phi = motion + size * noise.normal(size=motion.size)
        assert DegreesOfFreedom.from_channels({"u": motion, "phi": phi}).has_roll == moves
    rolls = told("u", "r", "phi", "p")
    planar = DegreesOfFreedom()
    assert rolls.fixed_states == ("v",)
    assert rolls.active_states == ("u", "r", "p", "phi")
    assert DegreesOfFreedom.intersection([rolls, planar]).velocities == ("u", "r")
    assert DegreesOfFreedom.intersection(
        [DegreesOfFreedom(("u",)), DegreesOfFreedom(("r",))]
    ).is_planar
    low = -np.ones(12)
    high = 2.0 * np.ones(12)
    # a depth and a loop are no runaway
    reach = SUBMERGED_SIGNALS.dof.range_limits(low, high)
    assert reach[:6].tolist() == [2.0] * 6
    assert np.isinf(reach[6:]).all()
    assert planar.range_limits(low, high).tolist() == [2.0] * 3


def trials(count: int, duration: float) -> SimulatedTrials:
    """Noiseless trials of the torpedo in depth and heading."""
    kinds_of: list[dict[str, Any]] = [
        {"kind": "depth_step", "depth": [3.0], "start": 1.0},
        {"kind": "helix", "drive": [0.5, 0.9], "start": 1.0},
        {"kind": "random_steps", "dive_amplitude": [0.2, 0.6], "drive_amplitude": [0.1, 0.3]},
    ]
    content: dict[str, Any] = {
        "vessel": "remus_100",
        "step": EXAMPLE_TIME_STEP,
        "substeps": 2,
        "duration": duration,
    }
    content |= {"trials": [{**kind, "count": count} for kind in kinds_of]}
    content |= {"identification": {}, "validation": {}, "noise": dict.fromkeys("uvr", 0.0)}
    return SimulatedTrials.model_validate(content)


def test_degrees_of_freedom_of_torpedo_logs() -> None:
    config = trials(2, 15.0)
    log = simulate_trials(config.draw_manoeuvres(), config)[0].measured_log
    live = DegreesOfFreedom.from_channels(log.channels)
    assert live.is_six_dof
    assert live.is_complete
    assert live.active_states == ("u", "v", "r", "w", "p", "q", "z", "phi", "theta")
    assert DegreesOfFreedom.intersection([live, live]) == live
    assert DegreesOfFreedom.intersection([live, DegreesOfFreedom()]).is_planar
    held = {name: values for name, values in log.channels.items() if name != "z"}
    assert not DegreesOfFreedom.from_channels(held).is_six_dof
    with pytest.raises(UsageError, match="z is not measured at every sample"):
        complete_motion(log.replace(channels=held), MotionConfig(), live)
    with pytest.raises(ResidnetError, match="u, v, r, w, p, q in this order"):
        validate_config({"inputs": ["n"], "velocities": ["u", "v", "w"]}, SignalsConfig, "here")
    assert {"damping heave", "damping pitch", "restoring pitch"} <= {
        c.name for c in make_fault_hypotheses(SUBMERGED_SIGNALS)
    }
    # the rates of the pose are those of the log
    rate = np.gradient(log["psi"], log.t)
    assert (
        np.abs(rate - to_horizontal_plane(log.stack(live.dynamic_states))[:, 2])[5:-5].max() < 0.03
    )


@functools.cache
def flown() -> list[Log]:
    config = trials(4, 40.0)
    return [flight.measured_log for flight in simulate_trials(config.draw_manoeuvres(), config)]


def test_compute_integration_errors_of_measured_velocities() -> None:
    y = np.stack([log.stack(SIX_DOF_LAYOUT.state_names) for log in flown()])
    off = compute_integration_errors(y, SUBMERGED_SIGNALS.dof, EXAMPLE_TIME_STEP)
    assert (
        list(off)
        == list(SUBMERGED_SIGNALS.dof.pose_error_names)
        == ["position", "depth", "attitude"]
    )
    way = np.hypot(*np.diff(y[:, :, :2], axis=1).T).sum(axis=0)
    assert (off["position"] < 0.01 * way).all()
    assert (off["depth"] < 0.01 * way).all()
    assert (off["attitude"] < 0.01).all()


@pytest.mark.parametrize("beside", ["samples", "means"])
def test_regressors_fit_finds_coefficients_of_the_vessel(beside: str) -> None:
    """Of noiseless trials: what the trials determine is that of the vessel's file."""
    signals = SUBMERGED_SIGNALS.build()
    # means are right by a smoother that softens the swing in roll
    smoother = {"kind": "savitzky_golay", "window": 0.5, "order": 2 if beside == "means" else 4}
    how = PrepareConfig.model_validate(
        {
            "grid": {"step": EXAMPLE_TIME_STEP},
            "derivative": smoother,
            "beside": beside,
            "hold": "mean",
        }
    )
    logs = [
        prepare_log(log, "train", SUBMERGED_SIGNALS.input_columns, how, SUBMERGED_SIGNALS.dof)
        for log in flown()
    ]
    found_in = make_samples(logs, signals)
    exact = RegressorsConfig(sets=("fossen",), ridge=1e-9)
    table = exact.fit_preferred(exact.build(found_in.names), found_in)
    vessel = load_vessel("remus_100")
    assert isinstance(vessel, SubmergedHullConfig)
    terms, rows = vessel.build_hull().acceleration_equations()
    axes = zip(("u", "v", "w", "p", "q", "r"), rows, strict=True)
    true = {(axis, term): row[i] for axis, row in axes for i, term in enumerate(terms)}
    for axis, term in (
        ("u", "u|u|"),
        ("r", "r|r|"),
        ("q", "sin(theta)"),
        ("q", "q"),
        ("v", "u r"),
        ("w", "u q"),
        ("p", "cos(theta) sin(phi)"),
    ):
        (found,) = (one.value for one in table if (one.axis, one.term) == (f"{axis}_dot", term))
        assert found == pytest.approx(true[axis, term], rel=0.05)


def test_preparation_plan_with_roll_uses_means() -> None:
    t = np.arange(0.0, 60.0, 0.1)
    log = Log("swing", t, dict.fromkeys(("u", "v", "r", "p", "phi", "delta"), np.sin(t)))
    for live, beside in (
        (DegreesOfFreedom(("u", "v", "r", "p")), "means"),
        (DegreesOfFreedom(), None),
    ):
        drafted = PreparationPlan.from_logs([log], ["delta"], live).to_config()
        assert drafted.get("beside") == beside


@pytest.mark.parametrize(
    ("signals", "names"),
    [
        pytest.param(ROLLING_SIGNALS, ("restoring", "damping roll"), marks=pytest.mark.long),
        pytest.param(
            SUBMERGED_SIGNALS, ("restoring pitch", "damping pitch"), marks=pytest.mark.long
        ),
    ],
    ids=["roll", "six"],
)
def test_monitor_distinguishes_stiffness_from_damping(
    signals: SignalsConfig, names: tuple[str, ...]
) -> None:
    spec = make_example_spec(None, signals)
    live = signals.dof
    model = make_example_model(spec).double()
    noise = np.full(len(live.state_names), 0.003)
    noise[:5] = 0.0, 0.0, 0.002, 0.02, 0.02
    low, high = (np.array(ends[live.n_dynamic :]) for ends in (spec.low, spec.high))

    def logs(change: SystemChange, count: int, seed: int) -> list[list[MeasuredWindow]]:
        random = np.random.default_rng(seed)
        w = random.uniform(low, high, size=(count, 6, low.size)).repeat(50, axis=1)
        x = torch.zeros(count, noise.size).double()
        x[:, 3] = 0.7 * spec.high[0]
        changed = PerturbedDynamics(model, [change], count, low.size)
        with torch.no_grad():
            states = Rollout(changed)(x, torch.from_numpy(w), x[:, :0])[0].numpy()
        y = states + noise * random.normal(size=states.shape)
        return [
            [MeasuredWindow(a[k : k + 101], b[k : k + 100], a[:0], b[:0]) for k in (0, 100, 200)]
            for a, b in zip(y, w, strict=True)
        ]

    watch = ChangeDetector(
        spec, model, logs(SystemChange("none", "", "", 1.0), 24, 0), MonitorConfig()
    )
    assert list(watch.innovation_columns) == [*live.active_states, "heading"]
    for cause in names:
        watcher = OnlineChangeDetector(watch)
        (known,) = (one for one in watch.hypotheses if one.name == cause)
        for log in logs(replace(known, size=-0.3), 3, 1):
            watcher.start_new_log()
            for sums in watch.compute_sums(log):
                verdict = watcher.update_with_sums(sums)
        first = verdict.hypotheses[0]
        assert verdict.is_alarm
        assert first.change.name == cause
        assert first.estimated_size == pytest.approx(-0.3, rel=0.3)


def test_actuated_dynamics_with_roll_equals_rollout() -> None:
    spec = make_example_spec(RidgeConfig(), ROLLING_SIGNALS)
    plant = load_vessel("patrol_p06_linear").build()
    model = make_example_model(spec).double()
    columns = spec.signals.input_columns
    gear = PlantActuators(plant, spec.dt)
    flown = ActuatedDynamics(model, columns, "start", gear)
    helm = Helm(gear.commands_for_demand, flown.state_names, gear.input_names)
    craft = SimulatedVessel("own", flown, helm, gear.n_commands, flown.make_initial_state(1))
    turn = ConstantInput(drive=0.8, steer=0.5, duration=12.0)
    log = simulate_manoeuvres(
        craft,
        [turn],
        TrialEnvironment(None, DisturbanceConfig(), SensorsConfig(), 0),
        12.0,
        spec.dt,
    )[0].true_log
    x, w = (
        flown.make_initial_state(1)[:, : len(ROLL_LAYOUT.state_names)],
        torch.from_numpy(log.stack(columns))[None],
    )
    with torch.no_grad():
        alone = Rollout(model)(x, w[:, :-1], model.initial_state(1).double())[0][0].numpy()
    np.testing.assert_allclose(log.stack(ROLL_LAYOUT.state_names), alone, atol=1e-9)
    assert np.ptp(log["phi"]) > 0.01
    # a heading controller sees the same steps
    steered = SteeredModel(model, columns, "start", SteeredPlant(plant))
    straight, held = steered.straight_course(torch.ones(1).double())
    memory = steered.memory(torch.tensor([[1.0, 1.0, 0.0]]).double())
    with torch.no_grad():
        moved = steered.model(spec.dt).step(straight, held, memory)[0]
        wanted = model.step(straight[:, :8], held[:, :2], model.initial_state(1).double())[0]
    assert steered.state[:8] == ROLL_LAYOUT.state_names
    torch.testing.assert_close(moved[:, :8], wanted)


def test_ardupilot_backend_reports_the_roll(tmp_path: Path) -> None:
    spec = make_example_spec(RidgeConfig(), ROLLING_SIGNALS)
    save_model(tmp_path / "models" / "example", spec, make_example_model(spec))
    accept_run(tmp_path)
    known = load_vehicle(tmp_path, model="example")
    assert known.states == ROLL_LAYOUT.state_names
    assert known.lower_commands.tolist() == pytest.approx(spec.low[5:])
    back = ArduPilotBackend(known, assign_servos(known), port=0)
    try:
        pulses = [1900, 1500, 1900, *[0] * 13]
        for frame in range(1, 200):
            said = json.loads(
                back.reply_to(struct.pack("<HHI16H", 18458, 50, frame, *pulses)) or b""
            )
    finally:
        back.close()
    phi, p = (float(back.current_state[0, place]) for place in (PHI, P))
    assert abs(phi) > 0.01
    assert said["attitude"][0] == pytest.approx(phi, abs=0.1 * abs(p) + 1e-6)
    assert said["imu"]["gyro"][0] == pytest.approx(p, abs=0.05)


@pytest.mark.parametrize("gain", [1.0, -1.0, 57.3])
def test_inspect_log_compares_roll_rate_with_roll_angle(gain: float) -> None:
    random = np.random.default_rng(2)
    t = np.arange(0.0, 120.0, 0.1)
    phi = 0.05 * np.sin(0.9 * t) + 0.001 * random.normal(size=t.size)
    p = gain * 0.05 * 0.9 * np.cos(0.9 * t) + 0.001 * random.normal(size=t.size)
    still = dict.fromkeys(("x", "y", "psi", "u", "v", "r"), 0.0 * t)
    log = Log("rolls", t, {**still, "phi": phi, "p": p}, {"phi": "rad", "p": "rad/s"})
    found = [one.text for one in inspect_log(log, []).findings if one.code == "roll_rate"]
    assert len(found) == (gain != 1.0)
    assert all(text.startswith(f"phi moves by {1.0 / gain:.2g} times") for text in found)
