"""Imports go one way, in no circle; yaml, cv2 and print each have one place."""

import ast
from functools import cache
from pathlib import Path

import pytest

from dlo_casadi.effects import EFFECTS, IN_MOTION, NUISANCES

PACKAGE = Path(__file__).parents[1] / "dlo_casadi"
FILES = sorted(PACKAGE.rglob("*.py"))

# Room -> the rooms below it that it may import. A new room gets its line here.
EVERYWHERE = {"arrays", "errors", "linear_mixed", "thresholds", "__version__"}
MECHANICS = {"rod", "effects", "model", "equilibrium"}
MAY_IMPORT: dict[str, set[str]] = {
    "__main__": {"cli"},
    "arrays": set(),
    "errors": set(),
    "linear_mixed": set(),
    "thresholds": set(),
    "runtime": set(),
    "show": {"io"},
    "rod": set(),
    "effects": {"rod"},
    "model": {"rod", "effects"},
    "equilibrium": {"rod", "effects", "model", "runtime"},
    "motion": MECHANICS,
    "planning": {*MECHANICS, "motion"},
    "config": MECHANICS,
    "io": {*MECHANICS, "config"},
    "codegen": {*MECHANICS, "motion", "config", "io"},
    "export": {*MECHANICS, "io"},
    "cable": {
        *MECHANICS,
        "motion",
        "planning",
        "config",
        "io",
        "codegen",
        "tracking",
        "show",
        "export",
        "runtime",
    },
    "vision": set(),
    "sensing": {*MECHANICS, "vision"},
    "estimation": {*MECHANICS, "motion", "codegen", "sensing", "runtime"},
    "paper": {*MECHANICS, "sensing"},
    "diagnosis": {*MECHANICS, "motion", "sensing", "estimation", "runtime"},
    "tracking": {
        *MECHANICS,
        "motion",
        "config",
        "io",
        "codegen",
        "sensing",
        "estimation",
        "diagnosis",
    },
}
FITTING = {*MECHANICS, "sensing", "estimation", "diagnosis"}
MAY_IMPORT["recordings"] = {"config", "vision", "io"}
MAY_IMPORT["session"] = {*FITTING, "motion", "cable", "paper", "config", "io", "vision", "runtime"}
MAY_IMPORT["session"] |= {"export"}
# A report reads results and solves nothing.
MAY_IMPORT["report"] = {*MAY_IMPORT["session"], "session"} - {"equilibrium", "paper", "sensing"}
MAY_IMPORT["report"] |= {"cable", "show"}
MAY_IMPORT["report"] |= {"equilibrium", "sensing"}  # types of what they hold
MAY_IMPORT["fleet"] = {"config", "io", "session", "report", "runtime", "codegen", "model"}
MAY_IMPORT["api"] = {"cable", "config", "session", "report"}
MAY_IMPORT["cli"] = set(MAY_IMPORT)


def room_of(file: Path) -> str:
    """Name of the room: the folder or module directly in the package."""
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


def module_of(file: Path) -> str:
    """Dotted name of a file."""
    parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def nodes(file: Path) -> tuple[ast.AST, ...]:
    """All nodes of the syntax tree of a file."""
    return tuple(ast.walk(ast.parse(file.read_text())))


@cache
def imports(file: Path) -> tuple[str, ...]:
    """Absolute names of all modules that a file imports, inside functions and for types, too."""
    found = []
    for node in nodes(file):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import in line {node.lineno}"
            assert node.module is not None
            folder = PACKAGE.parent.joinpath(*node.module.split("."))
            for alias in node.names:
                is_module = (folder / f"{alias.name}.py").exists()
                found.append(f"{node.module}.{alias.name}" if is_module else node.module)
    return tuple(found)


def name(file: Path) -> str:
    return str(file.relative_to(PACKAGE))


def test_imports_go_one_way():
    rooms = {room_of(file) for file in FILES} - {"__init__"}
    assert rooms <= set(MAY_IMPORT), "give a new room its line in MAY_IMPORT"
    wrong = [
        f"{name(file)} must not import {module}"
        for file in FILES
        for module in imports(file)
        if module.startswith("dlo_casadi.")
        and (room := room_of(file)) != "__init__"
        and module.split(".")[1] not in MAY_IMPORT[room] | EVERYWHERE | {room}
    ]
    assert wrong == []


def test_no_file_imports_itself_by_way_of_others():
    files = {module_of(file): file for file in FILES if room_of(file) != "__init__"}
    below = {
        module: {other for other in imports(file) if other in files and other != module}
        for module, file in files.items()
    }
    before = None
    while before != len(
        below
    ):  # leave out what imports nothing that is left, or is imported by none
        before = len(below)
        below = {module: others & below.keys() for module, others in below.items()}
        used = {other for others in below.values() for other in others}
        below = {module: others for module, others in below.items() if others and module in used}
    assert not below, f"in a circle: {sorted(below)}"


def test_the_top_holds_rooms_and_little_else():
    at_the_top = {file.name for file in FILES if file.parent == PACKAGE}
    assert at_the_top == {
        "__init__.py",
        "__main__.py",
        "api.py",
        "arrays.py",
        "errors.py",
        "linear_mixed.py",
        "thresholds.py",
    }


def test_no_file_is_longer_than_450_lines():
    long = {name(file): len(file.read_text().splitlines()) for file in FILES}
    assert {file: lines for file, lines in long.items() if lines > 450} == {}


@pytest.mark.parametrize(
    ("library", "room"), [("yaml", "config"), ("pydantic", "config"), ("cv2", "vision")]
)
def test_a_library_with_one_place(library, room):
    users = {name(f) for f in FILES if any(m.split(".")[0] == library for m in imports(f))}
    assert users, f"nothing imports {library}"
    assert all(user.startswith(f"{room}/") for user in users), users


def test_effects_are_named_by_themselves_alone():
    """A new effect is its file and one line in EFFECTS."""
    kinds = {**EFFECTS, **IN_MOTION, **NUISANCES}
    names = {*kinds, *(kind.__name__ for kind in kinds.values())}
    for file in FILES:
        if room_of(file) == "effects":
            continue
        for node in nodes(file):
            said = [node.value] if isinstance(node, ast.Constant) else []
            if isinstance(node, ast.ImportFrom):
                said = [alias.name for alias in node.names]
            assert names.isdisjoint(said), f"{name(file)}: {said}"


def test_only_the_commands_print_or_exit():
    for file in FILES:
        if room_of(file) == "cli":
            continue
        for node in nodes(file):
            called = ast.unparse(node.func) if isinstance(node, ast.Call) else ""
            assert called not in ("print", "exit", "quit", "sys.exit", "breakpoint"), (
                f"{name(file)}, line {getattr(node, 'lineno', '?')}: {called}"
            )
