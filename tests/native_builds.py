"""Controllers in C for the tests: the reference implementation, and small ones that go wrong in one way."""

from __future__ import annotations

import subprocess
from pathlib import Path

from controller.header import FOLDER

REFERENCE = FOLDER / "reference.c"
BITWISE = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-ffp-contract=off")

# a controller that holds the stroke's demand at 10 mm, until `fault` from 0.5 s on; text for each part can be given
WRONG = """
#define _GNU_SOURCE
#include "vaneloop_controller.h"
#include <fcntl.h>
#include <fenv.h>
#include <math.h>
#include <pthread.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>
static volatile double sink;
static int times;
static const vaneloop_calibration *flashed;
%(top)s
uint32_t vaneloop_version(void) { return %(version)s; }
const char *vaneloop_init(const vaneloop_calibration *c) { flashed = c; %(init)s return NULL; }
void vaneloop_step(double time, const vaneloop_inputs *in, vaneloop_outputs *out) {
    sink = in->n_dem;
    out->x_dem = 0.01, out->mode = VANELOOP_MODE_RUN, out->i_cmd = 0.0, out->faults = 0.0;
    if (time >= 0.5) { %(fault)s }
}
"""


def build(gcc: str, source: Path, out: Path, *flags: str) -> str:
    """Compile one C file into a shared library; return its path."""
    command = [gcc, *flags, f"-I{FOLDER}", "-fPIC", "-shared", "-o", str(out), str(source), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return str(out)


def wrong(
    gcc: str, folder: Path, fault: str = "", init: str = "", version: str = "VANELOOP_CONTROLLER_VERSION", top: str = ""
) -> str:
    """Build a controller that goes wrong as ``fault`` (C, in every tick from 0.5 s on), ``init`` (C, at power-on),
    ``version`` or ``top`` (C, functions of its own) say.
    """
    source = folder / "wrong.c"
    source.write_text(WRONG % {"fault": fault, "init": init, "version": version, "top": top}, encoding="utf-8")
    return build(gcc, source, folder / "wrong.so")
