"""Imports go one way; yaml, cv2 and print each have one place."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from dlo_casadi.effects import EFFECTS, NUISANCES

PACKAGE = Path(__file__).parents[1] / "dlo_casadi"
FILES = sorted(PACKAGE.rglob("*.py"))

CHAIN = ["errors", "interrupts", "thresholds", "parameters", "rod", "rest", "ends", "tolerances"]
CHAIN += [
    "effects",
    "assembly",
    "composition",
    "lagrangian",
    "model",
    "whole_pose",
    "descent",
    "initial",
    "initial_frames",
    "pose",
]
CHAIN += ["guesses", "equilibrium", "ipopt", "solve"]
MECHANICS = set(CHAIN)
PARALLEL = {"executors", "parallel"}

# layer -> what it may import beside itself. A new module gets its line here.
MAY_IMPORT: dict[str, set[str]] = {
    **{layer: set(CHAIN[:i]) for i, layer in enumerate(CHAIN)},
    "assembly": {*CHAIN[: CHAIN.index("assembly")], "model"},  # the model only for its type
    "config": {"errors", "thresholds", "parameters", "rod", "ends", "tolerances", "effects"},
    "durable": {"errors"},
    "measurements": {"errors", "config", "durable"},
    "vision": {"errors", "durable"},
    "estimation": MECHANICS,
    "diagnosis": MECHANICS | {"estimation"} | PARALLEL,
    "codegen": MECHANICS | {"durable"},
    "workers": {"interrupts", "vision"},
    "executors": {"durable", "errors", "workers"},
    "parallel": {"errors", "executors", "workers"},
}
# A session: what is declared and measured -> stages and findings -> one outcome.
READ = {"config", "measurements", "vision", "workers"}
MAY_IMPORT["session"] = MECHANICS | READ | {"estimation", "diagnosis"} | PARALLEL
# A report reads results and solves nothing.
STATED = set(CHAIN[: CHAIN.index("whole_pose")])
MAY_IMPORT["report"] = STATED | READ | {"durable", "estimation", "diagnosis", "session"} | PARALLEL
MAY_IMPORT["shape_table"] = MECHANICS | {"codegen", "durable", "parallel"}
MAY_IMPORT["fleet"] = {"errors", "config", "durable", "workers", "session", "report"} | PARALLEL
MAY_IMPORT["prediction"] = MECHANICS | {"config", "estimation", "report"}
MAY_IMPORT["api"] = {"errors", "config", "pose", "prediction", "session", "report"}
MAY_IMPORT["cli"] = set(MAY_IMPORT)


def layer_of(file: Path) -> str:
    """Name of the layer: the folder or module directly in the package."""
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(file: Path) -> Iterator[str]:
    """Absolute names of all modules that a file imports, also inside functions."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import in line {node.lineno}"
            assert node.module is not None
            yield node.module
            if node.module == "dlo_casadi":
                yield from (f"dlo_casadi.{alias.name}" for alias in node.names)


def name(file: Path) -> str:
    return str(file.relative_to(PACKAGE))


@pytest.mark.parametrize("file", [file for file in FILES if layer_of(file) != "__init__"], ids=name)
def test_imports_go_one_way(file):
    layer = layer_of(file)
    assert layer in MAY_IMPORT, f"give the layer {layer!r} its line in MAY_IMPORT"
    for module in imports(file):
        if module.startswith("dlo_casadi."):
            other = module.split(".")[1]
            if other == "__version__":
                continue
            assert other in MAY_IMPORT[layer] | {layer}, f"{layer} must not import {other}"


@pytest.mark.parametrize(
    ("library", "layer"), [("yaml", "config"), ("pydantic", "config"), ("cv2", "vision")]
)
def test_a_library_with_one_place(library, layer):
    users = {name(f) for f in FILES if any(m.split(".")[0] == library for m in imports(f))}
    assert users, f"nothing imports {library}"
    assert all(user.startswith(f"{layer}/") or user == f"{layer}.py" for user in users), users


def test_effects_are_named_by_themselves_alone():
    """A new effect is its file and one line in EFFECTS."""
    kinds = {**EFFECTS, **NUISANCES}
    names = {*kinds, *(kind.__name__ for kind in kinds.values())}
    for file in FILES:
        if layer_of(file) == "effects":
            continue
        for node in ast.walk(ast.parse(file.read_text())):
            said = [node.value] if isinstance(node, ast.Constant) else []
            if isinstance(node, ast.ImportFrom):
                said = [alias.name for alias in node.names]
            assert names.isdisjoint(said), f"{name(file)}: {said}"


def test_only_the_commands_print_or_exit():
    for file in FILES:
        if layer_of(file) == "cli":
            continue
        for node in ast.walk(ast.parse(file.read_text())):
            called = ast.unparse(node.func) if isinstance(node, ast.Call) else ""
            assert called not in ("print", "exit", "quit", "sys.exit", "breakpoint"), (
                f"{name(file)}, line {getattr(node, 'lineno', '?')}: {called}"
            )
