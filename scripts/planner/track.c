/* A gripper of 2 kg tracks the path of `dlo move` at 1 kHz, and the simulated cable pulls at it.
 *
 *   dlo move results/rope --from start=0,0 start_heading=-1.2 \
 *            --to start=0.3,0 start_heading=-1.2 --duration 1.1 --output way.csv
 *   dlo generate-solver results/rope --output solver --motion
 *   cc -O2 -Isolver scripts/planner/track.c solver/dlo_solver.c -lm -o track && ./track way.csv
 *
 * For a cable in a plane, whose start is carried and turned; everything else rests. The controller
 * knows the path alone, whose speed and acceleration are fed forward. Told is how far the tip is from rest in
 * the second after arrival, how far the gripper was from its path, and the longest step.
 */
#include "dlo_solver.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define STEP 0.001 /* [s] */
#define MASS 2.0   /* of the gripper [kg] */
#define RATE 40.0  /* of its controller [1/s], critically damped */
#define SOFT 0.005 /* [s] in which the cable's pull acts: the gripper yields a little */
#define ROWS 20000
#define COLUMNS (DLO_DIMENSION + 1) /* place and heading */

static double times[ROWS], rows[ROWS][COLUMNS];

/* The path, its speed and acceleration at t: cubic through the rows, at rest before and after. */
static void path(int count, double t, double out[3][COLUMNS])
{
    int k = 0, c;
    while (k < count - 2 && times[k + 1] <= t)
        ++k;
    for (c = 0; c < COLUMNS; ++c) {
        const double h = times[k + 1] - times[k], u = fmax(0.0, fmin(1.0, (t - times[k]) / h));
        const double a = rows[k][c], b = rows[k + 1][c];
        const double m = k > 0 ? (b - rows[k - 1][c]) / 2.0 : 0.0;
        const double n = k < count - 2 ? (rows[k + 2][c] - a) / 2.0 : 0.0;
        const double p = 2.0 * (a - b) + m + n, q = 3.0 * (b - a) - 2.0 * m - n;
        const int moves = t < times[count - 1];
        out[0][c] = a + u * (m + u * (q + u * p));
        out[1][c] = moves ? (m + u * (2.0 * q + 3.0 * u * p)) / h : 0.0;
        out[2][c] = moves ? (2.0 * q + 6.0 * u * p) / (h * h) : 0.0;
    }
}

/* Rows of a table whose first columns are t_s and the start's; their number, 0 if there are none. */
static int read_rows(const char *name)
{
    char line[1024];
    int count = 0, c;
    FILE *file = fopen(name, "r");
    if (!file || !fgets(line, sizeof line, file) || strncmp(line, "t_s,start_x_m", 13) != 0)
        return 0;
    while (count < ROWS && fgets(line, sizeof line, file)) {
        char *at = line;
        times[count] = strtod(at, &at);
        for (c = 0; c < COLUMNS; ++c)
            rows[count][c] = *at == ',' ? strtod(at + 1, &at) : 0.0;
        ++count;
    }
    fclose(file);
    return count;
}

int main(int argc, char **argv)
{
    static double work[DLO_WORKSPACE_SIZE], moving[DLO_MOTION_WORKSPACE_SIZE];
    static dlo_motion now, next;
    const int count = argc > 1 ? read_rows(argv[1]) : 0;
    double place[DLO_DIMENSION], speed[DLO_DIMENSION] = {0.0}, weight[DLO_DIMENSION], pull[DLO_DIMENSION], goal[3][COLUMNS];
    double rest[DLO_DIMENSION], off = 0.0, swing = 0.0;
    dlo_fixtures fixtures;
    dlo_pose pose;
    dlo_shape shape;
    clock_t begun, spent, longest = 0;
    dlo_status status;
    int i, k;

    if (count < 3) {
        fprintf(stderr, "track: give a table of `dlo move` in which the start moves\n");
        return 1;
    }
    memset(&pose, 0, sizeof pose);
    memset(&fixtures, 0, sizeof fixtures);
    for (i = 1; i >= 0; --i) { /* at rest after the path, then before it */
        memcpy(pose.start, rows[i * (count - 1)], sizeof pose.start);
        pose.start_heading = rows[i * (count - 1)][DLO_DIMENSION];
        status = dlo_solve(&pose, DLO_LOWEST, NULL, &shape, work, DLO_WORKSPACE_SIZE);
        if (status == DLO_OK)
            status = dlo_rest(&pose, &shape, &now, moving, DLO_MOTION_WORKSPACE_SIZE);
        if (i == 1)
            memcpy(rest, now.r[DLO_NODES - 1], sizeof rest);
    }
    fixtures.pose = pose;
    for (k = 0; k < DLO_DIMENSION; ++k) {
        place[k] = pose.start[k];
        weight[k] = pull[k] = now.start_force[k];
    }
    for (i = 1; STEP * i < times[count - 1] + 1.0 && status == DLO_OK; ++i) {
        const double t = STEP * i;
        begun = clock();
        path(count, t, goal);
        for (k = 0; k < DLO_DIMENSION; ++k) {
            const double lag = goal[0][k] - place[k], slower = goal[1][k] - speed[k];
            const double push = MASS * (goal[2][k] + 2.0 * RATE * slower + RATE * RATE * lag) - weight[k];
            const double rate = (push + pull[k]) / MASS;
            speed[k] += STEP * rate;
            place[k] += STEP * speed[k];
            fixtures.pose.start[k] = place[k];
            fixtures.velocity[0][k] = speed[k];
            fixtures.acceleration[0][k] = rate;
            off = fmax(off, fabs(lag));
        }
        fixtures.pose.start_heading = goal[0][DLO_DIMENSION];
        status = dlo_advance(&fixtures, STEP, &now, &next, moving, DLO_MOTION_WORKSPACE_SIZE);
        spent = clock() - begun;
        longest = spent > longest ? spent : longest;
        now = next;
        for (k = 0; k < DLO_DIMENSION; ++k)
            pull[k] += STEP / SOFT * (now.start_force[k] - pull[k]);
        for (k = 0; k < DLO_DIMENSION && t > times[count - 1]; ++k)
            swing = fmax(swing, fabs(now.r[DLO_NODES - 1][k] - rest[k]));
    }
    if (status != DLO_OK) {
        fprintf(stderr, "track: %s\n", dlo_message(status));
        return 1;
    }
    printf("tip %.2f mm from rest after arrival, gripper %.2f mm from its path, longest step %.3f ms\n",
           1e3 * swing, 1e3 * off, 1e3 * (double)longest / CLOCKS_PER_SEC);
    return 0;
}
