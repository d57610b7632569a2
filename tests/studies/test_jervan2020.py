"""The ferry study on a shortened course: what identification must recover, what control must gain,
what is refused.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from kinds import of_kind

import residnet
from residnet.autopilot.motion import PoseDerivatives, required_force, sample_filtered_course
from residnet.autopilot.motion_config import ActuatorLag
from residnet.baselines.given_config import BelievedConfig
from residnet.core.config import load_config
from residnet.core.errors import ConfigError, FitError
from residnet.export import get_exporter
from residnet.export.feed_forward import ExportedForce, RequiredForce
from residnet.physics.force_model import ForceCorrection, ForceModel
from residnet.physics.force_terms import FERRY_TERMS
from residnet.physics.plant import HullPlant
from residnet.physics.vessel import load_vessel
from residnet.runs.folder import RunFolder
from residnet.studies.jervan2020.ferry.config import FerryModelConfig, FerryStudyConfig
from residnet.studies.jervan2020.ferry.execute import (
    FerryExecutor,
    FerryStudy,
    build_record,
    compare_residuals,
    find_best_flown_model,
    identify_model,
    list_feed_forward_objections,
    run_ferry_study,
    write_results,
)
from residnet.studies.jervan2020.ferry.judging import draw_judging_courses
from residnet.studies.jervan2020.residual import (
    derive_forward_equations,
    estimate_earth_force,
    exact_residual_coefficients,
)

STUDIES = Path(residnet.__file__).parents[2] / "configs" / "studies" / "jervan2020"
SHORT = ["course.interval=20", "~models.surface"]


def config(name: str, *overrides: str) -> FerryStudyConfig:
    return load_config(STUDIES / f"{name}.yaml", list(overrides), FerryStudyConfig)


@pytest.fixture(scope="module")
def short() -> FerryStudy:
    torch.set_num_threads(1)
    return run_ferry_study(
        config("operation", *SHORT, "~crossing", "models.plsr={fit: {kind: plsr}}")
    )


def hull(name: str) -> Any:
    return of_kind(load_vessel(name).build(), HullPlant).hull


# 3 s; .ci/run carries out a study of the ferry
@pytest.mark.long
def test_the_lag_and_the_missing_half_are_found_and_flown(short: FerryStudy) -> None:
    model = short.models["lag_ridge"]
    course = short.runs["course"]
    before = course["believed"].tracking_metrics
    after = course["lag_ridge"].tracking_metrics
    left = model.test_mse(short.record)
    assert model.lag is not None
    assert model.lag.frequency == pytest.approx(2.0, rel=0.01)
    assert model.lag.damping == pytest.approx(0.8, rel=0.01)
    # the command is held for 20 ms: 10 ms on average
    assert model.lag.delay == pytest.approx(0.01, abs=0.01)
    assert all(own < 0.02 * raw for own, raw in zip(left, short.unmodelled_mse, strict=True))
    assert after.position_mae < 0.05 * before.position_mae
    assert after.iaew[0] < 0.05 * before.iaew[0]
    motion = short.believed_run.nu_dot, short.believed_run.nu
    missed = (model.force(*motion) - hull("milliampere_half").required_force(*motion)).std(0)
    # over both halves: of a shortened course the second goes beyond what identified
    assert bool((missed < 0.06 * short.believed_run.thruster_force.std(0)).all())


def test_a_fitted_model_runs_forward_as_the_true_ferry(short: FerryStudy) -> None:
    equations = derive_forward_equations(
        "milliampere", short.models["lag_ridge"].force, "lag_ridge"
    )
    names = ("u", "v", "r", "tau_x", "tau_y", "tau_n")
    model = BelievedConfig(vessel=equations).build(names)
    # along the half that identified: shortened segments leave the other half outside of what was
    # seen
    half = slice(0, len(short.believed_run.t) // 2)
    nu = short.believed_run.nu[half]
    acting = short.believed_run.thruster_force[half]
    with torch.no_grad():
        nu_dot = model(torch.cat((nu, acting), dim=-1))
    torch.testing.assert_close(nu_dot, short.believed_run.nu_dot[half], rtol=0, atol=2e-3)


MISSING = {
    "u_dot": [-1194.83, 0, 0],
    "v_dot": [0, -1266.96, -14.07],
    "r_dot": [0, -31.19, -2534.45],
    "u": [-13.82, 0, 0],
    "r^2": [31.19, 0, 0],
    "u v": [0, 0, -72.13],
    "u r": [0, -1194.83, -31.19],
    "v r": [1266.96, 0, 0],
    "|v|r": [0, 286.07, -60.98],
    "|r|v": [0, -770.19, 168.41],
}
"""Minus half of the believed model (correction J19), which Table 4.11 misprints."""


def test_what_the_believed_hull_lacks_stands_beside_what_was_found() -> None:
    truth = exact_residual_coefficients("milliampere_half", "milliampere")
    for term, values in MISSING.items():
        assert truth[term] == pytest.approx(values, abs=0.006)
    assert set(truth) <= set(FERRY_TERMS)


# 3 s; .ci/run carries out a study of the ferry
@pytest.mark.long
def test_azimuth_thrusters_get_the_controllers_force_and_push_late() -> None:
    near = "course.waypoints=[[0, 0, 0], [2, 0, 0], [2, -1, 0], [2, -1, 20 deg]]"
    flown = config("azimuth", near, "course.interval=5 s")
    flight = flown.build_loop(flown.true).simulate(
        flown.course, [(ForceModel(hull("milliampere")), None)]
    )[0]
    # the logged force is the controller's: feed-forward and feedback, not what the thrusters make
    motion = sample_filtered_course(flown.course, flown.loop.step)
    needed = required_force(ForceModel(hull("milliampere")), motion, None, flown.loop.step)
    expected = needed[:: flown.loop.steps_per_sample, :3] + flight.feedback
    torch.testing.assert_close(flight.command, expected, rtol=1e-9, atol=1e-6)
    # and what they make is what moves the hull
    moved = hull("milliampere_azimuth_half").required_force(flight.nu_dot, flight.nu)
    torch.testing.assert_close(flight.thruster_force, moved, rtol=1e-9, atol=1e-6)
    late = (flight.thruster_force[4:] - flight.command[:-4]).square().mean(0)
    assert bool((late < (flight.thruster_force - flight.command).square().mean(0)).all())


def test_lag_and_no_residual_are_tried_with_every_order(short: FerryStudy) -> None:
    believed = ForceModel(hull("milliampere"))
    wanted = FerryModelConfig.model_validate({"fit": {"kind": "plsr"}})
    late = identify_model(wanted, short.record, believed)
    assert late.lag is not None
    assert late.fit.notes["left_out"] < 0.1
    # a command that the believed model explains but for noise
    record = short.record
    force = believed(record.nu_dot, record.nu)
    noise = 50.0 * torch.randn(force.shape, generator=torch.Generator().manual_seed(0)).double()
    explained = replace(record, command=force + noise, averaged_command=force + noise)
    nothing = identify_model(wanted, explained, believed)
    assert (nothing.lag, nothing.fit.notes["order"]) == (None, 0)
    torch.testing.assert_close(nothing.force(record.nu_dot, record.nu), force)


def test_motions_to_port_tell_of_those_to_starboard(short: FerryStudy) -> None:
    believed = ForceModel(hull("milliampere"))
    record = short.record
    fit = {"fit": {"kind": "plsr"}}
    found = short.models["plsr"]
    assert found.fit.notes["mirror"]
    motion = torch.cat((record.nu_dot, record.nu), dim=-1)[~record.is_training].split(3, dim=-1)
    sides = torch.tensor([1.0, -1.0, -1.0]).double()
    there, back = (found.force(*(part * by for part in motion)) for by in (1.0, sides))
    torch.testing.assert_close(there, back * sides, rtol=1e-6, atol=1e-3)
    alone = identify_model(
        FerryModelConfig.model_validate({**fit, "mirror": False}), record, believed
    )
    left, more = (sum(model.test_mse(record)) for model in (found, alone))
    assert left < 0.7 * more
    for k, (low, high) in enumerate(record.motion_ranges(mirror=True)):
        # nu_dot and nu: surge, sway and yaw
        assert (low == -high) == (k % 3 > 0)
    # a hull that leans to port is not taken for one that does not
    pulled = record.command + torch.tensor([0.0, 200.0, 0.0]).double()
    leaning = replace(record, command=pulled, averaged_command=pulled)
    model = identify_model(FerryModelConfig.model_validate(fit), leaning, believed)
    assert "mirror" not in model.fit.notes


def test_what_searches_its_settings_leaves_with_the_whole_course(short: FerryStudy) -> None:
    assert set(short.whole_course_models) == {"plsr"}
    judged = short.models["plsr"]
    leaves = short.whole_course_models["plsr"]
    assert leaves.lag == judged.lag is not None
    assert [leaves.fit.notes[key] for key in ("order", "mirror")] == [
        judged.fit.notes[key] for key in ("order", "mirror")
    ]
    # the model that is reported has not seen what judges it
    half, whole = (
        of["plsr"].test_mse(short.record) for of in (short.models, short.whole_course_models)
    )
    assert all(more < less for more, less in zip(whole, half, strict=True))


def test_a_feed_forward_is_judged_by_its_flights() -> None:
    judging: dict[str, Any] = {
        "believed": {"position_mae": 0.232},
        "plsr": {"position_mae": 0.688},
        "ridge": {"position_mae": 0.1},
    }
    # the better flyer has the larger residual
    results: dict[str, Any] = {
        "judging": judging,
        "crossing": {},
        "models": {"plsr": {"share_left": [0.1] * 3}, "ridge": {"share_left": [1.4] * 3}},
    }
    (worse,) = list_feed_forward_objections("plsr", results)
    assert "validation courses is 0.688 m, the believed model's 0.232 m" in worse
    assert list_feed_forward_objections("ridge", results) == []
    assert find_best_flown_model(results) == "ridge"
    results["crossing"] = {"believed": {"position_mae": 0.1}, "ridge": {"position_mae": 0.3}}
    assert "in the crossing is 0.300 m" in list_feed_forward_objections("ridge", results)[0]
    judging["ridge"]["position_mae"] = None
    assert "unstable" in list_feed_forward_objections("ridge", results)[0]
    assert find_best_flown_model(results) == "plsr"


def test_judging_courses_are_flown_as_exported(short: FerryStudy) -> None:
    assert list(short.judging) == ["believed", "lag_ridge", "plsr"]
    for metrics in short.judging.values():
        assert list(metrics) == ["ahead", "astern", "mixed"]
    errors = {
        name: [run.position_mae for run in metrics.values() if run is not None]
        for name, metrics in short.judging.items()
    }
    assert all(len(values) == 3 for values in errors.values())
    assert sum(errors["lag_ridge"]) < 0.5 * sum(errors["believed"])


def test_judging_courses_resemble_the_course() -> None:
    course = config("operation").course
    courses = draw_judging_courses(course, seed=3)
    assert courses == draw_judging_courses(course, seed=3)
    for name, judging in courses.items():
        points = torch.tensor([(0.0, 0.0), *(point[:2] for point in judging.waypoints)])
        steps = points.diff(dim=0)
        # all segments of the course are 15 m long
        assert bool(((steps.norm(dim=1) >= 7.5) & (steps.norm(dim=1) <= 15.001)).all())
        drift = torch.tensor([point[2] for point in judging.waypoints]) - torch.atan2(
            steps[:, 1], steps[:, 0]
        )
        if name != "mixed":
            assert bool((drift.cos() - {"ahead": 1.0, "astern": -1.0}[name]).abs().max() < 1e-5)


@pytest.mark.parametrize(
    ("vessel", "key"),
    [
        ("milliampere", "response"),
        ("milliampere_azimuth", "shaft"),
    ],
)
def test_the_advice_for_a_vessel_without_lag_names_a_key_that_exists(
    vessel: str, key: str, tmp_path: Path
) -> None:
    file = tmp_path / "ferry.yaml"
    immediate = {"response": {"kind": "immediate"}} if key == "response" else {}
    content: dict[str, Any] = {"kind": "mass_matrix", "base": vessel, "name": "ferry"}
    file.write_text(yaml.safe_dump(content | ({"actuators": immediate} if immediate else {})))
    with pytest.raises(ConfigError, match="no lag") as caught:
        config("operation", *SHORT, f"true={file}")
    advice = re.search(r"`(actuators: .*?)` in a vessel file", str(caught.value))
    assert advice is not None
    assert key in advice[1]
    file.write_text(yaml.safe_dump(content | yaml.safe_load(advice[1])))
    config("operation", *SHORT, f"true={file}")


@pytest.mark.long
def test_feed_forward_alone_and_a_model_that_cannot_run_forward(tmp_path: Path) -> None:
    case = "models.case={fit: {kind: plsr, order: 1}, fly: true}"
    wanted = config("operation", *SHORT, "~crossing", "feed_forward_alone=true", case)
    found = run_ferry_study(wanted)
    alone = found.runs["feed_forward_alone"]
    assert list(alone) == ["believed", "lag_ridge", "case"]
    assert not any(bool(flight.feedback.any()) for flight in alone.values())
    # the thrusters give what is asked for, and half a ferry moves about twice as much
    ridge, believed = (alone[name].tracking_metrics for name in ("lag_ridge", "believed"))
    assert ridge.motion_mse[0] < 0.02 * believed.motion_mse[0]
    in_course = found.runs["course"]["believed"].tracking_metrics
    assert believed.position_mae > 10 * in_course.position_mae
    upside_down = found.models["case"].force.corrections[0].coefficients
    assert isinstance(upside_down, torch.Tensor)
    upside_down[:3] -= 5000.0 * torch.eye(3)
    folder = RunFolder.create(tmp_path / "run", "", resume=False)
    results, figures = write_results(wanted, found, folder)
    assert results["models"]["case"]["not_forward"].startswith("model case: its mass matrix")
    told = "With lag_ridge as feed-forward, the mean position error in the course"
    assert any(sentence.startswith(told) for sentence in FerryExecutor(wanted).summarize(results))
    titles = {
        section.title for section in FerryExecutor(wanted).build_sections(results, folder.path)
    }
    assert titles >= {"Models that cannot run forward in time", "Feed-forward without feedback"}
    left = {path.name for path in (tmp_path / "run" / "models").glob("*.yaml")}
    assert left == {"lag_ridge_forward.yaml"}
    drawn = {"errors_course", "forces_course", "errors_feed_forward_alone"}
    assert {figure.name for figure in figures} >= drawn
    row = results["course"]["lag_ridge"]
    assert row["power"][0] * float(found.believed_run.t[-1]) == pytest.approx(
        row["energy"][0], rel=0.01
    )


def loaded(force: RequiredForce, low: torch.Tensor, high: torch.Tensor, folder: Path) -> Any:
    ranges = list(zip(low.tolist(), high.tolist(), strict=True))
    get_exporter("torchscript").export(ExportedForce("ferry", force, ranges), folder / "f.pt")
    return torch.jit.load(str(folder / "f.pt"))


@torch.no_grad()
def test_feed_forward_outside_its_range_keeps_to_the_believed_model(
    short: FerryStudy, tmp_path: Path
) -> None:
    """Far from what identified it, a wild correction commands no more than 1.2 times the hull."""
    model = short.models["lag_ridge"].force
    most = torch.tensor([5.0] * 3 + [9.0] * 3)
    asked = loaded(
        RequiredForce(*model.split_corrections(), is_mirrored=False), -most, most, tmp_path
    )
    tau, outside = asked(short.believed_run.nu_dot, short.believed_run.nu)
    torch.testing.assert_close(tau, model(short.believed_run.nu_dot, short.believed_run.nu))
    assert not outside.any()
    record = build_record(short.believed_run, 20.0, None)
    believed = ForceModel(hull("milliampere"))
    random = torch.Generator().manual_seed(2)
    wild = ForceCorrection(
        FERRY_TERMS,
        300.0 * torch.randn(30, 3, generator=random, dtype=torch.float64),
        torch.tensor([5.0, 20.0, 30.0], dtype=torch.float64),
    )
    motion = torch.cat((record.nu_dot, record.nu), dim=-1)[record.is_training]
    low = motion.amin(0)
    high = motion.amax(0)
    force = RequiredForce(*believed.with_correction(wild).split_corrections(), is_mirrored=True)
    asked = loaded(force, low, high, tmp_path)
    random = torch.Generator().manual_seed(3)
    width = high - low
    seen = low + (2.0 * torch.rand(2000, 6, generator=random, dtype=torch.float64) - 0.5) * width
    needed = believed(seen[:, :3], seen[:, 3:])
    tau, outside = asked(seen[:, :3], seen[:, 3:])
    assert 500 < int(outside.sum()) < 2000
    assert (tau[outside].abs() <= 1.2 * needed[outside].abs() + 1e-9).all()
    # the correction is there inside
    assert ((tau - needed)[~outside].abs().amax(0) > 10.0).all()
    # nor does it where a motion is so far off that its nearest value stands for it
    far = 0.5 * (low + high) + 40.0 * (seen - 0.5 * (low + high))
    tau, flags = asked(far[:, :3], far[:, 3:])
    assert flags.all()
    assert (tau.abs() <= 1.2 * believed(far[:, :3], far[:, 3:]).abs() + 1e-9).all()
    spoiled = seen.clone()
    spoiled[::3, 1], spoiled[1::3, 4], spoiled[2::3] = torch.nan, torch.inf, 1e200
    answered, flags = asked(spoiled[:, :3], spoiled[:, 3:])
    assert answered.isfinite().all()
    assert flags.all()
    # nothing jumps at the edge
    path = torch.linspace(0.0, 1.5, 3001, dtype=torch.float64)[:, None]
    along, _ = asked(*(0.5 * (low + high) + path * width).split(3, dim=-1))
    assert (along.diff(dim=0).abs().amax(0) < 0.01 * along.abs().amax(0)).all()
    # straight ahead, at rest and straight astern there is neither sway force nor yaw moment
    straight = torch.zeros(41, 6, dtype=torch.float64)
    straight[:, 3], straight[:, 0] = torch.linspace(-1, 1, 41), torch.linspace(0.1, -0.1, 41)
    tau, _ = asked(straight[:, :3], straight[:, 3:])
    assert tau[:, 1:].abs().max() < 1e-9


def test_a_model_is_identified_again_where_its_residual_has_grown_for_long() -> None:
    def noise(scale: float, seed: int = 0) -> torch.Tensor:
        random = torch.Generator().manual_seed(seed)
        return scale * torch.randn(600, 3, generator=random, dtype=torch.float64)

    then = noise(20.0)
    now = noise(20.0, 1)
    force = noise(100.0, 9)
    fold = torch.arange(600) // 100
    same = compare_residuals(then, now, force, fold)
    assert same["fits"]
    assert same["growth"] == pytest.approx([1.0] * 3, rel=0.3)
    # one percent of the force is a trifle, and one gust no reason
    assert compare_residuals(noise(0.1), noise(1.0, 1), force, fold)["fits"]
    gust = torch.cat((6.0 * now[:100], now[100:]))
    assert compare_residuals(then, gust, force, fold)["fits"]
    grown = compare_residuals(then, now * torch.tensor([1.0, 3.0, 1.0]).double(), force, fold)
    assert (grown["fits"], grown["segments"]) == (False, [0.0, 1.0, 0.0])


def test_constant_force_needs_a_vessel_that_turns() -> None:
    random = torch.Generator().manual_seed(1)
    psi = torch.linspace(0, 5, 500, dtype=torch.float64)
    x = torch.randn(500, 4, generator=random, dtype=torch.float64)
    zero = torch.zeros_like(psi)
    columns = (psi.cos(), -psi.sin(), zero), (psi.sin(), psi.cos(), zero)
    earthly = torch.stack([torch.stack(column, -1) for column in columns], -1)
    force = torch.tensor([200.0, 100.0], dtype=torch.float64)
    y = x @ torch.randn(4, 3, generator=random, dtype=torch.float64) + earthly @ force
    torch.testing.assert_close(estimate_earth_force(x, y, earthly), force, rtol=1e-8, atol=1e-6)
    with pytest.raises(FitError, match="heading hardly changed"):
        estimate_earth_force(x, y, earthly[:1].expand(500, 3, 2))


def test_the_course_is_the_filters_own_and_its_derivatives_are_consistent() -> None:
    wanted = config("operation").course
    motion = sample_filtered_course(wanted, 0.02)
    filtered = wanted.build(0.02)
    s = torch.zeros(1, 9, dtype=torch.float64)
    x = torch.zeros(1, 6, dtype=torch.float64)
    rows = []
    for k in range(1100):
        reference, s = filtered(x, k, s)
        rows.append(reference[0])
    _, nu, nu_dot = motion.extrapolate(0.0)
    found = torch.cat((motion.pose, nu, nu_dot), -1)[:1100]
    torch.testing.assert_close(found, torch.stack(rows), rtol=1e-9, atol=1e-10)
    ahead = PoseDerivatives(*(part[500] for part in motion)).extrapolate(0.2)
    torch.testing.assert_close(ahead[1], nu[510], rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(ahead[2], nu_dot[510], rtol=1e-2, atol=1e-4)
    # the needed force and its derivatives
    needed = required_force(
        ForceModel(hull("milliampere")), motion, ActuatorLag(frequency=2.0, damping=0.8), 0.0
    )
    slope = (needed[2:, :3] - needed[:-2, :3]) / 0.04
    inside = slice(200, 2800)
    torch.testing.assert_close(needed[1:-1, 3:6][inside], slope[inside], rtol=2e-2, atol=0.5)
