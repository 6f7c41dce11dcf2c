"""Whether a part of the service answers, asked so that a part that hangs holds up nothing else."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable

from sqlalchemy.exc import SQLAlchemyError

from api.problems import FieldProblem
from storage.errors import StorageError

logger = logging.getLogger("nerfworks.api")


class Probe:
    """Asks one part whether it answers: in one thread at most, however many want to know."""

    def __init__(self, name: str, ping: Callable[[], None]) -> None:
        self.name = name
        self._ping = ping
        self._flight: asyncio.Future[str | None] | None = None

    async def ask(self, timeout_s: float) -> FieldProblem | None:
        """What is wrong with it, or None."""
        if self._flight is None or self._flight.done():
            loop = asyncio.get_running_loop()
            self._flight = loop.create_future()
            thread = threading.Thread(
                target=self._run, args=(loop, self._flight), daemon=True, name=f"probe {self.name}"
            )
            thread.start()
        try:
            wrong = await asyncio.wait_for(asyncio.shield(self._flight), timeout_s)
        except TimeoutError:
            wrong = f"no answer within {timeout_s:g} s"
        return None if wrong is None else FieldProblem(path=self.name, detail=wrong)

    def _run(self, loop: asyncio.AbstractEventLoop, flight: asyncio.Future[str | None]) -> None:
        wrong = None
        try:
            self._ping()
        except (SQLAlchemyError, StorageError, OSError) as error:
            logger.warning("not ready: %s: %s", self.name, error)
            wrong = "does not answer"
        except Exception:
            logger.exception("not ready: %s", self.name)
            wrong = "does not work"

        def tell() -> None:
            if not flight.done():
                flight.set_result(wrong)

        try:
            loop.call_soon_threadsafe(tell)
        except RuntimeError:
            logger.debug("the answer of %s came after the end", self.name)
