"""Tables of numbers in text files, as spreadsheets, scripts and laboratories write them.

Any encoding, separator, decimal sign and order of columns whose meaning is beyond doubt is read.
"""

import csv
import math
import re
from codecs import BOM_UTF8, BOM_UTF16_BE, BOM_UTF16_LE, BOM_UTF32_BE, BOM_UTF32_LE
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.config.problems import show
from dlo_casadi.errors import MeasurementError

BLANK = " "
SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", BLANK: "blanks"}

_LARGEST = 20_000_000
"""Bytes of a file: half a million points, measured to take two seconds."""

_COUNTS = {2: "two", 3: "three", 4: "four"}

# Marks of a comment line, which may name the columns: # of NumPy, % of MATLAB.
_COMMENT = re.compile(r"\s*(?:#+|%+|//+)\s*")
# First line by which a spreadsheet is told the separator.
_TOLD = re.compile(r'"?sep=(.)"?', re.IGNORECASE)
# A name with its unit apart: x [m], x (m), x / m.
_UNIT_APART = re.compile(r"(\w+?)_?\s*(?:\[\s*(\w+)\s*\]|\(\s*(\w+)\s*\)|/\s*(\w+))")
# Bytes that no text has, in any encoding that is read.
_NO_TEXT = re.compile("[\x00-\x08\x0e-\x1a\x1c-\x1f]")
# Signs that mean a minus or a blank in numbers of word processors.
_SIGNS = {"\u2212": "-", "\u00a0": " ", "\u202f": " "}
# UTF-16 marks before UTF-32 would take its first half.
_ENCODINGS = {
    BOM_UTF32_LE: "utf-32",
    BOM_UTF32_BE: "utf-32",
    BOM_UTF16_LE: "utf-16",
    BOM_UTF16_BE: "utf-16",
    BOM_UTF8: "utf-8-sig",
}

Columns = Callable[[tuple[str, ...]], Sequence[str]]
"""Given the names of all columns, those to read as numbers; ValueError, with what is wrong and
what to do, if they are none of such a table."""


@dataclass(frozen=True)
class Table:
    """Numbers under the names of their columns."""

    names: tuple[str, ...]
    """Of all columns in the file, in lower case; "" of one without a name."""
    columns: tuple[str, ...]
    """Those that were read as numbers."""
    numbers: FloatArray
    """(K, columns), finite."""
    lines: tuple[int, ...]
    """Line in the file of each row, counted from 1."""
    cells: tuple[Sequence[str], ...] = field(repr=False)
    """Text of all cells of each row, for columns that hold no numbers."""
    remarks: tuple[str, ...] = ()

    def texts(self, name: str) -> list[str]:
        """Cells (K,) of a column as text."""
        at = self.names.index(name)
        return [row[at] for row in self.cells]

    def __getitem__(self, name: str) -> FloatArray:
        """Numbers (K,) of a column."""
        return self.numbers[:, self.columns.index(name)]


def read_table(path: str | Path, columns: Columns, belongs: str) -> Table:
    r"""Read a table of numbers.

    Parameters
    ----------
    path : str or Path
        Text in UTF-8, UTF-16, UTF-32 or Latin-1. Columns are separated by commas, semicolons, tabs
        or blanks, decimals by a point or a comma; cells may be quoted. The first line names the
        columns, in any order and case (x_m, X_M, x [m]); it may begin with # or %. Comments and
        blank lines are skipped, and so is a first column of numbers of rows that has no name.
    columns : callable
        Maps the names found to those that are read as numbers. Others may hold anything.
    belongs : str
        What belongs in the file, for the message of an empty one: "a header x_m,y_m and points".

    Raises
    ------
    MeasurementError
        If the file is no such table, or if it can be read in several ways; the message names the
        line, what is wrong in it, and what to do.
    """
    source = Path(path)
    try:
        text, remarks = read_text(source)
        lines = [(k, line) for k, line in numbered_lines(text) if line.strip()]
        return _table(lines, '"' in text, columns, belongs, remarks)
    except ValueError as error:
        raise MeasurementError(str(error), pose=source.name) from None


def table_of_lines(lines: Sequence[tuple[int, str]], columns: Columns, belongs: str) -> Table:
    """As `read_table`, of numbered lines of a file, the first of which names the columns.

    Raises ValueError if they are no such table.
    """
    filled = [(k, line) for k, line in lines if line.strip()]
    return _table(filled, any('"' in line for _, line in filled), columns, belongs, ())


def read_text(path: Path) -> tuple[str, tuple[str, ...]]:
    """Text of a file, and a remark if its encoding had to be assumed.

    UTF-8 and UTF-16 with or without a byte-order mark, UTF-32 with one, or Latin-1. Raises
    ValueError if it is no text, or too large.
    """
    try:
        with path.open("rb") as file:
            content = file.read(_LARGEST + 1)
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror}") from None
    if len(content) > _LARGEST:
        raise ValueError(
            f"is larger than {_LARGEST} bytes; keep every tenth point, a few hundred suffice"
        )
    return decoded(content, path.name)


def decoded(content: bytes, name: str) -> tuple[str, tuple[str, ...]]:
    """Text of the content of a file, as `read_text` returns it."""
    remarks: tuple[str, ...] = ()
    try:
        text = content.decode(_encoding(content))
    except UnicodeDecodeError as error:  # numbers and keywords are ASCII in all encodings
        line = content.count(b"\n", 0, error.start) + 1
        text = content.decode("latin-1")
        remarks = (f"{name} is not UTF-8 (line {line}): its names are read as Latin-1",)
    if found := _NO_TEXT.search(text):
        line = text.count("\n", 0, found.start()) + 1
        raise ValueError(
            f"is not a text file: line {line} holds {found[0]!r}. Save it as text (CSV), not as a "
            "workbook or picture"
        )
    for sign, meant in _SIGNS.items():
        text = text.replace(sign, meant)
    return text, remarks


def _encoding(content: bytes) -> str:
    for mark, encoding in _ENCODINGS.items():
        if content.startswith(mark):
            return encoding
    # Every second byte of ASCII in UTF-16 is zero; in other encodings none is.
    even, odd = content[0:200:2], content[1:200:2]
    if odd and not odd.strip(b"\0") and b"\0" not in even:
        return "utf-16-le"
    return "utf-16-be" if even and not even.strip(b"\0") and b"\0" not in odd else "utf-8"


def numbered_lines(text: str) -> Iterator[tuple[int, str]]:
    """Lines of a text with their numbers, counted from 1."""
    return enumerate(re.split(r"\r\n|\r|\n", text), start=1)


def split(line: str, separator: str, quoted: bool = True) -> list[str]:
    """Cells of a line, without blanks around them and without quotes."""
    if separator == BLANK:
        return [cell.strip("\"'") for cell in line.split()]
    if quoted and '"' in line:
        return [cell.strip() for cell in next(csv.reader([line.strip()], delimiter=separator), [])]
    return [cell.strip() for cell in line.split(separator)]


def as_numbers(
    rows: Iterable[Sequence[str]],
    at: Sequence[int],
    lines: Sequence[int],
    names: Sequence[str],
    gaps: bool = False,
) -> FloatArray:
    """Numbers (K, n) in the n columns `at` of rows of text; a comma may be their decimal sign.

    Parameters
    ----------
    lines, names
        Line of each row and name of each column of `at`, for messages.
    gaps : bool
        Empty cells, and those that say NaN, are nan; otherwise only finite numbers are read.

    Raises
    ------
    ValueError
        With the line and the sign at which this fails.
    """
    cells = [row[k] for row in rows for k in at]
    shape = len(cells) // max(len(at), 1), len(at)
    if gaps:
        cells = [cell if cell and not cell.isspace() else "nan" for cell in cells]
    if any("," in cell for cell in cells):
        cells = _with_points(cells, lines, len(at))
    wrong = any("_" in cell for cell in cells)  # Python's float reads 1_000, which no file means
    found = np.full(len(cells), np.nan)
    try:
        found = np.array([float(cell) for cell in cells])
    except ValueError:
        wrong = True
    allowed = np.isnan(found) if gaps else np.zeros(len(cells), bool)
    if wrong or not (np.isfinite(found) | allowed).all():
        for k, cell in enumerate(cells):
            if reason := _no_number(cell, names[k % shape[1]], gaps):
                raise ValueError(f"line {lines[k // shape[1]]}: {reason}")
    return found.reshape(shape)


def _with_points(cells: Sequence[str], lines: Sequence[int], width: int) -> list[str]:
    """Cells with decimal points for decimal commas; ValueError if both signs occur."""
    comma = next(k for k, cell in enumerate(cells) if "," in cell)
    if cells[comma].count(",") + cells[comma].count(".") > 1:
        raise ValueError(
            f"line {lines[comma // width]}: {show(cells[comma])} is not a number; write decimals "
            "with a point, and nothing between thousands"
        )
    point = next((k for k, cell in enumerate(cells) if "." in cell), None)
    if point is not None:
        raise ValueError(
            f"line {lines[comma // width]}: {show(cells[comma])} has a decimal comma, but line "
            f"{lines[point // width]} has a decimal point in {show(cells[point])}; write all "
            "decimals with a point"
        )
    return [cell.replace(",", ".") for cell in cells]


def _no_number(cell: str, name: str, gaps: bool) -> str:
    """Why a cell is no number that can be used; empty if it is one."""
    try:
        value = math.nan if "_" in cell else float(cell)
    except ValueError:
        value = math.nan
    if math.isfinite(value) or (gaps and cell.lower() == "nan"):
        return ""
    if cell.lower().lstrip("+-") in ("nan", "inf", "infinity") or math.isinf(value):
        return (
            f"{show(cell)} is not a finite number; leave out the points that were not measured, "
            "gaps are allowed"
        )
    of = f" of {name}" if name else ""
    return f"{show(cell)} is not a number{of}; delete the line, or write a number as 0.25 or 2.5e-1"


# ---- dialects ----------------------------------------------------------------------------------

Lines = list[tuple[int, str]]


@dataclass(frozen=True)
class _Header:
    """The line that names the columns, in one way to split it."""

    separator: str
    names: tuple[str, ...]
    columns: tuple[str, ...]


def _table(
    lines: Lines, quoted: bool, columns: Columns, belongs: str, remarks: tuple[str, ...]
) -> Table:
    head, body = _headed(lines, columns, belongs)
    if not body:
        return Table(head.names, head.columns, np.zeros((0, len(head.columns))), (), (), remarks)
    read: list[tuple[FloatArray, list[list[str]]]] = []
    failed: list[tuple[bool, int, str]] = []
    at = [head.names.index(name) for name in head.columns]
    for separator in dict.fromkeys([head.separator, *SEPARATORS]):
        counted = False
        try:
            rows = _rows(body, separator, quoted, head)
            counted = True
            numbers = as_numbers(rows, at, [k for k, _ in body], head.columns)
        except ValueError as error:
            at_line = re.match(r"line (\d+)", str(error))
            failed.append((counted, int(at_line[1]) if at_line else 0, str(error)))
            continue
        if not any(np.array_equal(numbers, other) for other, _ in read):
            read.append((numbers, rows))
        if separator == head.separator and separator in ";\t":
            break  # a comma below it is a decimal sign; below a comma it may be either
    if not read:  # the way to read it that leads farthest tells most
        raise ValueError(max(failed, key=lambda item: item[:2])[2])
    if len(read) > 1:
        line, said = body[0]
        ways = " or ".join(str(numbers[0].tolist()) for numbers, _ in read)
        raise ValueError(
            f"line {line}: {show(said)} may mean {ways}; separate the columns by semicolons and "
            "write decimals with a point"
        )
    ((numbers, rows),) = read
    at_lines = tuple(k for k, _ in body)
    return Table(head.names, head.columns, numbers, at_lines, tuple(rows), remarks)


def _headed(lines: Lines, columns: Columns, belongs: str) -> tuple[_Header, Lines]:
    """The header of a table, and the lines below it that hold numbers."""
    commented = None
    for k, (number, line) in enumerate(lines):
        comment = _COMMENT.match(line)
        if k == 0 and _TOLD.fullmatch(line.strip()):
            continue
        found, why = _header(line[comment.end() :] if comment else line, columns)
        below = [item for item in lines[k + 1 :] if not _COMMENT.match(item[1])]
        if comment:
            commented = found or commented
        elif found:
            return found, below
        elif commented:
            return commented, [(number, line), *below]
        else:
            raise ValueError(f"line {number}: {why}")
    if commented:
        return commented, []
    raise ValueError(f"is empty; {belongs} belong here")


def _header(line: str, columns: Columns) -> tuple[_Header | None, str]:
    """A header in the separator that makes it one, or None and the reason."""
    reasons: dict[int, tuple[str, ...]] = {}
    for separator in SEPARATORS:
        names = tuple(_name(cell) for cell in split(line, separator))
        while len(names) > 1 and not names[-1]:
            names = names[:-1]
        try:
            chosen = tuple(columns(names))
            if missing := [name for name in chosen if name not in names]:
                raise ValueError(f"the column {missing[0]} is missing")
            return _Header(separator, names, chosen), ""
        except ValueError as error:
            reasons.setdefault(len(names), error.args)
    why, *remedy = reasons[max(reasons)]
    return None, f"{why}, found {show(line)}{''.join(remedy)}"


def _name(cell: str) -> str:
    """Name of a column as it is compared: lower case, with the unit at its end."""
    apart = _UNIT_APART.fullmatch(cell)
    if apart:
        cell = f"{apart[1]}_{apart[2] or apart[3] or apart[4]}"
    return cell.strip("\"' ").lower()


def _rows(body: Lines, separator: str, quoted: bool, head: _Header) -> list[list[str]]:
    """Cells of all rows under the names of the header; ValueError with the first that fails."""
    width, rows = len(head.names), []
    indexed = False
    for k, (number, line) in enumerate(body):
        row = split(line, separator, quoted)
        while len(row) > width and not row[-1]:
            row.pop()
        if k == 0:
            indexed = len(row) == width + 1 and _counts(body, separator, quoted)
        if len(row) != width + indexed:
            raise ValueError(f"line {number}: {_wrong_count(row, width, separator, line, head)}")
        rows.append(row[1:] if indexed else row)
    return rows


def _counts(body: Lines, separator: str, quoted: bool) -> bool:
    """Whether the first cells of several rows number them, from 0 or 1."""
    first = [split(line, separator, quoted)[0] for _, line in body]
    return len(body) > 1 and any(
        all(cell == str(k) for k, cell in enumerate(first, start=begin)) for begin in (0, 1)
    )


def _wrong_count(row: Sequence[str], width: int, separator: str, line: str, head: _Header) -> str:
    used = len(head.columns) == width
    names = ",".join(re.sub(r"_[a-z]+$", "", name) if used else name for name in head.names)
    belongs = f"{_COUNTS.get(width, width)} {'numbers' if used else 'cells'} {names} belong here"
    told = f"{belongs}, found {len(row)}: {show(line.strip())}"
    if separator == "," and len(row) > width:
        return (
            f"{told}; a comma separates the columns: write decimals with a point, or separate the "
            "columns by semicolons"
        )
    return f"{told}; one row a line, separated by {SEPARATORS[separator]}"
