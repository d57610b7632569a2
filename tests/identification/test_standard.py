"""The standard recipe: what it fits follows from logs, and its predictor is a mean."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from random_vessels import small_boat_logs

from residnet.baselines.regressors import RegressorsConfig
from residnet.core.config import validate
from residnet.core.errors import ConfigError, FitError
from residnet.core.layout import ALIVE
from residnet.core.log import Log
from residnet.core.samples import Samples
from residnet.data.prepare import samples
from residnet.dynamics.hybrid import Missed
from residnet.identification.fit import Identified, fit
from residnet.identification.fitter import FitStore, Fitter, burden
from residnet.identification.prepared import PreparedSplits, prepare_logs
from residnet.identification.recipe import PARTS, Facts, portfolio
from residnet.identification.settings import FitSettings
from residnet.judge.freerun import Candidate, free_run
from residnet.judge.protocol import all_windows
from residnet.physics.signals import SignalsConfig
from residnet.physics.symmetry import dissipates

NAMES = ("hull", "hull_network", "mean")


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
    found: FitSettings = validate(content(**changes), FitSettings, "here")
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
    return prepare_logs(splits, settings())


@pytest.fixture(scope="module")
def known(logs: PreparedSplits) -> Samples:
    return samples(logs["train"], settings().signals.build())


@pytest.fixture(scope="module")
def identified(logs: PreparedSplits) -> Identified:
    return fit(logs, settings())


@pytest.mark.long
def test_the_mean_is_reported_first_and_a_hull_that_does_not_run_away_beside_it(
    identified: Identified, logs: PreparedSplits
) -> None:
    assert list(identified)[:2] == ["zero", "baseline"]
    assert set(NAMES) <= set(identified)
    assert {identified[name].notes["prior"] for name in ("baseline", "hull")} == {1.0}
    assert all(np.isfinite(model.notes.get("validation", 0.0)) for model in identified.values())
    judged = identified.evaluate({split: logs[split] for split in ("train", "validation")})
    chosen = identified.select(judged)
    families = {entry.name: entry.family for entry in chosen.contenders}
    assert chosen.predictor == chosen.selected_ensemble == "mean"
    assert (chosen.selected, families["hull"]) == ("hull", "refitted baseline")
    assert families["hull_network"] == families["mean"] == "ensemble"
    assert identified["mean"].notes["members"] == ["hull", "hull_network"]
    found = judged["validation"].runs[0].predictions
    found["hull"] = [replace(one, diverged=True) for one in found["hull"]]
    assert identified.select(judged).selected == "baseline"


@pytest.mark.long
def test_bands_of_short_logs_come_from_fits_without_some_of_them(
    logs: PreparedSplits,
) -> None:
    found = fit(logs, settings(effort=0.01))
    banded = {name: entry.bands["T8"] for name, entry in found.items() if entry.bands}
    assert list(banded) == ["zero", "baseline", "hull", "mean"]
    hull, mean = banded["hull"], banded["mean"]
    assert hull.logs == len(logs["train"]) + len(logs["validation"])
    np.testing.assert_array_equal(mean.width, hull.width)
    assert "hull" in mean.cautions[0]
    assert hull.usual is not None


@pytest.mark.long
def test_the_mean_is_that_of_the_trajectories_of_its_members(
    identified: Identified, logs: PreparedSplits
) -> None:
    """Free runs of each member by itself, averaged, against those of the one model of them all."""
    config, step = settings().evaluation, 0.2
    windows = all_windows(config.protocols["T8"], logs["test"], step, "T8")
    members = identified["mean"].notes["members"]
    every = [Candidate(name, "", identified[name].model) for name in [*members, "mean"]]
    found = free_run(every, windows, logs["test"], step, identified.limit)
    beside = identified.evaluate({"test": logs["test"]})["test"].runs[0].predictions["mean"]
    for place, mean in enumerate(found["mean"]):
        states = [found[name][place].states[:, 3:] for name in members]
        np.testing.assert_allclose(mean.states[:, 3:], np.mean(states, axis=0), atol=1e-6)
        np.testing.assert_allclose(mean.states, beside[place].states, atol=1e-6)


@pytest.mark.long
def test_members_that_run_away_or_harm_the_mean_are_left_out(
    identified: Identified, logs: PreparedSplits
) -> None:
    fitter = Fitter(logs, settings(), FitStore())
    zero, hull, network = (identified[name] for name in ("zero", "hull", "hull_network"))
    lost = replace(identified["baseline"], notes={"validation_diverged": 1})
    assert fitter.mean("mean", [hull, network, lost]).notes["members"] == ["hull", "hull_network"]
    zero = replace(zero, notes={"validation": fitter.validate(zero.model).error})
    found = fitter.mean("mean", [hull, network, zero])
    assert (found.notes["members"], found.notes["left_out"]) == (["hull", "hull_network"], ["zero"])
    for one in (lost, zero):
        with pytest.raises(FitError, match="no mean errs less"):
            fitter.mean("mean", [hull, one])
    fitter.seen = True
    assert fitter.mean("mean", [hull, zero]).notes["left_out"] == []


def test_what_harms_a_mean_of_independent_errors() -> None:
    """Drawn errors say when the mean without the largest has less variance."""
    random = np.random.default_rng(1)
    for _ in range(50):
        sizes = random.uniform(0.5, 3.0, random.integers(2, 5))
        members: list[Any] = [SimpleNamespace(notes={"validation": size}) for size in sizes]
        variance = (sizes**2).sum() / len(sizes) ** 2
        others = np.delete(sizes, sizes.argmax())
        without = (others**2).sum() / len(others) ** 2
        expected = members[sizes.argmax()] if without < variance else None
        assert burden(members) is expected


def test_settings_say_the_recipe_and_nothing_of_its_parts() -> None:
    own = settings()
    written = own.model_dump(mode="json", by_alias=True)
    assert written["recipe"] == "standard"
    assert not set(PARTS) & set(written)
    assert validate(written, FitSettings, "again") == own
    assert own.model_names == ("baseline", "hull", "hull_network", "network", "mean")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"baseline": {"kind": "still"}}, "leave 'baseline' out"),
        ({"heads": {"ridge": {"kind": "ridge"}}}, "leave 'heads' out"),
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
    whole = Facts.supposed(names)
    hull = portfolio(whole)["baselines"]["hull"]["terms"]
    assert {"u|u|", "n|n|", "|n| u", "n|n| delta", "wind_u wind_mag"} <= set(hull)
    assert {"u^2 v", "n r", "wind_mag r", "n|n| delta|delta|"} <= set(hull)
    assert "n^2" not in hull
    astern = replace(whole, astern=("n",), moving=("n", "delta"))
    hull = portfolio(astern)["baselines"]["hull"]["terms"]
    assert "n^2 delta" in hull
    assert not [term for term in hull if "wind" in term]
    still = replace(whole, moving=("delta",))
    assert not [t for t in portfolio(still)["baselines"]["hull"]["terms"] if "n" in t.split()]


def short(names: tuple[str, ...]) -> Facts:
    """What is supposed of nine minutes of logs."""
    return replace(Facts.supposed(names), samples=5_400)


def test_networks_stand_alone_where_logs_are_long() -> None:
    names = ("u", "v", "r", "n", "delta")
    assert portfolio(short(names))["means"] == {"mean": ("hull", "hull_network")}
    whole = portfolio(Facts.supposed(names))
    assert whole["means"] == {"mean": ("hull", "hull_network", "network")}
    assert whole["base_of"] == {"hull_network": "hull", "network": "zero"}


def test_short_logs_give_each_axis_the_terms_that_a_symmetric_vessel_has() -> None:
    names = ("u", "v", "r", "n", "delta")
    rows = portfolio(short(names))["baselines"]["hull"]["terms"]
    assert {"1", "u", "u|u|", "v r", "n", "n|n|", "|n| u"} == set(rows["u"])
    assert {"u v", "v|r|", "u|u| delta", "n|n| delta", "n|n|", "1"} <= set(rows["v"])
    assert not {"u", "u|u|", "|n| u", "v r"} & set(rows["r"])
    paired = SignalsConfig(inputs=("left", "right"), pairs=(("left", "right"),)).build().names
    rows = portfolio(short(paired))["baselines"]["hull"]["terms"]
    assert {"left", "right|right|", "|left| u"} <= set(rows["r"])
    assert "u|u|" not in rows["r"]
    assert portfolio(short(paired))["training"]["hull_network"]["mirror"]


def test_the_models_of_the_recipe_cannot_run_away() -> None:
    plan = portfolio(Facts.supposed(("u", "v", "r", "n", "delta")))
    for part in (plan["baseline"], *plan["baselines"].values()):
        assert part["bounded"]
        assert part["dissipative"]


def test_horizons_fit_into_the_logs() -> None:
    facts = replace(Facts.supposed(("u", "v", "r", "n")), length=100.0, stretch=30.0)
    plan = portfolio(facts)
    horizons = [s["horizon"] for t in plan["training"].values() for s in t["multi_step"]]
    assert max(*horizons, plan["refit"]["hull"]["horizon"]) <= 18.0


@pytest.mark.parametrize(
    ("term", "axis", "known"),
    [("u|u|", 0, True), ("v|r|", 1, True), ("|n| r", 2, True), ("u v", 1, False), ("u", 1, False)],
)
def test_terms_whose_power_has_one_sign(term: str, axis: int, known: bool) -> None:
    assert dissipates(term, axis, ("u", "v", "r", "n")) == known


def test_terms_that_would_feed_energy_are_left_out(known: Samples) -> None:
    config = RegressorsConfig(terms=("1", "u", "v", "r", "u|u|", "left"), dissipative=True)
    # accelerations that grow with the speed, and fall with its square
    speed = known.z[:, 0]
    target = torch.stack((0.3 * speed - 0.2 * speed * speed.abs(), -known.z[:, 1], speed), dim=1)
    baseline = config.build(known.names)
    table = {(c.axis, c.term): c.value for c in config.fit(baseline, known.with_target(target))}
    assert ("u_dot", "u") not in table
    assert ("v_dot", "v") in table
    assert not baseline.feeding()


def test_a_bounded_model_comes_back_from_anywhere(known: Samples) -> None:
    config = RegressorsConfig(terms=("1", "u", "u|u|", "v", "r", "v|v|"), bounded=True)
    baseline = config.build(known.names)
    config.fit(baseline, known)
    low, high = known.z[:, :3].amin(0), known.z[:, :3].amax(0)
    far = torch.cat((high + 20.0 * (high - low), known.z[0, 3:]))
    assert bool((baseline(far) < 0).all())
    inside = RegressorsConfig(terms=("1", "u", "u|u|", "v", "r", "v|v|")).build(known.names)
    inside.load_state_dict({"theta": baseline.theta})
    torch.testing.assert_close(baseline(known.z), inside(known.z))


def test_a_bounded_model_holds_inputs_half_a_range_beyond_the_data(known: Samples) -> None:
    config = RegressorsConfig(terms=("1", "u", "v", "r", "left", "left|left|"), bounded=True)
    baseline = config.build(known.names)
    config.fit(baseline, known)
    place = known.names.index("left")
    low, high = known.z[:, place].amin(), known.z[:, place].amax()

    def at(value: torch.Tensor) -> torch.Tensor:
        z = known.z[:1].clone()
        z[:, place] = value
        return baseline(z)

    edge = high + 0.5 * (high - low)
    torch.testing.assert_close(at(high + 10.0 * (high - low)), at(edge))
    assert not torch.allclose(at(edge), at(high))


def test_a_mirror_symmetric_model_has_no_asymmetry(known: Samples) -> None:
    baseline = RegressorsConfig(terms=("1", "u", "r", "left", "right")).build(known.names)
    theta = torch.tensor(
        [[0.1, -0.5, 0.0, 2.0, 2.0], [0.0, 0.0, 0.3, 0.1, -0.1], [0.0, 0.0, -1.0, 0.4, -0.4]],
        dtype=torch.float64,
    )
    baseline.theta.data.copy_(theta)
    pull = baseline.asymmetry(known)
    assert float(theta.flatten() @ pull @ theta.flatten()) == pytest.approx(0.0, abs=1e-9)
    theta[2, 4] = 0.4
    assert float(theta.flatten() @ pull @ theta.flatten()) > 0.0


def test_what_was_predicted_wrong_of_the_past_is_told_and_fades() -> None:
    """A constant acceleration that no prediction knows; then a free run, where none is missed."""
    force = torch.tensor([[0.05, -0.02, 0.02]], dtype=torch.float64)
    missed = Missed(5.0, 0.1, ALIVE)
    x, s = torch.zeros(1, 6, dtype=torch.float64), torch.zeros(1, 7, dtype=torch.float64)
    told = force
    for k in range(2000):
        told = missed(x, s)
        s = missed.remembered(x, told)
        x = x + 0.1 * torch.cat((torch.zeros(1, 3), force), dim=-1) * (k < 1950)
    torch.testing.assert_close(told / force, torch.full_like(force, math.exp(-4.9 / 5.0)))
    torch.jit.script(missed)


def test_a_term_that_turns_the_damping_about_is_left_out(known: Samples) -> None:
    speed, sway, rate = (known.z[:, i] for i in range(3))
    # fed by u r, and damped by |u| r where nobody has been
    target = torch.stack((-speed, -sway, 0.4 * speed * rate - 0.1 * rate), dim=1)
    terms = ("1", "u", "v", "r", "u r", "left")
    for dissipative in (False, True):
        baseline = RegressorsConfig(terms=terms, dissipative=dissipative).build(known.names)
        config = RegressorsConfig(terms=terms, dissipative=dissipative)
        table = {(c.axis, c.term) for c in config.fit(baseline, known.with_target(target))}
        assert (("r_dot", "u r") in table) != dissipative
        assert ("v_dot", "u r") in table
        z = known.z[::20].clone().requires_grad_()
        slope = torch.autograd.grad(baseline(z)[:, 2].sum(), z)[0][:, 2]
        assert (slope.median() > 0.0) != dissipative
    assert not baseline.undamped(known)
