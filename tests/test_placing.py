"""Where to put clips: against a search on a grid and random places, and messages for bad input."""

from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest

from dlo_casadi.cable.estimate import EstimatedCable
from dlo_casadi.cable.held import held_pose
from dlo_casadi.cable.limits import Resolved
from dlo_casadi.cable.placing import ROOM, _Search, placed
from dlo_casadi.config import Limits
from dlo_casadi.effects import CableData
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.equilibrium.spread import SolvedCable
from dlo_casadi.errors import DloError
from dlo_casadi.model.cable_model import CableModel

KNOWN = SimpleNamespace(fixtures={}, limits=Limits(), coefficients=np.zeros(0))
LIMITS = {"bend_radius": 0.04, "force": 6.0}
POSES = [{"end": (0.5, 0.0)}, {"end": (0.4, 0.2)}]


pytestmark = pytest.mark.usefixtures("fewer_starts")


def cable(n=12, **more) -> EstimatedCable:
    data = CableData(0.8, 0.05, 0.006, 0.02, **more.pop("also", {}))
    model = CableModel(data, n, n_rest=0, **more)
    return EstimatedCable(model, model.nominal, np.zeros(model.chain.n_rests), KNOWN)


def used(known: EstimatedCable, clips: list[dict], limits: dict, poses=POSES):
    """What solved shapes use of the limits."""
    held = known.with_clips(["pinned"] * len(clips))
    asked = {"turns": 0.0, "branch": None, "clips": clips}
    for pose in poses:
        own = held_pose(held.model, {}, asked | pose)
        shape = SolvedCable.of(held.model, held.p, held.rest, own)
        yield from Resolved(shape, KNOWN.coefficients, Limits(**limits)).uses


@pytest.mark.long
def test_the_best_arc_length_at_a_given_place_is_that_of_a_grid():
    known, place = cable(), (0.25, -0.15)
    found = placed(known, 1, POSES, (place, place), LIMITS, "margin")
    chords = [0.0, 0.8] + np.array([1, -1]) * [
        np.hypot(*place) / ROOM,
        max(np.hypot(*np.subtract(pose["end"], place)) for pose in POSES) / ROOM,
    ]
    margins = [
        min(x.margin for x in used(known, [{"kind": "pinned", "at": s, "place": place}], LIMITS))
        for s in np.linspace(*chords, 21)
    ]
    assert found.clips[0].place == pytest.approx(place)
    # Between points of the grid the best margin is at most that of a kink: it may be 0.02 higher.
    assert max(margins) - 1e-3 < found.margin < max(margins) + 0.02


def test_two_clips_on_a_wall_keep_limits_with_what_is_said_of_them():
    known, wall = cable(), ((0.05, -0.1), (0.4, -0.1))
    found = placed(known, 2, POSES, wall, LIMITS, "margin")
    clips = [asdict(clip) for clip in found.clips]
    again = list(used(known, clips, LIMITS))
    assert [x.value for x in again] == pytest.approx([x.value for x in found.uses], rel=1e-3)
    assert 0 < found.margin == found.binding.margin < 1
    assert found.force == pytest.approx(max(x.value for x in found.uses if x.quantity == "force"))
    assert all(0.05 <= x.place[0] <= 0.4 and x.place[1] == -0.1 for x in found.clips)
    assert str(found.binding) in str(found)

    rng, others = np.random.default_rng(0), []
    for steps in rng.uniform(-0.01, 0.01, (6, 2, 2)):
        moved = [
            {**clip, "at": clip["at"] + ds, "place": (clip["place"][0] + dx, -0.1)}
            for clip, (ds, dx) in zip(clips, steps, strict=True)
        ]
        others.append(min(x.margin for x in used(known, moved, LIMITS)))
    assert max(others) < found.margin


def test_the_least_force_may_use_more_of_the_bend_radius():
    known, wall, poses = cable(), ((0.05, -0.1), (0.4, -0.1)), POSES[:1]
    sharp = {"bend_radius": 0.07}
    least = placed(known, 1, poses, wall, sharp, "force")
    mild = placed(known, 1, poses, wall, sharp, "margin")
    assert least.force < mild.force
    assert 0 <= least.margin < mild.margin
    corners = (wall[1][0], wall[0][1]), (wall[0][0], wall[1][1])  # in any order
    free = placed(known, 1, poses, corners, None, "force")
    assert (free.uses, free.binding, free.margin) == ((), None, 1.0)
    assert free.force <= least.force + 1e-3


@pytest.mark.parametrize("aim", ["margin", "force"])
def test_the_first_order_model_is_the_derivative_of_solved_shapes(aim):
    """Room of spans is compared exactly, sizes along a direction of all places and arc lengths."""
    held = tuple(HeldPose((0.0, 0.0), pose["end"]) for pose in POSES)
    between, box = cable().with_clips(["pinned"] * 2), np.array([[0.0, -0.3], [0.6, 0.1]]) / 0.8
    search = _Search(between, held, box, Limits(**LIMITS), aim)
    z, way = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 6))
    z = np.array([0.3, 0.2, -0.1, 0.6, 0.42, -0.05]) + 0.02 * z
    spare, by_z = search.spare(z)
    chord = np.hypot(*(z[4:] - z[1:3]))
    assert spare[1] == pytest.approx(ROOM * (z[3] - z[0]) - chord, abs=1e-14)
    step = 1e-5 * way
    changed = search.spare(z + step)[0] - search.spare(z - step)[0]
    assert by_z @ way == pytest.approx(changed / 2e-5, abs=1e-8)
    scales = np.array([[1.0, 2.0], [1.5, 0.5]])
    here, ahead, back = (search.solved_at(x, scales) for x in (z, z + step, z - step))
    for exact, more, less in zip(
        search.slopes(here, scales),
        (ahead.aims, ahead.others),
        (back.aims, back.others),
        strict=True,
    ):
        # Slopes are taken over 1 mm to either side: a hundredth of a few.
        assert exact @ way == pytest.approx((more - less) / 2e-5, rel=0.02, abs=1e-3)
    least = search.cable.model.force_scale
    for row, sizes, scale in zip((0, 1), here.sizes, scales, strict=True):
        shares = here.aims if aim == "margin" else here.others
        own = np.split(shares, 2)[row]
        expected = [0.04 * scale[0] * sizes["curvature"], scale[1] * sizes["force"] / 6.0]
        np.testing.assert_allclose(own, np.concatenate(expected), rtol=1e-12)
    if aim == "force":
        forces = np.concatenate([sizes["force"] for sizes in here.sizes])
        np.testing.assert_allclose(here.aims * least, forces, rtol=1e-12)


@pytest.mark.long
def test_no_place_near_a_clip_in_space_is_better():
    known = cable(8, gravity=(0.0, 0.0, -9.81), also={"torsional_stiffness": 0.015})
    poses, box = [{"end": (0.5, 0.1, 0.0)}], ((0.1, -0.1, -0.3), (0.4, 0.2, 0.0))
    found = placed(known, 1, poses, box, {"force": 3.0}, "margin")
    (clip,) = (asdict(one) for one in found.clips)
    rng = np.random.default_rng(0)
    for ds, *step in rng.uniform(-0.01, 0.01, (5, 4)):
        place = np.clip(np.add(clip["place"], step), *box)
        other = [{**clip, "at": clip["at"] + ds, "place": tuple(place)}]
        assert min(x.margin for x in used(known, other, {"force": 3.0}, poses)) < found.margin


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"limits": {"force": 0.2}}, r"no places of 1 pinned clip .* 2 poses.*\n.*≤ 0.2 N"),
        ({"limits": None}, "no limit is given"),
        ({"limits": {"moment": 1.0}}, "no end is clamped"),
        (
            {"within": ((2.0, 0.0), (2.1, 0.1))},
            "a span is longer than 95% of its cable, by [0-9.]+e",
        ),
        ({"within": ((0.3, 0.0, 0.1), (0.1, 0.1, 0.2))}, "two corners of a region"),
        ({"within": (0.1, 0.2)}, "two corners of a region"),
        ({"within": "wall"}, "two corners of a region"),
        ({"count": 0}, "1 or more"),
        ({"aim": "beauty"}, "one of margin, force"),
        ({"poses": []}, "as `solve` takes them"),
        ({"poses": 5}, "as `solve` takes them"),
        ({"poses": [(0.3, -0.1)]}, r"as `solve` takes them, found \[\(0.3, -0.1\)"),
        ({"poses": [{"end": (0.5, 0.0), "over": True}]}, "'over' is not about.* Try: end, start"),
        ({"poses": [{"end": (0.5, 0.0), "start_heading": 0.1}]}, "start_heading has no meaning"),
        ({"poses": [{"end": (5.0, 0.0)}]}, "5.0000 m from the start"),
    ],
)
def test_messages(changed, said):
    wall = ((0.05, -0.1), (0.4, -0.1))
    asked = {"count": 1, "poses": POSES, "within": wall, "limits": LIMITS, "aim": "margin"}
    with pytest.raises(DloError, match=f"(?s){said}"):
        placed(cable(), **(asked | changed))
