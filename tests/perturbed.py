"""Central differences of what an assembly says of poses, along directions of all it depends on."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dlo_casadi.model.assembly import Assembly, Inputs, Shapes, Tangents

FloatArray = np.ndarray


def any_shapes(a: Assembly, m: int = 1, scale: float = 0.4) -> Shapes:
    """Nodes, multipliers and deviations of m poses without any symmetry."""
    rng = np.random.default_rng(0)
    x = a.node.moved(np.array(a.node.identity), rng.normal(scale=scale, size=(m, a.n, a.b)))
    lam = rng.normal(size=(m, a.k))
    deviation = rng.normal(scale=0.01, size=(m, len(a.model.deviation_names)))
    return Shapes(x, lam, deviation)


def any_rest(a: Assembly, m: int = 1) -> FloatArray:
    """Rest curvatures (m, n_rests) [1/m]."""
    return np.random.default_rng(1).normal(size=(m, a.chain.n_rests))


def directions(a: Assembly, m: int, *names: str) -> Tangents:
    """One column for each number of the named parts of `Tangents`, the same in all poses."""
    rows = {
        "x": a.n * a.b,
        "lam": a.k,
        "p": len(a.model.parameters),
        "rest": a.chain.n_rests,
        "deviation": len(a.model.deviation_names),
    }
    q = sum(rows[name] for name in names)
    parts, used = {}, 0
    for name, count in rows.items():
        block = np.zeros((m, count, q))
        if name in names:
            block[:, np.arange(count), used + np.arange(count)] = 1.0
            used += count
        parts[name] = block
    parts["x"] = parts["x"].reshape((m, a.n, a.b, q))
    return Tangents(**parts)


def central(
    a: Assembly,
    function: Callable[[Shapes, Inputs], FloatArray],
    shapes: Shapes,
    given: Inputs,
    along: Tangents,
    step: FloatArray | float = 1e-6,
) -> FloatArray:
    """Derivatives (..., q) of what a function of the shapes says, by steps (q,)."""
    q = along.lam.shape[2]
    columns = []
    for i, d in enumerate(np.broadcast_to(step, (q,))):
        values = []
        for h in (d, -d):
            there = Shapes(
                a.node.moved(shapes.x, h * along.x[..., i]),
                shapes.lam + h * along.lam[..., i],
                shapes.deviation + h * along.deviation[..., i],
            )
            others = replace(
                given, p=given.p + h * along.p[..., i], rest=given.rest + h * along.rest[..., i]
            )
            values.append(np.asarray(function(there, others)))
        columns.append((values[0] - values[1]) / (2 * d))
    return np.stack(columns, axis=-1)
