/* All steps of some blocks of rows. */
#define AT(array, n, k) (array + (n) * (k) * width + at)
#define KEPT(array, n, k) (array + (at * steps + (k) * LANES) * (n))
#define ROOM(n) (((n) ? (n) : 1) * LANES)
#define BLOCKS for (long at = first * LANES; at < last * LANES; at += LANES)

void fly(const REAL *theta, const REAL *tables, const REAL *own, REAL *x, const REAL *w, REAL *s,
         REAL *q, REAL *a, REAL *held, long keep, long steps, long width, long first, long last)
{
    BLOCKS {
        REAL here[ROOM(N_HELD)];
        for (long k = 0; k < steps; k++) {
            /* without a gradient memories and products of the last step are all that is kept */
            const long from = keep ? k : k & 1, to = keep ? k + 1 : ~k & 1;
            step(AT(x, N_X, k), AT(w, N_W, k), AT(s, N_S, from), AT(q, N_Q, from),
                 AT(own, N_OWN, 0), theta,
                 AT(x, N_X, k + 1), AT(s, N_S, to), AT(q, N_Q, to), AT(a, N_A, k),
                 tables, keep ? KEPT(held, N_HELD, k) : here, 0, width);
        }
    }
}
