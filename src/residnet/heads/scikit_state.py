"""Fitted estimators of scikit-learn as arrays: which there are, and how one is stored and restored.

No pickle is written or opened, and nothing is fitted when an estimator is restored. An estimator is
made by its constructor from checked parameters; then the few attributes that its `predict` or
`transform` reads are set. Each is a number, a text, an array or a list of arrays. Compiled code of
scikit-learn trusts indices that it finds in them (nodes of trees, numbers of support vectors), so
these are checked before.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np

_COEFFICIENTS = ("coef_", "intercept_")
_LINEAR = (
    "ARDRegression BayesianRidge ElasticNet ElasticNetCV HuberRegressor Lars LarsCV Lasso LassoCV"
    " LassoLars LassoLarsCV LassoLarsIC LinearRegression OrthogonalMatchingPursuit"
    " OrthogonalMatchingPursuitCV QuantileRegressor Ridge RidgeCV SGDRegressor TheilSenRegressor"
)
_SUPPORT = (
    "_gamma support_ support_vectors_ _n_support dual_coef_ intercept_ _dual_coef_ _intercept_"
    " _probA _probB fit_status_ shape_fit_ _sparse _effective_probability"
)
FITTED: Final[Mapping[str, tuple[str, ...]]] = {
    **{f"sklearn.linear_model.{name}": _COEFFICIENTS for name in _LINEAR.split()},
    "sklearn.svm.LinearSVR": _COEFFICIENTS,
    "sklearn.svm.SVR": tuple(_SUPPORT.split()),
    "sklearn.svm.NuSVR": tuple(_SUPPORT.split()),
    "sklearn.cross_decomposition.PLSRegression": (
        *_COEFFICIENTS,
        "_x_mean",
        "_x_std",
        "_predict_1d",
    ),
    "sklearn.kernel_ridge.KernelRidge": ("dual_coef_", "X_fit_"),
    "sklearn.neural_network.MLPRegressor": (
        "coefs_",
        "intercepts_",
        "n_layers_",
        "n_outputs_",
        "out_activation_",
    ),
    "sklearn.neighbors.KNeighborsRegressor": (
        "_y",
        "_fit_X",
        "_fit_method",
        "effective_metric_",
        "n_samples_fit_",
    ),
    "sklearn.gaussian_process.GaussianProcessRegressor": (
        "X_train_",
        "y_train_",
        "alpha_",
        "_y_train_mean",
        "_y_train_std",
    ),
    "sklearn.tree.DecisionTreeRegressor": (),
    "sklearn.tree.ExtraTreeRegressor": (),
    "sklearn.ensemble.RandomForestRegressor": (),
    "sklearn.ensemble.ExtraTreesRegressor": (),
    "sklearn.ensemble.GradientBoostingRegressor": (),
    "sklearn.ensemble.HistGradientBoostingRegressor": ("_baseline_prediction",),
    "sklearn.preprocessing.StandardScaler": ("mean_", "scale_"),
    "sklearn.preprocessing.MinMaxScaler": ("min_", "scale_"),
    "sklearn.preprocessing.MaxAbsScaler": ("scale_",),
    "sklearn.preprocessing.RobustScaler": ("center_", "scale_"),
    "sklearn.preprocessing.Normalizer": (),
    "sklearn.preprocessing.QuantileTransformer": ("quantiles_", "references_", "n_quantiles_"),
    "sklearn.preprocessing.PolynomialFeatures": (
        "_min_degree",
        "_max_degree",
        "n_output_features_",
        "_n_out_full",
    ),
    "sklearn.decomposition.PCA": ("components_", "mean_", "explained_variance_", "n_components_"),
    "sklearn.kernel_approximation.Nystroem": ("components_", "normalization_"),
    "sklearn.kernel_approximation.RBFSampler": ("random_weights_", "random_offset_"),
}
"""Estimators whose fitted state is stored, each with the attributes that a prediction reads.

Those of trees and boosted trees are stored by `_encode_trees`.
"""
KERNELS: Final = frozenset(
    f"sklearn.gaussian_process.kernels.{name}"
    for name in (
        "ConstantKernel",
        "DotProduct",
        "ExpSineSquared",
        "Matern",
        "Product",
        "RBF",
        "RationalQuadratic",
        "Sum",
        "WhiteKernel",
    )
)
"""Covariance functions of a Gaussian process; their numbers are stored."""
_FORESTS = ("RandomForestRegressor", "ExtraTreesRegressor")
_SINGLE_TREES = ("DecisionTreeRegressor", "ExtraTreeRegressor")
_MOST_FEATURES = 100_000
"""Columns between two steps of a pipeline; a polynomial of high degree has no more by far."""


class StateError(ValueError):
    """The error of a stored estimator that does not fit its description."""


def encode(pipelines: Sequence[Sequence[tuple[str, Any]]]) -> bytes:
    """Return fitted pipelines as one safetensors file.

    Args:
        pipelines: one of each axis, a list of the name in `FITTED` and the fitted estimator.
    """
    from safetensors.numpy import save

    arrays: dict[str, np.ndarray] = {}

    def store(value: Any) -> Any:
        if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
            arrays[f"a{len(arrays)}"] = np.ascontiguousarray(value)
            return {"array": f"a{len(arrays) - 1}"}
        if isinstance(value, list | tuple):
            return [store(part) for part in value]
        if isinstance(value, np.generic):
            return value.item()
        if value is None or isinstance(value, bool | int | float | str):
            return value
        if isinstance(value, Mapping):
            return {"mapping": {str(key): store(part) for key, part in value.items()}}
        raise StateError(f"holds a {type(value).__name__}, which cannot be stored")

    index = []
    for steps in pipelines:
        stored = []
        for name, estimator in steps:
            state = {key: getattr(estimator, key, None) for key in FITTED[name]}
            if hasattr(estimator, "n_features_in_"):
                state["n_features_in_"] = estimator.n_features_in_
            state |= _encode_special(estimator)
            stored.append({"class": name, "state": {key: store(v) for key, v in state.items()}})
        index.append(stored)
    arrays["index"] = np.frombuffer(json.dumps(index).encode(), dtype=np.uint8)
    return bytes(save(arrays))


def decode(content: bytes, pipelines: Sequence[Sequence[tuple[str, Any]]], width: int) -> None:
    """Fill estimators, made but not fitted, with the state that `encode` stored.

    Args:
        content: safetensors file.
        pipelines: as of `encode`; the estimators are changed.
        width: number of features of the first steps.

    Raises:
        StateError: where the content does not belong to such pipelines.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        arrays = load(content)
        index = json.loads(arrays.pop("index").tobytes())
    except (SafetensorError, KeyError, ValueError, RecursionError) as error:
        raise StateError(f"is no stored pipeline ({error})") from None

    def restore(value: Any, depth: int = 0) -> Any:
        if depth > 8:
            raise StateError("is nested too deeply")
        if isinstance(value, list):
            return [restore(part, depth + 1) for part in value]
        if isinstance(value, dict):
            if set(value) == {"array"} and value["array"] in arrays:
                return arrays[value["array"]]
            if set(value) == {"mapping"} and isinstance(value["mapping"], dict):
                return {key: restore(part, depth + 1) for key, part in value["mapping"].items()}
            raise StateError("refers to an array that is missing")
        return value

    if not isinstance(index, list) or len(index) != len(pipelines):
        raise StateError(f"does not hold {len(pipelines)} pipelines")
    for stored, steps in zip(index, pipelines, strict=True):
        names = [part.get("class") if isinstance(part, dict) else None for part in stored]
        if names != [name for name, _ in steps]:
            raise StateError(f"holds {names}, expected {[name for name, _ in steps]}")
        columns = width
        for part, (name, estimator) in zip(stored, steps, strict=True):
            state = part.get("state")
            if not isinstance(state, dict):
                raise StateError(f"{name} has no state")
            try:
                _fill(estimator, name, {key: restore(v) for key, v in state.items()}, columns)
                columns = _width_after(estimator, columns)
            except StateError as error:
                raise StateError(f"{name} {error}") from None
            except Exception as error:
                # whatever scikit-learn raises on a state that does not belong to it
                first = next(iter(str(error).splitlines()), "")
                raise StateError(f"{name} cannot be restored ({first})") from None


def _width_after(estimator: Any, columns: int) -> int:
    """Return the number of columns that a step gives to the next one."""
    if not hasattr(estimator, "transform") or hasattr(estimator, "predict"):
        return 1
    with np.errstate(all="ignore"):
        width = np.asarray(estimator.transform(np.zeros((1, columns)))).shape
    if len(width) != 2 or not 1 <= width[1] <= _MOST_FEATURES:
        raise StateError(f"gives columns of the shape {width}")
    return int(width[1])


def _fill(estimator: Any, name: str, state: dict[str, Any], columns: int) -> None:
    """Set the fitted attributes of one estimator, after they have been checked."""
    fitted = {key: state.pop(key, None) for key in FITTED[name]}
    features = state.pop("n_features_in_", columns)
    if features != columns or isinstance(features, bool):
        raise StateError(f"was fitted on {features} columns, and its step has {columns}")
    for key, value in fitted.items():
        if isinstance(value, dict):
            raise StateError(f"has a mapping as {key}")
    if name.rpartition(".")[2] in ("SVR", "NuSVR"):
        _require_support(fitted, columns)
        fitted["shape_fit_"] = tuple(fitted["shape_fit_"])
    if name.endswith(".PolynomialFeatures") and not (
        0 <= int(fitted["n_output_features_"]) <= _MOST_FEATURES
        and (fitted["_min_degree"], fitted["_max_degree"]) == _degrees(estimator)
    ):
        raise StateError("has other degrees than its description")
    vars(estimator).update(fitted)
    estimator.n_features_in_ = columns
    if "n_jobs" in vars(estimator):
        estimator.n_jobs = None
    _restore_special(estimator, state, columns)


def _degrees(polynomial: Any) -> tuple[int, int]:
    """Return the lowest and the highest degree of `PolynomialFeatures`."""
    degree = polynomial.degree
    return (0, degree) if isinstance(degree, int) else (degree[0], degree[1])


def _require_support(state: Mapping[str, Any], columns: int) -> None:
    """Check the arrays that libsvm reads without a check of its own."""
    vectors = state["support_vectors_"]
    weights = state["_dual_coef_"]
    count = state["_n_support"]
    indices = state["support_"]
    rows = len(vectors)
    shapes = (
        vectors.shape == (rows, columns)
        and weights.shape == state["dual_coef_"].shape == (1, rows)
        and indices.shape == (rows,)
        and indices.dtype == count.dtype == np.int32
        and count.shape == (2,)
        and count[0] == rows
        and state["_intercept_"].shape == state["intercept_"].shape == (1,)
        and state["_probA"].size == state["_probB"].size == 0
        and {part.dtype for part in (vectors, weights, state["_intercept_"])} == {np.dtype(float)}
        and state["_sparse"] is False
        and isinstance(state["_gamma"], float)
    )
    samples = state["shape_fit_"]
    if not shapes or len(samples) != 2 or not all(type(size) is int for size in samples):
        raise StateError("has support vectors that do not belong together")
    if samples[1] != columns or (rows and not 0 <= indices.min() <= indices.max() < samples[0]):
        raise StateError("has support vectors beyond its samples")


# ------------------------------------------------------------------- trees, boosting, kernels


def _encode_special(estimator: Any) -> dict[str, Any]:
    """Return what of an estimator is no plain attribute: its trees or its covariance function."""
    kind = type(estimator).__name__
    if kind in _SINGLE_TREES:
        return {"trees": _encode_trees([estimator.tree_])}
    if kind in _FORESTS:
        return {"trees": _encode_trees([tree.tree_ for tree in estimator.estimators_])}
    if kind == "GradientBoostingRegressor":
        start = estimator.init_
        trees = [tree.tree_ for tree in estimator.estimators_.ravel()]
        return {
            "trees": _encode_trees(trees),
            "start": None if isinstance(start, str) else float(start.constant_.item()),
        }
    if kind == "HistGradientBoostingRegressor":
        if estimator.is_categorical_ is not None:
            raise StateError("has categories, which cannot be stored")
        nodes = [predictor.nodes for stage in estimator._predictors for predictor in stage]
        return {"trees": {"sizes": np.array([len(n) for n in nodes]), "nodes": _fields(nodes)}}
    if kind == "GaussianProcessRegressor":
        return {"kernel": _encode_kernel(estimator.kernel_)}
    return {}


def _restore_special(estimator: Any, state: dict[str, Any], columns: int) -> None:
    """Set what `_encode_special` returned."""
    kind = type(estimator).__name__
    if kind in _SINGLE_TREES:
        (tree,) = _decode_trees(state["trees"], columns)
        _hold_tree(estimator, tree, columns)
    elif kind in _FORESTS or kind == "GradientBoostingRegressor":
        from sklearn.tree import DecisionTreeRegressor, ExtraTreeRegressor

        member = ExtraTreeRegressor if kind == "ExtraTreesRegressor" else DecisionTreeRegressor
        trees = _decode_trees(state["trees"], columns)
        members = [_hold_tree(member(), tree, columns) for tree in trees]
        estimator.n_outputs_ = 1
        if kind in _FORESTS:
            estimator.estimators_ = members
            estimator.estimator_ = member()
            return
        boosted = np.empty((len(members), 1), dtype=object)
        boosted[:, 0] = members
        estimator.estimators_ = boosted
        estimator.n_estimators_ = len(members)
        estimator.n_trees_per_iteration_ = 1
        estimator._loss = estimator._get_loss(sample_weight=None)
        estimator.init_ = "zero" if state["start"] is None else _constant(state["start"], columns)
    elif kind == "HistGradientBoostingRegressor":
        _restore_histogram_trees(estimator, state["trees"], columns)
    elif kind == "GaussianProcessRegressor":
        estimator.kernel_ = _decode_kernel(state["kernel"])
    elif kind == "KNeighborsRegressor":
        if estimator._fit_method != "brute" or not isinstance(estimator.effective_metric_, str):
            raise StateError("has an index of neighbours, expected all distances ('brute')")
        if estimator._fit_X.shape != (len(estimator._y), columns):
            raise StateError("has neighbours of another shape")
        estimator._tree = None
        estimator.effective_metric_params_ = {}
        estimator.n_samples_fit_ = len(estimator._fit_X)


def _constant(value: Any, columns: int) -> Any:
    """Return the regressor of a constant, from which boosting begins."""
    from sklearn.dummy import DummyRegressor

    start = DummyRegressor(strategy="constant", constant=float(value))
    return start.fit(np.zeros((1, columns)), np.array([float(value)]))


def _hold_tree(estimator: Any, tree: Any, columns: int) -> Any:
    """Return an estimator of one tree that predicts by it."""
    estimator.tree_ = tree
    estimator.n_outputs_ = 1
    estimator.n_features_in_ = columns
    estimator.max_features_ = columns
    return estimator


def _fields(nodes: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """Return the fields of the nodes of all trees, one tree behind the other."""
    joined = np.concatenate(nodes)
    return {name: joined[name] for name in joined.dtype.names or ()}


def _encode_trees(trees: Sequence[Any]) -> dict[str, Any]:
    """Return trees as the fields of their nodes and one value a node."""
    states = [tree.__getstate__() for tree in trees]
    return {
        "sizes": np.array([state["node_count"] for state in states]),
        "depths": np.array([state["max_depth"] for state in states]),
        "values": np.concatenate([state["values"].reshape(-1) for state in states]),
        "nodes": _fields([state["nodes"] for state in states]),
    }


def _split_nodes(stored: Any, kind: np.dtype[Any]) -> list[np.ndarray]:
    """Return the nodes of each tree as structured arrays of scikit-learn's own type.

    Raises:
        StateError: where a field is missing or of another length.
    """
    if not isinstance(stored, dict) or not isinstance(stored.get("nodes"), dict):
        raise StateError("has no trees")
    sizes = np.asarray(stored["sizes"])
    fields = stored["nodes"]
    if sizes.ndim != 1 or sizes.dtype.kind not in "iu" or (sizes < 1).any():
        raise StateError("has a tree without nodes")
    total = int(sizes.sum())
    joined = np.zeros(total, dtype=kind)
    for name in kind.names or ():
        values = fields.get(name)
        if not isinstance(values, np.ndarray) or values.shape != (total,):
            raise StateError(f"has nodes without {name}; fit it again with this scikit-learn")
        if not np.array_equal(values.astype(joined[name].dtype), values, equal_nan=True):
            raise StateError(f"has nodes whose {name} is out of range")
        joined[name] = values
    return np.split(joined, np.cumsum(sizes)[:-1])


def _require_nodes(inner: np.ndarray, children: Sequence[np.ndarray], size: int) -> None:
    """Check that every inner node leads to later nodes of its tree: a walk then always ends."""
    places = np.flatnonzero(inner)
    for child in children:
        if not ((places < child[inner]) & (child[inner] < size)).all():
            raise StateError("has a tree whose nodes lead out of it or back")


def _decode_trees(stored: Any, columns: int) -> list[Any]:
    """Return the trees that `_encode_trees` stored."""
    from sklearn.tree import _tree

    parts = _split_nodes(stored, _tree.NODE_DTYPE)
    values = np.asarray(stored["values"], dtype=float)
    if values.shape != (sum(map(len, parts)),):
        raise StateError("has trees without a value for each node")
    depths = stored["depths"]
    trees = []
    begin = 0
    for nodes, depth in zip(parts, depths, strict=True):
        inner = nodes["left_child"] != -1
        children = (nodes["left_child"], nodes["right_child"])
        _require_nodes(inner, children, len(nodes))
        feature = nodes["feature"][inner]
        if not ((feature >= 0) & (feature < columns)).all():
            raise StateError("has a tree that asks for a feature it does not have")
        tree = _tree.Tree(columns, np.array([1], dtype=np.intp), 1)
        tree.__setstate__(
            {
                "max_depth": int(depth),
                "node_count": len(nodes),
                "nodes": nodes,
                "values": values[begin : begin + len(nodes)].reshape(-1, 1, 1).copy(),
            }
        )
        begin += len(nodes)
        trees.append(tree)
    return trees


def _restore_histogram_trees(estimator: Any, stored: Any, columns: int) -> None:
    """Set the trees of histogram boosting."""
    from sklearn.ensemble._hist_gradient_boosting.binning import _BinMapper
    from sklearn.ensemble._hist_gradient_boosting.common import PREDICTOR_RECORD_DTYPE
    from sklearn.ensemble._hist_gradient_boosting.predictor import TreePredictor

    none = np.zeros((0, 8), dtype=np.uint32)
    stages = []
    for nodes in _split_nodes(stored, PREDICTOR_RECORD_DTYPE):
        inner = nodes["is_leaf"] == 0
        children = (nodes["left"].astype(np.int64), nodes["right"].astype(np.int64))
        _require_nodes(inner, children, len(nodes))
        feature = nodes["feature_idx"][inner]
        if nodes["is_categorical"].any() or not ((feature >= 0) & (feature < columns)).all():
            raise StateError("has a tree that asks for a feature it does not have")
        stages.append([TreePredictor(nodes, none, none)])
    if np.shape(estimator._baseline_prediction) != (1, 1):
        raise StateError("has no value that boosting begins from")
    mapper = _BinMapper()
    mapper.is_categorical_ = np.zeros(columns, dtype=np.uint8)
    mapper.known_categories = None
    # without categories the mapper is asked for the number of columns alone
    mapper.bin_thresholds_ = [np.zeros(0)] * columns
    estimator._bin_mapper = mapper
    estimator._predictors = stages
    estimator._loss = estimator._get_loss(sample_weight=None)
    estimator._preprocessor = estimator.is_categorical_ = None
    estimator._is_categorical_remapped = None
    estimator._n_features = columns
    estimator.n_trees_per_iteration_ = 1


def _encode_kernel(kernel: Any) -> dict[str, Any]:
    """Return a covariance function as its name and its parameters."""
    name = f"sklearn.gaussian_process.kernels.{type(kernel).__name__}"
    if name not in KERNELS:
        raise StateError(f"has the kernel {type(kernel).__name__}, which cannot be stored")
    parameters = {
        key: _encode_kernel(value) if hasattr(value, "get_params") else value
        for key, value in kernel.get_params(deep=False).items()
    }
    return {"kernel": name, "parameters": parameters}


def _decode_kernel(stored: Any) -> Any:
    """Return the covariance function that `_encode_kernel` stored."""
    from sklearn.gaussian_process import kernels

    if not isinstance(stored, dict) or stored.get("kernel") not in KERNELS:
        raise StateError("has a kernel that is not allowed")
    made: Callable[..., Any] = getattr(kernels, stored["kernel"].rpartition(".")[2])
    return made(
        **{
            key: _decode_kernel(value) if isinstance(value, dict) else value
            for key, value in stored["parameters"].items()
        }
    )
