"""Kernel ridge regression against scikit-learn and explicit refits; Nystroem's method against its
textbook form.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from made_samples import NAMES, channels, made, sampled
from sklearn.kernel_ridge import KernelRidge
from sklearn.metrics.pairwise import rbf_kernel

from residnet.core.errors import ConfigError, FitError
from residnet.heads.kernel import KernelConfig, KernelHead
from residnet.regression.kernel import Polynomial, Rbf, spread_out

SAMPLES = made(300)
NEW = torch.from_numpy(channels(200, seed=9))


def fitted(
    kernel: Rbf | Polynomial, penalties: tuple[float, ...], choose: Any = "one_step", folds: int = 5
) -> tuple[KernelHead, dict[str, Any]]:
    head = KernelConfig(
        kernel=kernel, penalties=penalties, choose=choose, folds=folds, margin=1.0
    ).build(NAMES)
    head.calibrate(SAMPLES)
    return head, head.solve(SAMPLES)


def answer(head: KernelHead, z: torch.Tensor) -> np.ndarray:
    with torch.no_grad():
        return head(z, z[:, :0])[0].numpy()  # type: ignore[no-any-return]


def standardised(z: torch.Tensor) -> np.ndarray:
    x, own = z.numpy(), SAMPLES.z.numpy()
    reach = own.max(0) - own.min(0)
    kept: np.ndarray = np.clip(x, own.min(0) - reach, own.max(0) + reach)
    return (kept - own.mean(0)) / own.std(0)


@pytest.mark.parametrize(("sigma", "penalty"), [(1.0, 1e-3), (10.0, 1e-5), (100.0, 1e-1)])
def test_radial_basis_functions_equal_scikit_learn(sigma: float, penalty: float) -> None:
    head, notes = fitted(Rbf(sigma=(sigma,)), (penalty,))
    truth = KernelRidge(kernel="rbf", gamma=1 / (2 * sigma), alpha=penalty * len(SAMPLES))
    check(head, truth)
    size = np.abs(truth.dual_coef_).max()
    np.testing.assert_allclose(head.kernel.coefficients, truth.dual_coef_, atol=1e-10 * size)
    gram = rbf_kernel(standardised(SAMPLES.z), gamma=1 / (2 * sigma))
    freedom = np.trace(gram @ np.linalg.inv(gram + penalty * len(SAMPLES) * np.eye(len(SAMPLES))))
    assert notes["effective_parameters"] == pytest.approx([freedom] * 3, rel=1e-8)


@pytest.mark.parametrize(
    ("degree", "slope", "constant", "penalty"),
    [(1, 1.0, 1.0, 1e-1), (3, 0.5, 2.0, 1e-3), (2, 0.3, 0.0, 1e-5)],
)
def test_polynomials_equal_scikit_learn(
    degree: int, slope: float, constant: float, penalty: float
) -> None:
    head, _ = fitted(Polynomial(degree=degree, slope=slope, constant=constant), (penalty,))
    settings = {"degree": degree, "gamma": slope, "coef0": constant}
    check(head, KernelRidge(kernel="poly", alpha=penalty * len(SAMPLES), **settings))


def check(head: KernelHead, truth: KernelRidge) -> None:
    truth.fit(standardised(SAMPLES.z), SAMPLES.target.numpy())
    for z in (SAMPLES.z, NEW):
        np.testing.assert_allclose(answer(head, z), truth.predict(standardised(z)), atol=1e-10)


@pytest.mark.parametrize(
    "kernel",
    [Rbf(sigma=(3.0, 30.0)), Rbf(sigma=(3.0, 30.0), exact=100, landmarks=80), Polynomial(degree=2)],
)
def test_cross_validation_equals_explicit_refits(kernel: Rbf | Polynomial) -> None:
    penalties = (1e-6, 1e-3, 0.3)
    head, notes = fitted(kernel, penalties, folds=4)
    x, y = standardised(SAMPLES.z), SAMPLES.target.numpy()
    fold = np.unique(SAMPLES.group.numpy(), return_inverse=True)[1] % 4
    for i, found in enumerate(notes["cross_validated_error"]):
        error = np.zeros((3, 3))
        for f in range(4):
            own, rest = fold == f, fold != f
            for j, penalty in enumerate(penalties):
                predict = refitted(head, kernel, i, x[rest], y[rest], penalty * len(x))
                error[j] += ((predict(x[own]) - y[own]) ** 2).sum(0)
        np.testing.assert_allclose(found, error / len(x), rtol=1e-7)


def refitted(
    head: KernelHead, kernel: Any, setting: int, x: np.ndarray, y: np.ndarray, alpha: float
) -> Callable[[np.ndarray], np.ndarray]:
    if isinstance(kernel, Polynomial):
        poly = KernelRidge(kernel="poly", degree=kernel.degree, gamma=1, coef0=1, alpha=alpha)
        return poly.fit(x, y).predict  # type: ignore[no-any-return]
    gamma = 1 / (2 * kernel.sigma[setting])
    if len(SAMPLES) <= kernel.exact:
        radial = KernelRidge(kernel="rbf", gamma=gamma, alpha=alpha)
        return radial.fit(x, y).predict  # type: ignore[no-any-return]
    points = head.kernel.points.numpy()  # type: ignore[operator, union-attr]
    wide, own = rbf_kernel(x, points, gamma), rbf_kernel(points, gamma=gamma)
    # min |y - wide c|^2 + alpha c' own c, stacked: the normal equations would lose half the digits
    values, vectors = np.linalg.eigh(own)
    root = np.sqrt(alpha * values.clip(0))[:, None] * vectors.T
    target = np.concatenate((y, np.zeros((len(points), 3))))
    coefficients = np.linalg.lstsq(np.concatenate((wide, root)), target, rcond=None)[0]
    return lambda new: rbf_kernel(new, points, gamma) @ coefficients  # type: ignore[no-any-return]


def test_landmarks_that_are_all_samples_give_the_exact_fit() -> None:
    exact, _ = fitted(Rbf(sigma=(10.0,)), (1e-4,))
    landmarks, _ = fitted(Rbf(sigma=(10.0,), exact=1, landmarks=300), (1e-4,))
    assert len(landmarks.kernel.points) == 300  # type: ignore[arg-type]
    np.testing.assert_allclose(answer(landmarks, NEW), answer(exact, NEW), atol=1e-7)
    few, _ = fitted(Rbf(sigma=(10.0,), exact=1, landmarks=80), (1e-4,))
    assert len(few.kernel.points) == 80  # type: ignore[arg-type]
    apart = answer(few, NEW) - answer(exact, NEW)
    assert np.sqrt(np.mean(apart**2)) < 0.05 * answer(exact, NEW).std()


def test_landmarks_lie_apart_and_are_repeatable() -> None:
    x = torch.cat((torch.zeros(500, 2, dtype=torch.float64), torch.eye(2, dtype=torch.float64) * 3))
    chosen = spread_out(x, 10, seed=4)
    assert torch.equal(chosen, spread_out(x, 10, seed=4))
    # three different values and no more
    assert len(torch.unique(x[chosen], dim=0)) == len(chosen) == 3


def test_each_axis_takes_its_own_setting_by_one_step_errors() -> None:
    target, sigmas, penalties = SAMPLES.target.clone(), (0.3, 30.0), (1e-6, 10.0)
    noise = torch.Generator().manual_seed(0)
    target[:, 1] = torch.randn(len(SAMPLES), generator=noise, dtype=torch.float64)
    head = KernelConfig(kernel=Rbf(sigma=sigmas), penalties=penalties, choose="one_step")
    built = head.build(NAMES)
    built.calibrate(SAMPLES)
    (only,) = built.solutions(SAMPLES.with_target(target))
    assert only.choice["penalty"][:2] == [1e-6, 10.0]
    assert only.choice["sigma"][0] == 30.0
    error = np.array(only.notes["cross_validated_error"])
    for axis, (sigma, penalty) in enumerate(
        zip(only.choice["sigma"], only.choice["penalty"], strict=True)
    ):
        i, j = sigmas.index(sigma), penalties.index(penalty)
        assert error[i, j, axis] == error[..., axis].min()


def test_free_runs_are_offered_joint_settings_then_single_steps_around_the_best() -> None:
    head = KernelConfig(kernel=Rbf(sigma=(3.0, 30.0)), penalties=(1e-6, 1e-4, 1e-2)).build(NAMES)
    head.calibrate(SAMPLES)
    found = head.solutions(SAMPLES)
    joint = [(s, p) for s in (3.0, 30.0) for p in (1e-6, 1e-4, 1e-2)]
    assert [(s.choice["sigma"], s.choice["penalty"]) for s in found[1:-1]] == [
        ([s] * 3, [p] * 3) for s, p in joint
    ]
    head.load_state_dict(found[-1].state, strict=False)
    assert found[-1].choice == {"penalty": []}
    assert np.abs(answer(head, NEW)).max() == 0.0
    assert found[5].neighbours is not None
    near = list(found[5].neighbours())
    assert {tuple(s.choice["penalty"]) for s in near} == {
        tuple(p if axis == k else 1e-4 for k in range(3)) for axis in range(3) for p in (1e-6, 1e-2)
    }
    assert all(s.choice["sigma"] == [30.0] * 3 for s in near)
    # the axes whose penalty stays answer as before
    head.load_state_dict(found[5].state, strict=False)
    before = answer(head, NEW)
    for solution in near:
        head.load_state_dict(solution.state, strict=False)
        changed = np.abs(answer(head, NEW) - before).max(0) > 1e-12
        assert changed.tolist() == [p != 1e-4 for p in solution.choice["penalty"]]


def test_terms_are_features_too() -> None:
    first, second = NAMES[0], NAMES[1]
    terms = (f"{first}|{first}|", f"{first} {second}")
    head = KernelConfig(
        kernel=Polynomial(), penalties=(1e-3,), choose="one_step", terms=terms, margin=1.0
    ).build(NAMES)
    head.calibrate(SAMPLES)
    head.solve(SAMPLES)
    low, high = SAMPLES.z.numpy().min(0), SAMPLES.z.numpy().max(0)

    def columns(z: torch.Tensor) -> np.ndarray:
        x = np.clip(z.numpy(), 2 * low - high, 2 * high - low)
        return np.column_stack((x, x[:, 0] * np.abs(x[:, 0]), x[:, 0] * x[:, 1]))

    own = columns(SAMPLES.z)
    truth = KernelRidge(kernel="poly", degree=2, gamma=1.0, coef0=1.0, alpha=1e-3 * len(SAMPLES))
    truth.fit((own - own.mean(0)) / own.std(0), SAMPLES.target.numpy())
    np.testing.assert_allclose(
        answer(head, NEW), truth.predict((columns(NEW) - own.mean(0)) / own.std(0)), atol=1e-10
    )


def test_terms_that_say_nothing_are_refused() -> None:
    head = KernelConfig(terms=("1",)).build(NAMES)
    with pytest.raises(FitError, match="'1' is constant"):
        head.calibrate(SAMPLES)
    with pytest.raises(ConfigError, match="torque"):
        KernelConfig(terms=("torque^2",)).build(NAMES)


def test_recursion_is_a_free_run_of_one_velocity() -> None:
    """Against a loop over single samples, with scikit-learn's own fits."""
    random, step, names = np.random.default_rng(3), 0.2, ("u", "v", "r", "n")
    z, rates = np.zeros((60, 4)), np.zeros((60, 3))
    z[:, 3] = random.normal(size=60)
    for k in range(59):
        rates[k] = [
            -0.3 * z[k, 0] + z[k, 3],
            -0.5 * z[k, 1] + 0.2 * z[k, 0],
            -z[k, 2] + 0.4 * z[k, 1],
        ] + 0.05 * random.normal(size=3)
        z[k + 1, :3] = z[k, :3] + step * rates[k]
    t = step * np.concatenate((np.arange(30), np.arange(30)))
    made_here = sampled(z, rates, names, groups=2, t=t)
    penalties = (1e-3, 1.0)
    head = KernelConfig(
        kernel=Rbf(sigma=(2.0, 20.0)),
        penalties=penalties,
        choose="recursion",
        folds=2,
        margin=100.0,
    ).build(names)
    head.calibrate(made_here)
    notes = head.solve(made_here)
    mean, std = z.mean(0), z.std(0)
    for i, sigma in enumerate((2.0, 20.0)):
        for j, penalty in enumerate(penalties):
            model = KernelRidge(kernel="rbf", gamma=1 / (2 * sigma), alpha=penalty * 60).fit(
                (z - mean) / std, rates
            )
            for axis in range(3):
                errors = []
                for start in (0, 30):
                    x = z[start, axis]
                    for k in range(start, start + 29):
                        own = z[k].copy()
                        own[axis] = x
                        x = x + step * model.predict(((own - mean) / std)[None])[0, axis]
                        errors.append((x - z[k + 1, axis]) ** 2)
                assert notes["recursion_error"][i][j][axis] == pytest.approx(
                    np.mean(errors), rel=1e-6
                )
    flat = np.array(notes["recursion_error"]).reshape(4, 3).argmin(0)
    assert notes["penalty"] == [penalties[k % 2] for k in flat]
