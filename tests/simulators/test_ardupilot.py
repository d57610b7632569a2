"""ArduPilot's JSON interface over loopback UDP: replies at 400 Hz, losses, repeats and rubbish."""

from __future__ import annotations

import json
import math
import socket
import struct
import threading
from collections.abc import Iterator

import numpy as np
import pytest

from residnet.core.errors import UsageError
from residnet.simulators.ardupilot import ArduPilotBackend, assign_servos
from residnet.simulators.vehicle import Vehicle, load_vehicle

RATE = 400


def packet(frame: int, *pulses: int, rate: int = RATE, count: int = 16) -> bytes:
    magic = {16: 18458, 32: 29569}[count]
    return struct.pack(f"<HHI{count}H", magic, rate, frame, *pulses, *[0] * (count - len(pulses)))


@pytest.fixture(scope="module")
def boat() -> Vehicle:
    return load_vehicle("wam_v_cal", dt=1 / RATE)


@pytest.fixture
def end(boat: Vehicle) -> Iterator[ArduPilotBackend]:
    back = ArduPilotBackend(boat, assign_servos(boat), port=0)
    yield back
    back.close()


def test_packets_are_answered_over_the_network(end: ArduPilotBackend) -> None:
    server = threading.Thread(target=end.serve, args=(60, 5.0))
    server.start()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(5.0)
        client.connect(("127.0.0.1", end.port))
        stamps = []
        for frame in range(1, 61):
            if frame % 7 == 0:
                client.send(b"rubbish" * 5)
                client.send(packet(frame, 1500)[:-3])
            client.send(packet(frame, 1700, 1500, 1700, count=16 if frame % 2 else 32))
            text = client.recv(4096)
            assert text[:1] == text[-1:] == b"\n"
            reply = json.loads(text)
            stamps.append(reply["timestamp"])
    server.join()
    np.testing.assert_allclose(np.diff(stamps), 1 / RATE, rtol=1e-9)
    assert end.n_invalid_packets == 16
    assert set(reply) == {"timestamp", "imu", "position", "attitude", "velocity"}
    assert reply["imu"]["accel_body"][0] > 0
    assert reply["imu"]["accel_body"][2] == pytest.approx(-9.80665)


def replies(end: ArduPilotBackend, frames: list[int], *pulses: int) -> list[dict[str, object]]:
    out = []
    for frame in frames:
        answer = end.reply_to(packet(frame, *pulses))
        assert answer is not None
        out.append(json.loads(answer))
    return out


def test_losses_repeats_and_a_new_start(end: ArduPilotBackend) -> None:
    first, same, later = replies(end, [1, 1, 9], 1600, 0, 1600)
    assert first == same
    assert later["timestamp"] == pytest.approx(2 / RATE)
    assert end.n_lost_frames == 7
    (anew,) = replies(end, [0], 1600, 0, 1600)
    assert anew["timestamp"] == pytest.approx(1 / RATE)


@pytest.mark.parametrize(
    "data",
    [b"", packet(1, 1500)[:-1], packet(1, 9), packet(1, 1500, rate=0), b"\xff" * 40],
)
def test_what_is_no_packet_is_left_out(end: ArduPilotBackend, data: bytes) -> None:
    before = end.n_invalid_packets
    assert end.reply_to(data) is None
    assert end.n_invalid_packets == before + 1


def test_the_motion_is_that_of_the_vehicle_and_consistent(end: ArduPilotBackend) -> None:
    """The change of velocity over ground is what the accelerometers feel, turned to the earth."""
    seen = replies(end, list(range(1, 601)), 1800, 0, 1600)
    velocity = np.array([reply["velocity"] for reply in seen])
    position = np.array([reply["position"] for reply in seen])
    psi = np.array([reply["attitude"] for reply in seen])[:, 2]
    felt = np.array([reply["imu"]["accel_body"] for reply in seen])  # type: ignore[index]
    change = np.gradient(velocity, 1 / RATE, axis=0)[1:-1]
    cos, sin = np.cos(psi)[1:-1], np.sin(psi)[1:-1]
    north = felt[1:-1, 0] * cos - felt[1:-1, 1] * sin
    east = felt[1:-1, 0] * sin + felt[1:-1, 1] * cos
    scale = np.abs(change).max()
    np.testing.assert_allclose(change[10:, 0], north[10:], atol=0.02 * scale)
    np.testing.assert_allclose(change[10:, 1], east[10:], atol=0.02 * scale)
    moved = np.gradient(position, 1 / RATE, axis=0)[1:-1]
    np.testing.assert_allclose(moved, velocity[1:-1], atol=0.02 * np.abs(velocity).max())
    assert math.fabs(psi[-1]) > 0.01


def test_a_slower_vehicle_is_interpolated(boat: Vehicle) -> None:
    slow = load_vehicle("wam_v_cal", dt=0.05)
    ends = [ArduPilotBackend(it, assign_servos(it), port=0) for it in (boat, slow)]
    fine, coarse = (replies(end, list(range(1, 801)), 1800, 0, 1600) for end in ends)
    for end in ends:
        end.close()
    for name in ("position", "velocity"):
        a, b = (np.array([reply[name] for reply in part]) for part in (fine, coarse))
        assert np.abs(a - b).max() < 0.05 * np.abs(a).max()


def test_servos_are_read_and_refused(boat: Vehicle) -> None:
    first, second = boat.inputs[:2]
    found = assign_servos(boat, [f"{second}=4:-5:5"])
    assert (found[0].channel, found[1].channel) == (1, 4)
    assert found[1].command_at(2000) == 5.0
    assert found[1].command_at(0) == 0.0
    for text, message in (
        (f"{first}=1", "expected COMMAND=OUTPUT:LOW:HIGH"),
        (f"{first}=40:0:1", "numbered 1 to 32"),
        ("n_prot=1:0:1", "no command 'n_prot'"),
    ):
        with pytest.raises(UsageError, match=message):
            assign_servos(boat, [text])
