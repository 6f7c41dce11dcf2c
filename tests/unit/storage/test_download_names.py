"""The Content-Disposition header of a download, also for names that mean harm."""

from __future__ import annotations

from email.message import EmailMessage
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from storage.download_names import content_disposition


@given(name=st.text(max_size=60))
def test_content_disposition_is_one_safe_header(name: str) -> None:
    header = content_disposition(name)
    header.encode("ascii")
    assert "\r" not in header
    assert "\n" not in header
    plain = header.split('"')[1]
    assert header.count('"') == 2
    assert plain == Path(plain).name
    message = EmailMessage()
    message["Content-Disposition"] = header
    assert message.get_content_disposition() == "attachment"
    parsed = message.get_filename() or ""
    assert "/" not in parsed
    assert not {"\0", "\r", "\n"} & set(parsed)


@pytest.mark.parametrize(
    ("name", "plain", "extended"),
    [
        ("mesh.glb", "mesh.glb", "mesh.glb"),
        ('a"; evil="b.txt', "a__ evil__b.txt", None),
        ("día.zip", "d_a.zip", "d%C3%ADa.zip"),
        ("../../etc/passwd", "passwd", "passwd"),
        ("a\r\nSet-Cookie: x", "aSet-Cookie_ x", "aSet-Cookie%3A%20x"),
    ],
)
def test_hostile_names_are_disarmed(name: str, plain: str, extended: str | None) -> None:
    header = content_disposition(name)
    assert f'filename="{plain}"' in header
    if extended is not None:
        assert header.endswith(f"filename*=UTF-8''{extended}")
