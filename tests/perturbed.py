"""Central differences of what an assembly says of poses, along directions of all it depends on."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dlo_casadi.equilibrium.batch import BatchEquilibrium
from dlo_casadi.equilibrium.solve import solve_equilibrium
from dlo_casadi.model.assembly import Assembly, Shapes, Tangents
from dlo_casadi.model.cable_model import CableModel

FloatArray = np.ndarray


def any_shapes(model: CableModel, m: int = 1, scale: float = 0.4) -> Shapes:
    """Nodes, multipliers and deviations of m poses without any symmetry."""
    rng = np.random.default_rng(0)
    node, n = model.node, model.chain.n_nodes
    x = node.moved(np.array(node.identity), rng.normal(scale=scale, size=(m, n, node.increment)))
    lam = rng.normal(size=(m, model.n_border))
    deviation = rng.normal(scale=0.01, size=(m, len(model.deviation_names)))
    return Shapes(x, lam, deviation)


def any_rest(model: CableModel, m: int = 1) -> FloatArray:
    """Rest curvatures (m, n_rests) [1/m]."""
    return np.random.default_rng(1).normal(size=(m, model.chain.n_rests))


def directions(model: CableModel, m: int, *names: str) -> Tangents:
    """One column for each number of the named parts of `Tangents`, the same in all poses."""
    rows = {
        "x": model.chain.n_nodes * model.node.increment,
        "lam": model.n_border,
        "p": len(model.parameters),
        "rest": model.chain.n_rests,
        "deviation": len(model.deviation_names),
    }
    q = sum(rows[name] for name in names)
    parts, used = {}, 0
    for name, count in rows.items():
        block = np.zeros((m, count, q))
        if name in names:
            block[:, np.arange(count), used + np.arange(count)] = 1.0
            used += count
        parts[name] = block
    parts["x"] = parts["x"].reshape((m, model.chain.n_nodes, -1, q))
    return Tangents(**parts)


def central(
    here: Assembly,
    function: Callable[[Assembly], FloatArray],
    along: Tangents,
    step: FloatArray | float = 1e-6,
) -> FloatArray:
    """Derivatives (..., q) of what a function of the assembly says, by steps (q,)."""
    shapes, given, q = here.shapes, here.given, along.lam.shape[2]
    columns = []
    for i, d in enumerate(np.broadcast_to(step, (q,))):
        values = []
        for h in (d, -d):
            there = Shapes(
                here.model.node.moved(shapes.x, h * along.x[..., i]),
                shapes.lam + h * along.lam[..., i],
                shapes.deviation + h * along.deviation[..., i],
            )
            others = replace(
                given, p=given.p + h * along.p[..., i], rest=given.rest + h * along.rest[..., i]
            )
            values.append(np.asarray(function(replace(here, shapes=there, given=others))))
        columns.append((values[0] - values[1]) / (2 * d))
    return np.stack(columns, axis=-1)


def assert_derivatives(model, pose, p, rest, columns):
    """Derivatives of curve and border are those of equilibria of changed parameters."""
    equilibria, size, h = BatchEquilibrium(model, [pose]), len(p), 2e-5
    eq = solve_equilibrium(model, p, rest, pose)
    shapes, _ = equilibria.solve(eq.shapes, p, rest, tolerance=1e-13)
    along = equilibria.directions(shapes, p, rest, np.eye(size), np.zeros((len(rest), size)))
    ((_, change),) = equilibria.observe(shapes, p, rest, along)
    for k in columns:
        rows = []
        for step in (-2 * h, -h, h, 2 * h):
            moved = p + step * np.eye(size)[k]
            there, ok = equilibria.solve(shapes, moved, rest, tolerance=1e-13)
            assert ok.all()
            (seen,) = equilibria.seen(there, moved, rest)
            rows.append(np.concatenate([seen.curve.numbers.ravel(), there.lam[0]]))
        expected = (rows[0] - 8 * rows[1] + 8 * rows[2] - rows[3]) / (12 * h)
        found = np.concatenate([change.curve[..., k].ravel(), along.lam[0, :, k]])
        scale = np.abs(expected).max()
        np.testing.assert_allclose(found, expected, atol=1e-8 * scale, err_msg=model.names[k])
