"""`dlo schema`: the JSON schema of a configuration."""

from __future__ import annotations

from collections.abc import Sequence

from dlo_casadi.cli.guard import OK
from dlo_casadi.cli.options import command
from dlo_casadi.config.schema import schema_text

EXAMPLES = """\
dlo schema > schema.json
    then `# yaml-language-server: $schema=schema.json` as the first line of a configuration
    gives completion, help and checks in editors with the YAML language server"""


def main(argv: Sequence[str]) -> int:
    """Run `dlo schema`."""
    command(
        "schema", "Print the JSON schema of a configuration, for editors.", EXAMPLES
    ).parse_args(argv)
    print(schema_text(), end="")
    return OK
