"""Open a review: its session, its 3-D scene and its server."""

from __future__ import annotations

import io
import os
import socket
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stdout, suppress
from pathlib import Path
from typing import Any

from hodge_pipeline.errors import WorkspaceError
from hodge_pipeline.review.front import Front
from hodge_pipeline.review.routes import site
from hodge_pipeline.review.scene import Scene
from hodge_pipeline.review.session import Session
from hodge_pipeline.review.subject import open_for_review
from hodge_pipeline.run_folder import Run
from hodge_pipeline.store.workspace import hold

MISSING = "hodge review needs viser: pip install 'hodge-pipeline[review]'"


class Review:
    """An open review: its `session`, its 3-D `viewer` and the `address` of its page; a context that closes it.

    `scene`: whether there is a 3-D viewer; `who` the log names, by default the user of this process.
    """

    def __init__(self, path: Path, *, port: int = 0, scene: bool = True, who: str | None = None) -> None:
        with ExitStack() as stack:
            stack.enter_context(_alone(path))
            self.session = Session(open_for_review(path), who=who)
            stack.callback(self.session.close)
            self.viewer = Viewer() if scene else None
            if self.viewer is not None:
                stack.callback(self.viewer.close)
                self.scene = Scene(self.session, self.viewer.server)
                stack.callback(self.scene.close)
            self._front = Front(site(self.session, None if self.viewer is None else self.viewer.path), port)
            stack.callback(self._front.close)
            self._stack = stack.pop_all()

    @property
    def address(self) -> str:
        """The URL of the page; whoever has it can decide."""
        return self._front.address

    def wait(self) -> None:
        """Return when the review is interrupted (Ctrl-C)."""
        with suppress(KeyboardInterrupt):
            while True:  # a signal just before an endless wait would not end it
                time.sleep(1.0)

    def close(self) -> None:
        """Stop serving; every decision is on disk already."""
        self._stack.close()

    def __enter__(self) -> Review:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_review(run: Run | Path | str, *, port: int = 0, browser: bool = True) -> Review:
    """Open a run, its folder or a pose-graph file for review on a page that only this machine can see, in the browser.

    `port` 0 takes a free one. `review.close()` ends it; the decisions are in the run folder's `edits.json`, or beside
    the graph, as soon as they are made. Raises `HodgeError` where the path holds neither, another review of it is
    open, the port is taken or viser is missing.
    """
    review = Review(run.folder if isinstance(run, Run) else Path(run), port=port)
    if browser:
        import webbrowser

        webbrowser.open(review.address)
    return review


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """While the body runs no other review of this path can be opened. Raises `WorkspaceError` where one is open."""
    try:
        held = os.open(path, os.O_RDONLY)
    except OSError as error:
        raise WorkspaceError(f"{path}: cannot be read ({error.strerror})") from error
    try:
        hold(held, f"{path}: is being reviewed already: use that page, or end it first")
        yield
    finally:
        os.close(held)


class Viewer:
    """A viser server that listens on a Unix socket in a folder of its own, mode 0700, and on no port.

    Raises `WorkspaceError` where viser is missing, or the system has no Unix sockets.
    """

    def __init__(self) -> None:
        try:
            import viser
        except ImportError as error:
            raise WorkspaceError(MISSING) from error
        if not hasattr(socket, "AF_UNIX"):
            raise WorkspaceError("hodge review needs Unix sockets, which this system does not have: see docs/review.md")

        class Private(viser.ViserServer):
            def request_share_url(self, verbose: bool = True) -> str | None:
                """None: viser's own would publish the scene on a server of its authors."""
                return None

        self._folder = tempfile.TemporaryDirectory(prefix="hodge-review-")
        self.path = Path(self._folder.name) / "viser"
        if len(os.fsencode(self.path)) > LONGEST_SOCKET:  # viser would wait for a server that never starts
            self._folder.cleanup()
            raise WorkspaceError(f"{self.path}: too long a name for a Unix socket: set TMPDIR to a shorter folder")
        with _silent(), _listening_on(self.path):
            self.server: Any = Private(host="127.0.0.1", port=0, verbose=False)
        if not self.path.is_socket():
            self.close()
            raise WorkspaceError(f"viser {viser.__version__} listens elsewhere than told: install the version tested")
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.server.gui.main_panel.minimize()

    def close(self) -> None:
        """End the viewer."""
        with _silent():
            self.server.stop()
        self._folder.cleanup()


LONGEST_SOCKET = 103
"""Bytes of the name of a Unix socket that every system takes."""


@contextmanager
def _listening_on(path: Path) -> Iterator[None]:
    """While the body runs websockets listens on this Unix socket in place of a port: viser has no option for that."""
    from websockets.asyncio import server

    original = server.serve

    def serve(handler: Any, host: str, port: int, **options: Any) -> Any:
        return original(handler, unix=True, path=str(path), **options)

    server.serve = serve  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        server.serve = original  # type: ignore[misc]


@contextmanager
def _silent() -> Iterator[None]:
    """While the body runs nothing is printed: viser prints an address that nobody can open."""
    with redirect_stdout(io.StringIO()):
        yield
