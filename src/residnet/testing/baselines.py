"""The contract of baselines."""

from __future__ import annotations

import copy
import warnings

import torch

from residnet.baselines import BaselineConfig, IdentifiedConfig
from residnet.core.config import validate
from residnet.core.registry import kind_of
from residnet.core.samples import Samples
from residnet.testing.examples import example_samples
from residnet.testing.require import require, require_equal, require_finite


def check_baseline(config: IdentifiedConfig, samples: Samples | None = None) -> None:
    """Check everything that residnet relies on in a baseline.

    It is identified from samples, twice with the same result; its accelerations have the right
    shape and precision, are finite, do not depend on the company of a row, can be differentiated
    and compiled by TorchScript; its numbers survive a state dict, its config a file.

    Args:
        config: of the baseline.
        samples: whose target is the measured acceleration [N, 3]; those of a catamaran with two
            propellers (`example_samples`) where None.

    Raises:
        AssertionError: one line that says which contract is broken.
    """
    who = f"baseline {kind_of(type(config))}"
    known = example_samples() if samples is None else samples
    resolved = config.resolved()
    baseline, again = (resolved.build(known.names) for _ in range(2))
    table = resolved.fit(baseline, known)
    require(resolved.fit(again, known) == table, f"{who}: two fits give different coefficients")
    z = known.z[:: max(len(known) // 40, 1)]
    with torch.no_grad():
        accelerations = baseline(z)
        require(
            accelerations.shape == (len(z), 3),
            f"{who}: the accelerations have the shape {accelerations.shape}, not [N, 3]",
        )
        require_finite(accelerations, f"{who}: its accelerations are not finite")
        require_equal(again(z), accelerations, 0.0, f"{who}: two fits give different answers")
        together = baseline(z[None].expand(2, -1, -1))
        require_equal(together[1], accelerations, 1e-12, f"{who}: fails for channels [B, T, nz]")
        message = f"{who}: the answer for a row depends on the other rows of the batch"
        require_equal(baseline(z[3:4]), accelerations[3:4], 1e-9, message)
        single = copy.deepcopy(baseline).float()(z.float())
        require(single.dtype == torch.float32, f"{who}: answers {single.dtype} in float32")
        require_equal(single.double(), accelerations, 1e-3, f"{who}: float32 differs too much")
    moving = z.clone().requires_grad_()
    # a baseline that knows nothing may answer with a constant
    (baseline(moving).sum() + 0.0 * moving.sum()).backward()
    gradient = torch.zeros_like(z) if moving.grad is None else moving.grad
    require_finite(gradient, f"{who}: its gradient with respect to the channels is not finite")
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        try:
            compiled = torch.jit.script(baseline)
        except Exception as error:  # the compiler raises whatever it likes
            lines = [line.strip() for line in str(error).splitlines() if line.strip()]
            raise AssertionError(f"{who}: TorchScript cannot compile it: {lines[0]}") from error
        require_equal(compiled(z), accelerations, 1e-9, f"{who}: scripted, it answers otherwise")
    counts = baseline.parameter_count()
    require(len(counts) == 3, f"{who}: parameter_count gives {counts}, not one for each axis")
    empty = resolved.build(known.names)
    empty.load_state_dict(baseline.state_dict())
    with torch.no_grad():
        require_equal(empty(z), accelerations, 0.0, f"{who}: its state dict does not hold it all")
    read = validate(resolved.model_dump(mode="json"), BaselineConfig, "written")
    require(read == resolved, f"{who}: its config changes when it is written and read back")
