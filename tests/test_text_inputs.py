"""Tables and configurations as spreadsheets, scripts and computers of other countries write them.

Each is read as what it means, or refused with the line, the cause and what to do; and nothing is
written.
"""

import re

import numpy as np
import pytest
from files import tree

from dlo_casadi.cli import main
from dlo_casadi.config import load_config
from dlo_casadi.errors import ConfigError, MeasurementError
from dlo_casadi.io.points import read_points
from dlo_casadi.io.tables import read_table

LINE = np.array([[0.0, 0.0], [0.25, -0.125], [0.5, 0.125]])
POINTS = "x_m,y_m\n0,0\n0.25,-0.125\n0.5,0.125\n"
COMMAS = POINTS.replace(",", ";").replace(".", ",")
UTF_16 = POINTS.encode("utf-16-le")

READ = {
    "semicolons and decimal commas": COMMAS,
    "quoted decimal commas": '"x_m","y_m"\n"0","0"\n"0,25","-0,125"\n"0,5","0,125"\n',
    "UTF-16 with a mark": POINTS.encode("utf-16"),
    # ---- further ones
    "UTF-16 without a mark": UTF_16,
    "UTF-16, big end first": POINTS.encode("utf-16-be"),
    "UTF-8 with a mark": POINTS.encode("utf-8-sig"),
    "UTF-32": POINTS.encode("utf-32"),
    "tabs": POINTS.replace(",", "\t"),
    "tabs and decimal commas": COMMAS.replace(";", "\t"),
    "blanks, as NumPy saves it": "# x_m y_m\n" + POINTS[8:].replace(",", " "),
    "a header of commas above blanks": "# x_m,y_m\n" + POINTS[8:].replace(",", "   "),
    "upper case": POINTS.upper(),
    "units apart": COMMAS.replace("x_m;y_m", "X [m];Y (m)"),
    "a line for a spreadsheet": "sep=;\n" + COMMAS,
    "an index without a name": ",x_m,y_m\n0,0,0\n1,0.25,-0.125\n2,0.5,0.125\n",
    "names of rows, as R writes them": '"x_m" "y_m"\n"1" 0 0\n"2" 0.25 -0.125\n"3" 0.5 0.125\n',
    "other columns and order": "who,y_m,x_m,ok\na,0,0,?\nb,-0.125,0.25,1_0\nc,0.125,0.5,\n",
    "comments": "% digitised\n" + POINTS.replace("0.25", "# a point\n0.25"),
    "a minus of typography": POINTS.replace("-", "\u2212"),
    "the lines of an old Mac": POINTS.replace("\n", "\r"),
    "a separator at the end": POINTS.replace("\n", ",\n"),
    "exponents of Fortran's neighbours": POINTS.replace("0.25", "2.5E-01"),
    "Latin-1": POINTS.replace("\n", ",\u00f6\n").encode("latin-1"),
}


def written(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("name", READ)
def test_a_table_is_read_as_what_it_means(name, tmp_path):
    found = read_points(written(tmp_path / "a.csv", READ[name]), (0.0, 0.0)).points
    np.testing.assert_array_equal(found, LINE)


REFUSED = {
    "both decimal signs": (
        "x_m;y_m\n0,5;1\n0.7;1\n",
        "line 2: '0,5' has a decimal comma, but line 3 has a decimal point in '0.7'; write all",
    ),
    "signs between thousands": (
        "x_m;y_m\n0;0\n1.000,5;1\n",
        "line 3: '1.000,5' is not a number; write decimals with a point, and nothing between",
    ),
    "commas everywhere": (
        "x_m,y_m\n0,5,0,1\n",
        "line 2: two numbers x,y belong here, found 4: '0,5,0,1'; a comma separates the columns",
    ),
    "millimetres": ("x_mm,y_mm\n5,1\n", "line 1: .*'x_mm,y_mm'; divide x_mm by 1000 and call it"),
    "no unit": ("x,y\n5,1\n", "line 1: the header must be .*'x,y'; if x is in metres, call it x_m"),
    "no header": ("0,0\n5,1\n", "line 1: the header must be .*'0,0'; write it above the numbers"),
    "a workbook": (b"PK\x03\x04\x14\0\6\0", "not a text file: line 1 holds .* as text .CSV., not"),
    "an instant of a motion": ("t_s,x_m,y_m\n0,0,0\n", "line 1: .*; a pose is one instant: keep"),
    "space in a plane": (
        "x_m,y_m,z_m\n0,0,0\n",
        "line 1: .*; two coordinates belong to a cable in",
    ),
    "a name twice": ("x_m,y_m,Y_M\n0,0,0\n", "line 1: two columns are called y_m: leave one"),
    "digits in groups": (
        "x_m,y_m\n0,0\n1_000,1\n",
        "line 3: '1_000' is not a number of x_m; delete",
    ),
    "units in a row": (
        "x_m,y_m\nm,m\n0,0\n",
        "line 2: 'm' is not a number of x_m; delete the line",
    ),
    "a missing point": ("x_m;y_m\n0;0\nNaN;1\n", "line 3: 'NaN' is not a finite number; leave out"),
}

SESSION = """\
cable: {name: rope, length: 0.6, mass: 0.05, diameter: 0.005, bending_stiffness: 0.05}
experiment:
  gravity: [0.0, -9.81]
  boundary: {start: pinned, end: pinned}
  measurement: {kind: centerlines}
  poses:
    - {file: a.csv, start: [0, 0], end: [0.5, 0.125], role: fit}
    - {file: b.csv, start: [0, 0], end: [0.5, 0.125], role: fit}
"""


@pytest.mark.parametrize("name", REFUSED)
def test_a_table_is_refused_with_line_cause_and_remedy(name, tmp_path, capsys):
    content, said = REFUSED[name]
    written(tmp_path / "a.csv", content)
    with pytest.raises(MeasurementError, match=said):
        read_points(tmp_path / "a.csv", (0.0, 0.0))
    written(tmp_path / "b.csv", content)
    written(tmp_path / "rope.yaml", SESSION)
    before = tree(tmp_path)
    assert main(["check", str(tmp_path / "rope.yaml")]) == 2
    assert "a.csv: " in capsys.readouterr().err
    assert tree(tmp_path) == before


def test_what_may_be_read_in_two_ways_is_refused(tmp_path):
    """Below a header of commas, a comma may separate columns or decimals; not below semicolons."""
    rows = "1,5;a;2,5\n1,5;b;3,5\n"
    file = written(tmp_path / "a.csv", f"x_m;note;y_m\n{rows}")
    assert read_points(file, (0.0, 0.0)).points.tolist() == [[1.5, 2.5], [1.5, 3.5]]
    written(file, f"x_m,note,y_m\n{rows}")
    with pytest.raises(
        MeasurementError, match=r"line 2: .* may mean \[1.0, 5.0\] or \[1.5, 2.5\]; "
    ):
        read_points(file, (0.0, 0.0))


def test_columns_of_motions_and_fixtures_are_read_by_name(tmp_path):
    text = "t_s;start_qx;Start_X_M;note\n0;0,1;1;a\n0,01;0,2;2;b\n"
    wanted = ["t_s", "start_x_m", "start_qx"]
    table = read_table(written(tmp_path / "ends.csv", text), lambda names: wanted, "")
    np.testing.assert_array_equal(table["start_qx"], [0.1, 0.2])
    np.testing.assert_array_equal(table["t_s"], [0.0, 0.01])
    assert table.texts("note") == ["a", "b"]
    assert table.lines == (2, 3)


# ---- configurations ------------------------------------------------------------------------------

ESCAPE = "In double quotes a backslash begins an escape. Try: single quotes, .* or forward slashes"
WRONG = {
    "a path of Windows": ("file: a.csv", r'file: "C:\Users\lab\a.csv"', f"line 7: .*{ESCAPE}"),
    "a path with escapes": ("file: a.csv", r'file: "data\new\oa.csv"', f"line 7: .*{ESCAPE}"),
    "a path that is all escapes": ("file: a.csv", r'file: "data\new\table.csv"', ESCAPE),
    "a bell in a path": ("file: a.csv", r'file: "lab\bench.csv"', f"line 7: .*{ESCAPE}"),
    "backslashes": (
        "file: a.csv",
        r"file: 'poses\a.csv'",
        r"write / between folders: poses/a\.csv",
    ),
    "a decimal comma in braces": (
        "length: 0.6, mass: 0.05",
        "length: 0,6, mass: 0,05",
        "the decimal sign is a point; line 1: length: 0,6 means 0.6; line 1: mass: 0,05 means 0.05",
    ),
    "the same digits twice": (
        "length: 0.6, mass: 0.05, diameter: 0.005",
        "length: 0,6, mass: 0,6, diameter: 0.005",
        "line 1: length: 0,6 means 0.6; line 1: mass: 0,6 means 0.6",
    ),
    "with an exponent": ("mass: 0.05", "mass: 5,0e-2", "line 1: mass: 5,0e-2 means 5.0e-2"),
    "in brackets": ("[0.0, -9.81]", "[0, -9,81]", r"line 3: \[0, -9,81\] means \[0, -9.81\], or 3"),
    "in brackets without blanks": (
        "end: [0.5, 0.125]",
        "end: [0,5,0,125]",
        r"found \[0, 5, 0, 125\]; decimal commas\? The decimal sign is a point",
    ),
    "in a place": ("end: [0.5, 0.125]", "end: [0,5, 0,125]", r"line 7: \[0,5, 0,125\] means \[0.5"),
    "in a block": (
        SESSION.splitlines()[0],
        "cable:\n  length: 0,6\n  mass: 0.05\n  diameter: 0.005\n  bending_stiffness: 0.05",
        "line 2: .*'0,6'; the decimal sign is a point: 0.6",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_configuration_is_refused_with_line_cause_and_remedy(name, tmp_path):
    right, wrong, said = WRONG[name]
    assert right in SESSION
    written(tmp_path / "a.csv", POINTS)
    file = written(tmp_path / "rope.yaml", SESSION.replace(right, wrong))
    before = tree(tmp_path)
    try:
        told = load_config(file).skipped[0].reason
    except ConfigError as error:
        told = error.message
    assert re.search(said, told)
    assert tree(tmp_path) == before


def test_lists_of_whole_numbers_are_no_decimal_commas(tmp_path):
    """With or without blanks behind all commas."""
    written(tmp_path / "a.csv", POINTS)
    text = SESSION.replace("start: [0, 0]", "start: [0,0]")
    written(tmp_path / "b.csv", POINTS)
    assert load_config(written(tmp_path / "rope.yaml", text)).experiment.poses[0].start == (
        0.0,
        0.0,
    )
