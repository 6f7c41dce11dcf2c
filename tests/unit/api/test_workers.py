"""`GET /v1/workers`."""

from __future__ import annotations

from datetime import timedelta

from storage.db import now
from storage.records import register_worker
from tests.unit.api.conftest import Service, problem


def test_live_workers_say_what_they_have_and_what_holds_their_stages(service: Service) -> None:
    held = {"on": ["environment", "seccomp"], "lacks": ["files (no Landlock in this kernel)"]}
    common = {"hostname": "secret-name", "pid": 7, "boot": "b", "queues": ["cpu", "light"]}
    with service.services.database.session_scope() as session:
        moment = now(session)
        for name, age_s, contained in (("new", 0, None), ("old", 5, held), ("dead", 90, held)):
            register_worker(
                session,
                name,
                slots=2,
                has_gpu=False,
                contained=contained,
                when=moment - timedelta(seconds=age_s),
                **common,  # type: ignore[arg-type]
            )
    problem(service.anyone.get("/v1/workers"), 401, "unauthorized")
    answer = service.http.get("/v1/workers")
    assert answer.status_code == 200
    items = {item["id"]: item for item in answer.json()["items"]}
    assert {name: item["contained"] for name, item in items.items()} == {"new": None, "old": held}
    assert (items["old"]["slots"], items["old"]["queues"]) == (2, ["cpu", "light"])
    assert "secret-name" not in answer.text
