"""The capture report as a page: `capture-report.html`.

One file that needs nothing else: pictures are inline, there is no script, and its own policy allows
none. What senders wrote (file names) is escaped.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from pipelines.filming.around import Around, look_around
from pipelines.filming.causes import FAST, causes_of, spans
from pipelines.filming.drawings import (
    Curve,
    chart,
    directions,
    inline_jpeg,
    ribbon,
    top_view,
)
from pipelines.filming.findings import noun
from pipelines.filming.looks import BLURRED_PX, look_at
from pipelines.filming.shots import MIN_FEATURES, Take
from pipelines.filming.words import clock

THUMBNAIL_PX = 200
_VERDICTS = {
    "good": ("Good", "The pictures hang together and show what is needed."),
    "usable": ("Usable", "It will work, and could be better."),
    "poor": ("Poor", "It may work, but expect holes and softness."),
    "unusable": ("Unusable", "Nothing can be made of it as it is."),
    None: ("Not judged", "The job ended too early to say."),
}
_CAUSES = {
    "moved_too_fast": "moved too fast",
    "blurred": "blurred",
    "too_few_features": "too little to see",
    "broken_apart": "apart from the rest",
    "clip_apart": "apart from the other clips",
    "no_overlap": "no overlap with the rest",
    "does_not_fit": "fits nowhere",
}
_STYLE = """
:root{color-scheme:light}
*{box-sizing:border-box}
body{margin:0;background:#f4f6f8;color:#1d2733;font:16px/1.5 system-ui,-apple-system,"Segoe UI",
Roboto,"Helvetica Neue",Arial,sans-serif}
main{max-width:960px;margin:0 auto;padding:20px 16px 48px}
h1{font-size:1.5rem;line-height:1.25;margin:0;overflow-wrap:anywhere}
h2{font-size:1.1rem;margin:0 0 10px}
p{margin:0 0 10px}
.card{background:#fff;border:1px solid #e1e6eb;border-radius:12px;padding:16px 18px;margin-top:16px}
.head{display:flex;flex-wrap:wrap;gap:10px 14px;align-items:center;margin-bottom:8px}
.badge{border-radius:999px;padding:3px 14px;font-weight:650;color:#fff;background:#6b7785}
.good{background:#17804d}.usable{background:#8a6d00}.poor{background:#b85c00}
.unusable{background:#b93434}
.muted{color:#5b6875}
.small{font-size:.86rem}
ol.advice{margin:0;padding-left:1.3em}
ol.advice li{margin:0 0 14px}
ol.advice li:last-child{margin-bottom:0}
.do{font-weight:600;display:block}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(140px,1fr));gap:10px}
.tile{background:#f4f6f8;border-radius:10px;padding:10px 12px}
.tile b{display:block;font-size:1.25rem;line-height:1.3}
.row{margin-top:14px}
.row .name{display:flex;justify-content:space-between;gap:12px;font-size:.9rem}
svg{display:block;width:100%}
.chart{height:74px;background:#f8fafb;border:1px solid #e1e6eb;border-radius:6px}
.ribbon{height:14px;border-radius:4px;margin-top:6px}
.axis{display:flex;justify-content:space-between;font-size:.8rem;color:#5b6875;margin-top:4px}
.clips{justify-content:flex-start}
.clips span{overflow:hidden;text-overflow:ellipsis;white-space:nowrap;border-left:2px solid #5b6875;
padding-left:4px}
.strip{display:grid;grid-template-columns:repeat(auto-fill,minmax(92px,1fr));gap:8px}
figure{margin:0}
figure img{width:100%;display:block;border-radius:6px;border:3px solid #1f9d61}
figure.lost img{border-color:#d64545}
figure.unknown img{border-color:#c9d1da}
figcaption{font-size:.76rem;line-height:1.3;margin-top:3px;overflow-wrap:anywhere}
.two{display:grid;grid-template-columns:3fr 2fr;gap:18px;align-items:start}
.map{border:1px solid #e1e6eb;border-radius:8px;background:#fff}
.rose{max-width:340px;margin:0 auto}
.key{display:inline-block;width:.8em;height:.8em;border-radius:3px;margin:0 .3em 0 .9em}
@media(max-width:640px){.two{grid-template-columns:1fr}h1{font-size:1.25rem}
.card{padding:14px}}
@media print{body{background:#fff}.card{break-inside:avoid}}
"""
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def build_page(take: Take, report: dict[str, Any], paths: Sequence[Path], num_pictures: int) -> str:
    """The page of a capture.

    report: of `pipelines.filming.report.build_report`. paths: where its pictures lie.
    num_pictures: how many are shown, evenly picked, and besides one of each stretch that was lost.
    """
    title = take.filename or "Capture"
    around = look_around(take.poses)
    parts = [
        _head(take, report, title),
        _advice(report),
        _numbers(take, report, around),
        _clips(report),
        _timeline(take),
        _space(take, around),
        _strip(take, paths, num_pictures),
    ]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{escape(title)}: capture report</title><style>{_STYLE}</style></head>"
        f"<body><main>{''.join(parts)}</main></body></html>\n"
    )


def _head(take: Take, report: dict[str, Any], title: str) -> str:
    verdict = report["verdict"]
    word, meaning = _VERDICTS[verdict]
    length = f", {clock(take.duration_s)} min" if take.duration_s is not None else ""
    count = f", {len(take.shots)} {noun(take, len(take.shots))} looked at" if take.shots else ""
    reasons = "".join(f"<p>{escape(reason)}</p>" for reason in report["reasons"])
    return (
        '<section class="card"><div class="head">'
        f'<span class="badge {verdict or ""}">{word}</span><h1>{escape(title)}</h1></div>'
        f'<p class="muted small">{escape(take.kind)}{length}{count}</p>'
        f"<p>{meaning}</p>{reasons}</section>"
    )


def _advice(report: dict[str, Any]) -> str:
    told = [one for one in report["findings"] if one["advice"]]
    if not told:
        return (
            '<section class="card"><h2>What to do next time</h2>'
            "<p>Nothing stands out: film the next one the same way.</p></section>"
        )
    items = "".join(
        f'<li><span class="do">{escape(one["advice"])}</span>'
        f'<span class="muted">{escape(one["what"])}</span></li>'
        for one in told
    )
    return (
        '<section class="card"><h2>What to do next time</h2>'
        f'<ol class="advice">{items}</ol></section>'
    )


def _numbers(take: Take, report: dict[str, Any], around: Around | None) -> str:
    if not take.shots:
        return ""
    tiles = []
    if take.was_sought:
        tiles.append((f"{take.num_placed} of {len(take.shots)}", f"{noun(take)} with a pose"))
        seconds = report["lost"]["seconds"]
        if seconds is not None:
            tiles.append((f"{seconds:.1f} s", "of the film lost"))
    if around is not None:
        tiles.append((f"{around.covered_deg:.0f}°", "of the way around seen"))
    if take.angle_deg is not None:
        tiles.append((f"{take.angle_deg:.1f}°", "between views of a point"))
    blurred = sum(shot.look is not None and shot.look.is_blurred for shot in take.shots)
    tiles.append((str(blurred), f"blurred {noun(take, blurred)}"))
    if take.is_metric is not None and take.was_sought:
        tiles.append(("metres" if take.is_metric else "unknown", "scale"))
    shown = "".join(
        f'<div class="tile"><b>{escape(value)}</b><span class="small muted">{escape(name)}</span>'
        "</div>"
        for value, name in tiles
    )
    return f'<section class="card"><h2>In numbers</h2><div class="tiles">{shown}</div></section>'


def _clips(report: dict[str, Any]) -> str:
    """A line for each of several clips."""
    if not report["clips"]:
        return ""
    words = {True: "does not join the others", False: "joined", None: ""}
    lines = "".join(
        f'<div class="name"><span><b>{number}</b> {escape(clip["name"])}</span>'
        f'<span class="muted">{clock(clip["length_s"])} min, {_placed_of(clip)}'
        f"{words[clip['is_apart']]}</span></div>"
        for number, clip in enumerate(report["clips"], start=1)
    )
    return f'<section class="card"><h2>Clips</h2><div class="row">{lines}</div></section>'


def _placed_of(clip: dict[str, Any]) -> str:
    if clip["num_placed"] is None:
        return f"{clip['num']} frames"
    comma = "" if clip["is_apart"] is None else ", "
    return f"{clip['num_placed']} of {clip['num']} frames with a pose{comma}"


def _moment(take: Take, index: int) -> str:
    """What a picture is called under it: its time, in its own clip, or its name."""
    shot, clip = take.shots[index], take.clip_of(index)
    if shot.time_s is None:
        return shot.name or shot.file
    if clip is None:
        return clock(shot.time_s)
    return f"clip {shot.clip + 1}, {clock(shot.time_s - clip.offset_s)}"


def _places(take: Take) -> list[float]:
    """Where each picture stands on the line, in [0, 1]."""
    num = len(take.shots)
    times = [shot.time_s for shot in take.shots]
    known = [time for time in times if time is not None]
    if take.is_film and len(known) == num and num > 1 and known[-1] > known[0]:
        return [(time - known[0]) / (known[-1] - known[0]) for time in known]
    return [index / max(num - 1, 1) for index in range(num)]


def _top(values: Sequence[float | None], least: float) -> float:
    return max([least, *(value for value in values if value is not None)]) * 1.08


def _timeline(take: Take) -> str:
    if len(take.shots) < 2:
        return ""
    places = _places(take)
    lost = [shot.is_placed is False for shot in take.shots]
    blur = [None if shot.look is None else shot.look.blur_px for shot in take.shots]
    speed = [shot.speed for shot in take.shots]
    details = [None if s.num_features is None else float(s.num_features) for s in take.shots]
    exposure = [shot.gain_ev for shot in take.shots]
    luma = [None if shot.look is None else 100 * shot.look.luma for shot in take.shots]
    rows = [
        (
            "Blur",
            f"pixels of 640; from {BLURRED_PX:g} on it is blurred",
            Curve(blur, 0.0, _top(blur, 4.0), BLURRED_PX),
        ),
        (
            "Movement",
            f"picture sizes a second; from {FAST:g} on it is fast",
            Curve(speed, 0.0, _top(speed, 0.45), FAST),
        ),
        ("Exposure", "stops since the start", _stops(exposure)),
        ("Brightness", "% of white", Curve(luma, 0.0, 100.0)),
        (
            "Details found",
            f"a picture; it needs {MIN_FEATURES}",
            Curve(details, 0.0, _top(details, 200.0), float(MIN_FEATURES)),
        ),
    ]
    shown = "".join(
        f'<div class="row"><div class="name"><b>{name}</b><span class="muted">{unit}, '
        f"up to {curve.top:.{0 if curve.top >= 10 else 1}f}</span></div>"
        f"{chart(places, lost, curve)}</div>"
        for name, unit, curve in rows
        if any(value is not None for value in curve.values)
    )
    return (
        f'<section class="card"><h2>{noun(take).capitalize()} one after the other</h2>'
        '<p class="small muted"><span class="key" style="background:#1f9d61;margin-left:0"></span>'
        'has a pose<span class="key" style="background:#d64545"></span>lost</p>'
        f"{ribbon(places, [shot.is_placed for shot in take.shots])}{_axis(take)}{shown}</section>"
    )


def _stops(values: Sequence[float | None]) -> Curve:
    known = [value for value in values if value is not None]
    reach = max([1.0, *(abs(value) for value in known)]) * 1.08
    return Curve(values, -reach, reach, 0.0)


def _axis(take: Take) -> str:
    if take.clips:
        return _clip_axis(take)
    first, last = take.shots[0], take.shots[-1]
    middle = take.shots[len(take.shots) // 2]
    if take.is_film and first.time_s is not None and last.time_s is not None:
        marks = [
            clock(first.time_s),
            clock((first.time_s + last.time_s) / 2),
            clock(last.time_s),
        ]
    else:
        marks = [shot.name or shot.file for shot in (first, middle, last)]
    return '<div class="axis">' + "".join(f"<span>{escape(m)}</span>" for m in marks) + "</div>"


def _clip_axis(take: Take) -> str:
    """Where each clip begins and ends on the line."""
    edges, places = [0.0], _places(take)
    for index in range(1, len(take.shots)):
        if take.shots[index].clip != take.shots[index - 1].clip:
            edges.append((places[index - 1] + places[index]) / 2)
    numbers = list(dict.fromkeys(shot.clip for shot in take.shots))
    parts = "".join(
        f'<span style="flex:0 0 {100 * (end - start):.2f}%">{number + 1}: '
        f"{escape(take.clips[number].name)}</span>"
        for number, start, end in zip(numbers, edges, [*edges[1:], 1.0], strict=True)
    )
    return f'<div class="axis clips">{parts}</div>'


def _space(take: Take, around: Around | None) -> str:
    if len(take.poses) == 0:
        return ""
    view = top_view(
        take.poses, take.posed, take.points, take.colors, None if around is None else around.focus
    )
    cross = "" if around is None else " The cross is what all of them look at."
    side = (
        '<h2>Seen from</h2><p class="small muted">The cameras all look elsewhere: there is no one '
        "subject to count directions around.</p>"
        if around is None
        else f'<h2>Seen from</h2>{directions(around)}<p class="small muted">The subject is in the '
        "middle. A dot is a camera, the nearer to the middle the higher up; the rim is red where "
        "nothing was seen from.</p>"
    )
    return (
        f'<section class="card"><div class="two"><div><h2>From above</h2>{view}<p class="small '
        'muted">Green: the cameras and where they look; the ring is the first, red dashes are '
        f"parts without poses.{cross} Dots are points that were recognised.</p></div>"
        f"<div>{side}</div></div></section>"
    )


def _picked(take: Take, num_pictures: int) -> list[int]:
    num = len(take.shots)
    count = min(num, num_pictures)
    even = {round(i * (num - 1) / max(count - 1, 1)) for i in range(count)}
    lost = [index for index, shot in enumerate(take.shots) if shot.is_placed is False]
    return sorted(even | {(a + b) // 2 for a, b in spans(take, lost)[: num_pictures or 0]})


def _strip(take: Take, paths: Sequence[Path], num_pictures: int) -> str:
    if not take.shots or num_pictures == 0:
        return ""
    causes = causes_of(take)
    figures = []
    for index in _picked(take, num_pictures):
        shot = take.shots[index]
        try:
            picture = look_at(paths[index])[1]
        except OSError:  # a picture that is gone is left out of the strip
            continue
        label = _moment(take, index)
        cause = causes[index]
        notes = [_CAUSES[cause]] if cause is not None else []
        if cause is None and shot.is_placed is False:
            notes.append("no pose")
        if shot.look is not None and shot.look.is_blurred and cause != "blurred":
            notes.append("blurred")
        kind = {True: "", False: "lost", None: "unknown"}[shot.is_placed]
        figures.append(
            f'<figure class="{kind}"><img src="{inline_jpeg(picture, THUMBNAIL_PX)}" '
            f'alt="{escape(label)}"><figcaption>{escape(label)}'
            f"{'<br>' if notes else ''}{escape(', '.join(notes))}</figcaption></figure>"
        )
    return (
        f'<section class="card"><h2>Some of the {noun(take)}</h2>'
        f'<div class="strip">{"".join(figures)}</div></section>'
    )
