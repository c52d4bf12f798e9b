"""The 3-D viewer, viser, behind a socket that only this user can open."""

from __future__ import annotations

import contextlib
import io
import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hodge_pipeline.errors import WorkspaceError

MISSING = "hodge review needs viser: pip install 'hodge-pipeline[review]'"


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
                """Nothing: it would publish the scene on a server of viser's authors."""
                return None

        self._folder = tempfile.TemporaryDirectory(prefix="hodge-review-")
        self.path = Path(self._folder.name) / "viser"
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


@contextlib.contextmanager
def _listening_on(path: Path) -> Iterator[None]:
    """While viser starts, what it calls to listen on a port listens on this socket: it has no option for that."""
    from websockets.asyncio import server

    original = server.serve

    def serve(handler: Any, host: str, port: int, **options: Any) -> Any:
        return original(handler, unix=True, path=str(path), **options)

    server.serve = serve  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        server.serve = original  # type: ignore[misc]


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Viser prints an address that nobody can open."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
