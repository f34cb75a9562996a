"""The C header of a controller of the user's own, written from the declarations that the firmware here works on.

``python -m controller.header`` prints it; ``controller/native/vaneloop_controller.h`` is what it printed last, and a
test holds the two together.
"""

from __future__ import annotations

from pathlib import Path

from controller.records import (
    FAULTS,
    INPUT_FIELDS,
    MODES,
    OBSERVABLE_FIELDS,
    OUTPUT_FIELDS,
    SCALAR_FIELDS,
    STRATEGIES,
    Field,
)
from vaneloop.base.vanes import VANES

__all__ = ["FOLDER", "VERSION", "header"]

VERSION = 1  # of the interface: a new one for every change of a struct or a function
FOLDER = Path(__file__).with_name("native")  # of the header and the reference implementation

_STRUCTS = (
    ("inputs", "What comes to the controller at a tick.", INPUT_FIELDS),
    ("outputs", "What leaves it. Each must be a finite number; |i_cmd| at most current_limit.", OUTPUT_FIELDS),
    ("observables", "What it may show of itself, for pages, figures and verdicts.", OBSERVABLE_FIELDS),
    ("scalars", "The calibration's scalars (calibration.toml).", SCALAR_FIELDS),
)


def _struct(name: str, says: str, fields: tuple[Field, ...]) -> str:
    members = [f"double {f.name}{'[VANELOOP_STAGES]' if len(f.each) == len(VANES) else ''};" for f in fields]
    width = max(map(len, members))
    says_of = [
        f.meaning.replace("`MODES`", "VANELOOP_MODE_...").replace("`FAULTS`", "VANELOOP_FAULT_...") for f in fields
    ]
    says_of = [w.replace("`STRATEGIES`", "VANELOOP_STRATEGY_...") for w in says_of]
    lines = [f"    {m:<{width}} /* {f.unit}: {w} */" for m, f, w in zip(members, fields, says_of, strict=True)]
    return f"/* {says} */\ntypedef struct {{\n" + "\n".join(lines) + f"\n}} vaneloop_{name};\n"


def _names(prefix: str, names: tuple[str, ...]) -> str:
    return "enum {\n" + "".join(f"    VANELOOP_{prefix}_{n.upper()},\n" for n in names) + "};"


def header() -> str:
    """Return the header's text."""
    structs = "\n".join(_struct(*s) for s in _STRUCTS)
    return f"""\
/* The interface between VaneLoop and a controller of your own. C99, no dependency. docs/own_controller.md explains it.
 *
 * Build:  gcc -std=c99 -O2 -fPIC -shared -o my_controller.so controller.c -lm
 * Run:    vaneloop run --bus lockstep --controller ./my_controller.so
 *
 * Units are SI, speeds in % of design speed; positive current extends. Every number is a double. The tick is 1 ms; a
 * frame of the ECU comes every 10 ms. There is no clock: time is an argument. Each simulated loop gets a copy of the
 * library with global variables of its own, so a controller may keep its state in them.
 *
 * Written by `python -m controller.header` from controller/records.py: do not edit.
 */
#ifndef VANELOOP_CONTROLLER_H
#define VANELOOP_CONTROLLER_H

#include <stddef.h>
#include <stdint.h>

#define VANELOOP_CONTROLLER_VERSION {VERSION}u /* of this interface */
#define VANELOOP_STAGES {len(VANES)} /* vane stages at most; a machine has the first `stages` of them */
#define VANELOOP_TICK 1e-3 /* s */

#if defined(__GNUC__)
#define VANELOOP_EXPORT __attribute__((visibility("default")))
#else
#define VANELOOP_EXPORT
#endif

#ifdef __cplusplus
extern "C" {{
#endif

/* Numbers of the modes, of the bits in `faults`, of the strategies. */
{_names("MODE", MODES)}
{_names("FAULT", FAULTS)}
{_names("STRATEGY", STRATEGIES)}

{structs}
/* What the controller is flashed with. The pointers stay good as long as the controller runs; where an effect changes
 * the flashed tables or gains in a run (docs/effects.md), they change there. */
typedef struct {{
    const vaneloop_scalars *scalars;
    int32_t points;           /* of the stroke table */
    const double *speed;      /* %    increasing */
    const double *extension;  /* m    stroke at each speed while the demand rises */
    const double *retraction; /* m    while it falls */
    const double *single;     /* m    mean of both */
    int32_t strokes;          /* points of the angle table */
    const double *stroke;     /* m    increasing */
    const double *angle[VANELOOP_STAGES]; /* rad  of each stage in the middle of its play; NULL: no such stage */
}} vaneloop_calibration;

/* A calibration scalar of the controller's own: VaneLoop sets *value before vaneloop_init (own_calibration.toml). */
typedef struct {{
    const char *name, *unit, *meaning;
    double *value, low, high; /* *value is the default until it is set */
}} vaneloop_own_scalar;

/* A quantity of the controller's own that VaneLoop may read after any step. */
typedef struct {{
    const char *name, *unit, *meaning;
    const double *value;
}} vaneloop_own_observable;

typedef struct {{
    int32_t scalars, observables;
    const vaneloop_own_scalar *scalar;
    const vaneloop_own_observable *observable;
}} vaneloop_description;

/* ---- needed ---- */

/* Return VANELOOP_CONTROLLER_VERSION: which interface this was compiled against. */
VANELOOP_EXPORT uint32_t vaneloop_version(void);

/* Power on. Return NULL, or a text (one line) that says which value of the calibration is refused, what is allowed. */
VANELOOP_EXPORT const char *vaneloop_init(const vaneloop_calibration *calibration);

/* Run one tick. time: s since power-on. */
VANELOOP_EXPORT void vaneloop_step(double time, const vaneloop_inputs *inputs, vaneloop_outputs *outputs);

/* ---- optional ---- */

/* Show what the last step left behind. Without it VaneLoop shows the inputs as they came. */
VANELOOP_EXPORT void vaneloop_observe(vaneloop_observables *observables);

/* Copy the whole state to `to` unless that is NULL; return its size in bytes, always the same. */
VANELOOP_EXPORT size_t vaneloop_save(void *to);

/* Take back a state that vaneloop_save gave. */
VANELOOP_EXPORT void vaneloop_restore(const void *from);

/* Name calibration scalars and observables of the controller's own. */
VANELOOP_EXPORT const vaneloop_description *vaneloop_describe(void);

#ifdef __cplusplus
}}
#endif

#endif
"""


if __name__ == "__main__":
    print(header(), end="")
