"""A table of how fixtures move."""

from pathlib import Path

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.errors import DloError
from dlo_casadi.io.tables import read_table
from dlo_casadi.rod.node import Node


def read_fixtures(node: type[Node], path: Path) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Times (T,) [s] and arguments of `FittedCable.simulate` from a table.

    Columns are t_s, start_x_m, start_y_m, start_heading_rad and the same with end_; in space also
    _z_m, and start_qx to start_qw, end_qx to end_qw. What rests may be left out.

    Raises
    ------
    DloError
        If the file is missing or has other columns, see `read_table`.
    """
    sides, time = ("start", "end"), "t_s"
    keys = {side: [f"{side}_{axis}_m" for axis in node.axes] for side in sides}
    keys |= {f"{side}_{node.direction}": [f"{side}_{x}" for x in node.columns] for side in sides}
    known = [time, *(column for group in keys.values() for column in group)]
    advice = f".\n  Try: {', '.join(known)}; the first line names them"

    def chosen(names: tuple[str, ...]) -> list[str]:
        """All columns."""
        if strange := [name for name in names if name and name not in known]:
            raise ValueError(f"unknown columns {strange}", advice)
        groups = [[time], *(group for group in keys.values() if {*group} & {*names})]
        if absent := [name for group in groups for name in group if name not in names]:
            raise ValueError(f"the column {absent[0]} is missing", advice)
        return [name for group in groups for name in group]

    table = read_table(path, chosen, f"a header {','.join([time, *keys['start']])} and rows")
    if len(table.lines) < 2:
        raise DloError(f"{path}: two rows or more belong here{advice}")
    rows: dict[str, FloatArray] = {}
    for key, group in keys.items():
        if group[0] in table.columns:
            values = np.stack([np.array(table[name], dtype=float) for name in group], axis=1)
            rows[key] = values[:, 0] if len(group) == 1 else values
    return np.array(table[time], dtype=float), rows
