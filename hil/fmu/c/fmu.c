/* One instance: its phases, its variables, its steps. */
#include "fmu.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define TICKS_PER_S 1000.0
#define EARLY 1e-6 /* of a tick: a step that ends there ends with the tick */

static void ask(Instance *i, int64_t what, int64_t ticks) {
    uint64_t answer[2] = {0, 0}, error[2] = {0, 0};
    serve((uintptr_t)answer, (uintptr_t)error, (uintptr_t)i->state.m, what, ticks);
}

int fmu_refuse(Instance *i, const char *format, ...) {
    char line[512];
    va_list rest;
    va_start(rest, format);
    vsnprintf(line, sizeof line, format, rest);
    va_end(rest);
    if (i->log) i->log(i, ERROR, line);
    return ERROR;
}

Instance *fmu_new(const char *name, const char *token) {
    if (!name || !token || strcmp(token, TOKEN)) return NULL;
    Instance *i = calloc(1, sizeof *i);
    if (!i) return NULL;
    i->name = malloc(strlen(name) + 1);
    if (!i->name) {
        free(i);
        return NULL;
    }
    strcpy(i->name, name);
    fmu_reset(i);
    return i;
}

void fmu_free(Instance *i) {
    if (!i) return;
    free(i->name);
    free(i);
}

void fmu_reset(Instance *i) {
    memset(&i->state, 0, sizeof i->state);
    memcpy(i->state.m, first, sizeof first);
    i->state.phase = INSTANTIATED;
}

/* Put everything to where it is at the start, as far as it is known. */
static void settle(Instance *i) {
    if (i->state.settled) return;
    ask(i, START, 0);
    if (WARM_UP) ask(i, RUN, WARM_UP);
    i->state.settled = 1;
    i->state.changed = i->state.shown = 0;
}

static void take_over(Instance *i) {
    if (!i->state.changed) return;
    ask(i, CHANGE, 0);
    i->state.changed = 0;
}

int fmu_begin(Instance *i, double start) {
    if (i->state.phase != INSTANTIATED) return fmu_refuse(i, "the initialization can only be entered once");
    if (!isfinite(start)) return fmu_refuse(i, "start time (=%g s) must be finite", start);
    i->state.begin = i->state.time = start;
    i->state.phase = INITIALIZING;
    return OK;
}

int fmu_started(Instance *i) {
    if (i->state.phase != INITIALIZING) return fmu_refuse(i, "the initialization was not entered");
    settle(i);
    i->state.phase = STEPPING;
    return OK;
}

int fmu_step(Instance *i, double at, double step) {
    State *s = &i->state;
    if (s->phase != STEPPING) return fmu_refuse(i, "a step needs an initialized instance");
    if (!(fabs(at - s->time) <= 1e-9 * (1.0 + fabs(s->time))))
        return fmu_refuse(i, "communication point (=%.9g s) must be %.9g s, the end of the last step", at, s->time);
    if (!(step > 0.0 && step < 1e9)) return fmu_refuse(i, "step size (=%g s) must be above 0", step);
    take_over(i);
    int64_t due = (int64_t)floor((at + step - s->begin) * TICKS_PER_S + EARLY);
    int64_t done = (int64_t)s->m[CLOCK];
    if (due > done) {
        ask(i, RUN, due - done);
        s->shown = 0;
    }
    s->time = at + step;
    return OK;
}

static const Variable *known(Instance *i, uint32_t reference, int type) {
    if (reference >= VARIABLES) {
        fmu_refuse(i, "value reference %u is unknown", reference);
        return NULL;
    }
    if (variables[reference].type != type) {
        fmu_refuse(i, "%s (value reference %u) is of another type", variables[reference].name, reference);
        return NULL;
    }
    return &variables[reference];
}

int fmu_get(Instance *i, uint32_t reference, int type, double *value) {
    const Variable *v = known(i, reference, type);
    State *s = &i->state;
    if (!v) return ERROR;
    if (v->role == TIME) {
        *value = s->time;
        return OK;
    }
    if (v->role == OUTPUT && s->phase != INSTANTIATED) {
        if (s->phase == INITIALIZING) settle(i);
        take_over(i);
        if (!s->shown) ask(i, SHOW, 0);
        s->shown = 1;
    }
    *value = s->m[v->at];
    return OK;
}

int fmu_set(Instance *i, uint32_t reference, int type, double value) {
    const Variable *v = known(i, reference, type);
    State *s = &i->state;
    if (!v) return ERROR;
    if (v->role == TIME || v->role == OUTPUT) return fmu_refuse(i, "%s cannot be set", v->name);
    if (s->phase == TERMINATED) return fmu_refuse(i, "%s: the instance has ended", v->name);
    if (v->role == FIXED && s->phase == STEPPING && value != s->m[v->at])
        return fmu_refuse(i, "%s is fixed: it can be set before the start only", v->name);
    int open = v->role == INPUT && isnan(value) && isnan(v->low); /* a sensor that is not fitted */
    if (!open && !((isnan(v->low) || v->low <= value) && (isnan(v->high) || value <= v->high) && isfinite(value)))
        return fmu_refuse(i, "%s (=%g %s) must be in [%g, %g]", v->name, value, v->unit, v->low, v->high);
    if (value == s->m[v->at]) return OK;
    if (s->phase == STEPPING && v->acts >= 0 && !s->changed) {
        ask(i, WAKE, 0);
        s->changed = 1;
    }
    s->m[v->at] = value;
    if (v->acts >= 0) s->m[v->acts] = value * v->si * v->ratio;
    s->settled = s->phase == STEPPING;
    s->shown = 0;
    return OK;
}

State *fmu_state(const Instance *i) {
    State *s = malloc(sizeof *s);
    if (s) memcpy(s, &i->state, sizeof *s);
    return s;
}

void fmu_to_bytes(const State *s, unsigned char *bytes) {
    memcpy(bytes, TOKEN, sizeof(TOKEN));
    memcpy(bytes + sizeof(TOKEN), s, sizeof *s);
}

int fmu_from_bytes(const unsigned char *bytes, size_t size, State *s) {
    if (size != STATE_BYTES || memcmp(bytes, TOKEN, sizeof(TOKEN))) return 0;
    memcpy(s, bytes + sizeof(TOKEN), sizeof *s);
    return 1;
}
