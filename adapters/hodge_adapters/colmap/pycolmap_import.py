"""pycolmap, imported without the signal handlers that it installs, and quiet.

Its logging library takes SIGTERM to print a stack trace, so a run that is asked to end would die without a word. Its
warnings are of single steps of a solver that goes on by another one: what fails is raised.
"""

from __future__ import annotations

import signal
from contextlib import suppress

_before = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402 - between the two lines that keep the handler

if _before is not None:
    with suppress(ValueError):  # only the main thread may set one
        signal.signal(signal.SIGTERM, _before)

pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value

__all__ = ["pycolmap"]
