"""Functions of the Python interface that train autopilots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any

from residnet.api.tasks import RunResult, run
from residnet.api.values import PathLikeArg, parse_path
from residnet.autopilot.tasks.design import draft_autopilot_config
from residnet.core.progress import ProgressCallback


def design_autopilot(
    source: PathLikeArg | Sequence[PathLikeArg],
    config: PathLikeArg = "my_autopilot.yaml",
    *,
    rudder: str | None = None,
    rate: str | None = None,
    speed: str | None = None,
    classical: bool = False,
    folder: PathLikeArg | None = None,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
) -> RunResult:
    """Train a heading autopilot for a vessel from its logs, like `residnet autopilot`.

    Args:
        source: logs, the folder of a finished fit, or `K,T` in 1/s and s.
        config: config file to write; the vessel file is written to the same folder.
        rudder: rudder limit of the controllers with its unit; None for the largest angle in logs.
        rate: rate of the steering gear with its unit; None to identify it from the logs.
        speed: speed that K and T refer to, with its unit; None for the mean of the logs.
        classical: tune a classical law and train no policy.
        folder: run folder; None for a temporary one that is removed with the result.
        overwrite: replace earlier files and an earlier run.
        progress: callback that receives the progress of the training.

    Raises:
        DataError: if the logs have no rudder or yaw rate.
        FitError: if the logs show no response to the rudder.

    Example:
        residnet.design_autopilot("0.31,7.4", rate="6 deg/s", folder="runs/own")
    """
    sources = [source] if isinstance(source, str | PathLike) else source
    steering_options = {"rudder": rudder, "rate": rate, "speed": speed}
    config_path = parse_path(config, "design_autopilot")
    config_file = draft_autopilot_config(
        [str(source_entry) for source_entry in sources],
        config_path,
        classical=classical,
        overwrite=overwrite,
        **steering_options,
    )
    return run(config_file, folder=folder, overwrite=overwrite, progress=progress)


def train_autopilot(
    vessel: str,
    rudder: float | str,
    *,
    peers: Mapping[str, Any] | None = None,
    folder: PathLikeArg | None = None,
    name: str = "autopilot",
    progress: ProgressCallback | None = None,
    **settings: Any,
) -> RunResult:
    """Train heading autopilots through a vessel and compare them with tuned classical controllers.

    The arguments are the keys of a config of the task `autopilot` and give the same results.

    Args:
        vessel: name of a vessel, or path of its file.
        rudder: rudder limit of the controllers, in rad or with a unit.
        peers: classical controllers by name: a kind such as `pd`, or settings.
        folder: run folder; None for a temporary one that is removed with the result.
        name: name of the run.
        progress: callback that receives the progress of the training.
        settings: further keys: test, the step of heading that all are compared in; policies,
            learned controllers by name; conditions, predictive, floor, seed and so on.

    Raises:
        ConfigError: if a setting is invalid.

    Example:
        residnet.train_autopilot("nomoto_oceanos", "5 deg", test={"duration": 12}, conditions={},
                           policies={"mine": {"start": None}})
    """
    peer_settings = {
        peer: {"kind": controller_kind} if isinstance(controller_kind, str) else controller_kind
        for peer, controller_kind in (peers or {}).items()
    }
    config = {"task": "autopilot", "name": name, "vessel": vessel, "rudder": rudder}
    return run({**config, "peers": peer_settings, **settings}, folder=folder, progress=progress)
