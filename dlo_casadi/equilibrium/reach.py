"""Why a pose has no equilibrium, whatever the search for one: its end is too far, or no room."""

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.spans import chords, fixed_stretches, holders
from dlo_casadi.errors import EquilibriumError
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.clips import clamped_nodes
from dlo_casadi.model.contact import surfaces_at
from dlo_casadi.model.lagrangian import lagrangian_of


def no_equilibrium(pose: HeldPose, what: str, hint: str) -> EquilibriumError:
    """The error of a pose: what is wrong, and what to try."""
    return EquilibriumError(f"{what}.\n  Try: {hint}", pose.name, pose.end)


def out_of_reach(model: CableModel, p: FloatArray, pose: HeldPose) -> EquilibriumError | None:
    """Why a pose has no equilibrium: its end is missing or too far, or a number is not finite."""
    if pose.end is None and model.end != "free":
        what = f"no equilibrium: the end of the cable is {model.end}, and the pose has none"
        return no_equilibrium(pose, what, "Pose(start, end).")
    if not np.all(np.isfinite(pose.vector)):
        what = (
            f"no equilibrium: a number of the pose is not finite: start {pose.start} m, end "
            f"{pose.end} m, headings {pose.start_heading} and {pose.end_heading} rad"
        )
        return no_equilibrium(pose, what, "see where these numbers come from.")
    if wrong := _wrong_clips(model, p, pose):
        return no_equilibrium(pose, *wrong)
    if wrong := _inside(model, p, pose):
        return no_equilibrium(pose, *wrong)
    if pose.end is None or model.extensible:
        return None
    ends, true_length = lagrangian_of(model).true_ends_and_length(p, pose.ends, 0)
    start, end = np.array(ends).ravel()[: 2 * model.node.dimension].reshape(2, -1)
    distance, length = float(np.linalg.norm(end - start)), float(true_length)
    if distance < length:
        return None
    where = ", ".join(f"{x:.4f}" for x in pose.end)
    what = (
        f"no equilibrium: the end ({where}) m is {distance:.4f} m "
        f"from the start, the cable is {length:.4f} m long"
    )
    return no_equilibrium(pose, what, "end in metres? cable.length?")


def _inside(model: CableModel, p: FloatArray, pose: HeldPose) -> tuple[str, str] | None:
    """Why obstacles leave no equilibrium, and what to try: a fixture is inside of one."""
    held = [("start", pose.start), *((clip.name, clip.place) for clip in pose.clips)]
    held += [("end", pose.end)] if pose.end is not None else []
    surfaces = surfaces_at(model, p)
    for name, place in held:
        for obstacle in surfaces:
            depth = -float(obstacle.near(np.array(place)).distance)
            if depth > 0:
                at = ", ".join(f"{x:.4f}" for x in place)
                what = f"no equilibrium: the {name} ({at}) m is {depth:.4f} m inside"
                return f"{what} {obstacle.name}", "the obstacle's place, or its normal."
    return None


def _wrong_clips(model: CableModel, p: FloatArray, pose: HeldPose) -> tuple[str, str] | None:
    """Why clips leave no equilibrium, and what to try: other kinds, no room on the mesh or cable.

    Eyelets are taken to be anywhere between the clips beside them.
    """
    if tuple(clip.kind for clip in pose.clips) != model.clips:
        own, others = (", ".join(x) or "none" for x in ([c.kind for c in pose.clips], model.clips))
        return f"no equilibrium: the pose has the clips {own}, the model {others}", "the same."
    nodes = clamped_nodes(model.chain, pose.clips)
    if len(set(nodes)) < len(nodes):
        what = f"clamped clips are nearer to each other than an element, {model.chain.h:.4g} m"
        return f"no equilibrium: {what}", "a finer mesh (model.n)."
    held = holders(model, p, pose) if pose.clips and not model.extensible else []
    names = ["the start", *(clip.name for clip in pose.clips), "the end"]
    apart = chords(held)
    true_length = float(lagrangian_of(model).true_ends_and_length(p, pose.ends, 0)[1])
    for low, high, declared in fixed_stretches(held):
        length = declared * true_length / model.cable.length
        if sum(apart[low:high]) >= length:
            what = (
                f"no equilibrium: {names[low]} and {names[high]} are {sum(apart[low:high]):.4f} m "
                f"apart, with {length:.4f} m of cable between them"
            )
            return what, "places and arc lengths in metres, in the order along the cable?"
    return None
