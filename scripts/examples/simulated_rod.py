"""What the examples measure: a hanging rod by SciPy, which shares nothing with the package."""

import numpy as np
from scipy.integrate import solve_bvp

LENGTH, WEIGHT, EI, NOISE = 0.8, 0.6, 0.02, 3e-4  # m, N/m, N m^2, m
# Arguments of dlo.Cable and dlo.Session: what a user would know of the rod, and a quick fit.
CABLE = {"length": LENGTH, "mass": WEIGHT * LENGTH / 9.81, "diameter": 0.006}
QUICK = {"model": {"n": 12}, "estimation": {"algorithm1": False}}
HELD = {"gravity": (0, -9.81), "boundary": ("pinned", "pinned"), "std": NOISE}


def measured(
    end: tuple[float, float],
    generator: np.random.Generator,
    *,
    curvature: float = 0.0,
    lift: float = 0.0,
    place: float = 0.3,
) -> np.ndarray:
    """Noisy points (30, 2) [m] of a rod between two pins, the first at the origin.

        phi' = M / EI + curvature sin(pi s / L),   M' = t x f,   f' = (0, WEIGHT - lift delta)

    Parameters
    ----------
    end : (2,) [m]
    generator : numpy.random.Generator
    curvature : float [1/m]
        Largest rest curvature.
    lift, place : float [N], [m]
        A force upwards at an arc length.
    """

    def rod(s, state, force):
        _, _, phi, moment = state
        up = force[1] + WEIGHT * s - lift / 2 * (1 + np.tanh((s - place) / 0.004))
        bend = moment / EI + curvature * np.sin(np.pi * s / LENGTH)
        turn = force[0] * np.sin(phi) - up * np.cos(phi)
        return np.array([np.cos(phi), np.sin(phi), bend, turn])

    def gaps(a, b, _):
        return np.array([a[0], a[1], a[3], b[0] - end[0], b[1] - end[1], b[3]])

    s = np.linspace(0, LENGTH, 201)
    heading = np.arctan2(end[1], end[0]) + np.linspace(-1.5, 1.5, 201)  # sagging
    guess = np.array([end[0] * s / LENGTH, end[1] * s / LENGTH, heading, 0 * s])
    found = solve_bvp(rod, gaps, s, guess, p=[0.0, -WEIGHT * LENGTH / 2], max_nodes=20_000)
    assert found.success, found.message
    points = found.sol(np.linspace(0.02, 0.98, 30) * LENGTH)[:2].T
    return points + generator.normal(scale=NOISE, size=points.shape)
