"""Observers that the options of ``dvo run`` ask for."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator
from pathlib import Path

from dvo.commands.console import warn
from dvo.commands.view_options import VIEWER
from dvo.data.frame import Frame
from dvo.odometry.protocol import Estimate, Odometry
from dvo.session.observer import Observer
from dvo.session.results import RECORDING
from dvo.session.session import Run


class GuardedObserver:
    """Observer that ends with a warning at its first failure, which costs no frame and no result of the run.

    Args:
        observer: to call.
        option: of the command line that asks for it, for the warning.

    Attributes:
        option: of the command line.
    """

    def __init__(self, observer: Observer, option: str) -> None:
        self.option = option
        self._observer, self._failed = observer, False
        self._warnings: list[str] = []

    @property
    def warnings(self) -> list[str]:
        """Sentences that were printed so far, by the observer (its attribute ``warnings``) and at its failure."""
        return [*getattr(self._observer, "warnings", ()), *self._warnings]

    @property
    def file(self) -> Path | None:
        """File that the observer writes (its attribute ``file``); None if it writes none, or has failed."""
        return None if self._failed else getattr(self._observer, "file", None)

    def begin(self, odometry: Odometry) -> None:
        """See :class:`dvo.session.observer.Observer`."""
        if not self._failed:
            with self._guard():
                self._observer.begin(odometry)

    def update(self, frame: Frame, estimate: Estimate | None) -> None:
        """See :class:`dvo.session.observer.Observer`."""
        if not self._failed:
            with self._guard():
                self._observer.update(frame, estimate)

    def finish(self, run: Run) -> None:
        """See :class:`dvo.session.observer.Observer`."""
        if not self._failed:
            with self._guard():
                self._observer.finish(run)

    def close(self) -> None:
        """Release files and connections, also after a failure."""
        with self._guard():
            self._observer.close()

    @contextlib.contextmanager
    def _guard(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            if not self._failed:
                problem = f"{self.option} ended by {type(error).__name__}: {error}; the run goes on without it"
                self._warnings.append(problem)
                warn(problem)
            self._failed = True


@contextlib.contextmanager
def open_observers(arguments: argparse.Namespace, name: str, folder: Path) -> Iterator[list[Observer]]:
    """Open the observers for the time of a run.

    Args:
        arguments: of the command line.
        name: of the clip.
        folder: of the results; ``--rerun`` without a display writes there.

    Yields:
        Observers, closed at the end; a failure of one is a warning.

    Raises:
        DvoError: a package is missing, a file cannot be written, or it is the source itself.
    """
    with contextlib.ExitStack() as stack:
        found: list[Observer] = []

        def add(observer: Observer, option: str) -> None:
            found.append(GuardedObserver(observer, option))
            stack.callback(found[-1].close)

        if arguments.rerun_connect is not None:
            from dvo.viz.rerun_log import RerunLog

            add(RerunLog(None, name, arguments.rerun_connect), "--rerun-connect")
        if arguments.rerun is not None:
            from dvo.viz.rerun_log import RerunLog, has_display

            file = None if arguments.rerun == VIEWER else Path(arguments.rerun)
            if file is None and not has_display():
                file = folder / RECORDING
                warn(f"there is no display for the viewer: the run is written to {file}, for `rerun FILE`", "note")
            add(RerunLog(file, name), "--rerun")
        if arguments.overlay is not None:
            from dvo.viz.overlay import OverlayVideo

            add(OverlayVideo(Path(arguments.overlay)), "--overlay")
        yield found
