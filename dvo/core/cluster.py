"""Functions over a Ray cluster, and folders that travel as bytes.

Each node needs the environment of the driver, and files under the same paths. What a function leaves comes back through
Ray, so no folder of results need be shared.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import socket
import zipfile
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from dvo.core.errors import DvoError
from dvo.core.text import first_line

_POLL = 1.0  # seconds between two looks at should_stop
_REACH = 5.0  # seconds in which an address has to answer
_CLEANING = 5.0  # seconds that calls which are cancelled have to remove what they have begun


@contextlib.contextmanager
def connected(address: str, root: Path) -> Iterator[Any]:
    """Connect to a cluster for the time of a block.

    Args:
        address: of the cluster (``auto``, ``host:port``, ``ray://host:port``), or ``local`` for one on this machine.
        root: folder that a local cluster imports from; a remote one has an environment of its own.

    Yields:
        The module ``ray``.

    Raises:
        DvoError: Ray is not installed, or there is no cluster.
    """
    try:
        ray = importlib.import_module("ray")
    except ImportError:
        raise DvoError("Ray is not installed", field="--ray", remedy="pip install 'dvo[ray]'") from None
    _check_listens(address)
    path = os.pathsep.join(filter(None, [str(root), os.environ.get("PYTHONPATH")]))
    own = {"runtime_env": {"env_vars": {"PYTHONPATH": path}}, "include_dashboard": False}
    options: dict[str, Any] = own if address == "local" else {}
    try:
        ray.init(address=address, log_to_driver=False, **options)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise _no_cluster(address, error) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _check_listens(address: str) -> None:
    """Raise DvoError if nothing listens at a host and port, of which Ray asks again and again for many minutes."""
    if address == "auto":
        address = os.environ.get("RAY_ADDRESS", address)  # which Ray looks up first
    try:
        place = urlsplit(address if "://" in address else f"//{address}")
        if place.hostname and place.port:
            socket.create_connection((place.hostname, place.port), _REACH).close()
    except (OSError, ValueError) as error:  # of the port
        raise _no_cluster(address, error) from error


def _no_cluster(address: str, error: Exception) -> DvoError:
    message = f"no Ray cluster at '{address}' ({first_line(error)})"
    return DvoError(message, field="--ray", remedy="start one: ray start --head")


def run_on(
    ray: Any,
    function: Callable[[Any], Any],
    items: Sequence[Any],
    *,
    threads: int,
    accelerators: int = 0,
    at_most: int | None = None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Iterator[tuple[int, Callable[[], Any]]]:
    """Call a function for each item on a cluster.

    Args:
        ray: of :func:`connected`.
        function: importable on the nodes.
        items: its arguments.
        threads: CPUs that a call takes.
        accelerators: GPUs that a call takes.
        at_most: calls at the same time; None for as many as the cluster has room for.
        should_stop: asked about once a second; True cancels what is not done.

    Yields:
        Number of an item that is done, in order of time, and a function that gives what the call returned, or raises
        its exception.

    Raises:
        DvoError: no node has so many CPUs or GPUs, so that nothing would ever run.
    """
    wanted = {"CPU": threads, "GPU": accelerators}
    nodes = [node.get("Resources", {}) for node in ray.nodes() if node.get("Alive", True)]
    if not any(all(node.get(name, 0) >= number for name, number in wanted.items()) for node in nodes):
        text = " and ".join(f"{number} {name}" for name, number in wanted.items() if number)
        message = f"no node of the Ray cluster has {text} for a run"
        raise DvoError(message, field="--ray", remedy="set fewer threads (OMP_NUM_THREADS), or add a node")
    resources: dict[str, Any] = {"num_cpus": threads, "max_retries": 0}
    remote = ray.remote(**resources, **({"num_gpus": accelerators} if accelerators else {}))(function)
    left = iter(enumerate(items))
    waiting: dict[Any, int] = {}
    try:
        while not should_stop():
            while at_most is None or len(waiting) < at_most:
                number, item = next(left, (None, None))
                if number is None:
                    break
                waiting[remote.remote(item)] = number
            if not waiting:
                return
            done, _ = ray.wait(list(waiting), num_returns=1, timeout=_POLL)
            for reference in done:
                yield waiting.pop(reference), partial(ray.get, reference)
    finally:
        with contextlib.suppress(Exception):  # of a cluster that is gone
            for reference in waiting:
                ray.cancel(reference)
            if waiting:
                ray.wait(list(waiting), num_returns=len(waiting), timeout=_CLEANING)


def packed(folder: Path) -> bytes:
    """Pack all files of a folder.

    Args:
        folder: the folder.

    Returns:
        A zip file.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(path for path in folder.rglob("*") if path.is_file()):
            archive.write(file, file.relative_to(folder))
    return buffer.getvalue()


def unpack(content: bytes, folder: Path) -> None:
    """Write the files of :func:`packed`.

    Args:
        content: the zip file.
        folder: where; made if need be.
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        archive.extractall(folder)
