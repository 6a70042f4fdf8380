/* Random problems through every function, for sanitisers and valgrind, by threads with a workspace
 * each: all must find the same, to the last bit. */
#include "dlo_solver.h"

#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define COUNT 16
#define MOST_THREADS 8
#if DLO_OBSTACLES
#define AMONG obstacles, 2,
#else
#define AMONG
#endif

typedef struct {
    long problems;
    long counts[DLO_NO_ROOM + 1];
    double sum; /* of what was found */
} job_t;

static double uniform(unsigned long *state)
{
    *state = (*state * 6364136223846793005UL + 1442695040888963407UL) & 0xffffffffffffffffUL;
    return (double)(*state >> 11) / 9007199254740992.0;
}

static void draw_pose(dlo_pose *pose, unsigned long *state)
{
    const double r = 1.02 * DLO_LENGTH * sqrt(uniform(state));
    const double a = 6.283185307179586 * uniform(state);
    memset(pose, 0, sizeof *pose);
    pose->end[0] = uniform(state) < 0.01 ? (double)NAN : r * cos(a);
    pose->end[1] = r * sin(a);
#if DLO_DIMENSION == 3
    {
        int k;
        pose->end[2] = 0.2 * DLO_LENGTH * uniform(state);
        for (k = 0; k < 4; ++k) {
            pose->start_orientation[k] = uniform(state) - 0.5;
            pose->end_orientation[k] = uniform(state) - 0.5;
        }
        pose->turns = floor(3.0 * uniform(state)) - 1.0;
    }
#else
    pose->start_heading = 3.0 * uniform(state) - 1.5;
    pose->end_heading = 3.0 * uniform(state) - 1.5;
#endif
#if DLO_CLIPS
    {
        int h, k;
        for (h = 0; h < DLO_CLIPS; ++h) {
            dlo_clip *const clip = pose->clips + h;
            const double share = (h + 0.8 + 0.4 * uniform(state)) / (DLO_CLIPS + 1);
            clip->at = share * DLO_LENGTH;
            for (k = 0; k < DLO_DIMENSION; ++k)
                clip->place[k] = share * pose->end[k] + 0.1 * DLO_LENGTH * uniform(state);
#if DLO_SADDLES && DLO_DIMENSION == 3
            for (k = 0; k < 4; ++k)
                clip->orientation[k] = uniform(state) - 0.5;
#elif DLO_SADDLES
            clip->heading = 3.0 * uniform(state) - 1.5;
#endif
        }
    }
#endif
}

static void *work_off(void *what)
{
    job_t *const job = what;
    /* Of the exact size, so that a step beyond it is seen. */
    double *work = malloc(DLO_WORKSPACE_SIZE * sizeof *work);
    dlo_shape *shapes = malloc(COUNT * sizeof *shapes);
    dlo_slope *slope = malloc(sizeof *slope);
    const dlo_obstacle obstacles[2] = {{DLO_CAPSULE, {0.1}, {0.2}, 0.05},
                                       {DLO_HALF_SPACE, {0.0, -0.5}, {0.0, 1.0}, 0.0}};
    const double limits[DLO_QUANTITIES] = {0.05, 1.0, 0.1, 5.0, 0.01};
    const dlo_branch branches[] = {DLO_LOWEST,
#if DLO_DIMENSION == 2
                                   DLO_CCW, DLO_CW
#endif
    };
    const size_t kinds = sizeof branches / sizeof *branches;
    unsigned long state = 1;
    long k;
    for (k = 0; k < job->problems; ++k) {
        const dlo_branch branch = branches[(size_t)k % kinds], other = branches[kinds - 1];
        dlo_pose poses[COUNT];
        dlo_status statuses[COUNT];
        size_t jump, i;
        for (i = 0; i < COUNT; ++i)
            draw_pose(poses + i, &state);
        dlo_batch(poses, COUNT, AMONG branch, shapes, statuses, work, DLO_WORKSPACE_SIZE);
        for (i = 0; i < COUNT; ++i) {
            dlo_gap gap;
            dlo_usage usages[DLO_QUANTITIES];
            dlo_quantity tightest;
            dlo_shape near;
            ++job->counts[statuses[i]];
            job->sum += shapes[i].energy;
            dlo_sensitivity(poses + i, AMONG shapes + i, slope, work, DLO_WORKSPACE_SIZE);
            dlo_clearance(shapes + i, obstacles, 2, slope, &gap);
            dlo_limits(shapes + i, limits, obstacles, 2, slope, usages, &tightest);
            job->sum += gap.gradient[0] + usages[tightest].gradient[0];
            poses[i].end[0] += 1e-3;
            dlo_step(poses + i, AMONG shapes + i, 4, &near, work, DLO_WORKSPACE_SIZE);
            dlo_solve(poses + i, AMONG other, shapes + i, shapes + i, work, DLO_WORKSPACE_SIZE);
            job->sum += near.energy + shapes[i].energy;
        }
        dlo_path(poses, 4, AMONG branch, 0, shapes, statuses, &jump, work, DLO_WORKSPACE_SIZE);
        dlo_solve(poses, AMONG other, 0, shapes, work, DLO_WORKSPACE_SIZE - 1);
    }
    free(slope);
    free(shapes);
    free(work);
    return 0;
}

/* Arguments: problems, threads. */
int main(int argc, char **argv)
{
    const int threads = argc > 2 ? atoi(argv[2]) : 1;
    static job_t jobs[MOST_THREADS];
    pthread_t ids[MOST_THREADS];
    int i, differ = 0;
    size_t k;
    for (i = 0; i < threads; ++i) {
        jobs[i].problems = argc > 1 ? atol(argv[1]) : 1000;
        if (pthread_create(ids + i, 0, work_off, jobs + i))
            return 2;
    }
    for (i = 0; i < threads; ++i) {
        pthread_join(ids[i], 0);
        differ |= memcmp(jobs, jobs + i, sizeof *jobs);
    }
    for (k = 0; k < sizeof jobs->counts / sizeof *jobs->counts; ++k)
        printf("%ld ", jobs->counts[k]);
    printf("\n");
    return differ ? 1 : 0;
}
