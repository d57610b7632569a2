/* Run all steps of some blocks of rows.
 *
 * AT: entries at step k of an array [steps, n, width]. STORED: values that step k stores for the
 * gradient. SIZE: size of a local array, at least one block. */
#define AT(array, n, k) (array + (n) * (k) * width + at)
#define STORED(array, n, k) (array + (at * steps + (k) * LANES) * (n))
#define SIZE(n) (((n) ? (n) : 1) * LANES)
#define BLOCKS for (long at = first * LANES; at < last * LANES; at += LANES)

void run_forward(const REAL *theta, const REAL *tables, const REAL *row_values, REAL *x,
                 const REAL *w, REAL *s, REAL *q, REAL *a, REAL *history, long keep_history,
                 long steps, long width, long first, long last)
{
    BLOCKS {
        REAL scratch[SIZE(N_HISTORY)];
        for (long k = 0; k < steps; k++) {
            /* without a gradient only the memories and products of the last step are stored */
            const long from = keep_history ? k : k & 1, to = keep_history ? k + 1 : ~k & 1;
            step(AT(x, N_X, k), AT(w, N_W, k), AT(s, N_S, from), AT(q, N_Q, from),
                 AT(row_values, N_ROW_VALUES, 0), theta,
                 AT(x, N_X, k + 1), AT(s, N_S, to), AT(q, N_Q, to), AT(a, N_A, k),
                 tables, keep_history ? STORED(history, N_HISTORY, k) : scratch, 0, width);
        }
    }
}
