"""Loading of models whose parameters had other names when they were saved."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor, nn


class RenamedStateModule(nn.Module):
    """Module that accepts the names which its parameters and submodules had in earlier versions.

    Attributes:
        legacy_parameter_names: maps an earlier name in a state_dict to the current name.
    """

    legacy_parameter_names: ClassVar[Mapping[str, str]] = {}

    def _load_from_state_dict(
        self, state_dict: dict[str, Tensor], prefix: str, *other_arguments: Any
    ) -> None:
        for earlier_name, name in self.legacy_parameter_names.items():
            earlier_key = prefix + earlier_name
            for key in list(state_dict):
                if key == earlier_key or key.startswith(f"{earlier_key}."):
                    state_dict[prefix + name + key[len(earlier_key) :]] = state_dict.pop(key)
        super()._load_from_state_dict(state_dict, prefix, *other_arguments)
