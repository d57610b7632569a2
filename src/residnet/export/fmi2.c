/* Co-simulation interface of FMI 2.0. */
#include "instance.h"

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT
#endif

typedef int Status;
typedef unsigned int Reference;
typedef void (*Log)(
    void *environment, const char *name, Status status, const char *category,
    const char *message, ...);
typedef struct {
    Log logger;
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void (*finished)(void *, Status);
    void *environment;
} Callbacks;

static void say(void *environment, int status, const char *message, void *callback) {
    Log log;
    memcpy(&log, &callback, sizeof log);
    log(environment, "model", status,
        status == STATUS_WARNING ? "logStatusWarning" : "logStatusError", message);
}

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }

EXPORT Status fmi2SetDebugLogging(void *m, int on, size_t count, const char *const categories[]) {
    (void)m; (void)on; (void)count; (void)categories;
    return 0;
}

EXPORT void *fmi2Instantiate(
    const char *name, int type, const char *guid, const char *resources,
    const Callbacks *callbacks, int visible, int logging) {
    Instance *m;
    (void)name; (void)resources; (void)visible; (void)logging;
    if (type != 1 || strcmp(guid, FMI_UNIT_TOKEN) != 0) return NULL;
    m = (Instance *)calloc(1, sizeof(Instance));
    if (!m) return NULL;
    m->environment = callbacks->environment;
    if (callbacks->logger) {
        memcpy(&m->callback, &callbacks->logger, sizeof callbacks->logger);
        m->logger = say;
    }
    restart(m);
    return m;
}

EXPORT void fmi2FreeInstance(void *m) { free(m); }

EXPORT Status fmi2SetupExperiment(
    void *instance, int tolerance_defined, double tolerance, double start, int stop_defined,
    double stop) {
    (void)tolerance_defined; (void)tolerance;
    return set_experiment((Instance *)instance, start, stop_defined, stop);
}

EXPORT Status fmi2EnterInitializationMode(void *m) {
    return change_phase((Instance *)m, INSTANTIATED, INITIALIZING);
}

EXPORT Status fmi2ExitInitializationMode(void *instance) {
    return finish_initialization((Instance *)instance);
}

EXPORT Status fmi2Terminate(void *m) {
    return change_phase((Instance *)m, STEPPING, TERMINATED);
}

EXPORT Status fmi2Reset(void *instance) {
    return restart((Instance *)instance);
}

EXPORT Status fmi2GetReal(void *m, const Reference references[], size_t count, double values[]) {
    return get_reals((Instance *)m, references, count, values);
}

EXPORT Status fmi2SetReal(
    void *m, const Reference references[], size_t count, const double values[]) {
    return set_reals((Instance *)m, references, count, values);
}

EXPORT Status fmi2GetBoolean(
    void *instance, const Reference references[], size_t count, int values[]) {
    size_t i;
    for (i = 0; i < count; i++) {
        if (references[i] != OUTSIDE) return refused((Instance *)instance, REFERENCE_REFUSED);
        values[i] = ((Instance *)instance)->outside;
    }
    return 0;
}

EXPORT Status fmi2DoStep(void *instance, double point, double size, int no_set) {
    (void)no_set;
    return advance((Instance *)instance, point, size);
}

EXPORT Status fmi2GetFMUstate(void *instance, void **state) {
    if (!*state) *state = malloc(sizeof(Instance));
    if (!*state) return 3;
    memcpy(*state, instance, sizeof(Instance));
    return 0;
}

EXPORT Status fmi2SetFMUstate(void *instance, void *state) {
    memcpy(instance, state, sizeof(Instance));
    return 0;
}

EXPORT Status fmi2FreeFMUstate(void *m, void **state) {
    (void)m;
    free(*state);
    *state = NULL;
    return 0;
}

EXPORT Status fmi2CancelStep(void *m) { (void)m; return 3; }

/* variables of other types and derivatives: there are none, so that none can be asked for */
#define NONE(name) \
    EXPORT Status name(void *m) { return refused((Instance *)m, REFERENCE_REFUSED); }
NONE(fmi2GetInteger) NONE(fmi2GetString) NONE(fmi2SetInteger) NONE(fmi2SetBoolean)
NONE(fmi2SetString) NONE(fmi2SerializedFMUstateSize) NONE(fmi2SerializeFMUstate)
NONE(fmi2DeSerializeFMUstate) NONE(fmi2GetDirectionalDerivative)
NONE(fmi2SetRealInputDerivatives) NONE(fmi2GetRealOutputDerivatives) NONE(fmi2GetStatus)
NONE(fmi2GetRealStatus) NONE(fmi2GetIntegerStatus) NONE(fmi2GetBooleanStatus)
NONE(fmi2GetStringStatus)
