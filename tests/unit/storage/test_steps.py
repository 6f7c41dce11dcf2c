"""The named steps: the list and the code say the same, and a transaction says its own."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from sqlalchemy import text
from sqlalchemy.exc import OperationalError

from storage.db import Database
from storage.steps import STEPS, names, watch
from tests.faults import at_step

ROOT = Path(__file__).resolve().parents[3]


def said_in_the_code() -> set[str]:
    """Operations that are given as `step=...`, and names that `reached` is called with."""
    found = set()
    for path in (
        path for room in ("api", "storage", "worker") for path in (ROOT / room).rglob("*")
    ):
        if path.suffix != ".py":
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            given = [word.value for word in node.keywords if word.arg == "step"]
            if isinstance(node.func, ast.Name) and node.func.id == "reached":
                given += node.args
            found |= {str(one.value) for one in given if isinstance(one, ast.Constant)}
    return found


def test_the_list_names_each_step_of_the_code_and_no_other() -> None:
    said = said_in_the_code()
    whole = {name for name in said if "." not in name}
    assert whole == {
        name for name, steps in STEPS.items() if ".committed" in steps or ".stored" in steps
    }
    by_name = {
        operation + step
        for operation, steps in STEPS.items()
        for step in steps
        if step not in (".commit", ".committed", ".stored")
        and not (step in (".bytes", ".put") and ".stored" in steps)
    }
    assert said - whole == by_name
    assert len(names()) == len(set(names()))


def test_a_transaction_says_when_it_is_committed_and_when_not_yet(database: Database) -> None:
    said: list[tuple[str, int]] = []

    def look(step: str) -> None:
        with database.read_scope() as other:
            said.append((step, other.execute(text("SELECT count(*) FROM t")).scalar_one()))

    with database.engine.begin() as connection:
        connection.execute(text("CREATE TABLE t (x INTEGER)"))
    watch(look)
    try:
        with database.session_scope(step="claim") as session:
            session.execute(text("INSERT INTO t VALUES (1)"))
    finally:
        watch(None)
    assert said == [("claim.commit", 0), ("claim.committed", 1)]


@pytest.mark.parametrize("step", ["claim.commit", "claim.committed"])
def test_an_answer_is_lost_before_the_commit_or_after_it(database: Database, step: str) -> None:
    with database.engine.begin() as connection:
        connection.execute(text("CREATE TABLE t (x INTEGER)"))
    with (
        at_step(step) as happened,
        pytest.raises(OperationalError),
        database.session_scope(step="claim") as session,
    ):
        session.execute(text("INSERT INTO t VALUES (1)"))
    assert happened.is_set()
    with database.read_scope() as session:
        kept = session.execute(text("SELECT count(*) FROM t")).scalar_one()
    assert kept == (step == "claim.committed")
