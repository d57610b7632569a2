"""Heads (residual models) from `torch.nn.Module` objects of the user, without a package."""

from __future__ import annotations

import copy
import hashlib
import inspect
from collections.abc import Sequence
from typing import Any, ClassVar, Literal, final

import torch
from torch import Tensor, nn

from residnet.core.errors import ConfigError, UsageError
from residnet.heads.base import Features, ResidualHead, ResidualScale
from residnet.heads.config import BaseHeadConfig
from residnet.physics.symmetry import get_dof

_templates: dict[str, nn.Module] = {}
"""Modules of the user by their key in a config, with their initial weights."""


def register_module(module: nn.Module, key: str | None = None) -> dict[str, Any]:
    """Register a module of the user for this process, and return the config of its head.

    A config holds values only. It refers to the module by a digest of its class, structure, weights
    and plain attributes.

    Args:
        module: a `ResidualHead`, or a module with `forward(z) -> rho` or
            `forward(z, s) -> (rho, s)`; the latter has the number of memory values as `n_state`.
        key: key of the module in the config of a stored model; None to compute it.

    Raises:
        UsageError: if the module has no such `forward`.
    """
    name = type(module).__qualname__
    if not isinstance(module, ResidualHead) and _count_arguments(module) == 2:
        n_state = getattr(module, "n_state", None)
        if not isinstance(n_state, int) or n_state < 1:
            raise UsageError(
                f"head {name}: forward(z, s) needs the number of memory values per row; set"
                " self.n_state in __init__, or remove s from forward"
            )
    key = key or _compute_key(module)
    _templates[key] = copy.deepcopy(module)
    return {"kind": "module", "key": key, "class_name": name}


def register_stored_modules(content: Any, modules: Sequence[nn.Module]) -> None:
    """Register modules under the keys that the description of a stored model has for them.

    Args:
        content: content of `model.json`, or a part of it.
        modules: modules of the user; one of the class that the description names is used.
    """
    if isinstance(content, list):
        for item in content:
            register_stored_modules(item, modules)
    if not isinstance(content, dict):
        return
    if content.get("kind") == "module":
        for module in modules:
            if type(module).__qualname__ == content.get("class_name"):
                register_module(module, str(content.get("key")))
    for item in content.values():
        register_stored_modules(item, modules)


def _count_arguments(module: nn.Module) -> int:
    """Return the number of tensors that `forward` receives, 1 or 2.

    Raises:
        UsageError: if it is another number.
    """
    parameters = inspect.signature(module.forward).parameters.values()
    n_arguments = sum(
        parameter.kind in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD)
        and parameter.default is parameter.empty
        for parameter in parameters
    )
    # a container such as `nn.Sequential` has forward(input)
    if n_arguments not in (1, 2):
        raise UsageError(
            f"head {type(module).__qualname__}: expected forward(z) -> rho or forward(z, s) ->"
            f" (rho, s), given a forward with {n_arguments} arguments"
        )
    return n_arguments


def _compute_key(module: nn.Module) -> str:
    """Return a digest of class, structure, weights and plain attributes of a module."""
    digest = hashlib.sha256(f"{type(module).__module__}.{type(module).__qualname__}".encode())
    for path, part in module.named_modules():
        attributes = {
            name: value
            for name, value in vars(part).items()
            if isinstance(value, bool | int | float | str | tuple)
        }
        digest.update(f"{path} {type(part).__qualname__} {sorted(attributes.items())}".encode())
    for name, values in module.state_dict().items():
        digest.update(f"{name} {values.dtype} {list(values.shape)}".encode())
        digest.update(values.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


class ModuleHeadConfig(BaseHeadConfig):
    """Head of a `torch.nn.Module` that the user has passed in Python.

    Attributes:
        kind: name of this head in a config.
        key: key of the module in this process.
        class_name: name of the class of the module.
    """

    is_process_local: ClassVar[bool] = True
    kind: Literal["module"] = "module"
    key: str
    class_name: str

    def build(self, names: Sequence[str]) -> ResidualHead:
        """Build the head for channels `names`, with a copy of the registered module.

        Raises:
            ConfigError: if the module is not registered, or its tensors have the wrong shape.
        """
        template = _templates.get(self.key)
        if template is None:
            raise ConfigError(
                f"the head is the Python module {self.class_name}, and a stored model holds its"
                " weights only; load it in Python with residnet.load(..., parts=[MODULE]),"
                f" where MODULE is an instance of {self.class_name}"
            )
        module = copy.deepcopy(template)
        if isinstance(module, ResidualHead):
            return module
        self._check_shapes(module, names)
        if _count_arguments(module) == 1:
            return MemorylessModuleHead(self, module, names)
        return RecurrentModuleHead(self, module, names)

    def _check_shapes(self, module: nn.Module, names: Sequence[str]) -> None:
        """Evaluate a module of the user once.

        Raises:
            ConfigError: if it refuses the channels, or returns other shapes.
        """
        feature_names = self.select_features(names)
        n_dof = get_dof(names).n_dynamic
        z = torch.zeros(2, len(feature_names))
        expected = (
            f"expected z [B, {len(feature_names)}] with the channels"
            f" {', '.join(feature_names)}, and residuals [B, {n_dof}]"
        )
        module = copy.deepcopy(module).eval()
        try:
            with torch.no_grad(), torch.random.fork_rng(devices=[]):
                if _count_arguments(module) == 1:
                    shapes = [list(module(z).shape)]
                    expected_shapes = [[2, n_dof]]
                else:
                    n_state = int(module.n_state)  # type: ignore[arg-type]
                    expected = f"{expected} and memory [B, {n_state}]"
                    shapes = [list(part.shape) for part in module(z, torch.zeros(2, n_state))]
                    expected_shapes = [[2, n_dof], [2, n_state]]
        except Exception as error:
            # a module of the user may raise anything
            line = next(iter(str(error).splitlines()), type(error).__name__)
            raise ConfigError(f"{self.class_name}: {line}; {expected}") from error
        if shapes != expected_shapes:
            raise ConfigError(
                f"{self.class_name}: returns tensors of the shapes"
                f" {', '.join(map(str, shapes))} for two rows; {expected}"
            )


@final
class MemorylessModuleHead(ResidualHead):
    """Head with the residual rho = std * module(features)."""

    def __init__(self, config: ModuleHeadConfig, module: nn.Module, names: Sequence[str]) -> None:
        super().__init__(names)
        self.features = Features(config.select_features(names), names, config.margin)
        self.scale = ResidualScale(self.n_dof)
        self.module = module

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.scale(self.module(self.features(z))), s


@final
class RecurrentModuleHead(ResidualHead):
    """Head with rho = std * output, where (output, next memory) = module(features, memory)."""

    def __init__(self, config: ModuleHeadConfig, module: nn.Module, names: Sequence[str]) -> None:
        super().__init__(names)
        self.features = Features(config.select_features(names), names, config.margin)
        self.scale = ResidualScale(self.n_dof)
        self.module = module
        self.n_state = int(module.n_state)  # type: ignore[arg-type]

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        output, next_memory = self.module(self.features(z), s)
        return self.scale(output), next_memory
