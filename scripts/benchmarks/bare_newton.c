/* A bare Newton method for the pinned chain of links: the measure of what a solver can cost.
 * No line search, no check of stability or of the result, no bounds, no second guess. */
#include <math.h>
#include <stddef.h>

int bare_newton(int n, double stiffness, double weight_x, double weight_y, double h, double ex,
                double ey, double *x, double *work);
int bare_newton(int n, double stiffness, double weight_x, double weight_y, double h, double ex,
                double ey, double *x, double *work)
{
    double *r = work, *d = work + n, *u = work + 2 * n, *v = work + 3 * n, *o = work + 4 * n;
    const double chord = sqrt(ex * ex + ey * ey), to = atan2(ey, ex);
    double half = sqrt(6.0 * (1.0 - chord / (n * h))), lx = 0.0, ly = 0.0;
    int i, k;
    for (k = 0; k < 4; ++k) /* sin(a)/a = chord/length */
        half -= (sin(half) - half * chord / (n * h)) / (cos(half) - chord / (n * h));
    for (i = 0; i < n; ++i)
        x[i] = to + half * ((2.0 * i + 1.0) / n - 1.0);
    for (k = 1; k < 30; ++k) {
        double cx = -ex, cy = -ey, sxx = 0.0, sxy = 0.0, syy = 0.0, bx = 0.0, by = 0.0, det, px, py;
        double most = 0.0;
        for (i = 0; i < n; ++i) {
            const double c = cos(x[i]), s = sin(x[i]);
            const double a = h * (lx - weight_x * (n - i - 0.5)), b = h * (ly - weight_y * (n - i - 0.5));
            cx += h * c;
            cy += h * s;
            u[i] = -h * s;
            v[i] = h * c;
            r[i] = a * s - b * c;
            d[i] = -a * c - b * s;
            if (i) {
                const double m = stiffness * (x[i] - x[i - 1]);
                r[i] -= m;
                r[i - 1] += m;
                d[i] += stiffness;
                d[i - 1] += stiffness;
            }
        }
        for (i = 0; i < n; ++i) {
            if (i) {
                const double l = -stiffness * o[i - 1];
                d[i] += l * stiffness;
                r[i] -= l * r[i - 1];
                u[i] -= l * u[i - 1];
                v[i] -= l * v[i - 1];
            }
            o[i] = 1.0 / d[i];
            sxx += o[i] * u[i] * u[i];
            sxy += o[i] * u[i] * v[i];
            syy += o[i] * v[i] * v[i];
            bx += o[i] * u[i] * r[i];
            by += o[i] * v[i] * r[i];
        }
        bx += cx;
        by += cy;
        det = sxx * syy - sxy * sxy;
        px = (syy * bx - sxy * by) / det;
        py = (sxx * by - sxy * bx) / det;
        lx += px;
        ly += py;
        for (i = n - 1; i >= 0; --i) {
            r[i] = (r[i] - u[i] * px - v[i] * py + (i < n - 1 ? stiffness * r[i + 1] : 0.0)) * o[i];
            most = fabs(r[i]) > most ? fabs(r[i]) : most;
        }
        for (i = 0; i < n; ++i)
            x[i] += r[i];
        if (most < 1e-6)
            return k;
    }
    return 0;
}

void bare_newton_many(size_t count, int n, double stiffness, double weight_x, double weight_y,
                      double h, double ex, double ey, double *x, double *work);
void bare_newton_many(size_t count, int n, double stiffness, double weight_x, double weight_y,
                      double h, double ex, double ey, double *x, double *work)
{
    size_t i;
    for (i = 0; i < count; ++i)
        bare_newton(n, stiffness, weight_x, weight_y, h, ex, ey, x, work);
}
