"""Find mistakes about clips from the measured lines: places, kinds, order.

A measured line is straight between neighbouring points, so distances from it are exact up to
the sag between two points. Arc lengths are chords scaled to the cable, or those of markers.
"""

from dataclasses import dataclass

import numpy as np

from dlo_casadi.arrays import FloatArray, chord_lengths
from dlo_casadi.config import Pose
from dlo_casadi.model.clips import CLAMPS, HeldClip, tangents
from dlo_casadi.session.hypotheses import ReadSession, Suspicion
from dlo_casadi.session.outcome import PoseInput
from dlo_casadi.thresholds import CONTRADICTS, FITS, HEADING_OFF, NEARLY_ALL


@dataclass(frozen=True)
class _Passed:
    """Point of a measured line that is nearest to the declared place of a clip.

    `gap` [m]: its distance from the place; `at` [m]: its arc length; `ahead` (d,): tangent there.
    """

    gap: float
    at: float
    ahead: FloatArray


def wrong_clips(session: ReadSession) -> tuple[Suspicion, ...]:
    """Clips that are far from the measured lines, out of order, or not of the declared kind."""
    declared, length = session.declared, session.config.cable.length
    poses = [(declared[item.name], item) for item in session.read]
    found: list[Suspicion] = []
    for k, clip in enumerate(poses[0][0].held.clips if poses else ()):
        held = [pose.held.clips[k] for pose, _ in poses]
        own = [_passed(pose, item, held[j].place, length) for j, (pose, item) in enumerate(poses)]
        found += _far_off(session, k, np.array([one.gap for one in own])) or [
            *_of_other_kind(clip, held, own, length),
            *_turned(poses, held, own),
        ]
    return tuple(found) + (() if found else tuple(_out_of_order(poses, length)))


def _passed(pose: Pose, item: PoseInput, place: tuple[float, ...], length: float) -> _Passed:
    """The point of a measured line that is nearest to a place."""
    line = pose.held.joined(item.points)
    s = chord_lengths(line)
    chords = np.diff(s)
    if item.s is not None:
        s = np.concatenate([[0.0], item.s, [] if pose.end is None else [length]])
    elif pose.end is not None:
        s = s * length / s[-1]
    steps, toward = np.diff(line, axis=0), np.array(place) - line[:-1]
    share = np.clip((toward * steps).sum(axis=1) / np.maximum(chords**2, 1e-300), 0.0, 1.0)
    gaps = np.linalg.norm(toward - share[:, None] * steps, axis=1)
    i = int(gaps.argmin())
    at = s[i] + share[i] * (s[i + 1] - s[i])
    return _Passed(float(gaps[i]), float(at), steps[i] / max(chords[i], 1e-300))


def _far_off(session: ReadSession, k: int, gaps: FloatArray) -> list[Suspicion]:
    """Suspicion about one clip at distances `gaps` (m,) [m] from the lines; empty if it is near."""
    length, poses = session.config.cable.length, [session.declared[x.name] for x in session.read]
    clips = [pose.held.clips[k] for pose in poses]
    far = gaps > FITS * length
    if np.mean(far) < NEARLY_ALL:
        text = "{} is {:.3g} m from the measured line. Try: its place, in the frame of the points."
        return [
            Suspicion.of_pose(pose.name, text.format(clip.name, gap))
            for pose, clip, gap, off in zip(poses, clips, gaps, far, strict=True)
            if off
        ]
    typical = float(np.median(gaps))
    said = f"{clips[0].name} is {typical:.3g} m from the measured lines (median)"
    text = f"{said}. Try: its places, in metres and in the frame of the points."
    return [Suspicion(text, typical > CONTRADICTS * length)]


def _of_other_kind(
    clip: HeldClip, held: list[HeldClip], own: list[_Passed], length: float
) -> list[Suspicion]:
    """A clip that holds the cable at another arc length than declared, or lets it slide."""
    if clip.at is None:
        return []
    slid = np.array([one.at - (h.at or 0.0) for one, h in zip(own, held, strict=True)])
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


def _turned(
    poses: list[tuple[Pose, PoseInput]], held: list[HeldClip], own: list[_Passed]
) -> list[Suspicion]:
    """Clamped clips that the line leaves in another direction than declared."""
    clips = [clip for clip in held if clip.kind in CLAMPS]
    if not clips:
        return []
    node = poses[0][0].held.node
    frames = np.array([clip.frame for clip in clips])
    cosines = (tangents(node, frames) * np.array([one.ahead for one in own])).sum(axis=1)
    angles = np.arccos(np.clip(cosines, -1.0, 1.0))
    off = angles > HEADING_OFF
    if np.mean(off) >= NEARLY_ALL:
        text = (
            f"{clips[0].name}: the lines pass it {np.median(angles):.2g} rad (median) from its "
            "direction. Try: kind: pinned if it turns; x of its frame forward along the cable."
        )
        return [Suspicion(text, False)]
    text = "{} is turned {:.2g} rad from the measured line. Try: its direction; pinned if it turns."
    return [
        Suspicion.of_pose(pose.name, text.format(clip.name, angle))
        for (pose, _), clip, angle, wrong in zip(poses, clips, angles, off, strict=True)
        if wrong
    ]


def _out_of_order(poses: list[tuple[Pose, PoseInput]], length: float) -> list[Suspicion]:
    """Clips that the lines pass in another order."""
    for pose, item in poses:
        own = [_passed(pose, item, clip.place, length) for clip in pose.held.clips]
        order = np.argsort([one.at for one in own])
        if np.any(np.diff([one.at for one in own]) < -FITS * length):
            names = ", ".join(pose.held.clips[k].name for k in order)
            text = f"the line passes the clips in the order {names}. Try: clips in that order."
            return [Suspicion.of_pose(pose.name, text)]
    return []
