"""C text of numbers and of functions, as CasADi prints it."""

import re
from collections.abc import Sequence
from math import isfinite

import casadi as ca

from dlo_casadi.errors import DloError

# Functions that CasADi renames; the others have libm's names.
_CALLS = {"casadi_sq": "square", "casadi_sign": "sign_of", "casadi_real": "double"}
_HELPERS = {
    "square": "static double square(double a) { return a * a; }\n",
    "sign_of": "static double sign_of(double a) { return a > 0.0 ? 1.0 : (a < 0.0 ? -1.0 : a); }\n",
}
# Doubles as conditions, of which clang warns.
_CONDITIONS = (
    (re.compile(r"\((a\d+)(\|\||&&)(a\d+)\)"), r"(\1!=0\2\3!=0)"),
    (re.compile(r"\((a\d+)\?"), r"(\1!=0?"),
    (re.compile(r"\(!(a\d+)\)"), r"(\1==0)"),
)
_BODY = re.compile(r"^static int casadi_f0\(.*?\{\n(.*?)^\}", re.MULTILINE | re.DOTALL)
_INPUT = re.compile(r"arg\[(\d+)\]\? arg\[\1\]\[(\d+)\] : 0")
_OUTPUT = re.compile(r"if \(res\[0\]!=0\) res\[0\]\[(\d+)\]=(.*?);")


def c_number(value: float) -> str:
    """Shortest C literal of a finite double that reads back to the same bits."""
    if not isfinite(value):
        raise DloError(f"the generated solver would contain the constant {value}")
    text = repr(float(value))
    return text if any(mark in text for mark in ".e") else text + ".0"


def table_to_c(numbers: Sequence[float]) -> str:
    """Initialiser of the table; one zero where there is nothing to store."""
    texts = [c_number(number) for number in numbers] or ["0.0"]
    rows = [", ".join(texts[i : i + 4]) for i in range(0, len(texts), 4)]
    return ",\n    ".join(rows)


def marked(text: str, values: dict[str, str]) -> str:
    """Replace the @MARKS@ that have a value; CMake's own marks stay."""
    return re.sub(r"@([A-Z_]+)@", lambda match: values.get(match.group(1), match.group(0)), text)


def helpers_of(text: str) -> list[str]:
    """C text of the functions that a text calls beside libm's."""
    return [helper for name, helper in _HELPERS.items() if f"{name}(" in text]


def statements(function: ca.Function, inputs: Sequence[str], targets: Sequence[str]) -> str:
    """C statements that CasADi prints for a function, with our names of inputs and outputs.

    `inputs`: C arrays of its inputs; `targets`: left side and operator of the assignment to each
    number of its output.
    """
    generator = ca.CodeGenerator("kernel")
    generator.add(function)
    found = _BODY.search(generator.dump())
    if found is None:  # pragma: no cover: another version of CasADi prints in another way
        raise DloError("CasADi printed no function; try another version of CasADi")
    text = _INPUT.sub(lambda match: f"{inputs[int(match[1])]}[{match[2]}]", found[1])
    text = _OUTPUT.sub(lambda match: f"{targets[int(match[1])]} {match[2]};", text)
    text = text.replace("  return 0;\n", "")
    for pattern, written in _CONDITIONS:
        text = pattern.sub(written, text)
    text = re.sub(
        r"casadi_\w+", lambda match: _CALLS.get(match[0], match[0][len("casadi_") :]), text
    )
    return "\n".join("  " + line for line in text.splitlines() if line.strip())


def ends_text(function: ca.Function | None) -> str:
    """C text of the energy of the holders of a planar cable, if any."""
    if function is None:
        return "static void add_ends(point_t *q, const double *table) { (void)q, (void)table; }\n"
    targets = ["q->lagrangian +="]
    targets += ["first[SLOPE_0] +=", "last[SLOPE_1] +=", "first[BEND_00] +=", "last[BEND_11] +="]
    return f"""\
/* Adds what holds the first and the last node beside their conditions. */
static void add_ends(point_t *q, const double *table)
{{
    const double x[2] = {{q->x[0], q->x[DLO_NODES - 1]}};
    double *const first = q->segment, *const last = q->segment + SEGMENT * (DLO_NODES - 2);
{statements(function, ("x", "table"), targets)}
    (void)x, (void)table;
}}
"""
