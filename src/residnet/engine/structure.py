"""Identification of modules with the same structure, whose compiled code can be shared."""

from __future__ import annotations

import hashlib
import io
import pickle
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor


def hash_structure(content: object, variable_tensors: Iterable[Tensor] = ()) -> bytes | None:
    """Return a digest of modules and settings; None if a part cannot be pickled.

    The pickle is hashed only and never read.

    Args:
        content: modules, tensors, numbers and texts.
        variable_tensors: tensors whose values do not belong to the structure. Of all other tensors
            the values are hashed.
    """
    file = io.BytesIO()
    try:
        _StructurePickler(file, variable_tensors).dump(content)
    except Exception:
        # parts of other packages that cannot be pickled
        return None
    return hashlib.sha256(file.getvalue()).digest()


class _StructurePickler(pickle.Pickler):
    """Pickles modules without the values of some of their tensors."""

    def __init__(self, file: io.BytesIO, variable_tensors: Iterable[Tensor]) -> None:
        super().__init__(file)
        self.variable_ids = {id(tensor) for tensor in variable_tensors}

    def persistent_id(self, obj: Any) -> Any:
        """Return the identity of a tensor: type and shape, or type and values of a constant."""
        if not isinstance(obj, Tensor):
            return None
        if obj.is_floating_point() and id(obj) in self.variable_ids:
            return str(obj.dtype), tuple(obj.shape), obj.requires_grad and torch.is_grad_enabled()
        return str(obj.dtype), obj.tolist()
