"""Logs rewritten as tables of strangers: other names, units, signs, axes, delimiters, dates."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from residnet.core.log import Log

FACTORS = {
    "rad": 1.0,
    "deg": 180.0 / math.pi,
    "°": 180.0 / math.pi,
    "rad/s": 1.0,
    "deg/s": 180.0 / math.pi,
    "°/min": 10800.0 / math.pi,
    "m/s": 1.0,
    "kn": 3600.0 / 1852.0,
    "km/h": 3.6,
    "m": 1.0,
    "1/s": 1.0,
    "rpm": 60.0,
    "1/min": 60.0,
    "U/min": 60.0,
}
NAMES = {
    language: tuple(names.split("|"))
    for language, names in {
        "English": "time|north|east|heading|surge|sway|yaw rate|rudder|n",
        "German": "Zeit|Nord|Ost|Kurs|Längsgeschwindigkeit|Quergeschwindigkeit|Drehrate"
        "|Ruderwinkel|Propellerdrehzahl",
        "French": "temps|position nord|position est|cap|vitesse d'avance|vitesse latérale"
        "|vitesse de lacet|angle de barre|régime hélice",
        "Spanish": "tiempo|norte|este|rumbo|velocidad de avance|velocidad lateral"
        "|velocidad de giro|ángulo de timón|revoluciones hélice",
        "Dutch": "tijd|noord|oost|koers|snelheid vooruit|snelheid dwars|draaisnelheid"
        "|roerhoek|toerental",
        "Norwegian": "tid|nord|øst|kurs|hastighet fremover|hastighet tverrskips|svinghastighet"
        "|rorvinkel|turtall",
        "Japanese": "時刻|北|東|船首方位|前後速度|左右速度|回頭角速度|舵角|プロペラ回転数",
    }.items()
}
CHANNELS = ("x", "y", "psi", "u", "v", "r", "delta", "n")


@dataclass(frozen=True)
class Style:
    """How a stranger writes logs.

    Attributes:
        language: of the column names.
        units: channel -> unit.
        told: whether the header names the units.
        signs: channels that point the other way.
        delimiter: between cells.
        decimal: sign of the decimals.
        dates: format of local dates in place of seconds; empty for seconds.
        encoding: of the text.
        left_out: channels that are not written.
    """

    language: str = "English"
    units: Mapping[str, str] = field(default_factory=dict)
    told: bool = True
    signs: Sequence[str] = ()
    delimiter: str = ","
    decimal: str = "."
    dates: str = ""
    encoding: str = "utf-8"
    left_out: Sequence[str] = ()


SI = {"x": "m", "y": "m", "psi": "rad", "u": "m/s", "v": "m/s", "r": "rad/s", "delta": "rad"}


def write(logs: Sequence[Log], folder: Path, style: Style) -> list[Path]:
    """Write each log as a table; returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    names = dict(zip(("t", *CHANNELS), NAMES[style.language], strict=True))
    files = []
    for number, log in enumerate(logs):
        table: dict[str, object] = {names["t"]: _times(log, style, number)}
        for channel in CHANNELS:
            if channel not in log.channels or channel in style.left_out:
                continue
            unit = style.units.get(channel, SI.get(channel, "1/s"))
            values = log[channel] * FACTORS[unit] * (-1.0 if channel in style.signs else 1.0)
            if channel == "psi":
                values = np.remainder(values, 2.0 * np.pi * FACTORS[unit])
            table[names[channel] + (f" [{unit}]" if style.told else "")] = values
        file = folder / f"{log.name}.csv"
        pd.DataFrame(table).to_csv(
            file,
            index=False,
            sep=style.delimiter,
            decimal=style.decimal,
            encoding=style.encoding,
            float_format="%.9g",
        )
        files.append(file)
    return files


def _times(log: Log, style: Style, number: int) -> object:
    if not style.dates:
        return log.t
    start = pd.Timestamp("2024-05-28 23:59:30") + pd.Timedelta(hours=number)
    moments = start + pd.to_timedelta(np.rint(log.t * 1e3), unit="ms")
    return [moment.strftime(style.dates)[:-3] for moment in moments]
