"""Workers of a batch: a local Dask cluster, or those of an existing scheduler.

Dask is an optional dependency (extra `batch`), so it is imported in the functions.
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
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from multiprocessing import resource_tracker
from pathlib import Path
from types import FrameType
from typing import Any

from caliv_graph.batch.worker import probe
from caliv_graph.errors import BatchError

CONNECT_S = 10.0
"""Seconds to wait for the answer of a scheduler, and then for its first worker."""

_START_S = 120.0
"""Seconds to wait for the first worker of the local cluster on a busy machine."""

_END_S = 0.5
"""Seconds to wait for a worker to end by itself; its work is not needed any more."""

_KILL_S = 10.0
"""Seconds to wait for Dask to end its workers before they are killed."""

_LOGGERS = (
    *("distributed", "distributed.client", "distributed.gc", "distributed.nanny", "asyncio"),
    *("distributed.worker.memory", "tornado", "tornado.application", "bokeh"),
)

_ENDED = ("closed", "failed")
"""States of a Dask nanny that does not restart its worker: one of them follows when the worker dies
before its nanny knows that it has started."""

_RETRY_S = 0.5

_ADDRESS = re.compile(r"(?:(?:tcp|tls)://)?(?P<host>[\w.-]+|\[[0-9a-fA-F:.]+\]):(?P<port>\d{1,5})")

_DEATH = re.compile(r"Worker process (\d+) (was killed by .*|exited with .*)")
_MEMORY = re.compile(r"\(pid=(\d+)\) exceeded (\d+)% memory")


class Workers:
    """A connection to the workers of a batch.

    Attributes:
        client: the Dask client.
        deaths: per process of the local cluster that died, the reason.

    Args:
        client: see above.
        most: the largest number of jobs at a time; None: as many as there are workers.
        deaths: see above.
        replace_lost: starts the workers of the local cluster that Dask does not start again; None:
            the workers are not ours.
    """

    def __init__(
        self,
        client: Any,
        most: int | None,
        deaths: dict[int, str],
        replace_lost: Callable[[], None] | None = None,
    ) -> None:
        self.client = client
        self.deaths = deaths
        self._most = most
        self._replace_lost = replace_lost

    def count(self) -> int:
        """The number of jobs that can run at a time; 0 while no worker is there.

        Of a local cluster, this includes the workers that are still starting.
        """
        count = len(self.client.nthreads())
        if self._replace_lost is not None:
            self._replace_lost()
            if count and self._most is not None:
                return self._most
        return count if self._most is None else min(count, self._most)

    @property
    def connected(self) -> bool:
        """Whether the scheduler is connected."""
        return bool(self.client.status == "running")

    @property
    def lost(self) -> bool:
        """Whether the connection to the scheduler is lost finally."""
        return self.client.status in ("closing", "closed", "failed")


@contextmanager
def connect(address: str, most: int | None = None) -> Iterator[Workers]:
    """The workers of an existing scheduler such as tcp://host:8786; at most `most` jobs at a time.

    Raises:
        BatchError: Dask is not installed, no scheduler answers within CONNECT_S, or it has no
            workers.
    """
    distributed = _distributed()
    _await_answer(address)
    client: Any = None
    with _dask_loggers_redirected() as deaths, ExitStack() as stack:
        # Client and its cleanup would wait forever for a server that is not a Dask scheduler.
        with suppress(Exception):
            asyncio.run(asyncio.wait_for(_identify(address), CONNECT_S))
            with _interrupts_later():
                client = distributed.Client(
                    address, timeout=CONNECT_S, set_as_default=False, name="caliv-graph"
                )
                stack.callback(_close, client)
        if client is None:
            raise BatchError(
                f"--scheduler {address}: a server is there, but does not answer like a Dask "
                f"scheduler within {CONNECT_S:g} s. Check the address, and that the scheduler has "
                "the version of Dask of this environment"
                + ", and distributed.comm.tls of Dask's configuration"
                * address.startswith("tls:")
            )
        try:
            client.wait_for_workers(1, timeout=CONNECT_S)
        except Exception:
            raise BatchError(
                f"--scheduler {address}: has no workers. Start some with 'dask worker {address}' "
                "in the environment of caliv-graph"
            ) from None
        yield Workers(client, most, deaths)


@contextmanager
def start(count: int, scratch: Path) -> Iterator[Workers]:
    """Workers of a local cluster: processes on this machine, one thread each.

    They end with the context, even during a job, and when this process is killed. Dask has its
    files in `scratch`.

    Raises:
        BatchError: Dask is not installed, or no worker starts.
    """
    distributed = _distributed()
    dask = import_module("dask")
    before = set(multiprocessing.active_children())
    settings = {
        "distributed.scheduler.worker-ttl": None,  # native code may block a worker for long
        # Dask ends a worker for good that has not restarted by then, as on a busy machine.
        "distributed.deploy.lost-worker-timeout": f"{_START_S:g}s",
        "distributed.comm.timeouts.tcp": "120s",
        # A job has nothing to spill, and a paused worker would never continue.
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
    with _dask_loggers_redirected() as deaths, dask.config.set(settings), ExitStack() as stack:
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
                f"batch: no worker started within {_START_S:g} s: {str(e) or repr(e)}. Try fewer "
                "--workers"
            ) from None

        async def forget_closed() -> None:
            closed = [n for n, nanny in cluster.workers.items() if nanny.status.name in _ENDED]
            for name in closed:
                del cluster.workers[name]

        def replace_lost() -> None:
            cluster.sync(forget_closed)
            cluster.scale(count)  # starts what is missing

        yield Workers(client, count, deaths, replace_lost)


def default_workers() -> int:
    """The number of processors that this process may use.

    Raises:
        BatchError: Dask is not installed.
    """
    _distributed()
    return int(import_module("dask.system").CPU_COUNT)


def check_workers(workers: Workers, token: Path, version: str) -> None:
    """Checks that the workers can run the jobs; `token` is a file in the folder of the batch.

    Raises:
        BatchError: a worker cannot; the message names it and the reason.
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
            "batch: Dask is not installed. Install it with pip install 'caliv-graph[batch]'"
        ) from None


def _await_answer(address: str) -> None:
    """Waits until a server listens there; Dask itself would wait in a busy loop."""
    parts = _ADDRESS.fullmatch(address)
    if parts is None or int(parts["port"]) > 65535:
        raise BatchError(
            f"--scheduler {address}: is not an address of a scheduler: expected tcp://host:port, "
            "as printed by 'dask scheduler'"
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
    """Asks a server for its identity; raises if it is not a Dask scheduler."""
    core: Any = import_module("distributed.core")
    # Certificates of tls:// are those of Dask's own configuration, as for the client.
    security = _distributed().Security().get_connection_args("client")
    comm = await core.connect(address, timeout=CONNECT_S, **security)
    try:
        await comm.write({"op": "identity", "reply": True})
        answer = await comm.read()
        if answer["type"] != "Scheduler":
            raise ValueError(answer["type"])
    finally:
        comm.abort()


def _share_of_memory(count: int) -> int:
    """Memory limit per worker in bytes; Dask kills a worker that exceeds it."""
    memory: int = import_module("distributed.system").MEMORY_LIMIT
    return memory // count


async def _shield_children() -> None:
    """Blocks interrupts in the processes that are started from Dask's thread.

    A terminal sends an interrupt to all processes, and each would print a traceback. The main
    thread of the batch handles the interrupt and ends the workers. Processes inherit the signal
    mask of the thread that starts them.
    """
    # Python starts the tracker with its first process and then resets the mask of that thread.
    resource_tracker.ensure_running()
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})


@contextmanager
def _interrupts_later() -> Iterator[None]:
    """Delays interrupts while Dask's objects are created: incomplete ones would never end."""
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
        # The signal is delivered now.
        signal.raise_signal(came[0])


class _Listener(logging.Handler):
    """Collects the reasons why workers died, and keeps Dask's messages off the terminal."""

    def __init__(self) -> None:
        super().__init__()
        self.deaths: dict[int, str] = {}

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if found := _MEMORY.search(text):
            self.deaths[int(found[1])] = f"used more than {found[2]} % of its memory limit"
        elif found := _DEATH.search(text):
            self.deaths.setdefault(int(found[1]), found[2])


@contextmanager
def _dask_loggers_redirected() -> Iterator[dict[int, str]]:
    """Redirects Dask's loggers: stderr is for messages that a user can act upon."""
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
    """Ends workers at once; Dask itself would wait for their jobs."""

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
    """Kills all worker processes that are left after an error."""
    for child in set(multiprocessing.active_children()) - before:
        with suppress(Exception):
            child.kill()
            child.join(5)
