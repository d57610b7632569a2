"""Random layouts of recorders' tables: is what `residnet new` drafts right, marked, or refused?

    python scripts/bench/layouts.py [--count 20] [--seed 0]

Logs of a simulated boat are written as tables whose language, units, times, positions, delimiter,
decimals, encoding, lines above the names and kinds of rudder and throttle are drawn at random. Each
layout is drafted and read, and every channel is compared with the truth. A value that is wrong and
not marked as a guess makes the script fail; so does an error that is not one line.
"""

from __future__ import annotations

import csv
import math
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace as Layout
from typing import Any

import bench
import numpy as np
import pandas as pd

from residnet.core.config import validate_config
from residnet.core.errors import ResidnetError
from residnet.core.log import Log
from residnet.io.drafting.questions import DraftNotes
from residnet.io.drafting.tables import draft_tables
from residnet.io.readers import ReaderConfig
from residnet.manoeuvres.trials import simulate_trial_logs
from residnet.manoeuvres.trials_config import SimulatedTrials
from residnet.tasks.demo import DEMO_TRIALS

DEG, KN = 180.0 / math.pi, 3600.0 / 1852.0
KEYS = ["t", "x", "y", "lat", "lon", "psi", "u", "v", "r", "delta", "n", "throttle"]
LANGUAGES = {
    "English": "Log time|Northing|Easting|GPS_Lat|Lng|True heading|speed through water"
    "|lateral velocity|Rate of turn|helm angle|shaft speed|Throttle",
    "German": "Zeitstempel|Hochwert|Rechtswert|Breite|geogr. Länge|Kurs rechtweisend"
    "|Vorausgeschwindigkeit|Querdrift|Gierrate|Ruderlage|Motordrehzahl|Gashebel",
    "French": "Horodatage|Position nord|Position est|Latitude|Longitude|Cap vrai|Vitesse surface"
    "|Dérive|Vitesse de lacet|Angle de barre|Régime hélice|Gaz",
    "Spanish": "Marca de tiempo|Pos norte|Pos este|Latitud|Longitud|Rumbo verdadero"
    "|Velocidad de avance|Abatimiento|Velocidad de giro|Ángulo de pala|Revoluciones hélice"
    "|Acelerador",
    "Dutch": "Tijdstip|Noordpositie|Oostpositie|Breedte|Lengte|Kompaskoers|Vaart door het water"
    "|Verlijering|Bochtaanwijzer|Roerstand|Schroeftoerental|Gashendel",
    "Norwegian": "Klokkeslett|Nordposisjon|Østposisjon|Breddegrad|Lengdegrad|Styrt kurs"
    "|Fart gjennom vannet|Tverrskips fart|Svingrate|Rorutslag|Akselturtall|Gasspak",
    "Japanese": "日時|北方向位置|東方向位置|緯度|経度|船首角|対水速力|横流れ速度|回頭率|操舵角"
    "|軸回転数|スロットル",
    "Italian": "Ora|Nord|Est|Latitudine|Longitudine|Prua|Velocità avanzamento|Scarroccio"
    "|Velocità di accostata|Angolo timone|Giri elica|Manetta",
    "Swedish": "Klockslag|Nord|Ost|Latitud|Longitud|Stävriktning|Fart genom vattnet|Avdrift"
    "|Girhastighet|Rodervinkel|Propellervarvtal|Gasreglage",
}
UNITS: dict[str, Sequence[tuple[str, float]]] = {
    "psi": (("deg", DEG), ("°", DEG), ("degrees", DEG), ("rad", 1.0)),
    "u": (("kn", KN), ("m/s", 1.0), ("knots", KN), ("km/h", 3.6)),
    "v": (("kn", KN), ("m/s", 1.0), ("cm/s", 100.0)),
    "r": (("deg/min", 60.0 * DEG), ("°/min", 60.0 * DEG), ("°/s", DEG), ("rad/s", 1.0)),
    "delta": (("deg", DEG), ("°", DEG), ("rad", 1.0)),
    "n": (("rpm", 60.0), ("1/min", 60.0), ("Hz", 1.0), ("U/min", 60.0)),
}
ABOVE: dict[str, Sequence[str]] = {
    "nothing": (),
    "comments": ("# recorder 4.2, vessel MV Example", "# started 2025-06-17"),
    "words": ("Data logger XY-7 export", "Vessel: MV Example", "Serial: 12345", ""),
    "quotes": ('"Sea trial";"17.06.2025"', ""),
}
CLOCKS: dict[str, Callable[[pd.Timestamp], str]] = {
    "iso": lambda at: f"{at.isoformat(timespec='milliseconds')}Z",
    "zone": lambda at: f"{at:%Y-%m-%d %H:%M:%S}.{at.microsecond // 1000:03d}+02:00",
    "half days": lambda at: f"{at:%m/%d/%Y %I:%M:%S}.{at.microsecond // 1000:03d} {at:%p}",
    "local": lambda at: f"{at:%d.%m.%Y %H:%M:%S}.{at.microsecond // 1000:03d}",
    "clock": lambda at: f"{at:%H:%M:%S}.{at.microsecond // 1000:03d}",
    "unix": lambda at: f"{at.timestamp():.3f}",
    "unix ms": lambda at: f"{at.timestamp() * 1000:.0f}",
    "days": lambda at: f"{(at - pd.Timestamp('1899-12-30')) / pd.Timedelta(days=1):.10f}",
}
Column = tuple[str, str, list[Any]]


def drawn(rng: np.random.Generator) -> Layout:
    """Return how tables are written, at random; each value is a name from above or tells itself."""

    def one(*options: str) -> str:
        return str(rng.choice(options))

    language = one(*LANGUAGES)
    delimiter = one(",", ";", "\t", "|")
    comma = delimiter != "," and language != "English" and rng.random() < 0.8
    return Layout(
        language=language,
        delimiter=delimiter,
        decimal="," if comma else ".",
        encoding=one("utf-8", "utf-8-sig", "cp932" if language == "Japanese" else "cp1252"),
        above=one(*ABOVE),
        units=one("[]", "()", "second line", "none"),
        clock=one("s", "ms", *CLOCKS),
        place=one("metres", "degrees", "utm"),
        slow=bool(rng.random() < 0.3),
        motion=bool(rng.random() < 0.6),
        wrapped=bool(rng.random() < 0.7),
        rudder=one("angle", "to port", "pulses", "per cent", "shares"),
        drive=one("revolutions", "pulses", "per cent"),
        ended=bool(rng.random() < 0.3),
        form=one("csv", "csv", "csv", "xlsx"),
    )


def columns_of(log: Log, layout: Layout, rng: np.random.Generator) -> list[Column]:
    """Names, units and cells of a log as a layout has them."""
    names = dict(zip(KEYS, LANGUAGES[layout.language].split("|"), strict=True))
    out: list[Column] = []

    def add(key: str, unit: str, values: Any) -> None:
        out.append((names[key], unit, list(values)))

    def unit_of(key: str) -> tuple[str, float]:
        return UNITS[key][int(rng.integers(len(UNITS[key])))]

    t = log.t - log.t[0]
    start = pd.Timestamp("2025-06-17 11:58:20")
    if layout.clock in ("s", "ms"):
        add("t", layout.clock, t * (1000.0 if layout.clock == "ms" else 1.0))
    else:
        add("t", "", (CLOCKS[layout.clock](start + pd.Timedelta(seconds=s)) for s in t))
    x, y = log["x"], log["y"]
    if layout.slow:
        held = (np.arange(t.size) // 5) * 5
        x, y = x[held], y[held]
    if layout.place == "degrees":
        add("lat", "deg", 54.3 + x / 111_320.0)
        add("lon", "deg", 10.15 + y / (111_320.0 * math.cos(math.radians(54.3))))
    else:
        far = (6_800_123.0, 431_222.0) if layout.place == "utm" else (0.0, 0.0)
        add("x", "m", x + far[0])
        add("y", "m", y + far[1])
    for key in ("psi", *(("u", "v", "r") if layout.motion else ())):
        turned = key == "psi" and layout.wrapped
        unit, factor = unit_of(key)
        add(key, unit, (np.remainder(log[key], 2 * math.pi) if turned else log[key]) * factor)
    share = log["delta"] / math.radians(35.0)
    unit, factor = unit_of("delta")
    rudders = {
        "angle": (unit, log["delta"] * factor),
        "to port": (unit, -log["delta"] * factor),
        "pulses": ("us", np.round(1500.0 + 500.0 * share)),
        "per cent": ("%", 100.0 * share),
        "shares": ("", share),
    }
    add("delta", *rudders[layout.rudder])
    share = log["n"] / float(np.abs(log["n"]).max())
    unit, factor = unit_of("n")
    drives = {
        "revolutions": ("n", unit, log["n"] * factor),
        "pulses": ("throttle", "us", np.round(1500.0 + 500.0 * share)),
        "per cent": ("throttle", "%", 100.0 * share),
    }
    add(*drives[layout.drive])
    return out


def write(log: Log, layout: Layout, rng: np.random.Generator, path: Path) -> None:
    """Write a log as a layout has it."""
    columns = columns_of(log, layout, rng)
    bracketed = layout.units in ("[]", "()")
    heads = [
        f"{name} {layout.units[0]}{unit}{layout.units[1]}" if unit and bracketed else name
        for name, unit, _ in columns
    ]
    rows: list[list[Any]] = [heads]
    rows += [[unit for _, unit, _ in columns]] if layout.units == "second line" else []
    rows += [list(row) for row in zip(*(cells for _, _, cells in columns), strict=True)]
    if layout.form == "xlsx":
        blank = [None] * len(heads)
        title = [["Sea trial", *blank[1:]], blank] if ABOVE[layout.above] else []
        pd.DataFrame([*title, *rows]).to_excel(path, index=False, header=False)
        return

    def text(cell: Any) -> str:
        written = f"{cell:.9f}" if isinstance(cell, float) else str(cell)
        return written.replace(".", layout.decimal) if isinstance(cell, float) else written

    with path.open("w", encoding=layout.encoding, newline="") as stream:
        stream.writelines(f"{line}\n" for line in ABOVE[layout.above])
        writer = csv.writer(stream, delimiter=layout.delimiter)
        for row in rows:
            writer.writerow([*map(text, row), *([""] if layout.ended else [])])


def wrong(read: Log, truth: Log) -> list[str]:
    """The channels of a log that are not what they were."""
    t = read.t - read.t[0]
    out: list[str] = []
    if not math.isclose(float(t[-1]), float(truth.t[-1] - truth.t[0]), rel_tol=0.02):
        return ["time"]
    for name in ("x", "y", "psi", "u", "v", "r", "delta", "n"):
        if name not in read.channels:
            continue
        known = np.isfinite(read[name])
        was = np.interp(t[known], truth.t - truth.t[0], truth[name])
        there = read[name][known]
        if name in ("x", "y"):
            away = float(np.abs((there - there[0]) - (was - was[0])).max()) > 10.0
        elif name == "psi":
            away = float(np.median(np.abs(np.angle(np.exp(1j * (there - was)))))) > 0.1
        else:
            away = not 0.7 < float(there @ was) / float(was @ was + 1e-12) < 1.4
        out += [name] if away else []
    return out


def judged(files: Sequence[Path], logs: Sequence[Log], layout: Layout) -> tuple[str, str]:
    """What became of a layout, and what is to be said of it."""
    marks = DraftNotes()
    try:
        content = draft_tables(files, marks)[0]
        reader = validate_config(content, ReaderConfig, "bench").build()
        faults = {
            fault
            for f, log in zip(files, logs, strict=True)
            for fault in wrong(reader.read(f), log)
        }
    except ResidnetError as error:
        return ("refused", str(error)) if "\n" not in str(error) else ("FAILED", str(error))
    lacking = {"psi", "delta"} - set(content["channels"])
    told = {key[-1] for key, _ in marks.guessed_values}
    # to which side a rudder turns the vessel is found later, from the logs themselves
    faults -= {"delta"} if layout.rudder == "to port" else set()
    unmarked = sorted(faults - told)
    if unmarked or lacking:
        return "FAILED", f"wrong and not marked: {unmarked}; not found: {sorted(lacking)}"
    return ("marked", f"wrong, and marked: {sorted(faults)}") if faults else ("right", "")


def main() -> int:
    """Draw layouts; return 1 where one is wrong without a mark."""
    given = bench.options(__doc__, count=20, seed=0)
    sensors = {**DEMO_TRIALS["noise"]["sensors"], "delta": {"noise": "0.1 deg"}}
    settings = {
        **DEMO_TRIALS,
        "step": "0.2 s",
        "noise": {**DEMO_TRIALS["noise"], "sensors": sensors},
    }
    config = validate_config(settings, SimulatedTrials, "bench")
    logs = simulate_trial_logs(config.draw_manoeuvres(), config)[::5]
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as temporary:
        for seed in range(given.seed, given.seed + given.count):
            layout = drawn(np.random.default_rng(seed))
            folder = Path(temporary) / str(seed)
            folder.mkdir()
            files = [folder / f"log_{i}.{layout.form}" for i in range(len(logs))]
            for file, log in zip(files, logs, strict=True):
                write(log, layout, np.random.default_rng(seed), file)
            state, words = judged(files, logs, layout)
            counts[state] += 1
            print(f"{seed} {state} {words}", flush=True)
            if state == "FAILED":
                print(f"  {layout}", flush=True)
    print(", ".join(f"{count} {state}" for state, count in counts.items()))
    return int(counts["FAILED"] > 0)


if __name__ == "__main__":
    sys.exit(main())
