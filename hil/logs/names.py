"""What a name of a signal says, by the words that it is made of: `Oeltemp_Zulauf_degC` is a temperature, of oil, in
degC.

A name is cut into words at blanks, brackets, underscores, capitals and digits; a German compound is cut into words of
the dictionary. Every word has one meaning. A name with a word that is not in the dictionary is not understood:
`fuel_pressure` must not pass for a pressure. Only letters that are swapped or missing in a long word are forgiven, at
the price of confidence.
"""

from __future__ import annotations

import difflib
import functools
import re
from dataclasses import dataclass, replace

from vaneloop.base.vanes import VANES

__all__ = ["CERTAIN", "Meaning", "is_time", "meaning", "spool", "unit_in_name"]

CERTAIN = 0.98  # of a name that says all that there is to say

# meaning -> words, English and German, as loggers and signal lists write them
_WORDS = {
    "speed": "speed spd drehzahl drehz rpm n nh nl nhp nlp xn spool rotorspeed rotationalspeed umdrehungen upm "
    "rev revs",
    "stroke": "stroke hub weg position pos posn x s xpos displacement lvdt kolbenweg stellweg kolbenhub ram "
    "piston kolben extension auslenkung",
    "current": "current curr strom i cur amperage amps",
    "pressure": "pressure press prs druck p",
    "temperature": "temperature temp tmp temperatur t",
    "angle": "angle ang winkel vane schaufel leitschaufel leitschaufelwinkel stellwinkel potentiometer poti rvdt phi",
    "vigv": "vigv igv eintrittsleitrad vorleitrad",
    "vgv": "vgv vsv stator stage stufe",
    "time": "time zeit timestamp timestamps zeitstempel datetime epoch uhrzeit elapsed messzeit laufzeit zeitpunkt "
    "abszeit relzeit date datum clock systime abstime reltime",
    "demand": "demand dem dmd demanded cmd command commanded kommando soll sollwert set setp setpoint setpt stp "
    "sp ref reference request requested req reqd target tgt trgt desired des vorgabe fuehrung "
    "fuehrungsgroesse w",
    "actual": "actual act ist istwert meas measured measurement mess messwert gemessen fbk fdbk feedback fb "
    "sensor sns snsr sensed val r rueckmeldung",
    "supply": "supply sup sply versorgung versorgungs system sys systems hydraulic hydraulics hydraulik hyd "
    "hydr pump pumpe pumpen vorlauf speise",
    "oil": "oil oel fluid fld fluessigkeit lube",
    "valve": "valve ventil servovalve servoventil servo sv ehsv torquemotor coil spule tm moog",
    "drive": "actuator aktuator aktor stellzylinder zylinder cylinder cyl act1 jack",
    "rotor": "rotor engine eng motordrehzahl triebwerk tw turbine gasgenerator gg core hp lp hd nd compressor "
    "verdichter welle shaft",
    "filler": "signal sig value wert of der des die das und and channel chan ch kanal raw phys cal eng1 bench rig "
    "pruefstand test data daq adc ai input output analog messung measuredvalue out logsout model root plant vw mp "
    "m degree scaled filt filtered gefiltert",
    "clock": "abs absolute relative rel since start log logger gps utc local recorder of the in and daq",
}  # fmt: skip
_CLOCK = frozenset(_WORDS.pop("clock").split())  # what only a time may be called, besides
_MEANING = {word: what for what, words in _WORDS.items() for word in words.split()} | dict.fromkeys(
    ("of", "the", "in", "and"), "filler"
)
_SHORT = {"n": "speed", "x": "stroke", "s": "stroke", "p": "pressure", "t": "temperature", "i": "current"}
_QUANTITIES = ("speed", "stroke", "current", "pressure", "temperature", "angle", "vigv", "vgv")

# how names write units: the last words of a name -> unit as pint or hil.logs.units knows it
_UNITS = {
    "s": "s", "sec": "s", "secs": "s", "seconds": "s", "second": "s", "sekunden": "s", "sek": "s", "ms": "ms",
    "msec": "ms", "millis": "ms", "milliseconds": "ms", "us": "us", "usec": "us", "micros": "us", "ns": "ns",
    "nanos": "ns", "min": "min", "minutes": "min", "minuten": "min", "h": "hour", "hours": "hour",
    "rpm": "rpm", "upm": "rpm", "u min": "rpm", "1 min": "rpm", "min 1": "rpm", "r min": "rpm", "umin": "rpm",
    "hz": "Hz", "pct": "%", "percent": "%", "perc": "%", "prozent": "%", "proz": "%",
    "mm": "mm", "um": "um", "cm": "cm", "m": "m", "in": "inch", "inch": "inch", "inches": "inch", "zoll": "inch",
    "deg": "deg", "grad": "deg", "degree": "deg", "degrees": "deg", "rad": "rad", "mrad": "mrad",
    "ma": "mA", "a": "A", "ua": "uA", "amp": "A", "amps": "A", "bar": "bar", "mbar": "mbar", "psi": "psi",
    "psig": "psi", "pa": "Pa", "kpa": "kPa", "mpa": "MPa",
    "degc": "degC", "deg c": "degC", "grad c": "degC", "celsius": "degC",
    "c": "degC", "degf": "degF", "deg f": "degF", "f": "degF", "fahrenheit": "degF", "k": "K", "kelvin": "K",
}  # fmt: skip
_OF = {
    "time": {"s", "ms", "us", "ns", "min", "hour"},
    "speed": {"rpm", "Hz", "%", "rad/s"},
    "stroke": {"mm", "um", "cm", "m", "inch"},
    "current": {"mA", "A", "uA"},
    "pressure": {"bar", "mbar", "psi", "Pa", "kPa", "MPa"},
    "temperature": {"degC", "degF", "K"},
    "angle": {"deg", "rad", "mrad"},
}
_UMLAUTS = str.maketrans(
    {"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "µ": "u", "μ": "u"}
)


# parts of a machine that are not ours, as the path before a name says them: coolant.supply_pressure
_ELSEWHERE = (
    "fuel kraftstoff coolant cooling kuehlung kuehlwasser kuehlmittel water wasser air luft brake bremse gearbox "
    "getriebe bearing lager tank battery batterie room raum ambient umgebung"
)
_CAMEL = "\x1f"  # between two words that only a capital parts


@dataclass(frozen=True)
class Meaning:
    """What a name says: the signal that it may be, in which unit, with what confidence, and why so."""

    signal: str
    unit: str
    confidence: float
    why: str


# signal -> quantity, what must be said, what may be said, whether it is the demand, confidence where nothing says that
# it is measured
_SIGNALS: dict[str, tuple[str, frozenset[str], frozenset[str], str, float]] = {
    "n_dem": ("speed", frozenset(), frozenset({"rotor"}), "demand", 0.0),
    "n_r": ("speed", frozenset(), frozenset({"rotor"}), "actual", 0.85),
    "x_dem": ("stroke", frozenset(), frozenset({"drive", "vgv"}), "demand", 0.0),
    "x_lvdt": ("stroke", frozenset(), frozenset({"drive", "vgv"}), "actual", 0.85),
    "i_cmd": ("current", frozenset({"valve"}), frozenset({"drive", "vgv"}), "demand", 0.75),
    "p_s": ("pressure", frozenset({"supply"}), frozenset({"oil"}), "either", CERTAIN),
    "t_oil": ("temperature", frozenset({"oil"}), frozenset({"supply"}), "either", CERTAIN),
}  # fmt: skip


# ---- words -----------------------------------------------------------------------------------------------------------


_PATH = re.compile(r"::|\.(?=\D)|/(?=\s*\D)")


def _plain(name: str) -> str:
    """The part of a name that says what it is: without the path of the model, the device and the port."""
    text = re.sub(r"\[\]?\{[^}]*\}|\{[^}]*\}|[\"'<>]", "", name).strip()
    text = re.sub(r":\d+$", "", text.split("\\")[0])  # INCA's device, Simulink's port
    if bracket := re.fullmatch(r"(.*?)\s*[\[(]([^\[\]()]*)[\])]\s*", text):
        inside = " ".join(re.findall(r"[a-z]+|\d+", bracket[2].casefold()))
        # a unit stands in the file's own words; (Soll) is part of the name
        text = bracket[1] if not inside or inside in _UNITS else f"{bracket[1]} {inside}"
    text = _PATH.split(text)[-1] if not re.search(r"(?i)[u1r]/min$", text) else text
    return text.translate(_UMLAUTS)


def _compound(word: str) -> list[str] | None:
    """A word made of words of the dictionary, of three letters or more: solldrehzahl, versorgungsdruck."""
    if not word:
        return []
    for n in range(len(word), 2, -1):
        if word[:n] in _MEANING:
            for rest in (word[n:], word[n + 1 :] if word[n : n + 1] in ("s", "n") and len(word) > n + 1 else None):
                if rest is not None and (tail := _compound(rest)) is not None:
                    return [word[:n], *tail]
    return None


def _parts(chunk: str) -> list[str]:
    """The words of a run of letters."""
    low = chunk.casefold()
    if low in _MEANING:
        return [low]
    camel = [p.casefold() for p in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", chunk)]
    if len(camel) > 1:
        return [w for p in camel for w in (_parts(p) if p != low else [p])]
    if whole := _compound(low):
        return whole
    if low[0] in _SHORT and _MEANING.get(low[1:]) in ("demand", "actual", "supply", "oil", "valve", "drive", "rotor"):
        return [low[0], low[1:]]
    return [low]


@functools.lru_cache(maxsize=4096)
def _words(text: str) -> tuple[str, ...]:
    return tuple(
        w for chunk in re.findall(r"[A-Za-z]+|\d+|%", text) for w in (_parts(chunk) if chunk.isalpha() else [chunk])
    )


def unit_in_name(name: str) -> tuple[tuple[str, ...], str, str]:
    """Words of a name without the unit at its end, that unit ("" without one), and the quantity it is a unit of."""
    text = _plain(name)
    text = re.sub(r"(?<=[a-z]{2})(?=[A-Z][A-Za-z])", _CAMEL, text)  # PosMm, TimeMs
    raw = re.findall(r"[A-Za-z]+|\d+|%", text)
    for count in (2, 1):
        tail = " ".join(w.casefold() for w in raw[-count:])
        unit = "%" if tail == "%" else _UNITS.get(tail, "")
        if unit and len(raw) > count:
            cut = list(re.finditer(r"[A-Za-z]+|\d+|%", text))[-count].start()
            # one letter is a unit only behind a separator, and m, a, c, f, h, k, s only where the rest is a quantity
            if len(raw[-1]) > 1 or count == 2 or text[cut - 1 : cut] in "_ -.\u00b0":
                rest = _words(text[:cut].replace(_CAMEL, ""))
                quantity = _quantity(rest)
                if quantity and unit in _OF.get("angle" if quantity in ("vigv", "vgv") else quantity, ()):
                    return rest, unit, quantity
    return _words(text.replace(_CAMEL, "")), "", ""


def _kinds(words: tuple[str, ...]) -> tuple[list[str], list[str], int, bool]:
    """Meanings of the words, those that mean nothing, how many numbers there are, whether a word was misspelt."""
    kinds, unknown, numbers, misspelt = [], [], 0, False
    for w in words:
        if w in _MEANING:
            kinds.append(_MEANING[w])
        elif w.isdigit():
            numbers += 1
        else:
            near = difflib.get_close_matches(w, _LONG, 1, 0.86) if len(w) > 5 else []
            if near:
                kinds.append(_MEANING[near[0]])
                misspelt = True
            else:
                unknown.append(w)
    return kinds, unknown, numbers, misspelt


_LONG = [w for w in _MEANING if len(w) > 5]


def _quantity(words: tuple[str, ...]) -> str:
    """The one quantity that words speak of; "" where there is none, or several."""
    kinds = _kinds(words)[0]
    # t beside oil is a temperature, alone it is the time; s and x beside another quantity are no stroke
    if words == ("t",):
        return "time"
    several = list(dict.fromkeys(k for k in kinds if k in (*_QUANTITIES, "time")))
    if len(several) == 2 and several[0] in ("vigv", "vgv") and several[1] == "angle":
        several = several[:1]
    elif len(several) == 2 and several[1] in ("vigv", "vgv") and several[0] == "angle":
        several = several[1:]
    elif set(several) == {"stroke", "vgv"}:  # the stroke of the vanes' actuator
        several = ["stroke"]
    return several[0] if len(several) == 1 else ""


# ---- meaning ---------------------------------------------------------------------------------------------------------


def is_time(name: str) -> tuple[float, str]:
    """How surely a name means the time, 0 to 1, and the unit that it says ("" where it says none)."""
    words, unit, _ = unit_in_name(name)
    kinds, _, numbers, misspelt = _kinds(words)
    if words == ("t",):
        return CERTAIN, unit
    rest = tuple(
        w for w in words if not w.isdigit() and w not in _CLOCK and _MEANING.get(w) not in ("time", "actual", "supply")
    )
    strange = set(_kinds(rest)[0]) - {"time"} or _kinds(rest)[1]  # a misspelt time is one
    if "time" not in kinds or strange:
        return 0.0, ""
    return CERTAIN - 0.1 * (numbers > 0) - 0.1 * misspelt, unit


@functools.lru_cache(maxsize=8192)
def meaning(name: str, signals: tuple[str, ...]) -> Meaning | None:
    """The signal that a name most likely means; None where it means none of ours. A confidence below 0.7 is for a
    message, not for a guess.

    The path before a name counts where the name alone says too little: supply.pressure.
    """
    last = _last(name, signals)
    path = _words(" ".join(_PATH.split(name)[:-1]).translate(_UMLAUTS))
    if last is not None and not set(_ELSEWHERE.split()).isdisjoint(path):
        return replace(last, confidence=min(last.confidence, 0.4), why=f"{last.why}, but of another part")
    if last is not None and last.confidence >= 0.7 or not path:
        return last
    whole = _last(_PATH.sub(" ", name), signals)
    return whole if whole is not None and (last is None or whole.confidence > last.confidence) else last


def _last(name: str, signals: tuple[str, ...]) -> Meaning | None:
    """What the part of a name behind its path says."""
    words, unit, _ = unit_in_name(name)
    plain = re.sub(r"[^a-z0-9]", "", _plain(name).casefold())
    for signal in signals:  # our own name in other letters, or with a unit behind it
        own = signal.replace("_", "")
        if signal != "state" and plain.startswith(own):
            behind = "" if plain == own else _UNITS.get(plain.removeprefix(own), "no unit")
            if not behind or behind in _OF[_SIGNALS[signal][0] if signal in _SIGNALS else "angle"]:
                return Meaning(signal, behind, CERTAIN, f"is called {signal}")
    quantity = _quantity(words)
    kinds, unknown, numbers, misspelt = _kinds(words)
    roles = {k for k in kinds if k in ("demand", "actual")}
    if not quantity or quantity == "time":
        return None
    more = {k for k in kinds if k not in (*_QUANTITIES, "demand", "actual", "filler")}
    if len(roles) == 2 and [w for w in words if _MEANING.get(w) == "actual"] == ["act"]:  # ACT_POS_CMD: the actuator's
        roles, more = {"demand"}, more | {"drive"}
    if quantity == "speed" and "n" in words and numbers == 1:
        numbers = 0  # N1 is a rotor
    less = 0.1 * (numbers > 0) + 0.1 * misspelt
    if quantity in ("vigv", "vgv"):
        digits = [w for w in words if w.isdigit()]
        signal = "vigv" if quantity == "vigv" else f"vgv{int(digits[0])}" if len(digits) == 1 else ""
        if signal not in VANES or signal not in signals or "demand" in roles or more - {"drive"}:
            return None
        known = not unknown and not (quantity == "vgv" and not {"vgv", "vsv"} & set(words) and "angle" not in kinds)
        return Meaning(signal, unit, (CERTAIN - 0.1 * misspelt) if known else 0.4, _why(quantity, roles, more, unknown))
    for signal, (of, must, may, role, unsaid) in _SIGNALS.items():
        if of != quantity or signal not in signals or len(roles) > 1:
            continue
        if role == "demand" and roles == {"actual"} or role == "actual" and roles == {"demand"}:
            continue
        if role == "demand" and not roles and not unsaid:
            continue
        sure = CERTAIN if roles or role == "either" else unsaid
        if signal == "x_lvdt" and "lvdt" in words:
            sure = CERTAIN
        sure -= less
        if not roles and not more and (len(words) == 1 or numbers) and len(words[0]) == 1:
            sure = 0.5  # one letter, or one letter and a number, may be anything
        if of == "stroke" and {"x", "s"} & set(words) and kinds.count("stroke") > 1 and "lvdt" not in words:
            sure = 0.5  # position_x is a coordinate
        if unknown or more - must - may:
            sure = 0.4
        elif must and not must & more:
            sure = 0.5
        return Meaning(signal, unit, round(sure, 2), _why(quantity, roles, more, unknown))
    return None


def spool(name: str) -> tuple[str, ...]:
    """Which rotor a name speaks of: its number, or words such as NH; empty where it does not say."""
    which = {"nh": "hp", "nhp": "hp", "hd": "hp", "nl": "lp", "nlp": "lp", "nd": "lp", "hp": "hp", "lp": "lp"}
    return tuple(sorted({which.get(w, w) for w in unit_in_name(name)[0] if w in which or w.isdigit()}))


def _why(quantity: str, roles: set[str], more: set[str], unknown: list[str]) -> str:
    """The words that speak for a signal, as a person would say them."""
    said = ", ".join([quantity, *sorted(more), *sorted(roles)])
    return f"its name says {said}" + (f"; {', '.join(unknown[:3])} is not known" if unknown else "")
