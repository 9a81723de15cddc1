"""Tasks on a Dask cluster: on this machine, behind a scheduler's address, or in the jobs of a batch
system."""

from __future__ import annotations

import asyncio
import atexit
import concurrent.futures
import contextlib
import functools
import json
import logging
import pickle
import platform
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cloudpickle

from ipe_bench.basics.errors import StorageError, UserError, describe_exception
from ipe_bench.basics.machine import cores
from ipe_bench.basics.options import Count
from ipe_bench.runs.execution import FATAL, Event, Failure, Processes, Work, supervise

log = logging.getLogger(__name__)

_CONNECT_S = 30
_PATIENCE_S = 15.0
"""So long nothing is said while a cluster has no workers."""
_CANCELLED = asyncio.CancelledError, concurrent.futures.CancelledError
"""What is raised of a task that was called off."""


@dataclass(frozen=True)
class Dask(Processes):
    """Runs tasks on the workers of a Dask cluster, which write to the output directory themselves:
    all machines need it under the same path, and the same installation of ipe-bench and its
    plugins.

    Each Dask worker hands its task on to a process of its own, so that what an estimator does to
    its process never reaches Dask. A task whose Dask worker dies is given to another one by Dask
    itself.
    """

    workers: Count | None = None
    """Workers to start; None: one per core here, one job in a batch system."""
    address: str | None = None
    """A running scheduler, such as tcp://10.0.0.1:8786, to use in place of starting one."""
    jobqueue: str | None = None
    """A cluster class of dask-jobqueue, such as SLURMCluster, to start workers as jobs of a batch
    system."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Keyword arguments of the cluster class."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.address is not None and (
            self.jobqueue is not None or self.workers is not None or self.options
        ):
            raise UserError(
                f"address={self.address}: goes with no workers, jobqueue or options; leave out"
                " either"
            )

    def run(self, work: Work, tasks: Sequence[Any]) -> Iterator[Event]:
        if not tasks:
            return
        options = json.dumps(dict(self.options), sort_keys=True, default=str)
        client = _connect(self.workers, self.address, self.jobqueue, options)
        from distributed import as_completed

        # As bytes: what a Dask worker cannot unpickle, such as a plugin that it lacks, is then ours
        # to name.
        payloads = [cloudpickle.dumps((work, task)) for task in tasks]
        limits = self.block_timeout_s, self.memory_limit_gb
        futures = {
            client.submit(_run_one, payload, *limits, pure=False): i
            for i, payload in enumerate(payloads)
        }
        heard = threading.Event()
        threading.Thread(target=_say_when_nobody_works, args=(client, heard), daemon=True).start()
        try:
            for future in as_completed(list(futures)):
                heard.set()
                index = futures[future]
                error = None if future.cancelled() else future.exception()
                if isinstance(error, FATAL):
                    raise error
                if future.cancelled() or isinstance(error, _CANCELLED):
                    raise _lost(client)
                if error is not None:  # Dask gave up on it: its workers died again and again
                    failure = Failure(
                        "died", f"{type(error).__name__}: {' '.join(str(error).split())}"
                    )
                    yield Event(index, ended=True, failure=failure)
                    continue
                steps, failure = future.result()
                for step in steps:
                    yield Event(index, step)
                yield Event(index, ended=True, failure=failure)
        except (
            *_CANCELLED,
            OSError,
        ) as error:  # what as_completed raises where the scheduler is gone
            raise _lost(client) from error
        finally:
            heard.set()
            with contextlib.suppress(Exception, *_CANCELLED):
                client.cancel(list(futures), force=True)


def _lost(client: Any) -> StorageError:
    return StorageError(
        f"execution=dask: the scheduler at {client.scheduler.address} is gone; results are kept;"
        " run the same command to resume"
    )


def _say_when_nobody_works(client: Any, heard: threading.Event) -> None:
    """A scheduler without workers waits for ever, in case that one comes: says so, again and
    again."""
    while not heard.wait(_PATIENCE_S):
        with contextlib.suppress(Exception):
            if not client.nthreads():
                address = client.scheduler.address
                log.warning(
                    f"execution=dask: the scheduler at {address} has no workers yet; waiting for"
                    " one"
                )


def _run_one(payload: bytes, timeout_s: float | None, memory_gb: float | None) -> Any:
    """On a Dask worker: the steps and the failure of one task, done in a process beside it."""
    try:
        work, task = pickle.loads(payload)
    except Exception as error:
        return [], Failure(
            "died", f"{describe_exception(error)}, on {platform.node()}: install the same there"
        )
    events = list(supervise(work, [task], 1, 1, timeout_s, memory_gb))
    return [event.step for event in events if not event.ended], events[-1].failure


@functools.cache
def _connect(
    workers: int | None, address: str | None, jobqueue: str | None, options_json: str
) -> Any:
    """A client of the cluster that these options describe; it serves all runs of this process, then
    is closed."""
    try:
        import distributed
    except ImportError:
        raise UserError("execution=dask: Dask is not installed; pip install distributed") from None
    # What Dask logs of a cluster that goes away is a traceback; a line of ours says it.
    for name in ("client", "core", "comm", "batched"):
        logging.getLogger(f"distributed.{name}").setLevel(logging.CRITICAL)
    options = json.loads(options_json)
    if address is not None:
        try:
            client = distributed.Client(address, timeout=_CONNECT_S)
        except (OSError, ValueError) as error:
            raise UserError(
                f"execution.address={address}: no scheduler answers there ({error})"
            ) from None
    else:
        if jobqueue is not None:
            cluster = _jobqueue_cluster(jobqueue, options)
            cluster.scale(workers or 1)
        else:
            options = {
                "n_workers": workers or cores(),
                "threads_per_worker": 1,
                "dashboard_address": None,
                **options,
            }
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # it may warn of ports in use
                cluster = distributed.LocalCluster(**options)
        client = distributed.Client(cluster)
        atexit.register(cluster.close)
    atexit.register(client.close)
    return client


def _jobqueue_cluster(name: str, options: Mapping[str, Any]) -> Any:
    try:
        import dask_jobqueue
    except ImportError:
        raise UserError(
            "execution=dask: dask-jobqueue is not installed; pip install dask-jobqueue"
        ) from None
    known = [n for n in dir(dask_jobqueue) if n.endswith("Cluster")]
    if name not in known:
        raise UserError(
            f"execution.jobqueue={name}: there is no such cluster (there are: {', '.join(known)})"
        )
    try:
        return getattr(dask_jobqueue, name)(**options)
    except (TypeError, ValueError) as error:
        raise UserError(f"execution.options: {name} refuses them: {error}") from None
