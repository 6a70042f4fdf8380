/* Nanoseconds of single solves: appended to the generated solver by the benchmark. */
#include <time.h>

void dlo_time(const dlo_pose *pose, dlo_branch branch, const dlo_shape *warm, size_t repeats,
              double *seconds, dlo_shape *shape, double *work);
void dlo_time(const dlo_pose *pose, dlo_branch branch, const dlo_shape *warm, size_t repeats,
              double *seconds, dlo_shape *shape, double *work)
{
    struct timespec from, to;
    size_t i, k;
    for (i = 0; i < repeats; ++i) {
        clock_gettime(CLOCK_MONOTONIC, &from);
        for (k = 0; k < 10; ++k)
            dlo_solve(pose, branch, warm, shape, work, DLO_WORKSPACE_SIZE);
        clock_gettime(CLOCK_MONOTONIC, &to);
        seconds[i] = ((double)(to.tv_sec - from.tv_sec) + 1e-9 * (double)(to.tv_nsec - from.tv_nsec)) / 10.0;
    }
}
