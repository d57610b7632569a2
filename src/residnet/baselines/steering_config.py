"""Configuration of first-order models of speed and steering."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar, Literal, NamedTuple, final

from residnet.baselines.config import IdentifiedConfig, require_channels
from residnet.baselines.sets import active_terms
from residnet.core.config import Seconds
from residnet.core.errors import FitError
from residnet.core.names import VELOCITY_NAMES
from residnet.core.sample_origins import SampleOrigins
from residnet.physics.symmetry import get_dof
from residnet.physics.terms import parse_term

if TYPE_CHECKING:
    from residnet.baselines.base import Baseline
    from residnet.baselines.regressors import RegressorBaseline
    from residnet.core.samples import Samples
    from residnet.regression.estimator import Solution


_MIN_STEADY_MANOEUVRES = 3
"""Number of manoeuvres with constant input from which steady states are identified."""


class SteeringBaselineConfig(IdentifiedConfig, ABC):
    """Common base of the configurations of models of speed and steering.

    Attributes:
        drive: input channel of surge.
        steer: input channel of steering.
    """

    required_velocities: ClassVar[tuple[str, ...]] = VELOCITY_NAMES
    """Velocities that the model must have."""

    kind: str
    drive: str
    steer: str

    @abstractmethod
    def axis_terms(self) -> tuple[tuple[str, ...], ...]:
        """Return the terms of surge, sway and yaw.

        Sway with the only term `v` decays with the time constant of yaw.
        """

    @final
    def check_channels(self, names: Sequence[str]) -> None:
        for axis_terms in self._active_axis_terms(names):
            for term in axis_terms:
                parse_term(term, names)

    @final
    def is_parametric(self, names: Sequence[str]) -> bool:
        return True

    @final
    def has_regressors(self, names: Sequence[str]) -> bool:
        return True

    @final
    def has_inertia_matrix(self, names: Sequence[str]) -> bool:
        return False

    @final
    def build(self, names: Sequence[str]) -> RegressorBaseline:
        from residnet.baselines.regressors import RegressorBaseline

        terms_by_axis = self._active_axis_terms(names)
        # the decay of sway is a copy of the yaw coefficient, which a refit must not change
        return RegressorBaseline(
            terms_by_axis, names, ((1, "v"),) if terms_by_axis[1] == ("v",) else ()
        )

    def _active_axis_terms(self, names: Sequence[str]) -> list[tuple[str, ...]]:
        """Return the terms per axis for channels `names`.

        Raises:
            ConfigError: if a required channel is missing.
        """
        velocities = get_dof(names).velocities
        # a model of surge only needs no steering channel, and one without surge no propulsion
        driving = (
            [self.drive] if velocities == ("u",) else [self.steer] if "u" not in velocities else []
        )
        driving = driving or [self.drive, self.steer]
        require_channels(names, (*self.required_velocities, *driving), f"baseline '{self.kind}'")
        return active_terms(self.axis_terms(), names)


class NomotoLagConfig(SteeringBaselineConfig, ABC):
    """Common base of the configurations of both Nomoto models.

    The equations are T_u u_dot + u = K_u drive + b_u (eq. (12)) and T r_dot + r = K steer + b
    (eq. (13)).

    Attributes:
        manoeuvres: kinds of manoeuvre to fit on; empty for all.
    """

    sway_terms: ClassVar[tuple[str, ...]] = ("v",)

    drive: str = "n"
    steer: str = "delta"
    manoeuvres: tuple[str, ...] = ()

    @final
    def axis_terms(self) -> tuple[tuple[str, ...], ...]:
        return ("u", self.drive, "1"), self.sway_terms, ("r", self.steer, "1")

    @final
    def validate_samples(self, samples: SampleOrigins) -> None:
        samples.require_manoeuvres(self.manoeuvres)

    @final
    def fit_solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        from residnet.baselines.regressors import RegressorBaseline
        from residnet.baselines.steering import fit_nomoto

        assert isinstance(baseline, RegressorBaseline)
        return [fit_nomoto(self, baseline, samples)]


class NomotoBaselineConfig(NomotoLagConfig):
    """Nomoto model of first order, T r_dot + r = K steer + b.

    Surge is a first-order lag of the propulsion command. Sway, which the model does not describe,
    decays with T. If the model has only surge or only yaw, only its lag is identified.
    """

    required_velocities = ()

    kind: Literal["nomoto"] = "nomoto"


class NomotoSideslipBaselineConfig(NomotoLagConfig):
    """Nomoto model with sideslip (Woo et al. 2018, eqs. (14), (15)).

    T_beta beta_dot + beta = -K_beta r + b_beta, formulated for v = u beta.
    """

    sway_terms = ("v", "u r", "u")

    kind: Literal["nomoto_sideslip"] = "nomoto_sideslip"


class SteadyStateBlock(NamedTuple):
    """States with a common input, and the kinds of manoeuvre that identify their dynamics."""

    states: tuple[str, ...]
    input_name: str
    manoeuvre_kinds: tuple[str, ...]


class LinearSteadyConfig(SteeringBaselineConfig):
    """Linear models u_dot = a u + k tau + c and (v, r)_dot = A (v, r) + B tau + C.

    The equations are (12) and (16) of Woo et al. 2018. Steady states of constant-input manoeuvres
    give x_ss = Phi tau + Phi_bias by least squares (eqs. (24), (32)). Then x_dot = A (x - Phi tau -
    Phi_bias) gives A by least squares on derivatives (eq. (29)), and B = -A Phi (eq. (28)). Nomoto
    models are identified by the same method.

    Attributes:
        steering_model: `linear` is (16). `nomoto` is (13), with a sway velocity that decays with
            the yaw time constant. `nomoto_sideslip` is (15) with sway velocity instead of sideslip
            and the yaw rate as the input of sway.
        steady: kinds of manoeuvre with constant input.
        settled: time after the start of a constant-input manoeuvre from which samples count as
            steady.
        speed: kinds of manoeuvre that identify a.
        steering: kinds of manoeuvre that identify A.
    """

    kind: Literal["linear_steady"] = "linear_steady"
    drive: str = "tau_x"
    steer: str = "tau_n"
    steering_model: Literal["linear", "nomoto", "nomoto_sideslip"] = "linear"
    steady: tuple[str, ...] = ("constant",)
    settled: Seconds = 40.0
    speed: tuple[str, ...] = ("acceleration_deceleration",)
    steering: tuple[str, ...] = ("zigzag", "three_two_one_one")

    def axis_terms(self) -> tuple[tuple[str, ...], ...]:
        terms_of_axis: dict[str, tuple[str, ...]] = {"v": ("v",)}
        for block in self.steady_state_blocks():
            terms_of_axis |= dict.fromkeys(block.states, (*block.states, block.input_name, "1"))
        return tuple(terms_of_axis[axis] for axis in VELOCITY_NAMES)

    def steady_state_blocks(self) -> list[SteadyStateBlock]:
        """Return the states that are identified together, with their input."""
        yaw_block = SteadyStateBlock(("r",), self.steer, self.steering)
        steering_blocks = {
            "linear": [SteadyStateBlock(("v", "r"), self.steer, self.steering)],
            "nomoto": [yaw_block],
            "nomoto_sideslip": [SteadyStateBlock(("v",), "r", self.steering), yaw_block],
        }
        return [
            SteadyStateBlock(("u",), self.drive, self.speed),
            *steering_blocks[self.steering_model],
        ]

    def validate_samples(self, samples: SampleOrigins) -> None:
        """Check that the samples contain all required kinds of manoeuvre.

        Raises:
            FitError: if a kind is missing.
        """
        self.require_steady_manoeuvres(samples)
        for kinds in (self.speed, self.steering):
            samples.require_manoeuvres(kinds)

    def fit_solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        from residnet.baselines.regressors import RegressorBaseline
        from residnet.baselines.steering import fit_steady_states

        assert isinstance(baseline, RegressorBaseline)
        return [fit_steady_states(self, baseline, samples)]

    def require_steady_manoeuvres(self, samples: SampleOrigins) -> None:
        """Check that there are enough manoeuvres with constant input for the steady states.

        Raises:
            FitError: if there are not.
        """
        steady = samples.select_manoeuvres(self.steady)
        n_manoeuvres = steady.select(steady.t >= self.settled).n_groups
        if n_manoeuvres < _MIN_STEADY_MANOEUVRES:
            raise FitError(
                "baseline 'linear_steady' needs at least 3 constant-input manoeuvres of kinds"
                f" {list(self.steady)} longer than {self.settled:g} s, the data have"
                f" {n_manoeuvres}; kinds in the data: {sorted(set(samples.kinds))}"
            )
