import copy

import torch
from kinds import of_kind

from residnet.baselines.regressors import RegressorBaseline
from residnet.dynamics.ensemble import SampledDynamics
from residnet.dynamics.hybrid import HybridDynamics
from residnet.heads.base import ZeroHead
from residnet.physics.signals import SignalsConfig

TERMS = ["1", "u", "v", "r", "u v", "tau_x", "tau_n"]


def test_each_draw_steps_as_the_model_with_its_parameters() -> None:
    torch.manual_seed(0)
    signals = SignalsConfig(inputs=("tau_x", "tau_n")).build()
    model = HybridDynamics(
        signals, RegressorBaseline([TERMS] * 3, signals.names), ZeroHead(), 0.1, "rk4"
    ).double()
    theta = 0.3 * torch.randn(4, 3, len(TERMS), dtype=torch.float64)
    x, w = torch.randn(12, 6, dtype=torch.float64), torch.randn(12, 2, dtype=torch.float64)
    many = SampledDynamics(model, "baseline.theta", theta)
    with torch.no_grad():
        after, memory = many.step(x, w, x[:, :0])
        for row in range(12):
            alone = copy.deepcopy(model)
            of_kind(alone.baseline, RegressorBaseline).theta.copy_(theta[row % 4])
            torch.testing.assert_close(
                after[row], alone.step(x[row : row + 1], w[row : row + 1], x[:1, :0])[0][0]
            )
    assert memory.shape == (12, 0)
