"""pycolmap, imported when it is first used, without the signal handlers that it installs, and quiet.

Its import takes .15 s, and whoever asks every reader what a file is needs none of it. Its logging library takes SIGTERM
to print a stack trace, so a run that is asked to end would die without a word. Its warnings are of single steps of a
solver that goes on by another one: what fails is raised.
"""

from __future__ import annotations

import signal
from contextlib import suppress
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any


@cache
def _imported() -> ModuleType:
    before = signal.getsignal(signal.SIGTERM)
    module = import_module("pycolmap")
    if before is not None:
        with suppress(ValueError):  # only the main thread may set one
            signal.signal(signal.SIGTERM, before)
    module.logging.minloglevel = module.logging.ERROR.value
    return module


class _WhenUsed(ModuleType):
    def __getattr__(self, name: str) -> Any:
        return getattr(_imported(), name)


if TYPE_CHECKING:
    import pycolmap
else:
    pycolmap = _WhenUsed("pycolmap")

__all__ = ["pycolmap"]
