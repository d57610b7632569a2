"""Frames: wrapping against complex exponentials, rotations against compass directions and a
rotation matrix.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from residnet.core.frames import to_body, to_earth, wrap, wrap_array

# away from odd multiples of pi, where rounding alone decides between the two ends of the range
ANGLES = np.concatenate([np.linspace(-20.0, 20.0, 401), [0.0, 3.1, -3.1, 1e3, -1e3]])


def test_wrap_array_agrees_with_complex_exponential() -> None:
    np.testing.assert_allclose(wrap_array(ANGLES), np.angle(np.exp(1j * ANGLES)), atol=1e-12)


def test_wrap_agrees_with_wrap_array() -> None:
    np.testing.assert_allclose(
        wrap(torch.from_numpy(ANGLES)).numpy(), wrap_array(ANGLES), atol=1e-15
    )
    single = wrap(torch.from_numpy(ANGLES).float())
    assert single.dtype == torch.float32
    np.testing.assert_allclose(
        single.numpy(), wrap_array(ANGLES.astype(np.float32).astype(float)), atol=2e-4
    )


def test_wrap_keeps_small_angles_and_shapes() -> None:
    angle = torch.linspace(-3.0, 3.0, 12, dtype=torch.float64).reshape(3, 4)
    torch.testing.assert_close(wrap(angle), angle, rtol=0.0, atol=1e-15)
    assert wrap_array(np.array([math.pi]))[0] == -math.pi
    assert wrap(torch.tensor([math.pi], dtype=torch.float64))[0] == -math.pi


def test_wrapped_difference_across_north() -> None:
    assert math.isclose(
        wrap_array(np.radians(359.0) - np.radians(1.0)), np.radians(-2.0), abs_tol=1e-12
    )


def test_compass_directions() -> None:
    def vector(pair: tuple[torch.Tensor, torch.Tensor]) -> list[float]:
        return [round(float(value), 12) + 0.0 for value in pair]

    one, zero, east = torch.tensor([[1.0], [0.0], [math.pi / 2]], dtype=torch.float64)
    # heading east: ahead is east, starboard is south
    assert vector(to_earth(one, zero, east)) == [0.0, 1.0]
    assert vector(to_earth(zero, one, east)) == [-1.0, 0.0]
    assert vector(to_body(one, zero, east)) == [0.0, -1.0]
    assert vector(to_body(zero, one, east)) == [1.0, 0.0]


def test_rotations_are_inverse_and_equal_the_matrix() -> None:
    generator = torch.Generator().manual_seed(1)
    psi, forward, starboard = (
        torch.randn(5, 3, dtype=torch.float64, generator=generator) * 3 for _ in range(3)
    )
    north, east = to_earth(forward, starboard, psi)
    back = to_body(north, east, psi)
    torch.testing.assert_close(
        torch.stack(back), torch.stack([forward, starboard]), rtol=1e-13, atol=1e-13
    )
    complex_earth = torch.complex(forward, starboard) * torch.exp(1j * psi)
    torch.testing.assert_close(torch.complex(north, east), complex_earth, rtol=1e-13, atol=1e-13)


def test_rotation_broadcasts() -> None:
    north, east = to_earth(torch.ones(4, 1), torch.zeros(1), torch.zeros(4, 3))
    assert north.shape == east.shape == (4, 3)
