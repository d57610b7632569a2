/* The part of Simulink's simstruc.h that exported S-functions use, by its documentation. */
#ifndef SIMSTRUC_H
#define SIMSTRUC_H
#include <stddef.h>

typedef double real_T;
typedef int int_T;
typedef struct { int count; const double *values; } mxArray;
typedef struct {
    int parameters, given, states, inputs, outputs, work, width_in[4], width_out[4], through[4];
    mxArray parameter;
    double dt, offset, *kept, *free_work, *in[4], *out[4];
} SimStruct;

#define SS_OPTION_EXCEPTION_FREE_CODE 1
#define ssSetNumSFcnParams(S, n) ((S)->parameters = (n))
#define ssGetNumSFcnParams(S) ((S)->parameters)
#define ssGetSFcnParamsCount(S) ((S)->given)
#define ssGetSFcnParam(S, k) (&(S)->parameter)
#define mxGetPr(a) ((a)->values)
#define ssSetNumContStates(S, n) ((void)(S))
#define ssSetNumDiscStates(S, n) ((S)->states = (n))
#define ssSetNumInputPorts(S, n) ((S)->inputs = (n))
#define ssSetInputPortWidth(S, k, n) ((S)->width_in[k] = (n))
#define ssSetInputPortRequiredContiguous(S, k, n) ((void)(S))
#define ssSetInputPortDirectFeedThrough(S, k, n) ((S)->through[k] = (n))
#define ssSetNumOutputPorts(S, n) ((S)->outputs = (n))
#define ssSetOutputPortWidth(S, k, n) ((S)->width_out[k] = (n))
#define ssSetNumSampleTimes(S, n) ((void)(S))
#define ssSetNumRWork(S, n) ((S)->work = (n))
#define ssSetOptions(S, n) ((void)(S))
#define ssSetSampleTime(S, k, t) ((S)->dt = (t))
#define ssSetOffsetTime(S, k, t) ((S)->offset = (t))
#define ssGetRealDiscStates(S) ((S)->kept)
#define ssGetRWork(S) ((S)->free_work)
#define ssGetInputPortSignal(S, k) ((const void *)(S)->in[k])
#define ssGetOutputPortRealSignal(S, k) ((S)->out[k])
#endif
