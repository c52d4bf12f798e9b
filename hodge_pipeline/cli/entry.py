"""What the command `hodge` starts with: nothing is imported before Ctrl-C is provided for."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command; Ctrl-C during its imports ends it with 130 and no traceback."""
    try:
        from hodge_pipeline.store.memory import keep_memory

        keep_memory()
        from hodge_pipeline.cli.main import main as command

        command()
    except KeyboardInterrupt:
        sys.exit(130)
