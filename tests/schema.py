"""What `--json` prints against the JSON Schema in the package."""

from __future__ import annotations

import json
from importlib import resources
from typing import Any

import jsonschema


def matches(command: str, content: Any) -> None:
    """Raise where what a command printed is not what the schema says."""
    schema = json.loads((resources.files("figaroh_jax") / "json_schema.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator({**schema, "$ref": f"#/$defs/{command}"}).validate(content)
