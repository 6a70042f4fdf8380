"""Common code of all simulators: numbers as text in their files, and how a cable comes to rest."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import EquilibriumError

# Largest mean speed [m/s] of a node at rest, in each of two successive intervals [s].
REST_SPEED, INTERVAL = 2e-5, 0.02
# Simulated time [s] after which relaxation has failed.
PATIENCE = 60.0


def rounded(values: FloatArray) -> list:
    """Numbers as lists, to 12 digits."""
    return np.vectorize(lambda x: float(f"{x:.12g}"))(values).tolist()


def printable(text: str) -> str:
    """Text in one line: a line break would end the comment of Python that holds it."""
    return "".join(c if c.isprintable() else " " for c in text)


def array(values: FloatArray) -> str:
    """Format an array in Python, one row a line."""
    rows = ",\n    ".join(map(str, rounded(values)))
    return f"np.array([\n    {rows},\n])"


def head_of_python(
    head: Sequence[str], imports: Sequence[str], numbers: Sequence[tuple[str, str, str]]
) -> str:
    """Format comments, imports, and numbers: name, value, meaning."""
    lines = [f"# {line}".rstrip() for line in head]
    lines += ["", *(f"import {name}" for name in imports), ""]
    for name, value, meaning in numbers:
        lines += [f"# {meaning}"] * bool(meaning) + [f"{name} = {value}"]
    return "\n".join(lines) + "\n"


@dataclass(frozen=True, eq=False)
class Relaxed:
    """A cable at rest in a simulator.

    Parameters
    ----------
    nodes : (n + 1, 3) [m]
        Positions of the `Rod`'s nodes at rest.
    end_force : (3,) [N]
        Force of the cable on its end fixture, world axes; zero at a free end.
    """

    nodes: FloatArray
    end_force: FloatArray


def relax(
    advance: Callable[[int], FloatArray],
    energy: Callable[[], float],
    halt: Callable[[], None],
    step: float,
    name: str,
    speed: float = REST_SPEED,
) -> FloatArray:
    """Relax a cable; return its nodes (n + 1, 3) [m] at rest.

    Kinetic damping: whenever the kinetic energy has passed a maximum, all velocities are set to
    zero (Barnes, Comput. Struct. 19 (1984)). Damping and inertia do not change the shape at rest.

    Parameters
    ----------
    advance : callable
        Makes the given number of steps and returns the nodes.
    energy : callable
        Returns the kinetic energy, in any unit.
    halt : callable
        Sets all velocities to zero.
    step : float [s]
    speed : float [m/s]
        Speed below which a node is at rest; larger for a single-precision simulator.

    Raises
    ------
    EquilibriumError
        If it does not come to rest, or if its numbers become infinite.
    """
    many = max(1, round(INTERVAL / step))
    nodes, still, time, last = advance(0), 0, 0.0, 0.0
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
        moving = energy()
        if moving < last:
            halt()
            moving = 0.0
        last = moving
    return nodes
