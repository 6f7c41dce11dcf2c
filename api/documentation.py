"""`/docs`: the OpenAPI document as a page. No script, nothing from other hosts."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from typing import Any

_HEAD = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<style>
body {{ font: 15px/1.5 sans-serif; margin: 2rem auto; max-width: 60rem; padding: 0 1rem }}
section {{ border-top: 1px solid #ccc; margin-top: 1.5rem }}
code, pre {{ font: 13px/1.4 monospace }}
pre {{ background: #f4f4f4; overflow-x: auto; padding: .6rem }}
td, th {{ padding: .1rem .8rem .1rem 0; text-align: left; vertical-align: top }}
</style></head><body>
<h1>{title}</h1>
<p>{about}</p>
<p>The same for programs: <a href="/openapi.json">openapi.json</a>.</p>
"""
METHODS = ("get", "post", "put", "patch", "delete")


def _kind(schema: dict[str, Any]) -> str:
    """A type in a few words."""
    if "$ref" in schema:
        return str(schema["$ref"]).rsplit("/", 1)[-1]
    if "anyOf" in schema:
        return " or ".join(_kind(one) for one in schema["anyOf"])
    if "enum" in schema:
        return ", ".join(str(one) for one in schema["enum"])
    words = str(schema.get("type", "anything"))
    if words == "array":
        words = f"list of {_kind(schema.get('items', {}))}"
    for key, name in (("minimum", "from"), ("maximum", "to"), ("default", "default")):
        if schema.get(key) is not None:
            words += f", {name} {schema[key]}"
    return words


def _table(rows: Sequence[tuple[str, ...]], *heads: str) -> str:
    if not rows:
        return ""
    head = "".join(f"<th>{escape(one)}</th>" for one in heads)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def _fields(name: str, schemas: dict[str, Any]) -> str:
    found = schemas[name]
    rows = [
        (key, _kind(field), str(field.get("description", "")))
        for key, field in found.get("properties", {}).items()
    ]
    about = escape(str(found.get("description", "")))
    return f'<h4 id="{escape(name)}">{escape(name)}</h4><p>{about}</p>' + _table(
        rows, "field", "type", "meaning"
    )


def _curl(method: str, path: str, call: dict[str, Any], schemas: dict[str, Any]) -> str:
    words = ["curl"] if method == "get" else ["curl", "-X", method.upper()]
    if call.get("security"):
        words.append('-H "Authorization: Bearer $KEY"')
    body = call.get("requestBody", {}).get("content", {})
    if "multipart/form-data" in body:
        words.append("-F file=@walk.mp4")
    elif body:
        given = body["application/json"]["schema"]
        found = next((one for one in (given, *given.get("anyOf", [])) if "$ref" in one), None)
        schema = {} if found is None else schemas[_kind(found)]
        words.append(f"--json '{json.dumps(schema.get('examples', [{}])[0])}'")
    return " ".join([*words, f'"$URL{path}"'])


def _call(method: str, path: str, call: dict[str, Any], schemas: dict[str, Any]) -> str:
    parameters = [
        (one["name"], one["in"], _kind(one["schema"]), str(one.get("description", "")))
        for one in call.get("parameters", [])
    ]
    answers = [
        (status, str(answer.get("description", "")))
        for status, answer in sorted(call["responses"].items())
    ]
    return (
        f'<section id="{escape(call["operationId"])}">'
        f"<h3><code>{method.upper()} {escape(path)}</code></h3>"
        f"<p>{escape(str(call.get('description', '')))}</p>"
        + _table(parameters, "parameter", "in", "type", "meaning")
        + f"<pre>{escape(_curl(method, path, call, schemas))}</pre>"
        + _table(answers, "status", "answer")
        + "</section>"
    )


def page_of(document: dict[str, Any]) -> str:
    """The page of an OpenAPI document."""
    info, schemas = document["info"], document["components"]["schemas"]
    parts = [_HEAD.format(title=escape(info["title"]), about=escape(info["description"]))]
    parts += [
        _call(method, path, calls[method], schemas)
        for path, calls in document["paths"].items()
        for method in METHODS
        if method in calls
    ]
    parts.append("<section><h2>What is sent and answered</h2>")
    parts += [_fields(name, schemas) for name in sorted(schemas)]
    return "".join([*parts, "</section></body></html>\n"])
