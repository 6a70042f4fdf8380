"""Values and derivatives of `CasadiCable.function` with every effect, in the plane and in space.

    python scripts/check_function.py [EFFECT ...]

For each effect, at values away from those at which it vanishes: the outputs against
`solve_equilibrium`, their Jacobian, and the Hessian of a random sum of them, against differences of
fourth order, by all numbers of the pose and by all parameters. Exit code 1 above 1e-9, 1e-6, 1e-5.
"""

import argparse
import os
import sys
from collections.abc import Callable, Sequence

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dlo_casadi.effects import EFFECTS, BoundaryEffect, CableData, Effect
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.equilibrium.symbolic import CasadiCable, pose_of
from dlo_casadi.model.cable_model import CableModel

FloatArray = NDArray[np.floating]

# Largest error of values, and of first and second derivatives relative to the largest of them.
MOST = (1e-9, 1e-6, 1e-5)
POSES = {
    2: [0.01, 0.02, 0.5, 0.1, 0.3, -0.4],
    3: [0.01, 0.02, 0.03, 0.5, 0.1, 0.05, 0.1, 0.0, 0.1, 1.1, 0.1, 0.2, 0.0, 0.9, 0.0],
}


def model_of(effect: type[Effect] | None, dimension: int) -> tuple[CableModel, FloatArray]:
    """A cable with one effect, and its parameters."""
    cable = CableData(0.8, 0.05, 0.005, 0.01, torsional_stiffness=0.008 if dimension == 3 else None)
    held = effect is None or not issubclass(effect, BoundaryEffect) or "clamp" in effect.name
    model = CableModel(
        cable,
        n=10,
        start="clamped" if held else "pinned",
        end="clamped" if held else "pinned",
        gravity=(0.0, -9.81) if dimension == 2 else (0.0, 0.0, -9.81),
        effects=() if effect is None else (effect(),),
        n_rest=0,
    )
    away = [q.nominal + (0.5 * q.scale if q.scale and not q.log else 0.0) for q in model.parameters]
    return model, np.array(away)


def differences(function: Callable[[FloatArray], FloatArray], u: FloatArray) -> FloatArray:
    """Derivatives (rows, len(u)) by differences of fourth order."""
    columns = []
    for k, step in enumerate(1e-3 * np.maximum(np.abs(u), 0.01)):
        d = step * np.eye(len(u))[k]
        near, far = (function(u + j * d) - function(u - j * d) for j in (1, 2))
        columns.append((8 * near - far) / (12 * step))
    return np.stack(columns, axis=-1)


def errors(effect: type[Effect] | None, dimension: int) -> tuple[float, ...]:
    """Errors of values, first and second derivatives."""
    (model, p), pose = model_of(effect, dimension), np.array(POSES[dimension])
    rest = np.random.default_rng(1).normal(scale=0.5, size=model.chain.n_rests)
    rest[: -model.chain.n_cells * len(model.node.curvatures)] = 0.0
    function = CasadiCable(model, p, rest).function(parameters=True)
    eq = solve_equilibrium(model, p, rest, pose_of(model, pose))
    told = dict(zip(function.name_out(), map(np.array, function(pose, p)), strict=True))
    pairs = [
        (told["points"].T, eq.points),
        (told["end_force"].ravel(), eq.end_force),
        (told["end_moment"].ravel(), np.reshape(eq.moments, (2, -1))[1]),
        (told["energy"].item(), eq.energy),
        (told["min_bend_radius"].item(), eq.min_bend_radius),
    ]
    wrong = max(float(np.abs(found - known).max()) for found, known in pairs)
    u = ca.MX.sym("u", len(pose) + len(p))
    outs = ca.veccat(*function(u[: len(pose)], u[len(pose) :])[:-1])
    weights = np.random.default_rng(0).normal(size=outs.numel())
    hessian, gradient = ca.hessian(ca.dot(weights, outs), u)
    calls = [ca.Function("f", [u], [e]) for e in (outs, gradient, ca.jacobian(outs, u), hessian)]
    value, slope, jacobian, second = ((lambda v, f=f: np.array(f(v)).squeeze()) for f in calls)
    at, found = np.concatenate([pose, p]), [wrong]
    for exact, function_of in ((jacobian, value), (second, slope)):
        known = differences(function_of, at)
        found.append(float(np.abs(exact(at) - known).max() / np.abs(known).max()))
    return tuple(found)


def main(argv: Sequence[str] | None = None) -> int:
    """Print a line for each effect."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("effects", nargs="*", help="names; all by default")
    asked = parser.parse_args(argv).effects
    bad = False
    for name in asked or ["none", *EFFECTS]:
        for dimension in (2, 3):
            effect = EFFECTS.get(name)
            if effect is not None and dimension not in effect.dimensions:
                continue
            found = errors(effect, dimension)
            wrong = any(not error < most for error, most in zip(found, MOST, strict=True))
            bad |= wrong
            texts = "  ".join(f"{error:.1e}" for error in found)
            where = {2: "plane", 3: "space"}[dimension]
            print(f"{name:22s} {where}  {texts}{'  BAD' * wrong}", flush=True)
    return int(bad)


if __name__ == "__main__":
    sys.exit(main())
