"""How quick the simulators are: ArduPilot's back end over loopback, and many Gymnasium vessels.

    python scripts/bench/simulators.py [--source wam_v_cal] [--packets 4000] [--envs 1024]

The first line tells how many of ArduPilot's packets a second are answered over UDP while every
hundredth packet is lost, every seventieth is cut off and every ninetieth is rubbish; 400 a second
are asked, 2.5 ms each. The second tells how many vessel steps a second the vectorised environment
makes, beside a bare rollout of as many vessels under the same commands; the environment should have
60 % of it. Both take turns, and the quickest of three rounds counts. `--source` may be the folder
of a finished fit.
"""

from __future__ import annotations

import argparse
import json
import socket
import struct
import threading
import time

import numpy as np
import torch

from residnet.dynamics.rollout import Rollout
from residnet.simulators.ardupilot import ArduPilotBackEnd, servos
from residnet.simulators.gym import VesselVectorEnv
from residnet.simulators.vehicle import Vehicle, vehicle

RATE = 400
STEPS = 200


def packet(frame: int, *pulses: int) -> bytes:
    """Return a packet of sixteen servos as ArduPilot documents it."""
    return struct.pack("<HHI16H", 18458, RATE, frame, *pulses, *[0] * (16 - len(pulses)))


def answered(boat: Vehicle, packets: int) -> tuple[float, float, float, int]:
    """Return packets answered in a second of wall time, CPU and slowest time in ms, the refused."""
    end = ArduPilotBackEnd(boat, servos(boat), port=0)
    random = np.random.default_rng(0)
    sent = [frame for frame in range(1, packets + 1) if frame % 100]
    wrong = sum((frame % 70 == 0) + (frame % 90 == 0) for frame in sent)
    server = threading.Thread(target=end.serve, args=(len(sent), 5.0))
    server.start()
    slowest = 0.0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(5.0)
        client.connect(("127.0.0.1", end.port))
        begun, working = time.perf_counter(), time.process_time()
        for frame in sent:
            pulses = [int(pulse) for pulse in random.integers(1000, 2000, 4)]
            if frame % 70 == 0:
                client.send(packet(frame, *pulses)[:-3])
            if frame % 90 == 0:
                client.send(bytes(random.integers(0, 256, 40, dtype=np.uint8)))
            at = time.perf_counter()
            client.send(packet(frame, *pulses))
            reply = json.loads(client.recv(4096))
            slowest = max(slowest, time.perf_counter() - at)
            if not np.isfinite([*reply["position"], *reply["velocity"], *reply["attitude"]]).all():
                raise SystemExit(f"simulators.py: the answer to frame {frame} is not finite")
        taken, cpu = time.perf_counter() - begun, time.process_time() - working
    server.join()
    if end.refused != wrong:
        raise SystemExit(f"simulators.py: {end.refused} packets were refused, {wrong} were wrong")
    end.close()
    return len(sent) / taken, 1e3 * cpu / len(sent), 1e3 * slowest, wrong


def stepped(boat: Vehicle, count: int) -> tuple[float, float]:
    """Return vessel steps per second of CPU time of the environment, and of a bare rollout."""
    envs = VesselVectorEnv(boat, count, "heading", seconds=60.0)
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, count, boat.commands))
    middle, half = 0.5 * (boat.high + boat.low), 0.5 * (boat.high - boat.low)
    start = boat.start.expand(count, -1)
    w = torch.from_numpy(actions).to(start.dtype) * half + middle
    held = torch.cat((w, boat.rest.expand(STEPS, count, -1)), dim=-1).transpose(0, 1).contiguous()
    roll = Rollout(boat.dynamics)
    memory = boat.dynamics.initial_state(count).to(start.dtype)
    best = [0.0, 0.0]
    for _ in range(3):
        envs.reset(seed=0)
        begun = time.process_time()
        for action in actions:
            envs.step(action)
        middle_of = time.process_time()
        with torch.no_grad():
            roll(start, held, memory)
        ended = time.process_time()
        rates = STEPS * count / (middle_of - begun), STEPS * count / (ended - middle_of)
        best = [max(pair) for pair in zip(best, rates, strict=True)]
    return best[0], best[1]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--source", default="wam_v_cal")
    parser.add_argument("--packets", type=int, default=4000)
    parser.add_argument("--envs", type=int, default=1024)
    given = parser.parse_args()
    torch.set_num_threads(1)
    rate, cpu, slowest, wrong = answered(vehicle(given.source, dt=1 / RATE), given.packets)
    print(
        f"ArduPilot: {rate:.0f} packets a second answered, {cpu:.2f} ms of CPU time each with the"
        f" client's, the slowest after {slowest:.1f} ms; {wrong} malformed ones left out",
        flush=True,
    )
    many, bare = stepped(vehicle(given.source), given.envs)
    print(
        f"Gymnasium: {given.envs} vessels, {many / 1e3:.0f} thousand steps a second, bare rollout"
        f" {bare / 1e3:.0f}: {many / bare:.0%}"
    )


if __name__ == "__main__":
    main()
