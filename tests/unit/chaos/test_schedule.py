"""What strikes, and what is asked for, follows from the seed; doors fail in the ways they name."""

from __future__ import annotations

import contextlib
import hashlib
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipelines.captures.sniff import sniff
from pipelines.registry import STAGES as REAL
from tests.chaos.doors import Door
from tests.chaos.plans import BIG_BYTES, KIND, Plan, chains, make_plans
from tests.chaos.schedule import BLOWS, KINDS, make_schedule
from tests.chaos.stages import STAGES


def test_one_seed_is_one_schedule_and_another_seed_another() -> None:
    assert make_schedule(7, 300.0) == make_schedule(7, 300.0)
    assert make_schedule(7, 300.0) != make_schedule(8, 300.0)
    assert make_plans(7, 50, 100.0) == make_plans(7, 50, 100.0)


@pytest.mark.parametrize("seed", range(20))
def test_every_kind_of_fault_strikes_within_a_minute_and_ends(seed: int) -> None:
    schedule = make_schedule(seed, 60.0)
    assert {fault.kind for fault in schedule} == {*KINDS}
    assert all((fault.seconds > 0) == (fault.kind not in BLOWS) for fault in schedule)
    assert max(fault.at_s + fault.seconds for fault in schedule) < 90.0


def test_a_capture_carries_its_plan_and_is_what_it_says(tmp_path: Path) -> None:
    plans = make_plans(3, 12, 10.0)
    assert {plan.fate for plan in plans[:5]} == {"finish", "cancel", "fail", "retry", "delete"}
    for plan in (plans[0], plans[10]):
        path = tmp_path / f"{plan.name}.zip"
        path.write_bytes(plan.capture())
        assert Plan.of_capture(path) == plan
        assert sniff(path, path.name).kind == KIND
        assert (path.stat().st_size > BIG_BYTES) == plan.big
    assert plans[10].big


def test_results_are_named_by_all_that_they_were_made_from() -> None:
    plan = make_plans(3, 1, 1.0)[0]
    names = chains(plan.stages(), "a" * 64)
    assert len({*names.values()}) == len(names) == len(plan.stages())
    assert not {*names.values()} & {*chains(plan.stages(), "b" * 64).values()}
    without = chains([name for name in plan.stages() if name != "depth"], "a" * 64)
    assert without["draft"] != names["draft"]


def test_the_stages_are_those_of_the_registry_with_another_body() -> None:
    for toy, real in zip(STAGES, REAL, strict=True):
        assert (toy.name, toy.after, toy.reads, toy.artifacts, toy.needs_gpu, toy.version) == (
            real.name,
            real.after,
            real.reads,
            real.artifacts,
            real.needs_gpu,
            real.version,
        )


@pytest.fixture
def echo() -> Iterator[tuple[Door, list[bytes]]]:
    """A door to a server that says what it hears, and what it heard."""
    heard: list[bytes] = []
    listener = socket.create_server(("127.0.0.1", 0))

    def answer(near: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := near.recv(1024):
                heard.append(data)
                near.sendall(hashlib.sha256(data).digest())

    def serve() -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = listener.accept()
                threading.Thread(target=answer, args=(near,), daemon=True).start()

    threading.Thread(target=serve, daemon=True).start()
    address = listener.getsockname()
    door = Door(lambda: socket.create_connection(address))
    yield door, heard
    door.close()
    listener.close()


def ask(near: socket.socket, text: bytes, timeout_s: float = 10.0) -> bytes | None:
    """The answer; empty where the connection is gone, None where there is none in time."""
    near.settimeout(timeout_s)
    try:
        near.sendall(text)
        return near.recv(1024)
    except TimeoutError:
        return None
    except OSError:
        return b""


def test_a_door_fails_as_it_is_told_and_opens_again(echo: tuple[Door, list[bytes]]) -> None:
    door, heard = echo
    right = hashlib.sha256(b"x").digest()

    def fresh() -> socket.socket:
        return socket.create_connection(("127.0.0.1", door.port))

    kept = fresh()
    assert ask(kept, b"x") == right
    number = door.begin("hang")
    assert ask(kept, b"x", 0.3) is None
    door.end(number)
    assert kept.recv(1024) == right, "what was asked meanwhile is answered"
    number = door.begin("late", 0.8)
    assert ask(kept, b"x", 0.2) is None
    assert ask(kept, b"", 10.0) == right
    door.end(number)
    number = door.begin("errors")
    assert b" 500 " in (ask(fresh(), b"x") or b"") + (ask(fresh(), b"x") or b"")
    door.end(number)
    before = len(heard)
    number = door.begin("lose")
    assert ask(fresh(), b"x") == b""
    assert len(heard) == before + 1, "it was done, and nobody was told"
    door.end(number)
    number = door.begin("refuse")
    assert ask(kept, b"x") == b""
    assert ask(fresh(), b"x") == b""
    assert len(heard) == before + 1
    door.end(number)
    assert ask(fresh(), b"x") == right
