"""What the tests of the generated solver share: compiler flags, poses moved by one number."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.equilibrium.pose import HeldPose

WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror")
# A third of the time of an optimised build. Every solver is compiled without a warning, but clang
# would warn of constants that stand for what a kind of cable has: `DLO_DIMENSION && CLAMPS`.
QUICK = ("-O0", *WARNINGS, "-Wno-constant-logical-operand")
# -Wmaybe-uninitialized needs an optimiser.
STRICT = ("-O1", *WARNINGS)


def all_zero(shape) -> bool:
    """Whether all numbers of a compiled shape are zero."""
    return not any(np.any(value) for name, value in vars(shape).items() if name != "status")


def moved(pose: HeldPose, column: int, step: float) -> HeldPose:
    """The pose with one number of its ends moved, in the order of a sensitivity's columns.

    In the plane: the end's place, headings of start and end, the start's place. In space: place and
    orientation of the start, then of the end; an orientation turns about the world's axes.
    """
    if len(pose.start) == 2:
        if column in (2, 3):
            name = ("start_heading", "end_heading")[column - 2]
            return replace(pose, **{name: getattr(pose, name) + step})
        name, by = ("end", "start")[column // 4], step * np.eye(2)[column % 2]
    else:
        name, by = ("start", "end")[column // 6], step * np.eye(3)[column % 3]
    if len(by) == 2 or column % 6 < 3:
        return replace(pose, **{name: tuple(np.array(getattr(pose, name)) + by)})
    name += "_orientation"
    turned = Rotation.from_rotvec(by) * Rotation.from_quat(getattr(pose, name))
    return replace(pose, **{name: tuple(turned.as_quat())})
