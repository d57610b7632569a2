"""Offsets of logs: the arrow of normal equations against the dense matrix, the spread against the
marginal likelihood by SciPy.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from residnet.training.offsets import Arrow, Offsets, OffsetsConfig, with_spread

P, LOGS = 4, 6


def offsets_of(spread: list[float], logs: int = LOGS, **config: Any) -> Offsets:
    """All zero, in sway and yaw; spreads estimated from a start, unless the config gives them."""
    settings = OffsetsConfig.model_validate(config or {"v": "estimated", "r": "estimated"})
    return Offsets.begin(settings, logs, torch.tensor([0.0, *spread], dtype=torch.float64), 0.9)


def arrow_and_dense(seed: int) -> tuple[Arrow, np.ndarray, np.ndarray]:
    """An arrow, and the same matrix [P + 2L, P + 2L] and right side written out."""
    random = np.random.default_rng(seed)
    size = P + 2 * LOGS
    matrix, right = np.zeros((size, size)), random.normal(size=size)
    for log in range(LOGS):
        here = [*range(P), P + 2 * log, P + 2 * log + 1]
        rows = random.normal(size=(9, P + 2))
        matrix[np.ix_(here, here)] += rows.T @ rows
    mixed = matrix[:P, P:].reshape(P, LOGS, 2).transpose(1, 0, 2)
    blocks = np.stack(
        [matrix[P + 2 * i : P + 2 * i + 2, P + 2 * i : P + 2 * i + 2] for i in range(LOGS)]
    )
    parts = (matrix[:P, :P], mixed, blocks, right[:P], right[P:].reshape(LOGS, 2))
    return Arrow(*(torch.from_numpy(np.array(part)) for part in parts)), matrix, right


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_an_arrow_is_solved_as_the_whole_matrix(damping: float) -> None:
    arrow, matrix, right = arrow_and_dense(1)
    expected = np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), right)
    shared, blocks = arrow.damped(damping).solve()
    np.testing.assert_allclose(shared.numpy(), expected[:P], rtol=1e-9)
    np.testing.assert_allclose(blocks.flatten().numpy(), expected[P:], rtol=1e-9)


def test_its_inverse_is_that_of_the_whole_matrix() -> None:
    arrow, matrix, _ = arrow_and_dense(2)
    inverse = np.linalg.inv(matrix)
    shared = torch.linalg.inv(arrow.reduced()[0])
    np.testing.assert_allclose(shared.numpy(), inverse[:P, :P], rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(
        arrow.variances(shared).flatten().numpy(), np.diag(inverse)[P:], rtol=1e-8
    )


def test_beliefs_add_their_precision_and_pull_to_zero() -> None:
    arrow, matrix, right = arrow_and_dense(3)
    value = torch.from_numpy(np.random.default_rng(4).normal(size=(LOGS, 2)))
    offsets = offsets_of([0.0, 0.0], v=0.5, r=0.2).moved(-value)
    precision = np.tile([0.7 / 0.25, 0.7 / 0.04], LOGS)
    expected = np.linalg.solve(
        matrix + np.diag(np.r_[np.zeros(P), precision]),
        right + np.r_[np.zeros(P), precision * value.flatten().numpy()],
    )
    shared, blocks = arrow.believing(offsets, torch.tensor(0.7, dtype=torch.float64)).solve()
    np.testing.assert_allclose(np.r_[shared.numpy(), blocks.flatten().numpy()], expected, rtol=1e-9)
    assert float(offsets.unlikely()) == pytest.approx(
        float((value / torch.tensor([0.5, 0.2])).square().sum())
    )


def test_without_offsets_the_shared_part_is_left_alone() -> None:
    arrow = arrow_and_dense(5)[0]
    none = Offsets.begin(None, LOGS, torch.zeros(3, dtype=torch.float64), 0.9)
    bare = Arrow(
        arrow.shared,
        arrow.mixed[:, :, :0],
        arrow.blocks[:, :0, :0],
        arrow.gradient,
        arrow.slope[:, :0],
    )
    step, blocks = with_and_believing(bare, none).solve()
    assert torch.equal(step, torch.linalg.solve(arrow.shared, arrow.gradient))
    assert blocks.shape == (LOGS, 0)
    assert torch.equal(none.accelerations(), torch.zeros(LOGS, 3, dtype=torch.float64))
    assert none.table(["log"] * LOGS) == []


def with_and_believing(arrow: Arrow, offsets: Offsets) -> Arrow:
    share = torch.tensor(0.1, dtype=torch.float64)
    assert with_spread(offsets, arrow, share) is offsets
    return arrow.believing(offsets, share)


def test_the_spread_is_the_most_likely() -> None:
    """Measurements y = X theta + Z c + e of known sigma: the likelihood with theta and c integrated
    out is a normal one, maximised by SciPy.
    """
    random, sigma, wide, planted, count = (
        np.random.default_rng(6),
        0.3,
        3.0,
        np.array([0.8, 0.1]),
        10,
    )
    logs = 12
    x, z = random.normal(size=(logs, count, P)), random.normal(size=(logs, count, 2))
    y = (
        (z @ (random.normal(size=(logs, 2)) * planted)[:, :, None])[:, :, 0]
        + x @ random.normal(size=P)
        + sigma * random.normal(size=(logs, count))
    )
    flat = x.reshape(-1, P)

    def unlikely(log_spread: np.ndarray) -> float:
        blocks = [z[i] @ np.diag(np.exp(2 * log_spread)) @ z[i].T for i in range(logs)]
        covariance = sigma**2 * np.eye(logs * count) + wide**2 * flat @ flat.T
        for i, block in enumerate(blocks):
            covariance[i * count : (i + 1) * count, i * count : (i + 1) * count] += block
        return -float(multivariate_normal(cov=covariance).logpdf(y.flatten()))

    best = np.exp(
        minimize(
            unlikely,
            np.log([0.3, 0.3]),
            method="Nelder-Mead",
            options={"xatol": 1e-5, "fatol": 1e-8},
        ).x
    )
    parts = (
        flat.T @ flat + sigma**2 / wide**2 * np.eye(P),
        x.transpose(0, 2, 1) @ z,
        z.transpose(0, 2, 1) @ z,
        -flat.T @ y.flatten(),
        -(z.transpose(0, 2, 1) @ y[:, :, None])[:, :, 0],
    )
    arrow, share = (
        Arrow(*(torch.from_numpy(np.ascontiguousarray(part)) for part in parts)),
        torch.tensor(sigma**2, dtype=torch.float64),
    )
    found = with_spread(offsets_of([0.3, 0.3], logs), arrow, share)
    np.testing.assert_allclose(found.spread.numpy(), best, rtol=0.03)
    # a spread that is given stays
    half = with_spread(offsets_of([0.3, 0.3], logs, v="estimated", r=0.05), arrow, share)
    assert float(half.spread[1]) == 0.05
    assert float(half.spread[0]) == pytest.approx(best[0], rel=0.1)


def test_table_names_logs_axes_and_units_of_si() -> None:
    offsets = offsets_of([0.0, 0.0], 2, u="2 m/s^2", r="1 deg/s^2").moved(
        torch.tensor([[1.0, 2.0], [3.0, 4.0]], dtype=torch.float64)
    )
    rows = offsets.table(["a", "b"])
    assert [(row["log"], row["axis"], row["value"]) for row in rows] == [
        ("a", "u_dot", -1.0),
        ("a", "r_dot", -2.0),
        ("b", "u_dot", -3.0),
        ("b", "r_dot", -4.0),
    ]
    assert rows[1]["spread"] == pytest.approx(np.pi / 180)
    assert rows[1]["speed"] == 0.9
    assert offsets.accelerations().tolist() == [[-1.0, 0.0, -2.0], [-3.0, 0.0, -4.0]]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "for at least one of u, v, r"),
        ({"r": "1 m/s"}, r"rad/s\^2"),
        ({"v": 0.0}, "greater than 0"),
        ({"r": "some"}, "estimated"),
    ],
)
def test_what_is_wrong_is_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        OffsetsConfig.model_validate(given)
