/* Adds what numbers and slopes of a step give to the gradient of a matrix, each row for itself. */
static __attribute__((noinline)) void outer(const REAL *restrict from, long count,
    const REAL *restrict slope, long to_count, REAL *restrict sum) {
    for (long i = 0; i < count; i++) {
        V v = *(const U *)(from + i * LANES);
        for (long j = 0; j < to_count; j++)
            *(U *)(sum + (i * to_count + j) * LANES) += v * *(const U *)(slope + j * LANES);
    }
}

/* The slope of the state at a step's end is what came from outside and from the steps after it.
 *
 * What a step leaves stands where the one before it looks: for step 0 that is place ~0 & 1.
 */
void back(const REAL *theta, const REAL *tables, const REAL *own, const REAL *x, const REAL *w,
          const REAL *s, const REAL *q, REAL *held, REAL *gx, const REAL *ga, REAL *gs,
          REAL *pulled, REAL *total, long steps, long width, long first, long last) {
    BLOCKS {
        REAL slope_s[2][ROOM(N_S)], slope_q[2][ROOM(N_Q)];
        memset(slope_q, 0, sizeof slope_q);
        for (long i = 0; i < N_S; i++) EACH
            slope_s[(steps - 1) & 1][i * LANES + l] = AT(gs, N_S, 0)[i * width + l];
        for (long k = steps - 1; k >= 0; k--) {
            slope(AT(x, N_X, k), AT(w, N_W, k), AT(s, N_S, k), AT(q, N_Q, k), AT(own, N_OWN, 0),
                  theta, AT(gx, N_X, k + 1), slope_s[k & 1], slope_q[k & 1], AT(ga, N_A, k),
                  AT(gx, N_X, k), slope_s[~k & 1], slope_q[~k & 1], total + at * N_TOTAL,
                  tables, KEPT(held, N_HELD, k), KEPT(pulled, N_PULLED, k), width);
OUTER
        }
        for (long i = 0; i < N_S; i++) EACH
            AT(gs, N_S, 0)[i * width + l] = slope_s[1][i * LANES + l];
    }
}
