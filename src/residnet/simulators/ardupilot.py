"""Physics back end for ArduPilot software-in-the-loop simulation over its JSON interface.

ArduPilot sends a binary packet of servo outputs over UDP and waits for a line of JSON with the
measurements of the inertial sensors (ArduPilot, libraries/SITL/examples/JSON/readme.md). A packet
starts with the number 18458 (16 servos) or 29569 (32 servos), followed by the frame rate, the frame
count and the pulse widths, all little-endian.
"""

from __future__ import annotations

import json
import math
import socket
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import torch
from torch import Tensor

from residnet.core.errors import UsageError
from residnet.core.names import suggest_name
from residnet.core.progress import log_message
from residnet.simulators.vehicle import Vehicle

_PACKET_FORMATS = {18458: struct.Struct("<HHI16H"), 29569: struct.Struct("<HHI32H")}
"""Formats of a packet by its first number: 16 or 32 servo outputs."""
_GRAVITY = 9.80665
"""Standard gravity in m/s^2, as used by ArduPilot for accelerometers."""
_PULSE_RANGE = (800, 2200)
"""Valid pulse widths of a servo output in us; 0 means that there is no pulse yet."""
_FRAME_RATE_RANGE = (10, 4000)
"""Frame rates in Hz that are accepted."""


@dataclass(frozen=True)
class Servo:
    """Mapping from a servo output to a command.

    Attributes:
        channel: number of the output, from 1.
        lower_command: command at 1000 us, SI.
        upper_command: command at 2000 us, SI.
    """

    channel: int
    lower_command: float
    upper_command: float

    def command_at(self, pulse: int) -> float:
        """Return the command of a pulse width; the centre command for a missing pulse."""
        fraction = 0.5 if pulse == 0 else min(max((pulse - 1000) / 1000, 0.0), 1.0)
        return self.lower_command + fraction * (self.upper_command - self.lower_command)


def assign_servos(vehicle: Vehicle, servo_texts: Sequence[str] = ()) -> list[Servo]:
    """Return the servo output of each command, from texts such as `cmd_delta=1:-0.6:0.6`.

    Other commands get the outputs 1, 3, 2, 4, 5 ... in their order and with their full range, since
    ArduPilot's rovers have steering or left motor on output 1 and throttle or right motor on 3.

    Raises:
        UsageError: if a text is invalid.
    """
    names = vehicle.inputs[: vehicle.n_commands]
    order = [1, 3, 2, *range(4, 33)]
    servo_by_command = {
        name: Servo(order[i], float(vehicle.lower_commands[i]), float(vehicle.upper_commands[i]))
        for i, name in enumerate(names)
    }
    for text in servo_texts:
        name, _, assignment = text.partition("=")
        parts = assignment.split(":")
        try:
            channel, lower, upper = int(parts[0]), *(float(number) for number in parts[1:3])
        except ValueError:
            raise UsageError(
                f"servo '{text}': expected COMMAND=OUTPUT:LOW:HIGH, for example"
                f" {names[0]}=1:{float(vehicle.lower_commands[0]):g}"
                f":{float(vehicle.upper_commands[0]):g}"
            ) from None
        if name not in names:
            raise UsageError(f"servo '{text}': no command '{name}'{suggest_name(name, names)}")
        if not 1 <= channel <= 32:
            raise UsageError(f"servo '{text}': outputs are numbered 1 to 32")
        servo_by_command[name] = Servo(channel, lower, upper)
    return [servo_by_command[name] for name in names]


@final
class ArduPilotBackend:
    """Server that replies to ArduPilot's packets with the motion of a vehicle.

    Frames advance at the frame rate requested by ArduPilot. The vehicle has its own time step:
    inputs act from its next step, and the motion is interpolated between steps. A repeated packet
    gets the same reply without advancing the time. Lost packets are not compensated. A decreasing
    frame count restarts the simulation. Invalid packets are ignored.

    Args:
        vehicle: simulated vehicle.
        servos: servo of each command of the vehicle.
        port: UDP port; 0 selects a free port.
        host: address to listen on.
    """

    def __init__(
        self, vehicle: Vehicle, servos: Sequence[Servo], port: int = 9002, host: str = "127.0.0.1"
    ) -> None:
        self.vehicle = vehicle
        self.servos = list(servos)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self.socket.bind((host, port))
        except OSError as error:
            raise UsageError(
                f"UDP port {port}: cannot be opened ({error.strerror}); stop the program that uses"
                " it or choose another port"
            ) from None
        self.port = int(self.socket.getsockname()[1])
        self.n_invalid_packets = 0
        self.n_lost_frames = 0
        self._reset()

    def _reset(self) -> None:
        """Reset the vehicle to its initial state."""
        self.last_frame = -1
        self.reply = b""
        self.time = 0.0
        self.n_steps = 0
        x = self.vehicle.initial_state.unsqueeze(0)
        self.previous_state = self.current_state = x
        self.memory = self.vehicle.dynamics.initial_state(1).to(x.dtype)

    def serve(self, packets: int | None = None, timeout: float | None = None) -> None:
        """Answer packets until `packets` have been answered, or none arrives for `timeout` s."""
        self.socket.settimeout(timeout)
        n_answered = 0
        while packets is None or n_answered < packets:
            try:
                data, sender = self.socket.recvfrom(4096)
            except TimeoutError:
                return
            except ConnectionError:
                # the client has closed its socket; another client may follow
                continue
            reply = self.reply_to(data)
            if reply is not None:
                self.socket.sendto(reply, sender)
                n_answered += 1

    def close(self) -> None:
        """Close the UDP socket; the server cannot be used afterwards."""
        self.socket.close()

    def reply_to(self, data: bytes) -> bytes | None:
        """Return the reply to a packet; None for an invalid packet."""
        layout = _PACKET_FORMATS.get(int.from_bytes(data[:2], "little"))
        if layout is None or len(data) != layout.size:
            self.n_invalid_packets += 1
            return None
        _, rate, frame, *pulses = layout.unpack(data)
        is_invalid = any(
            pulse and not _PULSE_RANGE[0] <= pulse <= _PULSE_RANGE[1] for pulse in pulses
        )
        if is_invalid or not _FRAME_RATE_RANGE[0] <= rate <= _FRAME_RATE_RANGE[1]:
            self.n_invalid_packets += 1
            return None
        if frame == self.last_frame:
            return self.reply
        if frame < self.last_frame:
            log_message("ArduPilot restarted")
            self._reset()
        elif self.last_frame >= 0:
            self.n_lost_frames += frame - self.last_frame - 1
        self.last_frame = frame
        self.time += 1.0 / rate
        self._advance_vehicle(pulses)
        self.reply = self._encode_motion()
        return self.reply

    def _advance_vehicle(self, pulses: Sequence[int]) -> None:
        """Step the vehicle until it has reached the time of the frame.

        Args:
            pulses: pulse widths of the servo outputs in us.
        """
        # a packet of 16 outputs has no pulse for the outputs 17 to 32
        commands_by_servo = [
            servo.command_at(pulses[servo.channel - 1] if servo.channel <= len(pulses) else 0)
            for servo in self.servos
        ]
        commands = torch.tensor([commands_by_servo], dtype=self.current_state.dtype)
        # the tolerance prevents an additional step due to rounding of the accumulated time
        while self.n_steps * self._dt < self.time - 1e-9:
            self.previous_state = self.current_state
            with torch.no_grad():
                next_state, memory = self.vehicle.dynamics.step(
                    self.previous_state, self.vehicle.inputs_at(commands), self.memory
                )
            # JSON has neither NaN nor infinity: the vehicle stays in its last finite state
            if bool(torch.isfinite(next_state).all()) and bool(torch.isfinite(memory).all()):
                self.current_state = next_state
                self.memory = memory
            self.n_steps += 1

    def _encode_motion(self) -> bytes:
        """Return the motion at the time of the frame as the line of JSON that ArduPilot expects."""
        step_fraction = min(max(self.time / self._dt - (self.n_steps - 1), 0.0), 1.0)
        state: Tensor = self.previous_state[0] + step_fraction * (
            self.current_state[0] - self.previous_state[0]
        )
        acceleration = ((self.current_state[0] - self.previous_state[0]) / self._dt).tolist()
        north, east, psi, u, v, r = state[:6].tolist()
        named_states = dict(zip(self.vehicle.states, state.tolist(), strict=True))
        # a planar model has no roll
        phi = named_states.get("phi", 0.0)
        p = named_states.get("p", 0.0)
        cos_psi = math.cos(psi)
        sin_psi = math.sin(psi)
        horizontal_sway = v * math.cos(phi)
        wrapped_heading = math.remainder(psi, 2 * math.pi)
        reply = {
            "timestamp": self.time,
            "imu": {
                "gyro": [p, 0.0, r],
                # specific force: acceleration in the rotating body frame minus gravity
                "accel_body": [
                    acceleration[3] - r * v,
                    acceleration[4] + r * u - _GRAVITY * math.sin(phi),
                    p * v - _GRAVITY * math.cos(phi),
                ],
            },
            "position": [north, east, 0.0],
            "attitude": [phi, 0.0, wrapped_heading],
            "velocity": [
                u * cos_psi - horizontal_sway * sin_psi,
                u * sin_psi + horizontal_sway * cos_psi,
                0.0,
            ],
        }
        return b"\n" + json.dumps(reply, separators=(",", ":")).encode() + b"\n"

    @property
    def _dt(self) -> float:
        return self.vehicle.dynamics.dt
