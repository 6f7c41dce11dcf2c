"""How a worker behaves: typed settings from the environment, prefix NERFWORKS_WORKER_."""

from __future__ import annotations

from typing import Literal

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict


class WorkerSettings(BaseSettings):
    """Times in seconds. The lease must outlast several heartbeats."""

    model_config = SettingsConfigDict(env_prefix="NERFWORKS_WORKER_", extra="ignore", frozen=True)

    lease_s: float = Field(60.0, gt=0, description="A claim dies this long after its heartbeat.")
    heartbeat_s: float = Field(5.0, gt=0, description="Time between two heartbeats.")
    cancel_poll_s: float = Field(2.0, gt=0, description="Time between two looks for a cancel.")
    tick_s: float = Field(2.0, gt=0, description="Time between two rounds of housekeeping.")
    clean_s: float = Field(
        30.0, gt=0, description="Time between two rounds of cleaning up after finished jobs."
    )
    sweep_s: float = Field(
        21_600.0,
        gt=0,
        description="Time between two searches of the object store for what belongs to no record.",
    )
    direct_after_s: float = Field(
        10.0, ge=0, description="A free slot takes a ready stage that waited so long by itself."
    )
    ring_again_s: float = Field(
        60.0,
        gt=0,
        description="The bell rings again for a ready stage after so long.",
    )
    cancel_grace_s: float = Field(
        5.0, ge=0, description="A stage that was asked to stop is killed after so long."
    )
    min_free_bytes: int = Field(
        2**28,
        ge=0,
        description="A worker takes a stage only with so many bytes free on its disk, and starts "
        "it only where the inputs that it still lacks fit beside them.",
    )
    transfers: int = Field(4, ge=1, le=64, description="Files moved at once by one slot.")
    prepare: bool = Field(
        True,
        description="Start stage processes, load their code and compile kernels before a job "
        "comes; without it an idle worker takes less memory, and its first job longer.",
    )

    contain: Literal["auto", "required", "off"] = Field(
        "auto",
        description="Confine stage processes as far as the system can; or refuse to run any where "
        "it cannot do it all; or not at all.",
    )
    stage_memory_bytes: int | None = Field(
        None,
        ge=0,
        description="Memory that one process of a stage may hold; 0 for no bound. Without it 95 % "
        "of the machine's, or the container's; on a GPU none.",
    )
    stage_file_bytes: int = Field(
        2**36, ge=0, description="Largest file that a stage may write; 0 for no bound."
    )
    stage_processes: int = Field(
        4096, ge=64, description="Processes and threads that stages may start; root has no bound."
    )
    stage_open_files: int = Field(
        4096, ge=64, description="Files that one process of a stage may have open."
    )
    stage_environment: str = Field(
        "", description="Further environment variables that stages get: names between commas."
    )
    stage_readable: str = Field(
        "", description="Further files and folders that stages may read, as PATH lists them."
    )
    stage_writable: str = Field(
        "", description="Further folders that stages may write to, as PATH lists them."
    )
