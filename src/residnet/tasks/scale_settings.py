"""Settings of the command `scale`: ratios, and scale effects from factors or a form factor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from residnet.core.config import Quantity, validate_config
from residnet.core.errors import UsageError
from residnet.dynamics.scaling import ScaleEffects, ittc_resistance_ratio
from residnet.physics.similarity import FroudeScaling
from residnet.runs.folder import RunFolder


class ScaleRequest(NamedTuple):
    """A request to write a run with the models and logs of a finished fit at another scale.

    Attributes:
        run: folder of the fit.
        output_folder: folder of the new run.
        scaling: ratios of lengths and densities.
        effects: scale effects of viscosity.
        model_names: models to scale; empty for all that can be scaled.
        overwrite: replace an earlier run in the folder.
    """

    run: RunFolder
    output_folder: Path
    scaling: FroudeScaling
    effects: ScaleEffects
    model_names: Sequence[str] = ()
    overwrite: bool = False


def make_scale_settings(
    scale: float,
    density_ratio: float,
    effects: Mapping[str, Any],
    *,
    form_factor: float | None = None,
    total_resistance: float | None = None,
    length: str | float | None = None,
    speed: str | float | None = None,
) -> tuple[FroudeScaling, ScaleEffects]:
    """Return the ratios of a scaling and its scale effects.

    Args:
        scale: length at full scale divided by that in the logs.
        density_ratio: ratio of the densities of the water.
        effects: keys of `ScaleEffects`.
        form_factor: k, from which the resistance factor is computed by ITTC 1978.
        total_resistance: C_TM of the model, with a form factor.
        length: length of the model, with a form factor.
        speed: speed of the model, with a form factor.

    Raises:
        UsageError: if a value is not plausible, or a form factor lacks one of the other values.
        ConfigError: if a scale effect has no source.
    """
    scaling = FroudeScaling(scale, density_ratio)
    values = dict(effects)
    particulars = {
        "--total-resistance": total_resistance,
        "--length": length,
        "--speed": speed,
    }
    if form_factor is None:
        unused = [name for name, value in particulars.items() if value is not None]
        if unused:
            raise UsageError(
                f"{unused[0]}: is used with --form-factor only; add it, or remove this"
            )
        return scaling, validate_config(values, ScaleEffects, "scale effects")
    missing = [name for name, value in particulars.items() if value is None]
    if missing:
        raise UsageError(f"--form-factor needs {', '.join(missing)} too")
    if values.get("resistance", 1.0) != 1.0:
        raise UsageError("--resistance and --form-factor: give one of them, not both")
    try:
        length_m = Quantity("m").convert(length)
        speed_m_s = Quantity("m/s").convert(speed)
    except ValueError as error:
        raise UsageError(f"--length, --speed: {error}") from None
    values["resistance"] = ittc_resistance_ratio(
        length_m,
        speed_m_s,
        scale,
        form_factor=form_factor,
        total_coefficient=total_resistance or 0.0,
    )
    values["source"] = values.get("source") or (
        f"ITTC 1957 line and ITTC 1978 method with form factor {form_factor:g} and C_TM"
        f" {total_resistance:g}"
    )
    return scaling, validate_config(values, ScaleEffects, "scale effects")
