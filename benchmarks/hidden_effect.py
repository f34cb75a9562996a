"""``python -m benchmarks.hidden_effect``: the blind benchmark. The rig (``tests/rig``), an independent simulator with
other equations, hides an effect, the diagnosis sees the log only, and every answer is counted.
"""

from __future__ import annotations

import argparse
import json
import secrets
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import start
from benchmarks.blind import (
    INSIDE,
    KINDS,
    add_learn_options,
    add_run_options,
    as_curve,
    check_run,
    detected,
    print_shares,
    read_rows,
    run,
    share,
)
from benchmarks.loggers import draw, recorded
from benchmarks.same_curve import as_a_curve
from hil.logs import Channel, read_log, write_log
from hil.loop.lockstep import warm_up
from plant import Model, build_plant
from plant.effects import EFFECTS
from tests import rig
from tests.firmware_on_rig import firmware
from tests.rig.left_out import LEFT_OUT
from vaneloop.base import terminal
from vaneloop.base.durations import named_lag, within_no_period
from vaneloop.base.errors import InputError
from vaneloop.base.vanes import VANES
from vaneloop.identification.settings import LIKELY
from vaneloop.identification.vane_chain.chain import build_chain
from vaneloop.identification.vane_chain.experiment import recommend
from vaneloop.identification.vane_chain.parameters import SHAPES
from vaneloop.identification.workflow import diagnose, diagnosis_json
from vaneloop.verbs.learn import learned
from vaneloop.verbs.search import Diagnosed, not_given

__all__ = ["DESCRIPTION", "add_options", "command", "draw_case", "judge_case", "summary"]

DESCRIPTION = """Blind benchmark of the diagnosis: logs with fresh seeds are drawn (25 % clean, 25 % with an effect that
the library does not have, 20 % with two effects, the rest with one, from undetectable to gross), written, and diagnosed
knowing only the log. Every machine's links are drawn within their tolerance; a fifth of the logs lacks rows, in a fifth
the controller is for some seconds in another mode.

examples:
  python -m benchmarks.hidden_effect --logs 40 --out out/blind.parquet
  python -m benchmarks.hidden_effect --logs 200 --seed 12345 --out out/blind.parquet  (continues where it was stopped)
  python -m benchmarks.hidden_effect --logs 60 --kinds outside clean --learn --out out/learned.parquet
  python -m benchmarks.hidden_effect --logs 40 --leave-out --out out/left_out.parquet
  python -m benchmarks.hidden_effect --logs 40 --loggers --out out/loggers.parquet
  python -m benchmarks.hidden_effect --logs 40 --begins --kinds single pair --out out/begins.parquet
  python -m benchmarks.hidden_effect --plant tables/plant_electromechanical.toml --out out/motor.parquet

exit codes: 0 done, 2 bad input. The figures are for reading; no threshold decides."""

SHARES = (0.25, 0.25, 0.20, 0.30)
GAPS = 0.2  # of the logs lack rows
MODES = 0.2  # of the logs have seconds in another mode
MACHINES = {"hydraulic": "plant.toml", "electromechanical": "plant_electromechanical.toml"}  # that the rig has
LEAVE_OUT = "left out"  # a kind of its own
IN_CONTROLLER = ("trend_threshold_error",)  # the rig's controller has it from the start or not at all
ONSET_NEAR = 2.0  # s, by which an onset may be off


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--logs", type=int, default=40, metavar="N", help="number of logs (default 40)")
    parser.add_argument("--seed", type=int, metavar="S", help="seed of the draw (default: fresh, and printed)")
    parser.add_argument("--duration", type=float, default=300.0, metavar="S", help="length of each log (default 300 s)")
    parser.add_argument("--rate", type=int, default=100, choices=(10, 100, 1000), help="rows a second (default 100)")
    parser.add_argument(
        "--loggers",
        action="store_true",
        help="every log is taken by an ordinary recorder of its own: rate, filter, clocks, last digit, hum, stale rows",
    )
    parser.add_argument(
        "--begins",
        action="store_true",
        help="what is hidden begins within the log, at a time drawn from its middle: is that found, too?",
    )
    parser.add_argument(
        "--experiments",
        action="store_true",
        help="where rivals remain, run the recommended experiment too, and see whether it decides",
    )
    parser.add_argument(
        "--plant",
        metavar="F.toml",
        default=MACHINES["hydraulic"],
        help="plant's table of the machine, one of the two that the rig has: plant.toml (default) or "
        "plant_electromechanical.toml",
    )
    add_learn_options(parser, "effects")
    add_run_options(parser, "logs", "log", "out/hidden_effect.parquet")


def draw_case(
    seed: int, index: int, duration: float = 300.0, machine: str = "hydraulic", kinds: Sequence[str] = KINDS,
    leave_out: bool = False, begins: bool = False,
) -> dict[str, Any]:  # fmt: skip
    """Draw what is hidden in log ``index`` of the series ``seed``: kind, effects, links, gaps and modes, nothing
    simulated yet.

    machine  of `MACHINES`: what can be hidden in it
    kinds    of `KINDS`, that are drawn
    leave_out  hide effects that can be left out of the library instead
    begins     what is hidden acts from a time on that is drawn, too
    """
    motor = machine == "electromechanical"
    library = [e for e in (rig.WITH_MOTOR if motor else rig.EFFECTS) if not (begins and e in IN_CONTROLLER)]
    outside = [k for k, e in rig.OUTSIDE.items() if not motor or e.stage != "actuator" or e.site == "lvdt"]
    rng = np.random.default_rng([seed, index])
    shares = np.array([share if kind in kinds else 0.0 for kind, share in zip(KINDS, SHARES, strict=True)])
    kind = str(rng.choice(KINDS, p=shares / shares.sum()))
    hidden = []
    if leave_out:
        names = [name for name in LEFT_OUT if name in library]
        kind, hidden = LEAVE_OUT, [rig.draw(str(rng.choice(names)), int(rng.integers(1, 5)), rng)]
    elif kind == "single":
        hidden = [rig.draw(str(rng.choice(library)), int(rng.integers(0, 5)), rng)]
    elif kind == "outside":
        hidden = [rig.draw(str(rng.choice(outside)), int(rng.integers(1, 5)), rng)]
    elif kind == "pair":
        two = rng.choice(library, size=2, replace=False)
        hidden = [rig.draw(str(name), int(rng.integers(2, 5)), rng) for name in two]
    machine_seed = int(rng.integers(1, 2**31))
    geometry = rig.load_geometry(rng=rng)
    longest = min(10.0, duration / 10.0)
    gaps, modes = [], []
    if rng.random() < GAPS:
        gaps = [
            (float(rng.uniform(0.05, 0.9) * duration), float(rng.uniform(1.0, longest)))
            for _ in range(rng.integers(1, 4))
        ]
    if rng.random() < MODES:
        kind_of = str(rng.choice(["standby", "deaf"]))
        modes = [
            rig.Spell(
                kind_of, round(float(rng.uniform(0.2, 0.8) * duration), 2), round(float(rng.uniform(1.0, longest)), 2)
            )
        ]
    if begins:
        onset = round(float(rng.uniform(0.3, 0.7) * duration), 2)
        hidden = [replace(h, onset=onset) for h in hidden]
    return {
        "index": index, "kind": kind, "hidden": hidden, "machine_seed": machine_seed, "geometry": geometry,
        "gaps": gaps, "modes": modes,
    }  # fmt: skip


def _intervals(hidden: list[Any], answer: dict[str, Any]) -> list[dict[str, Any]]:
    """True size of every hidden effect that was named, in border units, beside its interval (where both know the
    parameter).
    """
    out = []
    for h in hidden:
        named = next((e for e in answer["effects"] if e["effect"] == h.name), None)
        if named is None:
            continue
        sizes = dict(h.parameters)
        which = int(sizes["stage"]) if "stage" in sizes else -1
        key = VANES[which] if which >= 0 else rig.CATALOGUE[h.name].main
        declared = next((p for p in EFFECTS[h.name].parameters if p.name == key), None)
        if declared is not None:
            truth = sizes[rig.CATALOGUE[h.name].main] / declared.si
            out.append({"effect": h.name, "parameter": key, "truth": truth, **named["parameters"][key]})
    return out


def _learned(chain: Any, d: Any, name: str, hidden: Any = None) -> dict[str, Any]:
    """What `learn` answers on the diagnosed log: each law with its rivals, formulas and errors.

    hidden  an effect that was left out: is a law it (`benchmarks.same_curve`)?
    """
    started = time.process_time()
    answer = learned(chain, name, Model(), 1, None, Diagnosed(chain, d, name))
    spent = time.process_time() - started
    names = LEFT_OUT[hidden.name].names(hidden) if hidden else []
    laws: list[dict[str, Any]] = [
        {"names": [law.name, *law.rivals], "formulas": [f.text for f in law.formulas], "before": law.error_before,
         "after": law.error_after, "found": any(n in names for n in (law.name, *law.rivals))}
        for law in answer.laws
    ]  # fmt: skip
    for law, row in zip(answer.laws, laws, strict=True) if hidden else ():
        curve = as_a_curve(chain, law, hidden.name, _sizes(hidden), law.name == names[0])
        if curve is not None:
            forms = LEFT_OUT[hidden.name].forms_of(law.name, hidden)
            row |= {"found": True, **as_curve(law, partial(np.interp, xp=law.x, fp=curve), forms)}
    return {"verdict": answer.verdict, "laws": laws, "notes": answer.notes, "why": answer.outcome.why,
            "nearest": answer.outcome.nearest, "steps": dict(answer.steps), "processor_s": spent}  # fmt: skip


def _named_where(effect: str, d: Any) -> set[str]:
    """Effects that a diagnosis names, with their rivals, in stages where ``effect`` shows."""
    shown = [s for s in d.stages if s.stage in EFFECTS[effect].stages]
    return {name for s in shown for f in s.effects for name in (f.effect, *f.rivals)}


def _sizes(hidden: Any) -> dict[str, float]:
    """The sizes of what is hidden by the library's names, in its units; of one vane stage, by that stage."""
    main, which = rig.CATALOGUE[hidden.name].main, int(hidden.parameters.get("stage", -1))
    sizes = {VANES[which] if which >= 0 and k == main else k: v for k, v in hidden.parameters.items() if k != "stage"}
    return {k: v / EFFECTS[hidden.name][k].si for k, v in sizes.items()}


def learned_right(row: dict[str, Any]) -> bool:
    """Whether a curve that was learned, or a rival of it, is at the place of what is hidden and of its quantity; or an
    effect of the library is named that has its law, and its cause is said; or, of a reading that lost its low bits, no
    law, but the step.
    """
    said = json.loads(row["learned"])
    names = {within_no_period(n) for law in said["laws"] for n in law["names"]}
    truth = row["truth"][0]
    late = [lag for n in names if (lag := named_lag(n)) and lag[0] in LAGS_OF.get(truth, ())]
    (sizes,) = json.loads(row["sizes"])
    return (
        bool(names & CURVES_OF[truth])
        or any(1.0 / LAG_TOLD <= tau / sizes["time"] <= LAG_TOLD for _, tau in late)
        or (said["verdict"] == "named" and _told(row))
        or (truth in STEPS_OF and not said["laws"] and _step_told(said.get("steps", {}), truth, sizes))
    )


def _step_told(steps: Mapping[str, float], truth: str, sizes: Mapping[str, float]) -> bool:
    """Whether the one channel that is said to come in steps is the one that does, in steps as large."""
    channel, per_si = STEPS_OF[truth]
    return set(steps) == {channel} and abs(steps[channel] / (per_si * sizes["step"]) - 1.0) <= STEP_TOLD


def learned_summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Count what was learned, of rows where that was asked."""
    asked = [r for r in rows if json.loads(r.get("learned") or "{}")]
    if not asked:
        return {}
    outside = [r for r in asked if r["kind"] == "outside" and r["detectable"][0]]
    plain = [r for r in outside if CURVES_OF[r["truth"][0]] or r["truth"][0] in (*LAGS_OF, *STEPS_OF)]
    right = [r for r in outside if learned_right(r)]
    errors = [laws[-1]["after"] for r in right if (laws := json.loads(r["learned"])["laws"])]
    spent = sorted(json.loads(r["learned"])["processor_s"] for r in asked if json.loads(r["learned"])["laws"])
    clean = [not json.loads(r["learned"])["laws"] for r in asked if r["kind"] == "clean"]
    answers = [json.loads(r["learned"]) for r in asked if r["kind"] == LEAVE_OUT and r["detectable"][0]]
    gone = [said["laws"] for said in answers]
    return {
        "learned: left out of the library, right place and quantity": share(
            [any(law["found"] for law in laws) for laws in gone]
        ),
        "learned: left out, and no other effect of the library does as well": share(
            [any(law["found"] for law in said["laws"]) for said in answers if not said["also"]]
        ),
        "learned: left out, the curve is the law within its band": share(
            [any(law.get("inside", 0.0) >= INSIDE for law in laws) for laws in gone]
        ),
        "learned: left out, the right formula among those given": share(
            [any(law.get("formula") for law in laws) for laws in gone]
        ),
        "learned: outside the library, right place and quantity": share([r in right for r in outside]),
        "learned: of those that are a curve at all": share([r in right for r in plain]),
        "learned: of these, held-out error within 1.5 noise floors": share([e <= 1.5 for e in errors]),
        "learned: nothing hidden, nothing learned": share(clean),
        "learned: longest processor seconds beyond the diagnosis": spent[-1] if spent else None,
    }


def _experiment(d: Any, chain: Any, case: dict[str, Any], test: Any, stages_of: Any) -> dict[str, Any] | None:
    """What the recommended experiment, run on the same machine, says of the rivals; None where there are none."""
    e = recommend(d, chain=chain)
    if e is None:
        return None
    out = {"profile": e["profile"], "nats": e["score"], "separable": e["separates"], "resolved": False}
    if e["separates"]:
        n = len(e["n_dem"])
        supply = {
            k: np.pad(v, (0, max(0, n - len(v))), mode="reflect")[:n]
            for k, v in (("p_s", test.p_s), ("t_oil", test.t_oil))
        }
        again = stages_of(case["hidden"], replace(test, n_dem=e["n_dem"], **supply))
        said = diagnosis_json(diagnose(again.stages, again.not_observed, workers=1), "")
        found = {x["effect"]: x["rivals"] for x in said["effects"]}
        # what both logs allow: the candidates for each effect of the first log that are candidates in the second
        second = _all_named(said)
        left = [{f.effect, *f.rivals} & second for s in d.stages for f in s.effects if f.rivals]
        hidden = {h.name for h in case["hidden"]}
        out |= {"resolved": all(len(c) == 1 and c <= hidden for c in left), "named": found}
    return out


def judge_case(
    seed: int, index: int, duration: float, rate: int, experiments: bool = False, machine: str = "hydraulic",
    learn: bool = False, kinds: Sequence[str] = KINDS, leave_out: bool = False, loggers: bool = False,
    begins: bool = False,
) -> dict[str, Any]:  # fmt: skip
    """Simulate, write, diagnose and score one log of a ``machine`` of `MACHINES`; a flat record."""
    case = draw_case(seed, index, duration, machine, kinds, leave_out, begins)
    plant, motor = build_plant(MACHINES[machine]), machine == "electromechanical"
    test = rig.manoeuvre(case["machine_seed"], duration)
    logger = draw(np.random.default_rng([seed, index, 1])) if loggers else None

    def stages_of(hidden: list[Any], test: Any = test) -> Any:
        run = rig.simulate(
            test, firmware(), hidden, seed=case["machine_seed"], rate=1000 if logger else rate,
            geometry=case["geometry"],
            gaps=() if logger else case["gaps"],
            spells=case["modes"],
            motor=motor,
        )  # fmt: skip
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "log.parquet"
            without = ("t", "p_s") if motor else ("t",)  # there is no oil
            log = {k: v for k, v in run.log.items() if k not in without}
            channels = (
                recorded(log, logger, np.random.default_rng([seed, index, 2]), case["gaps"])
                if logger
                else {k: Channel(run.log["t"], v) for k, v in log.items()}
            )
            write_log(path, channels)
            return build_chain(read_log(path, require=()), plant)

    chain = stages_of(case["hidden"])
    gone: set[str] = {h.name for h in case["hidden"]} if leave_out else set()
    chain = not_given(chain, sorted(gone))
    started, used = time.perf_counter(), time.process_time()
    d = diagnose(chain.stages, chain.not_observed, workers=1)
    elapsed, used = time.perf_counter() - started, time.process_time() - used
    answer = diagnosis_json(d, f"case {index}")
    said = _learned(chain, d, f"case {index}") if learn else {}
    if leave_out:
        (h,) = case["hidden"]
        said = _learned(chain, d, f"case {index}", h)
        # another effect says the same in this log: it is left out, too, also where another stage is open
        while not said["laws"] and (same := _named_where(h.name, d)):
            gone |= same
            chain = not_given(chain, sorted(gone))
            d = diagnose(chain.stages, chain.not_observed, workers=1)
            said = _learned(chain, d, f"case {index}", h)
        said["also"] = sorted(gone - {h.name})
    truth = [h.name for h in case["hidden"]]
    detectable = []
    if truth:
        clean = stages_of([])
        for h in case["hidden"]:
            detectable.append(detected(chain if len(truth) == 1 else stages_of([h]), clean))
    named = [e["effect"] for e in answer["effects"]]
    rivals = {e["effect"]: e["rivals"] for e in answer["effects"]}
    tried = (
        _experiment(d, chain, case, test, stages_of)
        if experiments and any(h in _all_named(answer) for h in truth)
        else None
    )
    ratios = [s["error_after"] / s["noise_floor"] for s in answer["stages"] if s["verdict"] == "missing"]
    return {
        "seed": seed, "index": index, "machine": machine, "kind": case["kind"], "truth": truth,
        "sizes": json.dumps([dict(h.parameters) for h in case["hidden"]]),
        "geometry": json.dumps(asdict(case["geometry"])),
        "gaps": json.dumps(case["gaps"]), "modes": json.dumps([asdict(s) for s in case["modes"]]),
        "logger": json.dumps(asdict(logger) if logger else None),
        "onset": case["hidden"][0].onset if begins and case["hidden"] else None,
        "detectable": detectable, "verdict": answer["verdict"], "named": named, "rivals": json.dumps(rivals),
        "probabilities": [e["probability"] for e in answer["effects"]],
        "unknown_stages": [u["stage"] for u in answer["unknown"]], "shapes": [u["shape"] for u in answer["unknown"]],
        "after_over_floor": max(ratios) if ratios else None, "elapsed_s": elapsed,
        "processor_s": used,
        "learned": json.dumps(terminal.plain(said)),
        "answer": json.dumps(terminal.plain(answer)),
        "intervals": json.dumps(terminal.plain(_intervals(case["hidden"], answer))),
        "experiment": json.dumps(terminal.plain(tried)),
    }  # fmt: skip


def _too_easy(effect: dict[str, Any]) -> bool:
    """Whether an effect was named improbable and without rival, or with a size on a bound that is not its neutral
    value.
    """
    if effect["probability"] < LIKELY and not effect["rivals"]:
        return True
    if effect["effect"] not in EFFECTS:
        return False
    kind = next(k for k in MACHINES if k in EFFECTS[effect["effect"]].kinds)
    for p in build_plant(MACHINES[kind]).parameters_of(effect["effect"]).values():
        value = effect["parameters"].get(p.name, {}).get("value", p.neutral)
        near = 1e-6 * (p.high - p.low)
        if (
            not p.period
            and p.name not in SHAPES
            and abs(value - p.neutral) > near
            and (value <= p.low + near or value >= p.high - near)
        ):
            return True
    return False


# what is outside the library and has the law of effects in it, under another cause
OTHER_CAUSE = {
    "play_temperature": ({"linkage_wear"}, "oil temperature"),
    "piston_cushion": ({"valve_flow_saturation"}, "a drag that grows with the square of the speed"),
    "pot_cross_talk": ({"pot_gain", "pot_bias"}, "a share of another vane row's reading"),
}


def _of(places: str, quantities: str) -> set[str]:
    return {
        f"{place}.{'gain' if place in TIMES else 'curve'}_of_{q}"
        for place in places.split()
        for q in quantities.split()
    }


# what is outside the library and a function of one quantity at one place: the curves that say so. Of two quantities
# that go together in every log of the rig, such as the angles of its stages and its stroke, either is right; so is
# either place where two are one in the logged signals: a valve's curve and a drag are both a speed of the current.
TIMES = ("actuator.flow_gain", "engine.lag", "engine.acceleration", "servo.current")
STROKE = "x_lvdt vigv vgv1 vgv2"
SPEED = "i_cmd speed_of_x_lvdt"
CURVES_OF: dict[str, set[str]] = {
    "play_temperature": _of("linkage.play linkage.vigv_play linkage.vgv1_play linkage.vgv2_play", "t_oil"),
    "area_growth": _of("actuator.flow_gain", "x_lvdt"),
    "supply_dips": _of("actuator.flow_gain", "time"),
    "pot_cross_talk": _of("sensors.vigv", STROKE),
    "pot_track_wear": _of("sensors.vigv", STROKE),
    "piston_cushion": _of("actuator.load valve.current valve.opening actuator.flow_gain", SPEED),
    "speed_dependent_lag": _of("engine.lag", "n_r n_dem"),
    "ring_snag": _of("linkage.vigv_ring sensors.vigv", STROKE),
    "return_spring": _of("actuator.load", STROKE),
    "null_over_temperature": _of("valve.current", "t_oil"),
    "null_over_pressure": _of("valve.current", "p_s"),
    "schedule_bent": _of("controller.demand", "n_r"),
    "servo_gain_warm": _of("servo.current", "t_oil"),
    "lvdt_over_pressure": _of("sensors.lvdt", "p_s"),
    "acceleration_by_speed": _of("engine.acceleration", "n_r n_dem"),
    "lvdt_ripple": _of("sensors.lvdt", "time"),
    "driver_oscillation": _of("valve.current", "time"),
    "crank_bushing": _of("linkage.crank linkage.ring", "stops_of_x_lvdt"),
}
# what is one of a quantity behind a lag, whose time the rig knows: each ring is late by a share of ring - y, where
# y' = (ring - y) / time, which is that share times the time of the ring's speed behind the lag. All rings turn with the
# crank. Of the stroke behind the lag, instead of its speed, the share of the ring itself is left to the links' lengths.
LAGS_OF = {"ring_creep": _of("linkage.crank linkage.ring", "x_lvdt speed_of_x_lvdt")}
LAG_TOLD = 1.25  # times the true time, or its inverse
# what is stairs of a reading itself: its channel, and border units of it in one of the rig's. The law is their step.
STEPS_OF = {"lvdt_lost_bits": ("x_lvdt", 1e3)}
STEP_TOLD = 0.05  # of the true step
# what is no smooth function of one quantity at one place: shaking, resonance, a spool that sticks, stairs
NO_CURVE = (
    "vane_vibration", "valve_silting", "ring_creep", "linkage_resonance", "stall_rumble", "lvdt_lost_bits",
)  # fmt: skip
CURVES_OF |= {name: set() for name in NO_CURVE}


def _told(row: dict[str, Any]) -> bool:
    """Whether the answer names only what has the true law, and says that it cannot tell the true cause from it."""
    effects, (law, cause) = json.loads(row["answer"])["effects"], OTHER_CAUSE.get(row["truth"][0], (set(), ""))
    return {e["effect"] for e in effects} == law and any(cause in e["inseparable"] for e in effects)


def _all_named(answer: dict[str, Any]) -> set[str]:
    return {name for e in answer["effects"] for name in (e["effect"], *e["rivals"])}


def _hit(effect: str, row: dict[str, Any]) -> bool:
    rivals = json.loads(row["rivals"])
    return any(effect == n or effect in rivals[n] for n in row["named"])


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Count: shares with 90 % binomial (Wilson) intervals, and every miss."""
    single = [r for r in rows if r["kind"] == "single" and r["detectable"][0]]
    alone = [
        r
        for r in single
        if r["verdict"] == "missing" and len(r["named"]) == 1 and not json.loads(r["rivals"])[r["named"][0]]
    ]
    pairs = [r for r in rows if r["kind"] == "pair" and all(r["detectable"])]
    outside = [r for r in rows if r["kind"] == "outside"]
    intervals = [i for r in rows for i in json.loads(r["intervals"])]
    used = sorted(t for r in rows if (t := r.get("processor_s")) is not None)  # older files have none
    tried = [e for r in rows if (e := json.loads(r["experiment"]))]
    found = [r for r in single if _hit(r["truth"][0], r) and r["after_over_floor"] is not None]
    return {
        "logs": len(rows),
        "detectable single named or among rivals": share([_hit(r["truth"][0], r) for r in single]),
        "single named verdict right": share([r["named"][0] == r["truth"][0] for r in alone]),
        "single named verdict given": share([r in alone for r in single]),
        "clean logs with a false alarm": share([r["verdict"] != "none" for r in rows if r["kind"] == "clean"]),
        "clean logs with an effect named": share([bool(r["named"]) for r in rows if r["kind"] == "clean"]),
        "both effects of a detectable pair": share([all(_hit(e, r) for e in r["truth"]) for r in pairs]),
        "outside the library: unknown, or none where undetectable": share(
            [("unknown" in (r["verdict"], *(["unknown"] if r["unknown_stages"] else [])) and not r["named"])
             or (r["verdict"] == "none" and not r["detectable"][0]) or _told(r) for r in outside]
        ),
        "error after within 1.1 noise floors": share([r["after_over_floor"] <= 1.1 for r in found]),
        "90 % interval covers the truth": share([i["low"] <= i["truth"] <= i["high"] for i in intervals]),
        "parameter within 5 % of the truth": share(
            [abs(i["value"] - i["truth"]) <= 0.05 * abs(i["truth"]) for i in intervals]
        ),
        f"onset within {ONSET_NEAR:g} s": share(
            [abs(e.get("onset_s", {"value": 0.0})["value"] - r["onset"]) <= ONSET_NEAR
             for r in rows if r.get("onset") is not None for e in json.loads(r["answer"])["effects"]
             if any(m in r["truth"] for m in (e["effect"], *e["rivals"]))]
        ),
        "separable ties decided by the experiment": share([e["resolved"] for e in tried if e["separable"]]),
        "effects named with P < 0.5 and no rival, or on a bound": share(
            [_too_easy(e) for r in rows for e in json.loads(r["answer"])["effects"]]
        ),
        "median seconds": sorted(r["elapsed_s"] for r in rows)[len(rows) // 2] if rows else None,
        "median processor seconds": used[len(used) // 2] if used else None,
        "longest processor seconds": used[-1] if used else None,
        **learned_summary(rows),
    }  # fmt: skip


def reliability(rows: list[dict[str, Any]]) -> list[list[str]]:
    """How often effects named with a probability were hidden indeed: stated (mean), count, share right, 90 %
    interval.
    """
    said = [(p, n in r["truth"]) for r in rows for n, p in zip(r["named"], r["probabilities"], strict=True)]
    out = []
    for low, high in ((0.0, 0.4), (0.4, 0.6), (0.6, 0.9), (0.9, 1.01)):
        inside = [(p, right) for p, right in said if low <= p < high]
        if inside:
            right = share([right for _, right in inside])
            stated = sum(p for p, _ in inside) / right["of"]
            out.append(
                [
                    f"{low:g} to {min(high, 1.0):g}",
                    f"{stated:.2f}",
                    f"{right['hits']} of {right['of']}",
                    f"{right['share']:.2f}",
                    f"{right['low']:.2f} to {right['high']:.2f}",
                ]
            )
    return out


def confusion(rows: list[dict[str, Any]]) -> list[list[str]]:
    """What was said of each hidden thing: a row a truth and an answer, with its count (answers: the names, none,
    unknown).
    """
    count: Counter[tuple[str, str]] = Counter()
    for r in rows:
        answers = r["named"] or [r["verdict"]]
        for truth in r["truth"] or ["(clean)"]:
            hit = truth if truth in answers else f"{answers[0]} (rival)" if _hit(truth, r) else " + ".join(answers)
            count[truth, hit] += 1
    return [[truth, said, str(n)] for (truth, said), n in sorted(count.items())]


def misses(rows: list[dict[str, Any]]) -> list[str]:
    """Every answer that is not what it should be, a line each."""
    out = []
    for r in rows:
        what = (
            f"#{r['index']} {r['kind']}: hidden {', '.join(r['truth']) or 'nothing'} {r['sizes']}, detectable "
            f"{r['detectable']}"
        )
        said = f"said {r['verdict']} {r['named']} rivals {r['rivals']} unknown {r['unknown_stages']}"
        wrong = (
            (r["kind"] == "clean" and r["verdict"] != "none")
            or (
                r["kind"] in ("single", "pair")
                and any(d and not _hit(e, r) for e, d in zip(r["truth"], r["detectable"], strict=True))
            )
            or any(_too_easy(e) for e in json.loads(r["answer"])["effects"])
            or (
                r["kind"] == "outside"
                and not _told(r)
                and (r["named"] or (r["verdict"] == "none" and r["detectable"][0]))
            )
        )
        if wrong:
            out.append(f"{what}; {said}")
    return out


def _machine(table: str) -> str:
    """Which of `MACHINES` a plant's table describes; InputError for one that the rig does not have."""
    plant = build_plant(table)
    if not np.array_equal(plant.p, build_plant(MACHINES[plant.kind]).p):
        raise InputError(
            f"--plant {table}: its numbers are not those of {MACHINES[plant.kind]}; the rig has the machines of "
            f"{' and '.join(MACHINES.values())} only"
        )
    return plant.kind


def command(args: argparse.Namespace) -> int:
    """Run from parsed options; return the exit code."""
    check_run(args, "logs")
    if not 30.0 <= args.duration <= 1e5:
        raise InputError(f"--duration (={args.duration:g} s) must be in [30, 1e5]")
    machine, path = _machine(args.plant), Path(args.out)
    rows = read_rows(path, "hidden_effect") if path.exists() else []
    seed = args.seed if args.seed is not None else (rows[0]["seed"] if rows else secrets.randbelow(2**31))
    if rows and "gaps" not in rows[0]:
        raise InputError(f"{path}: written by an older version, with one geometry for all; give another --out")
    rows = [r for r in rows if r["seed"] == seed and r.get("machine", "hydraulic") == machine]
    terminal.say(args, f"seed {seed}; {len(rows)} logs done before")
    path.parent.mkdir(parents=True, exist_ok=True)
    warm_up(lambda text: terminal.say(args, text))
    if args.learn and any(json.loads(r.get("learned") or "{}") == {} for r in rows):
        raise InputError(f"{path}: has rows without --learn; allowed: no --learn, or another --out")
    if rows and args.leave_out != any(r["kind"] == LEAVE_OUT for r in rows):
        raise InputError(
            f"{path}: has rows {'without' if args.leave_out else 'of'} --leave-out; allowed: another --out"
        )
    run(
        args, "logs", args.logs, rows, path, judge_case, seed, args.duration, args.rate, args.experiments, machine,
        args.learn, tuple(k for k in KINDS if k in args.kinds), args.leave_out, args.loggers, args.begins,
    )  # fmt: skip
    s = summary(rows)
    spent = f"{s['median seconds']:.1f} s a diagnosis"
    if s["median processor seconds"] is not None:
        spent += (
            f", {s['median processor seconds']:.1f} s of processor time, at most {s['longest processor seconds']:.1f}"
        )
    print_shares(args, f"{len(rows)} logs, {spent}", s)
    terminal.print_table(args, "what was hidden, what was said", ["hidden", "said", "logs"], confusion(rows))
    terminal.print_table(
        args, "are the probabilities right?", ["stated", "mean", "right", "share", "90 % interval"], reliability(rows)
    )
    for line in misses(rows):
        terminal.say(args, "miss " + line)
    terminal.write_json(
        args,
        {
            "schema": 1,
            "seed": seed,
            "summary": s,
            "confusion": confusion(rows),
            "reliability": reliability(rows),
            "misses": misses(rows),
        },
    )
    return 0


if __name__ == "__main__":
    start.run("benchmarks.hidden_effect")
