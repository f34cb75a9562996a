/* See vgv.h. One curve, PI; DEGRADED after 50 ms without a frame, FAIL_SAFE after 550 ms. */
#include "vgv.h"

ExtU_vgv_T vgv_U;
ExtY_vgv_T vgv_Y;
P_vgv_T vgv_P;

static struct {
    real_T goal, integral, age, good;
    int_T begun, seen;
} vgv_DW;

void vgv_initialize(void) {
    vgv_DW.goal = vgv_DW.integral = vgv_DW.good = 0.0;
    vgv_DW.age = 1.0;
    vgv_DW.begun = vgv_DW.seen = 0;
    vgv_Y.i_cmd = vgv_Y.x_dem = vgv_Y.mode = 0.0;
}

static real_T limited(real_T v, real_T low, real_T high) { return v < low ? low : v > high ? high : v; }

static void vgv_step0(void) { /* 1 ms: age of the demand, mode, PI */
    real_T x = vgv_U.x_lvdt, e, i;
    if (!(x > -0.01 && x < 0.1)) x = vgv_Y.x_dem; /* no number, or no stroke */
    if (!vgv_DW.begun) vgv_Y.x_dem = vgv_DW.goal = limited(x, vgv_P.low, vgv_P.high);
    vgv_DW.begun = 1;
    vgv_DW.age = vgv_U.fresh > 0.5 ? 0.0 : vgv_DW.age + 0.001;
    vgv_DW.seen |= vgv_U.fresh > 0.5;
    vgv_DW.good = vgv_DW.age < 0.05 ? vgv_DW.good + 0.001 : 0.0;
    if (!vgv_DW.seen || (vgv_U.request < 0.5 && vgv_DW.age < 0.05))
        vgv_Y.mode = 1.0; /* STANDBY */
    else if (vgv_DW.age >= 0.55)
        vgv_Y.mode = 4.0; /* FAIL_SAFE */
    else if (vgv_DW.age >= 0.05 && vgv_Y.mode != 4.0)
        vgv_Y.mode = 3.0; /* DEGRADED */
    else if (vgv_DW.good >= 0.5 || vgv_Y.mode <= 1.0)
        vgv_Y.mode = 2.0; /* RUN */
    vgv_Y.x_dem += limited(vgv_DW.goal - vgv_Y.x_dem, -0.001 * vgv_P.rate, 0.001 * vgv_P.rate);
    e = vgv_Y.x_dem - x;
    vgv_DW.integral = limited(vgv_DW.integral + 0.001 * vgv_P.ki * e, -vgv_P.limit, vgv_P.limit);
    i = vgv_P.kp * e + vgv_DW.integral;
    vgv_Y.i_cmd = limited(i, -vgv_P.limit, vgv_P.limit);
}

static void vgv_step1(void) { /* 10 ms: the table */
    int_T k = 1;
    real_T n = limited(vgv_U.n_r, vgv_P.speed[0], vgv_P.speed[vgv_P.points - 1]), share;
    if (vgv_Y.mode == 4.0) {
        vgv_DW.goal = vgv_P.fail_safe;
        return;
    }
    if (vgv_Y.mode != 2.0) return;
    while (k < vgv_P.points - 1 && vgv_P.speed[k] < n) k++;
    share = (n - vgv_P.speed[k - 1]) / (vgv_P.speed[k] - vgv_P.speed[k - 1]);
    vgv_DW.goal = vgv_P.stroke[k - 1] + share * (vgv_P.stroke[k] - vgv_P.stroke[k - 1]);
    vgv_DW.goal = limited(vgv_DW.goal, vgv_P.low, vgv_P.high);
}

void vgv_step(int_T tid) {
    if (tid == 0)
        vgv_step0();
    else
        vgv_step1();
}

void vgv_terminate(void) {}
