"""The one table of units, and what people write for them: `kt`, `°/s`, `rev/min`, `m s-1`, `RPM`.

Inside residnet everything is SI with angles in radians; propeller revolutions are in 1/s. A unit is
read as it stands first and without regard to case after that. Where two units then differ in case
alone (`kn` and `kN`), the dimension that is expected decides.
"""

from __future__ import annotations

import difflib
import itertools
import math
import re
from collections.abc import Iterator
from functools import cache, lru_cache

from residnet.core.errors import UsageError

# SI unit of a dimension -> factors to it
_FACTORS: dict[str, dict[str, float]] = {
    "-": {"-": 1.0, "%": 0.01},
    "m": {
        "m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0, "nmi": 1852.0, "ft": 0.3048,
    },
    "m^2": {"m^2": 1.0},
    "m^3": {"m^3": 1.0},
    "s": {
        "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "day": 86400.0,
    },
    "1/s": {
        "Hz": 1.0, "1/s": 1.0, "1/min": 1.0 / 60.0, "rps": 1.0, "rpm": 1.0 / 60.0,
    },
    "1/s^2": {"1/s^2": 1.0, "rpm/s": 1.0 / 60.0},
    "m/s": {
        "m/s": 1.0, "cm/s": 0.01, "m/min": 1.0 / 60.0, "kn": 1852.0 / 3600.0, "km/h": 1.0 / 3.6,
        "mph": 1609.344 / 3600.0, "ft/s": 0.3048,
    },
    "m/s^2": {"m/s^2": 1.0, "g": 9.80665},
    "rad": {
        "rad": 1.0, "deg": math.pi / 180.0, "cdeg": math.pi / 18000.0, "gon": math.pi / 200.0,
    },
    "rad/s": {
        "rad/s": 1.0, "rad/min": 1.0 / 60.0, "deg/s": math.pi / 180.0, "deg/min": math.pi / 10800.0,
    },
    "rad/s^2": {"rad/s^2": 1.0, "deg/s^2": math.pi / 180.0},
    "N": {"N": 1.0, "kN": 1000.0},
    "N m": {"N m": 1.0, "kN m": 1000.0},
    "kg": {"kg": 1.0, "t": 1000.0},
    **{unit: {unit: 1.0} for unit in ("kg m", "kg m^2", "kg/m^3", "V", "A", "W")},
}  # fmt: skip
_UNITS = {
    unit: (si, factor) for si, factors in _FACTORS.items() for unit, factor in factors.items()
}
"""SI unit of each unit's dimension, and the factor to it."""

# a part of a unit -> what else people write for it
_WORDS: dict[str, str] = {
    "%": "percent pct prozent procent prosent",
    "m": "meter meters metre metres mtr м 米 メートル",
    "nmi": "nm NM",
    "ft": "foot feet",
    "s": "sec secs second seconds sek sekunde sekunden seconde segundo segundos sekund с 秒",
    "ms": "msec millisecond milliseconds",
    "us": "usec µs μs microsecond microseconds",
    "ns": "nsec nanosecond nanoseconds",
    "min": "minute minutes mins minuten minuto minutos minutt мин 分",
    "h": "hr hrs hour hours stunde stunden heure uur 時",
    "day": "days tag tage jour jours dag dagen",
    "Hz": "hertz",
    "kn": "kt kts knot knots knoten nd nds noeud noeuds nœud nœuds nudo nudos knoop knopen knop"
    " ノット",
    "rpm": "r.p.m. upm",
    "rps": "r.p.s.",
    "rad": "radian radians rads",
    "deg": "° º degree degrees degs grader grados degré degrés degres graden graus gradi stopnie"
    " stopni град 度",
    "N": "newton newtons",
    "N m": "Nm N·m newtonmeter newtonmetre",
    "kN m": "kNm kN·m",
    "t": "tonne tonnes",
    "V": "volt volts",
    "A": "amp amps ampere",
    "W": "watt watts",
    "km/h": "kmh kph km/hr",
    "mph": "mi/h mile/h miles/h",
    "m/s": "mps",
    "deg/s": "dps",
    "deg/min": "degmin",
    "-": "none dimensionless",
}
_TURNS = "rev revs revolutions r u tr o omw omdr obr об giri 转 turns vueltas 回転"
# where one part of a quotient is written in another way than the table does
_PARTS = ("m", "km", "cm", "rad", "deg", "kg", "rpm", "1")
_POWERS = {"²": "^2", "³": "^3", "**": "^", "⁻": "^-", "¹": "1"}


@cache
def slips(si: str) -> dict[float, str]:
    """Return factor by which values are too large -> the two units of a dimension in question."""
    factors, out = _FACTORS.get(si, {}), dict[float, str]()
    for usual in (si.replace("rad", "deg"), si):
        for unit, factor in factors.items() if usual in factors else ():
            size = factors[usual] / factor
            # those closer together, as gon and deg, are no better explanation than chance
            if abs(math.log(size)) > 0.2:
                out.setdefault(round(size, 9), f"{unit} taken as {usual}")
                out.setdefault(round(1.0 / size, 9), f"{usual} taken as {unit}")
    return out


def units() -> tuple[str, ...]:
    """Return the names of all units that residnet converts."""
    return tuple(_UNITS)


def si_unit(unit: str) -> str:
    """Return the SI unit of the dimension of `unit`.

    Raises:
        UsageError: where the unit is not known, or may be one of two.
    """
    return _UNITS[known_unit(unit)][0]


def to_si(unit: str, expected: str | None = None) -> float:
    """Return the factor that converts values in `unit` to SI.

    Args:
        unit: name of a unit, for example `deg/s`.
        expected: SI unit of the dimension that is wanted, for example `rad/s`; None takes any.

    Raises:
        UsageError: where the unit is not known or of another dimension than `expected`.
    """
    return _UNITS[known_unit(unit, expected)][1]


@lru_cache(maxsize=4096)
def known_unit(unit: str, expected: str | None = None) -> str:
    """Return residnet's own name of a unit, whatever its spelling.

    Args:
        expected: SI unit of the dimension that is wanted; None takes any.

    Raises:
        UsageError: where the unit is not known, of another dimension than `expected`, or, without
            `expected`, may be one of two that differ in case.
    """
    meant, fitting = _meant(unit, expected)
    if len({_UNITS[name] for name in fitting}) == 1:
        return fitting[0]
    usual = [name for name, (base, _) in _UNITS.items() if base == expected]
    if not meant:
        hint = f"; did you mean '{near}'?" if (near := _near(unit, expected)) else ""
        listed = sorted(usual) if expected is not None else [*sorted(_UNITS)[:24], "..."]
        raise UsageError(f"unknown unit '{unit}'{hint or '; valid: ' + ', '.join(listed)}")
    if not fitting:
        raise UsageError(
            f"unit '{unit}' does not measure [{expected}]; units that do:"
            f" {', '.join(usual) or 'none'}"
        )
    raise UsageError(f"unit '{unit}' may be {' or '.join(fitting)}; write the one that is meant")


def is_unit(text: str) -> bool:
    """Return whether a text is a unit that `known_unit` knows; no other name is looked for."""
    return len({_UNITS[name] for name in _meant(text, None)[1]}) == 1


def _meant(unit: str, expected: str | None) -> tuple[tuple[str, ...], list[str]]:
    """Return the units that a spelling may mean, and those of them that measure `expected`."""
    exact, folded = _spellings()
    text = _tidy(unit)
    meant: tuple[str, ...] = ()
    fitting: list[str] = []
    for spellings, written in ((exact, text), (folded, text.casefold())):
        meant = meant or spellings.get(written, ())
        fitting = fitting or [
            name for name in spellings.get(written, ()) if expected in (None, _UNITS[name][0])
        ]
    return meant, fitting


def _tidy(unit: str) -> str:
    """Return a unit with its blanks, powers and quotients in one style."""
    text = " ".join(unit.split())
    for written, power in _POWERS.items():
        text = text.replace(written, power)
    text = re.sub(r"\s*(?:/|\bper\b|\bpro\b|\bpar\b|\bpor\b|毎)\s*", "/", text)
    # `m s-1`, `m.s^-1` and `min-1` are quotients
    quotient = re.fullmatch(r"(?:(.+?)[ .·*])?([^\W\d_]+)\^?-([12])", text)
    if quotient is not None:
        above, below, power = quotient.groups()
        text = f"{above or 1}/{below}" + ("^2" if power == "2" else "")
    return re.sub(r"(?<=[a-z])2$", "^2", text)


@cache
def _spellings() -> tuple[dict[str, tuple[str, ...]], dict[str, tuple[str, ...]]]:
    """Return what may be written for each unit, with and without regard to case."""
    exact: dict[str, list[str]] = {}
    for text, unit in _written():
        if unit not in exact.setdefault(text, []):
            exact[text].append(unit)
    folded: dict[str, list[str]] = {}
    for text, meant in exact.items():
        entry = folded.setdefault(text.casefold(), [])
        entry += [unit for unit in meant if unit not in entry]
    return (
        {text: tuple(meant) for text, meant in exact.items()},
        {text: tuple(meant) for text, meant in folded.items()},
    )


def _written() -> Iterator[tuple[str, str]]:
    """Yield (text, unit) for every spelling."""
    for unit in _UNITS:
        yield unit, unit
        for word in _WORDS.get(unit, "").split():
            yield word, unit
        above, slash, below = unit.partition("/")
        if not slash:
            continue
        # a power stays behind the word that it belongs to
        below, caret, power = below.partition("^")
        tops = [above, *_WORDS.get(above, "").split()] if above in _PARTS else [above]
        tops += _TURNS.split() if above == "1" and not power else []
        for top, bottom in itertools.product(tops, [below, *_WORDS.get(below, "").split()]):
            yield f"{top}/{bottom}{caret}{power}", unit


def _near(unit: str, expected: str | None) -> str | None:
    """Return the spelling that a text is a slip of the pen of; None where there is no single one.

    What can be read in the text must stay as it is: `deg/m` is never taken for `deg/s`.
    """
    exact, _ = _spellings()
    text = _tidy(unit)
    wanted = [
        spelling
        for spelling, meant in exact.items()
        if any(expected in (None, _UNITS[name][0]) for name in meant)
    ]
    close = [
        spelling
        for spelling in difflib.get_close_matches(text, wanted, n=6, cutoff=0.6)
        if sorted(spelling) == sorted(text) or _one_word_differs(spelling, text)
    ]
    # swapped letters are likelier than another word
    close = [spelling for spelling in close if sorted(spelling) == sorted(text)] or close
    factors = {_UNITS[name][1] for spelling in close for name in exact[spelling]}
    return exact[close[0]][0] if len(factors) == 1 else None


def _one_word_differs(spelling: str, text: str) -> bool:
    """Return whether one part of a quotient differs, by little: a word of three letters or more."""
    a, b = spelling.casefold().split("/"), text.casefold().split("/")
    if len(a) != len(b):
        return False
    other = [(x, y) for x, y in zip(a, b, strict=True) if x != y]
    if len(other) != 1 or min(len(part) for part in other[0]) < 3:
        return False
    x, y = other[0]
    return x[0] == y[0] and difflib.SequenceMatcher(None, x, y).ratio() >= 0.75
