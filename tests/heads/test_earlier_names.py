"""Models saved with earlier names of their parameters still load."""

from __future__ import annotations

import pytest
import torch

from residnet.core.config import validate_config
from residnet.heads import HeadConfig
from residnet.testing import make_example_samples

# networks had no skip connection
CONFIGS: dict[str, dict[str, object]] = {
    "mlp": {"kind": "mlp", "skip": "none"},
    "lstm": {"kind": "lstm", "skip": "none"},
    "recurrent": {"kind": "recurrent"},
    "mirrored": {"kind": "mlp", "mirror": True, "skip": "none"},
}
EARLIER = {
    "mlp": {"network.0.weight": "net.0.weight", "scale.std": "scale.spread"},
    "lstm": {"networks.0.cell.input_weight": "networks.0.core.w_input"},
    "recurrent": {"output_weight": "w_out", "skip_weight": "w_skip"},
    "mirrored": {"inner_head.network.0.bias": "inner.net.0.bias"},
}


@pytest.mark.parametrize("case", EARLIER)
def test_load_state_dict_accepts_earlier_names(case: str) -> None:
    names = make_example_samples().names
    head = validate_config(CONFIGS[case], HeadConfig, "here").build(names)
    state = {name: torch.randn_like(value) for name, value in head.state_dict().items()}
    earlier = {EARLIER[case].get(name, name): value for name, value in state.items()}
    assert earlier.keys() != state.keys()
    head.load_state_dict(earlier)
    for name, value in head.state_dict().items():
        assert torch.equal(value, state[name])
