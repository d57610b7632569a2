"""Sea trials in Python: vessels and manoeuvres by name, logs and manoeuvring indices as results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, final

from residnet.api.values import PartGiven, described, hearing, part, plain
from residnet.core.config import validate
from residnet.core.errors import UsageError
from residnet.core.log import Log
from residnet.core.progress import ProgressCallback
from residnet.data.simulated.flying import Flight
from residnet.judge.booklet import index_rows
from residnet.manoeuvres import ManoeuvreConfig
from residnet.manoeuvres.base import Manoeuvre
from residnet.physics.vessel import load_vessel
from residnet.physics.vessel_file import VesselFile
from residnet.tasks.programme import Programme

if TYPE_CHECKING:
    import pandas as pd


@final
class Trials:
    """Sea trials that were flown.

    Attributes:
        logs: what sensors measured, one log for each manoeuvre; those of a learned model follow
            those of a vessel.
        motions: the motions themselves, without noise.
        indices: one row for each flight: log, manoeuvre, craft, fault, then manoeuvring indices in
            SI and rad; those that a flight is too short for are missing.

    Example:
        trials.indices[["log", "first_overshoot"]]
    """

    def __init__(self, flights: Sequence[Flight], indices: pd.DataFrame) -> None:
        self.logs: list[Log] = [flight.log for flight in flights]
        self.motions: list[Log] = [flight.motion for flight in flights]
        self.indices = indices

    def __repr__(self) -> str:
        return f"Trials({len(self.logs)} logs)"


def simulate(
    vessel: str | None = None,
    manoeuvres: PartGiven | Sequence[PartGiven] = (),
    *,
    families: PartGiven | Sequence[PartGiven] = (),
    model: Mapping[str, Any] | None = None,
    duration: float | str = 600.0,
    step: float | str | None = None,
    substeps: int = 5,
    noise: Mapping[str, Any] | None = None,
    disturbance: Mapping[str, Any] | None = None,
    initial: Mapping[str, Any] | None = None,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    **settings: Any,
) -> Trials:
    """Fly manoeuvres with a vessel, a learned model, or both.

    The arguments are the keys of `programme` in a config of the task `simulate`, and give the same
    logs.

    Args:
        vessel: name of a vessel, or path of its file.
        manoeuvres: each a kind with settings, or a config object.
        families: further ones drawn at random by `seed`.
        model: a learned model of a run: `{"run": folder, "name": "selected"}`, and actuators.
        duration: in s, of manoeuvres that give none.
        step: of the logs in s; that of the model, else 0.05 s, where None.
        substeps: steps of the vessel within one step of the logs.
        noise: standard deviations of the sensors by channel.
        disturbance: current, wind, waves and forces, as YAML has them.
        initial: states by name that trials start from.
        seed: of everything random.
        progress: is told about the work.
        settings: further keys of `programme`: length, reader.

    Raises:
        ConfigError: where a setting is wrong, or the vessel cannot fly a manoeuvre.
        DataError: where a motion is not finite from its first step on.

    Example:
        trials = residnet.simulate("wam_v_cal", {"kind": "zigzag", "drive": 0.6, "steer": 0.4,
                                                 "heading": "20 deg"}, duration=60)
    """
    import pandas as pd

    given = {
        "vessel": vessel,
        "manoeuvres": [part(entry, "manoeuvre") for entry in _several(manoeuvres)],
        "families": [part(entry, "family") for entry in _several(families)],
        "model": model,
        "duration": duration,
        "step": step,
        "substeps": substeps,
        "noise": noise,
        "disturbance": disturbance,
        "initial": initial,
        "seed": seed,
        **settings,
    }
    known = {name: value for name, value in given.items() if value is not None}
    programme: Programme = validate(plain(known), Programme, "simulate")
    flights, rows = [], []
    with hearing(progress):
        for craft, sea in programme.crafts():
            flown = programme.fly(craft, sea)
            flights += flown
            rows += index_rows(craft, flown, programme.hull_length)
    flat = [
        {name: row[name] for name in ("log", "manoeuvre", "craft", "fault")} | row["indices"]
        for row in rows
    ]
    return Trials(flights, pd.DataFrame(flat))


def _several(given: Any) -> list[Any]:
    return list(given) if isinstance(given, list | tuple) else [given]


def vessel(name: str) -> VesselFile:
    """Return a vessel by its name or file: particulars in SI, each with its source.

    Args:
        name: one of `available("vessels")`, or the path of a YAML file.

    Raises:
        ConfigError: where there is no such vessel or its file is wrong.

    Example:
        residnet.vessel("wam_v_cal").length.value
    """
    if not isinstance(name, str):
        raise UsageError(f"vessel: expected a name or path, given {described(name)}")
    return load_vessel(name)


def manoeuvre(kind: PartGiven, **settings: Any) -> Manoeuvre:
    """Return a manoeuvre by its kind and settings, for `simulate`.

    Args:
        kind: one of `available("manoeuvres")`.
        settings: of the manoeuvre; SI numbers, or texts with a unit such as "20 deg".

    Raises:
        ConfigError: where there is no such kind, or a setting is wrong.

    Example:
        residnet.manoeuvre("zigzag", drive=0.6, steer=0.4, heading="20 deg")
    """
    config: Manoeuvre = validate(part(kind, "manoeuvre", **settings), ManoeuvreConfig, "manoeuvre")
    return config
