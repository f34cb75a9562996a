/* The face of FMI 3.0, co-simulation. */
#include "fmi3Functions.h"
#include "fmu.h"

#include <stdlib.h>
#include <string.h>

static void say(void *instance, int status, const char *message) {
    Instance *i = instance;
    fmi3LogMessageCallback log;
    memcpy(&log, &i->callback, sizeof log);
    if (log) log(i->environment, (fmi3Status)status, "logStatusError", message);
}

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean on, size_t n, const fmi3String categories[]) {
    (void)instance, (void)on, (void)n, (void)categories;
    return fmi3OK;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early,
                                         const fmi3ValueReference required[], size_t n,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update) {
    (void)resources, (void)visible, (void)logging, (void)events, (void)early, (void)required, (void)n, (void)update;
    Instance *i = fmu_new(name, token);
    if (!i) {
        if (log) log(environment, fmi3Error, "logStatusError", "the instantiation token is another FMU's");
        return NULL;
    }
    memcpy(&i->callback, &log, sizeof log);
    i->environment = environment;
    i->log = say;
    return i;
}

void fmi3FreeInstance(fmi3Instance instance) { fmu_free(instance); }

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean exact, fmi3Float64 tolerance,
                                       fmi3Float64 start, fmi3Boolean ends, fmi3Float64 stop) {
    (void)exact, (void)tolerance, (void)ends, (void)stop;
    return (fmi3Status)fmu_begin(instance, start);
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) { return (fmi3Status)fmu_started(instance); }

fmi3Status fmi3Terminate(fmi3Instance instance) {
    ((Instance *)instance)->state.phase = TERMINATED;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance instance) {
    fmu_reset(instance);
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 at, fmi3Float64 step, fmi3Boolean final, fmi3Boolean *event,
                      fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *reached) {
    (void)final;
    int status = fmu_step(instance, at, step);
    *event = *terminate = *early = fmi3False;
    *reached = ((Instance *)instance)->state.time;
    return (fmi3Status)status;
}

#define ACCESS(NAME, C, TYPE)                                                                                          \
    fmi3Status fmi3Get##NAME(fmi3Instance instance, const fmi3ValueReference r[], size_t n, C values[], size_t many) { \
        if (many != n) return (fmi3Status)fmu_refuse(instance, "%s: all variables are scalars", "fmi3Get" #NAME);      \
        for (size_t q = 0; q < n; q++) {                                                                               \
            double value;                                                                                              \
            if (fmu_get(instance, r[q], TYPE, &value) != OK) return fmi3Error;                                         \
            values[q] = (C)value;                                                                                      \
        }                                                                                                              \
        return fmi3OK;                                                                                                 \
    }                                                                                                                  \
    fmi3Status fmi3Set##NAME(fmi3Instance instance, const fmi3ValueReference r[], size_t n, const C values[],          \
                             size_t many) {                                                                            \
        if (many != n) return (fmi3Status)fmu_refuse(instance, "%s: all variables are scalars", "fmi3Set" #NAME);      \
        for (size_t q = 0; q < n; q++)                                                                                 \
            if (fmu_set(instance, r[q], TYPE, (double)values[q]) != OK) return fmi3Error;                              \
        return fmi3OK;                                                                                                 \
    }

ACCESS(Float64, fmi3Float64, REAL)
ACCESS(Int32, fmi3Int32, WHOLE)
ACCESS(Boolean, fmi3Boolean, TRUTH)

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *state) {
    if (!*state) {
        *state = fmu_state(instance);
        return *state ? fmi3OK : fmi3Error;
    }
    memcpy(*state, &((Instance *)instance)->state, sizeof(State));
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState state) {
    memcpy(&((Instance *)instance)->state, state, sizeof(State));
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *state) {
    (void)instance;
    if (!state) return fmi3OK;
    free(*state);
    *state = NULL;
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState state, size_t *size) {
    (void)instance, (void)state;
    *size = STATE_BYTES;
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState state, fmi3Byte bytes[], size_t size) {
    if (size < STATE_BYTES) return (fmi3Status)fmu_refuse(instance, "a state takes %u bytes", (unsigned)STATE_BYTES);
    fmu_to_bytes(state, bytes);
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte bytes[], size_t size, fmi3FMUState *state) {
    if (!*state) *state = malloc(sizeof(State));
    if (!*state) return fmi3Error;
    if (!fmu_from_bytes(bytes, size, *state)) return (fmi3Status)fmu_refuse(instance, "not a state of this FMU");
    return fmi3OK;
}
