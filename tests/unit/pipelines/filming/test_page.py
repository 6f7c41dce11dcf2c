"""The page stands alone, shows what was found, and takes no orders from who sent the capture."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.filming.page import build_page
from pipelines.filming.report import build_report
from pipelines.filming.shots import Clip, Take
from tests.unit.pipelines.filming.takes import NUM, SMEARED, good_take, spoiled


class Reader(HTMLParser):
    """All tags with their attributes, the text, and whether tags are closed in order."""

    VOID = frozenset({"meta", "img", "br"})

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def page_of(take: Take, folder: Path, num_pictures: int = 6) -> tuple[str, Reader]:
    paths = []
    for index in range(len(take.shots)):
        paths.append(folder / f"{index}.jpg")
        Image.new("RGB", (64, 48), (6 * index % 255, 90, 90)).save(paths[-1])
    page = build_page(take, build_report(take), paths, num_pictures)
    reader = Reader()
    reader.feed(page)
    assert reader.open == []
    return page, reader


def test_the_page_needs_nothing_else_and_runs_nothing(tmp_path: Path) -> None:
    _, reader = page_of(good_take(), tmp_path)
    assert not {"script", "link", "iframe", "form", "object"} & {tag for tag, _ in reader.tags}
    for _, attributes in reader.tags:
        assert not [name for name in attributes if name.startswith("on")]
        for name in ("src", "href"):
            assert (attributes.get(name) or "data:image/").startswith("data:image/")
    policy = [a["content"] for tag, a in reader.tags if a.get("http-equiv")]
    assert policy == ["default-src 'none'; img-src data:; style-src 'unsafe-inline'"]
    assert any(a.get("name") == "viewport" for _, a in reader.tags)


def test_the_page_shows_verdict_advice_numbers_and_pictures(tmp_path: Path) -> None:
    take = spoiled(good_take(), range(24, 27), look=SMEARED, speed=1.4, is_placed=False, group=None)
    page, reader = page_of(take, tmp_path)
    for said in (
        "Usable",
        "Film that part again, slower, keeping the subject in view.",
        "From 0:12 to 0:13 you turned faster than the shutter",
        "37 of 40",
        "1.5 s",
        "moved too fast",
    ):
        assert said in reader.text
    figures = [a for tag, a in reader.tags if tag == "figure"]
    assert len(figures) == 7, "six, and one of the lost stretch"
    assert [a["class"] for a in figures].count("lost") == 1
    assert page.count('class="chart"') == 5
    assert page.count('class="map"') == page.count('class="rose"') == 1


def test_clips_have_a_line_and_their_own_times(tmp_path: Path) -> None:
    take = good_take()
    shots = [replace(shot, clip=int(index >= 25)) for index, shot in enumerate(take.shots)]
    clips = (Clip("<b>a.mp4", 0.0, 12.5, False, 90), Clip("b.mp4", 12.5, 7.5, True, 4))
    take = spoiled(
        replace(take, shots=tuple(shots), clips=clips), range(25, 40), is_placed=False, group=1
    )
    page, reader = page_of(take, tmp_path)
    assert "<b>a.mp4" not in page
    for said in ("<b>a.mp4", "0:12 min, 25 of 25 frames with a pose, joined"):
        assert said in reader.text
    assert "0:07 min, 0 of 15 frames with a pose, does not join the others" in reader.text
    assert "clip 2, 0:03" in reader.text
    assert "apart from the other clips" in reader.text
    assert "2: b.mp4" in reader.text
    assert "Clips" not in page_of(good_take(), tmp_path)[1].text


def test_names_are_escaped(tmp_path: Path) -> None:
    evil = '<script>alert(1)</script>"><img src=x onerror=alert(2)>'
    take = good_take(is_film=False)
    shots = tuple(replace(shot, name=evil) for shot in take.shots)
    page, reader = page_of(replace(take, shots=shots, filename=evil), tmp_path)
    assert "script" not in {tag for tag, _ in reader.tags}
    assert "<script" not in page
    assert not [a for tag, a in reader.tags if "onerror" in a]
    assert evil in reader.text


def test_a_job_that_knows_nothing_has_a_page(tmp_path: Path) -> None:
    error = {"stage": "ingest", "code": "video_truncated", "message": "It ends.", "hint": "Again."}
    _, reader = page_of(Take(filename="a.mp4", kind="video", error=error), tmp_path)
    assert "Unusable" in reader.text
    assert "It ends." in reader.text
    assert "Again." in reader.text


@pytest.mark.parametrize("num", [1, 2, 1500])
def test_any_number_of_pictures_can_be_drawn(tmp_path: Path, num: int) -> None:
    take = good_take(num=num)
    if num > NUM:
        take = replace(take, points=np.random.default_rng(0).normal(0, 1, (9000, 3)))
        take = replace(take, colors=np.full((9000, 3), 200, np.uint8))
    page = build_page(take, build_report(take), [tmp_path / "gone.jpg"] * num, 4)
    assert not re.search(r"\bnan\b|\binf\b", page)
    assert len(page) < 1_500_000
