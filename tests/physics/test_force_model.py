"""Models in force space against the hull's own equation and closed forms."""

from __future__ import annotations

import pytest
import torch

from residnet.core.errors import ConfigError, FitError
from residnet.physics.force_model import (
    ForceCorrection,
    ForceModel,
    augment_mass,
    weighted_column_std,
)
from residnet.physics.force_terms import FERRY_TERMS, term_order
from residnet.physics.plant import HullPlant
from residnet.physics.vessel import load_vessel


def hull(name: str) -> HullPlant:
    built = load_vessel(name).build()
    assert isinstance(built, HullPlant)
    return built


def motion(n: int = 50) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(2)
    return (
        0.1 * torch.randn(n, 3, generator=generator, dtype=torch.float64),
        0.6 * torch.randn(n, 3, generator=generator, dtype=torch.float64),
    )


def truth() -> torch.Tensor:
    """What half of the believed ferry lacks, by basis function (document 002 Table 4.11 with the
    signs of correction J19).
    """
    # rows of surge, sway and yaw
    axes: list[dict[str, float]] = [
        {
            "u_dot": -1194.8285, "u": -13.816, "u|u|": -55.032, "u^3": -6.9825, "r^2": 31.193,
            "v r": 1266.9555,
        },
        {
            "v_dot": -1266.9555, "r_dot": -31.193, "v": -26.4735, "r": 12.366, "v|v|": -58.243,
            "r|r|": -57.7285, "v^3": -12.1565, "u r": -1194.8285, "|v|r": 286.0705,
            "|r|v": -770.1915,
        },
        {
            "v_dot": -14.0705, "r_dot": -2534.455, "v": 1.762, "r": -61.43, "v|v|": -0.416,
            "r|r|": -437.214, "u v": -72.127, "u r": -31.193, "|v|r": -60.9785, "|r|v": 168.4135,
        },
    ]  # fmt: skip
    return torch.tensor([[row.get(term, 0.0) for row in axes] for term in FERRY_TERMS]).double()


def test_half_the_ferry_is_the_believed_one_and_table_4_11() -> None:
    assert len(set(FERRY_TERMS)) == len(FERRY_TERMS) == 30
    orders = [term_order(term) for term in ("u_dot", "|u|", "u|u|", "v^2", "r^3", "|u||r|")]
    assert orders == [1, 1, 2, 2, 3, 2]
    nu_dot, nu = motion()
    correction = ForceCorrection(FERRY_TERMS, truth(), torch.zeros(3))
    model = ForceModel(hull("milliampere").hull, [correction])
    wanted = hull("milliampere_half").hull.required_force(nu_dot, nu)
    torch.testing.assert_close(model(nu_dot, nu), wanted, rtol=1e-4, atol=1e-2)
    # forward in time it is the true ferry
    believed = hull("milliampere").hull
    total, rest = augment_mass(believed.mass, FERRY_TERMS, truth(), "model")
    torch.testing.assert_close(total, 0.5 * believed.mass, rtol=1e-6, atol=1e-2)
    assert [FERRY_TERMS[j] for j in rest[:2]] == ["u", "v"]


def test_a_chain_adds_up_and_leaves_what_its_corrections_do_not_explain() -> None:
    nu_dot, nu = motion()
    first = ForceCorrection(
        ("u_dot",), torch.tensor([[3.0, 0.0, 0.0]]), torch.tensor([1.0, 0.0, 0.0])
    )
    second = ForceCorrection(
        ("u|u|", "v"), torch.tensor([[0.0, 2.0, 0.0], [0.0, 0.0, 5.0]]), torch.zeros(3)
    )
    base = ForceModel(hull("milliampere").hull)
    chain = base.with_correction(first).with_correction(
        second, torch.tensor([200.0, 100.0], dtype=torch.float64)
    )
    extra = torch.stack((3 * nu_dot[:, 0] + 1, 2 * nu[:, 0] * nu[:, 0].abs(), 5 * nu[:, 1]), dim=-1)
    torch.testing.assert_close(chain(nu_dot, nu) - base(nu_dot, nu), extra)
    psi = torch.full((len(nu),), torch.pi / 2, dtype=torch.float64)
    # heading east: a force to the north pushes to port, one to the east pushes forward; the
    # thrusters hold against both
    against = chain.thruster_force(nu_dot, nu, psi) - chain(nu_dot, nu)
    torch.testing.assert_close(
        against, torch.tensor([-100.0, 200.0, 0.0], dtype=torch.float64).expand(len(nu), 3)
    )
    torch.testing.assert_close(
        chain.force_residual(against + chain(nu_dot, nu), nu_dot, nu, psi),
        torch.zeros(len(nu), 3, dtype=torch.float64),
    )


@pytest.mark.parametrize(
    ("term", "value", "error", "message"),
    [
        ("u_dot", -2400.0, FitError, "cannot be solved"),
        ("u_dot", -2389.65, FitError, "condition"),
        ("u_dot u", 0.0, ConfigError, "only be a term by itself"),
        ("u_dot^2", 0.0, ConfigError, "only be a term by itself"),
        ("|v_dot|", 0.0, ConfigError, "only be a term by itself"),
    ],
)
def test_what_cannot_run_forward_is_refused(
    term: str, value: float, error: type[Exception], message: str
) -> None:
    coefficients = torch.tensor([[value, 0.0, 0.0]], dtype=torch.float64)
    with pytest.raises(error, match=message):
        augment_mass(hull("milliampere").hull.mass, (term,), coefficients, "model plsr")


def test_constant_columns_are_named() -> None:
    x = torch.stack((torch.linspace(0, 1, 20), torch.full((20,), 3.0)), dim=1).double()
    with pytest.raises(FitError, match=r"'v' is constant"):
        weighted_column_std(("u", "v"), x)
    torch.testing.assert_close(
        weighted_column_std(("u^2", "v"), x + torch.rand(20, 2)) / (x.std(0) + 1) > 0,
        torch.tensor([True, True]),
    )
