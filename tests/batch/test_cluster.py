"""The local cluster has its workers, also after one died."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest

from caliv_graph.batch import cluster

PATIENCE_S = 120.0


def test_a_worker_that_dies_before_its_nanny_knows_it_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from distributed.nanny import WorkerProcess

    # As on a busy machine: the scheduler knows the worker long before the nanny does. Dask takes a
    # death in between for a failed start, and does not start the worker again.
    monkeypatch.setattr(WorkerProcess, "_init_msg_interval", 2.0)

    with cluster.start(1, tmp_path) as workers:
        assert workers.count() == 1
        (pid,) = workers.client.run(os.getpid).values()
        os.kill(pid, signal.SIGKILL)

        end = time.monotonic() + PATIENCE_S
        pids = {pid}
        while pids <= {pid} and time.monotonic() < end:
            time.sleep(0.2)
            assert workers.count() <= 1
            pids = set(workers.client.run(os.getpid, on_error="ignore").values())

        assert len(pids - {pid}) == 1
        assert workers.count() == 1


def test_a_scheduler_without_certificates_is_connected() -> None:
    from distributed import LocalCluster

    with LocalCluster(  # type: ignore[no-untyped-call]
        n_workers=1,
        threads_per_worker=1,
        processes=False,
        protocol="tcp",
        host="127.0.0.1",
        dashboard_address=None,
    ) as there:
        assert there.scheduler_address.startswith("tcp://")
        with cluster.connect(there.scheduler_address) as workers:
            assert workers.connected
            assert workers.count() == 1
            assert workers.client.submit(os.getpid, pure=False).result() == os.getpid()
