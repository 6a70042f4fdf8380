"""First guesses of the nodes of a cable held at the ends of a pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.equilibrium.initial_arcs import arc_headings, arc_into_clamps, limited, wrapped
from dlo_casadi.equilibrium.initial_frames import guessed_frames_of
from dlo_casadi.equilibrium.pose import Pose
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.lagrangian import lagrangian_of
from dlo_casadi.rod.chain import Chain

FloatArray = NDArray[np.floating]

# First guesses that seldom lead to the lowest equilibrium are left out, see `guesses` [rad].
# Of 300 random problems with a clamp at the end or at both ends this loses none.
FAR, CURVED = 1.5, 1.0


def resting_headings(chain: Chain, rest: FloatArray) -> FloatArray:
    """Headings (n_nodes,) of the cable at rest, counted from its start [rad]."""
    cells = chain.cells
    turn = np.concatenate([[0.0], np.cumsum(rest * np.diff(cells, axis=1).ravel())])
    edges = np.concatenate([cells[:1, 0], cells[:, 1]])
    return np.interp(chain.places, edges, turn)


def guesses(model: CableModel, p: FloatArray, rest: FloatArray, pose: Pose) -> list[FloatArray]:
    """First guesses of the headings, in the order in which they are tried.

    Pinned at both ends:

    1. the arc of the cable's length through both ends that turns counter-clockwise, and
    2. the one that turns clockwise; a pose that names its branch swaps them;
    3. the rest shape turned into the chord, if it turns by more than 0.05 rad;
    4. a loop in the middle of a straight cable, counter-clockwise, and
    5. clockwise; both if the rest shape turns by more than 1 rad and the loop has 4.5 elements.

    With a clamp at one end or at both:

    1. the counter-clockwise arc, bent into the headings of the clamps (`arc_into_clamps`), and
    2. the clockwise one; a pose that names its branch swaps them;
    3. and 4. the same on the other way around: where the nearer one bends the cable by more than
       1.5 rad, or the rest shape turns by more than 1 rad.

    With a free end:

    1. the rest shape from the start on;
    2. the cable falling down from the start's direction;
    3. straight on;
    4. the cable falling down the other way round: where the nearer one turns by more than 1.5 rad,
       or the rest shape by more than 1 rad.

    In all of them bends are cut at 0.9 of the joints' bound, and clamps keep their headings.
    The generated solver tries the same ones: codegen/templates/guesses.c.in.

    Parameters
    ----------
    p : (n_parameters,)
    rest : (n_rests,) [1/m]
    """
    chain = model.chain
    ends, length = lagrangian_of(model).held(p, pose.ends, 0)
    start, end, headings = np.array(ends).reshape(3, 2)
    u, chord = chain.places / chain.length, (end - start) / float(length)
    held = tuple(side == "clamped" for side in (model.start, model.end))
    clamps = (
        float(headings[0]) if held[0] else None,
        float(headings[1]) if held[1] else None,
    )
    bent = resting_headings(chain, rest)
    sides = (-1, 1) if pose.branch == "cw" else (1, -1)
    if model.end == "free":
        found = _hanging(model, u, bent, clamps[0])
    elif any(held):
        into = [arc_into_clamps(u, chord, clamps, side) for side in sides]
        found = [near for near, _, _ in into]
        found += [far for _, far, bend in into if bend > FAR or np.ptp(bent) > CURVED]
    else:
        found = [arc_headings(u, 1.0, np.zeros(2), chord, side) for side in sides]
        found += _curved(chain.n, u, bent, chord)
    out = [limited(phi) for phi in found]
    for phi in out:
        phi[[0, -1]] = np.where(held, headings, phi[[0, -1]])
    return out


def first_nodes(model: CableModel, p: FloatArray, rest: FloatArray, pose: Pose) -> list[FloatArray]:
    """First guesses of the nodes (n_nodes, coordinates): `guesses`, or `guessed_frames`."""
    if model.in_space:
        return guessed_frames(model, p, rest, pose)
    return [phi[:, None] for phi in guesses(model, p, rest, pose)]


def guessed_frames(
    model: CableModel, p: FloatArray, rest: FloatArray, pose: Pose
) -> list[FloatArray]:
    """First guesses of the frames (n_nodes, 4) of a cable in space.

    Between two ends, four arcs of the cable's length, the first sagging along gravity, the others
    turned about the chord by quarter turns; bent into the clamps, the roll of the end clamp that
    is nearest to `turns` spread evenly; of no turns, where that is nearly half a turn, also with
    the one the other way round. With a free end: the rest shape, the cable fallen down, and
    straight on.
    """
    ends, length = lagrangian_of(model).held(p, pose.ends, 0)
    values = np.array(ends).ravel()
    start, end, first, last = np.split(values, [3, 6, 10])
    held = tuple(side == "clamped" for side in (model.start, model.end))
    clamps = (first if held[0] else None, last if held[1] else None)
    u = model.chain.places / model.chain.length
    down = np.array(model.gravity)
    chord = None if model.end == "free" else (end - start) / float(length)
    cells = model.chain.cells
    widths = np.diff(cells, axis=1).ravel()
    bent = model.chain.curvatures(rest) * widths
    return guessed_frames_of(u, chord, clamps, down, bent, pose.turns)


def _hanging(
    model: CableModel, u: FloatArray, bent: FloatArray, first: float | None
) -> list[FloatArray]:
    """Guesses for a cable with a free end; `first` is the clamp's heading."""
    down = float(np.arctan2(model.gravity[1], model.gravity[0])) if any(model.gravity) else 0.0
    if first is None:
        first = down
    drop, decay = wrapped(down - first), 1 - np.exp(-4 * u)
    found = [first + bent, first + drop * decay, np.full_like(u, first)]
    if abs(drop) > FAR or np.ptp(bent) > CURVED:
        found.append(first + (drop - 2 * np.pi * (1 if drop > 0 else -1)) * decay)
    return found


def _curved(n: int, u: FloatArray, bent: FloatArray, chord: FloatArray) -> list[FloatArray]:
    """Guesses for a cable of n elements between two pins that is curved at rest."""
    direction, slack = np.arctan2(chord[1], chord[0]), 1 - float(np.hypot(*chord))
    turning = np.ptp(bent)
    found = []
    if turning > 0.05:
        bent = limited(bent)
        found.append(bent + direction - np.arctan2(np.sin(bent).sum(), np.cos(bent).sum()))
    if turning > CURVED and slack * n > 4.5:
        looped = 2 * np.pi * np.clip((u - 0.5) / slack + 0.5, 0.0, 1.0)
        found += [direction + looped, direction - looped]
    return found
