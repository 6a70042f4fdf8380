"""The JSON schema of a configuration, for editors: completion, help, and typing errors at once."""

from __future__ import annotations

import json
from typing import Any

from dlo_casadi.config.sections import File

DIALECT = "https://json-schema.org/draft/2020-12/schema"


def config_schema() -> dict[str, Any]:
    """JSON schema of what may stand in a configuration, made from the checked sections.

    It knows keys, types, ranges and help; what concerns several values together only
    `load_config` checks.
    """
    schema: dict[str, Any] = _plain(File.model_json_schema())
    return {"$schema": DIALECT, **schema, "title": "Configuration of dlo_casadi"}


def schema_text() -> str:
    """The schema as the text of configs/schema.json."""
    return json.dumps(config_schema(), indent=1, sort_keys=True) + "\n"


def _plain(schema: Any) -> Any:
    """Write tuples of equal items as arrays of a fixed length, which older editors know."""
    if isinstance(schema, list):
        return [_plain(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    plain = {key: _plain(value) for key, value in schema.items()}
    items = plain.get("prefixItems")
    if isinstance(items, list) and all(item == items[0] for item in items):
        plain["items"] = plain.pop("prefixItems")[0]
    return plain
