/* A controller of your own, to begin with: PI on the stroke, one stroke table for a rising and one for a falling demand.
 *
 *   n_dem --> which table --+
 *   n_r ---> table ---------+--> rate limit --> x_dem --> PI --> i_cmd
 *   x_lvdt -> plausible? -------------------------------^
 *
 * Everything it remembers stands in one struct. Units: SI, speeds in %. vaneloop_controller.h says what each number is.
 */
#include "vaneloop_controller.h"

#include <math.h>
#include <string.h>

/* ---- calibration: what is not in the tables that VaneLoop gives ---- */
static const double TURN = 0.5;        /* %: the demand has come back this far: the other table */
static const double STALE = 0.05;      /* s without a good frame: DEGRADED; five frames */
static const double GIVE_UP = 0.5;     /* s in DEGRADED: FAIL_SAFE */
static const double RECOVER = 0.5;     /* s of good frames and good samples: RUN again */
static const double LVDT_BAD = 0.005;  /* s of implausible samples: FAIL_SAFE */

static struct {
    int mode;
    double demand_age, lvdt_bad, good, degraded; /* s */
    double n_dem, n_r, farthest, direction;      /* %, %, %, +1 rising or -1 falling */
    double x_meas, x_dem, blend, integral;       /* m, m, 0..1 from falling to rising, A */
    int run_request, seen;
} z;

static const vaneloop_scalars *k;
static vaneloop_calibration tables;

uint32_t vaneloop_version(void) { return VANELOOP_CONTROLLER_VERSION; }

const char *vaneloop_init(const vaneloop_calibration *calibration) {
    if (!(calibration->scalars->kp > 0.0)) return "kp must be above 0: without it the loop does not close";
    tables = *calibration; /* what its pointers point to stays */
    k = tables.scalars;
    memset(&z, 0, sizeof z);
    z.mode = VANELOOP_MODE_INIT;
    z.direction = z.blend = 1.0;
    z.demand_age = 1.0;
    return NULL; /* accepted */
}

static double clip(double v, double low, double high) { return v < low ? low : v > high ? high : v; }

/* Straight lines between the points of a table, constant beyond its ends. */
static double look_up(const double *strokes, double n) {
    int i = 1, last = tables.points - 1;
    if (n <= tables.speed[0]) return strokes[0];
    if (n >= tables.speed[last]) return strokes[last];
    while (tables.speed[i] < n) i++;
    double share = (n - tables.speed[i - 1]) / (tables.speed[i] - tables.speed[i - 1]);
    return strokes[i - 1] + share * (strokes[i] - strokes[i - 1]);
}

static int plausible(double v, double low, double high) { return low <= v && v <= high; } /* 0 for NaN, too */

/* What is believed of the inputs. A frame with a value that cannot be counts as none. */
static void listen(const vaneloop_inputs *in) {
    z.demand_age += VANELOOP_TICK + in->pause;
    if (in->demand_fresh > 0.5 && plausible(in->n_dem, k->demand_low, k->demand_high) &&
        plausible(in->n_r, k->demand_low, k->demand_high) && plausible(in->mode_request, 0.0, 1.0)) {
        z.demand_age = 0.0;
        z.n_dem = in->n_dem;
        z.n_r += (z.seen ? 0.2 : 1.0) * (in->n_r - z.n_r); /* a lag of 50 ms */
        z.run_request = in->mode_request > 0.5;
        z.seen = 1;
        if (z.direction * (z.n_dem - z.farthest) > 0.0) z.farthest = z.n_dem;
        if (z.direction * (z.farthest - z.n_dem) > TURN) { /* it has turned round */
            z.direction = -z.direction;
            z.farthest = z.n_dem;
        }
    }
    double reach = k->lvdt_rate * (VANELOOP_TICK + in->pause + z.lvdt_bad) + 1e-4;
    int first = z.mode == VANELOOP_MODE_INIT;
    if (plausible(in->x_lvdt, k->lvdt_low, k->lvdt_high) && (first || fabs(in->x_lvdt - z.x_meas) <= reach)) {
        z.x_meas = in->x_lvdt;
        z.lvdt_bad = 0.0;
    } else {
        z.lvdt_bad += VANELOOP_TICK;
    }
}

static void choose_mode(void) {
    int lvdt_lost = z.lvdt_bad >= LVDT_BAD, stale = z.demand_age >= STALE, before = z.mode;
    z.good = lvdt_lost || stale ? 0.0 : z.good + VANELOOP_TICK;
    switch (z.mode) {
    case VANELOOP_MODE_INIT:
        if (z.lvdt_bad == 0.0) z.mode = VANELOOP_MODE_STANDBY;
        break;
    case VANELOOP_MODE_STANDBY:
        if (z.run_request && !stale) z.mode = VANELOOP_MODE_RUN;
        break;
    case VANELOOP_MODE_RUN:
        if (stale) z.mode = VANELOOP_MODE_DEGRADED;
        else if (!z.run_request) z.mode = VANELOOP_MODE_STANDBY;
        break;
    case VANELOOP_MODE_DEGRADED:
        z.degraded += VANELOOP_TICK;
        if (z.good >= RECOVER) z.mode = VANELOOP_MODE_RUN;
        else if (stale && z.degraded >= GIVE_UP) z.mode = VANELOOP_MODE_FAIL_SAFE;
        break;
    default: /* FAIL_SAFE */
        if (z.good >= RECOVER) z.mode = z.run_request ? VANELOOP_MODE_RUN : VANELOOP_MODE_STANDBY;
    }
    if (lvdt_lost) z.mode = VANELOOP_MODE_FAIL_SAFE;
    if (z.mode != before) z.degraded = 0.0;
}

/* The stroke demand moves to its goal no faster than stroke_rate. */
static void move_demand(void) {
    double step = k->stroke_rate * VANELOOP_TICK, goal = z.x_dem;
    z.blend = clip(z.blend + (z.direction > 0.0 ? 1.0 : -1.0) * VANELOOP_TICK / k->blend_time, 0.0, 1.0);
    if (z.mode == VANELOOP_MODE_RUN || z.mode == VANELOOP_MODE_DEGRADED) {
        double falling = look_up(tables.retraction, z.n_r), rising = look_up(tables.extension, z.n_r);
        goal = falling + z.blend * (rising - falling);
    } else if (z.mode == VANELOOP_MODE_FAIL_SAFE) {
        goal = k->fail_safe_stroke;
        step = k->fail_safe_rate * VANELOOP_TICK;
    }
    z.x_dem = clip(z.x_dem + clip(goal - z.x_dem, -step, step), k->stroke_min, k->stroke_max);
}

void vaneloop_step(double time, const vaneloop_inputs *in, vaneloop_outputs *out) {
    (void)time; /* s since power-on; this controller counts by itself */
    listen(in);
    choose_mode();
    double i = 0.0, limit = k->current_limit;
    if (z.mode == VANELOOP_MODE_INIT) {
        z.x_dem = clip(z.x_meas, k->stroke_min, k->stroke_max); /* begin where the piston is */
    } else if (z.lvdt_bad >= LVDT_BAD) {
        i = clip(k->fail_safe_current, -limit, limit); /* blind: a fixed current */
        z.integral = 0.0;
        z.x_dem = clip(z.x_meas, k->stroke_min, k->stroke_max);
    } else {
        move_demand();
        double e = z.x_dem - z.x_meas;
        i = k->kp * e + z.integral;
        if (fabs(i) < limit || e * i < 0.0) z.integral += k->ki * e * VANELOOP_TICK; /* not further into the limit */
        z.integral = clip(z.integral, -limit, limit);
        i = clip(i, -limit, limit);
    }
    out->i_cmd = i;
    out->x_dem = z.x_dem;
    out->mode = z.mode;
    out->faults = (z.demand_age >= STALE && z.seen ? 1 << VANELOOP_FAULT_DEMAND_STALE : 0) |
                  (z.lvdt_bad >= LVDT_BAD ? 1 << VANELOOP_FAULT_LVDT_RANGE : 0);
}

/* ---- optional: what VaneLoop shows besides the outputs, and the state for fuzz and for FMI's get and set state ---- */

void vaneloop_observe(vaneloop_observables *o) {
    o->n_dem = z.n_dem;
    o->n_r = o->n_r_raw = z.n_r;
    o->x_meas = z.x_meas;
    o->x_servo = o->x_from = o->x_target = z.x_dem;
    o->direction = z.direction;
    o->blend = z.blend;
    o->integral = z.integral;
}

size_t vaneloop_save(void *to) {
    if (to) memcpy(to, &z, sizeof z);
    return sizeof z;
}

void vaneloop_restore(const void *from) { memcpy(&z, from, sizeof z); }
