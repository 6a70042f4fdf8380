"""What the generated solver of a cable that is fed through its ends has beside."""

import casadi as ca
import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.codegen.c_text import statements
from dlo_casadi.model.cable_model import CableModel
from dlo_casadi.model.lagrangian import lagrangian_of
from dlo_casadi.rod.chain import with_cells_beyond


def feed_marks(model: CableModel, border: int) -> dict[str, int | str]:
    """What a template says of ends that slide, by mark; their rows are the last of the border."""
    sides, names = [k for k, own in enumerate(model.loose) if own], list[str]()
    by_length, unit = model.slides and model.fed_by_length, "tension beyond it [N]"
    rows, example = [0, 0], 2 * model.force_scale
    names = [f"{('start', 'end')[side]}_tension" for side in sides]
    if by_length:
        names, unit, example = ["free_length"], "length between the ends [m]", model.cable.length
    else:
        for row, side in enumerate(sides, border - len(sides)):
            rows[side] = row
    taken = zip(sides, names, strict=True)
    return {
        "LOOSE_START": model.start.slides,
        "LOOSE_END": model.end.slides,
        "BY_LENGTH": by_length,
        "SLIDING": len(model.sliding),
        "FED_ROW_START": rows[0],
        "FED_ROW_END": rows[1],
        "TAKE_FEED": " ".join(f"w->feed[{side}] = pose->{name};" for side, name in taken),
        "FEED_NUMBERS": "".join(f"    double {name}; /* {unit} */\n" for name in names),
        "EXAMPLE_FEED": "".join(f", {example:.4g}" for _ in names),
    }


def with_rows_beyond(rows: FloatArray) -> FloatArray:
    """Rows of even segments, and one before and one after them."""
    first, length = rows[0, :2]
    starts = first + length * np.arange(-1, len(rows) + 1)
    rest = with_cells_beyond(rows[:, 2:, None])[..., 0]
    return np.column_stack([starts, np.full(len(starts), length), rest])


def load_beyond(model: CableModel, p: ca.SX, given: ca.SX) -> ca.Function:
    """(s [m], given) -> force [N] of all distributed loads on the cable beyond s, and its slope.

    `given`: the parameters p, or none if these are numbers.
    """
    terms, s = lagrangian_of(model), ca.SX.sym("s")
    (force,) = ca.substitute([terms.resultant(s)], [terms.p], [p])
    found = ca.densify(ca.vertcat(force, ca.jacobian(force, s)))
    return ca.Function("load", [s, given], [found])


def load_text(function: ca.Function | None) -> str:
    """C text of the force of all distributed loads beyond an arc length, and its slope, if any."""
    if function is None:
        return ""
    targets = [f"out[{k}] =" for k in range(function.nnz_out())]
    return f"""\
/* Force [N] of all distributed loads on the cable beyond an arc length [m], then its derivative. */
static void load_beyond(const double *table, double at, double *out)
{{
    const double s[1] = {{at}};
{statements(function, ("s", "table"), targets)}
    (void)table, (void)s, (void)out;
}}
"""
