"""Where a network is trained: device, precision and processes. No Lightning here."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from residnet.core.config import Config
from residnet.core.errors import UsageError


class MachineConfig(Config):
    """What a training runs on.

    Attributes:
        device: `cpu`, `cuda`, `cuda:1` for the second GPU, or `auto` for a GPU where there is one.
            Free runs that validate are run on the CPU whatever it is.
        precision: of numbers, by Lightning's names: `32-true` or `64-true`. Half precision is not
            offered: the baseline's accelerations, which a rollout adds up, would be off by a
            hundredth.
        processes: that share each batch, each on a device of its own (ddp).
    """

    device: str = Field(default="cpu", pattern=r"^(auto|cpu|cuda(:\d{1,3})?)$")
    precision: Literal["32-true", "64-true"] = "32-true"
    processes: int = Field(default=1, ge=1, le=1_024)

    @property
    def double(self) -> bool:
        """Return whether weights and windows are float64."""
        return self.precision == "64-true"

    def for_lightning(self) -> dict[str, Any]:
        """Return the arguments of Lightning's trainer.

        Raises:
            UsageError: where the machine has no such device.
        """
        import torch

        found = torch.cuda.device_count()
        kind, _, number = self.device.partition(":")
        if kind == "auto":
            kind = "cuda" if found else "cpu"
        first = int(number or 0)
        if kind == "cuda" and first + self.processes > found:
            raise UsageError(
                f"device: {self.device} with {self.processes} processes needs"
                f" {first + self.processes} GPUs, and PyTorch finds {found}; give device: cpu, or"
                " auto"
            )
        devices: int | list[int] = self.processes
        if kind == "cuda":
            devices = list(range(first, first + self.processes))
        return {
            "accelerator": "gpu" if kind == "cuda" else "cpu",
            "devices": devices,
            "precision": self.precision,
            # stages train different parameters
            "strategy": "auto" if self.processes == 1 else "ddp_spawn_find_unused_parameters_true",
        }
