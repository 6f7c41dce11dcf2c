"""Views asked side by side: on how many threads."""

from __future__ import annotations

import threading
import time

import pytest

from pipelines.exports.each_view import each_view


@pytest.mark.parametrize(("of_torch", "used"), [(1, 1), (2, 2), (9, 4)])
def test_as_many_threads_as_torch_has_or_a_few(
    of_torch: int, used: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.get_num_threads", lambda: of_torch)
    names: set[str] = set()

    def named(view: int) -> int:
        names.add(threading.current_thread().name)
        time.sleep(0.02)
        return view

    assert list(each_view(named, range(16))) == list(range(16))
    assert len(names) == used
    assert (threading.current_thread().name in names) == (used == 1)
