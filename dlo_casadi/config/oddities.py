"""Values of a configuration that are possible, but hardly meant: warnings."""

import math
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_casadi.config.effects import has_pin_spring
from dlo_casadi.config.sections import Config, Experiment, Pose
from dlo_casadi.config.supports import unused_directions
from dlo_casadi.config.values import EARTH
from dlo_casadi.errors import counted
from dlo_casadi.rod.chain import ELEMENTS
from dlo_casadi.rod.supports import SupportKind

# Order of convergence -> number of elements below which a declared mesh is coarse. A mesh chosen
# from the data has at least 20 elements, a compromise of error and time.
_COARSE = {4: 10, 2: 20}
# Largest number of elements of a mesh chosen from the data.
_FINE = 160
# Time of COBYLA for one pose: 1 s measured for 10 links, 4 s for 20; it grows with the square.
_COBYLA_LINKS = 20
# Standard deviations above which a moment is read although nothing there takes one.
_FELT = 5.0
# Largest relative difference from gravity on Earth that passes without a question: 10 m/s^2 does.
_OTHER_GRAVITY = 0.03


def oddities(config: Config) -> Iterator[str]:
    """Values that are computable but probably unintended, each in a sentence."""
    cable, experiment, estimation = config.cable, config.experiment, config.estimation
    young, std = cable.youngs_modulus, experiment.measurement.std
    n, element = config.model.n, config.model.element
    if young is not None and young < 1.0e4:
        yield f"youngs_modulus {young:g} Pa is softer than any cable: in pascal?"
    if cable.mass is None:
        yield (
            f"cable.mass is not declared: the first stages assume {cable.prior_mass:.3g} kg (a "
            "solid cable of this diameter); the batch fit then estimates it from the force readings"
        )
    spans = [math.dist(pose.start, pose.end) for pose in experiment.poses if pose.end is not None]
    if spans and 0.0 < 50.0 * max(spans) < cable.length:
        yield (
            f"the cable is {cable.length:g} m long, but its ends are never more than "
            f"{max(spans):g} m apart: all in metres?"
        )
    yield from odd_gravity(experiment.gravity)
    if std is not None and std > 0.02 * cable.length:
        yield f"std {std:g} m is large for a cable of {cable.length:g} m: in metres?"
    if n is not None and n < _COARSE[ELEMENTS[element].order]:
        yield (
            f"model.n: {counted(n, f'{element} element')}: so coarse that the mesh's own error "
            "can look like a missing effect. Without model.n the mesh is chosen from the data"
        )
    if n is not None and n > _FINE:
        yield (
            f"model.n: {counted(n, 'element')} take minutes and much memory; the mesh that is "
            f"chosen from the data, without model.n, never has more than {_FINE}"
        )
    links = estimation.algorithm1_n
    if estimation.algorithm1_inner == "cobyla" and links > _COBYLA_LINKS:
        yield (
            f"estimation.algorithm1_n: COBYLA takes about {(links / 10) ** 2:.0f} s for one shape "
            f"of {links} links, and the loop needs hundreds; ipopt takes milliseconds"
        )
    if not experiment.in_space:
        for key in ("start", "end"):
            if getattr(experiment.boundary, key) is SupportKind.SWIVEL:
                yield (
                    f"boundary.{key}: swivel: in a plane no cable rolls about its axis, so that it "
                    f"holds what clamped holds. Try: {key}: clamped; or three numbers of gravity, "
                    "for a cable in space"
                )
    if not has_pin_spring(config):
        yield from _moments_of_free_turns(experiment)
    for key in unused_directions(experiment.boundary.start, experiment.boundary.end):
        if given := [p.name for p in experiment.poses if getattr(p, key) is not None]:
            yield f"{key} is not used, the {key.partition('_')[0]} is pinned: {', '.join(given)}"


def odd_gravity(gravity: Sequence[float]) -> Iterator[str]:
    """Whether gravity [m/s^2] is hardly meant: neither that on Earth nor none."""
    size = math.hypot(*gravity)
    if size and abs(size / EARTH - 1.0) > _OTHER_GRAVITY:
        meant = "in m/s^2?"
        if abs(size - 1.0) < _OTHER_GRAVITY:
            meant = f"in units of g? Try: {[round(EARTH * x, 6) + 0.0 for x in gravity]}"
        yield (
            f"gravity is {size:g} m/s^2, on Earth {EARTH}; a stiffness is found in proportion to "
            f"it: {meant}"
        )


def _moments_of_free_turns(experiment: Experiment) -> Iterator[str]:
    """Readings of moments about directions in which a support lets the cable turn: there are none.

    Friction, at most: a few standard deviations of the sensor pass.
    """
    known = experiment.measurement.moment_std or 0.0
    noise = math.hypot(known, experiment.tolerances.moment_bias)
    for side in ("start", "end"):
        kind = getattr(experiment.boundary, side)
        read = [pose for pose in experiment.poses if getattr(pose, f"{side}_moment") is not None]
        sizes = {pose.name: abs(_about_free_turns(experiment, pose, side)) for pose in read}
        largest = max(sizes, key=lambda name: sizes[name], default=None)
        if largest is not None and sizes[largest] > _FELT * noise:
            about = " about the cable's axis" if kind.direction else ""
            yield (
                f"{side}_moment of {largest}: {sizes[largest]:.3g} N m{about}, but a {kind} {side} "
                f"lets the cable turn there, so that the model has none (a sensor's std and offset "
                f"are {noise:.2g} N m). Try: boundary.{side}: clamped, or moments about the "
                f"{side} itself, not about the sensor's origin"
            )


def _about_free_turns(experiment: Experiment, pose: Pose, side: str) -> float:
    """Size [N m] of the part of a pose's moment at an end about what its support leaves free."""
    kind, moment = getattr(experiment.boundary, side), np.ravel(getattr(pose, f"{side}_moment"))
    if not kind.direction:
        return float(np.linalg.norm(moment))
    if kind.roll or not experiment.in_space:
        return 0.0
    axis = Rotation.from_quat(getattr(pose, f"{side}_orientation")).apply([1.0, 0.0, 0.0])
    return float(axis @ moment)
