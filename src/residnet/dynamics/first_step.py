"""First step of heads and baselines of other packages: errors that name the part.

An error in the code of a user would otherwise appear in the middle of a fit as an internal error of
residnet.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from residnet.baselines.base import Baseline
from residnet.baselines.config import IdentifiedConfig
from residnet.core.errors import ConfigError, ResidnetError
from residnet.core.external_parts import describe_part_class, describe_part_error
from residnet.heads.base import ClosedFormHead, ResidualHead
from residnet.heads.config import BaseHeadConfig
from residnet.physics.symmetry import get_dof

_N_ROWS = 13
"""Rows of the first step; a prime number rarely equals the number of features or of axes."""


def check_first_step(config: BaseHeadConfig | IdentifiedConfig, names: Sequence[str]) -> None:
    """Build a head or a baseline and evaluate one step at channels that are zero.

    A closed-form head is only built, because it has no coefficients before its fit.

    Args:
        config: config of the part.
        names: channels of the model.

    Raises:
        ConfigError: if `build` or `forward` raises an error, or returns another type or shape.
    """
    is_head = isinstance(config, BaseHeadConfig)
    expected_class: type[Any] = ResidualHead if is_head else Baseline
    subject = f"{'head' if is_head else 'baseline'} '{config.kind}'"
    # the generator is restored, so that the check changes no initial weights
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        try:
            part = config.build(names)
        except ResidnetError:
            raise
        except Exception as error:  # the code of a user may raise anything
            raise ConfigError(
                f"{subject} {describe_part_class(type(config), config)}:"
                f" {describe_part_error(error, type(config), 'build')}"
            ) from error
        subject = f"{subject} {describe_part_class(type(part), config)}"
        if not isinstance(part, expected_class):
            raise ConfigError(
                f"{subject}: build returned {type(part).__name__}, expected a"
                f" {expected_class.__name__}"
            )
        if isinstance(part, ClosedFormHead):
            return
        try:
            if isinstance(part, ResidualHead):
                _check_head_step(part.float().eval(), names, subject)
            elif isinstance(part, Baseline):
                # baselines are identified in double precision
                _check_baseline_step(part.double().eval(), names, subject)
        except ResidnetError:
            raise
        except Exception as error:
            raise ConfigError(
                f"{subject}: {describe_part_error(error, type(part), 'forward')}"
            ) from error


def _check_head_step(head: ResidualHead, names: Sequence[str], subject: str) -> None:
    """Check types and shapes of the residual and the memory of one step."""
    head.set_inertia(torch.eye(3, dtype=torch.float64))
    # the innovation, or the indicator of measured states, follows the channels
    n_extra = head.n_dof if head.innovation_time_constant > 0.0 else 0
    n_extra = 1 if head.has_encoder else n_extra
    n_rows = _N_ROWS * head.batch_ensemble_size
    result: Any = head(torch.zeros(n_rows, len(names) + n_extra), torch.zeros(n_rows, head.n_state))
    expected = f"expected (residual [B, {head.n_dof}], memory [B, {head.n_state}])"
    if not (
        isinstance(result, tuple)
        and len(result) == 2
        and all(isinstance(part, Tensor) for part in result)
    ):
        raise ConfigError(f"{subject}: forward returned {_describe_result(result)}, {expected}")
    if [list(part.shape) for part in result] != [[n_rows, head.n_dof], [n_rows, head.n_state]]:
        shapes = ", ".join(_describe_shape(part, n_rows) for part in result)
        raise ConfigError(f"{subject}: forward returned ({shapes}), {expected}")


def _check_baseline_step(baseline: Baseline, names: Sequence[str], subject: str) -> None:
    """Check type and shape of the accelerations of one step."""
    n_dof = get_dof(names).n_dynamic
    result: Any = baseline(torch.zeros(_N_ROWS, len(names), dtype=torch.float64))
    expected = f"expected accelerations [B, {n_dof}]"
    if not isinstance(result, Tensor):
        raise ConfigError(f"{subject}: forward returned {_describe_result(result)}, {expected}")
    if list(result.shape) != [_N_ROWS, n_dof]:
        shape = _describe_shape(result, _N_ROWS)
        raise ConfigError(f"{subject}: forward returned {shape}, {expected}")


def _describe_result(result: Any) -> str:
    """Return the type of a result for messages; of a tuple the types of its items."""
    if isinstance(result, tuple):
        return f"({', '.join(type(item).__name__ for item in result)})"
    return type(result).__name__


def _describe_shape(tensor: Tensor, n_rows: int) -> str:
    """Return the shape of a tensor for messages, with the batch size as `B`."""
    sizes = ["B" if size == n_rows else str(size) for size in tensor.shape]
    return f"[{', '.join(sizes)}]"
