"""How many of ArduPilot's packets a second are answered over UDP, by loopback.

    python scripts/bench/simulators.py [--source wam_v_cal] [--packets 4000]

Every hundredth packet is lost, every seventieth is cut off and every ninetieth is rubbish; 400 a
second are asked, 2.5 ms each. `--source` may be the folder of a finished fit.
"""

from __future__ import annotations

import json
import socket
import struct
import threading
import time

import bench
import numpy as np

from residnet.simulators.ardupilot import ArduPilotBackend, assign_servos
from residnet.simulators.vehicle import Vehicle, load_vehicle

RATE = 400


def packet(frame: int, *pulses: int) -> bytes:
    """Return a packet of sixteen servos as ArduPilot documents it."""
    return struct.pack("<HHI16H", 18458, RATE, frame, *pulses, *[0] * (16 - len(pulses)))


def answered(boat: Vehicle, packets: int) -> tuple[float, float, float, int]:
    """Return packets answered in a second of wall time, CPU and slowest time in ms, the refused."""
    end = ArduPilotBackend(boat, assign_servos(boat), port=0)
    random = np.random.default_rng(0)
    sent = [frame for frame in range(1, packets + 1) if frame % 100]
    wrong = sum((frame % 70 == 0) + (frame % 90 == 0) for frame in sent)
    server = threading.Thread(target=end.serve, args=(len(sent), 5.0))
    server.start()
    slowest = 0.0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(5.0)
        client.connect(("127.0.0.1", end.port))
        begun = time.perf_counter()
        working = time.process_time()
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
        taken = time.perf_counter() - begun
        cpu = time.process_time() - working
    server.join()
    if end.n_invalid_packets != wrong:
        raise SystemExit(
            f"simulators.py: {end.n_invalid_packets} packets were refused, {wrong} were wrong"
        )
    end.close()
    return len(sent) / taken, 1e3 * cpu / len(sent), 1e3 * slowest, wrong


def main() -> None:
    """Measure and print."""
    given = bench.options(__doc__, source="wam_v_cal", packets=4000)
    rate, cpu, slowest, wrong = answered(load_vehicle(given.source, dt=1 / RATE), given.packets)
    print(
        f"ArduPilot: {rate:.0f} packets a second answered, {cpu:.2f} ms of CPU time each with the"
        f" client's, the slowest after {slowest:.1f} ms; {wrong} malformed ones left out",
        flush=True,
    )


if __name__ == "__main__":
    main()
