"""The standard recipe: what it fits follows from logs, and its predictor is a mean."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from random_vessels import small_boat_logs

from residnet.baselines.regressors_config import RegressorsConfig
from residnet.core.config import validate_config
from residnet.core.errors import ConfigError, FitError
from residnet.core.layout import SURGE_SWAY_YAW
from residnet.core.log import Log
from residnet.core.progress import on_progress
from residnet.core.samples import Samples
from residnet.dynamics.hybrid import InnovationFilter
from residnet.heads import HeadConfig
from residnet.identification.fit import fit_models
from residnet.identification.fitter import FitStore, Fitter
from residnet.identification.identified import IdentifiedModels
from residnet.identification.prepared import PreparedSplits, prepare_splits
from residnet.identification.recipe import (
    PART_KEYS,
    PreparationPlan,
    TrainingDataSummary,
    make_portfolio,
)
from residnet.identification.settings import FitSettings
from residnet.identification.training_schedule import resolve_training
from residnet.physics.signals_config import SignalsConfig
from residnet.physics.symmetry import acts_along_own_velocity
from residnet.preprocessing.samples import make_samples
from residnet.training.config import TrainingConfig

NAMES = ("hull", "hull_network", "ensemble")


def content(**changes: Any) -> dict[str, Any]:
    windows = {"kind": "windows", "length": 8.0, "first": 1.0, "history": 1.0}
    return {
        "recipe": "standard",
        "effort": 0.05,
        "prepare": {
            "grid": {"step": 0.2},
            "derivative": {"kind": "savitzky_golay", "window": 1.4, "order": 2},
        },
        "signals": {"inputs": ["left", "right"], "pairs": [["left", "right"]]},
        "integrator": "semi_implicit_euler",
        "evaluation": {
            "protocols": {"T8": windows},
            "selection": "T8",
            "scales": {"u": 0.2, "v": 0.05, "r": 0.1},
        },
        **changes,
    }


def settings(**changes: Any) -> FitSettings:
    found: FitSettings = validate_config(content(**changes), FitSettings, "here")
    return found


def renamed(log: Log) -> Log:
    """The log at 5 Hz, its propellers under names that say nothing of a side."""
    new = {"n_port": "left", "n_stbd": "right"}
    channels = {new.get(name, name): values[::2] for name, values in log.channels.items()}
    return Log(log.name, 0.2 * np.arange(len(log.t[::2])), channels)


@pytest.fixture(scope="module")
def logs() -> PreparedSplits:
    flown = [renamed(log) for log in small_boat_logs("twin", 4, 4, 40.0)]
    splits = {"train": flown[:2], "validation": flown[2:3], "test": flown[3:]}
    return prepare_splits(splits, settings())


@pytest.fixture(scope="module")
def known(logs: PreparedSplits) -> Samples:
    return make_samples(logs["train"], settings().signals.build())


@pytest.fixture(scope="module")
def identified(logs: PreparedSplits) -> IdentifiedModels:
    return fit_models(logs, settings())


@pytest.mark.long
def test_the_mean_is_reported_first_and_a_hull_that_does_not_run_away_beside_it(
    identified: IdentifiedModels, logs: PreparedSplits
) -> None:
    assert list(identified)[:2] == ["constant_velocity", "baseline"]
    assert set(NAMES) <= set(identified)
    assert {identified[name].notes["prior"] for name in ("baseline", "hull")} == {1.0}
    assert all(np.isfinite(model.notes.get("validation", 0.0)) for model in identified.values())
    judged = identified.evaluate({split: logs[split] for split in ("train", "validation")})
    chosen = identified.select_models(judged)
    families = {entry.name: entry.family for entry in chosen.candidates}
    assert chosen.default_model == chosen.selected_ensemble == "ensemble"
    assert (chosen.selected, families["hull"]) == ("hull", "refitted baseline")
    assert families["hull_network"] == families["ensemble"] == "ensemble"
    assert identified["ensemble"].notes["members"] == ["hull", "hull_network"]
    found = judged["validation"].free_runs[0].predictions
    found["hull"] = [replace(one, has_diverged=True) for one in found["hull"]]
    # without the hull the rule of every fit chooses
    assert identified.select_models(judged).selected == "plsr"


@pytest.mark.long
def test_bands_of_short_logs_come_from_fits_without_some_of_them(
    logs: PreparedSplits,
) -> None:
    found = fit_models(logs, settings(effort=0.01))
    banded = {name: entry.bands["T8"] for name, entry in found.items() if entry.bands}
    assert list(banded) == ["constant_velocity", "baseline", "hull", "plsr", "ensemble"]
    hull = banded["hull"]
    mean = banded["ensemble"]
    assert hull.n_logs == len(logs["train"]) + len(logs["validation"])
    np.testing.assert_array_equal(mean.half_width, hull.half_width)
    assert "hull" in mean.cautions[0]
    assert hull.typical_spread is not None


@pytest.mark.long
def test_members_that_run_away_or_harm_the_mean_are_left_out(
    identified: IdentifiedModels, logs: PreparedSplits
) -> None:
    fitter = Fitter(logs, settings(), FitStore())
    zero, hull, network = (
        identified[name] for name in ("constant_velocity", "hull", "hull_network")
    )
    lost = replace(identified["baseline"], notes={"validation_diverged": 1})
    assert fitter.build_trajectory_ensemble("ensemble", [hull, network, lost]).notes["members"] == [
        "hull",
        "hull_network",
    ]
    zero = replace(zero, notes={"validation": fitter.score_on_validation(zero.model).error})
    found = fitter.build_trajectory_ensemble("ensemble", [hull, network, zero])
    # constant velocity is not used for the velocities in which it makes the mean worse
    weights = dict(zip(found.notes["members"], found.spec.weights, strict=False))
    assert 0.0 in weights.get("constant_velocity", (0.0,))
    with pytest.raises(FitError, match="fewer than two members"):
        fitter.build_trajectory_ensemble("ensemble", [hull, lost])
    fitter.validation_in_training = True
    assert fitter.build_trajectory_ensemble("ensemble", [hull, zero]).notes["left_out"] == []


def test_settings_say_the_recipe_and_nothing_of_its_parts() -> None:
    own = settings()
    written = own.model_dump(mode="json", by_alias=True)
    assert written["recipe"] == "standard"
    assert not set(PART_KEYS) & set(written)
    assert validate_config(written, FitSettings, "again") == own
    networks = ("hull_network", "network")
    candidates = ("plsr", "mlp", "lstm")
    assert own.model_names == ("baseline", "hull", *networks, *candidates, "ensemble")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"baseline": {"kind": "still"}}, "remove 'baseline'"),
        ({"heads": {"ridge": {"kind": "ridge"}}}, "remove 'heads'"),
        ({"recipe": "standart"}, "standard"),
        ({"recipe": None}, "baseline"),
        ({"signals": {"inputs": ["left"], "pairs": [["left", "rigth"]]}}, "rigth"),
    ],
)
def test_what_does_not_go_with_the_recipe(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        settings(**changes)


def test_terms_follow_from_what_moves() -> None:
    names = ("u", "v", "r", "n", "delta", "wind_u", "wind_v", "wind_mag")
    whole = TrainingDataSummary.from_channel_names(names)

    def hull(**change: Any) -> list[str]:
        return list(make_portfolio(replace(whole, **change))["baselines"]["hull"]["terms"])

    wanted = {"u|u|", "n|n|", "|n| u", "n|n| delta", "wind_u wind_mag"}
    assert wanted | {"u^2 v", "n r", "wind_mag r", "n|n| delta|delta|"} <= set(hull())
    assert "n^2" not in hull()
    astern = hull(reversing_inputs=("n",), varying_channels=("n", "delta"))
    assert "n^2 delta" in astern
    assert not [term for term in astern if "wind" in term]
    assert not [term for term in hull(varying_channels=("delta",)) if "n" in term.split()]
    turned = short(("u", "v", "r", "n_bow", "azimuth_bow"))["baselines"]["hull"]["terms"]["r"]
    assert {"n_bow|n_bow| sin(azimuth_bow)", "u |n_bow| cos(azimuth_bow)"} <= set(turned)
    assert not {"n_bow", "azimuth_bow"} & set(turned)


NAMES_OF_A_BOAT = ("u", "v", "r", "n", "delta")


def short(names: tuple[str, ...]) -> dict[str, Any]:
    """The parts for what is supposed of nine minutes of logs."""
    return make_portfolio(replace(TrainingDataSummary.from_channel_names(names), n_samples=5_400))


def test_the_hull_of_model_tests_has_a_saturating_rudder_and_free_asymmetry() -> None:
    summary = TrainingDataSummary.from_channel_names(("u", "v", "r", "delta"))
    portfolio = make_portfolio(summary, has_model_tests=True)
    terms = portfolio["baselines"]["hull"]["terms"]
    assert {"1", "u|u| delta", "u|u| delta^3", "v|v|"} <= set(terms["r"])
    assert {"v^2", "r^2", "u|u| delta^2"} <= set(terms["u"])
    # mirror symmetry: surge is even, sway and yaw are odd
    assert "u|u| delta^3" not in terms["u"]
    assert not {"v^2", "r^2", "u|u| delta^2"} & set(terms["r"])
    assert portfolio["refit"]["hull"]["asymmetric"] == 0.0
    assert settings(recipe="model_tests").refit["hull"].asymmetric == 0.0


def test_a_yaw_rate_of_noise_alone_tells_no_memory() -> None:
    random = np.random.default_rng(1)
    t = np.arange(0.0, 200.0, 0.1)
    straight = Log("straight", t, {"u": np.sin(0.1 * t), "r": random.normal(size=t.size)})
    assert PreparationPlan.from_logs([straight], []).correlation_time > 5.0


def test_networks_stand_alone_and_horizons_are_long_where_logs_are() -> None:
    facts = TrainingDataSummary.from_channel_names(NAMES_OF_A_BOAT)
    assert short(NAMES_OF_A_BOAT)["means"] == {"ensemble": ("hull", "hull_network")}
    whole = make_portfolio(facts)
    assert whole["means"] == {"ensemble": ("hull", "hull_network", "network")}
    assert whole["base_of"] == {"hull_network": "hull", "network": "constant_velocity"}
    # no model can run away
    for part in (whole["baseline"], *whole["baselines"].values()):
        assert part["bounded"]
        assert part["dissipative"]
    plan = make_portfolio(replace(facts, free_run_length=100.0, median_segment_duration=30.0))
    assert plan["refit"]["hull"]["horizon"] <= 18.0
    facts = replace(facts, free_run_length=100.0, median_segment_duration=30.0)
    for name in ("hull_network", "mlp", "lstm"):
        stages = derived_training(plan, name, facts).multi_step
        assert max(stage.horizon for stage in stages) <= 18.0


def derived_training(
    plan: dict[str, Any], name: str, facts: TrainingDataSummary, effort: float = 1.0, **given: Any
) -> TrainingConfig:
    """The training of a head of the recipe."""
    config = validate_config(plan["heads"][name], HeadConfig, "here")
    training = validate_config(given, TrainingConfig, "here")
    return resolve_training(training, config.build(facts.channel_names), facts, effort)


def test_trainings_follow_from_the_logs_and_given_keys_override_them() -> None:
    facts = TrainingDataSummary.from_channel_names(NAMES_OF_A_BOAT)
    plan = make_portfolio(facts)
    usual = derived_training(plan, "mlp", facts)
    assert usual.one_step.washout == 0.0
    assert derived_training(plan, "lstm", facts).one_step.washout > 0.0
    assert usual.require_improvement
    longer = derived_training(plan, "mlp", replace(facts, n_samples=28_000))
    assert longer.steps == pytest.approx(1.4 * usual.steps, rel=0.02)
    assert derived_training(plan, "mlp", facts, 0.5).steps == pytest.approx(usual.steps / 2, abs=1)
    # more channels have more products to learn: 56 up to degree 3 of five channels, 120 of seven
    for n_channels, factor in ((4, 1.0), (5, 1.0), (7, 120 / 56), (20, 3.0)):
        names = tuple(f"channel_{i}" for i in range(n_channels))
        training = derived_training(plan, "mlp", replace(facts, channel_names=names))
        assert training.steps == pytest.approx(factor * 97.7, abs=1)
    own = derived_training(plan, "mlp", facts, steps=7)
    assert own == usual.model_copy(update={"steps": 7})
    # a schedule of the user is taken as it is
    exact = derived_training(plan, "mlp", facts, multi_step=[{"horizon": 2.0, "epochs": 3}])
    assert (exact.epochs, exact.one_step.epochs, exact.history) == (3, 0, 0.5)
    # what is stored is derived again
    stored = TrainingConfig(steps=7).model_dump(mode="json")
    assert stored == {"steps": 7}
    assert TrainingConfig(**exact.model_dump(mode="json")) == exact


def test_networks_need_logs_of_ten_free_runs() -> None:
    facts = TrainingDataSummary.from_channel_names(NAMES_OF_A_BOAT)
    assert set(make_portfolio(facts)["heads"]) >= {"plsr", "mlp", "lstm"}
    assert set(short(NAMES_OF_A_BOAT)["heads"]) == {"hull_network", "plsr"}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, "mlp and lstm are left out: "),
        (
            {"recipe": None, "baseline": {"kind": "regressors"}, "heads": {"net": {"kind": "mlp"}}},
            "net: ",
        ),
    ],
)
def test_a_fit_says_that_logs_are_short_for_networks(
    logs: PreparedSplits, changes: dict[str, Any], said: str
) -> None:
    windows = {"kind": "windows", "length": 15.0, "first": 1.0, "history": 1.0}
    evaluation = content()["evaluation"] | {"protocols": {"T8": windows}}
    messages: list[str] = []
    with on_progress(lambda progress: messages.append(progress.message)):
        fitter = Fitter(logs, settings(evaluation=evaluation, **changes), FitStore())
    step = fitter.settings.prepare.grid.step
    usable = sum(int(log.trainable.sum()) for log in logs["train"]) * step
    recorded = sum(len(log.trainable) for log in logs["train"]) * step
    durations = f"{usable:.0f} s of the {recorded:.0f} s of the training logs"
    assert [
        one
        for one in messages
        if said in one and durations in one and "shorter than ten free runs" in one
    ]
    assert "mlp" not in fitter.settings.heads


def test_short_logs_give_each_axis_the_terms_that_a_symmetric_vessel_has() -> None:
    rows = short(NAMES_OF_A_BOAT)["baselines"]["hull"]["terms"]
    assert {"1", "u", "u|u|", "v r", "n", "n|n|", "|n| u"} == set(rows["u"])
    assert {"u v", "v|r|", "u|u| delta", "n|n| delta", "n|n|", "1"} <= set(rows["v"])
    assert not {"u", "u|u|", "|n| u", "v r"} & set(rows["r"])
    paired = SignalsConfig(inputs=("left", "right"), pairs=(("left", "right"),)).build().names
    rows = short(paired)["baselines"]["hull"]["terms"]
    assert {"left", "right|right|", "|left| u"} <= set(rows["r"])
    assert "u|u|" not in rows["r"]
    facts = TrainingDataSummary.from_channel_names(paired)
    assert derived_training(short(paired), "hull_network", facts).mirror


def test_least_squares_of_relays_has_a_small_weight(known: Samples, logs: PreparedSplits) -> None:
    switched = known.z.clone()
    left = known.names.index("left")
    switched[:, left] = torch.where(torch.arange(len(known)) // 10 % 2 == 0, 1.0, -1.0)
    priors = []
    for z in (known.z, switched):
        summary = TrainingDataSummary.from_logs(
            replace(known, z=z), logs["train"], settings().evaluation, 0.2
        )
        priors.append((summary.relay_inputs, make_portfolio(summary)["refit"]["hull"]["prior"]))
    assert priors == [((), 1.0), (("left",), 1e-2)]


def test_a_mirror_symmetric_model_has_no_asymmetry(known: Samples) -> None:
    baseline = RegressorsConfig(terms=("1", "u", "r", "left", "right")).build(known.names)
    theta = torch.tensor(
        [[0.1, -0.5, 0.0, 2.0, 2.0], [0.0, 0.0, 0.3, 0.1, -0.1], [0.0, 0.0, -1.0, 0.4, -0.4]]
    ).double()
    baseline.theta.data.copy_(theta)
    pull = baseline.symmetry_precision(known)
    flat = theta.flatten()
    assert float(flat @ pull @ flat) == pytest.approx(0.0, abs=1e-9)
    flat[-1] = 0.4
    assert float(flat @ pull @ flat) > 0.0


def test_what_was_predicted_wrong_of_the_past_is_told_and_fades() -> None:
    """A constant acceleration that no prediction knows; then a free run, where none is missed."""
    force = torch.tensor([[0.05, -0.02, 0.02]], dtype=torch.float64)
    missed = InnovationFilter(5.0, 0.1, SURGE_SWAY_YAW)
    x, s = torch.zeros(1, 6, dtype=torch.float64), torch.zeros(1, 7, dtype=torch.float64)
    told = force
    for k in range(2000):
        told = missed(x, s)
        s = missed.next_memory(x, told)
        x = x + 0.1 * torch.cat((torch.zeros(1, 3), force), dim=-1) * (k < 1950)
    torch.testing.assert_close(told / force, torch.full_like(force, math.exp(-4.9 / 5.0)))


TERMS = ("1", "u", "u|u|", "v", "r", "v|v|", "left", "left|left|")


def test_a_bounded_model_comes_back_from_anywhere(known: Samples) -> None:
    config = RegressorsConfig(terms=TERMS, bounded=True)
    baseline = config.build(known.names)
    config.fit_preferred(baseline, known)
    low = known.z.amin(0)
    high = known.z.amax(0)
    far = known.z[:1].clone()
    far[:, :3] = (high + 20.0 * (high - low))[:3]
    assert bool((baseline(far) < 0).all())
    inside = RegressorsConfig(terms=TERMS).build(known.names)
    inside.load_state_dict({"theta": baseline.theta})
    torch.testing.assert_close(baseline(known.z), inside(known.z))

    def at(beyond: float) -> torch.Tensor:
        z = known.z[:1].clone()
        place = known.names.index("left")
        z[:, place] = (high + beyond * (high - low))[place]
        return baseline(z)

    # inputs are held half a range beyond the data
    torch.testing.assert_close(at(10.0), at(0.5))
    assert not torch.allclose(at(0.5), at(0.0))


def test_terms_that_would_feed_energy_are_left_out(known: Samples) -> None:
    speed, sway, rate = (known.z[:, i] for i in range(3))
    # accelerations that grow with the speed, and fall with its square
    surge = 0.3 * speed - 0.2 * speed * speed.abs()
    # fed by u r, and damped by |u| r where nobody has been
    target = torch.stack((surge, -sway, 0.4 * speed * rate - 0.1 * rate), dim=1)
    terms = ("1", "u", "v", "r", "u|u|", "u r", "left")
    for dissipative in (False, True):
        config = RegressorsConfig(terms=terms, dissipative=dissipative)
        baseline = config.build(known.names)
        table = {
            (c.axis, c.term) for c in config.fit_preferred(baseline, known.with_target(target))
        }
        assert {("r_dot", "u r") in table, ("u_dot", "u") in table} == {not dissipative}
        assert {("v_dot", "u r"), ("v_dot", "v")} <= table
        z = known.z[::20].clone().requires_grad_()
        slope = torch.autograd.grad(baseline(z)[:, 2].sum(), z)[0][:, 2]
        assert (slope.median() > 0.0) != dissipative
    assert not baseline.undamped_terms(known)
    assert not baseline.destabilising_terms()
    for term, axis, sure in (("u|u|", 0, 1), ("v|r|", 1, 1), ("|n| r", 2, 1), ("u v", 1, 0)):
        assert acts_along_own_velocity(term, axis, ("u", "v", "r", "n")) == bool(sure)
    assert not acts_along_own_velocity("u", 1, ("u", "v", "r", "n"))
