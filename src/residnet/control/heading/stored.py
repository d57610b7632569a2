"""Descriptions of trained heading controllers, from which they are built again."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from residnet.control.heading.document_autopilot import NetworkPredictor
from residnet.control.heading.policy import HeadingPolicy
from residnet.control.heading.turning import Turning
from residnet.dynamics.store import Stored, read_spec, read_weights


class HeadingPolicySpec(Stored):
    """A description of a neural heading autopilot.

    Attributes:
        schema_name: kind and version of the format.
        state: names of the state of the vessel that it was trained on.
        gain: K of that vessel about straight ahead in 1/s.
        time: T of that vessel in s.
        speed: at which K and T hold, in m/s.
        limit: of the rudder in rad.
        rate: of the rudder in rad/s; None where it stands at its command at once.
        dt: step of its training in s.
        hidden: widths of the layers.
        observer: bandwidth of the estimator as a multiple of 1/T.
    """

    schema_name: Literal["residnet.heading_policy/1"] = Field(
        default="residnet.heading_policy/1", alias="schema"
    )
    state: tuple[str, ...]
    gain: float
    time: float = Field(gt=0)
    speed: float
    limit: float = Field(gt=0)
    rate: float | None = Field(gt=0)
    dt: float = Field(gt=0)
    hidden: tuple[int, ...]
    observer: float

    def build(self) -> HeadingPolicy:
        """Return the policy with its weights not yet trained."""
        return HeadingPolicy(
            self.state,
            turning=Turning(self.gain, self.time, self.speed),
            limit=self.limit,
            dt=self.dt,
            rate=self.rate,
            hidden=self.hidden,
            observer=self.observer,
        )


class PredictorSpec(Stored):
    """A description of a network that predicts heading and yaw rate by rudder angle.

    Attributes:
        schema_name: kind and version of the format.
        state: names of the state of the vessel that it was trained on.
        candidates: number of rudder angles.
        hidden: widths of the layers.
        linear: without activations.
    """

    schema_name: Literal["residnet.heading_predictor/1"] = Field(
        default="residnet.heading_predictor/1", alias="schema"
    )
    state: tuple[str, ...]
    candidates: int = Field(ge=1, le=10_001)
    hidden: tuple[int, ...]
    linear: bool

    def build(self) -> NetworkPredictor:
        """Return the network with its weights not yet trained, in float64."""
        return NetworkPredictor(
            self.state, candidates=self.candidates, hidden=self.hidden, linear=self.linear
        ).double()


def load_heading_policy(folder: Path) -> HeadingPolicy:
    """Read a trained autopilot, frozen and in float64.

    Raises:
        UsageError: where the folder holds none, or one that is not as it was written.
    """
    policy = read_spec(folder, HeadingPolicySpec).build()
    read_weights(folder, policy)
    return policy.eval().requires_grad_(False).double()
