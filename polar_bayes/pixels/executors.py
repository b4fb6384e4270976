"""Who fits the blocks: threads of this process, or the workers of a cluster."""

import contextlib
import importlib
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, ThreadPoolExecutor, wait
from typing import Any

from polar_bayes.errors import FitError

AHEAD = 2
"""Blocks that wait for each that is being fitted: none idles, and memory stays small."""


@contextlib.contextmanager
def workers(scheduler: str | None) -> Iterator[tuple[Executor, int]]:
    """Something that runs functions, and how many at a time."""
    if scheduler is None:
        threads = os.cpu_count() or 1
        pool = ThreadPoolExecutor(threads)
        try:
            yield pool, threads
        except BaseException:  # an interrupt must not wait for blocks that take minutes
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        pool.shutdown()
        return
    try:
        distributed = importlib.import_module("distributed")
    except ImportError as error:
        raise FitError(
            "the library for clusters is not installed",
            where=f"scheduler={scheduler}",
            mend="pip install 'polar_bayes[cluster]', or leave the scheduler out",
        ) from error
    try:
        client = distributed.Client(scheduler, timeout="5s")
    except (OSError, ValueError) as error:
        raise FitError(
            "no scheduler answers there",
            where=f"scheduler={scheduler}",
            mend="give the address that `dask scheduler` prints, such as tcp://10.0.0.1:8786",
        ) from error
    with client:
        yield client.get_executor(), max(1, len(client.scheduler_info()["workers"]))


def as_completed(
    executor: Executor, count: int, function: Callable, tasks: Iterable[tuple]
) -> Iterator[tuple[tuple, Any]]:
    """Results as they come, with few tasks on their way at any time."""
    waiting, left = {}, iter(tasks)
    try:
        while True:
            for task in left:
                waiting[executor.submit(function, *task)] = task
                if len(waiting) >= AHEAD * count:
                    break
            if not waiting:
                return
            done, _ = wait(waiting, return_when=FIRST_COMPLETED)
            for future in done:
                yield waiting.pop(future), future.result()
    finally:
        for future in waiting:
            future.cancel()
