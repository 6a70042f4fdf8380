"""How a simulator comes to rest: the same rule for all of them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import EquilibriumError

# At rest: no node moves faster than this [m/s], on average over two intervals [s] in a row.
REST_SPEED, INTERVAL = 2e-5, 0.02
# Simulated time [s] after which it has failed.
PATIENCE = 60.0


@dataclass(frozen=True, eq=False)
class Relaxed:
    """A cable at rest in a simulator.

    Parameters
    ----------
    nodes : (n + 1, 3) [m]
        Where the nodes of the `Rod` have come to rest.
    end_force : (3,) [N]
        Force of the cable on its end fixture, world axes; zero at a free end.
    seconds : float
        Simulated time.
    """

    nodes: FloatArray
    end_force: FloatArray
    seconds: float


def relax(
    advance: Callable[[int], FloatArray],
    halt: Callable[[], None],
    step: float,
    name: str,
    speed: float = REST_SPEED,
) -> tuple[FloatArray, float]:
    """Nodes (n + 1, 3) [m] at rest, and the simulated time [s].

    Kinetic damping: whenever the kinetic energy has passed a maximum all velocities are set to zero
    (Barnes, Comput. Struct. 19 (1984)). Damping and inertia do not change where it comes to rest.

    Parameters
    ----------
    advance : callable
        Makes so many steps, and returns the nodes.
    halt : callable
        Sets all velocities to zero if the kinetic energy is smaller than at the last call.
    step : float [s]
    speed : float [m/s]
        Below it a node is at rest; larger for a simulator of single precision.

    Raises
    ------
    EquilibriumError
        If it does not come to rest, or its numbers become infinite.
    """
    many = max(1, round(INTERVAL / step))
    nodes, still, time = advance(0), 0, 0.0
    while still < 2:
        before, nodes = nodes, advance(many)
        time += many * step
        fastest = np.linalg.norm(nodes - before, axis=1).max() / (many * step)
        if not np.isfinite(fastest) or time > PATIENCE:
            raise EquilibriumError(
                f"{name} does not come to rest: after {time:.3g} s a node still moves by "
                f"{fastest:.2g} m/s.\n  Try: fewer segments, or a pose nearer to the cable's."
            )
        still = still + 1 if fastest < speed else 0
        halt()
    return nodes, time
