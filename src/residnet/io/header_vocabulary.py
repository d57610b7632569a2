"""Recognition of channels and units by column names in many languages.

A name is first parsed into concepts (rudder, speed, wind), whose words are in
`header_vocabulary.yaml`. Rules then map combinations of concepts to channels. Therefore compounds
and different orders of words need no entries.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable
from functools import lru_cache
from importlib import resources
from typing import Any, NamedTuple

import numpy as np
import yaml

from residnet.core.names import ACCELERATION_NAMES, BOW_WIND_CHANNELS, CHANNEL_UNITS, get_si_unit
from residnet.core.units import canonical_unit, find_unit, is_unit, si_unit

_IN_BRACKETS = re.compile(r"[\[({]([^\])}]*)[\])}]")
_FULL_RUDDER_DEG = 35.0
"""Usual angle of a rudder hard over in deg."""


def _load_vocabulary() -> dict[str, Any]:
    """Return the names and words of `header_vocabulary.yaml`, which users do not edit."""
    text = resources.files("residnet.io").joinpath("header_vocabulary.yaml").read_text("utf-8")
    # libyaml reads the file ten times faster, which every start of a command line pays for
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)(text)
    vocabulary: dict[str, Any] = loader.get_single_data()
    return vocabulary


_VOCABULARY = _load_vocabulary()
_UNIT_NAMES: dict[str, str] = _VOCABULARY["unit_names"]
"""Foreign name of a unit -> unit."""
_UNIT_SUFFIXES: dict[str, dict[str, str]] = _VOCABULARY["unit_suffixes"]
"""SI unit of a quantity -> suffix behind an underscore of a name -> unit."""
MONTH_NUMBERS: dict[str, int] = {
    word: number for number, words in enumerate(_VOCABULARY["months"], 1) for word in words.split()
}
"""First three letters of a month -> its number, from 1."""
DATE_PART_NAMES = tuple(_VOCABULARY["date_parts"].split())
"""Normalised names of columns with one part of a date or of a time of day."""
VESSEL_COLUMN_NAMES = tuple(_VOCABULARY["vessel_columns"].split("|"))
"""Normalised names of columns that identify the vessel of each row, in order of precedence."""
TIME_VECTOR_NAMES = tuple(_VOCABULARY["time_vectors"].split())
"""Names of time vectors in MATLAB and HDF5 files, in order of precedence."""
ARRIVAL_COLUMN_NAMES = tuple(_VOCABULARY["arrival_columns"].split())
"""Names of the arrival time in csv files of topics, in order of precedence."""
SPLIT_NAMES: dict[str, str] = _VOCABULARY["split_names"]
"""Name of a folder or file -> split."""
GERMANIC_PATTERN = re.compile("|".join(_VOCABULARY["germanic_words"].split()))
"""German and Dutch words, in which the letter O means east."""
MANOEUVRE_PATTERNS: dict[str, re.Pattern[str]] = {
    kind: re.compile(re.sub(r"\|\s+", "|", text.strip()))
    for kind, text in _VOCABULARY["manoeuvre_names"].items()
}
"""Kind of manoeuvre -> pattern of the normalised names of its files."""
TEST_NAME_PATTERN = re.compile(re.sub(r"\|\s+", "|", _VOCABULARY["test_names"].strip()))
"""Words for a test in normalised titles, and names of columns with its number or name."""
VESSEL_TITLE_PATTERN = re.compile(re.sub(r"\|\s+", "|", _VOCABULARY["vessel_titles"].strip()))
"""Normalised title that names a vessel."""
_DRIFT_ANGLE_PATTERN = re.compile(
    re.sub(r"\|\s+", "|", _VOCABULARY["drift_angle_names"].strip()), re.IGNORECASE
)
REVOLUTION_PATTERN = re.compile("|".join(_VOCABULARY["revolution_patterns"].split()), re.IGNORECASE)
"""Words for revolutions."""


class _ConceptWords(NamedTuple):
    """Words that stand for a concept: parts of words, and complete words."""

    parts: tuple[str, ...]
    words: frozenset[str]


_CONCEPTS = {
    concept: _ConceptWords(
        tuple(entry.get("parts", "").split()), frozenset(entry.get("words", "").split())
    )
    for concept, entry in _VOCABULARY["concepts"].items()
}
_PARTS_AND_WORDS = frozenset(
    word for entry in _CONCEPTS.values() for word in (*entry.parts, *entry.words)
)
_ASCII_WORDS = frozenset(word for word in _PARTS_AND_WORDS if word.isascii())
# compounds are not made of words of one or two letters
_COMPOUND_WORDS = frozenset(word for word in _ASCII_WORDS if len(word) > 2)
_ACTUATOR_WORDS = frozenset(
    word
    for concept in ("rudder", "planes", "propeller", "engine", "revolutions", "throttle", "servo")
    for word in (*_CONCEPTS[concept].parts, *_CONCEPTS[concept].words)
)


def parse_header_unit(column: str, expected: str | None) -> str | None:
    """Return the unit in a column name, in brackets or at the end, or None.

    Args:
        column: name of the column.
        expected: SI unit of the required dimension; None accepts any dimension, in brackets only.
    """
    texts = [text.strip() for text in _IN_BRACKETS.findall(column)]
    if expected is not None:
        # also behind the dots and slashes of namespaces, as in `/thruster/state.rpm`
        name_parts = re.split(r"[\s_,;./]+", _IN_BRACKETS.sub("", column).strip())
        # `r_deg_s` and `speed_m_s` are quotients
        texts += ["/".join(name_parts[-2:]), name_parts[-1]] if len(name_parts) > 1 else []
        texts += (
            [f"{name_parts[-3]}/{name_parts[-1]}"]
            if len(name_parts) > 3 and name_parts[-2] == "per"
            else []
        )
        stem, _, suffix = column.strip().rpartition("_")
        if stem and (unit := _UNIT_SUFFIXES.get(expected, {}).get(suffix.casefold())):
            return unit
    for text in texts:
        unit = _UNIT_NAMES.get(text.casefold(), text)
        if len(unit) == 1 and unit.isalpha() and text not in _IN_BRACKETS.findall(column):
            # a single letter at the end is part of the name
            continue
        if (name := find_unit(unit, expected)) is not None:
            return name
    return None


def find_mismatched_unit(column: str, expected: str) -> str | None:
    """Return the unit in the brackets of a name if it has another dimension, else None.

    Args:
        column: name of the column.
        expected: SI unit of the required dimension.
    """
    for text in map(str.strip, _IN_BRACKETS.findall(column)):
        # (T) and (M) mark true and magnetic headings
        if is_unit(text) and not (expected == "rad" and text in ("T", "M")):
            unit = canonical_unit(text)
            if si_unit(unit) != expected:
                return unit
    return None


def guess_unit_from_size(channel: str, values: np.ndarray) -> tuple[str, str]:
    """Guess the unit of a channel from the 99 % quantile of its absolute values.

    Args:
        channel: canonical or user-defined name.
        values: values of the column [T] in all logs.

    Returns:
        The unit, and the reason as text.
    """
    magnitudes = np.abs(values[np.isfinite(values)])
    upper_quantile = float(np.quantile(magnitudes, 0.99)) if magnitudes.size else 0.0
    expected = get_si_unit(channel) or "-"
    if expected == "rad":
        threshold = 7.0 if channel in ("psi", "wind_dir") or "azimuth" in channel else 1.6
        unit = "deg" if upper_quantile > threshold else "rad"
    elif expected == "rad/s":
        # pi rad/s is a full turn in two seconds
        unit = "deg/s" if upper_quantile > np.pi else "rad/s"
    elif expected == "1/s":
        unit = "rpm" if upper_quantile > 60.0 else "1/s"
    else:
        unit = expected
    return unit, f"the header has no unit; values up to {upper_quantile:.3g} would be {unit}"


class Scaling(NamedTuple):
    """Conversion of a column to its channel.

    Attributes:
        settings: `unit`, and `offset` and `scale` if needed, of a channel map.
        reason: reason for a guess; empty if the column name contains the unit.
    """

    settings: dict[str, Any]
    reason: str


def infer_unit(channel: str, column: str, values: np.ndarray) -> Scaling:
    """Return the unit of a column from its name, otherwise from its values [T]."""
    unit = parse_header_unit(column, get_si_unit(channel))
    reason = ""
    if unit is None:
        unit, reason = guess_unit_from_size(channel, values)
    return Scaling({"unit": unit}, reason)


def guess_scaling(channel: str, column: str, values: np.ndarray) -> Scaling | None:
    """Guess the conversion of servo pulses, per cent or relative values to a channel.

    Args:
        channel: name of the channel.
        column: name of the column.
        values: values of the column [T] in all logs.

    Returns:
        The conversion; None if the column has a physical unit.
    """
    bare_channel = channel.removeprefix("cmd_")
    is_rudder = bare_channel.startswith("delta")
    # the nozzle of a waterjet in per cent; other azimuths are angles
    is_rudder |= bare_channel.startswith("azimuth") and parse_header_unit(column, "-") == "%"
    if is_rudder and parse_header_unit(column, "rad") is not None:
        return None
    unit, full_value, full_text = (
        ("deg", _FULL_RUDDER_DEG, f", {_FULL_RUDDER_DEG:g} deg") if is_rudder else ("-", 1.0, "")
    )
    if is_pulse(channel, values):
        settings = {"unit": unit, "offset": 1500, "scale": full_value / 500.0}
        reason = "servo pulses; 1500 us are assumed neutral, 500 us full scale"
        return Scaling(settings, reason + full_text)
    if not is_rudder or not (full_count := _full_scale(column, values)):
        return None
    reason = f"{full_count:g} is assumed full scale{full_text}"
    return Scaling({"unit": unit, "scale": full_value / full_count}, reason)


def _full_scale(column: str, values: np.ndarray) -> float:
    """Return the number for a rudder hard over; 0 if the column has angles."""
    header_unit = parse_header_unit(column, "-")
    if header_unit is not None:
        return 100.0 if header_unit == "%" else 1.0
    max_abs = float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
    if max_abs > 180.0:
        # counts of a lever, assumed to end at the next power of ten
        return float(10.0 ** np.ceil(np.log10(max_abs)))
    # a maximum of exactly 1 or 100 indicates a relative value, not an angle
    return next(
        (full_value for full_value in (1.0, 100.0) if 0.995 * full_value <= max_abs <= full_value),
        0.0,
    )


def is_pulse(channel: str, values: np.ndarray) -> bool:
    """Return whether values [T] are servo pulses in us; shaft speeds may have the same size."""
    finite_values = values[np.isfinite(values)]
    if not finite_values.size or re.match(r"(cmd_)?n(_|$)", channel):
        return False
    lower, upper = np.quantile(finite_values, (0.01, 0.99))
    return bool(lower >= 800.0 and upper <= 2300.0 and upper > 1200.0)


MOTION_CHANNELS = (
    "x",
    "y",
    "psi",
    "u",
    "v",
    "r",
    "p",
    "phi",
    "wind_speed",
    "wind_dir",
    *BOW_WIND_CHANNELS,
)
"""Channels of motion and wind."""
PLANE_PATTERN = re.compile(r"(cmd_)?delta_s(_|$)")
"""Start of the names of channels with dive planes, which pitch a vessel."""


class ParsedName(NamedTuple):
    """Parsed column name.

    Attributes:
        text: name in lower case without accents, units and punctuation.
        concepts: concepts that the name mentions, keys of `concepts` in the vocabulary.
        number: number in the name that distinguishes several columns; None without a number.
    """

    text: str
    concepts: frozenset[str]
    number: int | None

    def has_all(self, *names: str) -> bool:
        """Return whether the name mentions all these concepts."""
        return self.concepts.issuperset(names)

    def has_none(self, *names: str) -> bool:
        """Return whether the name mentions none of these concepts."""
        return self.concepts.isdisjoint(names)


_LETTER_MAP = str.maketrans(_VOCABULARY["letters"])


@lru_cache(maxsize=4096)
def normalize_name(name: str) -> str:
    """Return a name in lower case without accents and units, with blanks between its words."""
    text = _IN_BRACKETS.sub(" ", name)
    for sign, replacement in _VOCABULARY["greek_letters"].items():
        text = re.sub(rf"(?<![^\W_]){sign}(?![^\W_\d])", replacement, text)
    # `StB` (starboard) is one word, unlike other changes of case
    text = re.sub(r"(?<![^\W_])[A-Z][a-z][A-Z](?![^\W_])", lambda word: word[0].lower(), text)
    text = re.sub(r"([a-z])([A-Z])", r"\1 \2", text)
    text = text.translate(_LETTER_MAP)
    decomposed = unicodedata.normalize("NFKD", text)
    # the voicing marks of kana distinguish letters and are not removed
    letters = "".join(c for c in decomposed if not unicodedata.combining(c) or c in "\u3099\u309a")
    normalized = unicodedata.normalize("NFC", letters).lower()
    return " ".join(re.split(r"[\W_]+", normalized)).strip()


@lru_cache(maxsize=4096)
def parse_name(name: str) -> ParsedName:
    """Parse a column name into concepts."""
    tokens = [part for token in normalize_name(name).split() for part in _split_side(token)]
    text = " ".join(tokens)
    if "ang" in tokens and re.search(r"\bang vel", text):
        # `ang` alone abbreviates angle
        tokens = ["angular" if word == "ang" else word for word in tokens]
        text = " ".join(tokens)
    if len(tokens) > 1 and re.search(r"[\s_][VAW]$", _IN_BRACKETS.sub(" ", name).strip()):
        # a last V, A or W is the unit volt, ampere or watt
        tokens = tokens[:-1]
        text = text[:-2]
    number = next((int(token) for token in reversed(tokens) if token.isdigit()), None)
    tokens_without_digits = [re.sub(r"\d+$", "", token) for token in tokens if not token.isdigit()]
    if number is None:
        # `servo3_raw` equals `servo_raw_3`
        trailing_numbers = (re.search(r"[a-z](\d+)$", token) for token in reversed(tokens))
        number = next(
            (int(number_match.group(1)) for number_match in trailing_numbers if number_match), None
        )
    tokens_without_digits += [
        compound_part for token in tokens_without_digits for compound_part in _split_compound(token)
    ]
    concepts = {
        concept for concept in _CONCEPTS if _mentions_concept(concept, text, tokens_without_digits)
    }
    return ParsedName(text, frozenset(concepts), number)


def _split_side(token: str) -> tuple[str, ...]:
    """Split an actuator from the letter of its side, as in `deltal` or `rpmr`."""
    is_glued = (
        token[-1:] in ("l", "r") and token not in _ASCII_WORDS and token[:-1] in _ACTUATOR_WORDS
    )
    return (token[:-1], token[-1]) if is_glued else (token,)


def _split_compound(token: str) -> tuple[str, ...]:
    """Split a compound into two known words, as `ostposition`; empty for other tokens."""
    for split_position in range(3, len(token) - 2):
        first_word = token[:split_position]
        # German compounds may have an s between their words
        second_word = token[split_position:].removeprefix("s")
        is_known = any(
            second_word.startswith(vocabulary_entry)
            for vocabulary_entry in _COMPOUND_WORDS
            if len(vocabulary_entry) > 3
        )
        if first_word in _COMPOUND_WORDS and (is_known or second_word in _COMPOUND_WORDS):
            return first_word, second_word
    return ()


def _mentions_concept(concept: str, text: str, tokens: list[str]) -> bool:
    """Return whether a normalised name mentions a concept.

    Args:
        concept: key of `concepts` in the vocabulary.
        text: normalised name.
        tokens: words of the name without digits, and the parts of compounds.
    """
    entry = _CONCEPTS[concept]
    if not entry.words.isdisjoint(tokens):
        return True
    # the German "Geschwindigkeit" (speed) contains "wind"
    text = text.replace("geschwind", "") if concept == "wind" else text
    return any(
        part in text if len(part) > 3 or not part.isascii() else part in tokens
        for part in entry.parts
    )


class _ChannelRule:
    """Rule that maps a combination of concepts to a channel.

    Args:
        channel: name of the channel; None for quantities without a channel.
        required: required concepts, separated by blanks; alternatives are `rate|speed`.
        excluded: concepts that exclude the channel, separated by blanks.
        pattern: regular expression that the normalised name must contain.
    """

    def __init__(
        self, channel: str | None, required: str, excluded: str = "", pattern: str = ""
    ) -> None:
        self.channel = channel
        self._pattern = re.compile(pattern)
        self._required = [frozenset(alternatives.split("|")) for alternatives in required.split()]
        self._excluded = frozenset(excluded.split())

    def matches(self, parsed_name: ParsedName) -> bool:
        """Return whether a name has all required concepts, no excluded one and the pattern."""
        if not self._excluded.isdisjoint(parsed_name.concepts) or any(
            map(parsed_name.concepts.isdisjoint, self._required)
        ):
            return False
        return self._pattern.search(parsed_name.text) is not None


def _match_rules(rules: tuple[_ChannelRule, ...], parsed_name: ParsedName) -> str | None:
    return next((rule.channel for rule in rules if rule.matches(parsed_name)), None)


_TWIST_PATTERN = (
    r"\b(?:(?:twist|velocity) linear|linear velocity|v|vel|velo|velocity|speed|lin|linear)"
    r" ?{}(?: (?:m s|mps|ms|mm s|cm s|cms|kn|kts))?$"
)
_RATE_UNITS = "(?:dps|degps|degs|radps|rads|rps|deg s|rad s)"
"""Units of angular velocities at the end of a name."""
_AXIS_RULES = (
    _ChannelRule("u", "", "angular", _TWIST_PATTERN.format("x")),
    _ChannelRule("v", "", "angular", _TWIST_PATTERN.format("y")),
)
# concepts that exclude all channels of motion
_NON_MOTION_CONCEPTS = (
    *("command", "acceleration", "rudder", "planes", "propeller", "current", "depth", "age"),
    "heave",
)
# concepts that exclude channels of motion except the northward position N, which is also a symbol
# of shaft speed
_DRIVE_CONCEPTS = ("engine", "revolutions", "throttle", "azimuth", "servo", "thrust", "torque")
_EARTH_AXIS_CONCEPTS = "north east angular voltage"
_POSITION_SOURCES = (
    "(?:mocap|vicon|optitrack|qualisys|qtm|uwb|rtk|gps|gnss|nav|odom|ekf|utm|enu|ned|world|map|"
    "local|global)"
)
"""Names of instruments and frames before an axis of a position."""
_STATE_RULES = (
    # with a speed these words mean lateral and longitudinal
    _ChannelRule("latitude", "latitude", "sway speed"),
    _ChannelRule("longitude", "longitude", "surge speed"),
    # the sibling of a velocity along x and y is no sway, and u of one side is a control signal
    _ChannelRule(None, "", "angular", _TWIST_PATTERN.format("z")),
    _ChannelRule(None, "port|starboard", "", "^u "),
    _ChannelRule("p", "roll rate|angular"),
    _ChannelRule("phi", "roll"),
    _ChannelRule("r", "turn_rate"),
    _ChannelRule("r", "heading|turn rate"),
    _ChannelRule("r", "", "", "^r( mid)?$"),
    _ChannelRule("r", "angular", "", rf" [zr](?: {_RATE_UNITS})?$"),
    _ChannelRule("r", "", "", rf"^(?:w|omega) ?z(?: {_RATE_UNITS})?$"),
    # an angular rate without an axis is that of the heading
    _ChannelRule("r", "angular rate", "x y pitch"),
    *_AXIS_RULES,
    _ChannelRule("psi", "heading", "ground"),
    _ChannelRule("psi", "", "", "^(gyro|gyro ?compass|compass)$"),
    # x0 and y0 are earth-fixed coordinates in some notations
    *(
        _ChannelRule(axis, about, "speed angle force", text)
        for axis, direction in (("x", "north"), ("y", "east"))
        for about, text in (
            (direction, ""),
            (f"{axis} position", ""),
            # of the centre of gravity, midship or the model, as model basins write it
            (axis, r"^[xy](?: ?0)?(?: ?(?:cg|cog)| (?:ms|midship|model))?(?: m)?$"),
            (axis, rf"^{_POSITION_SOURCES} [xy](?: m)?$"),
            # symbol of a position vector, the sibling of v_x and w_x
            (axis, r"^p [xy](?: m)?$"),
        )
    ),
    _ChannelRule("v", "sway|latitude", _EARTH_AXIS_CONCEPTS),
    _ChannelRule("u", "surge|longitude", _EARTH_AXIS_CONCEPTS),
    _ChannelRule("v", "speed port|starboard", _EARTH_AXIS_CONCEPTS),
    _ChannelRule("speed", "speed", _EARTH_AXIS_CONCEPTS),
)
"""Rules for channels of motion in order of precedence."""
_VERTICAL_TWIST_PATTERN = _TWIST_PATTERN.format("z")
_DEPTH_RULES = (
    # the siblings of position_x, linear_x and angular_z
    _ChannelRule("z", "position", "x y speed", r"\bz(?: m)?$"),
    _ChannelRule("z", "", "", rf"^(?:{_POSITION_SOURCES} )?z(?: ?0)?(?: ?(?:cg|cog))?(?: m)?$"),
    _ChannelRule("w", "", "angular", _VERTICAL_TWIST_PATTERN),
    *(
        _ChannelRule(rate, "", "", rf"^(?:w|omega) ?{axis}(?: {_RATE_UNITS})?$")
        for rate, axis in (("p", "x"), ("q", "y"))
    ),
    _ChannelRule("q", "angular", "", rf" y(?: {_RATE_UNITS})?$"),
    _ChannelRule("p", "angular", "", rf" x(?: {_RATE_UNITS})?$"),
    _ChannelRule("q", "pitch rate|speed|angular", "propeller heave"),
    _ChannelRule("theta", "pitch", "propeller heave"),
    _ChannelRule("w", "heave|depth rate|speed|angular"),
    _ChannelRule("w", "heave", "", r"^heave (?:mps|ms|m s)$"),
    _ChannelRule("z", "depth", "heave"),
)


_VELOCITY_UNIT_SUFFIX = re.compile(
    r"(?<=\b[pqr]) (?:dps|degps|degs|radps|rads|rps|deg s|rad s)$|(?<=\b[uvw]) (?:mps|ms|kn|m s)$"
)
"""Unit behind the symbol of a velocity."""


@lru_cache(maxsize=4096)
def match_state_channel(parsed_name: ParsedName) -> str | None:
    """Return the channel of motion or wind for a name, or None.

    The result is `speed` for the magnitude of a velocity.
    """
    parsed = parsed_name
    normalized = parsed.text.replace(" ", "_")
    if normalized in MOTION_CHANNELS:
        return normalized
    if re.fullmatch(r"[pqr] rps", parsed.text):
        # rps is rad/s here, not revolutions per second
        return parsed.text[0] if parsed.text[0] != "q" else None
    last_word = _VELOCITY_UNIT_SUFFIX.sub("", parsed.text).rpartition(" ")[2]
    if (
        last_word in ("psi", "u", "v", "r", "phi", "p")
        and parsed.concepts <= parse_name(last_word).concepts
    ):
        # ignore a prefix as in `body.r`
        return last_word
    if parsed.has_all("machinery") and parsed.has_none("speed", "surge"):
        return None
    if parsed.has_all("wind"):
        wind_prefix = (
            "apparent_" if parsed.has_all("relative") and not parsed.has_all("true") else ""
        )
        if parsed.has_all("speed") and "dir" not in parsed.text.split():
            return f"{wind_prefix}wind_speed"
        return (
            (f"{wind_prefix}wind_angle" if wind_prefix else "wind_dir")
            if parsed.has_all("direction")
            else None
        )
    can_be_motion = parsed.has_none(*_NON_MOTION_CONCEPTS) and (
        parsed.has_none(*_DRIVE_CONCEPTS) or parsed.has_all("position", "north")
    )
    return _match_rules(_STATE_RULES, parsed) if can_be_motion else None


def match_depth_channel(parsed_name: ParsedName) -> str | None:
    """Return the channel w, q, z or theta of an underwater vessel for a name, or None."""
    bare_text = _VELOCITY_UNIT_SUFFIX.sub("", parsed_name.text)
    # a last w without a unit may be part of a quaternion
    bare_text = (
        bare_text
        if bare_text == parsed_name.text or parsed_name.concepts
        else bare_text.rpartition(" ")[2]
    )
    if bare_text in ("w", "q", "z", "theta"):
        return bare_text
    excluded_concepts = ("command", "acceleration", "age", "index", "machinery", "thrust", "engine")
    return (
        _match_rules(_DEPTH_RULES, parsed_name)
        if parsed_name.has_none(*excluded_concepts)
        else None
    )


def is_drift_angle(column: str) -> bool:
    """Return whether a column has the name of the drift angle of the hull, and no other unit."""
    is_named = _DRIFT_ANGLE_PATTERN.search(normalize_name(column)) is not None
    return is_named and find_mismatched_unit(column, "rad") is None


def match_axis_velocity(parsed_name: ParsedName) -> str | None:
    """Return u or v for a velocity along an axis x or y of an unknown frame, or None."""
    return _match_rules(_AXIS_RULES, parsed_name)


_EARTH_AXIS_VELOCITY = re.compile(
    r"(?:^|.* )(?:v|vel|velo|velocity|speed|geschwindigkeit) ?"
    r"(?:(?P<north>n|north|nord)|(?P<east>e|east|ost))(?: (?:m s|mps|ms|mm s|cm s|cms|kn|kts))?"
)
"""Normalised name of a velocity along north or east."""


def find_earth_velocities(columns: Iterable[str]) -> tuple[str, str] | None:
    """Return the first columns of the velocities along north and along east, or None."""
    matches = [(name, _EARTH_AXIS_VELOCITY.fullmatch(parse_name(name).text)) for name in columns]
    north = next((name for name, match in matches if match and match["north"]), None)
    east = next((name for name, match in matches if match and match["east"]), None)
    return None if north is None or east is None else (north, east)


_EARTH_VELOCITY_PATTERN = re.compile(r"\bvel\w* (?:n|e|d|north|east|down)\b")
"""Velocity along north, east or down, whose N is no shaft speed."""
_SIDE_LETTER_PATTERN = re.compile(r"(?<=\w) ([lr])(?= |$)")
"""Letter of the side behind the name of an actuator."""


_INPUT_RULES = (
    _ChannelRule("cmd{side}", "port|starboard", "", r"^u \w+$"),
    _ChannelRule(None, "torque"),
    _ChannelRule("{cmd_}azimuth{side}", "azimuth"),
    _ChannelRule("{cmd_}delta_s{side}", "planes"),
    _ChannelRule("{cmd_}delta_rate{side}", "rudder rate"),
    _ChannelRule("{cmd_}delta{side}", "rudder"),
    # an outboard motor steers as an azimuth thruster does
    _ChannelRule("{cmd_}azimuth{side}", "engine angle", "throttle revolutions"),
    _ChannelRule("throttle{side}", "propeller throttle|pitch", "revolutions"),
    _ChannelRule("throttle{side}", "engine throttle", "revolutions angle"),
    _ChannelRule("{cmd_}n{side}", "revolutions|propeller", "thrust"),
    _ChannelRule("{cmd_}n{side}", "engine", "thrust angle"),
    # a thruster in revolutions; a thrust has another unit
    _ChannelRule("{cmd_}n{side}", "revolutions thrust", "force"),
    _ChannelRule("{cmd_}thrust{side}", "thrust"),
    _ChannelRule("servo{side}", "servo"),
    _ChannelRule("throttle{side}", "throttle"),
)
"""Rules for channels of actuators in order of precedence."""


@lru_cache(maxsize=4096)
def match_input_channel(parsed_name: ParsedName) -> str | None:
    """Return the channel of an actuator for a name, or None."""
    parsed = parsed_name
    normalized = parsed.text.replace(" ", "_")
    if normalized in CHANNEL_UNITS and normalized not in (
        *MOTION_CHANNELS,
        "t",
        *ACCELERATION_NAMES,
    ):
        return normalized
    if not parsed.has_none("wind", "age", "index", "power", "voltage", "machinery"):
        return None
    if _EARTH_VELOCITY_PATTERN.search(parsed.text):
        return None
    if parsed.has_all("engine", "current"):
        # the electric current of a motor
        return None
    side_suffixes = {"port": "_port", "starboard": "_stbd", "bow": "_bow", "stern": "_stern"}
    side_suffixes["difference"] = "_diff"
    side_suffix = next(
        (suffix for normalized, suffix in side_suffixes.items() if parsed.has_all(normalized)), ""
    )
    if letter_match := _SIDE_LETTER_PATTERN.search(parsed.text):
        side_suffix = side_suffix or {"l": "_port", "r": "_stbd"}[letter_match[1]]
    side_suffix = side_suffix or (f"_{parsed.number}" if parsed.number is not None else "")
    if parsed.has_all("force") and (force_channel := _match_force_channel(parsed)):
        return force_channel
    channel_template = _match_rules(_INPUT_RULES, parsed)
    if channel_template is None and parsed.concepts and parsed.concepts <= _ACTUATOR_QUALIFIERS:
        return f"cmd{side_suffix}" if parsed.has_all("command") else f"n{side_suffix}"
    if parsed.has_all("planes"):
        side_suffix = side_suffix.removesuffix("_stern")
    return channel_template and channel_template.format(
        side=side_suffix, cmd_="cmd_" if parsed.has_all("command") else ""
    )


_ACTUATOR_QUALIFIERS = frozenset({"port", "starboard", "command", "measured"})


def _match_force_channel(parsed_name: ParsedName) -> str | None:
    """Return the channel of a force or moment in body axes with a qualifier, or None."""
    axis = next((axis for axis in ("x", "y", "n", "z") if axis in parsed_name.text.split()), None)
    is_moment = parsed_name.has_all("torque")
    if axis is None or not parsed_name.text.startswith("tau") or (is_moment and axis in "xy"):
        return None
    if axis == "z" and not is_moment and "force" in parsed_name.text:
        return None
    qualifier = next(
        (
            f"_{name}"
            for name in ("command", "estimate", "measured", "allocated")
            if parsed_name.has_all(name)
        ),
        "",
    )
    return f"tau_{'n' if axis == 'z' else axis}{qualifier}"
