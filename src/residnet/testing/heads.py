"""The contract of residual heads."""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from residnet.core.config import validate
from residnet.core.registry import kind_of
from residnet.dynamics.store import load_model, save_model
from residnet.heads import HeadConfig, ResidualHead
from residnet.heads.base import FeatureConfig
from residnet.testing.examples import example_model, example_samples, example_spec
from residnet.testing.require import require, require_equal, require_finite

_ROWS, _STEPS = 4, 12


def check_head(config: FeatureConfig) -> None:
    """Check everything that residnet relies on in a head.

    Shapes and precision, a residual that is not zero, equal answers for equal questions, rows of a
    batch that do not see each other, sequences that equal steps, the memory of a past, TorchScript,
    finite answers far outside of the training range, gradients, and a model that is stored and
    loaded without a change.

    Args:
        config: of the head; it must work with the channels of `example_samples`.

    Raises:
        AssertionError: one line that says which contract is broken.
    """
    who = f"head {kind_of(type(config))}"
    head = fitted_head(config)
    for dtype in (torch.float32, torch.float64):
        _check_step(head.to(dtype), dtype, who)
    _check_memory(head.double(), who)
    _check_batch(head.double(), who)
    _check_script(head.float(), who)
    _check_far(head.double(), who)
    _check_gradient(head.double(), who)
    _check_parameters(head, who)
    _check_config(config, who)
    _check_store(config, who)


def fitted_head(config: FeatureConfig) -> ResidualHead:
    """Return the head of a config with its scales, fitted where it has a closed form."""
    return example_model(example_spec(config)).head.eval()


def typical() -> Tensor:
    """Return channels [4, 12, 8] from the middle of the example samples, float64."""
    z = example_samples().z
    start = torch.arange(_ROWS) * (len(z) // _ROWS) + 30
    return z[start[:, None] + torch.arange(_STEPS)[None]]


def _zeros(head: ResidualHead, rows: int, dtype: torch.dtype) -> Tensor:
    return torch.zeros(rows, head.n_state, dtype=dtype)


def _steps(head: ResidualHead, z: Tensor) -> tuple[Tensor, Tensor]:
    s, residuals = _zeros(head, len(z), z.dtype), []
    with torch.no_grad():
        for k in range(z.shape[1]):
            rho, s = head(z[:, k], s)
            residuals.append(rho)
    return torch.stack(residuals, dim=1), s


def _check_step(head: ResidualHead, dtype: torch.dtype, who: str) -> None:
    z = typical().to(dtype)[:, 0]
    s = _zeros(head, _ROWS, dtype)
    with torch.no_grad():
        rho, after = head(z, s)
        again, _ = head(z, s)
    require(rho.shape == (_ROWS, 3), f"{who}: the residual has the shape {rho.shape}, not [B, 3]")
    require(
        after.shape == (_ROWS, head.n_state),
        f"{who}: the memory has the shape {after.shape}, not [B, n_state = {head.n_state}]",
    )
    require(
        rho.dtype == after.dtype == dtype,
        f"{who}: answers {rho.dtype} and {after.dtype} where it is asked in {dtype}",
    )
    require_finite(rho, f"{who}: the residual at a training sample is not finite")
    require(float(rho.abs().max()) > 0, f"{who}: the residual is zero everywhere")
    require(torch.equal(rho, again), f"{who}: two answers to one question differ; is it in eval?")


def _check_memory(head: ResidualHead, who: str) -> None:
    z = typical()
    residuals, memory = _steps(head, z)
    with torch.no_grad():
        require_equal(head.sequence(z), residuals, 1e-9, f"{who}: sequence differs from steps")
        require_equal(head.warmup(z), memory, 1e-9, f"{who}: warmup differs from the steps' memory")
        empty = head.warmup(z[:, :0])
    require_equal(
        empty,
        _zeros(head, _ROWS, z.dtype),
        0.0,
        f"{who}: the memory without a past is not zeros [B, {head.n_state}]",
    )


def _check_batch(head: ResidualHead, who: str) -> None:
    z = typical()
    with torch.no_grad():
        whole = head.sequence(z)
        step, _ = head(z[:, 0], _zeros(head, _ROWS, z.dtype))
        for i in range(_ROWS):
            alone = head.sequence(z[i : i + 1])
            single, _ = head(z[i : i + 1, 0], _zeros(head, 1, z.dtype))
            message = f"{who}: the answer for a row depends on the other rows of the batch"
            require_equal(alone, whole[i : i + 1], 1e-9, message)
            require_equal(single, step[i : i + 1], 1e-9, message)


def _check_script(head: ResidualHead, who: str) -> None:
    z = typical().float()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            compiled: Any = torch.jit.script(head)
        except Exception as error:  # the compiler raises whatever it likes
            lines = [line.strip() for line in str(error).splitlines() if line.strip()]
            raise AssertionError(f"{who}: TorchScript cannot compile it: {lines[0]}") from error
    residuals, memory = _steps(head, z)
    same, after = _steps_of(compiled, head, z)
    require_equal(same, residuals, 1e-5, f"{who}: the scripted head gives other residuals")
    require_equal(after, memory, 1e-5, f"{who}: the scripted head keeps another memory")


def _steps_of(compiled: Any, head: ResidualHead, z: Tensor) -> tuple[Tensor, Tensor]:
    s, residuals = _zeros(head, len(z), z.dtype), []
    with torch.no_grad():
        for k in range(z.shape[1]):
            rho, s = compiled(z[:, k], s)
            residuals.append(rho)
    return torch.stack(residuals, dim=1), s


def _check_far(head: ResidualHead, who: str) -> None:
    z = example_samples().z
    far = (z.mean(0) + 1e6 * z.std(0))[None]
    further = (z.mean(0) + 1e9 * z.std(0))[None]
    with torch.no_grad():
        rho, memory = head(far, _zeros(head, 1, z.dtype))
        beyond, _ = head(further, _zeros(head, 1, z.dtype))
        inside = float(head.sequence(typical()).abs().max())
        held = head.sequence(far.expand(200, -1)[None])
    require_finite(torch.cat((rho, beyond)), f"{who}: not finite far outside of the training range")
    require_finite(memory, f"{who}: its memory is not finite far outside of the training range")
    require_finite(held, f"{who}: not finite after 200 steps outside of the training range")
    largest = float(held.abs().max())
    require(
        largest < 50 * inside + 10,
        f"{who}: runs away outside of the training range ({largest:.3g}, inside {inside:.3g});"
        " hold the features at its edge (residnet.heads.base.Features)",
    )


def _check_gradient(head: ResidualHead, who: str) -> None:
    z = typical()[:, 0].requires_grad_()
    rho, _ = head(z, _zeros(head, _ROWS, z.dtype))
    rho.sum().backward()
    require(z.grad is not None, f"{who}: cannot be differentiated with respect to the channels")
    assert z.grad is not None
    require_finite(z.grad, f"{who}: its gradient with respect to the channels is not finite")
    require(float(z.grad.abs().max()) > 0, f"{who}: its gradient is zero everywhere")


def _check_parameters(head: ResidualHead, who: str) -> None:
    counts = head.parameter_count()
    require(
        len(counts) == 3 and all(count >= 0 for count in counts),
        f"{who}: parameter_count gives {counts}, not one number for each of three axes",
    )
    spread = head.residual_std()
    require(
        spread.shape == (3,) and bool((spread > 0).all()),
        f"{who}: residual_std gives {spread.tolist()}, not three positive numbers",
    )


def _check_config(config: FeatureConfig, who: str) -> None:
    written = config.model_dump(mode="json")
    try:
        again = validate(written, type(config), "written")
        known = validate(written, HeadConfig, "written")
    except Exception as error:  # also of a validator that the part brings
        raise AssertionError(f"{who}: its config cannot be read back: {error}") from error
    require(again == config, f"{who}: its config changes when it is written and read back")
    require(type(known) is type(config), f"{who}: its name leads to {type(known).__name__} instead")


def _check_store(config: FeatureConfig, who: str) -> None:
    spec = example_spec(config)
    model = example_model(spec)
    with tempfile.TemporaryDirectory() as folder:
        save_model(Path(folder) / "example", spec, model)
        stored_spec, stored = load_model(Path(folder) / "example")
    require(stored_spec == spec, f"{who}: its description changes when it is stored")
    state = model.state_dict()
    for name, value in stored.state_dict().items():
        require(
            value.dtype == state[name].dtype and torch.equal(value, state[name]),
            f"{who}: '{name}' changes when the model is stored",
        )
    z = typical()
    with torch.no_grad():
        require_equal(
            stored.head.double().eval().sequence(z),
            model.head.double().eval().sequence(z),
            0.0,
            f"{who}: the stored model gives other residuals",
        )
