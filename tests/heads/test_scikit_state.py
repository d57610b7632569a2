"""Fitted estimators of scikit-learn: stored as arrays, restored without a fit, and not believed."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.numpy import load, save

from residnet.core.config import validate_config
from residnet.core.errors import ConfigError, UsageError
from residnet.core.trust import trusting
from residnet.dynamics.store import load_model, restore_module, save_model
from residnet.heads import scikit, scikit_state
from residnet.heads.scikit import SklearnHead
from residnet.heads.scikit_config import SklearnConfig
from residnet.testing.checks import make_example_model, make_example_spec

STEPS: dict[str, Any] = {
    "sklearn.linear_model.QuantileRegressor": {"alpha": 0.01},
    "sklearn.ensemble.RandomForestRegressor": {"n_estimators": 4},
    "sklearn.ensemble.ExtraTreesRegressor": {"n_estimators": 4},
    "sklearn.ensemble.GradientBoostingRegressor": {"n_estimators": 5},
    "sklearn.ensemble.HistGradientBoostingRegressor": {"max_iter": 5},
    "sklearn.neural_network.MLPRegressor": {"hidden_layer_sizes": [5, 4], "max_iter": 30},
    "sklearn.gaussian_process.GaussianProcessRegressor": {
        "alpha": 0.1,
        "kernel": {"sklearn.gaussian_process.kernels.RBF": {"length_scale": 2.0}},
    },
    "sklearn.preprocessing.QuantileTransformer": {"n_quantiles": 20},
    "sklearn.kernel_approximation.Nystroem": {"n_components": 10},
    "sklearn.decomposition.PCA": {"n_components": 3},
}
EXTRA = [
    [{"sklearn.ensemble.GradientBoostingRegressor": {"loss": "huber", "init": "zero"}}],
    [{"sklearn.ensemble.HistGradientBoostingRegressor": {"loss": "absolute_error", "max_iter": 5}}],
    [{"sklearn.gaussian_process.GaussianProcessRegressor": {"alpha": 0.1, "normalize_y": True}}],
    [{"sklearn.svm.SVR": {"kernel": "poly", "degree": 2}}],
    [{"sklearn.neighbors.KNeighborsRegressor": {"weights": "distance", "metric": "manhattan"}}],
]


def _pipeline(name: str) -> list[Any]:
    step = {name: STEPS[name]} if name in STEPS else name
    is_regressor = hasattr(scikit.make_estimator(step), "predict")
    return [step] if is_regressor else [step, "sklearn.linear_model.Ridge"]


def _config(pipeline: list[Any]) -> SklearnConfig:
    return validate_config({"pipeline": pipeline, "samples": 150}, SklearnConfig, "here")


@pytest.fixture
def no_fit(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Make every later fit of an estimator an error."""

    def forbid() -> None:
        def fit(*_: object, **__: object) -> None:
            raise AssertionError("an estimator was fitted")

        monkeypatch.setattr(SklearnHead, "_fit", fit)

    return forbid


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("estimator", [*scikit_state.FITTED, *EXTRA], ids=lambda p: str(p)[:70])
def test_a_stored_pipeline_predicts_the_same_without_a_fit(
    estimator: str | list[Any], tmp_path: Path, no_fit: Callable[[], None]
) -> None:
    pipeline = _pipeline(estimator) if isinstance(estimator, str) else estimator
    spec = make_example_spec(_config(pipeline))
    model = make_example_model(spec)
    save_model(tmp_path / "model", spec, model)
    no_fit()
    stored = load_model(tmp_path / "model")[1]
    features: Any = model.head.features
    x = np.random.default_rng(0).normal(size=(50, features.n_features))
    before = model.head.predict(torch.from_numpy(x))
    assert before.std() > 0
    assert torch.equal(stored.head.predict(torch.from_numpy(x)), before)
    assert stored.head.parameter_counts() == model.head.parameter_counts()
    assert b"pickle" not in (tmp_path / "model" / "model.safetensors").read_bytes()


HOSTILE: list[tuple[str, str, Any, str]] = [
    ("sklearn.tree.DecisionTreeRegressor", "left_child", 0, "invalid children"),
    ("sklearn.tree.DecisionTreeRegressor", "left_child", 10**9, "invalid children"),
    ("sklearn.tree.DecisionTreeRegressor", "feature", 10**6, "a feature it does not have"),
    ("sklearn.tree.DecisionTreeRegressor", "feature", -7, "a feature it does not have"),
    ("sklearn.ensemble.RandomForestRegressor", "right_child", 10**9, "invalid children"),
    ("sklearn.ensemble.GradientBoostingRegressor", "feature", 10**6, "a feature it does not have"),
    ("sklearn.ensemble.HistGradientBoostingRegressor", "left", 10**9, "invalid children"),
    ("sklearn.ensemble.HistGradientBoostingRegressor", "feature_idx", 99, "it does not have"),
    ("sklearn.ensemble.HistGradientBoostingRegressor", "is_categorical", 1, "it does not have"),
    ("sklearn.svm.SVR", "_n_support", 10**8, "inconsistent arrays"),
    ("sklearn.svm.SVR", "support_", 10**8, "outside its samples"),
    ("sklearn.svm.SVR", "dual_coef_", None, "inconsistent arrays"),
    ("sklearn.linear_model.Ridge", "coef_", None, "gives no prediction"),
    ("sklearn.kernel_ridge.KernelRidge", "X_fit_", None, "gives no prediction"),
    ("sklearn.neural_network.MLPRegressor", "coefs_", None, "gives no prediction"),
    ("sklearn.neighbors.KNeighborsRegressor", "_fit_X", None, "neighbours of another shape"),
]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("name", "key", "value", "message"), HOSTILE)
def test_a_forged_state_is_refused(name: str, key: str, value: Any, message: str) -> None:
    """Compiled code of scikit-learn would read beyond arrays, or walk in a circle."""
    spec = make_example_spec(_config(_pipeline(name)))
    model = make_example_model(spec)
    state = model.state_dict()
    stored = state["head._extra_state"].numpy()
    arrays = load(stored[5:].tobytes())
    index = json.loads(arrays["index"].tobytes())
    place: Any = index[0][0]["state"]
    if key not in place:
        place = place["trees"]["mapping"]["nodes"]["mapping"]
    array = (place[key][0] if isinstance(place[key], list) else place[key])["array"]
    if value is None:
        arrays[array] = arrays[array].reshape(-1)[:-1]
    else:
        arrays[array] = arrays[array].copy()
        arrays[array][0] = value
    arrays = {k: np.ascontiguousarray(v) for k, v in arrays.items()}
    forged = np.concatenate((stored[:5], np.frombuffer(save(arrays), dtype=np.uint8)))
    with pytest.raises(UsageError, match=message):
        restore_module(spec, state | {"head._extra_state": torch.from_numpy(forged)})


@pytest.mark.parametrize("length", [0, 3, 5, 40, 400])
def test_a_cut_state_is_refused(length: int) -> None:
    spec = make_example_spec(_config(["sklearn.linear_model.Ridge"]))
    state = make_example_model(spec).state_dict()
    state["head._extra_state"] = state["head._extra_state"][:length]
    if length == 0:
        # the state of a head that is not fitted yet
        assert restore_module(spec, state).head.axis_pipelines == []
        return
    with pytest.raises(UsageError, match="a head of kind sklearn: its state"):
        restore_module(spec, state)


def test_samples_to_fit_on_again_are_refused() -> None:
    """Earlier versions stored these; a forged state cannot make a load fit anything."""
    spec = make_example_spec(_config(["sklearn.linear_model.Ridge"]))
    state = make_example_model(spec).state_dict()
    forged = state["head._extra_state"].clone()
    forged[0] = 2
    with pytest.raises(UsageError, match="give --trust"):
        restore_module(spec, state | {"head._extra_state": forged})
    with pytest.raises(UsageError, match="earlier version"):
        restore_module(spec, state | {"head._extra_state": torch.zeros(4, 9)})


MEMORY = [
    {"sklearn.cluster.FeatureAgglomeration": {"memory": "cache", "n_clusters": 2}},
    "sklearn.linear_model.LinearRegression",
]


def test_a_store_of_pickles_is_refused_with_and_without_trust() -> None:
    with pytest.raises(ConfigError, match="FeatureAgglomeration' is not among"):
        _config(MEMORY)
    with trusting(), pytest.raises(ConfigError, match="memory: is a cache of pickles"):
        _config(MEMORY)


def test_other_classes_need_trust_at_the_fit_and_at_the_load(tmp_path: Path) -> None:
    with trusting():
        spec = make_example_spec(
            _config([{"sklearn.ensemble.BaggingRegressor": {"n_estimators": 2}}])
        )
        model = make_example_model(spec)
        save_model(tmp_path / "model", spec, model)
        stored = load_model(tmp_path / "model")[1]
    features: Any = model.head.features
    x = torch.randn(9, features.n_features)
    assert torch.equal(stored.head.predict(x), model.head.predict(x))
    with pytest.raises(ConfigError, match=r"BaggingRegressor' is not among.*--trust"):
        load_model(tmp_path / "model")
