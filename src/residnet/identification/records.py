"""Typed contents of fit.json, the notes on the fit of one model."""

from __future__ import annotations

from pydantic import ConfigDict, Field

from residnet.core.records import FileRecord, Record

Hyperparameter = float | str | tuple[float | str, ...]
"""A selected setting; several values where it differs between the axes."""


class OpenRecord(Record):
    """A JSON object with some known keys; heads and baselines may add others."""

    model_config = ConfigDict(extra="allow")


class CoefficientRow(OpenRecord):
    """A coefficient of a model that is linear in its terms.

    Attributes:
        axis: name of the acceleration.
        term: the regressor.
        value: the coefficient.
        standard_error: its standard error; zero for an exact value.
    """

    axis: str
    term: str
    value: float
    standard_error: float


class EpochRow(OpenRecord):
    """An epoch of the training of a network.

    Attributes:
        epoch: number from 0 on.
        stage: number of the training stage, from 0 on.
        loss: mean training loss of the epoch.
        validation: free-run error over the validation logs; None if it was not computed.
    """

    epoch: float
    stage: float = 0.0
    loss: float | None = None
    validation: float | None = None


class GenerationRow(OpenRecord):
    """The best individual of a generation of a symbolic regression.

    Attributes:
        train: mean square error over the target's mean square, on the samples that breed.
        validation: the same on the samples that validate.
    """

    train: float
    validation: float


class EquationNotes(OpenRecord):
    """The equation of one acceleration.

    Attributes:
        text: the equation.
        error_share: root mean square error over the root mean square target.
        exact: whether the error is at the level of rounding errors.
        candidates: number of candidate terms that differ on the data.
        condition: condition number of the candidates.
        same_as_simpler: terms that equal a combination of simpler ones on the data.
        cannot_tell_apart: candidates that could replace each term.
        undecided: largest share of the target that each omitted candidate may explain.
        lack_of_fit: share of the mean square of the residual of all candidates that functions of
            the named channels predict in cross-validation.
        generation: generation of the selected equation, of a symbolic regression.
        history: all generations; empty for other estimators.
    """

    text: str = ""
    error_share: float = 0.0
    exact: bool = False
    candidates: int = 0
    condition: float = 1.0
    same_as_simpler: dict[str, dict[str, float]] = Field(default_factory=dict)
    cannot_tell_apart: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    undecided: dict[str, float] = Field(default_factory=dict)
    lack_of_fit: dict[str, float] = Field(default_factory=dict)
    generation: int = 0
    history: tuple[GenerationRow, ...] = ()


class TrainingStageNotes(OpenRecord):
    """A stage of training over free runs.

    Attributes:
        horizon: length of the free runs in s.
    """

    horizon: float


class TrainingNotes(OpenRecord):
    """The training settings of a network.

    Attributes:
        multi_step: stages over free runs.
    """

    multi_step: tuple[TrainingStageNotes, ...] = ()


class InputDelay(OpenRecord):
    """The delay of the inputs of an equation.

    Attributes:
        seconds: the delay in s.
    """

    seconds: float


class RefitNotes(OpenRecord):
    """The refit of a baseline through rollouts.

    Attributes:
        at_rest: indices of the parameters that are held at zero.
    """

    at_rest: tuple[int, ...] = ()


class SteadyConstraint(OpenRecord):
    """The linear relation between a steady state and the force that drives it.

    Attributes:
        phi: steady state per unit of force.
        phi_error: its standard error.
        bias: steady state without force.
        bias_error: its standard error.
    """

    phi: float
    phi_error: float
    bias: float = 0.0
    bias_error: float = 0.0


class FitNotes(FileRecord):
    """models/<model>/fit.json: the notes on the fit of one model.

    Attributes:
        seconds: duration of the fit in s.
        samples: number of training samples.
        validation: mean free-run error over the validation logs; None if it is not finite.
        validation_diverged: number of diverged validation windows.
        baseline: name of the baseline below a head.
        members: members of an ensemble.
        parameters: number of fitted parameters.
        terms: number of basis functions, for each axis where it differs.
        order: number of latent variables, for each axis where it differs.
        penalty: penalty of a regression, for each axis where it differs.
        epochs: number of training epochs.
        training: settings of the training; None for other models.
        curve: training by epoch.
        coefficients: coefficients of all axes.
        equations: equation of each acceleration.
        unexcited: candidate terms that are zero in all samples.
        delay: delay of the inputs of an equation; None without one.
        refit: refit through rollouts; None without one.
        prior: standard deviation of the prior of a refit.
        feeding: axis and term of the parameters that a refit holds at zero, because their sign
            would feed energy.
        open: axis and term of the parameters that the data do not determine.
        steady_states: means of the settled parts of manoeuvres by state and force.
        steady_constraints: relation of each steady state to its force.
    """

    model_config = ConfigDict(extra="allow")

    seconds: float | None = None
    samples: int | None = None
    validation: float | None = None
    validation_diverged: int = 0
    baseline: str = "baseline"
    members: tuple[str, ...] = ()
    parameters: float | None = None
    terms: Hyperparameter | None = None
    order: Hyperparameter | None = None
    penalty: Hyperparameter | None = None
    epochs: int | None = None
    training: TrainingNotes | None = None
    curve: tuple[EpochRow, ...] = ()
    coefficients: tuple[CoefficientRow, ...] = ()
    equations: dict[str, EquationNotes] = Field(default_factory=dict)
    unexcited: tuple[str, ...] = ()
    delay: InputDelay | None = None
    refit: RefitNotes | None = None
    prior: float | None = None
    feeding: tuple[tuple[str, str], ...] = ()
    open: tuple[tuple[str, str], ...] = ()
    steady_states: dict[str, tuple[float, ...]] = Field(default_factory=dict)
    steady_constraints: dict[str, SteadyConstraint] = Field(default_factory=dict)
