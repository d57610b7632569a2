/* Drives an S-function as Simulink does: sizes, start, then outputs and update at every hit. */
#include <stdlib.h>
#include <string.h>

/* inputs [steps, widths side by side] to outputs [steps, widths side by side]; its sample time,
   or -1 where the parameters are not as many as the S-function wants */
double fly(const double *parameter, int given, int steps, const double *inputs, double *outputs) {
    SimStruct S;
    double dt;
    int k, i;
    memset(&S, 0, sizeof S);
    S.given = given ? 1 : 0;
    S.parameter.count = given;
    S.parameter.values = parameter;
    mdlInitializeSizes(&S);
    if (S.parameters != S.given) return -1.0;
    mdlInitializeSampleTimes(&S);
    dt = S.dt;
    S.kept = (double *)calloc((size_t)S.states + 1, sizeof(double));
    S.free_work = (double *)calloc((size_t)S.work + 1, sizeof(double));
    for (i = 0; i < S.inputs; i++)
        S.in[i] = (double *)calloc((size_t)S.width_in[i], sizeof(double));
    for (i = 0; i < S.outputs; i++)
        S.out[i] = (double *)calloc((size_t)S.width_out[i], sizeof(double));
    mdlInitializeConditions(&S);
    for (k = 0; k < steps; k++) {
        for (i = 0; i < S.inputs; i++) {
            memcpy(S.in[i], inputs, (size_t)S.width_in[i] * sizeof(double));
            inputs += S.width_in[i];
        }
        mdlOutputs(&S, 0);
        for (i = 0; i < S.outputs; i++) {
            memcpy(outputs, S.out[i], (size_t)S.width_out[i] * sizeof(double));
            outputs += S.width_out[i];
        }
        mdlUpdate(&S, 0);
    }
    mdlTerminate(&S);
    for (i = 0; i < S.inputs; i++) free(S.in[i]);
    for (i = 0; i < S.outputs; i++) free(S.out[i]);
    free(S.kept);
    free(S.free_work);
    return dt;
}
