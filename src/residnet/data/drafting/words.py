"""What columns are called: English, German, French, Spanish, Dutch, Norwegian, Japanese and others.

A name is read for what it is about (a rudder, a speed, the wind) and then for the channel that
these make together, so that compounds and orders of words need no list of their own.
"""

from __future__ import annotations

import re
import unicodedata
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from residnet.core.errors import UsageError
from residnet.core.names import ACCELERATION, BOW_WIND, CHANNEL_UNITS, si_of
from residnet.core.units import is_unit, known_unit, si_unit

_IN_BRACKETS = re.compile(r"[\[({]([^\])}]*)[\])}]")
_FULL = 35.0
"""Angle in deg of a rudder that is hard over, as most are built."""
_GERMAN = {"grad": "deg", "grad/s": "deg/s", "grad/min": "deg/min"}
_SUFFIXES: dict[str, dict[str, str]] = {
    "m": {"m": "m"},
    "s": {"s": "s", "ms": "ms"},
    "m/s": {"ms": "m/s", "mps": "m/s"},
    "m/s^2": {"ms2": "m/s^2", "mps2": "m/s^2", "mpss": "m/s^2"},
    "rad/s": {"degps": "deg/s", "degs": "deg/s", "radps": "rad/s", "rads": "rad/s", "rps": "rad/s"},
    "rad/s^2": {"degps2": "deg/s^2", "radps2": "rad/s^2"},
    "1/s": {"rps": "1/s"},
    "N": {"n": "N"},
    "N m": {"nm": "N m"},
}
"""SI unit of a quantity -> suffix behind an underscore of a name -> unit.

The quantity decides what a suffix means: `_ms` is m/s behind a speed and milliseconds behind a
time, `_rps` is rad/s behind a yaw rate and revolutions behind a propeller.
"""


def written_unit(column: str, expected: str | None) -> str | None:
    """Return the unit that a column's name holds, in brackets or at its end; None for none.

    Args:
        expected: SI unit of the dimension; None takes any, in brackets only.
    """
    texts = [text.strip() for text in _IN_BRACKETS.findall(column)]
    if expected is not None:
        tail = re.split(r"[\s_,;]+", _IN_BRACKETS.sub("", column).strip())
        # `r_deg_s` and `speed_m_s` are quotients
        texts += ["/".join(tail[-2:]), tail[-1]] if len(tail) > 1 else []
        texts += [f"{tail[-3]}/{tail[-1]}"] if len(tail) > 3 and tail[-2] == "per" else []
        stem, _, suffix = column.strip().rpartition("_")
        if stem and (unit := _SUFFIXES.get(expected, {}).get(suffix.casefold())):
            return unit
    for text in texts:
        unit = _GERMAN.get(text.casefold(), text)
        if len(unit) == 1 and unit.isalpha() and text not in _IN_BRACKETS.findall(column):
            # a letter at the end is rather a name
            continue
        try:
            return known_unit(unit, expected)
        except UsageError:
            continue
    return None


def other_dimension(column: str, expected: str) -> str | None:
    """Return the unit in the brackets of a name where it measures something else; None for none."""
    for text in map(str.strip, _IN_BRACKETS.findall(column)):
        # (T) and (M) tell a true and a magnetic heading
        if is_unit(text) and not (expected == "rad" and text in ("T", "M")):
            unit = known_unit(text)
            if si_unit(unit) != expected:
                return unit
    return None


def unit_by_size(channel: str, values: np.ndarray) -> tuple[str, str]:
    """Return the unit of a channel by the size of its values, and why.

    Args:
        channel: canonical name, or a name of one's own.
        values: of the column [T], of all logs together.
    """
    known = np.abs(values[np.isfinite(values)])
    largest = float(np.quantile(known, 0.99)) if known.size else 0.0
    expected = si_of(channel) or "-"
    if expected == "rad":
        limit = 7.0 if channel in ("psi", "wind_dir") or "azimuth" in channel else 1.6
        unit = "deg" if largest > limit else "rad"
    elif expected == "rad/s":
        # a turn round in two seconds
        unit = "deg/s" if largest > np.pi else "rad/s"
    elif expected == "1/s":
        unit = "rpm" if largest > 60.0 else "1/s"
    else:
        unit = expected
    return unit, f"the header has no unit; values up to {largest:.3g} would be {unit}"


class Scaling(NamedTuple):
    """How the numbers of a column become the values of its channel.

    Attributes:
        settings: unit, and offset and scale where they are needed, of a channel map.
        reason: why these are guessed; empty where the column's name says them.
    """

    settings: dict[str, Any]
    reason: str


def unit_of(channel: str, column: str, values: np.ndarray) -> Scaling:
    """Return the unit of a column by its name, else by the size of its values [T]."""
    unit, reason = written_unit(column, si_of(channel)), ""
    if unit is None:
        unit, reason = unit_by_size(channel, values)
    return Scaling({"unit": unit}, reason)


def thrown(channel: str, column: str, values: np.ndarray) -> Scaling | None:
    """Return how pulses, per cent or shares become a channel; None where its unit is a plain one.

    Args:
        values: of the column [T], of all logs together.
    """
    rudder = channel.removeprefix("cmd_").startswith("delta")
    if rudder and written_unit(column, "rad") is not None:
        return None
    unit, all_the_way, told = ("deg", _FULL, f", {_FULL:g} deg") if rudder else ("-", 1.0, "")
    if is_pulse(channel, values):
        settings = {"unit": unit, "offset": 1500, "scale": all_the_way / 500.0}
        reason = "pulses of a servo; 1500 us are taken as neutral, 500 us as all the way"
        return Scaling(settings, reason + told)
    if not rudder or not (whole := _whole(column, values)):
        return None
    reason = f"{whole:g} is taken as all the way{told}"
    return Scaling({"unit": unit, "scale": all_the_way / whole}, reason)


def _whole(column: str, values: np.ndarray) -> float:
    """Return the number that stands for a rudder that is hard over; 0 where it is an angle."""
    written = written_unit(column, "-")
    if written is not None:
        return 100.0 if written == "%" else 1.0
    largest = float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
    if largest > 180.0:
        # no angle of a rudder: counts of a lever, to the power of ten above them
        return float(10.0 ** np.ceil(np.log10(largest)))
    # numbers that end at a round one are rather shares than angles
    return next((whole for whole in (1.0, 100.0) if 0.995 * whole <= largest <= whole), 0.0)


def is_pulse(channel: str, values: np.ndarray) -> bool:
    """Return whether values are pulses of a servo, in us; revolutions may be as large."""
    known = values[np.isfinite(values)]
    if not known.size or re.match(r"(cmd_)?n(_|$)", channel):
        return False
    low, high = np.quantile(known, (0.01, 0.99))
    return bool(low >= 800.0 and high <= 2300.0 and high > 1200.0)


# what a name may be about -> parts of words, and whole words behind a bar
_ABOUT: dict[str, str] = {
    "time": "zeit timestamp tiempo temps tijd tidspunkt klockslag klokkeslett horodatage 時刻 時間"
    " 日時 micros millis czas время 时间 aika 시간 시각 | t time stamp tid sec secs seconds"
    " elapsed hora heure uhrzeit datum date datetime fecha utc dato tempo ora orario zaman"
    " sure",
    "north": "north nord norte noord hochwert 北 север polnoc pohjoinen kuzey 북쪽 북방 | n"
    " northing",
    "east": "east ost oste este oost rechtswert ostwert ostkoord ostricht 東 восток 东 ostlig"
    " wschod itainen 동쪽 동방 | e easting est leste dogu",
    "position": "posit posic posisj coordin koordinat coorden coordonn 位置 posiz pozyc полож |"
    " pos local utm pose ned enu xpos ypos posx posy px py konum 위치",
    "x": "| x xpos posx px",
    "y": "| y ypos posy py",
    "latitude": "latit breitengrad breedte bredde breddegrad 緯度 纬度 широт szerokosc 위도 enlem"
    " | lat breite",
    "longitude": "longitude longitud longitudine langengrad lengte lengde 経度 经度 долгот dlugosc"
    " 경도 boylam | lon lng long laenge lange",
    "heading": "heading steuerkurs gierwinkel rumbo voorliggende heng kurswinkel 船首方位 方位"
    " 回頭角 船首角 方位角 針路 lacet guinada giringsvinkel girvinkel gierhoek kompaskoers"
    " kompasskurs курс 艏向 航向 선수각 선수방위 침로 | kompas psi yaw hdg cap koers kurs"
    " kompass compass koersen kompassi peiling hdt proa prua rotta stavriktning rumo pruva"
    " rota",
    "ground": "ground grund fond grond grunn 対地 | cog sog smg cmg",
    "course": "course | cog cmg",
    "rate": "rate taux geschwind vitesse velocidad velocita snelheid hastighet 速度 角速度 回頭率"
    " taxa скорост predkosc 속도 hizi | speed velo velocity rot",
    "turn": "turn dreh gier wende drei giring 回頭 旋回 virage girat giro guin accostat sving"
    " svang guinada 转艏 поворот donus 선회 | rot angvelo yaw lacet girhastighet",
    "turn_rate": "turnrate drehrate gierrate wenderate drehgeschwind giergeschwind wendegeschwind"
    " angvelo yawrate draaisnelheid giersnelheid svinghastighet dreiehastighet drejehastighed"
    " bochtaanwijzer girhastighet 回頭角速度 回頭率 旋回角速度 转艏角速度 선회율 선회각속도"
    " 회두각속도 | rot yawrate wz gyroz zgyro omega gz",
    "angular": "angul winkelgeschwind hoeksnelheid vinkelhastighet 角速度 углов katowa 각속도 |"
    " gyro gyr gyrz acisal",
    "speed": "speed velo 風速 geschwind vitesse velocidad velocita snelheid hastighet 速度 船速"
    " fahrt vaart 速力 скорост predkosc 속도 속력 | velo sog stw fart vel spd log tws hiz hizi"
    " surat vw aws",
    "surge": "surge langsgeschw laengsgeschw longitudinal avance avante voraus vooruit voorwaart"
    " fremover forover fremad 前後 langs avanzamento avanco 纵向 framat продольн | u forward"
    " ahead corredera",
    "sway": "sway quergeschw seitlich lateral dwars tverr sideveis sidelaens 左右 derive deriva"
    " transvers verlijering scarroccio avdrift abatimiento querdrift 横流 querab sidewards"
    " sideways 横向 sidled попереч | v vm quer trans",
    "rudder": "rudder ruder gouvernail timon roer rorv roder rorutslag 舵 safran barre руль 타각"
    " dumen | delta rudder rud ror rsa steering helm pala leme ster tiller rorkult barra pinne"
    " ruderpinne",
    "planes": "sternplane diveplane hydroplane tiefenruder hohenruder elevator dybderor djuproder"
    " hoogteroer 潜舵 横舵 升降舵 | plane planes",
    "propeller": "propel schraube helice schroef 推進 プロペラ propulseur 螺旋桨 винт srub pervane"
    " 프로펠러 | prop screw shaft welle eje arbre aksel 軸 elica cpp",
    "engine": "engine motor maschine maquina moteur hovedmaskin 主機 двигат silnik makine 엔진"
    " 모터 | main motoru fan",
    "revolutions": "drehzahl revolution umdreh tours toerental omdreining turtall varvtal regime"
    " giri 回転 revoluc 转速 оборот obrot rotac 회전수 devir devri | rpm erpm rps rev revs n",
    "thrust": "thrust schub poussee empuje stuwkracht skyv 推力 тяг spinta empuxo 추력 itki",
    "torque": "torque drehmoment couple koppel dreiemoment トルク",
    "power": "power leistung puissance potencia vermogen effekt 出力",
    "throttle": "throttle actuator gashebel gashendel gasspak gasreglage acelerador accelerateur"
    " manetta スロットル lever hebel 油门 | gas pwm gaz esc thr",
    "azimuth": "azimu schottel pod | azi nozzle alpha",
    "servo": "servo rcou",
    "force": "force kraft fuerza kracht 力 tau",
    "wind": "wind vind vent viento 風 风 ветер wiatr 풍속 풍향 ruzgar | tws twd vento vw twa aws"
    " awa",
    "true": "true wahr vrai verdadero real reel ware sann 真 | tws twd",
    "relative": "relativ apparent scheinb aparente schijnb tilsyn 相対 gemessen measured | aws awa",
    "direction": "direction direzion richtung riktning direccion richting retning angle winkel"
    " 方向 風向 | dir twd from angulo hoek vinkel twa awa",
    "angle": "angle winkel angulo hoek vinkel lage 角 | ang angolo",
    "roll": "roll roulis balanceo krenging krangung 横揺 kranken slagside 横摇 横倾 крен przechyl"
    " 횡동요 | phi heel yalpa",
    "pitch": "pitch tangage cabeceo stampf | theta trim cpp",
    "heave": "heave vertical tauch sink pilonnement arfada 升沉 上下揺 | hiv descent",
    "acceleration": "accel beschleun versnell akselerasjon 加速 | udot vdot rdot dot acc",
    "command": "command soll setpoint consigne befehl gevraagd onsket 指令 demand reference"
    " desired задан 명령 komut | cmd set ref des order ordre ordered comando",
    "port": "backbord babord babor bakboord 左舷 portside bombordo sinistra лев 좌현 iskele | port"
    " bb ps left links izquierda izquierdo gauche venstre",
    "starboard": "starboard steuerbord tribord estribor stuurboord styrbord 右舷 estibordo dritta"
    " прав 우현 sancak | stbd sb stb right rechts derecha derecho droite hoyre",
    "current": "current stromung courant corriente stroming 潮流",
    "depth": "depth tiefe profond profund diepte dybde 水深 수심 derinlik",
    "voltage": "volt spannung tension battery batterie bateria batteri | amp ampere current_a batt"
    " bat bus solar supply",
    "bow": "| bow bug proue proa boeg baug fwd fore",
    "stern": "| stern heck poupe popa hek akter aft",
    "difference": "differen | diff",
    "index": "| index idx id number nr no num count counter flag valid",
    "age": "| age alter",
    "machinery": "temperat pressure presion pression fuel kraftstoff carburant oil cool kuhl load"
    " consumption verbrauch hours stunden alarm druck | temp last water",
    "estimate": "estimat filtered hat mean | est",
    "measured": "| meas measured actual ist",
    "allocated": "alloc",
}

_WORDS = frozenset(
    word for words in _ABOUT.values() for word in words.split() if len(word) > 2 and word.isascii()
)
"""All words that compounds are made of."""
MOTION = ("x", "y", "psi", "u", "v", "r", "p", "phi", "wind_speed", "wind_dir", *BOW_WIND)
"""Channels of the motion and of the wind."""
PLANES = re.compile(r"(cmd_)?delta_s(_|$)")
"""How channels of planes begin, which turn a vessel down and not to a side."""


class Words(NamedTuple):
    """What a column's name is about.

    Attributes:
        text: the name without units and punctuation, in lower case and plain letters.
        about: what it is about.
        number: the number behind it, of several alike; None where there is none.
    """

    text: str
    about: frozenset[str]
    number: int | None

    def has(self, *names: str) -> bool:
        """Return whether the name is about all of these."""
        return self.about.issuperset(names)

    def lacks(self, *names: str) -> bool:
        """Return whether the name is about none of these."""
        return self.about.isdisjoint(names)


_LETTERS = str.maketrans({"ß": "ss", "ø": "o", "Ø": "O", "æ": "ae", "ł": "l", "ı": "i"})
_SYMBOLS = {"ψ̇": "r", "ψ": "psi", "δ": "delta", "φ": "phi", "ϕ": "phi", "θ": "theta", "τ": "tau"}
"""Greek letters that stand alone."""


@lru_cache(maxsize=4096)
def plain(name: str) -> str:
    """Return a name in lower case and plain letters, its words apart, its units left out."""
    text = _IN_BRACKETS.sub(" ", name)
    for sign, word in _SYMBOLS.items():
        text = re.sub(rf"(?<![^\W_]){sign}(?![^\W_\d])", word, text)
    # StB is one word
    text = re.sub(r"(?<![^\W_])[A-Z][a-z][A-Z](?![^\W_])", lambda word: word[0].lower(), text)
    text = re.sub(r"([a-z])([A-Z])", r"\1 \2", text)
    text = text.translate(_LETTERS)
    decomposed = unicodedata.normalize("NFKD", text)
    # voicing marks of kana are letters, not accents
    letters = "".join(c for c in decomposed if not unicodedata.combining(c) or c in "\u3099\u309a")
    joined = unicodedata.normalize("NFC", letters).lower()
    return " ".join(re.split(r"[\W_]+", joined)).strip()


@lru_cache(maxsize=4096)
def words_of(name: str) -> Words:
    """Return what a column's name is about."""
    tokens = [part for token in plain(name).split() for part in _sided(token)]
    text = " ".join(tokens)
    if len(tokens) > 1 and re.search(r"[\s_][VAW]$", _IN_BRACKETS.sub(" ", name).strip()):
        # volts, amperes and watts are no names of channels
        tokens, text = tokens[:-1], text[:-2]
    number = next((int(token) for token in reversed(tokens) if token.isdigit()), None)
    bare = [re.sub(r"\d+$", "", token) for token in tokens if not token.isdigit()]
    if number is None:
        # `servo3_raw` counts as `servo_raw_3` does
        tails = (re.search(r"[a-z](\d+)$", token) for token in reversed(tokens))
        number = next((int(tail.group(1)) for tail in tails if tail), None)
    bare += [piece for token in bare for piece in _pieces(token)]
    about = {thing for thing in _ABOUT if _fits(thing, text, bare)}
    return Words(text, frozenset(about), number)


_KNOWN = frozenset(
    word for words in _ABOUT.values() for word in words.replace("|", " ").split() if word.isascii()
)
_DRIVING = frozenset(
    word
    for thing in ("rudder", "planes", "propeller", "engine", "revolutions", "throttle", "servo")
    for word in _ABOUT[thing].replace("|", " ").split()
)


def _sided(token: str) -> tuple[str, ...]:
    """Return an actuator and its side, of `deltal` or `rpmr`; other tokens as they are."""
    glued = token[-1:] in ("l", "r") and token not in _KNOWN and token[:-1] in _DRIVING
    return (token[:-1], token[-1]) if glued else (token,)


def _pieces(token: str) -> tuple[str, ...]:
    """Return the two words that a compound is made of, `ost` and `position`; none for others."""
    for cut in range(3, len(token) - 2):
        first, second = token[:cut], token[cut:].removeprefix("s")
        known = any(second.startswith(word) for word in _WORDS if len(word) > 3)
        if first in _WORDS and (known or second in _WORDS):
            return first, second
    return ()


def _fits(thing: str, text: str, tokens: list[str]) -> bool:
    parts, _, whole = _ABOUT[thing].partition("|")
    if set(whole.split()) & set(tokens):
        return True
    # the German word for speed holds the wind
    text = text.replace("geschwind", "") if thing == "wind" else text
    return any(
        part in text if len(part) > 3 or not part.isascii() else part in tokens
        for part in parts.split()
    )


class _Rule:
    """A channel, and what a name is about that stands for it.

    Args:
        channel: its name; None where it is none.
        about: things, of each of which one must be among them (`rate|speed`).
        but: things that must not be.
        text: pattern that the name must hold.
    """

    def __init__(self, channel: str | None, about: str, but: str = "", text: str = "") -> None:
        self.channel, self._text = channel, re.compile(text)
        self._about = [frozenset(things.split("|")) for things in about.split()]
        self._but = frozenset(but.split())

    def fits(self, w: Words) -> bool:
        """Return whether a name stands for the channel."""
        if not self._but.isdisjoint(w.about) or any(map(w.about.isdisjoint, self._about)):
            return False
        return self._text.search(w.text) is not None


def _first(rules: tuple[_Rule, ...], words: Words) -> str | None:
    return next((rule.channel for rule in rules if rule.fits(words)), None)


_TWIST = (
    r"\b(?:(?:twist|velocity) linear|linear velocity|v|vel|velo|velocity|speed|lin|linear)"
    r" ?{}(?: (?:m s|mps|ms))?$"
)
_AXES = (_Rule("u", "", "", _TWIST.format("x")), _Rule("v", "", "", _TWIST.format("y")))
# what no channel of the motion is about, and what none is but a position along north, whose N
# may be one of revolutions
_NO_MOTION = (
    *("command", "acceleration", "rudder", "planes", "propeller", "current", "depth", "age"),
    "heave",
)
_POWERED = ("engine", "revolutions", "throttle", "azimuth", "servo", "thrust", "torque")
_ALONG = "north east angular voltage"
_STATES = (
    _Rule("latitude", "latitude"),
    _Rule("longitude", "longitude", "surge speed"),
    _Rule("p", "roll rate|angular"),
    _Rule("phi", "roll"),
    _Rule("r", "turn_rate"),
    _Rule("r", "heading|turn rate"),
    _Rule("r", "", "", "^r( mid)?$"),
    _Rule("r", "angular", "", r" [zr](?: (?:dps|degps|radps|rps|deg s|rad s))?$"),
    # of an axis that is not told: what turns is the vessel
    _Rule("r", "angular rate", "x y pitch"),
    *_AXES,
    _Rule("psi", "heading", "ground"),
    _Rule("psi", "", "", "^(gyro|gyro ?compass|compass)$"),
    # some write 0 for what is fixed to the earth
    *(
        _Rule(axis, about, "speed angle force", text)
        for axis, way in (("x", "north"), ("y", "east"))
        for about, text in ((way, ""), (f"{axis} position", ""), (axis, r"^[xy](?: ?0)?(?: m)?$"))
    ),
    _Rule("v", "sway", _ALONG),
    _Rule("u", "surge|longitude", _ALONG),
    _Rule("v", "speed port|starboard", _ALONG),
    _Rule("speed", "speed", _ALONG),
)
"""In the order in which they are asked."""
_DEEP = (
    _Rule("q", "pitch rate|speed|angular", "propeller heave"),
    _Rule("theta", "pitch", "propeller heave"),
    _Rule("w", "heave|depth rate|speed|angular"),
    _Rule("z", "depth", "heave"),
)


_UNIT = re.compile(
    r"(?<=\b[pqr]) (?:dps|degps|degs|radps|rads|rps|deg s|rad s)$|(?<=\b[uvw]) (?:mps|ms|kn|m s)$"
)
"""What stands behind the letter of a velocity."""


@lru_cache(maxsize=4096)
def state_channel(words: Words) -> str | None:
    """Return the channel of the motion or of the wind that a name stands for; None for none.

    It is `speed` where only the size of a velocity is meant.
    """
    w, name = words, words.text.replace(" ", "_")
    if name in MOTION:
        return name
    if re.fullmatch(r"[pqr] rps", w.text):
        # rad/s of a rate, not revolutions
        return w.text[0] if w.text[0] != "q" else None
    last = _UNIT.sub("", w.text).rpartition(" ")[2]
    if last in ("psi", "u", "v", "r", "phi", "p") and w.about <= words_of(last).about:
        # what stands before it, as in `body.r`, says nothing
        return last
    if w.has("machinery") and w.lacks("speed", "surge"):
        return None
    if w.has("wind"):
        felt = "apparent_" if w.has("relative") and not w.has("true") else ""
        if w.has("speed") and "dir" not in w.text.split():
            return f"{felt}wind_speed"
        return (f"{felt}wind_angle" if felt else "wind_dir") if w.has("direction") else None
    moves = w.lacks(*_NO_MOTION) and (w.lacks(*_POWERED) or w.has("position", "north"))
    return _first(_STATES, w) if moves else None


def deep_channel(words: Words) -> str | None:
    """Return w, q, z or theta of a vessel under water that a name stands for; None for others."""
    bare = _UNIT.sub("", words.text)
    # a last w without a unit may be a quaternion's
    bare = bare if bare == words.text or words.about else bare.rpartition(" ")[2]
    if bare in ("w", "q", "z", "theta"):
        return bare
    none = ("command", "acceleration", "age", "index", "machinery", "thrust", "engine")
    return _first(_DEEP, words) if words.lacks(*none) else None


def axis_velocity(words: Words) -> str | None:
    """Return u or v of a velocity along an axis x or y, of whatever frame; None for others."""
    return _first(_AXES, words)


_GROUND = re.compile(r"\bvel\w* (?:n|e|d|north|east|down)\b")
"""A velocity along north, east or down: its N is no propeller."""
_LETTER = re.compile(r"(?<=\w) ([lr])(?= |$)")
"""The side behind the name of an actuator."""


_INPUTS = (
    _Rule(None, "torque"),
    _Rule("{cmd_}azimuth{side}", "azimuth"),
    _Rule("{cmd_}delta_s{side}", "planes"),
    _Rule("{cmd_}delta_rate{side}", "rudder rate"),
    _Rule("{cmd_}delta{side}", "rudder"),
    _Rule("throttle{side}", "propeller throttle|pitch", "revolutions"),
    _Rule("throttle{side}", "engine throttle", "revolutions angle"),
    _Rule("{cmd_}n{side}", "revolutions|propeller", "thrust"),
    _Rule("{cmd_}n{side}", "engine", "thrust angle"),
    _Rule("{cmd_}thrust{side}", "thrust"),
    _Rule("servo{side}", "servo"),
    _Rule("throttle{side}", "throttle"),
)
"""In the order in which they are asked."""


@lru_cache(maxsize=4096)
def input_channel(words: Words) -> str | None:
    """Return the channel of an actuator that a name stands for; None where it names none."""
    w, name = words, words.text.replace(" ", "_")
    if name in CHANNEL_UNITS and name not in (*MOTION, "t", *ACCELERATION):
        return name
    if not w.lacks("wind", "age", "index", "power", "voltage", "machinery"):
        return None
    if _GROUND.search(w.text):
        return None
    sides = {"port": "_port", "starboard": "_stbd", "bow": "_bow", "stern": "_stern"}
    sides["difference"] = "_diff"
    side = next((end for name, end in sides.items() if w.has(name)), "")
    if lettered := _LETTER.search(w.text):
        side = side or {"l": "_port", "r": "_stbd"}[lettered[1]]
    side = side or (f"_{w.number}" if w.number is not None else "")
    if w.has("force") and (forced := _force(w)):
        return forced
    found = _first(_INPUTS, w)
    if found is None and w.about and w.about <= _ACTUATED:
        return f"cmd{side}" if w.has("command") else f"n{side}"
    if w.has("planes"):
        side = side.removesuffix("_stern")
    return found and found.format(side=side, cmd_="cmd_" if w.has("command") else "")


_ACTUATED = frozenset({"port", "starboard", "command", "measured"})


def _force(w: Words) -> str | None:
    """Return the name of a force or moment in body axes, with what tells it from others alike."""
    axis = next((axis for axis in ("x", "y", "n", "z") if axis in w.text.split()), None)
    moment = w.has("torque")
    if axis is None or not w.text.startswith("tau") or (moment and axis in "xy"):
        return None
    if axis == "z" and not moment and "force" in w.text:
        return None
    kind = next(
        (f"_{name}" for name in ("command", "estimate", "measured", "allocated") if w.has(name)), ""
    )
    return f"tau_{'n' if axis == 'z' else axis}{kind}"
