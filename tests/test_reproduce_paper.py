"""The reproduction of the paper: its Table 4."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

from paper import energies, published


def test_table_4_within_its_print():
    rows = energies.rows_of_table_4(roundings=2)
    printed = published.table(4)
    assert len(rows) == len(printed) == 12
    for row, line in zip(rows, printed, strict=True):
        assert abs(row.before - line["V_theta0_alpha0_J"]) <= energies.ENERGY_TOLERANCE, row.pose


def test_bound_on_the_first_heading_contradicts_the_print():
    """A bound at -pi/2 on theta_1 costs the last pose energy that the print does not show."""
    last = published.poses()[-1]
    printed = published.table(4)[-1]["V_theta0_alpha0_J"]
    assert energies.with_bounded_heading(last) > printed + 4.0
