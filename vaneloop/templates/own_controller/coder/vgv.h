/* A model as a code generator writes it (Simulink Embedded Coder): inputs in X_U, outputs in X_Y, X_initialize, and one
 * X_step for each rate, named by its task identifier. Put your own generated files here instead. */
#ifndef VGV_H
#define VGV_H

typedef double real_T;
typedef int int_T;

typedef struct {
    real_T n_dem, n_r, fresh, request; /* %, %, 1 = a good frame came, 1 = run */
    real_T x_lvdt;                     /* m */
} ExtU_vgv_T;

typedef struct {
    real_T i_cmd, x_dem, mode; /* A, m */
} ExtY_vgv_T;

typedef struct {
    real_T kp, ki, limit;                /* A/m, A/(m s), A */
    real_T low, high, fail_safe, rate;   /* m, m, m, m/s */
    int_T points;
    const real_T *speed, *stroke;        /* %, m */
} P_vgv_T;

extern ExtU_vgv_T vgv_U;
extern ExtY_vgv_T vgv_Y;
extern P_vgv_T vgv_P;

void vgv_initialize(void);
void vgv_step(int_T tid); /* 0: every 1 ms, 1: every 10 ms */
void vgv_terminate(void);

#endif
