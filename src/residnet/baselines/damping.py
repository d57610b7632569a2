"""Which terms turn the damping of an axis about where the logs have been.

Single terms such as u r in yaw may have either sign. Where sway and yaw go together in the logs,
least squares can give such a term a sign that feeds the yaw and let the sway take it out again: the
fit is good, and the model is not damped.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from residnet.core.names import VELOCITY
from residnet.core.samples import Samples
from residnet.physics.terms import TermLibrary

_POINTS = 400


def own_slopes(library: TermLibrary, samples: Samples) -> Tensor:
    """Return the slopes [3, K, J] of the terms along u, v and r at samples spread evenly."""
    z = samples.z[:: max(1, len(samples) // _POINTS)].double()
    ahead = z.new_zeros(len(VELOCITY), *z.shape)
    for axis, name in enumerate(VELOCITY):
        ahead[axis, :, samples.names.index(name)] = 1.0
    return library.along(z, ahead)


def undamped(theta: Tensor, slopes: Tensor) -> int | None:
    """Return the term that feeds an axis most where half of the samples feed it; None for none.

    Args:
        theta: coefficients of the axis, [J].
        slopes: of the terms along the velocity of the axis, [K, J].
    """
    if not len(slopes) or float((slopes @ theta).median()) <= 0.0:
        return None
    shares = slopes.mean(0) * theta
    most = int(shares.argmax())
    return most if float(shares[most]) > 0.0 else None


def undamped_terms(theta: Tensor, slopes: Tensor) -> Sequence[tuple[int, int]]:
    """Return (axis, term) of what `undamped` finds of coefficients [3, J], slopes [3, K, J]."""
    found = [(axis, undamped(theta[axis], slopes[axis])) for axis in range(len(VELOCITY))]
    return [(axis, term) for axis, term in found if term is not None]
