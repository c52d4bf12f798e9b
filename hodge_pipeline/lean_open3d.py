"""open3d without what it draws in a browser with: plotly, dash and IPython take half the time of its import.

`open3d.visualization.draw_plotly` and its like work all the same: they import them when they are called.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType
from typing import Any

from hodge_pipeline.interrupts import delayed_interrupts

_PLOTLY = "open3d.visualization.draw_plotly"


class _WhenCalled(ModuleType):
    """In place of a module: each function imports that when it is called."""

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("__"):
            raise AttributeError(name)

        def call(*arguments: Any, **options: Any) -> Any:
            package, _, module = self.__name__.rpartition(".")
            before = getattr(sys.modules[package], module)  # a function of the same name, which the import hides
            function = getattr(import_module(self.__name__), name)
            setattr(sys.modules[package], module, before)
            return function(*arguments, **options)

        return call


@contextmanager
def _left_out(module: str) -> Iterator[None]:
    """While this lasts the module is imported by nobody who has not imported it before."""
    if module in sys.modules:
        yield
        return
    sys.modules[module] = _WhenCalled(module)
    try:
        yield
    finally:
        del sys.modules[module]


with delayed_interrupts(), _left_out(_PLOTLY):  # stopped while it starts, it prints pages of memory statistics
    import open3d as o3d

__all__ = ["o3d"]
