"""What each job of a run asks for, and what must come of it. All of it follows from the seed."""

from __future__ import annotations

import hashlib
import io
import json
import random
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from PIL import Image

from pipelines.options import stages_skipped
from pipelines.registry import STAGES, get_stage

KIND = "images"
BIG_BYTES = 17 << 20
"""More than the object store sends in one piece."""
FAILS_AT = "poses"
ODD_VIEWS, GOOD_VIEWS = 23, 24


@dataclass(frozen=True)
class Plan:
    """One job.

    fate: "finish", "cancel", "fail" (the capture is of no use), "retry" (fails, then goes through
    with another option), "delete" (once it is over, its capture too).
    at_s: when it is submitted. cancel_after_s: how long after it was accepted.
    steps, step_s: of each stage. big: whether capture and draft are larger than one transfer.
    """

    number: int
    name: str
    fate: str
    preset: str
    at_s: float
    cancel_after_s: float
    steps: int
    step_s: float
    big: bool

    def options(self) -> dict[str, Any]:
        """What the job is created with."""
        return {"draft": {"num_views": ODD_VIEWS if self.fate == "retry" else GOOD_VIEWS}}

    def stages(self) -> list[str]:
        """The stages that such a job runs, in order."""
        skipped = stages_skipped(self.preset, KIND, self.options())
        return [stage.name for stage in STAGES if stage.name not in skipped]

    def capture(self) -> bytes:
        """A .zip of pictures that carries the plan as its comment."""
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w") as archive:
            for index in range(3):
                picture = io.BytesIO()
                colour = (self.number % 256, index * 40, 80)
                Image.new("RGB", (16, 12), colour).save(picture, "PNG")
                archive.writestr(f"photo_{index}.png", picture.getvalue())
            if self.big:
                padding = Image.frombytes("RGB", (2048, 1024), noise(self.name, 3 << 21))
                picture = io.BytesIO()
                padding.save(picture, "PNG")
                for index in range(BIG_BYTES // len(picture.getvalue()) + 1):
                    archive.writestr(f"large_{index}.png", picture.getvalue())
            archive.comment = json.dumps(asdict(self)).encode()
        return packed.getvalue()

    @classmethod
    def of_capture(cls, path: Path) -> Plan:
        """The plan that a capture carries."""
        with zipfile.ZipFile(path) as archive:
            return cls(**json.loads(archive.comment))


def noise(text: str, num_bytes: int) -> bytes:
    """Bytes that no packing makes smaller, the same for the same text."""
    return random.Random(text).randbytes(num_bytes)


def make_plans(seed: int, jobs: int, over_s: float) -> list[Plan]:
    """So many jobs, submitted over so many seconds; the first of each fate is always there."""
    chance = random.Random(f"plans {seed}")
    fates = ["finish", "cancel", "fail", "retry", "delete"]
    weights = [60, 12, 8, 10, 10]
    plans = []
    for number in range(jobs):
        fate = fates[number] if number < len(fates) else chance.choices(fates, weights)[0]
        whole = chance.random() < 0.12
        plans.append(
            Plan(
                number=number,
                name=f"{seed}-{number}-{chance.randrange(1 << 32):08x}",
                fate=fate,
                preset="preview" if whole and fate != "retry" else "draft",
                at_s=round(over_s * number / jobs, 2),
                cancel_after_s=round(chance.uniform(0.0, 8.0), 2),
                steps=chance.choice([2, 3, 4, 12]),
                step_s=round(chance.uniform(0.02, 0.2), 3),
                big=number % 40 == 10,
            )
        )
    return plans


def chain(stage: str, capture_sha256: str, inputs: dict[str, str]) -> str:
    """What a stage's result is named: it follows from the capture and all that the stage read.

    inputs: the same of the stages that it read.
    """
    text = json.dumps([stage, capture_sha256, sorted(inputs.items())])
    return hashlib.sha256(text.encode()).hexdigest()


def chains(stages: list[str], capture_sha256: str) -> dict[str, str]:
    """What the results of all these stages must be named."""
    found: dict[str, str] = {}
    for name in stages:
        inputs = {read: found[read] for read in get_stage(name).reads if read in found}
        found[name] = chain(name, capture_sha256, inputs)
    return found
