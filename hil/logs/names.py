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
import itertools
import re
from dataclasses import dataclass, replace

from vaneloop.base.signals import SIDES
from vaneloop.base.vanes import VANES

__all__ = [
    "CERTAIN", "LONGEST_NAME", "Meaning", "bracketed", "is_time", "lacks", "meaning", "spool", "unit_behind",
    "unit_in_name", "unit_kind",
]  # fmt: skip

CERTAIN = 0.98  # of a name that says all that there is to say
LONGEST_NAME = 1_000  # letters; no logger writes more, and what is longer means nothing here

# meaning -> words, English and German, as loggers and signal lists write them
_WORDS = {
    "speed": "speed spd drehzahl drehz rpm n nh nl nhp nlp xn spool rotorspeed rotationalspeed umdrehungen upm "
    "rev revs nr xnh xnl ng ngg",
    "stroke": "stroke hub weg position pos posn x s xpos displacement lvdt kolbenweg stellweg kolbenhub ram "
    "piston kolben extension auslenkung stellung",
    "current": "current curr strom i cur amperage amps stellstrom steuerstrom",
    "pressure": "pressure press prs druck p",
    "temperature": "temperature temp tmp temperatur t",
    "angle": "angle ang winkel stellwinkel potentiometer poti rvdt phi",
    "vigv": "vigv igv eintrittsleitrad vorleitrad vlr eintrittsleitschaufel vorleitschaufel inletguidevane",
    "vgv": "vgv vsv variablestatorvane",
    "vane": "vane vanes guidevane statorvane schaufel leitschaufel leitrad verstellleitschaufel verstellleitrad",
    "stage": "stator stage stufe stg",
    "time": "time zeit timestamp timestamps zeitstempel datetime epoch uhrzeit elapsed messzeit laufzeit zeitpunkt "
    "abszeit relzeit date datum clock systime abstime reltime",
    "demand": "demand dem dmd demanded cmd command commanded kommando soll sollwert set setp setpoint setpt stp "
    "cmnd sp ref reference request requested req reqd target tgt trgt desired des vorgabe fuehrung "
    "fuehrungsgroesse w",
    "actual": "actual act ist istwert meas measured measurement mess messwert gemessen fbk fdbk feedback fb "
    "sensor sns snsr sensed sense sel selected voted transducer geber val r rueckmeldung",
    "supply": "supply sup sply versorgung versorgungs system sys systems hydraulic hydraulics hydraulik hyd "
    "hydr pump pumpe pumpen vorlauf speise",
    "oil": "oil oel fluid fld fluessigkeit lube",
    "valve": "valve ventil servovalve servoventil servo sv ehsv torquemotor coil spule tm moog",
    "drive": "actuator aktuator aktor stellzylinder zylinder cylinder cyl act1 jack stellglied stellantrieb",
    "rotor": "rotor engine eng motordrehzahl triebwerk tw turbine gasgenerator gg core hp lp hd nd compressor "
    "verdichter welle shaft gasgenerator hochdruckwelle niederdruckwelle",
    "filler": "signal sig value wert of der des die das und and channel chan ch kanal raw phys cal eng1 bench rig "
    "pruefstand test data daq adc ai input output analog messung measuredvalue out logsout model root plant vw mp "
    "m degree scaled filt filtered gefiltert ecu eec fadec",
    "clock": "abs absolute relative rel since start log logger gps utc local recorder of the in and daq",
}  # fmt: skip
_CLOCK = frozenset(_WORDS.pop("clock").split())  # what only a time may be called, besides
_MEANING = {word: what for what, words in _WORDS.items() for word in words.split()} | dict.fromkeys(
    ("of", "the", "in", "and"), "filler"
)
_LONGEST_WORD = max(map(len, _MEANING))
_ACRONYMS = ("hp", "lp", "nh", "nl", "nr", "ng", "sv", "tm")  # that names write before a word without a gap: NHist
_PLACE = {"position", "pos", "posn", "stellung"}  # of a stroke, or of a vane
_VANES = ("vigv", "vgv", "vane", "stage")
_SHORT = {"n": "speed", "x": "stroke", "s": "stroke", "p": "pressure", "t": "temperature", "i": "current"}
_QUANTITIES = ("speed", "stroke", "current", "pressure", "temperature", "angle", *_VANES)

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


def _bracket(name: str) -> tuple[str, str] | None:
    """A name that ends in a bracket: what stands before it, and what in it; None for another."""
    text = name.rstrip()
    at = max(text.rfind("["), text.rfind("("))
    if at < 0 or text[-1] not in "])" or any(c in "])" for c in text[at:-1]):
        return None
    return text[:at].rstrip(), text[at + 1 : -1]


def _plain(name: str) -> str:
    """The part of a name that says what it is: without the path of the model, the device and the port."""
    text = re.sub(r"\[\]?\{[^{}]*\}|\{[^{}]*\}|[\"'<>]", "", name).strip()
    text = re.sub(r":\d+$", "", text.split("\\")[0])  # INCA's device, Simulink's port
    if bracket := _bracket(text):
        before, inside = bracket[0], " ".join(re.findall(r"[a-z]+|\d+", bracket[1].casefold()))
        # a unit stands in the file's own words; (Soll) is part of the name
        text = before if not inside or inside in _UNITS else f"{before} {inside}"
    text = _PATH.split(text)[-1] if not re.search(r"(?i)[u1r]/min$", text) else text
    return text.translate(_UMLAUTS)


def _compound(word: str) -> list[str] | None:
    """A word made of words of the dictionary, of three letters or more: solldrehzahl, versorgungsdruck, nhist.

    From its end on, each place where such words can begin gets the longest first word after which the rest is made of
    words, too; an s or n may join two.
    """
    end = len(word)
    steps = {end: (0, end)}  # place -> letters of the word that begins there, place of the next
    for at in range(end - 2, -1, -1):
        for n in range(min(end - at, _LONGEST_WORD), 1, -1):
            after = at + n
            if word[at:after] not in (_MEANING if n > 2 else _ACRONYMS):
                continue
            joined = after + 1 if word[after : after + 1] in ("s", "n") and end > after + 1 else after
            following = next((k for k in (after, joined) if k in steps), None)
            if following is not None:
                steps[at] = n, following
                break
    if 0 not in steps:
        return None
    words, at = [], 0
    while at < end:
        n, following = steps[at]
        words.append(word[at : at + n])
        at = following
    return words


def _parts(chunk: str) -> list[str]:
    """The words of a run of letters."""
    low = chunk.casefold()
    if low in _MEANING:
        return [low]
    if low[-1] == "s" and _MEANING.get(low[:-1]) in _VANES:  # VSVs, VSVS1
        return [low[:-1]]
    camel = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", chunk)
    if len(camel) > 1:
        cuts = [camel, re.findall(r"[A-Z]{2,}|[A-Z]?[a-z]+", chunk)]  # NHist: N, Hist or NH, ist
        read = [[w for p in cut for w in _parts(p if p.isupper() else p.casefold())] for cut in cuts if len(cut) > 1]
        return next((words for words in read if _MEANING.keys() >= set(words)), read[0])
    if whole := _compound(low):
        return whole
    if low[0] in _SHORT and _MEANING.get(low[1:]) in ("demand", "actual", "supply", "oil", "valve", "drive", "rotor"):
        return [low[0], low[1:]]
    return [low]


@functools.lru_cache(maxsize=4096)
def _words(text: str) -> tuple[str, ...]:
    words = [
        w for chunk in re.findall(r"[A-Za-z]+|\d+|%", text) for w in (_parts(chunk) if chunk.isalpha() else [chunk])
    ]
    for count in (3, 2):  # words that are written apart: set point, inlet guide vane
        for k in range(len(words) - count, -1, -1):
            if (joined := "".join(words[k : k + count])) in _MEANING and not _MEANING.keys() >= {*words[k : k + count]}:
                words[k : k + count] = [joined]
    vanes = any(_MEANING.get(w) in _VANES for w in words)
    return tuple(
        "stage" if vanes and w in ("s", "st") and after.isdigit() else w  # VSV_S1
        for w, after in itertools.zip_longest(words, words[1:], fillvalue="")
    )


@functools.lru_cache(maxsize=256)
def unit_kind(unit: str) -> str:
    """The quantity that a unit is of, as files and users write it; "" where it tells nothing, as % does."""
    text = unit.strip().removeprefix("-")
    known = _UNITS.get(" ".join(re.findall(r"[a-z]+|\d+", text.casefold().translate(_UMLAUTS))), text)
    for kind, units in _OF.items():
        if known in units:
            return "" if known == "%" else kind
    return "angle" if text == "\u00b0" else "temperature" if "\u00b0" in text else ""


def bracketed(name: str) -> str:
    """The unit in the bracket at a name's end; "" without one."""
    inside = (_bracket(name) or ("", ""))[1]
    return inside.strip() if unit_kind(inside) or inside.strip() == "%" else ""


def unit_behind(name: str) -> tuple[str, str]:
    """A name of anything, and the unit behind it, in a bracket or of two letters and more; "" where there is none."""
    if len(name) > LONGEST_NAME:
        return name, ""
    if (bracket := _bracket(name)) and (unit := bracketed(name)):
        return bracket[0], unit
    text = re.sub(r"(?<=[a-z]{2})(?=[A-Z][A-Za-z])", _CAMEL, _plain(name))
    for count in (2, 1):
        parts = list(re.finditer(r"[A-Za-z]+|\d+|%", text))
        if len(parts) > count:
            tail = " ".join(p[0].casefold() for p in parts[-count:])
            if len(tail) > 1 and tail in _UNITS:
                return text[: parts[-count].start()].replace(_CAMEL, "").rstrip("_ -."), _UNITS[tail]
    return name, ""


def unit_in_name(name: str, said: str = "") -> tuple[tuple[str, ...], str, str]:
    """Words of a name without the unit at its end, that unit ("" without one), and the quantity it is a unit of.

    said  the unit that the log states for it: with words that name no quantity it says which is meant
    """
    if len(name) > LONGEST_NAME:
        return (), "", ""
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
                quantity = _quantity(rest, unit_kind(unit) if len(raw[-1]) > 1 or count == 2 else "")
                if quantity and unit in _OF.get("angle" if quantity in ("vigv", "vgv") else quantity, ()):
                    return rest, unit, quantity
    words = _words(text.replace(_CAMEL, ""))
    return words, "", _quantity(words, unit_kind(said or bracketed(name)))


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


def _quantity(words: tuple[str, ...], unit: str = "") -> str:
    """The one quantity that words and the ``unit`` beside them (its kind) speak of; "" where there is none, or several.

    Words that name no quantity have that of the unit: an actuator's setpoint in mm is a stroke.
    """
    kinds = _kinds(words)[0]
    # t beside oil is a temperature, alone it is the time; s and x beside another quantity are no stroke
    if words == ("t",):
        return "time"
    several = {k for k in kinds if k in (*_QUANTITIES, "time")}
    vane = "vigv" if "vigv" in several else "vgv" if several & set(_VANES) else ""
    several -= set(_VANES)
    place = {w for w in words if _MEANING.get(w) == "stroke"} <= _PLACE
    if not several:  # the unit says it, beside what has it; ActCmd_mm is the actuator's command
        moved = vane == "vgv" and {"actual", "demand"} & set(kinds) or "act" in words and "demand" in kinds
        for of, says in (("stroke", "drive"), ("current", "valve"), ("pressure", "supply"), ("temperature", "oil")):
            if unit == of and (says in kinds or (of == "stroke" and moved)):
                return of
    if vane and (several <= {"angle"} or (several <= {"angle", "stroke"} and unit == "angle" and place)):
        return vane
    # the stroke of the vanes' actuator, the current of its valve
    return several.pop() if len(several) == 1 and (not vane or several & {"stroke", "current"}) else ""


# ---- meaning ---------------------------------------------------------------------------------------------------------


def is_time(name: str) -> tuple[float, str]:
    """How surely a name means the time, 0 to 1, and the unit that it says ("" where it says none)."""
    if name.strip().casefold() == "x_value":  # of LabVIEW
        return 0.9, ""
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
def meaning(name: str, signals: tuple[str, ...], unit: str = "") -> Meaning | None:
    """The signal that a name most likely means; None where it means none of ours. A confidence below 0.7 is for a
    message, not for a guess. ``unit`` is the one that the log states for the name.

    The path before a name counts where the name alone says too little: supply.pressure.
    """
    if len(name) > LONGEST_NAME:
        return None
    last = _last(name, signals, unit)
    path = _words(" ".join(_PATH.split(name)[:-1]).translate(_UMLAUTS))
    if last is not None and not set(_ELSEWHERE.split()).isdisjoint(path):
        return replace(last, confidence=min(last.confidence, 0.4), why=f"{last.why}, but of another part")
    if last is not None and last.confidence >= 0.7 or not path:
        return last
    whole = _last(_PATH.sub(" ", name), signals, unit)
    return whole if whole is not None and (last is None or whole.confidence > last.confidence) else last


def _quantity_of(signal: str) -> str:
    """The quantity of one of our signals."""
    if signal in _SIGNALS:
        return _SIGNALS[signal][0]
    return "stroke" if signal in SIDES else "angle"


def _last(name: str, signals: tuple[str, ...], said: str) -> Meaning | None:
    """What the part of a name behind its path says, in the unit that the log states."""
    words, unit, quantity = unit_in_name(name, said)
    kind = unit_kind(unit or said or bracketed(name))
    plain = re.sub(r"[^a-z0-9]", "", _plain(name).casefold())
    for signal in signals:  # our own name in other letters, or with a unit behind it
        own = signal.replace("_", "")
        if signal != "state" and plain.startswith(own):
            behind = "" if plain == own else _UNITS.get(plain.removeprefix(own), "no unit")
            if not behind or behind in _OF[_quantity_of(signal)]:
                sure = 0.5 if words == ("nr",) and not behind and not kind else CERTAIN  # Nr counts rows in German
                return Meaning(signal, behind, sure, f"is called {signal}")
    kinds, unknown, numbers, misspelt = _kinds(words)
    roles = {k for k in kinds if k in ("demand", "actual")}
    if not quantity or quantity == "time":
        return None
    more = {k for k in kinds if k not in (*_QUANTITIES, "demand", "actual", "filler")}
    numbers += unknown == ["a"] or unknown == ["b"]  # the two channels of a sensor
    unknown = [] if unknown in (["a"], ["b"]) and words[-1] == unknown[0] else unknown
    if len(roles) == 2 and [w for w in words if _MEANING.get(w) == "actual"] == ["act"]:  # ACT_POS_CMD: the actuator's
        roles, more = {"demand"}, more | {"drive"}
    if quantity == "speed" and "n" in words and numbers == 1:
        numbers = 0  # N1 is a rotor
    less = 0.1 * (numbers > 0) + 0.1 * misspelt
    if quantity in ("vigv", "vgv"):
        digits = [w for w in words if w.isdigit()]
        signal = (
            VANES[int(digits[0])] if len(digits) == 1 and len(digits[0]) < 3 and int(digits[0]) < len(VANES) else ""
        )
        signal = "vigv" if quantity == "vigv" else signal
        if signal not in signals or "demand" in roles or more - {"drive"}:
            return None
        sure = CERTAIN if signal == quantity or "vgv" in kinds and signal != "vigv" else CERTAIN - 0.1  # Vane 1, VSV0
        sure -= 0.1 * misspelt
        known = not unknown and ({"vigv", "vgv", "vane", "angle"} & set(kinds) or kind == "angle")
        why = _why("vane" if signal != quantity and quantity == "vgv" else quantity, roles, more, unknown)
        return Meaning(signal, unit, round(sure, 2) if known else 0.4, why)
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
        place = {w for w in words if _MEANING.get(w) == "stroke"} <= _PLACE
        if of == "stroke" and place and not kind and not more and set(_VANES) & set(kinds):
            return Meaning(signal, unit, 0.5, "a stroke or an angle: no unit says which")
        if of == "stroke" and {"x", "s"} & set(words) and kinds.count("stroke") > 1 and "lvdt" not in words:
            sure = 0.5  # position_x is a coordinate
        if unknown or more - must - may:
            sure = 0.4
        elif must and not must & more:
            sure = 0.5
        return Meaning(signal, unit, round(sure, 2), _why(quantity, roles, more, unknown))
    return None


def lacks(name: str, unit: str = "") -> str:
    """What keeps a name from being a signal of the model, in a few words; ``unit`` as the log states it."""
    words, _, quantity = unit_in_name(name, unit)
    kinds, unknown, numbers, _ = _kinds(words)
    ours = set(kinds) - {"filler", "demand", "actual", "time"}
    vanes = bool(ours & set(_VANES))
    if not ours or unknown or ours <= {"rotor"}:
        which = f": {', '.join(map(repr, unknown[:3]))} is not known" if ours and unknown else ""
        return f"no signal of the model has such a name{which}"
    if quantity in ("vigv", "vgv") and "demand" in kinds:
        return "a stroke or an angle: no unit says which" if not numbers and "angle" not in kinds else (
            "the model has no demand of a vane's angle"
        )  # fmt: skip
    if quantity == "vgv" and not numbers:
        return "it does not say of which vane row"
    if not quantity:
        several = [q for q in dict.fromkeys(kinds) if q in _QUANTITIES]
        return (
            f"it says {' and '.join(several)}"
            if len(several) > 1 and not vanes
            else "it does not say what is measured; a unit would"
        )
    said = ", ".join(dict.fromkeys(k for k in kinds if k != "filler"))
    return f"the model has no such signal: {said}"


def spool(name: str) -> tuple[str, ...]:
    """Which rotor a name speaks of: its number, or words such as NH; empty where it does not say."""
    which = {"nh": "hp", "nhp": "hp", "hd": "hp", "nl": "lp", "nlp": "lp", "nd": "lp", "hp": "hp", "lp": "lp"}
    return tuple(sorted({which.get(w, w) for w in unit_in_name(name)[0] if w in which or w.isdigit()}))


def _why(quantity: str, roles: set[str], more: set[str], unknown: list[str]) -> str:
    """The words that speak for a signal, as a person would say them."""
    said = ", ".join([quantity, *sorted(more), *sorted(roles)])
    return f"its name says {said}" + (f"; {', '.join(unknown[:3])} is not known" if unknown else "")
