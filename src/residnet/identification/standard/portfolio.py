"""The models of the standard recipe, as a config of a fit would have them."""

from __future__ import annotations

from typing import Any

from residnet.identification.standard.facts import Facts
from residnet.identification.standard.schedule import (
    calibration_settings,
    hidden_size,
    refit_settings,
    training_settings,
)
from residnet.identification.standard.terms import full_hull_terms, hull_terms, linear_terms, long
from residnet.physics.signals import WIND_CHANNELS
from residnet.physics.symmetry import mirrored_channels

PARTS = ("baseline", "baselines", "refit", "heads", "base_of", "forces", "ensembles", "training")
"""Keys of a fit that the recipe stands in place of."""
TIED = "tied"
"""Name of the mean of the models that are as good as the best, within their standard error."""
_FULL = "full_hull"
_FROZEN, _TOGETHER = "hull_network", "hull_network_calibrated"


def portfolio(facts: Facts, effort: float = 1.0) -> dict[str, Any]:
    """Return baselines, refits, heads and trainings by the names that the recipe gives them.

    `baseline` is linear and `hull` nonlinear in velocities and inputs, both refitted; long logs
    have a `full_hull` of more terms too, on which networks find little. A network stands on the
    hull, moves with it, stands on the linear model, and stands alone. Where the wind
    is not measured, an unknown force is estimated from the measured past and added to the hull.

    Args:
        facts: of the logs; `Facts.supposed` before they are read.
        effort: how long networks are trained, 1 for usual.
    """
    network = _network(facts)
    # a residual needs its past less than a whole model does, and without an encoder every format
    # of export has a place for it
    alone = {**network, "encoder": True}
    heads = {_FROZEN: network, _TOGETHER: network, "linear_network": network, "network": alone}
    training = training_settings(facts, effort)
    hulls = {"hull": _regressors(1e-4, hull_terms(facts))}
    if long(facts):
        hulls[_FULL] = _regressors(1e-4, full_hull_terms(facts))
    return {
        "baseline": _regressors(1e-6, linear_terms(facts)),
        "baselines": hulls,
        "refit": dict.fromkeys(("baseline", *hulls), refit_settings(facts)),
        "heads": heads,
        "base_of": {
            _FROZEN: "hull",
            _TOGETHER: "hull",
            "linear_network": "baseline",
            "network": "zero",
        },
        # where the wind is measured it is no unknown force
        "forces": {} if _knows_wind(facts) else {"hull_force": {"of": [*hulls][-1]}},
        "ensembles": {},
        "training": {
            **dict.fromkeys(heads, training),
            _TOGETHER: calibration_settings(facts, effort, _FROZEN),
        },
    }


def _knows_wind(facts: Facts) -> bool:
    return any(name in WIND_CHANNELS for name in facts.names)


def _regressors(ridge: float, terms: list[str] | dict[str, list[str]]) -> dict[str, Any]:
    """Return a model of regressors that neither feeds itself energy nor runs away."""
    sound = {"dissipative": True, "bounded": True}
    return {"kind": "regressors", "ridge": ridge, "terms": terms, **sound}


def _network(facts: Facts) -> dict[str, Any]:
    """Return a recurrent network that comes back from velocities that no log has."""
    size = hidden_size(facts)
    return {
        "kind": "lstm",
        "hidden_size": size,
        "readout": size,
        "restoring": True,
        "margin": 0.0,
        "mirror": mirrored_channels(facts.names) is not None,
    }
