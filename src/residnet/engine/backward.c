/* Add the outer product of a factor and a cotangent to the gradient of a matrix, for each row. */
static __attribute__((noinline)) void outer(const REAL *restrict from, long count,
    const REAL *restrict cotangent, long to_count, REAL *restrict sum) {
    for (long i = 0; i < count; i++) {
        V v = *(const U *)(from + i * LANES);
        for (long j = 0; j < to_count; j++)
            *(U *)(sum + (i * to_count + j) * LANES) += v * *(const U *)(cotangent + j * LANES);
    }
}

/* Compute the gradient of some blocks of rows, from the last step to the first.
 *
 * gx, ga and gs are the cotangents of states, applied inputs and final memory that the caller gives;
 * gx and gs receive those of the initial values. The cotangent of the state at the end of a step is
 * the one that the caller gives plus the one from later steps. Two buffers of memory cotangents
 * alternate: step k reads buffer k & 1 and writes buffer ~k & 1, which step k - 1 reads.
 */
void run_backward(const REAL *theta, const REAL *tables, const REAL *row_values, const REAL *x,
                  const REAL *w, const REAL *s, const REAL *q, REAL *history, REAL *gx,
                  const REAL *ga, REAL *gs, REAL *product_cotangents, REAL *gradient, long steps,
                  long width, long first, long last) {
    BLOCKS {
        REAL cotangent_s[2][SIZE(N_S)], cotangent_q[2][SIZE(N_Q)];
        memset(cotangent_q, 0, sizeof cotangent_q);
        for (long i = 0; i < N_S; i++) EACH
            cotangent_s[(steps - 1) & 1][i * LANES + l] = AT(gs, N_S, 0)[i * width + l];
        for (long k = steps - 1; k >= 0; k--) {
            step_vjp(AT(x, N_X, k), AT(w, N_W, k), AT(s, N_S, k), AT(q, N_Q, k),
                     AT(row_values, N_ROW_VALUES, 0), theta,
                     AT(gx, N_X, k + 1), cotangent_s[k & 1], cotangent_q[k & 1], AT(ga, N_A, k),
                     AT(gx, N_X, k), cotangent_s[~k & 1], cotangent_q[~k & 1],
                     gradient + at * N_GRADIENT, tables, STORED(history, N_HISTORY, k),
                     STORED(product_cotangents, N_PRODUCT_COTANGENTS, k), width);
OUTER
        }
        for (long i = 0; i < N_S; i++) EACH
            AT(gs, N_S, 0)[i * width + l] = cotangent_s[1][i * LANES + l];
    }
}
