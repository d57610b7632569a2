"""Types of the values in the JSON files of a run that are read without a typed record.

These are metrics.json, in which a model can have the name of an earlier version, and fit.json,
whose notes depend on the head (residual model). Other keys are not checked. A value of a wrong type
raises an error that names the file and the key.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, StrictStr, TypeAdapter
from pydantic import ValidationError as ShapeError

from residnet.core.errors import UsageError
from residnet.core.model_names import FORMER_NAMES

Number = Annotated[float, Field(strict=True)] | None
"""A number; None represents a non-finite number."""


class _Shape(BaseModel):
    """JSON object with typed keys; further keys are allowed."""

    model_config = ConfigDict(extra="allow")


class _Row(_Shape):
    """A row of metrics.json: errors of one model on one split, protocol and kind of manoeuvre.

    Attributes:
        protocol: name of the free-run protocol of the config, such as `T30`.
        windows: number of free runs.
        n: number of samples.
        diverged: number of diverged free runs.
    """

    model: StrictStr
    kind: StrictStr = "head"
    split: StrictStr
    protocol: StrictStr = ""
    manoeuvre: StrictStr = "all"
    rmse: dict[str, Number] = {}
    mae: dict[str, Number] = {}
    nrmse: dict[str, Number] = {}
    rmse_ci95: dict[str, list[Number] | None] = {}
    nrmse_mean_ci95: list[Number] | None = None
    windows: Number = None
    n: Number = None
    diverged: Number = None
    position_error_end: Number = None
    heading_error_end: Number = None


class _FitMetrics(_Shape):
    """The contents of metrics.json of a fit.

    Attributes:
        selected: single model that the validation logs select.
        predictor: model that the run recommends, which can be an ensemble.
        channels: channel -> unit.
        scales: channel -> divisor of its error in the NRMSE.
    """

    selected: StrictStr | None = None
    predictor: StrictStr | None = None
    channels: dict[str, StrictStr] = {}
    scales: dict[str, Number] = {}
    rows: list[_Row]


class _Metrics(_Shape):
    """The contents of metrics.json of any other task."""

    rows: list[dict[str, Any]] = []


class _FitNotes(_Shape):
    """The contents of models/<model>/fit.json.

    Attributes:
        seconds: duration of the fit in s.
        validation: validation error, in the form that the head writes.
    """

    seconds: Number = None
    validation: Number | list[Any] | dict[str, Any] = None


_SHAPES: dict[str, type[BaseModel]] = {
    "fit.json": _FitNotes,
}


@cache
def _adapter(shape: type[BaseModel]) -> TypeAdapter[BaseModel]:
    return TypeAdapter(shape)


def require_shape(path: Path, content: Any) -> None:
    """Check the types of the known keys of a JSON file of a run.

    Args:
        path: path of the file, whose name determines the expected keys.
        content: parsed content of the file.

    Raises:
        UsageError: if a value has another type, or a key is missing.
    """
    shape = _SHAPES.get(path.name)
    if path.name == "metrics.json":
        is_fit = isinstance(content, dict) and content.get("schema") == "residnet.metrics/1"
        shape = _FitMetrics if is_fit else _Metrics
    if shape is None or not isinstance(content, dict):
        # the reader of the file reports a list or a number in place of an object
        return
    try:
        _adapter(shape).validate_python(content)
    except ShapeError as error:
        first_fault = error.errors(include_url=False)[0]
        # pydantic appends the type of the union member that failed, such as list[float]; it is no
        # key of the file
        key = ".".join(str(part) for part in first_fault["loc"] if "[" not in str(part))
        location = f"key '{key}'" if key else "its contents"
        raise UsageError(
            f"{path}: {location}: {first_fault['msg'].lower()}; restore the folder or run it again"
        ) from None
    if shape is _FitMetrics:
        for index, row in enumerate(content["rows"]):
            if (kind := row.get("kind")) in FORMER_NAMES:
                raise UsageError(
                    f"{path}: key 'rows.{index}.kind': an earlier version wrote '{kind}', which is"
                    f" '{FORMER_NAMES[kind]}' today; run the fit again"
                )
