/* VaneLoop's interface on a model of a code generator (vgv.h): copy the inputs in, step each rate, copy the outputs out.
 *
 * The names that your model has go into the six marked lines. A generator that writes one function a rate (vgv_step0,
 * vgv_step1) instead of a task identifier: call them where vgv_step(0) and vgv_step(1) stand.
 */
#include "coder/vgv.h"
#include "vaneloop_controller.h"

#define SUBRATE 10 /* ticks of 1 ms between two steps of task 1 */

static unsigned long tick;

uint32_t vaneloop_version(void) { return VANELOOP_CONTROLLER_VERSION; }

const char *vaneloop_init(const vaneloop_calibration *c) {
    const vaneloop_scalars *k = c->scalars;
    vgv_P = (P_vgv_T){k->kp,         k->ki,               k->current_limit, k->stroke_min, k->stroke_max, /* the model's */
                      k->fail_safe_stroke, k->stroke_rate, c->points,        c->speed,      c->single};
    tick = 0;
    vgv_initialize(); /* the model's */
    return NULL;
}

void vaneloop_step(double time, const vaneloop_inputs *in, vaneloop_outputs *out) {
    (void)time;
    int good = in->demand_fresh > 0.5 && in->n_dem >= 0.0 && in->n_dem <= 120.0 && in->n_r >= 0.0 && in->n_r <= 120.0 &&
               in->mode_request <= 1.0;
    double n_dem = good ? in->n_dem : vgv_U.n_dem, n_r = good ? in->n_r : vgv_U.n_r;
    vgv_U = (ExtU_vgv_T){n_dem, n_r, good, good ? in->mode_request : vgv_U.request, in->x_lvdt}; /* the model's */
    vgv_step(0); /* the model's; the fast rate first, as the generator's own main does */
    if (tick++ % SUBRATE == 0) vgv_step(1); /* the model's */
    out->i_cmd = vgv_Y.i_cmd; /* the model's */
    out->x_dem = vgv_Y.x_dem;
    out->mode = vgv_Y.mode;
    out->faults = vgv_Y.mode >= VANELOOP_MODE_DEGRADED ? 1 << VANELOOP_FAULT_DEMAND_STALE : 0;
}
