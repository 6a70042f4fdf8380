"""Numbers in the text of exported files."""

from collections.abc import Sequence

import numpy as np

from dlo_casadi.arrays import FloatArray


def rounded(values: FloatArray) -> list:
    """Numbers as lists, to 12 digits."""
    plain: list = np.vectorize(lambda x: float(f"{x:.12g}"))(values).tolist()
    return plain


def array(values: FloatArray) -> str:
    """An array in Python, one row a line."""
    rows = ",\n    ".join(map(str, rounded(values)))
    return f"np.array([\n    {rows},\n])"


def head_of_python(
    head: Sequence[str], imports: Sequence[str], numbers: Sequence[tuple[str, str, str]]
) -> str:
    """Comments, imports, and numbers: name, value, meaning."""
    lines = [f"# {line}".rstrip() for line in head]
    lines += ["", *(f"import {name}" for name in imports), ""]
    for name, value, meaning in numbers:
        lines += [f"# {meaning}"] * bool(meaning) + [f"{name} = {value}"]
    return "\n".join(lines) + "\n"
