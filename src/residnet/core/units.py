"""Convert units to SI, and parse their spellings: `kt`, `°/s`, `rev/min`, `m s-1`, `RPM`.

All quantities are in SI units with angles in radians; propeller revolutions are in 1/s. A spelling
is matched exactly first and case-insensitively second. If two units differ only in case (`kn` and
`kN`), the expected dimension decides.
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
_FACTORS_OF_DIMENSION: dict[str, dict[str, float]] = {
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
        "m/s": 1.0, "cm/s": 0.01, "mm/s": 0.001, "m/min": 1.0 / 60.0, "kn": 1852.0 / 3600.0,
        "km/h": 1.0 / 3.6, "mph": 1609.344 / 3600.0, "ft/s": 0.3048,
    },
    "m/s^2": {"m/s^2": 1.0, "g": 9.80665},
    "rad": {
        "rad": 1.0, "deg": math.pi / 180.0, "cdeg": math.pi / 18000.0, "gon": math.pi / 200.0,
    },
    "rad/s": {
        "rad/s": 1.0, "rad/min": 1.0 / 60.0, "deg/s": math.pi / 180.0, "deg/min": math.pi / 10800.0,
        "mdeg/s": math.pi / 180000.0, "mrad/s": 0.001,
    },
    "rad/s^2": {"rad/s^2": 1.0, "deg/s^2": math.pi / 180.0},
    "N": {"N": 1.0, "kN": 1000.0},
    "N m": {"N m": 1.0, "kN m": 1000.0},
    "kg": {"kg": 1.0, "t": 1000.0},
    **{unit: {unit: 1.0} for unit in ("kg m", "kg m^2", "kg/m^3", "V", "A", "W")},
}  # fmt: skip
_UNITS = {
    unit: (si, factor)
    for si, factors in _FACTORS_OF_DIMENSION.items()
    for unit, factor in factors.items()
}
"""SI unit of each unit's dimension, and the factor to it."""

# unit or part of a unit -> other spellings
_SPELLINGS_OF_UNIT: dict[str, str] = {
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
    "kn": (
        "kt kts knot knots knoten nd nds noeud noeuds nœud nœuds nudo nudos knoop knopen knop"
        " ノット"
    ),
    "rpm": "r.p.m. upm",
    "rps": "r.p.s.",
    "rad": "radian radians rads",
    "deg": (
        "° º degree degrees degs grader grados degré degrés degres graden graus gradi stopnie"
        " stopni град 度"
    ),
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
    "mdeg/s": "mdps",
    "deg/min": "degmin",
    "-": "none dimensionless",
}
_REVOLUTION_SPELLINGS = "rev revs revolutions r u tr o omw omdr obr об giri 转 turns vueltas 回転"
# numerators whose other spellings also occur in quotients
_QUOTIENT_PARTS = ("m", "km", "cm", "rad", "deg", "kg", "rpm", "1")
_POWER_SPELLINGS = {"²": "^2", "³": "^3", "**": "^", "⁻": "^-", "¹": "1"}


@cache
def unit_confusions(si: str) -> dict[float, str]:
    """Return the factors by which values are wrong if a unit is taken for another one.

    Args:
        si: SI unit of the dimension.

    Returns:
        Factor -> description such as `deg taken as rad`.
    """
    factors = _FACTORS_OF_DIMENSION.get(si, {})
    confusions = dict[float, str]()
    for reference_unit in (si.replace("rad", "deg"), si):
        for unit, factor in factors.items() if reference_unit in factors else ():
            ratio = factors[reference_unit] / factor
            # units with a smaller ratio, such as gon and deg, explain a factor no better than
            # chance
            if abs(math.log(ratio)) > 0.2:
                confusions.setdefault(round(ratio, 9), f"{unit} taken as {reference_unit}")
                confusions.setdefault(round(1.0 / ratio, 9), f"{reference_unit} taken as {unit}")
    return confusions


def unit_names() -> tuple[str, ...]:
    """Return the names of all units that residnet converts."""
    return tuple(_UNITS)


def si_unit(unit: str) -> str:
    """Return the SI unit of the dimension of `unit`.

    Raises:
        UsageError: if the unit is unknown or ambiguous.
    """
    return _UNITS[canonical_unit(unit)][0]


def to_si(unit: str, expected: str | None = None) -> float:
    """Return the factor that converts values in `unit` to SI.

    Args:
        unit: name of a unit, for example `deg/s`.
        expected: SI unit of the required dimension, for example `rad/s`; None accepts any.

    Raises:
        UsageError: if the unit is unknown or has another dimension than `expected`.
    """
    return _UNITS[canonical_unit(unit, expected)][1]


@lru_cache(maxsize=4096)
def canonical_unit(unit: str, expected: str | None = None) -> str:
    """Return the canonical name of a unit from any spelling.

    Args:
        unit: name or spelling of a unit.
        expected: SI unit of the required dimension; None accepts any.

    Raises:
        UsageError: if the unit is unknown, has another dimension than `expected`, or, without
            `expected`, may be one of two units that differ only in case.
    """
    if (name := find_unit(unit, expected)) is not None:
        return name
    possible_units, matches = _match_unit(unit, expected)
    units_of_dimension = [
        name for name, (unit_dimension, _) in _UNITS.items() if unit_dimension == expected
    ]
    if not possible_units:
        hint = (
            f"; did you mean '{suggestion}'?"
            if (suggestion := _suggest_unit(unit, expected))
            else ""
        )
        listed_units = (
            sorted(units_of_dimension) if expected is not None else [*sorted(_UNITS)[:24], "..."]
        )
        raise UsageError(f"unknown unit '{unit}'{hint or '; valid: ' + ', '.join(listed_units)}")
    if not matches:
        raise UsageError(
            f"unit '{unit}' does not measure [{expected}]; units that do:"
            f" {', '.join(units_of_dimension) or 'none'}"
        )
    raise UsageError(f"unit '{unit}' may be {' or '.join(matches)}; write the intended one")


@lru_cache(maxsize=4096)
def find_unit(unit: str, expected: str | None = None) -> str | None:
    """Return the canonical name of a unit as `canonical_unit` does, None where that one refuses.

    A refusal looks for a similar unit, which takes 100 times as long as the spelling itself.
    """
    _, matches = _match_unit(unit, expected)
    return matches[0] if len({_UNITS[name] for name in matches}) == 1 else None


def is_unit(text: str) -> bool:
    """Return whether a text is a spelling of exactly one unit."""
    return find_unit(text) is not None


def _match_unit(unit: str, expected: str | None) -> tuple[tuple[str, ...], list[str]]:
    """Return the units that match a spelling, and those among them of the expected dimension."""
    exact, casefolded = _units_of_spelling()
    unit_text = _normalise_unit_text(unit)
    possible_units: tuple[str, ...] = ()
    matches: list[str] = []
    for spellings, spelling in ((exact, unit_text), (casefolded, unit_text.casefold())):
        possible_units = possible_units or spellings.get(spelling, ())
        matches = matches or [
            name for name in spellings.get(spelling, ()) if expected in (None, _UNITS[name][0])
        ]
    return possible_units, matches


def _normalise_unit_text(unit: str) -> str:
    """Normalise blanks, powers and quotients of a unit."""
    unit_text = " ".join(unit.split())
    for spelling, exponent in _POWER_SPELLINGS.items():
        unit_text = unit_text.replace(spelling, exponent)
    unit_text = re.sub(r"\s*(?:/|\bper\b|\bpro\b|\bpar\b|\bpor\b|毎)\s*", "/", unit_text)
    # `m s-1`, `m.s^-1` and `min-1` are quotients
    quotient = re.fullmatch(r"(?:(.+?)[ .·*])?([^\W\d_]+)\^?-([12])", unit_text)
    if quotient is not None:
        numerator, denominator, exponent = quotient.groups()
        unit_text = f"{numerator or 1}/{denominator}" + ("^2" if exponent == "2" else "")
    return re.sub(r"(?<=[a-z])2$", "^2", unit_text)


@cache
def _units_of_spelling() -> tuple[dict[str, tuple[str, ...]], dict[str, tuple[str, ...]]]:
    """Return spelling -> units, first exact and then case-folded spellings."""
    exact: dict[str, list[str]] = {}
    for text, unit in _iterate_spellings():
        if unit not in exact.setdefault(text, []):
            exact[text].append(unit)
    casefolded: dict[str, list[str]] = {}
    for text, possible_units in exact.items():
        folded_units = casefolded.setdefault(text.casefold(), [])
        folded_units += [unit for unit in possible_units if unit not in folded_units]
    return (
        {text: tuple(possible_units) for text, possible_units in exact.items()},
        {text: tuple(possible_units) for text, possible_units in casefolded.items()},
    )


def _iterate_spellings() -> Iterator[tuple[str, str]]:
    """Yield (spelling, unit) for every spelling of every unit."""
    for unit in _UNITS:
        yield unit, unit
        for spelling in _SPELLINGS_OF_UNIT.get(unit, "").split():
            yield spelling, unit
        numerator, slash, denominator = unit.partition("/")
        if not slash:
            continue
        # the exponent is kept behind each spelling of the denominator
        denominator, caret, exponent = denominator.partition("^")
        numerators = (
            [numerator, *_SPELLINGS_OF_UNIT.get(numerator, "").split()]
            if numerator in _QUOTIENT_PARTS
            else [numerator]
        )
        numerators += _REVOLUTION_SPELLINGS.split() if numerator == "1" and not exponent else []
        for numerator_text, denominator_text in itertools.product(
            numerators, [denominator, *_SPELLINGS_OF_UNIT.get(denominator, "").split()]
        ):
            yield f"{numerator_text}/{denominator_text}{caret}{exponent}", unit


def _suggest_unit(unit: str, expected: str | None) -> str | None:
    """Return the unit of the closest spelling of a mistyped unit; None if it is not unique.

    Only swapped letters and one misspelt word are corrected: `deg/m` never becomes `deg/s`.
    """
    exact, _ = _units_of_spelling()
    unit_text = _normalise_unit_text(unit)
    allowed_spellings = [
        spelling
        for spelling, possible_units in exact.items()
        if any(expected in (None, _UNITS[name][0]) for name in possible_units)
    ]
    close_spellings = [
        spelling
        for spelling in difflib.get_close_matches(unit_text, allowed_spellings, n=6, cutoff=0.6)
        if _has_swapped_letters(spelling, unit_text) or _differs_in_one_word(spelling, unit_text)
    ]
    # swapped letters are more likely than a different word
    close_spellings = [
        spelling for spelling in close_spellings if _has_swapped_letters(spelling, unit_text)
    ] or close_spellings
    factors = {_UNITS[name][1] for spelling in close_spellings for name in exact[spelling]}
    return exact[close_spellings[0]][0] if len(factors) == 1 else None


def _has_swapped_letters(spelling: str, text: str) -> bool:
    """Return whether the parts of two quotients have the same letters in any order."""
    return [sorted(part) for part in spelling.split("/")] == [
        sorted(part) for part in text.split("/")
    ]


def _differs_in_one_word(spelling: str, text: str) -> bool:
    """Return whether exactly one part of a quotient differs, and is a similar word."""
    spelling_parts = spelling.casefold().split("/")
    text_parts = text.casefold().split("/")
    if len(spelling_parts) != len(text_parts):
        return False
    different_parts = [
        (spelling_part, text_part)
        for spelling_part, text_part in zip(spelling_parts, text_parts, strict=True)
        if spelling_part != text_part
    ]
    if len(different_parts) != 1 or min(len(part) for part in different_parts[0]) < 3:
        return False
    spelling_part, text_part = different_parts[0]
    return (
        spelling_part[0] == text_part[0]
        and difflib.SequenceMatcher(None, spelling_part, text_part).ratio() >= 0.75
    )
