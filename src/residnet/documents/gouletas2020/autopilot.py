"""The document's own autopilots of an autopilot run: data, training and controller (document 004
sections 6.1.1 to 6.1.3).
"""

from __future__ import annotations

import math
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
from residnet.runs.folder import RunFolder
from residnet.runs.model_store import FolderStore
from residnet.training.predictor import train_predictor


def predictive(
    name: str, wanted: PredictiveConfig, steering: Steering, seed: int, folder: RunFolder
) -> tuple[Policy, dict[str, Any]]:
    """A trained controller, and what there is to say about it.

    Args:
        name: of the controller.
        wanted: its config.
        steering: the vessel in calm water, and the limit of the rudder.
        seed: of weights, states and batches.
        folder: of the run.

    Raises:
        FitError: where training fails.
    """
    torch.manual_seed(seed)
    law, network = _untrained(wanted, steering)
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
            wanted.training,
            seed,
            folder.path,
        )
        notes["seconds"] = round(time.time() - started, 1)
        store.keep_module(name, _spec(wanted, steering), network, notes)
    degrees = [math.degrees(notes[key]) for key in ("rms_heading", "rms_yaw_rate")]
    say(
        f"  {name}: predicts {wanted.horizon:g} s ahead within {degrees[0]:.2g} deg and"
        f" {degrees[1]:.2g} deg/s (rms), {notes['seconds']:.0f} s"
    )
    return controller, {"config": wanted.model_dump(mode="json")} | {
        key: value for key, value in notes.items() if key != "curve"
    }


def load_predictive(
    name: str, wanted: PredictiveConfig, steering: Steering, folder: RunFolder
) -> Policy:
    """The controller that a finished run trained.

    Raises:
        UsageError: where the run lacks it.
    """
    law, network = _untrained(wanted, steering)
    if FolderStore(folder).finished_module(name, network) is None:
        raise UsageError(f"{folder.path}: no trained '{name}' (models/{name}/model.json)")
    return law.law(network, steering)


def _untrained(
    wanted: PredictiveConfig, steering: Steering
) -> tuple[DocumentConfig, NetworkPredictor]:
    law = DocumentConfig(horizon=wanted.horizon, candidates=wanted.candidates, weight=wanted.weight)
    return law, _spec(wanted, steering).build()


def _spec(wanted: PredictiveConfig, steering: Steering) -> PredictorSpec:
    return PredictorSpec(
        state=tuple(steering.vessel.state),
        candidates=wanted.candidates,
        hidden=tuple(wanted.hidden),
        linear=wanted.linear,
    )
