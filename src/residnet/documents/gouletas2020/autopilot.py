"""The predictive autopilots of an autopilot run (document 004, sections 6.1.1 to 6.1.3).

A perceptron is trained on simulated answers to the rudder angles, and the control law picks an
angle by its predictions.
"""

from __future__ import annotations

import time
from typing import Any

import torch

from residnet.control.base import Policy
from residnet.control.heading.controllers import DocumentConfig, Steering
from residnet.control.heading.document_autopilot import NetworkPredictor
from residnet.control.heading.stored import PredictorSpec
from residnet.core.errors import UsageError
from residnet.core.progress import say
from residnet.documents.gouletas2020.config import PredictiveConfig
from residnet.report.format import DEG
from residnet.runs.folder import RunFolder
from residnet.runs.model_store import FolderStore
from residnet.training.policies.predictor import train_predictor


def predictive(
    name: str, config: PredictiveConfig, steering: Steering, seed: int, folder: RunFolder
) -> tuple[Policy, dict[str, Any]]:
    """Train a controller, or take up the one that an interrupted run has trained.

    Args:
        name: name of the controller.
        config: how it predicts and how it is trained.
        steering: the vessel in calm water and the limit of its rudder.
        seed: seed of the weights, the states and the batches.
        folder: run folder, which keeps the weights.

    Returns:
        The controller, and notes on its config and on the errors of its predictions.

    Raises:
        FitError: where training fails.
    """
    torch.manual_seed(seed)
    law, network = _untrained(config, steering)
    exact, controller = law.predictor(steering), law.law(network, steering)
    store = FolderStore(folder)
    notes = store.finished_module(name, network)
    if notes is None:
        started = time.time()
        say(f"  training {name}")
        notes = train_predictor(
            name,
            network,
            steering.vessel,
            exact,
            controller.rudder,
            config.training,
            seed,
            folder.path,
        )
        notes["seconds"] = round(time.time() - started, 1)
        store.keep_module(name, _spec(config, steering), network, notes)
    degrees = [DEG * notes[key] for key in ("rms_heading", "rms_yaw_rate")]
    say(
        f"  {name}: predicts {config.horizon:g} s ahead within {degrees[0]:.2g} deg and"
        f" {degrees[1]:.2g} deg/s (rms), {notes['seconds']:.0f} s"
    )
    return controller, {"config": config.model_dump(mode="json")} | {
        key: value for key, value in notes.items() if key != "curve"
    }


def load_predictive(
    name: str, config: PredictiveConfig, steering: Steering, folder: RunFolder
) -> Policy:
    """Return the controller that a finished run has trained.

    Raises:
        UsageError: where the run lacks it.
    """
    law, network = _untrained(config, steering)
    if FolderStore(folder).finished_module(name, network) is None:
        raise UsageError(f"{folder.path}: no trained '{name}' (models/{name}/model.json)")
    return law.law(network, steering)


def _untrained(
    config: PredictiveConfig, steering: Steering
) -> tuple[DocumentConfig, NetworkPredictor]:
    law = DocumentConfig(horizon=config.horizon, candidates=config.candidates, weight=config.weight)
    return law, _spec(config, steering).build()


def _spec(config: PredictiveConfig, steering: Steering) -> PredictorSpec:
    return PredictorSpec(
        state=tuple(steering.vessel.state),
        candidates=config.candidates,
        hidden=tuple(config.hidden),
        linear=config.linear,
    )
