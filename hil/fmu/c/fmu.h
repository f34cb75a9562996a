/* An FMU of VaneLoop: one instance, whatever the version of FMI. fmi2.c and fmi3.c are its faces.
 *
 * All numbers stand in one memory of doubles: reading, setting and writing down the state is copying it. What happens in
 * a tick of 1 ms is part.c, which is written from the compiled functions of VaneLoop; sizes, variables and the memory as
 * it is at first are model.c.
 */
#ifndef VANELOOP_FMU_H
#define VANELOOP_FMU_H

#include <stddef.h>
#include <stdint.h>

#include "model.h" /* NUMBERS, VARIABLES, WARM_UP, CLOCK, TOKEN */

enum { START, RUN, SHOW, WAKE, CHANGE };                       /* what part.c can be asked for (hil/fmu/kernel.py) */
enum { REAL, WHOLE, TRUTH };                                   /* types of variables */
enum { TIME, INPUT, OUTPUT, FIXED, TUNABLE };                  /* their roles */
enum { INSTANTIATED = 1, INITIALIZING, STEPPING, TERMINATED }; /* where an instance is */
enum { OK, WARNING, DISCARD, ERROR };                          /* as both versions of FMI number their answers */

typedef struct {
    unsigned char type, role;
    int32_t at;                /* its number in the memory, in its own unit */
    int32_t acts;              /* number in SI that follows from it; -1: none */
    double si, ratio;          /* the number is value * si * ratio */
    double low, high;          /* allowed */
    const char *name, *unit;
} Variable;

typedef struct {
    double m[NUMBERS];
    double begin, time; /* s */
    int phase;
    int settled; /* before the start: everything follows from what was set */
    int changed; /* parameters were set since the last tick */
    int shown;   /* the outputs are those of now */
} State;

typedef struct {
    State state;
    char *name;
    void (*log)(void *instance, int status, const char *message);
    void *environment, *callback;
} Instance;

extern const Variable variables[VARIABLES];
extern const double first[NUMBERS];

int serve(uintptr_t answer, uintptr_t error, uintptr_t m, int64_t what, int64_t ticks); /* part.c */

Instance *fmu_new(const char *name, const char *token);
void fmu_free(Instance *i);
void fmu_reset(Instance *i);
int fmu_refuse(Instance *i, const char *format, ...);
int fmu_begin(Instance *i, double start); /* enter the initialization */
int fmu_started(Instance *i);             /* leave it */
int fmu_step(Instance *i, double at, double step);
int fmu_get(Instance *i, uint32_t reference, int type, double *value);
int fmu_set(Instance *i, uint32_t reference, int type, double value);

State *fmu_state(const Instance *i);                              /* a copy */
void fmu_to_bytes(const State *s, unsigned char *bytes);
int fmu_from_bytes(const unsigned char *bytes, size_t size, State *s); /* 0: not a state of this FMU */
#define STATE_BYTES (sizeof(TOKEN) + sizeof(State))

#endif
