"""Whether the object store answers, so that an outage of it fails no job.

A store that is away fails whatever is tried: a worker that went on taking stages would use up the
attempts of every job in the queue. So one that finds it away gives the stage back, no attempt
counted, and takes no other until the store answers.
"""

from __future__ import annotations

import logging

from storage.breaker import Breaker
from storage.errors import ObjectStoreError, ObjectStoreFullError
from storage.objects import ObjectStore

_log = logging.getLogger("nerfworks.worker")


class StoreWatch:
    """One for all slots of a worker. It asks the store only after a transfer failed."""

    def __init__(self, store: ObjectStore, breaker: Breaker | None = None) -> None:
        self._store = store
        self._breaker = breaker or Breaker()
        self._is_away = False

    @property
    def is_pausing(self) -> bool:
        """Whether the store was away a moment ago. Asks nobody, so it never waits."""
        return self._is_away and self._breaker.is_open

    def explains(self, error: Exception) -> bool:
        """Whether an attempt ended with this error because the store is away, for all alike."""
        is_full = isinstance(error, ObjectStoreFullError)
        return isinstance(error, ObjectStoreError) and not is_full and self.is_away()

    def is_away(self) -> bool:
        """Whether the store does not answer now. Asks it."""
        try:
            self._store.ping()
        except ObjectStoreError as error:
            pause_s = self._breaker.failed()
            if not self._is_away:
                _log.warning("no stage is begun, the object store is away: %s", error)
            self._is_away = True
            _log.info("the object store is asked again in %.0f s", pause_s)
            return True
        if self._is_away:
            _log.warning("the object store answers again: stages are begun")
        self._breaker.succeeded()
        self._is_away = False
        return False

    def answers(self) -> bool:
        """To be asked before a claim; may wait for the store where it was away before."""
        if not self._is_away:
            return True
        return not self._breaker.is_open and not self.is_away()
