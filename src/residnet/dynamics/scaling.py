"""Scaling of models to similar vessels at the same Froude number.

Equations of motion without dimensional constants keep their form under Froude's law of similarity:
lengths scale with lambda, times and velocities with its square root, masses with its cube. A scaled
model has scaled coefficients, ranges, prediction intervals and time step. Its free run in
non-dimensional form is that of the original, which `scale_model` verifies.

Froude's law ignores viscosity. `ScaleEffects` holds the factors by which resistance, thrust and
rudder force of the full-scale ship differ from the scaled ones, as given by the user.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from residnet.baselines.mmg import MMGBaseline, axis_of_parameter
from residnet.baselines.mmg_config import MMGConfig
from residnet.baselines.mmg_parameters import PARAMETER_NAMES
from residnet.baselines.regressors import RegressorBaseline
from residnet.core.config import Config
from residnet.core.errors import UsageError
from residnet.dynamics.domain_config import InputRelation, OperatingDomain
from residnet.dynamics.ensemble import MeanOfTrajectories
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import BandTable, ModelSpec
from residnet.heads.base import Features, ResidualScale
from residnet.heads.basis import BasisHead
from residnet.heads.skip import RangeWeight
from residnet.physics.signals import SoftVelocityLimit
from residnet.physics.similarity import FroudeScaling, is_drive, is_rudder
from residnet.physics.symmetry import get_dof
from residnet.physics.terms import parse_term

_VERIFIED_STEPS = 8
"""Steps of the free runs that verify a scaled model."""
_VERIFIED_RUNS = 16
"""Number of free runs that verify a scaled model, from random states of the training range."""
_VERIFIED_HISTORY = 4
"""Samples of the measured past of these runs."""
_MAX_DEVIATION = 1e-6
"""Largest deviation of these runs as a share of the training range; softening constants of square
roots, which have a unit, cause smaller ones."""


class ScaleEffects(Config):
    """Factors on full-scale forces that Froude's law does not contain, with their source.

    Attributes:
        resistance: ratio of the total resistance coefficients of ship and model.
        propeller: thrust at full scale divided by the scaled thrust, at the same advance ratio.
        rudder: rudder force at full scale divided by the scaled force.
        source: reference of the factors, such as "towing test 2047, ITTC 1978".
    """

    resistance: float = Field(default=1.0, gt=0)
    propeller: float = Field(default=1.0, gt=0)
    rudder: float = Field(default=1.0, gt=0)
    source: str = ""

    @model_validator(mode="after")
    def _require_source(self) -> ScaleEffects:
        if self.has_effect and not self.source.strip():
            raise ValueError(
                "a scale effect needs its source, such as 'ITTC 1978, towing test 2047'; give it as"
                " source (--source)"
            )
        return self

    @property
    def has_effect(self) -> bool:
        """Whether a factor differs from 1."""
        return (self.resistance, self.propeller, self.rudder) != (1.0, 1.0, 1.0)


def ittc_resistance_ratio(
    length: float,
    speed: float,
    scale: float,
    *,
    form_factor: float,
    total_coefficient: float,
    allowance: float = 0.0,
    model_viscosity: float = 1.1386e-6,
    ship_viscosity: float = 1.1883e-6,
) -> float:
    """Return the ratio of the total resistance coefficients of ship and model.

    The wave resistance coefficient is equal at equal Froude number; the friction follows the
    ITTC 1957 line, C_F = 0.075 / (log10 Re - 2)^2, with the form factor k:
    C_TS = C_TM - (1 + k) (C_FM - C_FS) + C_A (ITTC 1978 Performance Prediction Method,
    Recommended Procedure 7.5-02-03-01.4, without air resistance).

    Args:
        length: length of the model, m.
        speed: speed of the model, m/s.
        scale: ratio of the lengths of ship and model.
        form_factor: k.
        total_coefficient: C_TM of the model at this speed, from a towing test.
        allowance: C_A, correlation allowance with roughness.
        model_viscosity: kinematic viscosity of the model's water, m^2/s; fresh water at 15 deg C.
        ship_viscosity: viscosity of the ship's water; sea water at 15 deg C.

    Raises:
        UsageError: if an argument is not plausible, or the coefficient is smaller than friction.
    """
    if not 0.0 <= form_factor < 1.0:
        raise UsageError(f"form factor: expected 0 to 1 such as 0.2, got {form_factor:g}")
    if not 0.0 < total_coefficient < 0.1:
        raise UsageError(
            f"total resistance coefficient: expected such as 0.0042, got {total_coefficient:g}"
        )

    def friction(reynolds_number: float) -> float:
        if reynolds_number < 1e4:
            raise UsageError(
                f"form factor: the Reynolds number {reynolds_number:.3g} is outside the range of"
                " the ITTC 1957 line; check length and speed"
            )
        return 0.075 / (math.log10(reynolds_number) - 2.0) ** 2

    model_friction = friction(speed * length / model_viscosity)
    ship_friction = friction(speed * length * scale**1.5 / ship_viscosity)
    ratio = (
        total_coefficient - (1.0 + form_factor) * (model_friction - ship_friction) + allowance
    ) / total_coefficient
    if (1.0 + form_factor) * model_friction > total_coefficient or ratio <= 0.0:
        raise UsageError(
            f"total resistance coefficient {total_coefficient:g} is smaller than the viscous share"
            f" {(1.0 + form_factor) * model_friction:.3g} of the ITTC 1957 line with form factor"
            f" {form_factor:g}; check both"
        )
    return ratio


def acceleration_factors(scaling: FroudeScaling, names: Sequence[str]) -> Tensor:
    """Return the factors [n] of the derivatives of the dynamic states of a model."""
    factors = [
        scaling.channel_factor(name) / scaling.time_factor for name in get_dof(names).dynamic_states
    ]
    return torch.tensor(factors, dtype=torch.float64)


def scale_spec(spec: ModelSpec, scaling: FroudeScaling) -> ModelSpec:
    """Return the description of the scaled model, without its coefficients."""
    channels = (*spec.signals.dof.dynamic_states, *spec.signals.input_columns)
    factors = [scaling.channel_factor(name) for name in channels]
    return spec.model_copy(
        update={
            "signals": scaling.scale_config(spec.signals.with_thrusters()),
            "baseline": scaling.scale_config(spec.baseline.without_file_references()),
            "head": None if spec.head is None else scaling.scale_config(spec.head),
            "dt": spec.dt * scaling.time_factor,
            "low": tuple(f * value for f, value in zip(factors, spec.low, strict=True)),
            "high": tuple(f * value for f, value in zip(factors, spec.high, strict=True)),
            "band": None if spec.band is None else _scale_band_table(spec.band, scaling),
            "domain": None if spec.domain is None else _scale_domain(spec.domain, scaling),
            "members": tuple(scale_spec(member, scaling) for member in spec.members),
        }
    )


def band_channel_factor(name: str, scaling: FroudeScaling) -> float:
    """Return the factor of a channel of prediction intervals, such as position or heading."""
    if name == "position":
        return scaling.scale
    return 1.0 if name == "heading" else scaling.channel_factor(name)


def _scale_band_table(table: BandTable, scaling: FroudeScaling) -> BandTable:
    scaled = {
        name: tuple(band_channel_factor(name, scaling) * value for value in column)
        for name, column in zip(table.channels, table.columns, strict=True)
    }
    return table.model_copy(update=scaled)


def _scale_domain(domain: OperatingDomain, scaling: FroudeScaling) -> OperatingDomain:
    factors = [scaling.channel_factor(name) for name in domain.channels]

    def scale_relation(relation: InputRelation) -> InputRelation:
        input_factor = scaling.channel_factor(relation.input)
        return relation.model_copy(
            update={
                "offset": relation.offset * input_factor,
                "gains": tuple(
                    gain * input_factor / scaling.channel_factor(name)
                    for gain, name in zip(relation.gains, relation.channels, strict=True)
                ),
                "heading_gain": relation.heading_gain * input_factor,
                "tolerance": relation.tolerance * input_factor,
            }
        )

    return domain.model_copy(
        update={
            "centre": tuple(f * value for f, value in zip(factors, domain.centre, strict=True)),
            "scale": tuple(f * value for f, value in zip(factors, domain.scale, strict=True)),
            "relations": tuple(map(scale_relation, domain.relations)),
        }
    )


def scale_model(
    spec: ModelSpec, model: HybridDynamics, scaling: FroudeScaling
) -> tuple[ModelSpec, HybridDynamics]:
    """Return a model at another scale by Froude's law of similarity.

    Args:
        spec: description of the model.
        model: the model with its parameter values; it is not changed.
        scaling: ratios of lengths and densities.

    Raises:
        UsageError: if a part of the model contains dimensional constants that cannot be scaled.
    """
    scaled_spec = scale_spec(spec, scaling)
    original = copy.deepcopy(model).double().eval()
    state = {name: value.clone() for name, value in original.state_dict().items()}
    scaled_model = scaled_spec.build().double().eval()
    _scale_states(original, state, scaling)
    scaled_model.load_state_dict(state)
    scaled_model.requires_grad_(False)
    deviation = _largest_deviation(spec, original, scaled_model, scaling)
    if not deviation <= _MAX_DEVIATION:
        kinds = (
            spec.baseline.kind if spec.head is None else f"{spec.baseline.kind}, {spec.head.kind}"
        )
        raise UsageError(
            f"model {spec.name}: cannot be scaled, since a part of it ({kinds}) has constants with"
            f" dimensions: its scaled free run deviates by {deviation:.2g} of the training range;"
            " choose another model (--model)"
        )
    return scaled_spec, scaled_model


def _scale_states(model: nn.Module, state: dict[str, Tensor], scaling: FroudeScaling) -> None:
    """Scale the parameters and buffers of all parts of a model in place.

    Args:
        model: the original model.
        state: its state, which is changed.
        scaling: ratios of lengths and densities.
    """
    for path, part in model.named_modules():
        if isinstance(part, HybridDynamics) and not isinstance(part, MeanOfTrajectories):
            names = part.signals.names
            for key, factors in _part_factors(part, names, scaling).items():
                full_key = f"{path}.{key}" if path else key
                if full_key in state:
                    state[full_key] *= factors.to(state[full_key].dtype)


def _part_factors(
    model: HybridDynamics, names: Sequence[str], scaling: FroudeScaling
) -> dict[str, Tensor]:
    """Return the factors of the state of a model by key, each broadcast to its tensor."""
    acceleration = acceleration_factors(scaling, names)
    channel_of = {name: scaling.channel_factor(name) for name in names}

    def channel_factors(channels: Sequence[str]) -> Tensor:
        return torch.tensor([channel_of[name] for name in channels], dtype=torch.float64)

    factors: dict[str, Tensor] = {}
    for path, part in model.named_modules():
        prefix = f"{path}." if path else ""
        if isinstance(part, Features) and set(part.names) <= set(names):
            for key in ("mean", "std", "low", "high"):
                factors[prefix + key] = channel_factors(part.names)
        elif isinstance(part, RangeWeight):
            ranges = channel_factors(part.names)
            factors |= {f"{prefix}low": ranges, f"{prefix}high": ranges}
            factors[f"{prefix}decay"] = 1.0 / ranges
        elif isinstance(part, ResidualScale):
            factors[f"{prefix}std"] = acceleration
        elif isinstance(part, SoftVelocityLimit):
            bounds = channel_factors(list(names)[: part.n_channels])
            factors[f"{prefix}low"] = bounds
            factors[f"{prefix}high"] = bounds
            factors[f"{prefix}restoring_rate"] = torch.tensor(1.0 / scaling.time_factor)
        elif isinstance(part, RegressorBaseline):
            factors[f"{prefix}theta"] = regressor_factors(part, scaling)
        elif isinstance(part, BasisHead):
            factors[f"{prefix}coefficients"] = acceleration
            factors[f"{prefix}intercept"] = acceleration
    return factors


def regressor_factors(baseline: RegressorBaseline, scaling: FroudeScaling) -> Tensor:
    """Return the factors [n, J] of the coefficients of a baseline of regressors."""
    names = baseline.channel_names
    term_factors = torch.tensor(
        [scaling.term_factor(term, names) for term in baseline.library.terms], dtype=torch.float64
    )
    return acceleration_factors(scaling, names)[:, None] / term_factors


def parameter_factors(
    baseline: nn.Module, scaling: FroudeScaling, effects: ScaleEffects | None = None
) -> Tensor | None:
    """Return the factors [P] of the free parameters of a baseline, in their order.

    Args:
        baseline: the original baseline.
        scaling: ratios of lengths and densities.
        effects: scale effects, which change some coefficients further.

    Returns:
        The factors; None if the baseline has no free parameters.
    """
    if isinstance(baseline, MMGBaseline):
        factors = torch.ones_like(baseline.theta)
        if effects is not None:
            factors = factors * _effect_factors(baseline, effects)
        return factors[baseline.free_indices()]
    if isinstance(baseline, RegressorBaseline):
        factors = regressor_factors(baseline, scaling)
        if effects is not None:
            factors = factors * _effect_factors(baseline, effects)
        return factors.flatten()[baseline.free_indices()]
    return None


def apply_scale_effects(
    spec: ModelSpec, model: HybridDynamics, effects: ScaleEffects
) -> tuple[ModelSpec, HybridDynamics]:
    """Return a full-scale model with the scale effects of viscosity.

    In a baseline of regressors, the resistance are the surge terms of u alone; terms of a propeller
    without rudder are its thrust; terms of a rudder are its force. In an MMG model they are R_0,
    the open-water thrust and the force gradient of the rudder.

    Args:
        spec: description of the scaled model.
        model: the scaled model; it is not changed.
        effects: the factors.

    Raises:
        UsageError: if the baseline has no such terms.
    """
    scaled_model = copy.deepcopy(model)
    baseline = scaled_model.baseline
    if isinstance(baseline, RegressorBaseline):
        with torch.no_grad():
            baseline.theta.copy_(baseline.theta * _effect_factors(baseline, effects))
        return spec, scaled_model
    if isinstance(baseline, MMGBaseline) and isinstance(spec.baseline, MMGConfig):
        config = spec.baseline
        # the gradient of the rudder's force is a formula of its aspect ratio: the area scales it
        changed = config.model_copy(
            update={
                "propeller": config.propeller.model_copy(
                    update={"thrust": tuple(effects.propeller * k for k in config.propeller.thrust)}
                ),
                "rudder": config.rudder.model_copy(
                    update={"area": config.rudder.area * effects.rudder}
                ),
            }
        )
        changed_spec = spec.model_copy(update={"baseline": changed})
        changed_model = changed_spec.build().double().eval()
        state = scaled_model.state_dict()
        state["baseline.theta"] = state["baseline.theta"] * _effect_factors(baseline, effects)
        changed_model.load_state_dict(state)
        return changed_spec, changed_model.requires_grad_(False)
    raise UsageError(
        f"model {spec.name}: scale effects need a baseline of kind regressors or mmg without a"
        f" network, not '{spec.baseline.kind}'; choose such a model (--model)"
    )


def _effect_factors(baseline: RegressorBaseline | MMGBaseline, effects: ScaleEffects) -> Tensor:
    """Return the factors of the scale effects on the coefficients, in the shape of theta."""
    factors = torch.ones_like(baseline.theta)
    if isinstance(baseline, MMGBaseline):
        factors[PARAMETER_NAMES.index("R_0")] = effects.resistance
        return factors
    for column, term in enumerate(baseline.library.terms):
        channels = {factor.name for factor in parse_term(term, baseline.channel_names)}
        rudders = {name for name in channels if is_rudder(name)}
        drives = {name for name in channels if is_drive(name)}
        if rudders:
            factors[:, column] = effects.rudder
        elif drives:
            factors[:, column] = effects.propeller
        elif channels == {"u"}:
            factors[0, column] = effects.resistance
    return factors


def _largest_deviation(
    spec: ModelSpec, original: HybridDynamics, scaled: HybridDynamics, scaling: FroudeScaling
) -> float:
    """Return the largest deviation of scaled free runs as a share of the training range.

    Both models start from the same random states within the training range, under random inputs.
    In the first half of the steps, deviating states are measured, so that models with innovations
    use them.
    """
    generator = torch.Generator().manual_seed(0)
    channels = (*spec.signals.dof.dynamic_states, *spec.signals.input_columns)
    low = torch.tensor(spec.low, dtype=torch.float64)
    width = torch.tensor(spec.high, dtype=torch.float64) - low
    # a constant channel, such as an inactive velocity, is compared with its size
    width = torch.where(width > 0.0, width, low.abs().clamp(min=1e-6))
    factors = torch.tensor([scaling.channel_factor(name) for name in channels], dtype=torch.float64)
    n = len(spec.signals.dof.dynamic_states)

    def draw(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    velocities = low[:n] + width[:n] * draw(_VERIFIED_RUNS, n)
    pose = torch.zeros(_VERIFIED_RUNS, 3, dtype=torch.float64)
    x = torch.cat((pose, velocities), dim=-1)
    scaled_x = torch.cat((pose, velocities * factors[:n]), dim=-1)
    rows = _VERIFIED_RUNS
    # networks with a memory begin from a measured past
    histories = low + width * draw(rows, _VERIFIED_HISTORY, len(channels))
    past = torch.cat((pose[:, None].expand(-1, _VERIFIED_HISTORY, -1), histories[..., :n]), dim=-1)
    scaled_past = torch.cat((past[..., :3], histories[..., :n] * factors[:n]), dim=-1)
    copies = original.head.batch_ensemble_size
    x, scaled_x = (part.repeat(copies, 1) for part in (x, scaled_x))
    past, scaled_past, past_inputs = (
        part.repeat(copies, 1, 1) for part in (past, scaled_past, histories[..., n:])
    )
    with torch.no_grad():
        s = original.warmup(past, past_inputs)
        scaled_s = scaled.warmup(scaled_past, past_inputs * factors[n:])
    deviation = 0.0
    with torch.no_grad():
        for step in range(_VERIFIED_STEPS):
            if step < _VERIFIED_STEPS // 2:
                error = (0.02 * width[:n] * draw(rows, n)).repeat(copies, 1)
                x = torch.cat((x[:, :3], x[:, 3:] + error), dim=-1)
                scaled_x = torch.cat(
                    (scaled_x[:, :3], scaled_x[:, 3:] + error * factors[:n]), dim=-1
                )
            w = low[n:] + width[n:] * draw(rows, len(channels) - n)
            w = w.repeat(copies, 1)
            x, s = original.step(x, w, s)
            scaled_x, scaled_s = scaled.step(scaled_x, w * factors[n:], scaled_s)
            difference = (scaled_x[:, 3:] / factors[:n] - x[:, 3:]).abs() / width[:n]
            position = (scaled_x[:, :2] / scaling.scale - x[:, :2]).abs()
            deviation = max(deviation, float(difference.max()), float(position.max()))
    return deviation if math.isfinite(deviation) else math.inf


def scale_coefficient_rows(
    rows: Sequence[Mapping[str, Any]],
    baseline: nn.Module,
    names: Sequence[str],
    scaling: FroudeScaling,
    effects: ScaleEffects | None = None,
) -> list[dict[str, Any]]:
    """Return a table of coefficients at the target scale, as in fit.json.

    Ratios of coefficients, such as time constants, are left out: they follow from the coefficients.

    Args:
        rows: rows with axis, term, value and standard_error.
        baseline: the original baseline.
        names: channels of the model.
        scaling: ratios of lengths and densities.
        effects: scale effects.
    """
    if isinstance(baseline, RegressorBaseline):
        table = regressor_factors(baseline, scaling)
        if effects is not None:
            table = table * _effect_factors(baseline, effects)
        factor_of = {
            (axis, term): float(table[i, j])
            for i, axis in enumerate(baseline.output_names)
            for j, term in enumerate(baseline.library.terms)
        }
    elif isinstance(baseline, MMGBaseline):
        table = torch.ones_like(baseline.theta)
        if effects is not None:
            table = _effect_factors(baseline, effects)
        factor_of = {
            (axis_of_parameter(name), name): float(table[i])
            for i, name in enumerate(PARAMETER_NAMES)
        }
    else:
        return []
    return [
        {
            key: value * factor_of[row["axis"], row["term"]]
            if key in ("value", "standard_error") and isinstance(value, int | float)
            else value
            for key, value in row.items()
        }
        for row in rows
        if (row["axis"], row["term"]) in factor_of
    ]
