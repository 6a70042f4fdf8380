"""Declared headings of clamps held against the directions of the measured lines there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_casadi.config import Config, Pose
from dlo_casadi.errors import counted
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.session.plausibility import Suspicion
from dlo_casadi.thresholds import FITS, HEADING_NEAR, HEADING_OFF

FloatArray = NDArray[np.floating]

# A full turn [rad], as somebody may round it; beyond it the line itself must turn so far.
_TURN = 6.3
# Of the length: pieces of which the direction is taken, and the part at an end that is used.
_STEP, _PART = 0.02, 0.1
# Between two pieces a line must turn by less, or nobody knows which way round [rad].
_TELLING = np.pi / 2


def wrong_headings(config: Config, read: Sequence[PoseInput]) -> tuple[Suspicion, ...]:
    """Headings of clamps that the lines contradict: of single poses, or of most of them."""
    cable, experiment = config.cable, config.experiment
    weight = cable.prior_mass * float(np.linalg.norm(experiment.gravity))
    layer = np.sqrt(cable.prior_bending_stiffness / max(weight, 1e-12))
    # The weight bends it by 1 / layer beside a clamp: within half of that by a quarter of a radian.
    reach = min(layer / 2, _PART * cable.length)
    poses = {pose.name: pose for pose in experiment.poses}
    found: list[Suspicion] = []
    for side in ("start", "end"):
        if getattr(experiment.boundary, side) != "clamped":
            continue
        judged, wrong = 0, {}
        for item in read:
            shown = _shown(side, poses[item.name], item.points, cable.length, reach)
            if shown is None:
                continue
            judged += 1
            declared = getattr(poses[item.name], f"{side}_heading")
            if abs(shown - declared) > HEADING_OFF:
                wrong[item.name] = (declared, shown)
        texts = {
            name: f"its {side}_heading is {declared:g} rad, the line {side}s at {shown:.3g} rad"
            + _guess(declared, shown)
            for name, (declared, shown) in wrong.items()
        }
        if wrong and 2 * len(wrong) > judged:
            name = next(iter(wrong))
            text = f"{side}_heading contradicts {len(wrong)} of {counted(judged, 'line')}. {name}: "
            found.append(Suspicion(text + texts[name], True))
        else:
            found += [Suspicion(f"{name}: {text}", False, name) for name, text in texts.items()]
    return tuple(found)


def _shown(side: str, pose: Pose, points: FloatArray, length: float, reach: float) -> float | None:
    """Heading [rad] of a line at its clamp, as near to the declared one as it may be taken.

    None where the line begins too far from the fixture to tell, or its first piece, between points
    far apart, ends farther than `reach` [m] from it.
    """
    declared = getattr(pose, f"{side}_heading")
    place = pose.start if side == "start" else pose.end
    inward = points if side == "start" else points[::-1]
    before = float(np.hypot(*(inward[0] - place)))
    s, heading = _headings(inward, _STEP * length)
    if before > FITS * length or len(heading) == 0:
        return None
    # Of a loop the chord is short: pieces share the cable's length.
    whole = s[0] + s[-1]
    if before + 2 * s[0] * max(1.0, length / whole) > reach:
        return None
    if side == "end":
        heading = heading + np.pi
    candidates = [heading[0]]
    near = s < max(_PART * length, s[min(2, len(s) - 1)] + 1e-12)
    if near.sum() > 1:
        slope, offset = np.polyfit(s[near] + before, heading[near], 1)
        candidates.append(offset)
        candidates += list(offset + slope * s[near][:1])
    shown = [declared + _wrapped(value - declared) for value in candidates]
    best = float(min(shown, key=lambda value: abs(value - declared)))
    if side == "end" and abs(declared) > _TURN:
        return _continued(pose, points, length, best)
    return best


def _continued(pose: Pose, points: FloatArray, length: float, best: float) -> float:
    """The end's heading `best`, with as many turns as the line makes, if its points tell them."""
    _, heading = _headings(points, _STEP * length)
    if np.abs(np.diff(heading)).max(initial=0.0) > _TELLING:
        return best
    begin = heading[0] if pose.start_heading is None else pose.start_heading
    turned = begin + _wrapped(heading[0] - begin) + heading[-1] - heading[0]
    return float(turned + _wrapped(best - turned))


def _headings(points: FloatArray, step: float) -> tuple[FloatArray, FloatArray]:
    """Arc lengths [m] of the middles of pieces at least `step` long, and their headings [rad].

    Noise turns shorter pieces. Headings are continuous along the line.
    """
    kept = [0]
    for k in range(1, len(points)):
        if np.hypot(*(points[k] - points[kept[-1]])) >= step:
            kept.append(k)
    pieces = np.diff(points[kept], axis=0)
    size = np.hypot(pieces[:, 0], pieces[:, 1])
    return np.cumsum(size) - size / 2, np.unwrap(np.arctan2(pieces[:, 1], pieces[:, 0]))


def _wrapped(angle: float) -> float:
    """The same direction within half a turn [rad]."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def _guess(declared: float, shown: float) -> str:
    """What the declared heading may have been meant as."""
    guesses = {
        "in degrees?": float(np.radians(declared)),
        "headings point along the cable from its start to its end:": declared - np.pi,
        "counter-clockwise is positive:": -declared,
    }
    for question, value in guesses.items():
        if abs(_wrapped(value - shown)) < HEADING_NEAR:
            return f". Try: {question} then {value:.4g}."
    return ". Try: headings in radians, counter-clockwise from x, along the cable."
