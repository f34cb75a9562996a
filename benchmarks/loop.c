/* The closed loop of hil/lockstep.py written by hand in C: what the compiled Python is measured and checked against.
 *
 * One tick is 1 ms: sensors' samples -> controller -> log -> engine, valve and actuator (10 steps), linkage with play, potentiometers.
 * The ECU's frame arrives every 10 ms. Formulas and their order are those of controller/firmware.py and plant/, so that a build
 * without contraction (gcc -O3 -march=native -ffp-contract=off) gives the same bits; everything else is as one writes it in C:
 * state in structs, modes and faults as integers. Units: SI, speeds in % of design speed, temperature in degC.
 */
#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#define TICK 1e-3
#define SLOW 10 /* ticks: demand, trend and schedule */
#define SLOW_TICK 1e-2
#define HALF_TICK (0.5 * TICK) /* timers are sums of ticks */
#define FAR 1.0                /* m, beyond any stroke */
#define SUBSTEPS 10 /* plant steps a tick */
#define STAGES 3
#define COLUMNS 13

/* ---- calibration and parameters: the fields in the order of the flat arrays ------------------------------------------------ */

typedef struct {
    double strategy, table_input;
    double trend_alpha, trend_beta, trend_rate_on, trend_change, trend_hold;
    double speed_filter, blend_time, stroke_rate, stroke_min, stroke_max;
    double kp, ki, kff, current_limit;
    double init_time, fail_safe_stroke, fail_safe_current, fail_safe_rate, degraded_hold, recover_time;
    double demand_timeout, demand_reject_limit, demand_reject_leak, demand_low, demand_high;
    double lvdt_low, lvdt_high, lvdt_rate, lvdt_debounce, lvdt_heal;
    double stuck_current, stuck_motion, stuck_time, stuck_margin;
    double tracking_limit, tracking_time, saturated_time;
    double inverse_and_adaptive[29]; /* strategies that are not written here */
} Calibration;

typedef struct {
    int n;
    const double *speed, *extension, *retraction, *single;
} StrokeTable;

typedef struct {
    double lb, lc, ld, ldp, l, ax, ay, hysteresis;
} Stage;

typedef struct {
    double lag, acceleration, deceleration;
    double rated_current, bandwidth, damping;
    double flow_gain, area, stroke, p_ref;
    double lvdt_lag, pot_lag, play[STAGES], pot_bias[STAGES];
    double lx0, x1, y1, le;
    Stage stage[STAGES];
    double lvdt_step, a11, a12, a21, a22, lvdt_factor, pot_factor;
} Parameters;

typedef struct {
    double n_dem, n_r, p_s, t_oil, fresh, rejected, mode_request;
} Frame;

typedef struct {
    double lvdt, pot[STAGES], speed;
} Noise;

/* ---- state ----------------------------------------------------------------------------------------------------------------- */

typedef enum { INIT, STANDBY, RUN, DEGRADED, FAIL_SAFE } Mode;

typedef enum { STALE, REJECTED, LVDT_RANGE, LVDT_RATE, LVDT_STUCK, TRACKING, CURRENT_SATURATED, DEMAND_RANGE, FAULTS } Fault;

#define LVDT_LOST (1u << LVDT_RANGE | 1u << LVDT_RATE | 1u << LVDT_STUCK)
#define TROUBLE (1u << STALE | 1u << REJECTED | 1u << DEMAND_RANGE | 1u << TRACKING | 1u << CURRENT_SATURATED)

typedef struct {
    double n_dem, n_r, rejected, mode_request, x_lvdt;
    bool fresh;
} Inputs;

typedef struct {
    Mode mode;
    long ticks;
    unsigned faults;
    bool demand_seen, lvdt_good, saturated, run_request;
    double n_dem, n_r_raw, n_r, demand_age, reject_bucket;
    double trend_n, trend_rate, trend_turn, trend_last, trend_timer, direction, blend;
    double x_target, x_dem, x_from, x_meas, x_reach, x_servo;
    double stuck_x, stuck_timer, integral, i_cmd, recover_timer, degraded_timer;
    double timer[FAULTS];
} Controller;

typedef struct {
    double n_r, spool, spool_rate, speed, x, x_lvdt, ring[STAGES], pot[STAGES];
} Plant;

typedef struct {
    Calibration cal;
    StrokeTable table;
    Parameters par;
    Noise sigma;
    Inputs in;
    Controller con;
    Plant plant;
    double current_sum, current_count; /* since the last logged sample */
} Loop;

static inline double clip(double v, double low, double high) {
    if (low > v) v = low;
    if (high < v) v = high;
    return v;
}

/* ---- controller ------------------------------------------------------------------------------------------------------------ */

static double look_up(const StrokeTable *t, const double *row, double v) {
    int low = 0, high = t->n - 1;
    if (!(v > t->speed[0])) return row[0];
    if (v >= t->speed[high]) return row[high];
    while (high - low > 1) {
        int mid = (low + high) / 2;
        if (t->speed[mid] <= v)
            low = mid;
        else
            high = mid;
    }
    double w = (v - t->speed[low]) / (t->speed[high] - t->speed[low]);
    return row[low] + w * (row[high] - row[low]);
}

static void trend_step(Controller *c, const Calibration *k) {
    double n_dem = c->n_dem;
    double predicted = c->trend_n + c->trend_rate * SLOW_TICK;
    double r = n_dem - predicted;
    c->trend_n = predicted + k->trend_alpha * r;
    c->trend_rate = c->trend_rate + k->trend_beta * r / SLOW_TICK;
    double d = c->direction;
    double last = c->trend_last;
    bool ahead = d * (n_dem - last) > 0.0;
    double reached = ahead ? last : n_dem;
    if (d * (reached - c->trend_turn) > 0.0) c->trend_turn = reached;
    c->trend_last = n_dem;
    double back = d * (c->trend_turn - n_dem);
    bool moving = -d * c->trend_rate > k->trend_rate_on && back > 0.5 * k->trend_change;
    if (moving || back > k->trend_change) {
        c->trend_timer += SLOW_TICK;
        if (c->trend_timer >= k->trend_hold - HALF_TICK) {
            c->direction = -d;
            c->trend_turn = ahead ? n_dem : last;
            c->trend_timer = 0.0;
        }
    } else {
        c->trend_timer = 0.0;
    }
}

static void schedule_step(Controller *c, const Calibration *k, const StrokeTable *t) {
    double n = k->table_input == 1.0 ? c->n_dem : c->n_r;
    double target;
    if (k->strategy == 0.0) {
        target = look_up(t, t->single, n);
    } else {
        double goal = c->direction > 0.0 ? 1.0 : 0.0;
        double step = SLOW_TICK / k->blend_time;
        c->blend += clip(goal - c->blend, -step, step);
        double retraction = look_up(t, t->retraction, n);
        double extension = look_up(t, t->extension, n);
        target = retraction + c->blend * (extension - retraction);
    }
    c->x_target = clip(target, k->stroke_min, k->stroke_max);
}

static void move_demand(Controller *c, const Calibration *k, double target, double rate) {
    double step = rate * SLOW_TICK;
    c->x_from = c->x_dem;
    c->x_dem += clip(target - c->x_dem, -step, step);
    c->x_dem = clip(c->x_dem, k->stroke_min, k->stroke_max);
}

static void servo_step(Controller *c, const Calibration *k, double x_ref, double dx_ref) {
    double e = x_ref - c->x_meas;
    double limit = k->current_limit;
    double integral = c->integral + k->ki * e * TICK;
    double i = k->kp * e + integral + k->kff * dx_ref;
    if (i > limit) {
        i = limit;
        c->saturated = true;
        if (e < 0.0) c->integral = integral;
    } else if (i < -limit) {
        i = -limit;
        c->saturated = true;
        if (e > 0.0) c->integral = integral;
    } else {
        c->saturated = false;
        c->integral = integral;
    }
    c->integral = clip(c->integral, -limit, limit);
    c->i_cmd = i;
}

/* Set `fault` after `rise` seconds of bad ticks, clear it after `heal` seconds of good ones. */
static void debounce(Controller *c, Fault fault, bool bad, double rise, double heal) {
    double *timer = &c->timer[fault];
    if (c->faults & 1u << fault) {
        *timer = bad ? 0.0 : *timer - TICK;
        if (*timer <= HALF_TICK - heal) {
            c->faults &= ~(1u << fault);
            *timer = 0.0;
        }
    } else {
        *timer = bad ? *timer + TICK : 0.0;
        if (bad && *timer >= rise - HALF_TICK) {
            c->faults |= 1u << fault;
            *timer = 0.0;
        }
    }
}

static void debounce_leaky(Controller *c, Fault fault, bool bad, double rise, double heal) {
    double *timer = &c->timer[fault];
    if (c->faults & 1u << fault) {
        debounce(c, fault, bad, rise, heal);
        return;
    }
    if (bad)
        *timer += TICK;
    else
        *timer = *timer - 0.1 * TICK > 0.0 ? *timer - 0.1 * TICK : 0.0;
    if (*timer >= rise - HALF_TICK) {
        c->faults |= 1u << fault;
        *timer = 0.0;
    }
}

static void condition_lvdt(Controller *c, const Calibration *k, double x) {
    bool in_range = k->lvdt_low <= x && x <= k->lvdt_high;
    c->x_reach += k->lvdt_rate * TICK;
    if (c->x_reach > FAR) c->x_reach = FAR;
    bool jump = in_range && fabs(x - c->x_meas) > c->x_reach;
    c->lvdt_good = in_range && !jump;
    if (c->lvdt_good) {
        c->x_meas = x;
        c->x_reach = 0.0;
    }
    debounce_leaky(c, LVDT_RANGE, !in_range, k->lvdt_debounce, k->lvdt_heal);
    if (jump) c->timer[LVDT_RATE] += 4.0 * TICK;
    debounce_leaky(c, LVDT_RATE, jump, k->lvdt_debounce, k->lvdt_heal);
    bool inside = k->stroke_min + k->stuck_margin < c->x_meas && c->x_meas < k->stroke_max - k->stuck_margin;
    bool stuck = c->stuck_timer >= k->stuck_time - HALF_TICK;
    bool asked = fabs(c->i_cmd) > k->stuck_current && inside;
    if ((asked || stuck) && fabs(c->x_meas - c->stuck_x) < k->stuck_motion) {
        if (!stuck) c->stuck_timer += TICK;
    } else {
        c->stuck_x = c->x_meas;
        c->stuck_timer = 0.0;
    }
    debounce(c, LVDT_STUCK, c->stuck_timer >= k->stuck_time - HALF_TICK, TICK, k->lvdt_heal);
}

static void monitor_demand(Controller *c, const Calibration *k, const Inputs *in) {
    bool in_range = k->demand_low <= in->n_dem && in->n_dem <= k->demand_high && k->demand_low <= in->n_r && in->n_r <= k->demand_high &&
                    0.0 <= in->mode_request && in->mode_request <= 1.0;
    double rejected = in->rejected >= 0.0 ? in->rejected : 0.0;
    double bucket = c->reject_bucket - k->demand_reject_leak * TICK;
    bucket = (bucket > 0.0 ? bucket : 0.0) + rejected;
    double full = k->demand_reject_limit;
    c->reject_bucket = bucket < full ? bucket : full;
    if (in->fresh && in_range) {
        c->demand_age = 0.0;
        c->n_dem = in->n_dem;
        c->n_r_raw = in->n_r;
        c->run_request = in->mode_request > 0.5;
        if (!c->demand_seen) {
            c->demand_seen = true;
            c->n_r = in->n_r;
            c->trend_n = in->n_dem;
            c->trend_turn = in->n_dem;
            c->trend_last = in->n_dem;
        }
    } else if (c->demand_age < 1e6) {
        c->demand_age += TICK;
    }
    debounce(c, STALE, c->demand_age >= k->demand_timeout - HALF_TICK, TICK, k->recover_time);
    debounce(c, REJECTED, c->reject_bucket >= k->demand_reject_limit, TICK, k->recover_time);
    debounce(c, DEMAND_RANGE, in->fresh && !in_range, TICK, k->recover_time);
}

/* Is the cause of any fault in `mask` there at this tick, rather than gone and the fault healing? */
static bool cause_present(const Controller *c, unsigned mask) {
    for (int f = 0; f < FAULTS; f++)
        if (c->faults & mask & 1u << f && c->timer[f] == 0.0) return true;
    return false;
}

static void choose_mode(Controller *c, const Calibration *k) {
    Mode before = c->mode;
    bool lvdt_lost = c->faults & LVDT_LOST;
    bool trouble = c->faults & TROUBLE;
    bool may_run = c->run_request && c->demand_seen;
    if (before == INIT) {
        if (lvdt_lost)
            c->mode = FAIL_SAFE;
        else if (c->ticks * TICK >= k->init_time - HALF_TICK && c->lvdt_good)
            c->mode = STANDBY;
    } else if (lvdt_lost) {
        c->mode = FAIL_SAFE;
        c->recover_timer = 0.0;
    } else {
        switch (before) {
        case STANDBY:
            if (may_run && !trouble) c->mode = RUN;
            break;
        case RUN:
            if (trouble)
                c->mode = DEGRADED;
            else if (!c->run_request)
                c->mode = STANDBY;
            break;
        case DEGRADED:
            if (cause_present(c, TROUBLE)) c->degraded_timer += TICK;
            if (!trouble)
                c->mode = RUN;
            else if (c->degraded_timer >= k->degraded_hold - HALF_TICK)
                c->mode = FAIL_SAFE;
            break;
        default:
            c->recover_timer = trouble ? 0.0 : c->recover_timer + TICK;
            if (c->recover_timer >= k->recover_time - HALF_TICK) c->mode = may_run ? RUN : STANDBY;
        }
    }
    if (c->mode != before) {
        c->recover_timer = 0.0;
        c->degraded_timer = 0.0;
        if (c->mode == STANDBY || c->mode == FAIL_SAFE || before == INIT || before == STANDBY) {
            c->x_dem = clip(c->x_meas, k->stroke_min, k->stroke_max);
            c->x_from = c->x_dem;
        }
    }
}

static void controller_tick(Controller *c, const Calibration *k, const StrokeTable *t, const Inputs *in) {
    condition_lvdt(c, k, in->x_lvdt);
    monitor_demand(c, k, in);
    int phase = c->ticks % SLOW;
    if (phase == 0) {
        if (c->demand_seen) {
            c->n_r += (c->n_r_raw - c->n_r) * SLOW_TICK / (k->speed_filter + SLOW_TICK);
            trend_step(c, k);
            schedule_step(c, k, t);
        }
        if (c->mode == RUN || c->mode == DEGRADED)
            move_demand(c, k, c->x_target, k->stroke_rate);
        else if (c->mode == FAIL_SAFE)
            move_demand(c, k, k->fail_safe_stroke, k->fail_safe_rate);
        else
            c->x_from = c->x_dem;
    }
    bool servo_on = c->mode != INIT && !(c->mode == FAIL_SAFE && (c->faults & LVDT_LOST));
    if (!servo_on) {
        c->x_dem = clip(c->x_meas, k->stroke_min, k->stroke_max);
        c->x_from = c->x_dem;
    }
    double dx_ref = (c->x_dem - c->x_from) / SLOW_TICK;
    double x_ref = c->x_from + dx_ref * TICK * (phase + 1);
    c->x_servo = x_ref;
    if (servo_on) {
        servo_step(c, k, x_ref, dx_ref);
    } else {
        c->i_cmd = c->mode == INIT ? 0.0 : clip(k->fail_safe_current, -k->current_limit, k->current_limit);
        c->integral = 0.0;
        c->saturated = false;
    }
    debounce(c, TRACKING, servo_on && fabs(x_ref - c->x_meas) > k->tracking_limit, k->tracking_time, k->recover_time);
    debounce(c, CURRENT_SATURATED, servo_on && c->saturated, k->saturated_time, k->recover_time);
    c->ticks++;
    choose_mode(c, k);
    if (isnan(c->i_cmd)) c->i_cmd = 0.0;
}

/* ---- plant ----------------------------------------------------------------------------------------------------------------- */

static void rotor_step(Plant *s, const Parameters *p, double n_dem) {
    s->n_r = s->n_r + clip((n_dem - s->n_r) / p->lag, -p->deceleration, p->acceleration) * TICK;
}

static void drive_step(Plant *s, const Parameters *p, double i_cmd, double p_s) {
    double target = i_cmd / p->rated_current;
    double ratio = p_s / p->p_ref;
    double gain = p->flow_gain * sqrt(ratio > 0.0 ? ratio : 0.0);
    const double dt = TICK / SUBSTEPS;
    for (int i = 0; i < SUBSTEPS; i++) {
        double d = s->spool - target;
        double u = target + p->a11 * d + p->a12 * s->spool_rate;
        double du = p->a21 * d + p->a22 * s->spool_rate;
        if (u > 1.0) {
            u = 1.0;
            du = 0.0;
        } else if (u < -1.0) {
            u = -1.0;
            du = 0.0;
        }
        double v = u * gain;
        s->x = clip(s->x + 0.5 * (s->speed + v) * dt, 0.0, p->stroke);
        s->x_lvdt += p->lvdt_factor * (s->x - s->x_lvdt);
        s->spool = u;
        s->spool_rate = du;
        s->speed = v;
    }
}

/* Direction of the crank's upper arm; the nearest stretched or folded position where the triangle does not close. */
static void crank(const Parameters *p, double stroke, double *c, double *s) {
    double lx = p->lx0 + stroke;
    double d2 = p->x1 * p->x1 + p->y1 * p->y1;
    double m = 0.5 * (d2 + p->le * p->le - lx * lx);
    double r = d2 * p->le * p->le - m * m;
    double root = r;
    if (r > 0.0) {
        root = sqrt(r);
    } else if (r <= 0.0) {
        root = 0.0;
        m = copysign(sqrt(d2) * p->le, m);
    }
    double f = 1.0 / (d2 * p->le);
    *c = (p->x1 * m - p->y1 * root) * f;
    *s = (p->x1 * root + p->y1 * m) * f;
}

static double ring_angle(const Stage *g, double c, double s) {
    double qx = g->ax + g->lb * c;
    double qy = g->ay + g->lb * s;
    double q2 = qx * qx + qy * qy;
    double u = 0.5 * (q2 + g->ld * g->ld - g->lc * g->lc) / g->ld;
    double r = q2 - u * u;
    double v = r;
    if (r > 0.0) {
        v = sqrt(r);
    } else if (r <= 0.0) {
        if (q2 == 0.0) return 0.0;
        v = 0.0;
        u = copysign(sqrt(q2), u);
    }
    double f = 1.0 / q2;
    return atan2(-(qx * u + qy * v) * f, (qy * u - qx * v) * f);
}

static double vane_angle(const Stage *g, double theta5) {
    double q = g->ldp * tan(theta5) / g->l;
    if (q > 1.0)
        q = 1.0;
    else if (q < -1.0)
        q = -1.0;
    return asin(q);
}

static void vane_step(Plant *s, const Parameters *p) {
    double c, sn;
    crank(p, s->x, &c, &sn);
    for (int k = 0; k < STAGES; k++) {
        double drive = ring_angle(&p->stage[k], c, sn);
        double half = 0.5 * p->play[k];
        s->ring[k] = clip(s->ring[k], drive - half, drive + half);
        double vane = vane_angle(&p->stage[k], s->ring[k]) + p->pot_bias[k];
        s->pot[k] += p->pot_factor * (vane - s->pot[k]);
    }
}

static double quantise(double v, double step) { return step <= 0.0 ? v : floor(v / step + 0.5) * step; }

/* ---- loop ------------------------------------------------------------------------------------------------------------------ */

/* A loop at rest at `stroke` (m) and `n_r` (%), the rings in the middle of their play, the controller just switched on.
 * cal, par, sigma and table (4 rows of n) are the flat arrays of the product. */
Loop *loop_new(const double *cal, const double *table, int n, const double *par, const double *sigma, double stroke, double n_r,
               double direction, double blend) {
    Loop *l = calloc(1, sizeof *l);
    memcpy(&l->cal, cal, sizeof l->cal);
    memcpy(&l->par, par, sizeof l->par);
    memcpy(&l->sigma, sigma, sizeof l->sigma);
    l->table = (StrokeTable){n, table, table + n, table + 2 * n, table + 3 * n};
    l->con.direction = direction;
    l->con.blend = blend;
    l->con.x_reach = FAR;
    l->plant.n_r = n_r;
    l->plant.x = l->plant.x_lvdt = stroke;
    double c, s;
    crank(&l->par, stroke, &c, &s);
    for (int k = 0; k < STAGES; k++) {
        l->plant.ring[k] = ring_angle(&l->par.stage[k], c, s);
        l->plant.pot[k] = vane_angle(&l->par.stage[k], l->plant.ring[k]) + l->par.pot_bias[k];
    }
    return l;
}

void loop_free(Loop *l) { free(l); }

unsigned loop_faults(const Loop *l) { return l->con.faults; }

int loop_layout(int what) { /* so that the caller can check that both sides mean the same arrays */
    const int sizes[] = {sizeof(Calibration), sizeof(Parameters), sizeof(Frame), sizeof(Noise)};
    return sizes[what] / (int)sizeof(double);
}

/* Advance by `ticks` ticks from tick `k0`; a row of `out` every `every` ticks. noise: one entry a tick, or NULL; out: or NULL. */
void loop_advance(Loop *l, long k0, long ticks, const Frame *frames, long n_frames, const Noise *noise, long every, double (*out)[COLUMNS]) {
    static const Noise silent;
    Inputs *in = &l->in;
    Plant *s = &l->plant;
    l->current_sum = l->current_count = 0.0;
    for (long i = 0; i < ticks; i++) {
        long k = k0 + i;
        long f = k / SLOW < 0 ? 0 : k / SLOW >= n_frames ? n_frames - 1 : k / SLOW;
        const Frame *frame = &frames[f];
        const Noise *w = noise ? &noise[i] : &silent;
        if (k % SLOW == 0) {
            in->n_dem = frame->n_dem;
            in->n_r = isnan(frame->n_r) ? s->n_r + l->sigma.speed * w->speed : frame->n_r;
            in->fresh = frame->fresh > 0.5;
            in->rejected = frame->rejected;
            in->mode_request = frame->mode_request;
        } else {
            in->fresh = false;
            in->rejected = 0.0;
        }
        in->x_lvdt = quantise(s->x_lvdt + l->sigma.lvdt * w->lvdt, l->par.lvdt_step);
        controller_tick(&l->con, &l->cal, &l->table, in);
        l->current_sum += l->con.i_cmd;
        l->current_count += 1.0;
        if (out && k % every == 0) {
            double *row = out[i / every];
            row[0] = k * 1e-3;
            row[1] = in->n_dem;
            row[2] = in->n_r;
            row[3] = l->con.x_dem;
            row[4] = in->x_lvdt;
            row[5] = l->current_sum / l->current_count;
            row[6] = frame->p_s;
            row[7] = frame->t_oil;
            for (int q = 0; q < STAGES; q++) row[8 + q] = s->pot[q] + l->sigma.pot[q] * w->pot[q];
            row[11] = l->con.mode;
            row[12] = s->n_r;
            l->current_sum = l->current_count = 0.0;
        }
        rotor_step(s, &l->par, in->n_dem);
        drive_step(s, &l->par, l->con.i_cmd, frame->p_s);
        vane_step(s, &l->par);
    }
}
