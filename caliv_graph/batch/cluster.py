"""Workers of a batch: a Dask cluster of our own on this machine, or an existing scheduler's.

Dask comes with an extra, and is imported late: for everything else this program does without.
"""

from __future__ import annotations

import asyncio
import logging
import multiprocessing
import re
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from multiprocessing import resource_tracker
from pathlib import Path
from types import FrameType
from typing import Any

from caliv_graph.batch.worker import probe
from caliv_graph.errors import BatchError

CONNECT_S = 10.0
"""Seconds that a scheduler may take to answer, and then to have a worker."""

_START_S = 120.0
"""Seconds that workers of our own may take to start, on a machine that is busy with them."""

_END_S = 0.5
"""Seconds that a worker gets to end by itself. What it is at is of no more use."""

_KILL_S = 10.0
"""Seconds that Dask gets to end its workers, before they are killed over its head."""

_LOGGERS = (
    *("distributed", "distributed.client", "distributed.gc", "distributed.nanny", "asyncio"),
    *("distributed.worker.memory", "tornado", "tornado.application", "bokeh"),
)

_RETRY_S = 0.5

_ADDRESS = re.compile(r"(?:(?:tcp|tls)://)?(?P<host>[\w.-]+|\[[0-9a-fA-F:.]+\]):(?P<port>\d{1,5})")

_DEATH = re.compile(r"Worker process (\d+) (was killed by .*|exited with .*)")
_MEMORY = re.compile(r"\(pid=(\d+)\) exceeded (\d+)% memory")


class Workers:
    """A connection to the workers of a batch.

    Attributes:
        client: Dask's.
        deaths: per process of our own cluster that ended, how.
    """

    def __init__(
        self, client: Any, count: int | None, most: int | None, deaths: dict[int, str]
    ) -> None:
        """Makes it.

        Args:
            client: Dask's.
            count: of workers; None: it may change, and is asked for.
            most: jobs at a time, at most.
            deaths: filled in as they come.
        """
        self.client = client
        self.deaths = deaths
        self._count, self._most = count, most

    def count(self) -> int:
        """How many jobs can be done at a time."""
        count = len(self.client.nthreads()) if self._count is None else self._count
        return count if self._most is None else min(count, self._most)

    @property
    def connected(self) -> bool:
        """Whether the scheduler can be spoken to."""
        return bool(self.client.status == "running")

    @property
    def lost(self) -> bool:
        """Whether the scheduler is gone for good."""
        return self.client.status in ("closing", "closed", "failed")


@contextmanager
def connect(address: str, most: int | None = None) -> Iterator[Workers]:
    """The workers of an existing scheduler.

    Args:
        address: such as tcp://host:8786.
        most: jobs at a time, at most; None: as many as there are workers.

    Raises:
        BatchError: Dask is not installed, nobody answers within CONNECT_S, or there is no worker.
    """
    distributed = _distributed()
    _await_answer(address)
    client: Any = None
    with _heard_quietly() as deaths, ExitStack() as stack:
        # A client waits for the wrong kind of server without end, and its clean-up does so too.
        with suppress(Exception):
            asyncio.run(asyncio.wait_for(_identify(address), CONNECT_S))
            with _interrupts_later():
                client = distributed.Client(
                    address, timeout=CONNECT_S, set_as_default=False, name="caliv-graph"
                )
                stack.callback(_close, client)
        if client is None:
            raise BatchError(
                f"--scheduler {address}: something is there, but does not answer within "
                f"{CONNECT_S:g} s as a Dask scheduler would. Look at the address, and whether "
                "its version is this environment's"
            )
        try:
            client.wait_for_workers(1, timeout=CONNECT_S)
        except Exception:
            raise BatchError(
                f"--scheduler {address}: has no workers. Start some with 'dask worker {address}' "
                "in the environment of caliv-graph"
            ) from None
        yield Workers(client, None, most, deaths)


@contextmanager
def start(count: int, scratch: Path) -> Iterator[Workers]:
    """Workers of our own: processes on this machine, one thread each.

    They end with the context, whatever they are at, and if this process is killed.

    Args:
        count: how many.
        scratch: folder for what Dask writes.

    Raises:
        BatchError: Dask is not installed, or they do not start.
    """
    distributed = _distributed()
    dask = import_module("dask")
    before = set(multiprocessing.active_children())
    settings = {
        "distributed.scheduler.worker-ttl": None,  # native code may hold a worker up for long
        "distributed.comm.timeouts.tcp": "120s",
        # A job is one piece of work: nothing to spill, and to pause a worker would end the batch.
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.pause": False,
        "distributed.worker.profile.enabled": False,
        "distributed.nanny.pre-spawn-environ": {
            **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), 1),
            "DASK_LOGGING__DISTRIBUTED": "critical",
            "PYTHONWARNINGS": "ignore",
        },
    }
    with _heard_quietly() as deaths, dask.config.set(settings), ExitStack() as stack:
        stack.callback(_kill_children, before)
        try:
            with _interrupts_later():
                cluster = distributed.LocalCluster(
                    n_workers=0,
                    threads_per_worker=1,
                    processes=True,
                    host="127.0.0.1",
                    dashboard_address=None,
                    worker_dashboard_address=None,
                    local_directory=str(scratch),
                    preload=["caliv_graph.batch.worker"],
                    memory_limit=_share_of_memory(count),
                    silence_logs=logging.CRITICAL,
                )
                stack.callback(_end, cluster)
                client = distributed.Client(cluster, set_as_default=False)
                stack.callback(_close, client)
            cluster.sync(_shield_children)
            cluster.scale(count)
            client.wait_for_workers(1, timeout=_START_S)
        except Exception as e:
            raise BatchError(
                f"batch: no worker has started within {_START_S:g} s: {str(e) or repr(e)}. Try "
                "fewer --workers"
            ) from None
        yield Workers(client, count, count, deaths)


def default_workers() -> int:
    """Processors that this process may use.

    Raises:
        BatchError: Dask is not installed.
    """
    _distributed()
    return int(import_module("dask.system").CPU_COUNT)


def check_workers(workers: Workers, token: Path, version: str) -> None:
    """Whether the workers of a scheduler can do the jobs.

    Args:
        workers: connected.
        token: a file in the batch's folder.
        version: of this program.

    Raises:
        BatchError: one cannot; it and the reason are named.
    """
    answers = workers.client.run(probe, str(token), version, on_error="return")
    for address, answer in answers.items():
        if isinstance(answer, ImportError):
            answer = f"has no caliv-graph ({answer}): start it in the environment of caliv-graph"
        elif isinstance(answer, Exception):
            answer = f"does not answer ({answer!r})"
        if answer:
            raise BatchError(f"--scheduler: the worker at {address} {answer}")


def _distributed() -> Any:
    try:
        return import_module("distributed")
    except ImportError:
        raise BatchError(
            "batch: needs Dask, which is not installed. Install it with "
            "pip install 'caliv-graph[batch]'"
        ) from None


def _await_answer(address: str) -> None:
    """Waits until somebody listens there: Dask itself would do so with a processor of its own."""
    parts = _ADDRESS.fullmatch(address)
    if parts is None or int(parts["port"]) > 65535:
        raise BatchError(
            f"--scheduler {address}: is no address of a scheduler: expected tcp://host:port, as "
            "'dask scheduler' prints it"
        )
    host, port = parts["host"].strip("[]"), int(parts["port"])
    end = time.monotonic() + CONNECT_S
    while True:
        try:
            socket.create_connection((host, port), timeout=CONNECT_S).close()
            return
        except OSError as e:
            reason = e.strerror or str(e)
        if time.monotonic() > end - _RETRY_S:
            raise BatchError(
                f"--scheduler {address}: no Dask scheduler answers there within {CONNECT_S:g} s "
                f"({reason}). Start one with 'dask scheduler', or leave the option out"
            )
        time.sleep(_RETRY_S)


async def _identify(address: str) -> None:
    """Asks a scheduler who it is, and drops the line at once if it is none."""
    core: Any = import_module("distributed.core")
    comm = await core.connect(address, timeout=CONNECT_S)
    try:
        await comm.write({"op": "identity", "reply": True})
        answer = await comm.read()
        if answer["type"] != "Scheduler":
            raise ValueError(answer["type"])
    finally:
        comm.abort()


def _share_of_memory(count: int) -> int:
    """Bytes for each worker; who takes more is ended before the whole machine stands still."""
    memory: int = import_module("distributed.system").MEMORY_LIMIT
    return memory // count


async def _shield_children() -> None:
    """Has processes that are started from Dask's thread never hear of an interrupt.

    A terminal sends it to all of them, and each would have something to say; the batch hears it in
    its main thread, and ends them. The mask of a thread goes to what it starts.
    """
    # Python starts this with its first process, and takes the mask off the thread that does.
    resource_tracker.ensure_running()
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})


@contextmanager
def _interrupts_later() -> Iterator[None]:
    """Lets Dask's objects be made before an interrupt counts: those made by half never end."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []

    def remember(number: int, frame: FrameType | None) -> None:
        came.append(number)

    before = {n: signal.signal(n, remember) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
    if came:
        # Whoever asked to be told of it is told now.
        signal.raise_signal(came[0])


class _Listener(logging.Handler):
    """Hears how workers ended, and keeps what Dask says of itself off the terminal."""

    def __init__(self) -> None:
        super().__init__()
        self.deaths: dict[int, str] = {}

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if found := _MEMORY.search(text):
            self.deaths[int(found[1])] = f"used more than {found[2]} % of its share of the memory"
        elif found := _DEATH.search(text):
            self.deaths.setdefault(int(found[1]), found[2])


@contextmanager
def _heard_quietly() -> Iterator[dict[int, str]]:
    """Takes Dask's loggers over: stderr is for what a person can act upon."""
    listener = _Listener()
    loggers = [logging.getLogger(name) for name in _LOGGERS]
    before = [(list(log.handlers), log.level, log.propagate) for log in loggers]
    for log in loggers:
        log.handlers, log.propagate = [listener], False
        log.setLevel(logging.INFO)
    try:
        yield listener.deaths
    finally:
        for log, (handlers, level, propagate) in zip(loggers, before, strict=True):
            log.handlers, log.propagate = handlers, propagate
            log.setLevel(level)


def _end(cluster: Any) -> None:
    """Ends workers at once: by itself Dask would wait for what they are at."""

    async def end() -> None:
        nannies = list(cluster.workers.values())
        closing = (nanny.close(timeout=_END_S, reason="the batch ends") for nanny in nannies)
        await asyncio.wait_for(asyncio.gather(*closing, return_exceptions=True), _KILL_S)

    with suppress(Exception):
        cluster.sync(end)
    with suppress(Exception):
        cluster.close(timeout=_KILL_S)


def _close(client: Any) -> None:
    with suppress(Exception):
        client.close(timeout=2)


def _kill_children(before: set[Any]) -> None:
    """Nobody must be left behind, whatever went wrong while they were to end."""
    for child in set(multiprocessing.active_children()) - before:
        with suppress(Exception):
            child.kill()
            child.join(5)
