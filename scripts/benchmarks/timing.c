/* Seconds of single solves: appended to the generated solver by the benchmark. The machine may be
 * shared, so that the thread's own time on the processor counts. */
#include <time.h>

static double processor_seconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

void dlo_time(const dlo_pose *pose, dlo_branch branch, const dlo_shape *warm, size_t repeats,
              double *seconds, dlo_shape *shape, double *work);
void dlo_time(const dlo_pose *pose, dlo_branch branch, const dlo_shape *warm, size_t repeats,
              double *seconds, dlo_shape *shape, double *work)
{
    size_t i, k;
    for (i = 0; i < repeats; ++i) {
        const double from = processor_seconds();
        for (k = 0; k < 10; ++k)
            dlo_solve(pose, branch, warm, shape, work, DLO_WORKSPACE_SIZE);
        seconds[i] = (processor_seconds() - from) / 10.0;
    }
}
