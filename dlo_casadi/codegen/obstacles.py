"""Obstacles in the generated solver: their maximum number, and those of the model."""

from dataclasses import dataclass

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.codegen.kernels import c_number
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.contact import gap_per_force, surfaces_at
from dlo_casadi.rod import obstacles as rod
from dlo_casadi.rod.obstacles import Plane


@dataclass(frozen=True)
class Obstacles:
    """Obstacles of a solver: at most `most` per call, and those of the model if a fit has them."""

    most: int
    declared: tuple[rod.Obstacle, ...]

    @classmethod
    def of(cls, model: CableModel, p: FloatArray, most: int) -> "Obstacles":
        """Make room for at least the model's own obstacles.

        Raises
        ------
        DloError
            If `most` is not a valid number, or the cable is one of links.
        """
        if not isinstance(most, int | np.integer) or not 0 <= most <= 1000:
            raise DloError(f"obstacles: a whole number, 0 to 1000, found {most!r}")
        if most and not model.chain.kind.smooth:
            raise DloError(
                "a cable of links cannot lie on obstacles\n"
                "  Try: another element, --element quadratic"
            )
        declared = surfaces_at(model, p)
        return cls(max(int(most), len(declared)), declared)

    def values(self, model: CableModel) -> dict[str, int | str]:
        """Values that replace the templates' marks."""
        d, n, nodes = model.node.dimension, model.n, model.chain.n_nodes
        holds = len(model.clips) + model.n_springs
        border, slots = d * (1 + holds) + len(model.sliding), 4 * self.most * n
        rows, columns = model.node.increment * nodes + border, (1 + d) * n
        # Two points per plane, columns with their block, sums and forces; as in the template.
        size = (2 if d == 2 else 1) * ((3 + d) * slots + d * (3 * n + 2))
        size += columns * (4 * d + 5 + 2 * rows) + columns * (columns + 1) + columns
        size += d * (d + 1) // 2 * n + d * n + (7 + 3 * d) * slots
        return {
            "OBSTACLES": self.most,
            "DECLARED": len(self.declared),
            "CONTACT_SIZE": size if self.most else 0,
            "PER_FORCE": c_number(gap_per_force(model, 1.0)),
        }

    @property
    def words(self) -> dict[str, str]:
        """Text parts of the templates, by mark."""
        if not self.most:
            return dict.fromkeys(_MARKS, "")
        among = "const dlo_obstacle *obstacles, size_t n_obstacles,\n                     "
        own = "DECLARED_OBSTACLES, DLO_DECLARED, " if self.declared else "0, 0, "
        member = "    std::vector<dlo_obstacle> obstacles; /* on which the cable may lie */\n\n"
        given = ("obstacles, n_obstacles, ", own, "NULL, 0, ", _SAID)
        hpp = (member, "obstacles.data(), obstacles.size(), ")
        declared = ", ".join(map(_initializer, self.declared))
        return dict(zip(_MARKS, (among, *given, *hpp, declared), strict=True))


# Marks of obstacles in the templates.
_MARKS = (
    "AMONG",
    "GIVEN",
    "DECLARED_GIVEN",
    "NO_OBSTACLES",
    "OBSTACLES_ARE",
    "HPP_OBSTACLES",
    "HPP_GIVEN",
    "DECLARED_OBSTACLES",
)
# Text about obstacles in the header.
_SAID = """\
 *   obstacles  in   [n_obstacles], rigid and without friction, on which the cable may lie. Where
 *                   the status is DLO_OK the whole cable, its radius and its fixtures are outside
 *                   of them but for 1e-6 of its length. Places at which it touches slide along
 *                   it in derivatives. Along a path it touches down and lifts off without a jump
 *   n_obstacles in  at most DLO_OBSTACLES
"""


def _initializer(surface: rod.Obstacle) -> str:
    """A surface as an initialiser of dlo_obstacle."""
    if isinstance(surface, Plane):
        kind, places, radius = "DLO_HALF_SPACE", (surface.point, surface.normal), 0.0
    else:
        kind, places, radius = "DLO_CAPSULE", (surface.a, surface.b), surface.radius
    a, b = (", ".join(c_number(float(x)) for x in place) for place in places)
    return f"{{{kind}, {{{a}}}, {{{b}}}, {c_number(radius)}}}"
