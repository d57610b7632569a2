"""Cache of results of dear functions whose arguments are arrays."""

from __future__ import annotations

import copy
import hashlib
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import wraps
from typing import ParamSpec, TypeVar

import numpy as np

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def cache_results(
    max_bytes: int,
) -> Callable[[Callable[Parameters, Result]], Callable[Parameters, Result]]:
    """Cache the results of a function by a digest of the contents of its arguments.

    A draft or an inspection needs the smoothed motion of a log at several places, each of which
    reads or selects the channels anew. Arguments and results may be arrays, numbers, texts, None,
    dataclasses, mappings and sequences. The function must depend on its arguments only. Each call
    returns a copy, which the caller may change.

    Args:
        max_bytes: largest total size of the arrays in stored results; the results that were not
            used for the longest time are removed.
    """

    def decorate(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
        results: OrderedDict[bytes, tuple[Result, int]] = OrderedDict()

        @wraps(function)
        def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
            digest = hashlib.blake2b(digest_size=16)
            for part in _iterate_parts((args, kwargs)):
                digest.update(part.tobytes() if isinstance(part, np.ndarray) else part)
            key = digest.digest()
            if key in results:
                results.move_to_end(key)
                return copy.deepcopy(results[key][0])
            result = function(*args, **kwargs)
            size = sum(
                part.nbytes for part in _iterate_parts(result) if isinstance(part, np.ndarray)
            )
            results[key] = (copy.deepcopy(result), size)
            total = sum(stored_size for _, stored_size in results.values())
            while total > max_bytes:
                _, (_, removed_size) = results.popitem(last=False)
                total -= removed_size
            return result

        return call

    return decorate


def _iterate_parts(value: object) -> Iterator[np.ndarray | bytes]:
    """Yield the arrays in a value, and bytes that determine everything else.

    Raises:
        TypeError: if the value has a part of another type.
    """
    if isinstance(value, np.ndarray):
        yield f"array {value.dtype} {value.shape}".encode()
        yield value
    elif value is None or isinstance(value, str | int | float | np.generic):
        yield f"{type(value).__name__} {value!r}".encode()
    elif is_dataclass(value):
        yield type(value).__qualname__.encode()
        for field in fields(value):
            yield from _iterate_parts(getattr(value, field.name))
    elif isinstance(value, Mapping):
        yield f"mapping {len(value)}".encode()
        for key, item in value.items():
            yield from _iterate_parts(key)
            yield from _iterate_parts(item)
    elif isinstance(value, Sequence):
        yield f"sequence {type(value).__name__} {len(value)}".encode()
        for item in value:
            yield from _iterate_parts(item)
    else:
        raise TypeError(f"a {type(value).__name__} has no digest; pass arrays and numbers")
