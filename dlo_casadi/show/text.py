"""Numbers as text with their units, and rows as a table of HTML."""

import math
from collections.abc import Iterable, Sequence
from html import escape

from dlo_casadi.errors import worded


def millimetres(value: float | None, nothing: str = "-") -> str:
    """A length [m] as text in mm, with three digits; a dash for none."""
    return nothing if value is None else worded("{value:mm}", value=value)


# Bend radius [m] from which on a cable is straight: over 100 m it deviates by a millimetre.
STRAIGHT = 1e6


def bend_radius(value: float) -> str:
    """A bend radius [m] as text."""
    return "straight" if value > STRAIGHT else millimetres(value)


def vector(components: Iterable[float], form: str, unit: str) -> str:
    """Components of a vector in brackets, and their unit."""
    return f"({', '.join(format(x, form) for x in components)}) {unit}"


def plus_minus(value: float, std: float) -> str:
    """A value rounded to two significant digits of its standard deviation."""
    if not (0 < std < math.inf and math.isfinite(value)):
        return f"{value:.4g}"
    decimals = 1 - math.floor(math.log10(std))
    if std >= 10 * abs(value) or not 0 <= decimals <= 7:
        digits = decimals + 1 + math.floor(math.log10(abs(value))) if value else 1
        return f"{value:.{max(digits, 1)}g} ± {std:.2g}"
    return f"{value:.{decimals}f} ± {std:.{decimals}f}"


def html_table(title: str, rows: Sequence[Sequence[str]], remarks: Iterable[str] = ()) -> str:
    """HTML table with everything escaped; the remarks follow below it."""
    columns = max(map(len, rows))
    full = [[*row, *[""] * (columns - len(row))] for row in rows]
    cells = ["".join(f"<td>{escape(cell)}</td>" for cell in row) for row in full]
    body = "".join(f"<tr>{row}</tr>" for row in cells)
    below = "".join(f"<div>{escape(remark.strip())}</div>" for remark in remarks)
    return f"<div><b>{escape(title)}</b><table>{body}</table>{below}</div>"
