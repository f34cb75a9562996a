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

#define VANELOOP_CONTROLLER_VERSION 1u /* of this interface */
#define VANELOOP_STAGES 8 /* vane stages at most; a machine has the first `stages` of them */
#define VANELOOP_TICK 1e-3 /* s */

#if defined(__GNUC__)
#define VANELOOP_EXPORT __attribute__((visibility("default")))
#else
#define VANELOOP_EXPORT
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* Numbers of the modes, of the bits in `faults`, of the strategies. */
enum {
    VANELOOP_MODE_INIT,
    VANELOOP_MODE_STANDBY,
    VANELOOP_MODE_RUN,
    VANELOOP_MODE_DEGRADED,
    VANELOOP_MODE_FAIL_SAFE,
};
enum {
    VANELOOP_FAULT_DEMAND_STALE,
    VANELOOP_FAULT_DEMAND_REJECTED,
    VANELOOP_FAULT_LVDT_RANGE,
    VANELOOP_FAULT_LVDT_RATE,
    VANELOOP_FAULT_LVDT_STUCK,
    VANELOOP_FAULT_TRACKING,
    VANELOOP_FAULT_CURRENT_SATURATED,
    VANELOOP_FAULT_DEMAND_RANGE,
    VANELOOP_FAULT_PAUSED,
};
enum {
    VANELOOP_STRATEGY_SINGLE,
    VANELOOP_STRATEGY_DUAL,
    VANELOOP_STRATEGY_INVERSE,
    VANELOOP_STRATEGY_ADAPTIVE,
};

/* What comes to the controller at a tick. */
typedef struct {
    double n_dem;                 /* %: demand of the last good ECU frame */
    double n_r;                   /* %: measured speed of the last good ECU frame */
    double demand_fresh;          /* -: 1 if a good ECU frame came since the last tick */
    double demand_rejected;       /* -: ECU frames refused since the last tick (CRC, counter, length) */
    double mode_request;          /* -: 0 standby, 1 run */
    double x_lvdt;                /* m: stroke as the LVDT gives it */
    double pots[VANELOOP_STAGES]; /* rad: vane angles as the stem potentiometers give them; NaN = not fitted */
    double pause;                 /* s: for which the controller stood still before this tick, as its supervisor says; 0: on time */
} vaneloop_inputs;

/* What leaves it. Each must be a finite number; |i_cmd| at most current_limit. */
typedef struct {
    double i_cmd;  /* A: servo-valve current */
    double x_dem;  /* m: stroke demand */
    double mode;   /* -: number of the mode in VANELOOP_MODE_... */
    double faults; /* -: bit mask of VANELOOP_FAULT_... */
} vaneloop_outputs;

/* What it may show of itself, for pages, figures and verdicts. */
typedef struct {
    double n_dem;         /* %: demand in use */
    double n_r_raw;       /* %: measured speed of the last good frame */
    double n_r;           /* %: filtered measured speed */
    double direction;     /* -: +1 demand rises (extension curve), -1 falls (retraction curve) */
    double blend;         /* -: 0 retraction curve .. 1 extension curve */
    double x_target;      /* m: stroke from the tables */
    double x_from;        /* m: stroke demand 10 ms before */
    double x_meas;        /* m: last plausible stroke */
    double x_servo;       /* m: reference of the servo at this tick */
    double integral;      /* A: of the servo */
    double saturated;     /* -: 1 while the current is limited */
    double speed;         /* %: observed speed */
    double side;          /* -: +1, -1: the pushing side of the VIGV's gap that the stroke is to be on; 0 not yet known */
    double crossing;      /* -: -1 .. 1: where in the gap the stroke demand is */
    double offset_in_use; /* rad: of the VIGV */
    double width_in_use;  /* rad: beyond the play as built, of the VIGV */
} vaneloop_observables;

/* The calibration's scalars (calibration.toml). */
typedef struct {
    double strategy;              /* -: of VANELOOP_STRATEGY_... */
    double table_input;           /* -: 0 table entered with filtered n_r, 1 with n_dem */
    double trend_alpha;           /* -: fixed gain of the trend's Kalman filter for the demand, per 10 ms */
    double trend_beta;            /* -: and for its rate */
    double trend_rate_on;         /* %/s: rate of demand against the direction that counts as moving */
    double trend_change;          /* %: way back from the farthest demand that turns the direction; half of it while moving */
    double trend_hold;            /* s: for how long both must stand */
    double speed_filter;          /* s: lag of the n_r filter */
    double blend_time;            /* s: full change from one curve to the other */
    double stroke_rate;           /* m/s: fastest stroke demand */
    double stroke_min;            /* m: least stroke demand */
    double stroke_max;            /* m: greatest stroke demand */
    double kp;                    /* A/m: proportional gain */
    double ki;                    /* A/(m s): integral gain */
    double kff;                   /* A/(m/s): feed-forward of the demanded speed */
    double current_limit;         /* A: greatest current */
    double init_time;             /* s: in INIT at least */
    double fail_safe_stroke;      /* m: where FAIL_SAFE goes */
    double fail_safe_current;     /* A: when the LVDT cannot be used */
    double fail_safe_rate;        /* m/s: on the way to the fail-safe stroke */
    double degraded_hold;         /* s: longest presence of a fault's cause in DEGRADED before FAIL_SAFE */
    double recover_time;          /* s: all clear for this long before RUN returns */
    double demand_timeout;        /* s: without a good frame: stale */
    double demand_reject_limit;   /* -: refused frames in the bucket: rejected */
    double demand_reject_leak;    /* 1/s: refused frames forgiven */
    double demand_low;            /* %: least plausible speed of a frame */
    double demand_high;           /* %: greatest plausible speed of a frame */
    double lvdt_low;              /* m: least plausible stroke */
    double lvdt_high;             /* m: greatest plausible stroke */
    double lvdt_rate;             /* m/s: fastest plausible motion */
    double lvdt_debounce;         /* s: of bad samples: fault */
    double lvdt_heal;             /* s: of good samples: healed */
    double stuck_current;         /* A: a current above this must move the piston */
    double stuck_motion;          /* m: less motion than this is none */
    double stuck_time;            /* s: without motion: stuck */
    double stuck_margin;          /* m: from the end stops within which no motion is expected */
    double tracking_limit;        /* m: of the servo's error */
    double tracking_time;         /* s: beyond it: fault */
    double saturated_time;        /* s: at the current's limit: fault */
    double engine_lag;            /* s: the engine as the speed observer knows it */
    double engine_acceleration;   /* %/s: the same */
    double engine_deceleration;   /* %/s: the same */
    double observer_alpha;        /* -: fixed gain of the speed observer for the speed, per 10 ms */
    double observer_beta;         /* -: and for the drift of its rate */
    double observer_band;         /* %: farthest from the filtered speed that the observer may be */
    double play[VANELOOP_STAGES]; /* rad: total play at the vane, as built */
    double lead;                  /* s: delay from the stroke demand to the vane, made up for */
    double look_ahead;            /* s: how early the gap is crossed before the vanes must turn round */
    double turn_band;             /* rad: the vanes' error that is not worth a reversal */
    double turn_noise;            /* -: the same in multiples of the observed speed's noise */
    double pot_low;               /* rad: least plausible reading */
    double pot_high;              /* rad: greatest plausible reading */
    double pot_gate;              /* rad: farthest from its expected value that a reading is believed */
    double pot_trust;             /* rad: over which a reading must have followed the linkage before it is learned from */
    double learn_time;            /* s: time constant of learning */
    double learn_rate;            /* rad/s: fastest change of what is known already */
    double learn_budget;          /* rad: by which what is known may change before the readings must have followed again */
    double apply_rate;            /* rad/s: fastest change of the compensation in use */
    double offset_limit;          /* rad: greatest offset that is learned */
    double width_limit;           /* rad: farthest from the play as built */
    double stages;                /* -: vane stages of the machine, 1 to 8 */
} vaneloop_scalars;

/* What the controller is flashed with. The pointers stay good as long as the controller runs; where an effect changes
 * the flashed tables or gains in a run (docs/effects.md), they change there. */
typedef struct {
    const vaneloop_scalars *scalars;
    int32_t points;           /* of the stroke table */
    const double *speed;      /* %    increasing */
    const double *extension;  /* m    stroke at each speed while the demand rises */
    const double *retraction; /* m    while it falls */
    const double *single;     /* m    mean of both */
    int32_t strokes;          /* points of the angle table */
    const double *stroke;     /* m    increasing */
    const double *angle[VANELOOP_STAGES]; /* rad  of each stage in the middle of its play; NULL: no such stage */
} vaneloop_calibration;

/* A calibration scalar of the controller's own: VaneLoop sets *value before vaneloop_init (own_calibration.toml). */
typedef struct {
    const char *name, *unit, *meaning;
    double *value, low, high; /* *value is the default until it is set */
} vaneloop_own_scalar;

/* A quantity of the controller's own that VaneLoop may read after any step. */
typedef struct {
    const char *name, *unit, *meaning;
    const double *value;
} vaneloop_own_observable;

typedef struct {
    int32_t scalars, observables;
    const vaneloop_own_scalar *scalar;
    const vaneloop_own_observable *observable;
} vaneloop_description;

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
}
#endif

#endif
