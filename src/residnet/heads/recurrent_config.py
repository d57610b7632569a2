"""Configuration of ensembles of recurrent networks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from residnet.core.config import Seconds
from residnet.heads.config import NetworkConfig

if TYPE_CHECKING:
    from residnet.heads.base import ResidualHead


class GRUEnsembleConfig(NetworkConfig):
    """Ensemble of K recurrent networks, trained as one batch.

    The default cell is the gated recurrent unit (Cho et al. 2014).

    The update gate is the share of the memory retained over `step`. At a shorter time step of the
    model the corresponding root of the gate is used, so that networks trained at a coarse step run
    at a fine one.

    The networks also receive the innovations, which are the one-step prediction errors of the
    acceleration in the measured past, low-pass filtered over two steps. In a free run the
    innovations decay, and the memory retains the information. With `encoder: measurements` they
    receive no innovations: further networks, the encoders, read the measured states and inputs of
    the past and set the memory from which the free run starts.

    Attributes:
        cell: `gru`, or `lstm` for long short-term memory (Hochreiter and Schmidhuber 1997) with a
            forget gate.
        encoder: input of the networks in the measured past: `innovations` or `measurements`.
        members: number of networks; each predicts its own states, and velocities are averaged.
        hidden_size: number of hidden units of each network.
        step: time step of the gates.
        restoring: whether a restoring acceleration acts on velocities outside their training range,
            widened by `margin`, so that networks without a baseline cannot diverge.
    """

    kind: Literal["recurrent"] = "recurrent"
    cell: Literal["gru", "lstm"] = "gru"
    encoder: Literal["innovations", "measurements"] = "innovations"
    members: int = Field(default=1, ge=1, le=100)
    hidden_size: int = Field(default=32, ge=1, le=1_000)
    step: Seconds = Field(default=0.5, gt=0)
    restoring: bool = False

    def has_innovations(self, names: Sequence[str]) -> bool:
        return True

    def build(self, names: Sequence[str]) -> ResidualHead:
        """Build the head for channels `names`."""
        from residnet.heads.recurrent import GRUEnsembleHead

        return GRUEnsembleHead(self, names)
