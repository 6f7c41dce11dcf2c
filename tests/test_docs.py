"""The documentation says what the code does: options, API calls, environment, commands."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from api.app import create_app
from pipelines.options import STAGE_OPTIONS
from pipelines.presets import PRESETS
from pipelines.registry import STAGES

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text("utf-8")


def leaves(schema: dict[str, Any], definitions: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """(name, schema) of each option in a model's JSON schema, nested ones included."""
    found: list[tuple[str, dict[str, Any]]] = []
    for name, field in schema.get("properties", {}).items():
        found.append((name, field))
        reference = field.get("$ref")
        if reference:
            nested = definitions[reference.rsplit("/", 1)[1]]
            found += [(f"{name}.{inner}", value) for inner, value in leaves(nested, definitions)]
    return found


def test_every_option_says_what_it_means() -> None:
    silent = []
    for stage, model in STAGE_OPTIONS.items():
        schema = model.model_json_schema()
        for name, field in leaves(schema, schema.get("$defs", {})):
            if "$ref" not in field and not field.get("description"):
                silent.append(f"{stage}.{name}")
    assert not silent, f"options without a description: {silent}"


def test_options_page_names_every_option_and_preset() -> None:
    page = (ROOT / "docs" / "options.md").read_text("utf-8")
    missing = []
    for stage, model in STAGE_OPTIONS.items():
        schema = model.model_json_schema()
        for name, _ in leaves(schema, schema.get("$defs", {})):
            if f"`{stage}.{name}`" not in page:
                missing.append(f"{stage}.{name}")
    missing += [name for name in PRESETS if f"`{name}`" not in page]
    assert not missing, f"run `python -m deploy.options_page`; docs/options.md lacks {missing}"


def test_readme_names_every_api_call() -> None:
    schema = create_app().openapi()
    missing = [
        f"{method.upper()} {path}"
        for path, calls in schema["paths"].items()
        for method in calls
        if method in ("get", "post", "delete") and path not in README
    ]
    assert not missing, f"README.md, the API's table, lacks {missing}"


def test_readme_names_every_artifact_and_make_target() -> None:
    names = [artifact.name for stage in STAGES for artifact in stage.artifacts]
    missing = [name for name in names if f"`{name}`" not in README]
    assert not missing, f"README.md lacks the artifacts {missing}"
    for command in ("make demo", "make test", "make up"):
        assert command in README, f"README.md does not name {command}"


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def links(page: Path) -> list[tuple[str, str]]:
    """(file or "" for the page itself, anchor or "") of each link that stays in the repository."""
    found = re.findall(r"\]\(([^)#\s]*)(?:#([^)\s]*))?\)", page.read_text("utf-8"))
    return [(target, anchor) for target, anchor in found if "://" not in target]


def anchors(page: Path) -> set[str]:
    """What GitHub makes of a page's headings: letters, digits, hyphens and underscores."""
    text = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)
    found: list[str] = []
    for heading in re.findall(r"^#+ +(.+?) *$", text, re.MULTILINE):
        found.append(re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-"))
    return {
        f"{anchor}-{same}" if (same := found[:index].count(anchor)) else anchor
        for index, anchor in enumerate(found)
    }


def test_links_in_the_documentation_lead_somewhere() -> None:
    broken = [
        f"{page.name}: {target}"
        for page in PAGES
        for target, _ in links(page)
        if not (page.parent / target).exists()
    ]
    assert not broken, f"broken links: {broken}"


def test_links_to_headings_find_them() -> None:
    broken = []
    for page in PAGES:
        for target, anchor in links(page):
            aim = page.parent / target if target else page
            if anchor and aim.suffix == ".md" and aim.exists() and anchor not in anchors(aim):
                broken.append(f"{page.name}: {target}#{anchor}")
    assert not broken, f"links to headings that are not there: {broken}"


def test_every_picture_of_the_documentation_is_on_a_page() -> None:
    shown = {(page.parent / target).resolve() for page in PAGES for target, _ in links(page)}
    unused = sorted(path.name for path in (ROOT / "docs" / "images").iterdir() if path not in shown)
    assert not unused, f"pictures that no page shows: {unused}"
