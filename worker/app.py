"""The Celery app of the workers: the bell's receiving end.

Nothing of value is in a message, so the settings aim at two things only: a slot reserves at most
one message, and a worker comes back to its queue after the broker went away. What a message asks
for is decided by the claim in the database.
"""

from __future__ import annotations

from celery import Celery

from storage.queue import QUEUE_CPU
from storage.settings import StorageSettings

DAY_S = 86_400


def make_app(settings: StorageSettings) -> Celery:
    """The app. Its tasks are in `worker.tasks`."""
    app = Celery("nerfworks", broker=settings.redis_url, include=["worker.tasks"])
    app.conf.update(
        task_serializer="json",
        accept_content=["json"],
        task_ignore_result=True,
        task_acks_late=True,
        task_acks_on_failure=True,
        task_acks_on_timeout=True,
        task_reject_on_worker_lost=False,
        task_track_started=False,
        task_default_queue=QUEUE_CPU,
        worker_prefetch_multiplier=1,
        worker_cancel_long_running_tasks_on_connection_loss=False,
        worker_enable_remote_control=False,
        worker_send_task_events=False,
        worker_hijack_root_logger=False,
        worker_soft_shutdown_timeout=10.0,
        worker_enable_soft_shutdown_on_idle=False,
        broker_connection_retry=True,
        broker_connection_retry_on_startup=True,
        broker_connection_max_retries=None,
        # A Redis without memory, disk or replicas answers, and refuses to write, which taking a
        # message is: no reason to end a worker and the stages that it runs.
        broker_channel_error_retry=True,
        broker_connection_timeout=4.0,
        broker_transport_options={
            "visibility_timeout": DAY_S,
            "socket_keepalive": True,
            "socket_connect_timeout": 4.0,
            "socket_timeout": 10.0,  # longer than kombu's blocking pop, which ends each second
            "health_check_interval": 15,
        },
    )
    return app
