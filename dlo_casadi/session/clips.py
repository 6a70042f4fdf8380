"""Find mistakes about clips from the measured lines: places, kinds, order.

A measured line is straight between neighbouring points, so distances from it are exact up to
the sag between two points. Arc lengths are chords scaled to the cable, or those of markers.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dlo_casadi.arrays import FloatArray, chord_lengths
from dlo_casadi.config import Pose
from dlo_casadi.model.clips import HeldClip, tangents
from dlo_casadi.rod.node import Node
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.session.questions import Suspicion
from dlo_casadi.session.read_session import ReadSession
from dlo_casadi.thresholds import CONTRADICTS, FITS, HEADING_OFF, NEARLY_ALL


@dataclass(frozen=True)
class _Passed:
    """Point of a measured line, of the pose of that name, nearest to the declared place of a clip.

    `gap` [m]: its distance from the place; `at` [m]: its arc length; `ahead` (d,): tangent there.
    """

    pose: str
    clip: HeldClip
    gap: float
    at: float
    ahead: FloatArray


def wrong_clips(session: ReadSession) -> tuple[Suspicion, ...]:
    """Clips that are far from the measured lines, out of order, or not of the declared kind."""
    length, fed = session.config.cable.length, session.config.experiment.boundary.fed
    poses = [(session.declared[item.name], item) for item in session.read]
    passed = [
        [_passed(pose, item, clip, length, fed) for clip in pose.held.clips] for pose, item in poses
    ]
    found: list[Suspicion] = []
    for own in zip(*passed, strict=True):  # one clip in all poses
        found += _far_off(own, length) or [
            *_of_other_kind(own, length),
            *_turned(own, poses[0][0].held.node),
        ]
    return tuple(found or _out_of_order(passed, length))


def _passed(
    pose: Pose, item: PoseInput, clip: HeldClip, length: float, fed: tuple[bool, bool]
) -> _Passed:
    line = pose.held.joined(item.points)
    s = chord_lengths(line)
    chords = np.diff(s)
    if item.s is not None:
        first = item.s[0] - chords[0] if fed[0] else 0.0
        last = item.s[-1] + chords[-1] if fed[1] else length
        s = np.concatenate([[first], item.s, [] if pose.end is None else [last]])
    elif pose.end is not None:
        s = s * length / s[-1]
    steps, toward = np.diff(line, axis=0), np.array(clip.place) - line[:-1]
    share = np.clip((toward * steps).sum(axis=1) / np.maximum(chords**2, 1e-300), 0.0, 1.0)
    gaps = np.linalg.norm(toward - share[:, None] * steps, axis=1)
    i = int(gaps.argmin())
    at = s[i] + share[i] * (s[i + 1] - s[i])
    ahead = steps[i] / max(chords[i], 1e-300)
    return _Passed(pose.name, clip, float(gaps[i]), float(at), ahead)


def _far_off(own: Sequence[_Passed], length: float) -> list[Suspicion]:
    """Suspicion about one clip that is far from the lines; empty if it is near."""
    gaps = np.array([one.gap for one in own])
    far = gaps > FITS * length
    if np.mean(far) < NEARLY_ALL:
        text = "{} is {:.3g} m from the measured line. Try: its place, in the frame of the points."
        return [
            Suspicion.of_pose(one.pose, text.format(one.clip.name, one.gap))
            for one, off in zip(own, far, strict=True)
            if off
        ]
    typical = float(np.median(gaps))
    said = f"{own[0].clip.name} is {typical:.3g} m from the measured lines (median)"
    text = f"{said}. Try: its places, in metres and in the frame of the points."
    return [Suspicion(text, typical > CONTRADICTS * length)]


def _of_other_kind(own: Sequence[_Passed], length: float) -> list[Suspicion]:
    """A clip that holds the cable at another arc length than declared, or lets it slide."""
    clip = own[0].clip
    if clip.at is None:
        return []
    slid = np.array([one.at - (one.clip.at or 0.0) for one in own])
    middle = float(np.median(slid))
    if np.ptp(slid) > FITS * length and np.mean(np.abs(slid - middle) < FITS * length / 4) < 0.5:
        text = (
            f"{clip.name}, {clip.kind}: the cable passes it from {slid.min():+.3g} to "
            f"{slid.max():+.3g} m of its arc length `at`. Try: kind: eyelet, if it slides through."
        )
        return [Suspicion(text, False)]
    if abs(middle) > FITS * length:
        text = (
            f"{clip.name}: the cable passes it {abs(middle):.3g} m "
            f"{'behind' if middle > 0 else 'before'} its arc length `at` (median). Try: at, from "
            "the start along the cable."
        )
        return [Suspicion(text, False)]
    return []


def _turned(own: Sequence[_Passed], node: type[Node]) -> list[Suspicion]:
    """A clamped clip that the lines leave in another direction than declared."""
    if not own[0].clip.kind.direction:
        return []
    frames = np.array([one.clip.frame for one in own])
    cosines = (tangents(node, frames) * np.array([one.ahead for one in own])).sum(axis=1)
    angles = np.arccos(np.clip(cosines, -1.0, 1.0))
    off = angles > HEADING_OFF
    if np.mean(off) >= NEARLY_ALL:
        text = (
            f"{own[0].clip.name}: the lines pass it {np.median(angles):.2g} rad (median) from its "
            "direction. Try: kind: pinned if it turns; x of its frame forward along the cable."
        )
        return [Suspicion(text, False)]
    text = "{} is turned {:.2g} rad from the measured line. Try: its direction; pinned if it turns."
    return [
        Suspicion.of_pose(one.pose, text.format(one.clip.name, angle))
        for one, angle, wrong in zip(own, angles, off, strict=True)
        if wrong
    ]


def _out_of_order(passed: Sequence[Sequence[_Passed]], length: float) -> list[Suspicion]:
    """Clips that the lines pass in another order, in the first pose where they do."""
    for own in passed:
        at = [one.at for one in own]
        if np.any(np.diff(at) < -FITS * length):
            names = ", ".join(own[k].clip.name for k in np.argsort(at))
            text = f"the line passes the clips in the order {names}. Try: clips in that order."
            return [Suspicion.of_pose(own[0].pose, text)]
    return []
