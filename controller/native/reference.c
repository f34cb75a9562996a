/* The firmware of controller/ in C: the reference implementation of vaneloop_controller.h.
 *
 * Built without contraction (gcc -std=c99 -O2 -ffp-contract=off) it gives the same bits as the compiled Python, tick by
 * tick. Signal flow, formulas and their order are those of controller/firmware.py; docs/controller.md explains them, and
 * docs/strategies.md the strategies inverse and adaptive.
 */
#include "vaneloop_controller.h"

#include <math.h>
#include <stdbool.h>
#include <string.h>

#define TICK VANELOOP_TICK
#define SLOW 10 /* ticks: demand, trend and schedule */
#define SLOW_TICK 1e-2
#define HALF_TICK (0.5 * TICK) /* timers are sums of ticks */
#define FAR 1.0                /* m, beyond any stroke */

#define BIT(fault) (1u << VANELOOP_FAULT_##fault)
#define LVDT_LOST (BIT(LVDT_RANGE) | BIT(LVDT_RATE) | BIT(LVDT_STUCK))
#define MUST_STOP (LVDT_LOST | BIT(PAUSED))
#define TROUBLE (BIT(DEMAND_STALE) | BIT(DEMAND_REJECTED) | BIT(DEMAND_RANGE) | BIT(TRACKING) | BIT(CURRENT_SATURATED))
#define FAULTS 9

typedef struct {
    int mode, ticks;
    unsigned faults;
    bool demand_seen, lvdt_good, saturated, run_request;
    double n_dem, n_r_raw, n_r, demand_age, reject_bucket;
    double trend_n, trend_rate, trend_turn, trend_last, trend_timer, direction, blend;
    double x_target, x_dem, x_from, x_meas, x_reach, x_servo;
    double stuck_x, stuck_timer, integral, i_cmd, recover_timer, degraded_timer;
    double timer[FAULTS];
    /* inverse and adaptive only */
    double speed, speed_rate, speed_drift, speed_noise, side, crossing, x_slow, quiet, offset_in_use, width_in_use;
    double farthest[VANELOOP_STAGES], engaged[VANELOOP_STAGES];
    double pot[VANELOOP_STAGES], pot_seen[VANELOOP_STAGES], suspect[VANELOOP_STAGES], trusted[VANELOOP_STAGES];
    double lowest[VANELOOP_STAGES], highest[VANELOOP_STAGES], offset[VANELOOP_STAGES], width[VANELOOP_STAGES];
    double proved_offset[VANELOOP_STAGES], proved_width[VANELOOP_STAGES];
    double learned_up[VANELOOP_STAGES], learned_down[VANELOOP_STAGES];
} State;

static State z;
static const vaneloop_scalars *k;
static const vaneloop_calibration *tables;
static vaneloop_calibration flashed;

static double clip(double v, double low, double high) {
    if (low > v) v = low;
    if (high < v) v = high;
    return v;
}

static double less(double a, double b) { return b < a ? b : a; }
static double more(double a, double b) { return b > a ? b : a; }

/* ---- schedule: from speed to stroke demand ---- */

static double between(const double *axis, const double *row, int points, double v) {
    int low = 0, high = points - 1;
    if (!(v > axis[0])) return row[0];
    if (v >= axis[high]) return row[high];
    while (high - low > 1) {
        int middle = (low + high) / 2;
        if (axis[middle] <= v)
            low = middle;
        else
            high = middle;
    }
    double w = (v - axis[low]) / (axis[high] - axis[low]);
    return row[low] + w * (row[high] - row[low]);
}

static double look_up(const double *row, double v) { return between(tables->speed, row, tables->points, v); }

/* Is the demand rising or falling? An alpha-beta filter gives its rate; the way back from the farthest point turns. */
static void trend_step(double n_dem) {
    double predicted = z.trend_n + z.trend_rate * SLOW_TICK;
    double r = n_dem - predicted;
    z.trend_n = predicted + k->trend_alpha * r;
    z.trend_rate = z.trend_rate + k->trend_beta * r / SLOW_TICK;
    double d = z.direction, last = z.trend_last;
    bool ahead = d * (n_dem - last) > 0.0;
    double reached = ahead ? last : n_dem;
    if (d * (reached - z.trend_turn) > 0.0) z.trend_turn = reached;
    z.trend_last = n_dem;
    double back = d * (z.trend_turn - n_dem);
    bool moving = -d * z.trend_rate > k->trend_rate_on && back > 0.5 * k->trend_change;
    if (!(moving || back > k->trend_change)) {
        z.trend_timer = 0.0;
        return;
    }
    z.trend_timer += SLOW_TICK;
    if (z.trend_timer >= k->trend_hold - HALF_TICK) {
        z.direction = -d;
        z.trend_turn = ahead ? n_dem : last;
        z.trend_timer = 0.0;
    }
}

static void schedule_step(void) {
    double n = k->table_input == 1.0 ? z.n_dem : z.n_r;
    double target;
    if (k->strategy == VANELOOP_STRATEGY_SINGLE) {
        target = look_up(tables->single, n);
    } else {
        double goal = z.direction > 0.0 ? 1.0 : 0.0;
        double step = SLOW_TICK / k->blend_time;
        z.blend += clip(goal - z.blend, -step, step);
        double retraction = look_up(tables->retraction, n);
        double extension = look_up(tables->extension, n);
        target = retraction + z.blend * (extension - retraction);
    }
    z.x_target = clip(target, k->stroke_min, k->stroke_max);
}

static void move_demand(double target, double rate) {
    double step = rate * SLOW_TICK;
    z.x_from = z.x_dem;
    z.x_dem += clip(target - z.x_dem, -step, step);
    z.x_dem = clip(z.x_dem, k->stroke_min, k->stroke_max);
}

/* ---- strategies inverse and adaptive: through the play, and what is learned of it ---- */

#define DRIFT_LIMIT 3.0   /* %/s */
#define NOISE_SHARE 2e-3  /* of 10 ms */
#define QUICK 0.02        /* rad/s */
#define SOFT_END 0.25     /* of what is left of the gap in 10 ms */
#define POT_SHARE 0.1     /* of 1 ms */
#define STROKE_SHARE 0.1  /* of 1 ms */
#define OVERSHOT 3e-5     /* m */
#define SUSPICION 0.2     /* of 10 ms */
#define FORGIVEN 0.02     /* of 10 ms */
#define QUIET_MOTION 2e-5 /* m in 10 ms */
#define QUIET_ERROR 1e-4  /* m */
#define SETTLED 0.1       /* s at rest */
#define UNSETTLED 0.004   /* rad */
#define MOVING 60.0       /* rad/m */
#define KNOWN 15.0        /* s of learning on a side */
#define WELL_KNOWN 30.0   /* s */
#define SEEN_AGAIN 0.6    /* of well known */

/* Rotor speed and its rate, from the engine's model driven by the demand and corrected by the measurement. */
static void observe_speed(void) {
    if (k->table_input == 1.0) {
        z.speed = z.n_dem;
        z.speed_rate = z.trend_rate;
        return;
    }
    if (z.demand_age >= k->demand_timeout - HALF_TICK) {
        z.speed_rate = 0.0;
    } else {
        double model = less(more((z.n_dem - z.speed) / k->engine_lag, -k->engine_deceleration), k->engine_acceleration);
        z.speed_rate = model + z.speed_drift;
        z.speed += z.speed_rate * SLOW_TICK;
        if (z.demand_age < SLOW_TICK - HALF_TICK) {
            double e = z.n_r_raw - z.speed;
            z.speed += k->observer_alpha * e;
            e = clip(e, -k->observer_band, k->observer_band);
            z.speed_drift = clip(z.speed_drift + k->observer_beta * e / SLOW_TICK, -DRIFT_LIMIT, DRIFT_LIMIT);
            z.speed_noise += NOISE_SHARE * (e * e - z.speed_noise);
        }
    }
    z.speed = less(more(z.speed, z.n_r - k->observer_band), z.n_r + k->observer_band);
}

static double angle_at(int stage, double stroke) {
    return between(tables->stroke, tables->angle[stage], tables->strokes, stroke);
}

static double scheduled_angle(double n) { return angle_at(0, look_up(tables->single, n)); }

/* Where in its gap is a stage? The play operator, with the drive angle and the total width (rad). */
static void follow_play(int i, double drive, double width) {
    double side = z.engaged[i];
    if (side == 0.0) {
        z.engaged[i] = z.direction > 0.0 ? 1.0 : -1.0;
        z.farthest[i] = drive;
    } else if (side * (drive - z.farthest[i]) > 0.0) {
        z.farthest[i] = drive;
    } else if (side * (z.farthest[i] - drive) > width) {
        z.farthest[i] = drive;
        z.engaged[i] = -side;
        double *learned = side > 0.0 ? z.learned_down : z.learned_up;
        learned[i] = less(learned[i], SEEN_AGAIN * WELL_KNOWN);
    }
}

/* The stroke that brings the VIGV to its target through the play. */
static void inverse_step(void) {
    observe_speed();
    double stroke = z.x_dem + more(z.x_slow - z.x_dem - OVERSHOT, 0.0) + less(z.x_slow - z.x_dem + OVERSHOT, 0.0);
    for (int i = 0; i < (int)k->stages; i++) {
        double extra = i == 0 ? z.width_in_use : z.width[i];
        follow_play(i, angle_at(i, stroke), more(k->play[i] + extra, 0.0));
    }
    double width = more(k->play[0] + z.width_in_use, 0.0);
    double vane = z.farthest[0] - 0.5 * z.engaged[0] * width + z.offset_in_use;
    double n = z.speed, rate = z.speed_rate;
    double target = scheduled_angle(n + rate * k->lead);
    double ahead = scheduled_angle(n + rate * (k->lead + k->look_ahead));
    double slope = fabs(scheduled_angle(n + 0.5) - scheduled_angle(n - 0.5));
    double alpha = k->observer_alpha;
    double band = k->turn_band + k->turn_noise * slope * sqrt(more(z.speed_noise, 0.0) * alpha / (2.0 - alpha));
    if (z.side == 0.0) z.side = z.crossing = z.direction > 0.0 ? 1.0 : -1.0;
    if (z.side * (ahead - vane) < -band) z.side = -z.side;
    double side = z.side, left = side - z.crossing;
    double step = 2.0 * SLOW_TICK / k->blend_time * (1.0 + less(slope * fabs(rate) / QUICK, 3.0));
    step = less(step, SOFT_END * fabs(left) + 1e-3);
    z.crossing += clip(left, -step, step);
    double aim = (side * (target - vane) > 0.0 ? target : vane) - z.offset_in_use + 0.5 * z.crossing * width;
    z.x_target = clip(between(tables->angle[0], tables->stroke, tables->strokes, aim), k->stroke_min, k->stroke_max);
}

static void filter_pots(const vaneloop_inputs *in) {
    for (int i = 0; i < (int)k->stages; i++) {
        double y = in->pots[i];
        if (k->pot_low <= y && y <= k->pot_high) {
            if (z.pot_seen[i] == 0.0) {
                z.pot_seen[i] = 1.0;
                z.pot[i] = y;
            }
            z.pot[i] += POT_SHARE * (y - z.pot[i]);
        } else {
            z.suspect[i] += SUSPICION * TICK / SLOW_TICK;
        }
    }
}

/* Is a potentiometer trusted? Once its readings have followed the linkage over pot_trust, until doubts add up. */
static void judge_pot(int i, double expected, bool plausible) {
    if (plausible) {
        z.suspect[i] = more(z.suspect[i] - FORGIVEN, 0.0);
        z.lowest[i] = less(z.lowest[i], expected);
        z.highest[i] = more(z.highest[i], expected);
        if (z.highest[i] - z.lowest[i] >= k->pot_trust && z.suspect[i] == 0.0) {
            z.trusted[i] = 1.0;
            z.proved_offset[i] = z.offset[i];
            z.proved_width[i] = z.width[i];
            z.lowest[i] = z.highest[i] = expected;
        }
    } else {
        z.suspect[i] += SUSPICION;
        z.lowest[i] = z.highest[i] = expected;
    }
    if (z.suspect[i] >= 1.0) {
        if (z.trusted[i] == 1.0) {
            z.offset[i] = z.proved_offset[i];
            z.width[i] = z.proved_width[i];
        }
        z.trusted[i] = z.pot_seen[i] = 0.0;
        z.suspect[i] = 1.0;
        z.lowest[i] = z.highest[i] = expected;
    }
}

/* Learn offset and play of each stage from its potentiometer, with the stroke at rest. */
static void learn(void) {
    bool quiet = z.mode == VANELOOP_MODE_RUN && fabs(z.x_dem - z.x_from) < QUIET_MOTION &&
                 fabs(z.x_dem - z.x_meas) < QUIET_ERROR;
    z.quiet = quiet ? less(z.quiet + SLOW_TICK, 1.0) : 0.0;
    for (int i = 0; i < (int)k->stages; i++) {
        double side = z.engaged[i], play = k->play[i];
        double expected = z.farthest[i] + z.offset[i] - 0.5 * side * more(play + z.width[i], 0.0);
        double r = z.pot[i] - expected;
        double known = less(z.learned_up[i], z.learned_down[i]);
        double gate = known >= KNOWN ? k->pot_gate : k->pot_gate + k->offset_limit + 0.5 * k->width_limit;
        if (z.quiet < SETTLED) gate += UNSETTLED + MOVING * fabs(z.x_dem - z.x_from);
        bool plausible = z.pot_seen[i] == 1.0 && side != 0.0 && fabs(r) <= gate;
        judge_pot(i, expected, plausible);
        if (!plausible || z.trusted[i] == 0.0 || z.quiet < SETTLED) continue;
        double *learned = side > 0.0 ? z.learned_up : z.learned_down;
        double fresh = 1.0 - learned[i] / WELL_KNOWN;
        double rate = k->learn_rate * (1.0 + 11.0 * fresh);
        double step = clip(r / (k->learn_time * (1.0 - 0.75 * fresh)), -rate, rate) * SLOW_TICK;
        double share = 0.5 + 0.4 * less(known / WELL_KNOWN, 1.0);
        double offset = z.offset[i] + share * step;
        double width = z.width[i] - 2.0 * side * (1.0 - share) * step;
        if (known >= KNOWN) {
            double budget = k->learn_budget;
            offset = clip(offset, z.proved_offset[i] - budget, z.proved_offset[i] + budget);
            width = clip(width, z.proved_width[i] - budget, z.proved_width[i] + budget);
        }
        z.offset[i] = clip(offset, -k->offset_limit, k->offset_limit);
        z.width[i] = clip(width, -less(k->width_limit, play), k->width_limit);
        learned[i] = less(learned[i] + SLOW_TICK, WELL_KNOWN);
        if (known < KNOWN) {
            z.proved_offset[i] = z.offset[i];
            z.proved_width[i] = z.width[i];
        }
    }
    double step = k->apply_rate * SLOW_TICK;
    z.offset_in_use += clip(z.offset[0] - z.offset_in_use, -step, step);
    z.width_in_use += clip(z.width[0] - z.width_in_use, -step, step);
}

/* ---- servo: PI with feed-forward, current limit, anti-windup ---- */

static void servo_step(double x_ref, double dx_ref) {
    double e = x_ref - z.x_meas;
    double limit = k->current_limit;
    double integral = z.integral + k->ki * e * TICK;
    double i = k->kp * e + integral + k->kff * dx_ref;
    z.saturated = i > limit || i < -limit;
    if (i > limit) {
        i = limit;
        if (e < 0.0) z.integral = integral;
    } else if (i < -limit) {
        i = -limit;
        if (e > 0.0) z.integral = integral;
    } else {
        z.integral = integral;
    }
    z.integral = clip(z.integral, -limit, limit);
    z.i_cmd = i;
}

/* ---- monitors: what is believed ---- */

/* Set `fault` after `rise` seconds of bad ticks, clear it after `heal` seconds of good ones. */
static void debounce(int fault, bool bad, double rise, double heal) {
    double *timer = &z.timer[fault];
    if (z.faults & 1u << fault) {
        *timer = bad ? 0.0 : *timer - TICK;
        if (*timer <= HALF_TICK - heal) {
            z.faults &= ~(1u << fault);
            *timer = 0.0;
        }
    } else {
        *timer = bad ? *timer + TICK : 0.0;
        if (bad && *timer >= rise - HALF_TICK) {
            z.faults |= 1u << fault;
            *timer = 0.0;
        }
    }
}

/* The same, but good ticks only count the timer down: intermittent faults add up. */
static void debounce_leaky(int fault, bool bad, double rise, double heal) {
    double *timer = &z.timer[fault];
    if (z.faults & 1u << fault) {
        debounce(fault, bad, rise, heal);
        return;
    }
    if (bad)
        *timer += TICK;
    else
        *timer = *timer - 0.1 * TICK > 0.0 ? *timer - 0.1 * TICK : 0.0;
    if (*timer >= rise - HALF_TICK) {
        z.faults |= 1u << fault;
        *timer = 0.0;
    }
}

static void condition_lvdt(double x, double pause) {
    bool in_range = k->lvdt_low <= x && x <= k->lvdt_high; /* false for NaN */
    z.x_reach += k->lvdt_rate * (TICK + pause);
    if (z.x_reach > FAR) z.x_reach = FAR;
    bool jump = in_range && fabs(x - z.x_meas) > z.x_reach;
    z.lvdt_good = in_range && !jump;
    if (z.lvdt_good) {
        z.x_meas = x;
        z.x_reach = 0.0;
    }
    debounce_leaky(VANELOOP_FAULT_LVDT_RANGE, !in_range, k->lvdt_debounce, k->lvdt_heal);
    if (jump) z.timer[VANELOOP_FAULT_LVDT_RATE] += 4.0 * TICK;
    debounce_leaky(VANELOOP_FAULT_LVDT_RATE, jump, k->lvdt_debounce, k->lvdt_heal);
    bool inside = k->stroke_min + k->stuck_margin < z.x_meas && z.x_meas < k->stroke_max - k->stuck_margin;
    bool stuck = z.stuck_timer >= k->stuck_time - HALF_TICK;
    bool asked = fabs(z.i_cmd) > k->stuck_current && inside;
    if ((asked || stuck) && fabs(z.x_meas - z.stuck_x) < k->stuck_motion) {
        if (!stuck) z.stuck_timer += TICK;
    } else {
        z.stuck_x = z.x_meas;
        z.stuck_timer = 0.0;
    }
    debounce(VANELOOP_FAULT_LVDT_STUCK, z.stuck_timer >= k->stuck_time - HALF_TICK, TICK, k->lvdt_heal);
}

static void monitor_demand(const vaneloop_inputs *in, double pause) {
    bool fresh = in->demand_fresh > 0.5;
    bool in_range = k->demand_low <= in->n_dem && in->n_dem <= k->demand_high && k->demand_low <= in->n_r &&
                    in->n_r <= k->demand_high && 0.0 <= in->mode_request && in->mode_request <= 1.0;
    double rejected = in->demand_rejected >= 0.0 ? in->demand_rejected : 0.0;
    double bucket = z.reject_bucket - k->demand_reject_leak * TICK;
    bucket = (bucket > 0.0 ? bucket : 0.0) + rejected;
    z.reject_bucket = bucket < k->demand_reject_limit ? bucket : k->demand_reject_limit;
    if (fresh && in_range) {
        z.demand_age = 0.0;
        z.n_dem = in->n_dem;
        z.n_r_raw = in->n_r;
        z.run_request = in->mode_request > 0.5;
        if (!z.demand_seen) {
            z.demand_seen = true;
            z.n_r = z.speed = in->n_r;
            z.trend_n = z.trend_turn = z.trend_last = in->n_dem;
        }
    } else {
        z.demand_age += TICK + pause;
        if (z.demand_age > 1e6) z.demand_age = 1e6;
    }
    debounce(VANELOOP_FAULT_DEMAND_STALE, z.demand_age >= k->demand_timeout - HALF_TICK, TICK, k->recover_time);
    debounce(VANELOOP_FAULT_DEMAND_REJECTED, z.reject_bucket >= k->demand_reject_limit, TICK, k->recover_time);
    debounce(VANELOOP_FAULT_DEMAND_RANGE, fresh && !in_range, TICK, k->recover_time);
}

/* ---- modes ---- */

/* Is the cause of any fault in `mask` there at this tick, rather than gone and the fault healing? */
static bool cause_present(unsigned mask) {
    for (int f = 0; f < FAULTS; f++)
        if (z.faults & mask & 1u << f && z.timer[f] == 0.0) return true;
    return false;
}

static void choose_mode(void) {
    int before = z.mode;
    bool trouble = z.faults & TROUBLE;
    bool may_run = z.run_request && z.demand_seen;
    if (before == VANELOOP_MODE_INIT) {
        if (z.faults & MUST_STOP)
            z.mode = VANELOOP_MODE_FAIL_SAFE;
        else if (z.ticks * TICK >= k->init_time - HALF_TICK && z.lvdt_good)
            z.mode = VANELOOP_MODE_STANDBY;
    } else if (z.faults & MUST_STOP) {
        z.mode = VANELOOP_MODE_FAIL_SAFE;
        z.recover_timer = 0.0;
    } else if (before == VANELOOP_MODE_STANDBY) {
        if (may_run && !trouble) z.mode = VANELOOP_MODE_RUN;
    } else if (before == VANELOOP_MODE_RUN) {
        if (trouble)
            z.mode = VANELOOP_MODE_DEGRADED;
        else if (!z.run_request)
            z.mode = VANELOOP_MODE_STANDBY;
    } else if (before == VANELOOP_MODE_DEGRADED) {
        if (cause_present(TROUBLE)) z.degraded_timer += TICK;
        if (!trouble)
            z.mode = VANELOOP_MODE_RUN;
        else if (z.degraded_timer >= k->degraded_hold - HALF_TICK)
            z.mode = VANELOOP_MODE_FAIL_SAFE;
    } else {
        z.recover_timer = trouble ? 0.0 : z.recover_timer + TICK;
        if (z.recover_timer >= k->recover_time - HALF_TICK)
            z.mode = may_run ? VANELOOP_MODE_RUN : VANELOOP_MODE_STANDBY;
    }
    if (z.mode == before) return;
    z.recover_timer = z.degraded_timer = 0.0;
    if (z.mode == VANELOOP_MODE_STANDBY || z.mode == VANELOOP_MODE_FAIL_SAFE || before == VANELOOP_MODE_INIT ||
        before == VANELOOP_MODE_STANDBY)
        z.x_from = z.x_dem = clip(z.x_meas, k->stroke_min, k->stroke_max); /* start from where the piston is */
}

/* ---- the interface ---- */

uint32_t vaneloop_version(void) { return VANELOOP_CONTROLLER_VERSION; }

const char *vaneloop_init(const vaneloop_calibration *calibration) {
    flashed = *calibration;
    tables = &flashed;
    k = flashed.scalars;
    memset(&z, 0, sizeof z);
    z.direction = z.blend = 1.0;
    z.x_reach = FAR;
    return NULL;
}

void vaneloop_step(double time, const vaneloop_inputs *in, vaneloop_outputs *out) {
    (void)time;
    double pause = in->pause > 0.0 ? (in->pause < 1e6 ? in->pause : 1e6) : 0.0;
    condition_lvdt(in->x_lvdt, pause);
    monitor_demand(in, pause);
    debounce(VANELOOP_FAULT_PAUSED, pause > 0.0, TICK, k->recover_time);
    if (k->strategy >= VANELOOP_STRATEGY_INVERSE) z.x_slow += STROKE_SHARE * (z.x_meas - z.x_slow);
    if (k->strategy == VANELOOP_STRATEGY_ADAPTIVE) filter_pots(in);
    int mode = z.mode, phase = z.ticks % SLOW;
    if (phase == 0) {
        if (z.demand_seen) {
            z.n_r += (z.n_r_raw - z.n_r) * SLOW_TICK / (k->speed_filter + SLOW_TICK);
            trend_step(z.n_dem);
            if (k->strategy == VANELOOP_STRATEGY_ADAPTIVE) learn();
            if (k->strategy >= VANELOOP_STRATEGY_INVERSE)
                inverse_step();
            else
                schedule_step();
        }
        if (mode == VANELOOP_MODE_RUN || mode == VANELOOP_MODE_DEGRADED)
            move_demand(z.x_target, k->stroke_rate);
        else if (mode == VANELOOP_MODE_FAIL_SAFE)
            move_demand(k->fail_safe_stroke, k->fail_safe_rate);
        else
            z.x_from = z.x_dem;
    }
    bool servo_on = mode != VANELOOP_MODE_INIT && !(mode == VANELOOP_MODE_FAIL_SAFE && (z.faults & LVDT_LOST));
    if (!servo_on) z.x_from = z.x_dem = clip(z.x_meas, k->stroke_min, k->stroke_max);
    double dx_ref = (z.x_dem - z.x_from) / SLOW_TICK;
    double x_ref = z.x_from + dx_ref * TICK * (phase + 1);
    z.x_servo = x_ref;
    if (servo_on) {
        servo_step(x_ref, dx_ref);
    } else {
        double limit = k->current_limit;
        z.i_cmd = mode == VANELOOP_MODE_INIT ? 0.0 : clip(k->fail_safe_current, -limit, limit);
        z.integral = 0.0;
        z.saturated = false;
    }
    bool astray = servo_on && fabs(x_ref - z.x_meas) > k->tracking_limit;
    debounce(VANELOOP_FAULT_TRACKING, astray, k->tracking_time, k->recover_time);
    debounce(VANELOOP_FAULT_CURRENT_SATURATED, servo_on && z.saturated, k->saturated_time, k->recover_time);
    z.ticks++;
    choose_mode();
    if (isnan(z.i_cmd)) z.i_cmd = 0.0;
    *out = (vaneloop_outputs){z.i_cmd, z.x_dem, z.mode, z.faults};
}

void vaneloop_observe(vaneloop_observables *o) {
    o->n_dem = z.n_dem;
    o->n_r_raw = z.n_r_raw;
    o->n_r = z.n_r;
    o->direction = z.direction;
    o->blend = z.blend;
    o->x_target = z.x_target;
    o->x_from = z.x_from;
    o->x_meas = z.x_meas;
    o->x_servo = z.x_servo;
    o->integral = z.integral;
    o->saturated = z.saturated;
    o->speed = z.speed;
    o->side = z.side;
    o->crossing = z.crossing;
    o->offset_in_use = z.offset_in_use;
    o->width_in_use = z.width_in_use;
}

size_t vaneloop_save(void *to) {
    if (to) memcpy(to, &z, sizeof z);
    return sizeof z;
}

void vaneloop_restore(const void *from) { memcpy(&z, from, sizeof z); }
