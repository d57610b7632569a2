/* Blocks of rows as the vector types of gcc and clang: V is a block of numbers, U the same without
 * alignment, I a block of integers or truth values. */
#include <math.h>
#include <string.h>
#if defined(__AVX512F__)
#define BYTES 64
#elif defined(__AVX__)
#define BYTES 32
#else
#define BYTES 16
#endif
#define LANES ((long)(BYTES / sizeof(REAL)))
const long lanes = BYTES / sizeof(REAL);
#define ZERO ((REAL)0)
#define ONE ((REAL)1)
typedef REAL V __attribute__((vector_size(BYTES)));
typedef REAL U __attribute__((vector_size(BYTES), aligned(4), may_alias));
typedef INT I __attribute__((vector_size(BYTES)));
#define ALL(number) ((V){0} + (REAL)(number))
#define EACH for (int l = 0; l < LANES; l++)
#define pick(c, a, b) ((V)(((c) & (I)(a)) | (~(c) & (I)(b))))
