/* The face of FMI 2.0, co-simulation. */
#include "fmi2Functions.h"
#include "fmu.h"

#include <stdlib.h>
#include <string.h>

static void say(void *instance, int status, const char *message) {
    Instance *i = instance;
    const fmi2CallbackFunctions *f = i->callback;
    if (f && f->logger) f->logger(f->componentEnvironment, i->name, (fmi2Status)status, "logStatusError", "%s", message);
}

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[]) {
    (void)c, (void)on, (void)n, (void)categories;
    return fmi2OK;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type kind, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging) {
    (void)resources, (void)visible, (void)logging;
    Instance *i = kind == fmi2CoSimulation ? fmu_new(name, guid) : NULL;
    if (!i) {
        if (functions && functions->logger)
            functions->logger(functions->componentEnvironment, name, fmi2Error, "logStatusError",
                              "co-simulation only, with the guid of modelDescription.xml");
        return NULL;
    }
    i->callback = (void *)functions;
    i->log = say;
    return i;
}

void fmi2FreeInstance(fmi2Component c) { fmu_free(c); }

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean exact, fmi2Real tolerance, fmi2Real start, fmi2Boolean ends,
                               fmi2Real stop) {
    (void)exact, (void)tolerance, (void)ends, (void)stop;
    Instance *i = c;
    if (i->state.phase != INSTANTIATED) return (fmi2Status)fmu_refuse(i, "the experiment is set up before the start");
    i->state.begin = start;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    return (fmi2Status)fmu_begin(c, ((Instance *)c)->state.begin);
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return (fmi2Status)fmu_started(c); }

fmi2Status fmi2Terminate(fmi2Component c) {
    ((Instance *)c)->state.phase = TERMINATED;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c) {
    fmu_reset(c);
    return fmi2OK;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real at, fmi2Real step, fmi2Boolean final) {
    (void)final;
    return (fmi2Status)fmu_step(c, at, step);
}

fmi2Status fmi2CancelStep(fmi2Component c) { return (fmi2Status)fmu_refuse(c, "a step is never pending"); }

#define ACCESS(NAME, C, TYPE)                                                                         \
    fmi2Status fmi2Get##NAME(fmi2Component c, const fmi2ValueReference r[], size_t n, C values[]) {       \
        for (size_t q = 0; q < n; q++) {                                                              \
            double value;                                                                             \
            if (fmu_get(c, r[q], TYPE, &value) != OK) return fmi2Error;                               \
            values[q] = (C)value;                                                                     \
        }                                                                                             \
        return fmi2OK;                                                                                \
    }                                                                                                 \
    fmi2Status fmi2Set##NAME(fmi2Component c, const fmi2ValueReference r[], size_t n, const C values[]) { \
        for (size_t q = 0; q < n; q++)                                                                \
            if (fmu_set(c, r[q], TYPE, (double)values[q]) != OK) return fmi2Error;                    \
        return fmi2OK;                                                                                \
    }

ACCESS(Real, fmi2Real, REAL)
ACCESS(Integer, fmi2Integer, WHOLE)
ACCESS(Boolean, fmi2Boolean, TRUTH)

static fmi2Status none(fmi2Component c, size_t n, const char *what) {
    return n ? (fmi2Status)fmu_refuse(c, "this FMU has no %s", what) : fmi2OK;
}

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2String values[]) {
    (void)r, (void)values;
    return none(c, n, "texts");
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2String values[]) {
    (void)r, (void)values;
    return none(c, n, "texts");
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference r[], size_t n,
                                       const fmi2Integer order[], const fmi2Real values[]) {
    (void)r, (void)order, (void)values;
    return none(c, n, "derivatives of inputs");
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference r[], size_t n,
                                        const fmi2Integer order[], fmi2Real values[]) {
    (void)r, (void)order, (void)values;
    return none(c, n, "derivatives of outputs");
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference u[], size_t n,
                                        const fmi2ValueReference k[], size_t known, const fmi2Real seed[],
                                        fmi2Real out[]) {
    (void)u, (void)k, (void)known, (void)seed, (void)out;
    return none(c, n, "directional derivatives");
}

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind s, fmi2Status *value) {
    (void)s, (void)value;
    return (fmi2Status)fmu_refuse(c, "a step is never pending");
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind s, fmi2Real *value) {
    if (s != fmi2LastSuccessfulTime) return fmi2Discard;
    *value = ((Instance *)c)->state.time;
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind s, fmi2Integer *value) {
    (void)c, (void)s, (void)value;
    return fmi2Discard;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind s, fmi2Boolean *value) {
    (void)c;
    if (s != fmi2Terminated) return fmi2Discard;
    *value = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind s, fmi2String *value) {
    (void)c, (void)s, (void)value;
    return fmi2Discard;
}

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) {
    if (!*state) {
        *state = fmu_state(c);
        return *state ? fmi2OK : fmi2Error;
    }
    memcpy(*state, &((Instance *)c)->state, sizeof(State));
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) {
    memcpy(&((Instance *)c)->state, state, sizeof(State));
    return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) {
    (void)c;
    if (!state) return fmi2OK;
    free(*state);
    *state = NULL;
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size) {
    (void)c, (void)state;
    *size = STATE_BYTES;
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
    if (size < STATE_BYTES) return (fmi2Status)fmu_refuse(c, "a state takes %u bytes", (unsigned)STATE_BYTES);
    fmu_to_bytes(state, (unsigned char *)bytes);
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state) {
    if (!*state) *state = malloc(sizeof(State));
    if (!*state) return fmi2Error;
    if (!fmu_from_bytes((const unsigned char *)bytes, size, *state))
        return (fmi2Status)fmu_refuse(c, "not a state of this FMU");
    return fmi2OK;
}
