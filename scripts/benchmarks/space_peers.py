"""Time of a shape in space with other tools: IPOPT, MuJoCo's cable and PyElastica.

The cable of space_speed, straight at rest, in its first poses. As in `peers`, the simulators are
relaxed to rest; that they do more, and that building models and PyElastica's compilation are not
timed, holds here, too. All of them start from that first guess of the C solver which is nearest to
its shape; IPOPT from each, and the fastest that leads there counts. Errors are distances of nodes
from the C solver's on a mesh of 96 quadratic elements at the same arc length.

- Both simulators hold their first and last element by direction, not the cable at its ends.
- PyElastica: its axial and shear stiffness are those of a solid round rod with this EI and GJ.
- MuJoCo: the start is fixed, the end a weld, as stiff as it allows.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from cables.ipopt import Ipopt
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.peers import COURANT, missing_elastica, missing_mujoco, relax, relax_rod
from benchmarks.space_speed import CABLE, FINE, Timed, problem, reference
from dlo_casadi.equilibrium.guesses import guessed_frames
from dlo_casadi.equilibrium.pose import HeldPose
from dlo_casadi.model.assembly import Assembly

FloatArray = NDArray[np.floating]
RADIUS = CABLE.diameter / 2
AREA, SECOND_MOMENT = np.pi * RADIUS**2, np.pi * RADIUS**4 / 4
YOUNG = CABLE.bending_stiffness / SECOND_MOMENT
TWIST = CABLE.torsional_stiffness  # [N m^2]
SHEAR = TWIST / (2 * SECOND_MOMENT)
GRAVITY = (0.0, 0.0, -9.81)
# Damping [1/s] of PyElastica, and of a joint in MuJoCo relative to its stiffness [s]: by hand.
UNIFORM_DAMPING, JOINT_DAMPING = 20.0, 0.1


@dataclass(frozen=True)
class Start:
    """Links of equal length from the start to the end, with their frames: for a simulator."""

    pose: HeldPose
    nodes: FloatArray  # (n + 1, 3) [m]
    frames: Rotation  # (n,)


def start_at(pose: HeldPose, n: int, fine: FloatArray) -> Start:
    """The first guess that lies nearest to a shape, its links turned until they reach the end."""
    own = problem(n, "arc", 0.0)
    ends = np.array(pose.start), np.array(pose.end)
    h, found = CABLE.length / n, []
    for guess in guessed_frames(own.model, own.model.nominal, own.rest, pose):
        # Both quaternions of neighbours have the same sign: their mean is the frame between.
        frames = Rotation.from_quat(guess[1:] + guess[:-1])
        clamps = Rotation.concatenate([Rotation.from_quat(pose.frames[k]) for k in (0, 1)])
        frames = Rotation.concatenate([clamps[0], frames[1:-1], clamps[1]])
        ways = frames.apply([1.0, 0.0, 0.0])
        inner = ways[1:-1]
        for _ in range(100):
            gap = (ends[1] - ends[0]) / h - ways.sum(axis=0)
            inner = inner + gap / len(inner)
            inner /= np.linalg.norm(inner, axis=1)[:, None]
            ways = np.vstack([ways[:1], inner, ways[-1:]])
        before = frames.apply([1.0, 0.0, 0.0])
        axis = np.cross(before, ways)
        sine, cosine = np.linalg.norm(axis, axis=1), (before * ways).sum(axis=1)
        turn = axis * (np.arctan2(sine, cosine) / np.maximum(sine, 1e-12))[:, None]
        nodes = np.vstack([ends[0], ends[0] + h * np.cumsum(ways, axis=0)])
        found.append(Start(pose, nodes, Rotation.from_rotvec(turn) * frames))
    return min(found, key=lambda start: float(distances(start.nodes, fine).max()))


def distances(nodes: FloatArray, fine: FloatArray) -> FloatArray:
    """Distances [m] of nodes (n + 1, 3) from those of the fine mesh; n divides FINE."""
    return np.linalg.norm(nodes - fine[:: FINE // (len(nodes) - 1)], axis=1)


# A method takes a pose and the fine shape and returns nodes (n + 1, 3) and seconds.
Method = Callable[[HeldPose, FloatArray], tuple[FloatArray, float]]


def compiled(n: int, element: str) -> Method:
    """The generated C solver, cold."""
    timed = Timed(problem(n, element, 0.0))

    def solve(pose: HeldPose, fine: FloatArray) -> tuple[FloatArray, float]:
        seconds, shape = timed.solve(pose, None, 20)
        return shape["points"][0], float(np.median(seconds))

    return solve


def ipopt(n: int, element: str) -> Method:
    """IPOPT through CasADi, of the same model; points from its frames by the Python model."""
    from dlo_casadi.model.assembly import Inputs, Shapes

    own = problem(n, element, 0.0)
    solver = Ipopt(own.model)

    def solve(pose: HeldPose, fine: FloatArray) -> tuple[FloatArray, float]:
        given = Inputs.of(own.model.nominal, own.rest, pose.vector[None])
        results = []
        for found in solver.solve(own.model.nominal, own.rest, pose):
            shapes = Shapes.declared(found.frames[None], found.multipliers[None])
            nodes = Assembly(own.model, shapes, given).nodes()[0]
            results.append((nodes, found.seconds))
        least = min(float(distances(nodes, fine).max()) for nodes, _ in results)
        there = [r for r in results if distances(r[0], fine).max() < 1.1 * least + 1e-6]
        return min(there, key=lambda r: r[1])

    return solve


def elastica(n: int) -> Method:
    """PyElastica: position Verlet, uniform damping, both end elements held."""
    import elastica as ea

    density = CABLE.mass / (AREA * CABLE.length)
    # The shear mode of an element on its own small rotary inertia limits explicit steps.
    step = COURANT * 2 / np.sqrt(SHEAR * AREA / (density * SECOND_MOMENT))

    def solve(pose: HeldPose, fine: FloatArray) -> tuple[FloatArray, float]:
        start = start_at(pose, n, fine)
        # Their third director is along the rod.
        directors = start.frames.as_matrix()[:, :, [1, 2, 0]].transpose(2, 1, 0)
        rod = ea.CosseratRod.straight_rod(
            *(n, start.nodes[0], directors[2, :, 0], directors[0, :, 0]),
            *(CABLE.length, RADIUS, density),
            youngs_modulus=YOUNG,
            shear_modulus=SHEAR,
            position=start.nodes.T.copy(),
            directors=directors.copy(),
        )
        ends = (0, -1)
        held = {"constrained_position_idx": ends, "constrained_director_idx": ends}
        return relax_rod(rod, held, UNIFORM_DAMPING, step, GRAVITY)[:2]

    return solve


CABLE_XML = """
<mujoco>
  <extension><plugin plugin="mujoco.elasticity.cable"/></extension>
  <option timestep="{step}" gravity="0 0 -9.81" integrator="implicitfast" tolerance="1e-12">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <site name="clamp" pos="{end}" quat="{end_frame}"/>
    <body pos="{start}" quat="{start_frame}">
      <composite type="cable" curve="s" count="{nodes} 1 1" size="{length}" initial="none">
        <plugin plugin="mujoco.elasticity.cable">
          <config key="bend" value="{young}"/>
          <config key="twist" value="{shear}"/>
        </plugin>
        <joint kind="main" damping="{damping}"/>
        <geom type="capsule" size="{radius}" mass="{mass}"/>
      </composite>
    </body>
  </worldbody>
  <equality>
    <weld site1="S_last" site2="clamp" solref="{softest} 1" solimp="0.9999 0.9999 0.001"/>
  </equality>
</mujoco>
"""


def mujoco(n: int) -> Method:
    """MuJoCo: links on ball joints, the plugin's moments EI / h and GJ / h."""
    import mujoco as mj

    h, line = CABLE.length / n, CABLE.mass / CABLE.length
    # Explicit moments: the shortest waves of bending and of twist limit the step.
    bending = h**2 / 2 * np.sqrt(line / CABLE.bending_stiffness)
    twisting = h * np.sqrt(line * RADIUS**2 / 2 / TWIST)
    step = COURANT * min(bending, twisting)

    def text(values: FloatArray) -> str:
        return " ".join(f"{value:.17g}" for value in values)

    def solve(pose: HeldPose, fine: FloatArray) -> tuple[FloatArray, float]:
        start = start_at(pose, n, fine)
        first, last = (np.roll(frame, 1) for frame in pose.frames)  # w ahead
        model = mj.MjModel.from_xml_string(
            CABLE_XML.format(
                step=step,
                softest=2 * step,
                start=text(np.array(pose.start)),
                end=text(np.array(pose.end)),
                start_frame=text(first),
                end_frame=text(last),
                nodes=n + 1,
                length=CABLE.length,
                young=YOUNG,
                shear=SHEAR,
                damping=JOINT_DAMPING / n * CABLE.bending_stiffness / h,
                radius=RADIUS,
                mass=CABLE.mass / n,
            )
        )
        data = mj.MjData(model)
        turns = (start.frames[:-1].inv() * start.frames[1:]).as_quat()
        data.qpos[:] = np.roll(turns, 1, axis=1).ravel()
        end = model.site("S_last").id
        links = [
            model.body(f"B_{'first' if k == 0 else 'last' if k == n - 1 else k}").id
            for k in range(n)
        ]

        def advance(many: int) -> FloatArray:
            if many:
                mj.mj_step(model, data, nstep=many)
            mj.mj_kinematics(model, data)
            return np.vstack([data.xpos[links], data.site_xpos[end]])

        found, seconds, _ = relax(advance, step)
        return found, seconds

    return solve


def run(poses: int = 4) -> dict[str, Any]:
    """All methods; rows by method and number of elements."""
    methods: list[tuple[str, int, Callable[[], Method]]] = [
        *(
            ("C solver, quadratic", n, lambda n=n: compiled(n, "quadratic"))
            for n in (6, 12, 24, 48)
        ),
        *(("C solver, arcs", n, lambda n=n: compiled(n, "arc")) for n in (12, 24, 48, 96)),
        *(("IPOPT, quadratic", n, lambda n=n: ipopt(n, "quadratic")) for n in (6, 12, 24)),
    ]
    out: dict[str, Any] = {"poses": poses, "load_before": os.getloadavg()}
    for name, missing, make in (
        ("MuJoCo", missing_mujoco(), mujoco),
        ("PyElastica", missing_elastica(), elastica),
    ):
        if missing:
            print(f"{name}: not measured, {missing}", flush=True)
            out.setdefault("not_measured", {})[name] = missing
        else:
            methods += [(name, n, lambda n=n, make=make: make(n)) for n in (12, 24)]
    fine, rows = reference(0.0), []
    for name, n, make in methods:
        method = make()
        found = [
            method(pose, shape)
            for pose, shape in zip(problem(n, "arc", 0.0).poses[:poses], fine, strict=False)
        ]
        errors = [
            float(distances(nodes, shape).max())
            for (nodes, _), shape in zip(found, fine, strict=False)
        ]
        row = {
            "method": name,
            "n": n,
            "seconds": float(np.median([seconds for _, seconds in found])),
            "error_m": float(np.median(errors)),
            "largest_error_m": max(errors),
        }
        rows.append(row)
        print(
            f"{name:20s} n {n:3d} {1e3 * row['seconds']:11.3f} ms   largest error of a node "
            f"{1e3 * row['error_m']:8.4f} mm (median), most {1e3 * row['largest_error_m']:8.4f} mm",
            flush=True,
        )
    return out | {"rows": rows, "faster_than": _faster(rows), "load_after": os.getloadavg()}


def _faster(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Of each other method's fastest row: over the C solver's fastest that errs no more."""
    ours = [row for row in rows if row["method"].startswith("C solver")]
    out = {}
    for row in rows:
        as_good = [own["seconds"] for own in ours if own["error_m"] <= row["error_m"]]
        if row not in ours and as_good:
            quotient = row["seconds"] / min(as_good)
            out[row["method"]] = min(quotient, out.get(row["method"], np.inf))
    return out


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Error against time."""
    figure, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    for name in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == name]
        axes.loglog(
            [row["seconds"] for row in own],
            [1e3 * row["error_m"] for row in own],
            "o-",
            label=name,
        )
    axes.set_xlabel("time of a shape [s]")
    axes.set_ylabel("largest error of a node, median of the poses [mm]")
    axes.legend()
    axes.grid(visible=True, which="both", alpha=0.3)
    figure.savefig(path, dpi=150)
    plt.close(figure)
