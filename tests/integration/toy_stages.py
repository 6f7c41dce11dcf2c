"""Small stages that do real work in the real engine: files, checkpoints, time, errors, crashes.

The capture is a JSON plan, `{stage: {...}}`, that says what each stage does; `witness` is a file to
which every stage appends when it starts, resumes and ends; `until` is a file that a stage waits for
before it ends; where `hurry`, a file, exists its steps take no time. Point NERFWORKS_REGISTRY here.
The stages bear the names of real ones, because options classes go by name.
"""

from __future__ import annotations

import ctypes
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from pipelines.errors import Cancelled, CaptureError, ToolError, TrainingError
from pipelines.stage import Stage, StageContext

_HERE = "tests.integration.toy_stages"


def _stage(name: str, after: tuple[str, ...], reads: tuple[str, ...], **more: Any) -> Stage:
    return Stage(name, 1, after, reads, f"{_HERE}:run", f"{name.title()}Options", **more)


STAGES = (
    _stage("ingest", (), ()),
    _stage("frames", ("ingest",), ("ingest",)),
    _stage("train", ("frames",), ("ingest", "frames"), needs_gpu=True),
    _stage("mesh", ("train",), ("ingest", "train")),
    _stage("video", ("train",), ("ingest", "train")),
    _stage("report", ("mesh", "video"), ("ingest", "train", "mesh", "video")),
)


def get_stage(name: str) -> Stage:
    """The stage of that name."""
    return next(stage for stage in STAGES if stage.name == name)


def run(options: Any, ctx: StageContext) -> dict[str, Any]:
    """Do what the plan says of this stage."""
    plan_file = ctx.workspace.stage("ingest") / "plan.json"
    if ctx.stage == "ingest":
        plan_file = ctx.workspace.capture_file
        (ctx.out / "plan.json").write_bytes(plan_file.read_bytes())
    whole = json.loads(plan_file.read_text())
    plan = whole.get(ctx.stage, {})
    witness = Path(whole["witness"])
    _note(witness, f"{ctx.stage} start {os.getpid()}")
    _misbehave(plan, ctx, witness)
    state = ctx.checkpoint / "step.json"
    first = json.loads(state.read_text())["step"] if state.exists() else 0
    if first:
        _note(witness, f"{ctx.stage} resume {first}")
    steps = plan.get("steps", 2)
    for step in range(first + 1, steps + 1):
        if not ("hurry" in plan and Path(plan["hurry"]).exists()):
            time.sleep(plan.get("step_s", 0.0))
        print(f"{ctx.stage} step {step}")
        if plan.get("save_at_shutdown") and ctx.is_shutdown():
            state.write_text(json.dumps({"step": step}))
            ctx.checkpoint_saved()
        ctx.progress(step / steps, f"step {step}", (steps - step) * plan.get("step_s", 0.0))
        if plan.get("save_every") and step % plan["save_every"] == 0:
            _save(ctx, state, step)
        while step == steps and plan.get("until") and not Path(plan["until"]).exists():
            ctx.progress(1.0 - 0.1 * random.random(), "waiting")  # it gets on, so it does not hang
            if plan.get("save_every"):
                _save(ctx, state, step)
            time.sleep(0.05)
    (ctx.out / "deep").mkdir()
    (ctx.out / "deep" / "result ä.txt").write_text(f"{ctx.stage} {steps}")
    read = [name for name in get_stage(ctx.stage).reads if ctx.workspace.is_complete(name)]
    _note(witness, f"{ctx.stage} end {ctx.memory} {os.environ['OMP_NUM_THREADS']}")
    return {"steps": steps, "first": first, "read": read}


def _save(ctx: StageContext, state: Path, step: int) -> None:
    draft = state.with_name("step.json.new")
    draft.write_text(json.dumps({"step": step}))
    draft.replace(state)
    ctx.checkpoint_saved()


def _misbehave(plan: dict[str, Any], ctx: StageContext, witness: Path) -> None:
    earlier = witness.read_text().count(f"{ctx.stage} start") - 1
    if plan.get("child"):
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
        _note(witness, f"{ctx.stage} child {child.pid}")
    if plan.get("fail"):
        (ctx.out / "report.json").write_text(json.dumps({"said": "The plan says no."}))
        raise CaptureError("The plan says no.", code="no_images", hint="Change the plan.")
    if earlier < plan.get("fail_times", 0):
        raise ToolError("The tool broke.", retryable=True)
    if earlier < plan.get("give_up_times", 0):
        raise Cancelled("Nobody asked for it.")
    if earlier < plan.get("gpu_lost_times", 0):
        raise TrainingError("The GPU is gone.", code="gpu_lost", retryable=True)
    if earlier < plan.get("crash_times", 0):
        os.kill(os.getpid(), signal.SIGKILL)
    if plan.get("hungry") and ctx.memory == "full":
        raise MemoryError
    if plan.get("starving"):
        raise MemoryError
    if plan.get("fault"):
        raise ZeroDivisionError("/secret/path")
    while earlier < plan.get("hang_times", 0):  # alive, and it says the same again and again
        ctx.progress(plan.get("hang_at", 0.1), "hanging")
        time.sleep(0.1)
    if plan.get("deaf_s"):  # a native call that holds the interpreter: no Python thread runs
        ctypes.PyDLL(None).sleep(ctypes.c_uint(plan["deaf_s"]))
    if plan.get("spy"):
        (ctx.out / "environment.json").write_text(json.dumps(dict(os.environ)))


def _note(witness: Path, text: str) -> None:
    with witness.open("a") as file:
        file.write(text + "\n")
