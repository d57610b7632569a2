"""The few models of a first draft, and what the numbers of time follow from."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

from residnet.data.drafting.questions import Marks
from residnet.identification.recipe import Preparation
from residnet.tasks.drafting.inputs import roles

_HULL = ("u v", "u r", "v r", "u|u|", "v|v|", "r|r|", "v|r|", "r|v|")
_SOUND = {"dissipative": True, "bounded": True}
"""A model of logs that nobody has looked at neither feeds itself energy nor runs away."""
_EFFORT = 12_000
"""Steps of rollouts that a network is trained through, in batches: about half a minute."""


def models(
    inputs: Sequence[str],
    wind: bool,
    time: Preparation,
    length: float,
    samples: int,
    thrown: Collection[str] = (),
) -> Any:
    """Return baselines, refit, heads, base_of and training of a config.

    Args:
        inputs: of the models.
        wind: whether the true wind is known.
        time: of the logs.
        length: of the free runs that models are chosen by, s.
        samples: for training, on the grid.
        thrown: inputs in pulses, per cent or shares; of these one that steers may do so by
            thrust, without a flow past a rudder.
    """
    acting = roles(inputs)
    extra = [name for name in inputs if name == "tau_y"]
    linear: dict[str, Any] = {"kind": "regressors", **_SOUND, "ridge": 1e-6, "sets": ["linear"]}
    linear["terms"] = [*extra, *(["wind_u", "wind_v"] if wind else [])]
    if not linear["terms"]:
        del linear["terms"]
    physics: dict[str, Any] = {"kind": "regressors", **_SOUND, "ridge": 1e-4}
    if acting["drive"] and acting["steer"] and set(inputs) == {*acting["drive"], *acting["steer"]}:
        physics["sets"] = ["fossen", *(["wind"] if wind else [])]
        known = {"drive": ("n",), "steer": ("delta",)}
        physics |= {key: list(names) for key, names in acting.items() if names != known[key]}
        direct = [name for name in acting["steer"] if name in thrown]
        if direct:
            physics["terms"] = [t for name in direct for t in (name, f"{name}|{name}|")]
    else:
        physics["sets"] = ["linear", *(["wind"] if wind else [])]
        physics["terms"] = [*_HULL, *extra, *_driving(inputs, thrown)]
    horizon = _seconds(0.2 * length)
    plan: dict[str, Any] = {
        "baseline": linear,
        "baselines": {"physics": physics},
        "refit": {
            "physics": {"horizon": f"{horizon:g} s", "every": f"{horizon:g} s", "prior": 0.01}
        },
        "heads": {"plsr": {"kind": "plsr"}, "mlp": {"kind": "mlp", "hidden": _hidden(samples)}},
        "base_of": {"plsr": "physics", "mlp": "physics"},
        "training": {"mlp": _training(time.step, length)},
    }
    if not inputs:
        # a network has nothing to learn from a vessel that nothing is known to drive
        plan |= {"heads": {"plsr": {"kind": "plsr"}}, "base_of": {"plsr": "physics"}}
        del plan["training"]
    return plan


def _driving(inputs: Sequence[str], thrown: Collection[str]) -> list[str]:
    """Return the terms of inputs of which only their kinds are known.

    A thrust is a force already, unless it is told in pulses or per cent (`thrown`). A thruster
    that turns pushes along its angle; a rudder turns by the flow past it.
    """
    angles = [name for name in inputs if _kind(name) in ("azimuth", "nozzle")]
    thrusters = [name for name in inputs if _kind(name) in ("n", "thrust", "throttle")]
    turned = {
        name: next(
            (angle for angle in angles if _end(angle) == _end(name)),
            angles[0] if len(angles) == 1 else "",
        )
        for name in thrusters
    }
    out: list[str] = []
    for name in inputs:
        told = name.startswith(("thrust", "cmd_thrust")) and name not in thrown
        force = name if told else f"{name}|{name}|"
        if name in ("tau_x", "tau_y", "tau_n") or name in turned.values():
            continue
        if turned.get(name):
            out += [f"{force} {function}({turned[name]})" for function in ("cos", "sin")]
            out.append(f"|{name}| u")
        elif _kind(name) in ("delta", "azimuth", "nozzle"):
            out.append(f"u|u| {name}")
        else:
            out += [force, f"|{name}| u"]
    return out


def _kind(name: str) -> str:
    """Return the first word of a channel's name, `n` of `cmd_n_bow`."""
    return name.removeprefix("cmd_").split("_")[0]


def _end(name: str) -> str:
    """Return what follows the first word, which tells several actuators of a kind apart."""
    return name.removeprefix("cmd_").removesuffix("_cmd").partition("_")[2]


def _hidden(samples: int) -> list[int]:
    return [16] if samples < 5_000 else [16, 16] if samples < 50_000 else [32, 32]


def _seconds(value: float) -> float:
    """Return a time of one or two digits near a value, s."""
    return float(f"{value:.2g}") if value >= 0.01 else 0.01


def _training(step: float, length: float) -> dict[str, Any]:
    """Return the training of a network in free run, over growing horizons."""
    horizons = sorted({_seconds(min(share * length, 120 * step)) for share in (0.08, 0.16, 0.3)})
    cost = sum(weight * h / step for weight, h in zip((1, 2, 3), horizons, strict=False))
    unit = max(1, min(4, round(_EFFORT / 25.0 / max(cost, 1.0))))
    stages = [
        {
            "horizon": f"{h:g} s",
            "epochs": weight * unit,
            "batch": 128,
            "learning_rate": 3e-3 if weight < 3 else 1.5e-3,
            "final": 0.5 if weight < 3 else 0.05,
        }
        for weight, h in zip((1, 2, 3), horizons, strict=False)
    ]
    return {
        "history": f"{min(2.0, 0.1 * length):g} s",
        "one_step": {"epochs": 0},
        "multi_step": stages,
        "steps": 25,
        "average": 0.98,
        "weight_decay": 0.001,
        "robust": 0.05,
    }


def mark_timing(chosen: Preparation, length: float, marks: Marks) -> None:
    """Write down what the numbers of time follow from."""
    marks.note(("prepare", "grid"), chosen.reason)
    marks.note(
        ("evaluation", "protocols"), f"free runs of {length:g} s fit into most logs for judging"
    )
