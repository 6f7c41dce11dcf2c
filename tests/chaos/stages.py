"""The stages of the real registry, by name, order, needs and artifacts, with one small body.

Workers get them through NERFWORKS_REGISTRY. The plan comes with the capture. A stage's result is
named by all that it was made from, so that a mix-up of jobs, inputs or attempts shows in its bytes.
"""

from __future__ import annotations

import dataclasses
import json
import time
from typing import Any

from pipelines.errors import CaptureError
from pipelines.manifest import file_sha256
from pipelines.registry import STAGES as REAL
from pipelines.registry import get_stage as real_stage
from pipelines.stage import Stage, StageContext
from tests.chaos.plans import BIG_BYTES, FAILS_AT, ODD_VIEWS, Plan, chain, noise

CHAIN = "chain.txt"
PLAN = "plan.json"

STAGES = tuple(
    dataclasses.replace(stage, run=f"{__name__}:run", time_limit_s=900.0, stall_s=600.0)
    for stage in REAL
)
_BY_NAME = {stage.name: stage for stage in STAGES}


def get_stage(name: str) -> Stage:
    """The stage of that name."""
    return _BY_NAME[name]


def run(options: Any, ctx: StageContext) -> dict[str, Any]:
    """Take the time that the plan says, keep checkpoints, write what follows from the inputs."""
    if ctx.stage == "ingest":
        plan = Plan.of_capture(ctx.workspace.capture_file)
        facts: dict[str, Any] = {
            "sha256": file_sha256(ctx.workspace.capture_file),
            "plan": dataclasses.asdict(plan),
        }
        (ctx.out / PLAN).write_text(json.dumps(facts))
    else:
        facts = json.loads((ctx.workspace.stage("ingest") / PLAN).read_text())
        plan = Plan(**facts["plan"])
    if plan.fate == "fail" and ctx.stage == FAILS_AT:
        raise CaptureError("The plan says no.", code="no_images", hint="Change the plan.")
    if plan.fate == "retry" and ctx.stage == "draft" and options.num_views == ODD_VIEWS:
        raise CaptureError("Not with these options.", code="no_images", hint="Use others.")
    first = _work(plan, ctx)
    inputs = {
        name: (ctx.workspace.stage(name) / CHAIN).read_text()
        for name in real_stage(ctx.stage).reads
        if ctx.workspace.is_complete(name)
    }
    made = chain(ctx.stage, facts["sha256"], inputs)
    (ctx.out / CHAIN).write_text(made)
    for artifact in real_stage(ctx.stage).artifacts:
        path = ctx.out / artifact.path
        path.parent.mkdir(parents=True, exist_ok=True)
        is_big = plan.big and artifact.path == "draft.glb"
        path.write_bytes(noise(made + artifact.path, BIG_BYTES if is_big else 3000))
    return {"chain": made, "first": first}


def _work(plan: Plan, ctx: StageContext) -> int:
    state = ctx.checkpoint / "step.json"
    first = int(json.loads(state.read_text())["step"]) if state.exists() else 0
    for step in range(first + 1, plan.steps + 1):
        time.sleep(plan.step_s)
        print(f"{ctx.stage} step {step} of {plan.name}")
        if step % 4 == 0:
            draft = ctx.checkpoint / "step.json.new"
            draft.write_text(json.dumps({"step": step}))
            draft.replace(state)
            ctx.checkpoint_saved()
        ctx.progress(step / plan.steps, f"step {step}", (plan.steps - step) * plan.step_s)
    return first
