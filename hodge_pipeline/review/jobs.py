"""Background work of a review: one thread, in which the latest job of each kind replaces one that still waits."""

from __future__ import annotations

import sys
import threading
import traceback
from collections.abc import Callable

from hodge_pipeline.errors import HodgeError

Job = Callable[[], None]


class Jobs:
    """A thread that runs jobs in order; a job replaces a waiting one of its kind. `failed` gets errors in words."""

    def __init__(self, name: str, failed: Callable[[str], None]) -> None:
        self._failed = failed
        self._changed = threading.Condition()
        self._waiting: dict[str, Job] = {}
        self._doing = ""
        self._closed = False
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    @property
    def doing(self) -> str:
        """The kind of the job in progress, or of the next; empty where there is none."""
        with self._changed:
            return self._doing or next(iter(self._waiting), "")

    def put(self, kind: str, job: Job) -> None:
        """Run the job after those that wait already."""
        with self._changed:
            self._waiting[kind] = job
            self._changed.notify_all()

    def wait(self) -> None:
        """Return when no job waits or runs."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or not (self._waiting or self._doing))

    def close(self) -> None:
        """End the thread after the job in progress."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._doing = ""
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._closed or self._waiting)
                if self._closed:
                    return
                self._doing = next(iter(self._waiting))
                job = self._waiting.pop(self._doing)
            try:
                job()
            except HodgeError as error:
                self._failed(str(error))
            except Exception as error:  # a page must say that something went wrong, whatever it was
                traceback.print_exc(file=sys.stderr)
                self._failed(f"{self._doing}: {type(error).__name__}: {error}")
