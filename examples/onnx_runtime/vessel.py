"""An exported vessel model in Python without torch: NumPy and onnxruntime are all it needs.

python vessel.py boat.onnx

boat = Vessel("boat.onnx")
s = boat.initial_state()                      # or boat.warmup(states, inputs)
x, s, outside = boat.step(x, {"n_port": 10.0, "n_stbd": 12.0}, s)
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence

import numpy as np
import onnxruntime

Array = np.ndarray


class Vessel:
    """A model with its card.

    States are x, y (m, north and east), psi (rad), u, v (m/s) and r (rad/s); inputs are named in
    the card, in SI units and radians. All arrays may have rows of vessels in front.

    Args:
        file: what `residnet export RUN --format onnx` wrote.
    """

    def __init__(self, file: str) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(
            file, options, providers=["CPUExecutionProvider"]
        )
        self.card = json.loads(self.session.get_modelmeta().custom_metadata_map["card"])
        self.dt = float(self.card["dt"])
        self.states = [entry["name"] for entry in self.card["states"]]
        self.inputs = [entry["name"] for entry in self.card["inputs"]]
        self.memory = int(self.card["memory"])
        self.dtype = np.float64 if self.card["dtype"] == "float64" else np.float32
        accepted = self.card["bad_inputs"]["accepted"]
        self.least, self.most = np.array([accepted[n] for n in self.states + self.inputs]).T

    def initial_state(self, rows: int = 1) -> Array:
        """Return the memory [rows, memory] without a past."""
        return np.zeros((rows, self.memory), self.dtype)

    def step(
        self, x: Array, w: Array | Mapping[str, float], s: Array
    ) -> tuple[Array, Array, Array]:
        """Return state, memory and flag one step of `dt` later.

        The flag is true where something is beyond the training range or no number.
        """
        if isinstance(w, Mapping):
            missing = [name for name in self.inputs if name not in w]
            if missing:
                raise KeyError(f"inputs {missing} are missing; the model needs {self.inputs}")
            w = np.array([w[name] for name in self.inputs])
        x = np.atleast_2d(np.asarray(x, self.dtype))
        w = np.broadcast_to(np.asarray(w, self.dtype), (len(x), len(self.inputs)))
        feed = {"x": x, "w": np.ascontiguousarray(w)}
        if self.memory == 0:
            after, outside = self.session.run(["x_after", "outside"], feed)
            return after, s, outside
        feed["s"] = np.asarray(s, self.dtype)
        after, memory, outside = self.session.run(["x_after", "s_after", "outside"], feed)
        return after, memory, outside

    def warmup(self, x: Array, w: Array) -> Array:
        """Return the memory that a measured past leaves, states [T, 6] and inputs [T, m].

        A sample that is no measurement is replaced by the last one before it.
        """
        seen = np.concatenate((x, w), axis=1)
        good = np.flatnonzero(((seen >= self.least) & (seen <= self.most)).all(axis=1))
        s = self.initial_state()
        for k in range(len(x) if len(good) else 0):
            before = good[good <= k]
            at = before[-1] if len(before) else good[0]
            s = self.step(x[at], w[at], s)[1]
        return s

    def rollout(self, x: Array, w: Array, s: Array) -> tuple[Array, Array, Array]:
        """Return states [T + 1, 6] under inputs [T, m], the last memory, and flags [T]."""
        path = [np.asarray(x, self.dtype).reshape(-1)]
        flags = []
        for row in w:
            after, s, outside = self.step(path[-1], row, s)
            path.append(after[0])
            flags.append(bool(outside[0]))
        return np.stack(path), s, np.array(flags)


def main(arguments: Sequence[str]) -> None:
    """Run a model for ten seconds in the middle of its training range and print where it is."""
    boat = Vessel(arguments[0])
    ranges = boat.card["training_range"]
    w = np.array([np.mean(ranges[name]) for name in boat.inputs])
    x = np.array([0.0, 0.0, 0.0, np.mean(ranges["u"]), 0.0, 0.0])
    steps = round(10.0 / boat.dt)
    path, _, outside = boat.rollout(x, np.tile(w, (steps, 1)), boat.initial_state())
    print(f"{boat.card['model']}: {steps} steps of {boat.dt:g} s, {int(outside.sum())} outside")
    print(", ".join(f"{n} {v:.4g}" for n, v in zip(boat.states, path[-1], strict=True)))


if __name__ == "__main__":
    main(sys.argv[1:])
