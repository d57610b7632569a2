"""Sanity checks on models made by hand, whose answers are known."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from kinds import of_kind

from residnet.baselines.regressors import RegressorBaseline
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec, save_model
from residnet.heads.lstm import LstmHead
from residnet.judge.verdict.sanity import (
    BOUNDED,
    CHECKS,
    DAMPING,
    MASS,
    STABILITY,
    SYMMETRY,
    Finding,
    check_model,
    check_run,
    growth_rate,
)
from residnet.judge.verdict.sanity_points import Mirror, acceleration, operating_points
from residnet.physics.signals import SignalsConfig

# u_dot, v_dot, r_dot by term: a vessel that behaves
RUDDER = {
    "u": (-0.1, 0, 0),
    "v": (0, -0.3, 0.05),
    "r": (0, -0.2, -0.5),
    "n": (0.02, 0, 0),
    "delta": (0, 0.01, 0.1),
}
# delta from two thrusters, by differences
TWIN = {
    "u": (-0.1, 0, 0),
    "v": (0, -0.3, 0.05),
    "r": (0, -0.2, -0.5),
    "n_port": (0.01, 0, 0.02),
    "n_stbd": (0.01, 0, -0.02),
}


def made(
    terms: dict[str, tuple[float, float, float]],
    inputs: tuple[str, ...] = ("n", "delta"),
    *,
    exogenous: tuple[str, ...] = (),
    head: dict[str, object] | None = None,
    low: tuple[float, ...] = (0.0, -0.4, -0.2, 0.0, -0.6),
    high: tuple[float, ...] = (2.0, 0.4, 0.2, 10.0, 0.6),
) -> tuple[ModelSpec, HybridDynamics]:
    spec = ModelSpec.model_validate(
        {
            "schema": "residnet.model/1",
            "name": "made",
            "role": "baseline" if head is None else "head",
            "signals": SignalsConfig(inputs=inputs, exogenous=exogenous).model_dump(),
            "baseline": {"kind": "regressors", "terms": list(terms)},
            "head": head,
            "dt": 0.1,
            "integrator": "rk4",
            "low": low,
            "high": high,
        }
    )
    torch.manual_seed(0)
    model = spec.build()
    theta = of_kind(model.baseline, RegressorBaseline).theta
    theta.data.copy_(torch.tensor(list(terms.values()), dtype=torch.float64).T)
    return spec, model


def findings(spec: ModelSpec, model: HybridDynamics) -> dict[str, Finding]:
    return {finding.check: finding for finding in check_model(spec, model)}


@pytest.mark.parametrize(
    ("terms", "inputs"), [(RUDDER, ("n", "delta")), (TWIN, ("n_port", "n_stbd"))]
)
def test_a_vessel_that_behaves_passes(
    terms: dict[str, tuple[float, float, float]], inputs: tuple[str, ...]
) -> None:
    low = (0.0, -0.4, -0.2, 0.0, -0.6 if inputs[1] == "delta" else 0.0)
    high = (2.0, 0.4, 0.2, 10.0, 0.6 if inputs[1] == "delta" else 10.0)
    found = findings(*made(terms, inputs, low=low, high=high))
    assert list(found) == list(CHECKS)
    assert {check: finding.ok for check, finding in found.items()} == {
        DAMPING: True,
        STABILITY: True,
        SYMMETRY: True,
        MASS: None,
        BOUNDED: True,
    }
    assert "not applicable: acceleration-space model" in found[MASS].text


def test_a_vessel_without_inputs_is_checked_from_rest() -> None:
    coasting = {name: row for name, row in RUDDER.items() if name in "uvr"}
    found = check_model(*made(coasting, (), low=(0.0, -0.4, -0.2), high=(2.0, 0.4, 0.2)))
    assert all(finding.ok for finding in found if finding.check == BOUNDED)
    assert any("1 run of" in finding.text for finding in found if finding.check == BOUNDED)


def test_wrong_sign_of_damping_is_flagged() -> None:
    found = findings(*made(RUDDER | {"u": (0.1, 0, 0)}))
    assert found[DAMPING].ok is False
    assert "not damped (wrong sign or none): u at rest, u at cruise" in found[DAMPING].text
    assert "du′/du +0.1" in found[DAMPING].text
    assert found[BOUNDED].ok is False
    assert "runs away" in found[BOUNDED].text


def test_a_model_that_no_velocity_changes_is_not_damped() -> None:
    found = findings(*made({"1": (0.0, 0.0, 0.0)}))
    assert found[DAMPING].ok is False
    assert "u at cruise, v at cruise, r at cruise" in found[DAMPING].text


def test_purely_quadratic_damping_is_no_wrong_sign() -> None:
    terms = {name: value for name, value in RUDDER.items() if name != "u"} | {
        "u|u|": (-0.1, 0.0, 0.0)
    }
    assert findings(*made(terms))[DAMPING].ok is True


def test_instability_inside_the_data_is_flagged_with_its_doubling_time() -> None:
    # v and r feed each other: the linearisation [[-0.3, -1], [-1, -0.5]] has the eigenvalue 0.605
    # 1/s
    found = findings(*made(RUDDER | {"v": (0, -0.3, -1.0), "r": (0, -1.0, -0.5)}))
    assert found[DAMPING].ok is True
    assert found[STABILITY].ok is False
    assert "inside the training data" in found[STABILITY].text
    rate = float(
        torch.linalg.eigvals(
            torch.tensor([[-0.3, -1.0], [-1.0, -0.5]], dtype=torch.float64)
        ).real.max()
    )
    assert f"doubles in {math.log(2) / rate:.2g} s" in found[STABILITY].text


def test_instability_outside_the_data_is_told_apart() -> None:
    # yaw damping 0.5 - 0.2 u turns at u = 2.5 m/s; the data end at 2
    found = findings(*made(RUDDER | {"u r": (0, 0, 0.2)}))
    assert found[STABILITY].ok is False
    assert "only outside the training data" in found[STABILITY].text
    assert "u = 3 m/s (outside the training data)" in found[STABILITY].text


def test_growth_rate_is_the_eigenvalue_of_the_linearisation() -> None:
    spec, model = made(RUDDER)
    model = model.double()
    for point in operating_points(spec, model):
        expected = float(
            torch.linalg.eigvals(
                torch.tensor([[-0.3, -0.2], [0.05, -0.5]], dtype=torch.float64)
            ).real.max()
        )
        assert growth_rate(model, point) == pytest.approx(expected, rel=1e-4)


def test_growth_rate_with_a_memory_is_that_of_the_whole_step() -> None:
    spec, model = made(RUDDER, head={"kind": "lstm", "hidden_size": 3})
    model = model.double().eval()
    of_kind(model.head, LstmHead).scale.spread.fill_(0.3)
    point = operating_points(spec, model)[2]
    s = model.warmup(point.x.expand(1, 100, 6), point.w.expand(1, 100, 2))[0]

    def step(z: torch.Tensor) -> torch.Tensor:
        x, memory = model.step(torch.cat((point.x[:4], z[:2]))[None], point.w[None], z[2:][None])
        return torch.cat((x[0, 4:], memory[0]))

    jacobian = torch.autograd.functional.jacobian(step, torch.cat((point.x[4:], s)))
    expected = math.log(float(torch.linalg.eigvals(jacobian).abs().max())) / 0.1
    assert growth_rate(model, point) == pytest.approx(expected, rel=1e-9)


def test_cruise_holds_its_speed_with_the_rudder_amidships() -> None:
    spec, model = made(RUDDER)
    points = {point.label: point for point in operating_points(spec, model.double())}
    cruise = points["cruise"]
    assert cruise.speed == pytest.approx(0.67 * 2.0)
    assert float(cruise.w[1]) == 0.0
    # u_dot = 0.02 n - 0.1 u vanishes at n = 6.7; the drives tried are 0.25 apart
    assert float(cruise.w[0]) == pytest.approx(6.7, abs=0.13)
    assert cruise.inside


@pytest.mark.parametrize("term", ["1", "n", "u"])
def test_a_vessel_that_turns_by_itself_is_flagged(term: str) -> None:
    terms = dict(RUDDER)
    surge, sway, _ = terms.get(term, (0.0, 0.0, 0.0))
    terms[term] = (surge, sway, 0.05)
    found = findings(*made(terms))
    assert found[SYMMETRY].ok is False
    assert "differ" in found[SYMMETRY].text


def test_unequal_thrusters_are_flagged() -> None:
    low, high = (0.0, -0.4, -0.2, 0.0, 0.0), (2.0, 0.4, 0.2, 10.0, 10.0)
    assert (
        findings(
            *made(TWIN | {"n_stbd": (0.01, 0, -0.01)}, ("n_port", "n_stbd"), low=low, high=high)
        )[SYMMETRY].ok
        is False
    )


def test_symmetry_needs_to_know_what_steers() -> None:
    terms = {name: value for name, value in RUDDER.items() if name not in ("n", "delta")} | {
        "lever": (0.02, 0, 0),
        "wheel": (0, 0.01, 0.1),
    }
    found = findings(*made(terms, ("lever", "wheel")))
    assert found[SYMMETRY].ok is None
    assert "nobody said which input steers" in found[SYMMETRY].text


def test_wind_from_the_other_side_is_the_mirror_of_wind() -> None:
    wind = {"wind_u": (0.01, 0, 0), "wind_v": (0, 0.02, 0.01)}
    low, high = (0.0, -0.4, -0.2, 0.0, -0.6, 0.0, 0.0), (2.0, 0.4, 0.2, 10.0, 0.6, 8.0, 6.28)
    spec, model = made(RUDDER | wind, exogenous=("wind_speed", "wind_dir"), low=low, high=high)
    assert findings(spec, model)[SYMMETRY].ok is True
    mirror = Mirror.of(spec.signals.columns)
    assert mirror is not None
    x, w = mirror.draw(spec, 50)
    one, other = acceleration(model, x, w), acceleration(model, mirror.state(x), mirror.inputs(w))
    torch.testing.assert_close(other, one * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))


def test_a_network_on_top_is_checked_with_its_memory_settled() -> None:
    spec, model = made(RUDDER, head={"kind": "lstm", "hidden_size": 4})
    of_kind(model.head, LstmHead).scale.spread.fill_(1e-6)
    found = findings(spec, model)
    assert {check: finding.ok for check, finding in found.items()} == {
        DAMPING: True,
        STABILITY: True,
        SYMMETRY: True,
        MASS: None,
        BOUNDED: True,
    }
    of_kind(model.head, LstmHead).scale.spread.fill_(0.5)
    assert findings(spec, model)[SYMMETRY].ok is False


def test_a_run_is_checked_model_by_model_without_zero(tmp_path: Path) -> None:
    for name, role in (("zero", "zero"), ("baseline", "baseline")):
        spec, model = made(RUDDER)
        save_model(
            tmp_path / "models" / name, spec.model_copy(update={"name": name, "role": role}), model
        )
    threads = torch.get_num_threads()
    found = check_run(tmp_path)
    assert [finding.model for finding in found] == ["baseline"] * len(CHECKS)
    assert torch.get_num_threads() == threads
    assert check_run(tmp_path / "empty") == []
