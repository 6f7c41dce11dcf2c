"""The states of jobs and stages, and which may follow which.

`storage.jobs`, `storage.claims` and `storage.leases` alone change a state; each change names its
old state in the UPDATE itself and is checked against these tables.

    stage:  blocked -> ready -> running -> succeeded
                ^        |         |-> ready        released, retried, or its worker was lost
                |        |         |-> failed       no attempts left, or not worth another
            (create)     |         |-> cancelled
                 blocked, ready -> cancelled        the job was cancelled, or failed elsewhere
        succeeded, failed, cancelled -> blocked     the job is retried, and this stage with it
                 failed, cancelled -> succeeded     with what it had made before
                 skipped                            given at creation: no use for it in this job

    job:    queued -> running -> succeeded | failed
            queued -> cancelled
            running -> cancelling -> cancelled      (at once where no stage is running)
            succeeded, failed, cancelled -> queued  retried: a new generation
            queued -> succeeded                     retried, and every result holds
"""

from __future__ import annotations

from types import MappingProxyType

STAGE_TRANSITIONS: MappingProxyType[str, frozenset[str]] = MappingProxyType(
    {
        "blocked": frozenset({"ready", "cancelled"}),
        "ready": frozenset({"running", "cancelled"}),
        "running": frozenset({"ready", "succeeded", "failed", "cancelled"}),
        "succeeded": frozenset({"blocked"}),
        "failed": frozenset({"blocked", "succeeded"}),
        "cancelled": frozenset({"blocked", "succeeded"}),
        "skipped": frozenset(),
    }
)
JOB_TRANSITIONS: MappingProxyType[str, frozenset[str]] = MappingProxyType(
    {
        "queued": frozenset({"running", "cancelled", "succeeded"}),
        "running": frozenset({"succeeded", "failed", "cancelling", "cancelled"}),
        "cancelling": frozenset({"cancelled"}),
        "succeeded": frozenset({"queued"}),
        "failed": frozenset({"queued"}),
        "cancelled": frozenset({"queued"}),
    }
)
STAGE_STATES = tuple(STAGE_TRANSITIONS)
JOB_STATES = tuple(JOB_TRANSITIONS)
STAGE_DONE = frozenset({"succeeded", "skipped"})
JOB_TERMINAL = frozenset({"succeeded", "failed", "cancelled"})
JOB_LIVE = frozenset(JOB_STATES) - JOB_TERMINAL


def check_transition(what: str, old: str, new: str) -> None:
    """Raise ValueError for a change that the tables do not hold: a fault of our own code."""
    table = JOB_TRANSITIONS if what == "job" else STAGE_TRANSITIONS
    if new not in table[old]:
        raise ValueError(f"a {what} cannot go from {old} to {new}")
