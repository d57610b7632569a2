"""Storage of fitted estimators of scikit-learn as arrays, without pickles.

An estimator is restored by its constructor with validated parameters; then the attributes that
`predict` or `transform` reads are set. Each is a number, a string, an array or a list of arrays.
The compiled code of scikit-learn does not check indices in these arrays (nodes of trees, numbers of
support vectors), so they are validated here.
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
"""Estimators whose fitted state can be stored, with the attributes that a prediction reads.

Trees and boosted trees are stored by `_encode_trees`.
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
"""Covariance functions of a Gaussian process; their parameters are stored."""
_FORESTS = ("RandomForestRegressor", "ExtraTreesRegressor")
_SINGLE_TREES = ("DecisionTreeRegressor", "ExtraTreeRegressor")
_MAX_FEATURES = 100_000
"""Maximum number of columns between two steps; useful polynomials have fewer."""


class StateError(ValueError):
    """A stored state does not match its estimator."""


def encode(pipelines: Sequence[Sequence[tuple[str, Any]]]) -> bytes:
    """Encode fitted pipelines as a safetensors file.

    Args:
        pipelines: pipeline of each axis, a list of (name in `FITTED`, fitted estimator).
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
        raise StateError(f"contains a {type(value).__name__}, which cannot be stored")

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
    """Restore the state of constructed, not fitted estimators from the bytes of `encode`.

    Args:
        content: safetensors file.
        pipelines: pipeline of each axis, a list of (name, estimator); the estimators are changed.
        width: number of features of the first steps.

    Raises:
        StateError: if the content does not match the pipelines.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        arrays = load(content)
        index = json.loads(arrays.pop("index").tobytes())
    except (SafetensorError, KeyError, ValueError, RecursionError) as error:
        raise StateError(f"is not a stored pipeline ({error})") from None

    if not isinstance(index, list) or len(index) != len(pipelines):
        raise StateError(f"does not contain {len(pipelines)} pipelines")
    for stored, steps in zip(index, pipelines, strict=True):
        names = [part.get("class") if isinstance(part, dict) else None for part in stored]
        if names != [name for name, _ in steps]:
            raise StateError(f"contains {names}, expected {[name for name, _ in steps]}")
        n_columns = width
        for part, (name, estimator) in zip(stored, steps, strict=True):
            n_columns = _restore_step(estimator, name, part.get("state"), arrays, n_columns)


def _restore_step(
    estimator: Any, name: str, state: Any, arrays: Mapping[str, np.ndarray], n_columns: int
) -> int:
    """Restore one step of a pipeline and return its number of output columns.

    Raises:
        StateError: if the state does not match the step; the message names the step.
    """
    if not isinstance(state, dict):
        raise StateError(f"{name} has no state")
    try:
        values = {key: _insert_arrays(value, arrays) for key, value in state.items()}
        _fill(estimator, name, values, n_columns)
        return _width_after(estimator, n_columns)
    except StateError as error:
        raise StateError(f"{name} {error}") from None
    except Exception as error:
        # scikit-learn raises errors of many types on an inconsistent state
        first_line = next(iter(str(error).splitlines()), "")
        raise StateError(f"{name} cannot be restored ({first_line})") from None


def _insert_arrays(value: Any, arrays: Mapping[str, np.ndarray], depth: int = 0) -> Any:
    """Replace the references to arrays that `encode` wrote in a stored value.

    Raises:
        StateError: if a reference is unknown, or the value is nested more than eight levels.
    """
    # a file from a stranger must not exhaust the stack
    if depth > 8:
        raise StateError("is nested too deeply")
    if isinstance(value, list):
        return [_insert_arrays(part, arrays, depth + 1) for part in value]
    if not isinstance(value, dict):
        return value
    if set(value) == {"array"} and value["array"] in arrays:
        return arrays[value["array"]]
    if set(value) == {"mapping"} and isinstance(value["mapping"], dict):
        return {
            key: _insert_arrays(part, arrays, depth + 1) for key, part in value["mapping"].items()
        }
    raise StateError("refers to an array that is missing")


def _width_after(estimator: Any, columns: int) -> int:
    """Return the number of output columns of a step, by a trial transformation."""
    if not hasattr(estimator, "transform") or hasattr(estimator, "predict"):
        return 1
    with np.errstate(all="ignore"):
        width = np.asarray(estimator.transform(np.zeros((1, columns)))).shape
    if len(width) != 2 or not 1 <= width[1] <= _MAX_FEATURES:
        raise StateError(f"returns columns of the shape {width}")
    return int(width[1])


def _fill(estimator: Any, name: str, state: dict[str, Any], columns: int) -> None:
    """Validate and set the fitted attributes of an estimator."""
    attributes = {key: state.pop(key, None) for key in FITTED[name]}
    features = state.pop("n_features_in_", columns)
    if features != columns or isinstance(features, bool):
        raise StateError(f"was fitted on {features} columns, and its step has {columns}")
    for key, value in attributes.items():
        if isinstance(value, dict):
            raise StateError(f"has a mapping as {key}")
    if name.rpartition(".")[2] in ("SVR", "NuSVR"):
        _require_support(attributes, columns)
        attributes["shape_fit_"] = tuple(attributes["shape_fit_"])
    if name.endswith(".PolynomialFeatures") and not (
        0 <= int(attributes["n_output_features_"]) <= _MAX_FEATURES
        and (attributes["_min_degree"], attributes["_max_degree"]) == _degrees(estimator)
    ):
        raise StateError("has other degrees than its description")
    vars(estimator).update(attributes)
    estimator.n_features_in_ = columns
    # predictions run in this thread: a stored config must not start processes
    if "n_jobs" in vars(estimator):
        estimator.n_jobs = None
    _restore_special(estimator, state, columns)


def _degrees(polynomial: Any) -> tuple[int, int]:
    """Return the minimum and maximum degree of `PolynomialFeatures`."""
    degree = polynomial.degree
    return (0, degree) if isinstance(degree, int) else (degree[0], degree[1])


def _require_support(state: Mapping[str, Any], columns: int) -> None:
    """Validate the arrays of a support vector machine, which libsvm reads unchecked."""
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
        raise StateError("has inconsistent arrays of support vectors")
    if samples[1] != columns or (rows and not 0 <= indices.min() <= indices.max() < samples[0]):
        raise StateError("has indices of support vectors outside its samples")


# ------------------------------------------------------------------- trees, boosting, kernels


def _encode_special(estimator: Any) -> dict[str, Any]:
    """Encode the trees or the covariance function of an estimator."""
    class_name = type(estimator).__name__
    if class_name in _SINGLE_TREES:
        return {"trees": _encode_trees([estimator.tree_])}
    if class_name in _FORESTS:
        return {"trees": _encode_trees([tree.tree_ for tree in estimator.estimators_])}
    if class_name == "GradientBoostingRegressor":
        initial = estimator.init_
        trees = [tree.tree_ for tree in estimator.estimators_.ravel()]
        return {
            "trees": _encode_trees(trees),
            "start": None if isinstance(initial, str) else float(initial.constant_.item()),
        }
    if class_name == "HistGradientBoostingRegressor":
        if estimator.is_categorical_ is not None:
            raise StateError("has categories, which cannot be stored")
        nodes = [predictor.nodes for stage in estimator._predictors for predictor in stage]
        return {"trees": {"sizes": np.array([len(n) for n in nodes]), "nodes": _node_fields(nodes)}}
    if class_name == "GaussianProcessRegressor":
        return {"kernel": _encode_kernel(estimator.kernel_)}
    return {}


def _restore_special(estimator: Any, state: dict[str, Any], columns: int) -> None:
    """Set trees or covariance function of an estimator from their form by `_encode_special`."""
    class_name = type(estimator).__name__
    if class_name in _SINGLE_TREES:
        (tree,) = _decode_trees(state["trees"], columns)
        _set_tree(estimator, tree, columns)
    elif class_name in _FORESTS or class_name == "GradientBoostingRegressor":
        from sklearn.tree import DecisionTreeRegressor, ExtraTreeRegressor

        member = (
            ExtraTreeRegressor if class_name == "ExtraTreesRegressor" else DecisionTreeRegressor
        )
        trees = _decode_trees(state["trees"], columns)
        members = [_set_tree(member(), tree, columns) for tree in trees]
        estimator.n_outputs_ = 1
        if class_name in _FORESTS:
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
    elif class_name == "HistGradientBoostingRegressor":
        _restore_histogram_trees(estimator, state["trees"], columns)
    elif class_name == "GaussianProcessRegressor":
        estimator.kernel_ = _decode_kernel(state["kernel"])
    elif class_name == "KNeighborsRegressor":
        if estimator._fit_method != "brute" or not isinstance(estimator.effective_metric_, str):
            raise StateError("has a search tree of neighbours, expected the algorithm 'brute'")
        if estimator._fit_X.shape != (len(estimator._y), columns):
            raise StateError("has neighbours of another shape")
        estimator._tree = None
        estimator.effective_metric_params_ = {}
        estimator.n_samples_fit_ = len(estimator._fit_X)


def _constant(value: Any, columns: int) -> Any:
    """Return the constant regressor that initialises boosting."""
    from sklearn.dummy import DummyRegressor

    regressor = DummyRegressor(strategy="constant", constant=float(value))
    return regressor.fit(np.zeros((1, columns)), np.array([float(value)]))


def _set_tree(estimator: Any, tree: Any, columns: int) -> Any:
    """Set the fitted attributes of a decision tree and return it."""
    estimator.tree_ = tree
    estimator.n_outputs_ = 1
    estimator.n_features_in_ = columns
    estimator.max_features_ = columns
    return estimator


def _node_fields(nodes: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """Return the fields of the nodes of all trees, concatenated."""
    all_nodes = np.concatenate(nodes)
    return {name: all_nodes[name] for name in all_nodes.dtype.names or ()}


def _encode_trees(trees: Sequence[Any]) -> dict[str, Any]:
    """Encode trees as the fields of their nodes and a value per node."""
    states = [tree.__getstate__() for tree in trees]
    return {
        "sizes": np.array([state["node_count"] for state in states]),
        "depths": np.array([state["max_depth"] for state in states]),
        "values": np.concatenate([state["values"].reshape(-1) for state in states]),
        "nodes": _node_fields([state["nodes"] for state in states]),
    }


def _split_nodes(stored: Any, node_dtype: np.dtype[Any]) -> list[np.ndarray]:
    """Return the nodes of each tree as structured arrays of the type of scikit-learn.

    Raises:
        StateError: if a field is missing or has the wrong length.
    """
    if not isinstance(stored, dict) or not isinstance(stored.get("nodes"), dict):
        raise StateError("has no trees")
    sizes = np.asarray(stored["sizes"])
    fields = stored["nodes"]
    if sizes.ndim != 1 or sizes.dtype.kind not in "iu" or (sizes < 1).any():
        raise StateError("has a tree without nodes")
    total = int(sizes.sum())
    all_nodes = np.zeros(total, dtype=node_dtype)
    for name in node_dtype.names or ():
        values = fields.get(name)
        if not isinstance(values, np.ndarray) or values.shape != (total,):
            raise StateError(
                f"has nodes without {name}; run the fit again with this version of scikit-learn"
            )
        if not np.array_equal(values.astype(all_nodes[name].dtype), values, equal_nan=True):
            raise StateError(f"has nodes whose {name} is out of range")
        all_nodes[name] = values
    return np.split(all_nodes, np.cumsum(sizes)[:-1])


def _require_nodes(inner: np.ndarray, children: Sequence[np.ndarray], size: int) -> None:
    """Check that the children of a node follow it in its tree, so that traversal terminates."""
    node_indices = np.flatnonzero(inner)
    for child in children:
        if not ((node_indices < child[inner]) & (child[inner] < size)).all():
            raise StateError("has a tree whose nodes have invalid children")


def _decode_trees(stored: Any, columns: int) -> list[Any]:
    """Build the trees of scikit-learn from the arrays of `_encode_trees`."""
    from sklearn.tree import _tree

    nodes_of_trees = _split_nodes(stored, _tree.NODE_DTYPE)
    values = np.asarray(stored["values"], dtype=float)
    if values.shape != (sum(map(len, nodes_of_trees)),):
        raise StateError("has trees without a value for each node")
    depths = stored["depths"]
    trees = []
    first_node = 0
    for nodes, depth in zip(nodes_of_trees, depths, strict=True):
        inner = nodes["left_child"] != -1
        children = (nodes["left_child"], nodes["right_child"])
        _require_nodes(inner, children, len(nodes))
        feature = nodes["feature"][inner]
        if not ((feature >= 0) & (feature < columns)).all():
            raise StateError("has a tree that reads a feature it does not have")
        tree = _tree.Tree(columns, np.array([1], dtype=np.intp), 1)
        tree.__setstate__(
            {
                "max_depth": int(depth),
                "node_count": len(nodes),
                "nodes": nodes,
                "values": values[first_node : first_node + len(nodes)].reshape(-1, 1, 1).copy(),
            }
        )
        first_node += len(nodes)
        trees.append(tree)
    return trees


def _restore_histogram_trees(estimator: Any, stored: Any, columns: int) -> None:
    """Set the trees of a histogram gradient boosting from their stored nodes."""
    from sklearn.ensemble._hist_gradient_boosting.binning import _BinMapper
    from sklearn.ensemble._hist_gradient_boosting.common import PREDICTOR_RECORD_DTYPE
    from sklearn.ensemble._hist_gradient_boosting.predictor import TreePredictor

    no_categories = np.zeros((0, 8), dtype=np.uint32)
    stages = []
    for nodes in _split_nodes(stored, PREDICTOR_RECORD_DTYPE):
        inner = nodes["is_leaf"] == 0
        children = (nodes["left"].astype(np.int64), nodes["right"].astype(np.int64))
        _require_nodes(inner, children, len(nodes))
        feature = nodes["feature_idx"][inner]
        if nodes["is_categorical"].any() or not ((feature >= 0) & (feature < columns)).all():
            raise StateError("has a tree that reads a feature it does not have")
        stages.append([TreePredictor(nodes, no_categories, no_categories)])
    if np.shape(estimator._baseline_prediction) != (1, 1):
        raise StateError("has no initial value of boosting")
    mapper = _BinMapper()
    mapper.is_categorical_ = np.zeros(columns, dtype=np.uint8)
    mapper.known_categories = None
    # without categories, only the number of columns is read from the mapper
    mapper.bin_thresholds_ = [np.zeros(0)] * columns
    estimator._bin_mapper = mapper
    estimator._predictors = stages
    estimator._loss = estimator._get_loss(sample_weight=None)
    estimator._preprocessor = estimator.is_categorical_ = None
    estimator._is_categorical_remapped = None
    estimator._n_features = columns
    estimator.n_trees_per_iteration_ = 1


def _encode_kernel(kernel: Any) -> dict[str, Any]:
    """Encode a covariance function as its name and its parameters."""
    name = f"sklearn.gaussian_process.kernels.{type(kernel).__name__}"
    if name not in KERNELS:
        raise StateError(f"has the kernel {type(kernel).__name__}, which cannot be stored")
    parameters = {
        key: _encode_kernel(value) if hasattr(value, "get_params") else value
        for key, value in kernel.get_params(deep=False).items()
    }
    return {"kernel": name, "parameters": parameters}


def _decode_kernel(stored: Any) -> Any:
    """Decode the covariance function of `_encode_kernel`."""
    from sklearn.gaussian_process import kernels

    if not isinstance(stored, dict) or stored.get("kernel") not in KERNELS:
        raise StateError("has a kernel that is not allowed")
    kernel_class: Callable[..., Any] = getattr(kernels, stored["kernel"].rpartition(".")[2])
    return kernel_class(
        **{
            key: _decode_kernel(value) if isinstance(value, dict) else value
            for key, value in stored["parameters"].items()
        }
    )
