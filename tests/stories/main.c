/* A user's program: one pose, its shape and a column of its derivatives as JSON. */
#include "dlo_solver.h"

#include <stdio.h>

#if DLO_OBSTACLES
#define GIVEN obstacles, sizeof obstacles / sizeof *obstacles,
#else
#define GIVEN
#endif
#define STEP 1e-6
#if DLO_END_FREE
#define COLUMN 2 /* the start's heading */
#define TOLD(shape) (shape).points[DLO_N]
#define SLOPE slope.points[DLO_N]
#else
#define COLUMN (DLO_DIMENSION == 3 ? 6 : 0) /* the end's x */
#define TOLD(shape) (shape).end_force
#define SLOPE slope.end_force
#endif

static void row(const char *name, const double *x, int count)
{
    int i;
    printf("\"%s\": [", name);
    for (i = 0; i < count; ++i)
        printf("%.17g%s", x[i], i + 1 < count ? ", " : "], ");
}

static void table(const char *name, const double *x, int rows, int columns)
{
    int i, k;
    printf("\"%s\": [", name);
    for (i = 0; i < rows; ++i)
        for (k = 0; k < columns; ++k)
            printf("%s%.17g%s", k ? "" : "[", x[i * columns + k], k + 1 < columns ? ", " : i + 1 < rows ? "], " : "]], ");
}

static double *number(dlo_pose *pose)
{
#if DLO_END_FREE
    return &pose->start_heading;
#else
    return pose->end;
#endif
}

int main(void)
{
    static double work[DLO_WORKSPACE_SIZE];
    static dlo_shape shape, beside[2];
    static dlo_slope slope;
    dlo_pose pose = {POSE};
    double quotient[DLO_DIMENSION], column[DLO_DIMENSION], places[DLO_N + 1];
    dlo_status status;
    int i;
#if DLO_OBSTACLES
    const dlo_obstacle obstacles[] = {AMONG};
#endif
    status = dlo_solve(&pose, GIVEN DLO_LOWEST, NULL, &shape, work, DLO_WORKSPACE_SIZE);
    if (status == DLO_OK)
        status = dlo_sensitivity(&pose, GIVEN &shape, &slope, work, DLO_WORKSPACE_SIZE);
    for (i = 0; status == DLO_OK && i < 2; ++i) {
        dlo_pose moved = pose;
        *number(&moved) += i ? STEP : -STEP;
        status = dlo_solve(&moved, GIVEN DLO_LOWEST, &shape, beside + i, work, DLO_WORKSPACE_SIZE);
    }
    if (status != DLO_OK) {
        fprintf(stderr, "%s\n", dlo_message(status));
        return 1;
    }
    for (i = 0; i < DLO_DIMENSION; ++i) {
        column[i] = SLOPE[i][COLUMN];
        quotient[i] = (TOLD(beside[1])[i] - TOLD(beside[0])[i]) / (2 * STEP);
    }
    for (i = 0; i <= DLO_N; ++i)
#if DLO_SADDLES
        places[i] = shape.places[i];
#else
        places[i] = (double)i / DLO_N;
#endif
    printf("{");
    row("slope", column, DLO_DIMENSION);
    row("quotient", quotient, DLO_DIMENSION);
    row("places", places, DLO_N + 1);
    table("points", shape.points[0], DLO_N + 1, DLO_DIMENSION);
    row("start_force", shape.start_force, DLO_DIMENSION);
    row("end_force", shape.end_force, DLO_DIMENSION);
    table("moments", shape.moments[0], 2, DLO_AXES);
#if DLO_CLIPS
    table("clip_forces", shape.clip_forces[0], DLO_CLIPS, DLO_DIMENSION);
    row("clip_at", shape.clip_at, DLO_CLIPS);
#endif
#if DLO_OBSTACLES
    row("obstacle_force", shape.obstacle_forces[0], DLO_DIMENSION);
#endif
    printf("\"min_bend_radius\": %.17g, \"energy\": %.17g, \"hash\": \"%s\"}\n",
           shape.min_bend_radius, shape.energy, DLO_MODEL_HASH);
    return 0;
}
