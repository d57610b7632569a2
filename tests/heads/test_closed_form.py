"""Heads that are solved, not trained: PLSR, ridge, kernel ridge and pipelines of scikit-learn,
against scikit-learn's own fits and explicit refits, and what they refuse.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from made_samples import NAMES, channels, made, sampled
from sklearn.cross_decomposition import PLSRegression
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import Ridge
from sklearn.metrics.pairwise import rbf_kernel
from sklearn.pipeline import make_pipeline

from residnet.core.config import validate_config
from residnet.core.errors import ConfigError, ExportError, FitError
from residnet.core.samples import Samples
from residnet.export.vessel import ExportedVessel
from residnet.heads import scikit
from residnet.heads.base import Features
from residnet.heads.kernel_config import KernelConfig
from residnet.heads.linear import PlsrConfig, RidgeConfig
from residnet.heads.scikit_config import SklearnConfig
from residnet.regression.kernel import kmeans_plus_plus_indices
from residnet.regression.kernel_config import PolynomialConfig, RbfConfig
from residnet.regression.shrinkage import pls_path
from residnet.testing.checks import make_example_model, make_example_spec

SAMPLES = made(300)
NEW = torch.from_numpy(channels(200, seed=9))
NOISE = torch.randn(300, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
TARGET = SAMPLES.target.clone()
TARGET[:, 1] = NOISE
# of one axis nothing can be learned: it takes settings of its own
MIXED = SAMPLES.with_target(TARGET)
FOLD = np.unique(SAMPLES.group.numpy(), return_inverse=True)[1] % 4


def calibrated(config: Any, samples: Samples = SAMPLES) -> Any:
    head = config.build(samples.names)
    head.calibrate(samples)
    return head


def answer(head: Any, z: torch.Tensor = SAMPLES.z) -> np.ndarray:
    with torch.no_grad():
        return np.asarray(head(z, z[:, :0])[0])


def test_guard_holds_features_at_the_widened_range() -> None:
    samples = made()
    features = Features(("r", "u"), NAMES, margin=0.25)
    features.calibrate(samples)
    low = samples.z.amin(0)[[2, 0]]
    high = samples.z.amax(0)[[2, 0]]
    reach = 0.25 * (high - low)
    inside = samples.z[:5]
    assert torch.equal(features.select_clamped(inside), inside[:, [2, 0]])
    far = torch.full((1, 5), 1e9, dtype=torch.float64)
    torch.testing.assert_close(features.select_clamped(far)[0], high + reach)
    torch.testing.assert_close(features.select_clamped(-far)[0], low - reach)
    out = features(samples.z)
    torch.testing.assert_close(out.mean(0), torch.zeros(2, dtype=torch.float64), rtol=0, atol=1e-12)
    torch.testing.assert_close(out.std(0, correction=0), torch.ones(2, dtype=torch.float64))
    # a constant feature is left unscaled
    z = samples.z.clone()
    z[:, 3] = 400.0
    still = Features(("tau_x",), NAMES, margin=0.1)
    still.calibrate(replace(samples, z=z))
    assert still(z).abs().max() == 0
    assert bool(torch.isfinite(still(z + 1)).all())


def refitted(config: Any, setting: float, x: np.ndarray, y: np.ndarray, count: int) -> Any:
    """Scikit-learn's predictions: columns of X scaled to unit variance, those of Y centred."""
    if isinstance(config, PlsrConfig):
        scale = x.std(0, ddof=1)
        model: Any = PLSRegression(int(setting), scale=False, tol=1e-28, max_iter=10_000)
    else:
        scale = x.std(0)
        model = Ridge(alpha=setting * count, solver="svd")
    model.fit(x / scale, y)
    return lambda new: model.predict(new / scale)


@pytest.mark.parametrize(
    ("config", "settings"),
    [
        (PlsrConfig(folds=4, max_order=6), range(1, 7)),
        (RidgeConfig(folds=4, penalties=(1e-6, 1e-3, 0.3, 100.0)), (1e-6, 1e-3, 0.3, 100.0)),
    ],
)
def test_cross_validation_of_linear_heads_equals_explicit_refits(
    config: Any, settings: Any
) -> None:
    head = calibrated(config, MIXED)
    notes = head.fit_preferred(MIXED)
    x, y = head.basis_functions(MIXED.z).numpy(), MIXED.target.numpy()
    error = np.zeros((len(settings), 3))
    for f in range(4):
        own = np.equal(FOLD, f)
        rest = np.not_equal(FOLD, f)
        for i, setting in enumerate(settings):
            predict = refitted(config, setting, x[rest], y[rest], rest.sum())
            error[i] += ((predict(x[own]) - y[own]) ** 2).sum(0) / len(x)
    if isinstance(config, PlsrConfig):
        share = (error / y.var(0)).mean(1)
        np.testing.assert_allclose(notes["cross_validated_share"], share, rtol=1e-7)
        assert notes["order"] == int(np.argmin(share)) + 1
    else:
        np.testing.assert_allclose(notes["cross_validated_error"], error, rtol=1e-9)
        assert notes["penalty"] == [settings[i] for i in error.argmin(0)]
        assert notes["penalty"][1] == 100.0 > notes["penalty"][0]


def test_free_runs_are_offered_every_order_and_none() -> None:
    """First the cross-validated order, then orders from one to the highest, each scikit-learn's,
    and a residual of zero.
    """
    config = PlsrConfig()
    head = calibrated(config)
    found = head.fit_solutions(SAMPLES)
    orders = [solution.hyperparameters["order"] for solution in found]
    assert orders[0] == int(np.argmin(found[0].notes["cross_validated_share"])) + 1
    assert orders[1:9] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert orders[-2:] == [23, 0]
    x, y = head.basis_functions(SAMPLES.z).numpy(), SAMPLES.target.numpy()
    for solution, order in [*zip(found, orders, strict=True)][:9]:
        head.load_state_dict(solution.state, strict=False)
        truth = refitted(config, order, x, y, len(x))(x)
        np.testing.assert_allclose(answer(head), truth, atol=1e-8 * y.std())
    head.load_state_dict(found[-1].state, strict=False)
    assert not answer(head).any()
    assert calibrated(PlsrConfig(order=100)).fit_preferred(SAMPLES)["order"] == 23
    for single in (PlsrConfig(order=3), PlsrConfig(choose="one_step")):
        assert len(calibrated(single).fit_solutions(SAMPLES)) == 1


def test_free_runs_are_offered_one_penalty_for_all_axes_and_none() -> None:
    penalties = (1e-6, 1e-2, 1.0)
    config = RidgeConfig(penalties=penalties)
    head = calibrated(config)
    found = head.fit_solutions(SAMPLES)
    offered = [solution.hyperparameters["penalty"] for solution in found[1:]]
    assert offered == [*([penalty] * 3 for penalty in penalties), []]
    x, y = head.basis_functions(SAMPLES.z).numpy(), SAMPLES.target.numpy()
    for solution, penalty in zip(found[1:], penalties, strict=False):
        head.load_state_dict(solution.state, strict=False)
        truth = refitted(config, penalty, x, y, len(x))(x)
        np.testing.assert_allclose(answer(head), truth, atol=1e-10)
    (single,) = calibrated(RidgeConfig(penalties=penalties, choose="one_step")).fit_solutions(
        SAMPLES
    )
    assert single.hyperparameters == found[0].hyperparameters


@pytest.mark.parametrize("kind", [PlsrConfig, RidgeConfig, KernelConfig])
def test_few_manoeuvres_make_fewer_folds_unless_they_are_named(kind: Any) -> None:
    few = SAMPLES.select(SAMPLES.group < 3)
    usual, three, five = (
        calibrated(config, few) for config in (kind(), kind(folds=3), kind(folds=5))
    )
    for head in (usual, three):
        head.fit_preferred(few)
    for name, value in three.state_dict().items():
        torch.testing.assert_close(usual.state_dict()[name], value, rtol=0, atol=0)
    with pytest.raises(FitError, match=r"5 folds need .* have 3; lower `folds`"):
        five.fit_preferred(few)


def test_named_terms_and_features_and_a_residual_of_nothing() -> None:
    head = calibrated(PlsrConfig(features=("u", "r"), terms=("u|u|", "u r", "r|r|"), order=3))
    u, r = (SAMPLES.z[:, i] / SAMPLES.z[:, i].std(correction=0) for i in (0, 2))
    wanted = torch.stack((u * u.abs(), u * r, r * r.abs()), dim=1)
    np.testing.assert_allclose(head.basis_functions(SAMPLES.z), wanted, rtol=1e-12)
    assert list(head.library.terms) == ["u|u|", "u r", "r|r|"]
    head = calibrated(PlsrConfig())
    notes = head.fit_preferred(SAMPLES.with_target(torch.zeros_like(SAMPLES.target)))
    assert notes["order"] == 0
    assert not answer(head).any()


def test_a_rank_deficient_basis_ends_the_path_early() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(100, 3)) @ rng.normal(size=(3, 6))
    y = rng.normal(size=(100, 2))
    x, y = x - x.mean(0), y - y.mean(0)
    path = pls_path(torch.from_numpy(x.T @ x), torch.from_numpy(x.T @ y), 6).numpy()
    assert 3 <= len(path) <= 6
    wanted = x @ np.linalg.lstsq(x, y, rcond=None)[0]
    np.testing.assert_allclose(x @ path[2], wanted, atol=1e-9)
    np.testing.assert_allclose(x @ path[-1], wanted, atol=1e-6)


@pytest.mark.parametrize("kind", [PlsrConfig, RidgeConfig])
def test_columns_that_say_nothing_get_nothing(kind: Any) -> None:
    """A constant and a doubled column: no coefficient for the one, the same prediction without the
    other; NaN and few samples are errors.
    """
    random = torch.Generator().manual_seed(1)
    z = torch.randn(400, 5, generator=random, dtype=torch.float64)
    z[:, 3] = 0.1
    target = z[:, :3] @ torch.randn(3, 3, generator=random, dtype=torch.float64)
    of = sampled(z, target, NAMES, groups=10)

    def solved(terms: tuple[str, ...], samples: Samples = of) -> tuple[Any, np.ndarray]:
        head = calibrated(kind(terms=terms, choose="one_step"), samples)
        head.fit_preferred(samples)
        return head, answer(head, samples.z)

    _, plain = solved(("u", "v", "r"))
    head, with_constant = solved(("u", "v", "r", "tau_x", "tau_x^2"))
    assert not bool(head.coefficients[3:].any())
    np.testing.assert_allclose(with_constant, plain, rtol=0, atol=1e-6)
    head, doubled = solved(("u", "v", "r", "u v", "v u"))
    assert float(head.coefficients.abs().max()) < 10
    np.testing.assert_allclose(doubled, plain, rtol=0, atol=1e-5)
    spoiled = z.clone()
    spoiled[7, 0] = torch.nan
    with pytest.raises(FitError, match="channel 'u' is not finite at sample 7"):
        solved(("v", "u"), replace(of, z=spoiled))
    with pytest.raises(FitError, match="10 samples do not determine 23 basis functions"):
        solved((), of.select(torch.arange(400) % 40 == 0))
    with pytest.raises(FitError, match="at least two runs"):
        solved(("u",), sampled(z, target, NAMES))


def kernel(form: RbfConfig | PolynomialConfig, *penalties: float, **settings: Any) -> Any:
    fixed: dict[str, Any] = {"choose": "one_step", "margin": 1.0}
    return KernelConfig(kernel=form, penalties=penalties, **(fixed | settings))


def standardised(z: torch.Tensor, own: torch.Tensor = SAMPLES.z) -> np.ndarray:
    """Channels held at the widened range, and two terms of them."""
    low = own.amin(0)
    high = own.amax(0)
    x, known = (part.clamp(2 * low - high, 2 * high - low).numpy() for part in (z, own))
    return (x - known.mean(0)) / known.std(0)  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("form", "penalty"),
    [
        (RbfConfig(sigma=(1.0,)), 1e-3),
        (RbfConfig(sigma=(10.0,)), 1e-5),
        (RbfConfig(sigma=(100.0,)), 1e-1),
        (PolynomialConfig(degree=1, slope=1.0, constant=1.0), 1e-1),
        (PolynomialConfig(degree=3, slope=0.5, constant=2.0), 1e-3),
        (PolynomialConfig(degree=2, slope=0.3, constant=0.0), 1e-5),
    ],
)
def test_kernel_ridge_equals_scikit_learn(
    form: RbfConfig | PolynomialConfig, penalty: float
) -> None:
    head = calibrated(kernel(form, penalty))
    notes = head.fit_preferred(SAMPLES)
    alpha = penalty * len(SAMPLES)
    x = standardised(SAMPLES.z)
    if isinstance(form, RbfConfig):
        gamma = 1 / (2 * form.sigma[0])
        truth = KernelRidge(kernel="rbf", gamma=gamma, alpha=alpha).fit(x, SAMPLES.target.numpy())
        size = np.abs(truth.dual_coef_).max()
        np.testing.assert_allclose(head.kernel.coefficients, truth.dual_coef_, atol=1e-10 * size)
        gram = rbf_kernel(x, gamma=gamma)
        freedom = np.trace(gram @ np.linalg.inv(gram + alpha * np.eye(len(x))))
        assert notes["effective_parameters"] == pytest.approx([freedom] * 3, rel=1e-8)
    else:
        settings = {"degree": form.degree, "gamma": form.slope, "coef0": form.constant}
        truth = KernelRidge(kernel="poly", alpha=alpha, **settings).fit(x, SAMPLES.target.numpy())
    for z in (SAMPLES.z, NEW):
        np.testing.assert_allclose(answer(head, z), truth.predict(standardised(z)), atol=1e-10)


def test_terms_are_features_too() -> None:
    head = calibrated(kernel(PolynomialConfig(), 1e-3, terms=("u|u|", "u v")))
    head.fit_preferred(SAMPLES)
    low = SAMPLES.z.numpy().min(0)
    high = SAMPLES.z.numpy().max(0)

    def columns(z: torch.Tensor) -> np.ndarray:
        x = np.clip(z.numpy(), 2 * low - high, 2 * high - low)
        return np.column_stack((x, x[:, 0] * np.abs(x[:, 0]), x[:, 0] * x[:, 1]))

    own = columns(SAMPLES.z)
    truth = KernelRidge(kernel="poly", degree=2, gamma=1.0, coef0=1.0, alpha=1e-3 * len(SAMPLES))
    truth.fit((own - own.mean(0)) / own.std(0), SAMPLES.target.numpy())
    wanted = truth.predict((columns(NEW) - own.mean(0)) / own.std(0))
    np.testing.assert_allclose(answer(head, NEW), wanted, atol=1e-10)
    with pytest.raises(FitError, match="'1' is constant"):
        calibrated(KernelConfig(terms=("1",)))
    with pytest.raises(ConfigError, match="torque"):
        calibrated(KernelConfig(terms=("torque^2",)))


@pytest.mark.parametrize(
    "form",
    [
        RbfConfig(sigma=(3.0, 30.0)),
        RbfConfig(sigma=(3.0, 30.0), exact=100, landmarks=80),
        PolynomialConfig(degree=2),
    ],
)
def test_cross_validation_of_kernels_equals_explicit_refits(
    form: RbfConfig | PolynomialConfig,
) -> None:
    penalties = (1e-6, 1e-3, 10.0)
    head = calibrated(kernel(form, *penalties, folds=4), MIXED)
    (only,) = head.fit_solutions(MIXED)
    notes = head.fit_preferred(MIXED)
    x, y = standardised(MIXED.z), MIXED.target.numpy()
    errors = np.array(notes["cross_validated_error"])
    for i, found in enumerate(errors):
        error = np.zeros((3, 3))
        for f in range(4):
            own = np.equal(FOLD, f)
            rest = np.not_equal(FOLD, f)
            for j, penalty in enumerate(penalties):
                predict = kernel_refitted(head, form, i, x[rest], y[rest], penalty * len(x))
                error[j] += ((predict(x[own]) - y[own]) ** 2).sum(0)
        np.testing.assert_allclose(found, error / len(x), rtol=1e-7)
    # each axis takes its own setting
    best = [np.unravel_index(errors[..., axis].argmin(), errors.shape[:2]) for axis in range(3)]
    assert only.hyperparameters["penalty"] == [penalties[j] for _, j in best]
    assert only.hyperparameters["penalty"][1] == 10.0 > only.hyperparameters["penalty"][0]
    if isinstance(form, RbfConfig):
        assert only.hyperparameters["sigma"] == [form.sigma[i] for i, _ in best]


def kernel_refitted(
    head: Any, form: Any, setting: int, x: np.ndarray, y: np.ndarray, alpha: float
) -> Callable[[np.ndarray], np.ndarray]:
    if isinstance(form, PolynomialConfig):
        poly = KernelRidge(kernel="poly", degree=form.degree, gamma=1, coef0=1, alpha=alpha)
        return poly.fit(x, y).predict  # type: ignore[no-any-return]
    gamma = 1 / (2 * form.sigma[setting])
    if len(SAMPLES) <= form.exact:
        radial = KernelRidge(kernel="rbf", gamma=gamma, alpha=alpha)
        return radial.fit(x, y).predict  # type: ignore[no-any-return]
    points = head.kernel.points.numpy()
    wide = rbf_kernel(x, points, gamma)
    own = rbf_kernel(points, gamma=gamma)
    # min |y - wide c|^2 + alpha c' own c, stacked: the normal equations would lose half the digits
    values, vectors = np.linalg.eigh(own)
    root = np.sqrt(alpha * values.clip(0))[:, None] * vectors.T
    target = np.concatenate((y, np.zeros((len(points), 3))))
    coefficients = np.linalg.lstsq(np.concatenate((wide, root)), target, rcond=None)[0]
    return lambda new: rbf_kernel(new, points, gamma) @ coefficients  # type: ignore[no-any-return]


def test_landmarks_that_are_all_samples_give_the_exact_fit() -> None:
    forms = (
        RbfConfig(sigma=(10.0,)),
        RbfConfig(sigma=(10.0,), exact=1, landmarks=300),
        RbfConfig(sigma=(10.0,), exact=1, landmarks=80),
    )
    exact, all_of_them, few = (calibrated(kernel(form, 1e-4)) for form in forms)
    for head in (exact, all_of_them, few):
        head.fit_preferred(SAMPLES)
    assert (len(all_of_them.kernel.points), len(few.kernel.points)) == (300, 80)
    np.testing.assert_allclose(answer(all_of_them, NEW), answer(exact, NEW), atol=1e-7)
    apart = answer(few, NEW) - answer(exact, NEW)
    assert np.sqrt(np.mean(apart**2)) < 0.05 * answer(exact, NEW).std()
    # they lie apart and are repeatable: three different values and no more
    x = torch.cat((torch.zeros(500, 2), torch.eye(2) * 3)).double()
    chosen = kmeans_plus_plus_indices(x, 10, seed=4)
    assert torch.equal(chosen, kmeans_plus_plus_indices(x, 10, seed=4))
    assert len(torch.unique(x[chosen], dim=0)) == len(chosen) == 3


def test_free_runs_are_offered_joint_settings_then_single_steps_around_the_best() -> None:
    penalties = (1e-6, 1e-4, 1e-2)
    head = calibrated(KernelConfig(kernel=RbfConfig(sigma=(3.0, 30.0)), penalties=penalties))
    found = head.fit_solutions(SAMPLES)
    joint = [([s] * 3, [p] * 3) for s in (3.0, 30.0) for p in penalties]
    assert [
        (s.hyperparameters["sigma"], s.hyperparameters["penalty"]) for s in found[1:-1]
    ] == joint
    head.load_state_dict(found[-1].state, strict=False)
    assert found[-1].hyperparameters == {"penalty": []}
    assert np.abs(answer(head, NEW)).max() == 0.0
    assert found[5].neighbours is not None
    near = list(found[5].neighbours())
    assert {tuple(s.hyperparameters["penalty"]) for s in near} == {
        tuple(p if axis == k else 1e-4 for k in range(3)) for axis in range(3) for p in (1e-6, 1e-2)
    }
    assert all(s.hyperparameters["sigma"] == [30.0] * 3 for s in near)
    # the axes whose penalty stays answer as before
    head.load_state_dict(found[5].state, strict=False)
    before = answer(head, NEW)
    for solution in near:
        head.load_state_dict(solution.state, strict=False)
        changed = np.abs(answer(head, NEW) - before).max(0) > 1e-12
        assert changed.tolist() == [p != 1e-4 for p in solution.hyperparameters["penalty"]]


def test_recursion_is_a_free_run_of_one_velocity() -> None:
    """Against a loop over single samples, with scikit-learn's own fits."""
    random = np.random.default_rng(3)
    step = 0.2
    names = ("u", "v", "r", "n")
    a = np.array([[-0.3, 0, 0, 1], [0.2, -0.5, 0, 0], [0, 0.4, -1, 0]])
    z = np.zeros((60, 4))
    rates = np.zeros((60, 3))
    z[:, 3] = random.normal(size=60)
    for k in range(59):
        rates[k] = a @ z[k] + 0.05 * random.normal(size=3)
        z[k + 1, :3] = z[k, :3] + step * rates[k]
    t = step * np.concatenate((np.arange(30), np.arange(30)))
    known = sampled(z, rates, names, groups=2, t=t)
    sigmas = (2.0, 20.0)
    penalties = (1e-3, 1.0)
    settings = {"choose": "recursion", "folds": 2, "margin": 100.0}
    head = calibrated(kernel(RbfConfig(sigma=sigmas), *penalties, **settings), known)
    notes = head.fit_preferred(known)
    mean = z.mean(0)
    std = z.std(0)
    error = np.zeros((2, 2, 3))
    for i, j, axis in np.ndindex(2, 2, 3):
        model = KernelRidge(kernel="rbf", gamma=1 / (2 * sigmas[i]), alpha=penalties[j] * 60)
        model.fit((z - mean) / std, rates)
        errors = []
        for start in (0, 30):
            x = z[start, axis]
            for k in range(start, start + 29):
                own = z[k].copy()
                own[axis] = x
                x = x + step * model.predict(((own - mean) / std)[None])[0, axis]
                errors.append((x - z[k + 1, axis]) ** 2)
        error[i, j, axis] = np.mean(errors)
    np.testing.assert_allclose(notes["recursion_error"], error, rtol=1e-6)
    assert notes["penalty"] == [penalties[k % 2] for k in error.reshape(4, 3).argmin(0)]


PROCESS: dict[str, Any] = {
    "sklearn.gaussian_process.GaussianProcessRegressor": {
        "alpha": 0.1,
        "kernel": {"sklearn.gaussian_process.kernels.RBF": {"length_scale": 2.0}},
    }
}


@pytest.mark.parametrize(
    "pipeline",
    [
        ["sklearn.preprocessing.PolynomialFeatures", {"sklearn.linear_model.Ridge": {"alpha": 1}}],
        [{"sklearn.svm.SVR": {"C": 10.0}}],
        [PROCESS],
    ],
)
def test_the_answers_of_a_pipeline_are_those_of_scikit_learn(pipeline: list[Any]) -> None:
    config = validate_config({"pipeline": pipeline, "samples": 100}, SklearnConfig, "here")
    head = calibrated(config)
    head.fit_preferred(SAMPLES)
    x = head.features(SAMPLES.z).numpy()
    spread = head.residual_scale().numpy()
    rows = torch.linspace(0, len(x) - 1, 100).long()
    for axis in range(3):
        own = make_pipeline(*map(scikit.make_estimator, pipeline))
        own.fit(x[rows], SAMPLES.target[rows, axis].numpy() / spread[axis])
        wanted = own.predict(x) * spread[axis]
        np.testing.assert_allclose(answer(head)[:, axis], wanted, atol=1e-9 * spread[axis])


def test_no_format_exports_it() -> None:
    spec = make_example_spec(SklearnConfig(samples=100))
    with pytest.raises(ExportError, match=r"example: .*scikit-learn need Python.*export ano"):
        ExportedVessel(spec, make_example_model(spec))


@pytest.mark.parametrize(
    ("pipeline", "said"),
    [
        (["os.system"], "is not a class below `sklearn`"),
        (["sklearn.svm.SVX"], r"'sklearn.svm.SVX' is not among.*did you mean 'sklearn.svm.SVR'"),
        (["sklearn.datasets.load_iris"], "is not among the classes"),
        ([{"sklearn.svm.SVR": {"C": "much"}}], "The 'C' parameter of SVR must be a float"),
        (["sklearn.svm.SVR", "sklearn.svm.SVR"], "SVR is not a transformer"),
        (
            [{"sklearn.svm.SVR": {"kernel": {"os.system": {}}}}],
            "kernel: expected a number, a string",
        ),
        ([{"sklearn.svm.SVR": {"D": 1}}], "unexpected keyword argument 'D'"),
        (["sklearn.preprocessing.StandardScaler"], "is not a regressor"),
        ([], "at least 1"),
    ],
)
def test_what_is_no_pipeline(pipeline: list[Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        validate_config({"pipeline": pipeline}, SklearnConfig, "here")
