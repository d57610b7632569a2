"""Regressors of scikit-learn as heads: fitted, judged and stored as any other, exported never."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from made_samples import NAMES, made

from residnet.core.config import validate
from residnet.core.errors import ConfigError, ExportError
from residnet.export.vessel import ExportedVessel
from residnet.heads.scikit import SklearnConfig, SklearnHead
from residnet.testing.checks import example_model, example_spec

PROCESS: dict[str, Any] = {
    "sklearn.gaussian_process.GaussianProcessRegressor": {
        "alpha": 0.1,
        "kernel": {"sklearn.gaussian_process.kernels.RBF": {"length_scale": 2.0}},
    }
}


@pytest.mark.parametrize(
    "pipeline",
    [
        ["sklearn.ensemble.HistGradientBoostingRegressor"],
        ["sklearn.preprocessing.PolynomialFeatures", {"sklearn.linear_model.Ridge": {"alpha": 1}}],
        [{"sklearn.svm.SVR": {"C": 10.0}}],
        [PROCESS],
    ],
)
def test_the_answers_are_those_of_scikit_learn(pipeline: list[Any]) -> None:
    from sklearn.pipeline import make_pipeline

    from residnet.heads.scikit import _made

    head = validate({"pipeline": pipeline, "samples": 300}, SklearnConfig, "here").build(NAMES)
    assert isinstance(head, SklearnHead)
    samples = made()
    head.calibrate(samples)
    head.solve(samples)
    x = head.features(samples.z)
    rows = torch.linspace(0, len(x) - 1, min(len(x), 300)).long()
    spread = samples.target.std(0, correction=0)
    for axis in range(3):
        own = make_pipeline(*map(_made, pipeline))
        own.fit(x[rows].numpy(), (samples.target[rows, axis] / head.residual_std()[axis]).numpy())
        wanted = own.predict(x.numpy()) * head.residual_std()[axis].item()
        found = head(samples.z, samples.z[:, :0])[0][:, axis].detach().numpy()
        np.testing.assert_allclose(found, wanted, atol=1e-9 * float(spread[axis]))


def test_no_format_exports_it() -> None:
    spec = example_spec(SklearnConfig(samples=100))
    with pytest.raises(ExportError, match=r"example: scikit-learn predicts in Python.*export ano"):
        ExportedVessel(spec, example_model(spec))


@pytest.mark.parametrize(
    ("pipeline", "said"),
    [
        (["os.system"], "names nothing below `sklearn`"),
        (["sklearn.svm.SVX"], "scikit-learn has no"),
        (["sklearn.datasets.load_iris"], "is no class"),
        ([{"sklearn.svm.SVR": {"D": 1}}], "unexpected keyword argument 'D'"),
        (["sklearn.preprocessing.StandardScaler"], "is no regressor"),
        ([], "at least 1"),
    ],
)
def test_what_is_no_pipeline(pipeline: list[Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        validate({"pipeline": pipeline}, SklearnConfig, "here")
