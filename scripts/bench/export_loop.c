/* Times an exported C file: prints the first call and the mean step in microseconds of CPU time. */
#include "boat.h"
#include <stdio.h>
#include <time.h>
static double now(void) { return 1e6 * (double)clock() / CLOCKS_PER_SEC; }
int main(void) {
    mine_real x[6] = {0, 0, 0, 1, 0, 0}, w[4] = {9, 9, 3, 1}, s[MINE_MEMORY + 1], y[6];
    double begun = now(), first; int k;
    mine_initial_state(s);
    mine_step(x, w, s, y, s);
    first = now() - begun;
    begun = now();
    for (k = 0; k < 200000; k++) { mine_step(x, w, s, y, s); x[3] = y[3] > 1 ? 1 : y[3]; }
    printf("%.3f %.6f\n", first, (now() - begun) / 200000);
    return 0;
}
