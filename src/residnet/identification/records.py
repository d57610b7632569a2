"""Typed contents of fit.json, the notes on the fit of one model.

Baselines and residual models (called heads: they add a residual to the accelerations of a baseline)
write these notes. An `alias` is the key in the file.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from pydantic import ConfigDict, Field

from residnet.core.format import channel_title
from residnet.core.records import FileRecord, OpenRecord, Record

Hyperparameter = float | str | tuple[float | str, ...]
"""A selected setting; several values where it differs between the axes."""


class CoefficientRow(OpenRecord):
    """A coefficient of a model that is linear in its terms.

    Attributes:
        axis: name of the acceleration.
        term: the regressor.
        value: the coefficient.
        standard_error: standard error of the coefficient; zero for an exact value.
    """

    axis: str
    term: str
    value: float
    standard_error: float


class EpochRow(OpenRecord):
    """An epoch of the training of a network.

    Attributes:
        epoch: index of the epoch, starting at 0.
        stage: index of the training stage, starting at 0.
        loss: mean training loss of the epoch.
        validation_error: free-run error over the validation logs; None if it was not computed.
    """

    epoch: float
    stage: float = 0.0
    loss: float | None = None
    validation_error: float | None = Field(default=None, alias="validation")


class GenerationRow(OpenRecord):
    """The best individual of a generation of a symbolic regression.

    Attributes:
        training_error: mean square error divided by the mean square of the target, on the training
            samples.
        validation_error: the same ratio on the validation samples.
    """

    training_error: float = Field(alias="train")
    validation_error: float = Field(alias="validation")


class EquationNotes(OpenRecord):
    """The equation of one acceleration.

    Attributes:
        text: the equation.
        error_share: root mean square error over the root mean square target.
        exact: whether the error is at the level of rounding errors.
        candidates: number of candidate terms that are linearly independent on the data.
        condition: condition number of the candidates.
        linear_dependencies: for each term that equals a linear combination of simpler terms on the
            data, the coefficients of this combination by term.
        indistinguishable_terms: for each term of the equation, the candidates that explain the data
            equally well in its place.
        max_omitted_share: for each omitted candidate that may matter, the largest share of the
            target that it could explain within two standard errors of its coefficient.
        lack_of_fit: fraction of the mean square of the residual of all candidates that functions of
            the named channels predict in cross-validation, by names of channels.
        generation: generation of the selected equation, of a symbolic regression.
        history: all generations; empty for other estimators.
    """

    text: str = ""
    error_share: float = 0.0
    exact: bool = False
    candidates: int = 0
    condition: float = 1.0
    linear_dependencies: dict[str, dict[str, float]] = Field(
        default_factory=dict, alias="same_as_simpler"
    )
    indistinguishable_terms: dict[str, tuple[str, ...]] = Field(
        default_factory=dict, alias="cannot_tell_apart"
    )
    max_omitted_share: dict[str, float] = Field(default_factory=dict, alias="undecided")
    lack_of_fit: dict[str, float] = Field(default_factory=dict)
    generation: int = 0
    history: tuple[GenerationRow, ...] = ()


class TrainingStageNotes(OpenRecord):
    """A stage of the training in which the loss is the error of free runs.

    Attributes:
        horizon: length of the free runs in s.
    """

    horizon: float


class TrainingNotes(OpenRecord):
    """The training settings of a network.

    Attributes:
        simulation_stages: stages in which the loss is the error of free runs, in their order.
    """

    simulation_stages: tuple[TrainingStageNotes, ...] = Field(default=(), alias="multi_step")


class InputDelay(OpenRecord):
    """The delay of the inputs of an equation.

    Attributes:
        seconds: the delay in s.
    """

    seconds: float


class RefitNotes(OpenRecord):
    """Re-estimation of the parameters of a baseline that minimises the error of free runs.

    Attributes:
        parameters_fixed_at_zero: indices of the parameters that are fixed at zero.
    """

    parameters_fixed_at_zero: tuple[int, ...] = Field(default=(), alias="at_rest")


class SteadyConstraint(OpenRecord):
    """The linear relation between a steady velocity and the force that drives it.

    It is Phi of Woo et al. 2018, Table 1: velocity = gain * force + bias.

    Attributes:
        gain: steady velocity per unit of force.
        gain_error: standard error of the gain.
        bias: steady velocity without force.
        bias_error: standard error of the bias.
    """

    gain: float = Field(alias="phi")
    gain_error: float = Field(alias="phi_error")
    bias: float = 0.0
    bias_error: float = 0.0


class MemberExclusion(Record):
    """A member that an ensemble does not use for a velocity, with the evidence.

    Attributes:
        member: name of the member.
        velocity: name of the velocity.
        reference: what has a significantly smaller error on validation windows.
        p_value: of the paired one-sided t-test.
    """

    member: str
    velocity: str
    reference: Literal["constant velocity", "the mean of the others"]
    p_value: float


def describe_exclusions(exclusions: Sequence[MemberExclusion]) -> list[str]:
    """Return a sentence for each member and reason, without a full stop."""
    reasons = {
        "constant velocity": "constant velocity has a smaller error",
        "the mean of the others": "the ensemble has a smaller error without it",
    }
    sentences = []
    for member, reference in dict.fromkeys((row.member, row.reference) for row in exclusions):
        rows = [row for row in exclusions if (row.member, row.reference) == (member, reference)]
        velocities = " and ".join(
            f"{channel_title(row.velocity)} (p = {row.p_value:.1g})" for row in rows
        )
        sentences.append(
            f"{member} is not used for {velocities}: on validation logs {reasons[reference]}"
            " (paired t-test)"
        )
    return sentences


class FitNotes(FileRecord):
    """models/<model>/fit.json: the notes on the fit of one model.

    Attributes:
        seconds: duration of the fit in s.
        samples: number of training samples.
        validation_error: mean free-run error over the validation logs; None if it is not finite.
        validation_diverged: number of diverged validation windows.
        baseline: name of the baseline to which a head adds its residual.
        members: members of an ensemble.
        excluded_members: names of models that are not in an ensemble, because they diverged or are
            not used for any velocity.
        exclusions: velocities for which a member of an ensemble is not used.
        parameters: number of fitted parameters.
        n_terms: number of basis functions; one number per axis if the axes differ.
        order: number of latent variables; one number per axis if the axes differ.
        penalty: penalty of a regression; one value per axis if the axes differ.
        epochs: number of training epochs.
        training: training settings of a network; None for other models.
        training_history: losses and validation errors by epoch.
        coefficients: coefficients of all axes.
        equations: equation of each acceleration.
        unexcited: candidate terms that are zero in all samples.
        delay: delay of the inputs of an equation; None without a delay.
        refit: re-estimation by the error of free runs; None without a refit.
        prior: weight of the least-squares solution as the prior of a refit, as a share of its own
            information; see `RefitConfig`.
        energy_generating_terms: axis and term of the parameters that a refit fixes at zero, because
            their estimates would add energy to the motion (negative damping).
        undetermined_parameters: axis and term of the parameters that the data do not determine.
        steady_states: for each velocity and force, its mean in every manoeuvre with constant
            inputs, over the part in which the motion is steady.
        steady_constraints: relation of each velocity to the force that drives it, by the name of
            the velocity.
    """

    model_config = ConfigDict(extra="allow")

    seconds: float | None = None
    samples: int | None = None
    validation_error: float | None = Field(default=None, alias="validation")
    validation_diverged: int = 0
    baseline: str = "baseline"
    members: tuple[str, ...] = ()
    excluded_members: tuple[str, ...] = Field(default=(), alias="left_out")
    exclusions: tuple[MemberExclusion, ...] = ()
    parameters: float | None = None
    n_terms: Hyperparameter | None = Field(default=None, alias="terms")
    order: Hyperparameter | None = None
    penalty: Hyperparameter | None = None
    epochs: int | None = None
    training: TrainingNotes | None = None
    training_history: tuple[EpochRow, ...] = Field(default=(), alias="curve")
    coefficients: tuple[CoefficientRow, ...] = ()
    equations: dict[str, EquationNotes] = Field(default_factory=dict)
    unexcited: tuple[str, ...] = ()
    delay: InputDelay | None = None
    refit: RefitNotes | None = None
    prior: float | None = None
    energy_generating_terms: tuple[tuple[str, str], ...] = Field(default=(), alias="feeding")
    undetermined_parameters: tuple[tuple[str, str], ...] = Field(default=(), alias="open")
    steady_states: dict[str, tuple[float, ...]] = Field(default_factory=dict)
    steady_constraints: dict[str, SteadyConstraint] = Field(default_factory=dict)
