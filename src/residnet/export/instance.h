/* One instance of the exported model, common to FMI 2.0 and 3.0. Written by residnet.
   model.h names the model's functions; references 1 to INPUTS are the inputs, 101 and on the
   states, 201 and on the states to start from, 300 is `outside`. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "model.h"

#define INPUT 1u
#define STATE 101u
#define START 201u
#define OUTSIDE 300u

typedef void (*Logger)(void *environment, int status, const char *message, void *callback);

typedef struct {
    MODEL_REAL x[MODEL_STATES], start[MODEL_STATES], w[MODEL_INPUTS], s[MODEL_MEMORY + 1];
    int outside;
    double time;
    void *environment, *callback;
    Logger logger;
} Instance;

static const char *const STEP_REFUSED =
    "the communication step is not a multiple of the model's step of " MODEL_DT_TEXT " s";
static const char *const REFERENCE_REFUSED = "no variable has this value reference";

static int refused(Instance *m, const char *why) {
    if (m->logger) m->logger(m->environment, 3, why, m->callback);
    return 3;
}

static void begin(Instance *m) {
    memcpy(m->x, m->start, sizeof m->x);
    MODEL_INITIAL_STATE(m->s);
    m->outside = 0;
}

static MODEL_REAL *real_variable(Instance *m, unsigned reference) {
    if (reference >= INPUT && reference < INPUT + MODEL_INPUTS) return m->w + (reference - INPUT);
    if (reference >= STATE && reference < STATE + MODEL_STATES) return m->x + (reference - STATE);
    if (reference >= START && reference < START + MODEL_STATES)
        return m->start + (reference - START);
    return NULL;
}

static int get_reals(Instance *m, const unsigned *references, size_t count, double *values) {
    size_t i;
    for (i = 0; i < count; i++) {
        const MODEL_REAL *found = real_variable(m, references[i]);
        if (references[i] == 0u) values[i] = m->time;
        else if (found) values[i] = (double)*found;
        else return refused(m, REFERENCE_REFUSED);
    }
    return 0;
}

static int set_reals(Instance *m, const unsigned *references, size_t count, const double *values) {
    size_t i;
    for (i = 0; i < count; i++) {
        MODEL_REAL *found = real_variable(m, references[i]);
        if (!found || (references[i] >= STATE && references[i] < START))
            return refused(m, REFERENCE_REFUSED);
        *found = (MODEL_REAL)values[i];
    }
    return 0;
}

static int advance(Instance *m, double size) {
    const double steps = size / MODEL_DT;
    long k, n;
    if (!(steps >= 0.5 && steps < 1e9)) return refused(m, STEP_REFUSED);
    n = (long)floor(steps + 0.5);
    if (fabs(steps - (double)n) > 1e-6) return refused(m, STEP_REFUSED);
    m->outside = 0;
    for (k = 0; k < n; k++)
        if (MODEL_STEP(m->x, m->w, m->s, m->x, m->s)) m->outside = 1;
    m->time += size;
    return 0;
}
