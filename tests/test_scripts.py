"""Scripts that no test runs take only names from the package that it has."""

import ast
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[1] / "scripts"


def missing(script):
    """Names that a script imports from the package and that are not there."""
    for node in ast.walk(ast.parse(script.read_text())):
        if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith("dlo_casadi"):
            continue
        module = import_module(node.module)
        for name in (alias.name for alias in node.names):
            if not (hasattr(module, name) or find_spec(f"{node.module}.{name}")):
                yield f"line {node.lineno}: {node.module} has no {name}"


@pytest.mark.parametrize(
    "script", sorted(SCRIPTS.rglob("*.py")), ids=lambda path: str(path.relative_to(SCRIPTS))
)
def test_a_script_imports_what_the_package_has(script):
    assert list(missing(script)) == []
