/* A bare Newton method with the generated solver's own element and elimination: the measure of
 * what a solver in space can cost. Appended to the generated solver by the benchmark. No shift, no
 * limit of the step, no coarse mesh, no check of stability or of the result, one first guess. */
static int bare_newton(solver_t *w)
{
    double c[3], size;
    int count, i, k;
    for (count = 1; count < 30; ++count) {
        evaluate(w, &w->at);
        (void)factor(w, &w->at, 0.0);
        for (i = LOW; i < HIGH; ++i) {
            for (k = 0; k < 3; ++k)
                w->step[3 * i + k] = -slope_at(&w->at, i, k);
        }
        for (k = 0; k < 3; ++k)
            c[k] = -w->at.c[k];
        solve_with(w, w->step, c, w->step, w->dlam);
        size = largest_step(w);
        move(w, 1.0);
        if (size < 1e-6)
            return count;
        if (!(size < 1e3))
            return 0;
    }
    return 0;
}

/* Steps from first guess `which`, or from `warm`; 0 if that leads nowhere. */
int dlo_bare(const dlo_pose *pose, int which, const dlo_shape *warm, dlo_shape *shape, double *work);
int dlo_bare(const dlo_pose *pose, int which, const dlo_shape *warm, dlo_shape *shape, double *work)
{
    solver_t w;
    int steps;
    lay_out(&w, TABLE, work);
    if ((warm && load(&w, warm) != DLO_OK) || take(&w, pose) != DLO_OK || which >= GUESSES)
        return 0;
    if (warm)
        clamp(&w);
    else if (first_guess(&w, which) <= 0)
        return 0;
    steps = bare_newton(&w);
    if (steps)
        (void)report(&w, pose, shape);
    return steps;
}

void dlo_time_bare(const dlo_pose *pose, int which, const dlo_shape *warm, size_t repeats,
                   double *seconds, dlo_shape *shape, double *work);
void dlo_time_bare(const dlo_pose *pose, int which, const dlo_shape *warm, size_t repeats,
                   double *seconds, dlo_shape *shape, double *work)
{
    size_t i;
    int k;
    for (i = 0; i < repeats; ++i) {
        const double from = processor_seconds();
        for (k = 0; k < 10; ++k)
            (void)dlo_bare(pose, which, warm, shape, work);
        seconds[i] = (processor_seconds() - from) / 10.0;
    }
}
