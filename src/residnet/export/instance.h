/* One instance of the exported model, of FMI 2.0. Written by residnet.
   model.h names the model's functions; references 1 to INPUTS are the inputs, 101 and on the
   states, 201 and on the states to start from, 300 is `outside`. */
#include <float.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "model.h"

#define INPUT 1u
#define STATE 101u
#define START 201u
#define OUTSIDE 300u

#define STATUS_OK 0
#define STATUS_WARNING 1
#define STATUS_ERROR 3

/* Phases of an instance; a mask of them says where a function may be called. */
#define INSTANTIATED 1
#define INITIALIZING 2
#define STEPPING 4
#define TERMINATED 8

typedef void (*Logger)(void *environment, int status, const char *message, void *callback);

typedef struct {
    FMI_UNIT_REAL x[FMI_UNIT_STATES], start[FMI_UNIT_STATES], w[FMI_UNIT_INPUTS], s[FMI_UNIT_MEMORY + 1];
    int outside, phase, time_defined, stop_defined;
    double time, stop;
    void *environment, *callback;
    Logger logger;
} Instance;

static const char *const STEP_REFUSED =
    "the communication step is not a multiple of the model's step of " FMI_UNIT_DT_TEXT " s";
static const char *const REFERENCE_REFUSED = "no variable has this value reference";
static const char *const OUTPUT_REFUSED = "an output cannot be set; set its start value";
static const char *const START_REFUSED =
    "start values can be set until the initialization mode is left; reset the instance first";
static const char *const EARLY_STEP_REFUSED =
    "no step before the initialization mode was entered and left";
static const char *const LATE_STEP_REFUSED = "no step beyond the stop time";
static const char *const PHASE_REFUSED = "not allowed in this phase of the instance";
static const char *const TIME_DIFFERS =
    "the communication point is not the end of the step before; the importer's time is used";

static int answer(Instance *m, int status, const char *why) {
    if (m->logger) m->logger(m->environment, status, why, m->callback);
    return status;
}

static int refused(Instance *m, const char *why) { return answer(m, STATUS_ERROR, why); }

static void begin(Instance *m) {
    memcpy(m->x, m->start, sizeof m->x);
    FMI_UNIT_INITIAL_STATE(m->s);
    m->outside = 0;
}

/* Instantiate or reset: all values are those of modelDescription.xml. */
static int restart(Instance *m) {
    memset(m->w, 0, sizeof m->w);
    memset(m->start, 0, sizeof m->start);
    m->time = m->stop = 0.0;
    m->time_defined = m->stop_defined = 0;
    m->phase = INSTANTIATED;
    begin(m);
    return STATUS_OK;
}

static int change_phase(Instance *m, int from, int to) {
    if (!(m->phase & from)) return refused(m, PHASE_REFUSED);
    m->phase = to;
    return STATUS_OK;
}

static int set_experiment(Instance *m, double start, int stop_defined, double stop) {
    if (m->phase != INSTANTIATED) return refused(m, PHASE_REFUSED);
    m->time = start;
    m->time_defined = 1;
    m->stop_defined = stop_defined;
    m->stop = stop;
    return STATUS_OK;
}

static int finish_initialization(Instance *m) {
    if (m->phase != INITIALIZING) return refused(m, PHASE_REFUSED);
    begin(m);
    m->phase = STEPPING;
    return STATUS_OK;
}

static FMI_UNIT_REAL *real_variable(Instance *m, unsigned reference) {
    if (reference >= INPUT && reference < INPUT + FMI_UNIT_INPUTS) return m->w + (reference - INPUT);
    if (reference >= STATE && reference < STATE + FMI_UNIT_STATES) return m->x + (reference - STATE);
    if (reference >= START && reference < START + FMI_UNIT_STATES)
        return m->start + (reference - START);
    return NULL;
}

static int get_reals(Instance *m, const unsigned *references, size_t count, double *values) {
    size_t i;
    for (i = 0; i < count; i++) {
        const FMI_UNIT_REAL *found = real_variable(m, references[i]);
        if (references[i] == 0u) values[i] = m->time;
        else if (found) values[i] = (double)*found;
        else return refused(m, REFERENCE_REFUSED);
    }
    return STATUS_OK;
}

/* Set all values or, where one may not be set, none. */
static int set_reals(Instance *m, const unsigned *references, size_t count, const double *values) {
    size_t i;
    if (m->phase == TERMINATED) return refused(m, PHASE_REFUSED);
    for (i = 0; i < count; i++) {
        if (!real_variable(m, references[i])) return refused(m, REFERENCE_REFUSED);
        if (references[i] >= STATE && references[i] < START) return refused(m, OUTPUT_REFUSED);
        if (references[i] >= START && m->phase == STEPPING) return refused(m, START_REFUSED);
    }
    for (i = 0; i < count; i++)
        *real_variable(m, references[i]) = (FMI_UNIT_REAL)values[i];
    /* until the first step the outputs are the start values */
    if (m->phase != STEPPING) begin(m);
    return STATUS_OK;
}

/* Advance from a communication point by a communication step.

   A point in Unix time is rounded to 2.4e-7 s, and so is a step that is the difference of two
   points: what may differ has a share of the model's step and a share of the time. */
static int advance(Instance *m, double point, double size) {
    const double steps = size / FMI_UNIT_DT;
    const double rounding = 4.0 * DBL_EPSILON * (fabs(point) + fabs(size));
    const double tolerance = 1e-6 * FMI_UNIT_DT + rounding;
    long k, n;
    int status = STATUS_OK;
    if (m->phase != STEPPING)
        return refused(m, m->phase == TERMINATED ? PHASE_REFUSED : EARLY_STEP_REFUSED);
    if (!(steps >= 0.5 && steps < 1e9)) return refused(m, STEP_REFUSED);
    n = (long)floor(steps + 0.5);
    /* where time resolves the step no more, every size would be a multiple */
    if (!(tolerance < 0.1 * FMI_UNIT_DT)) return refused(m, STEP_REFUSED);
    if (fabs(size - (double)n * FMI_UNIT_DT) > tolerance)
        return refused(m, STEP_REFUSED);
    if (m->stop_defined && point + size > m->stop + tolerance) return refused(m, LATE_STEP_REFUSED);
    if (m->time_defined && fabs(point - m->time) > tolerance)
        status = answer(m, STATUS_WARNING, TIME_DIFFERS);
    m->outside = 0;
    for (k = 0; k < n; k++)
        if (FMI_UNIT_STEP(m->x, m->w, m->s, m->x, m->s)) m->outside = 1;
    m->time = point + size;
    m->time_defined = 1;
    return status;
}
