"""Write docs/options.md from the options themselves: python -m deploy.options_page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pipelines.options import STAGE_OPTIONS, method_names, train_options
from pipelines.presets import PRESETS

TABLE_HEAD = ("| option | default | allowed | meaning |", "|---|---|---|---|")
_NULL = {"type": "null"}
PAGE = Path(__file__).resolve().parent.parent / "docs" / "options.md"


def rows(prefix: str, schema: dict[str, Any], definitions: dict[str, Any]) -> list[str]:
    """Table rows of a model's options, nested ones under their dotted names."""
    lines = []
    for name, field in schema.get("properties", {}).items():
        path = f"{prefix}.{name}"
        reference = field.get("$ref")
        if reference:
            nested = definitions[reference.rsplit("/", 1)[1]]
            lines.append(f"| `{path}` | | | {nested.get('description', '').splitlines()[0]} |")
            lines += rows(path, nested, definitions)
            continue
        field = {**next((one for one in field.get("anyOf", []) if one != _NULL), {}), **field}
        default = json.dumps(field.get("default")) if "default" in field else ""
        limits = " or ".join(f"`{choice}`" for choice in _choices(field))
        low = field.get("minimum", field.get("exclusiveMinimum"))
        high = field.get("maximum", field.get("exclusiveMaximum"))
        if low is not None or high is not None:
            limits = f"{low} to {high}"
        description = field.get("description", "").replace("|", "\\|")
        lines.append(f"| `{path}` | {default} | {limits} | {description} |")
    return lines


def _choices(field: dict[str, Any]) -> list[Any]:
    """What an option may be, or each item of a list that it is."""
    choices: list[Any] = field.get("enum") or field.get("items", {}).get("enum") or []
    return choices


def other_methods(known: list[str]) -> list[str]:
    """What `train` has for methods other than the default one; `known`: the rows of that."""
    parts = []
    for name in method_names():
        options = train_options(name)
        schema = options.model_json_schema()
        own = [row for row in rows("train", schema, schema.get("$defs", {})) if row not in known]
        if own:
            parts += [f"\n### train, where `method` is `{name}`\n"]
            parts += ["As above, except:\n", *TABLE_HEAD, *own]
    return parts


def page() -> str:
    """The whole page."""
    parts = [
        "# Options\n",
        "Written by `python -m deploy.options_page`; do not edit.\n",
        "`--set stage.option=value` on the command line, `options` in `POST /v1/jobs`, and the",
        "same as JSON Schema from `GET /v1/options`.\n",
        "## Presets\n",
        "| preset | what for |",
        "|---|---|",
        *(f"| `{preset.name}` | {preset.summary} |" for preset in PRESETS.values()),
    ]
    for preset in PRESETS.values():
        overrides = json.dumps(preset.overrides, indent=2)
        parts += [f"\nWhat `{preset.name}` changes:\n", "```json", overrides, "```"]
        if preset.without:
            left_out = ", ".join(f"`{name}`" for name in STAGE_OPTIONS if name in preset.without)
            parts += [f"\nIts jobs skip {left_out}; options of these are refused."]
    for stage, model in STAGE_OPTIONS.items():
        schema = model.model_json_schema()
        parts += [f"\n## {stage}\n", (model.__doc__ or "").strip() + "\n"]
        table = rows(stage, schema, schema.get("$defs", {}))
        if table:
            parts += [*TABLE_HEAD, *table]
        if stage == "train":
            parts += other_methods(table)
    return "\n".join(parts) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), "utf-8")
