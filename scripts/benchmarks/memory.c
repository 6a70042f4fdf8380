/* Random problems through every function, for sanitisers and valgrind. */
#include "dlo_solver.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#define COUNT 16

static double uniform(unsigned long *state)
{
    *state = (*state * 6364136223846793005UL + 1442695040888963407UL) & 0xffffffffffffffffUL;
    return (double)(*state >> 11) / 9007199254740992.0;
}

int main(int argc, char **argv)
{
    const long problems = argc > 1 ? atol(argv[1]) : 1000;
    /* Of the exact size, so that a step beyond it is seen. */
    double *work = malloc(DLO_WORKSPACE_SIZE * sizeof *work);
    dlo_shape *shapes = malloc(COUNT * sizeof *shapes);
    dlo_slope *slope = malloc(sizeof *slope);
    unsigned long state = 1;
    long counts[7] = {0, 0, 0, 0, 0, 0, 0}, k;
    for (k = 0; k < problems; ++k) {
        dlo_pose poses[COUNT];
        dlo_status statuses[COUNT];
        size_t jump, i;
        for (i = 0; i < COUNT; ++i) {
            const double r = 1.02 * DLO_LENGTH * sqrt(uniform(&state));
            const double a = 6.283185307179586 * uniform(&state);
            poses[i].start[0] = poses[i].start[1] = 0.0;
            poses[i].end[0] = uniform(&state) < 0.01 ? NAN : r * cos(a);
            poses[i].end[1] = r * sin(a);
            poses[i].start_heading = 3.0 * uniform(&state) - 1.5;
            poses[i].end_heading = 3.0 * uniform(&state) - 1.5;
        }
        dlo_batch(poses, COUNT, (dlo_branch)(k % 3), shapes, statuses, work, DLO_WORKSPACE_SIZE);
        for (i = 0; i < COUNT; ++i) {
            ++counts[statuses[i]];
            dlo_sensitivity(poses + i, shapes + i, slope, work, DLO_WORKSPACE_SIZE);
            dlo_solve(poses + i, DLO_CW, shapes + i, shapes + i, work, DLO_WORKSPACE_SIZE);
        }
        dlo_path(poses, 4, DLO_CCW, 0, shapes, statuses, &jump, work, DLO_WORKSPACE_SIZE);
        dlo_solve(poses, DLO_CW, 0, shapes, work, DLO_WORKSPACE_SIZE - 1);
    }
    for (k = 0; k < 7; ++k)
        printf("%ld ", counts[k]);
    printf("\n");
    free(slope);
    free(shapes);
    free(work);
    return 0;
}
