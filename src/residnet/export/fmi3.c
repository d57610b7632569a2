/* Co-simulation interface of FMI 3.0. */
#include <stdbool.h>
#include <stdint.h>

#include "instance.h"

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT
#endif

typedef int Status;
typedef void (*Log)(void *environment, Status status, const char *category, const char *message);

static void say(void *environment, int status, const char *message, void *callback) {
    Log log;
    memcpy(&log, &callback, sizeof log);
    log(environment, status,
        status == STATUS_WARNING ? "logStatusWarning" : "logStatusError", message);
}

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

EXPORT Status fmi3SetDebugLogging(void *m, bool on, size_t count, const char *const categories[]) {
    (void)m; (void)on; (void)count; (void)categories;
    return 0;
}

EXPORT void *fmi3InstantiateCoSimulation(
    const char *name, const char *token, const char *resources, bool visible, bool logging,
    bool event_mode, bool early_return, const uint32_t required[], size_t required_count,
    void *environment, Log log, void *update) {
    Instance *m;
    (void)name; (void)resources; (void)visible; (void)logging; (void)event_mode;
    (void)early_return; (void)required; (void)required_count; (void)update;
    if (strcmp(token, FMU_MODEL_TOKEN) != 0) return NULL;
    m = (Instance *)calloc(1, sizeof(Instance));
    if (!m) return NULL;
    m->environment = environment;
    if (log) {
        memcpy(&m->callback, &log, sizeof log);
        m->logger = say;
    }
    restart(m);
    return m;
}

EXPORT void *fmi3InstantiateModelExchange(
    const char *name, const char *token, const char *resources, bool visible, bool logging,
    void *environment, Log log) {
    (void)name; (void)token; (void)resources; (void)visible; (void)logging; (void)environment;
    (void)log;
    return NULL;
}

EXPORT void *fmi3InstantiateScheduledExecution(
    const char *name, const char *token, const char *resources, bool visible, bool logging,
    void *environment, Log log, void *update, void *lock, void *unlock) {
    (void)name; (void)token; (void)resources; (void)visible; (void)logging; (void)environment;
    (void)log; (void)update; (void)lock; (void)unlock;
    return NULL;
}

EXPORT void fmi3FreeInstance(void *m) { free(m); }

EXPORT Status fmi3EnterInitializationMode(
    void *instance, bool tolerance_defined, double tolerance, double start, bool stop_defined,
    double stop) {
    Instance *m = (Instance *)instance;
    const Status status = set_experiment(m, start, stop_defined, stop);
    (void)tolerance_defined; (void)tolerance;
    return status ? status : change_phase(m, INSTANTIATED, INITIALIZING);
}

EXPORT Status fmi3ExitInitializationMode(void *instance) {
    return finish_initialization((Instance *)instance);
}

EXPORT Status fmi3EnterConfigurationMode(void *m) { (void)m; return 0; }
EXPORT Status fmi3ExitConfigurationMode(void *m) { (void)m; return 0; }
EXPORT Status fmi3EnterEventMode(void *m) { (void)m; return 3; }
EXPORT Status fmi3EnterStepMode(void *m) { (void)m; return 3; }
EXPORT Status fmi3Terminate(void *m) {
    return change_phase((Instance *)m, STEPPING, TERMINATED);
}

EXPORT Status fmi3Reset(void *instance) {
    return restart((Instance *)instance);
}

EXPORT Status fmi3GetFloat64(
    void *m, const uint32_t references[], size_t count, double values[], size_t value_count) {
    if (count != value_count) return refused((Instance *)m, REFERENCE_REFUSED);
    return get_reals((Instance *)m, references, count, values);
}

EXPORT Status fmi3SetFloat64(
    void *m, const uint32_t references[], size_t count, const double values[],
    size_t value_count) {
    if (count != value_count) return refused((Instance *)m, REFERENCE_REFUSED);
    return set_reals((Instance *)m, references, count, values);
}

EXPORT Status fmi3GetBoolean(
    void *instance, const uint32_t references[], size_t count, bool values[],
    size_t value_count) {
    size_t i;
    (void)value_count;
    for (i = 0; i < count; i++) {
        if (references[i] != OUTSIDE) return refused((Instance *)instance, REFERENCE_REFUSED);
        values[i] = ((Instance *)instance)->outside != 0;
    }
    return 0;
}

EXPORT Status fmi3DoStep(
    void *instance, double point, double size, bool no_set, bool *event, bool *terminate,
    bool *early, double *last) {
    Instance *m = (Instance *)instance;
    Status status;
    (void)no_set;
    *event = *terminate = *early = false;
    status = advance(m, point, size);
    *last = m->time;
    return status;
}

EXPORT Status fmi3GetFMUState(void *instance, void **state) {
    if (!*state) *state = malloc(sizeof(Instance));
    if (!*state) return 3;
    memcpy(*state, instance, sizeof(Instance));
    return 0;
}

EXPORT Status fmi3SetFMUState(void *instance, void *state) {
    memcpy(instance, state, sizeof(Instance));
    return 0;
}

EXPORT Status fmi3FreeFMUState(void *m, void **state) {
    (void)m;
    free(*state);
    *state = NULL;
    return 0;
}

/* variables of other types, clocks and derivatives: there are none, so that none can be asked for */
#define NONE(name) \
    EXPORT Status name(void *m) { return refused((Instance *)m, REFERENCE_REFUSED); }
NONE(fmi3GetFloat32) NONE(fmi3GetInt8) NONE(fmi3GetUInt8) NONE(fmi3GetInt16) NONE(fmi3GetUInt16)
NONE(fmi3GetInt32) NONE(fmi3GetUInt32) NONE(fmi3GetInt64) NONE(fmi3GetUInt64) NONE(fmi3GetString)
NONE(fmi3GetBinary) NONE(fmi3GetClock) NONE(fmi3SetFloat32) NONE(fmi3SetInt8) NONE(fmi3SetUInt8)
NONE(fmi3SetInt16) NONE(fmi3SetUInt16) NONE(fmi3SetInt32) NONE(fmi3SetUInt32) NONE(fmi3SetInt64)
NONE(fmi3SetUInt64) NONE(fmi3SetBoolean) NONE(fmi3SetString) NONE(fmi3SetBinary)
NONE(fmi3SetClock) NONE(fmi3GetNumberOfVariableDependencies) NONE(fmi3GetVariableDependencies)
NONE(fmi3SerializedFMUStateSize) NONE(fmi3SerializeFMUState) NONE(fmi3DeserializeFMUState)
NONE(fmi3GetDirectionalDerivative) NONE(fmi3GetAdjointDerivative)
NONE(fmi3GetIntervalDecimal) NONE(fmi3GetIntervalFraction) NONE(fmi3GetShiftDecimal)
NONE(fmi3GetShiftFraction) NONE(fmi3SetIntervalDecimal) NONE(fmi3SetIntervalFraction)
NONE(fmi3SetShiftDecimal) NONE(fmi3SetShiftFraction) NONE(fmi3EvaluateDiscreteStates)
NONE(fmi3UpdateDiscreteStates) NONE(fmi3EnterContinuousTimeMode)
NONE(fmi3CompletedIntegratorStep) NONE(fmi3SetTime) NONE(fmi3SetContinuousStates)
NONE(fmi3GetContinuousStateDerivatives) NONE(fmi3GetEventIndicators)
NONE(fmi3GetContinuousStates) NONE(fmi3GetNominalsOfContinuousStates)
NONE(fmi3GetNumberOfEventIndicators) NONE(fmi3GetNumberOfContinuousStates)
NONE(fmi3GetOutputDerivatives) NONE(fmi3ActivateModelPartition)
