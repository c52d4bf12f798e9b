"""BLAS has one thread while a graph is solved, and the caller's own number of them afterwards."""

from __future__ import annotations

import pytest
from threadpoolctl import threadpool_limits

from hodge_pipeline.one_blas_thread import CONTROLLER, one_blas_thread


def threads() -> set[int]:
    return {each["num_threads"] for each in CONTROLLER.select(user_api="blas").info()}


def test_one_thread_inside_and_the_callers_number_after() -> None:
    with threadpool_limits(2, user_api="blas"):
        assert one_blas_thread(threads)() == {1}
        assert threads() == {2}


def test_the_callers_number_is_back_after_an_error() -> None:
    @one_blas_thread
    def fails() -> None:
        raise ValueError("as it should")

    with threadpool_limits(2, user_api="blas"):
        with pytest.raises(ValueError, match="as it should"):
            fails()
        assert threads() == {2}
