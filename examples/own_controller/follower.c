/* The least that is a controller: the stroke follows the mean table by a proportional current. It has a calibration
 * scalar and an observable of its own (vaneloop_describe). examples/own_controller/README.md builds and runs it; for a
 * controller to begin with, use vaneloop new-controller. */
#include "vaneloop_controller.h"

static vaneloop_calibration tables;
static double gain = 4.0;  /* A/m, own calibration scalar */
static double age = 1.0;   /* s since the last good frame */
static double n_r, error;  /* %, m */

uint32_t vaneloop_version(void) { return VANELOOP_CONTROLLER_VERSION; }

const char *vaneloop_init(const vaneloop_calibration *calibration) {
    tables = *calibration;
    return NULL;
}

static double mean_stroke(double n) {
    int i = 1;
    if (!(n > tables.speed[0])) return tables.single[0];
    while (i < tables.points - 1 && tables.speed[i] < n) i++;
    double share = (n - tables.speed[i - 1]) / (tables.speed[i] - tables.speed[i - 1]);
    if (share > 1.0) share = 1.0;
    return tables.single[i - 1] + share * (tables.single[i] - tables.single[i - 1]);
}

void vaneloop_step(double time, const vaneloop_inputs *in, vaneloop_outputs *out) {
    double limit = tables.scalars->current_limit, i;
    (void)time;
    age = in->demand_fresh > 0.5 ? 0.0 : age + VANELOOP_TICK;
    if (age == 0.0) n_r = in->n_r;
    out->x_dem = mean_stroke(n_r);
    error = in->x_lvdt == in->x_lvdt ? out->x_dem - in->x_lvdt : 0.0; /* 0 for NaN */
    i = gain * error;
    out->i_cmd = i > limit ? limit : i < -limit ? -limit : i;
    out->mode = age < 0.05 ? VANELOOP_MODE_RUN : age < 0.5 ? VANELOOP_MODE_DEGRADED : VANELOOP_MODE_FAIL_SAFE;
    out->faults = age < 0.05 ? 0 : 1 << VANELOOP_FAULT_DEMAND_STALE;
}

const vaneloop_description *vaneloop_describe(void) {
    static const vaneloop_own_scalar scalars[] = {{"gain", "A/m", "current per stroke error", &gain, 0.0, 100.0}};
    static const vaneloop_own_observable shown[] = {{"error", "m", "stroke error at the last tick", &error}};
    static const vaneloop_description all = {1, 1, scalars, shown};
    return &all;
}
