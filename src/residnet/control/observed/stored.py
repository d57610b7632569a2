"""Descriptions of recurrent heading policies, from which they are built again."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from residnet.control.heading.turning import Turning
from residnet.control.observed.config import AnyObserved
from residnet.control.observed.network import NetworkPolicy
from residnet.control.observed.policy import ObservedPolicy
from residnet.dynamics.store import Stored, read_spec, read_weights


class ObservedPolicySpec(Stored):
    """A description of a heading policy with observer, predictor and recurrent network.

    Attributes:
        schema_name: kind and version of the format.
        state: names of the state of the vessel that it was trained on.
        gain: K of that vessel about straight ahead in 1/s.
        time: T of that vessel in s.
        speed: at which K and T hold, in m/s.
        limit: of the rudder in rad.
        rate: of the rudder in rad/s; None where it stands at its command at once.
        dt: step in s that it runs with.
        trained_at: step of its training in s.
        law: with the constants that its training began with.
        units: of the network; 0 for none.
    """

    schema_name: Literal["residnet.observed_policy/1"] = Field(
        default="residnet.observed_policy/1", alias="schema"
    )
    state: tuple[str, ...]
    gain: float
    time: float = Field(gt=0)
    speed: float
    limit: float = Field(gt=0)
    rate: float | None = Field(gt=0)
    dt: float = Field(gt=0)
    trained_at: float = Field(gt=0)
    law: AnyObserved
    units: int = Field(ge=0, le=10_000)

    def build(self) -> ObservedPolicy:
        """Return the policy with its network not yet trained."""
        return ObservedPolicy(
            self.state,
            turning=Turning(self.gain, self.time, self.speed),
            law=self.law.law(self.limit, self.rate),
            constants=self.law.complete(),
            limit=self.limit,
            dt=self.dt,
            rate=self.rate,
            lag=self.law.lag,
            units=self.units,
            trained_at=self.trained_at,
        )


class NetworkPolicySpec(Stored):
    """A description of a heading policy that is a recurrent network alone.

    Attributes:
        schema_name: kind and version of the format.
        state: names of the state of the vessel that it was trained on.
        gain: K of that vessel about straight ahead in 1/s.
        time: T of that vessel in s.
        speed: at which K and T hold, in m/s.
        limit: of the rudder in rad.
        rate: of the rudder in rad/s; None where it stands at its command at once.
        dt: step in s that it runs with.
        trained_at: step of its training in s.
        units: of the network.
    """

    schema_name: Literal["residnet.network_policy/1"] = Field(
        default="residnet.network_policy/1", alias="schema"
    )
    state: tuple[str, ...]
    gain: float
    time: float = Field(gt=0)
    speed: float
    limit: float = Field(gt=0)
    rate: float | None = Field(gt=0)
    dt: float = Field(gt=0)
    trained_at: float = Field(gt=0)
    units: int = Field(ge=1, le=10_000)

    def build(self) -> NetworkPolicy:
        """Return the policy with its network not yet trained."""
        return NetworkPolicy(
            self.state,
            turning=Turning(self.gain, self.time, self.speed),
            limit=self.limit,
            dt=self.dt,
            rate=self.rate,
            units=self.units,
            trained_at=self.trained_at,
        )


RecurrentSpec = ObservedPolicySpec | NetworkPolicySpec
RecurrentPolicy = ObservedPolicy | NetworkPolicy


def load_recurrent(folder: Path, kind: type[RecurrentSpec]) -> RecurrentPolicy:
    """Read a trained recurrent policy, frozen and in float64.

    Args:
        folder: of the policy.
        kind: of its description.

    Raises:
        UsageError: where the folder holds none, or one that is not as it was written.
    """
    policy = read_spec(folder, kind).build()
    read_weights(folder, policy)
    return policy.eval().requires_grad_(False).double()
