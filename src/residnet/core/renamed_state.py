"""Loading of models whose parameters had other names when they were saved."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor, nn


class RenamedStateModule(nn.Module):
    """Module that accepts earlier names of its parameters and submodules in a state_dict.

    Attributes:
        renamed_state: current name by earlier name.
    """

    renamed_state: ClassVar[Mapping[str, str]] = {}

    def _load_from_state_dict(
        self, state_dict: dict[str, Tensor], prefix: str, *other_arguments: Any
    ) -> None:
        for earlier_name, name in self.renamed_state.items():
            earlier_key = prefix + earlier_name
            for key in list(state_dict):
                if key == earlier_key or key.startswith(f"{earlier_key}."):
                    state_dict[prefix + name + key[len(earlier_key) :]] = state_dict.pop(key)
        super()._load_from_state_dict(state_dict, prefix, *other_arguments)
