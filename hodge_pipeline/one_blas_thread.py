"""One thread for BLAS: the matrices here are small, and its threads wait for each other longer than they compute."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import scipy.linalg  # noqa: F401 - its BLAS is another than numpy's, and must be loaded to be found
from threadpoolctl import ThreadpoolController

Inputs = ParamSpec("Inputs")
Result = TypeVar("Result")
CONTROLLER = ThreadpoolController()


def one_blas_thread(function: Callable[Inputs, Result]) -> Callable[Inputs, Result]:
    """The function; while it runs BLAS has one thread in this process."""

    @wraps(function)
    def limited(*args: Inputs.args, **kwargs: Inputs.kwargs) -> Result:
        with CONTROLLER.limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited
