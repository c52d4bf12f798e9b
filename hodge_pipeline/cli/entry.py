"""What the command `hodge` starts with: nothing is imported before Ctrl-C is provided for."""

from __future__ import annotations

import gc
import sys

COLLECT_AFTER = 10_000
"""Objects made and kept, 700 by default: imports alone make and keep hundreds of thousands, and looking through them
for cycles takes a twelfth of the time of a run of 60 frames.
"""


def main() -> None:
    """Run the command; stopped before it has begun, it ends with 130 and without a word, as later."""
    gc.set_threshold(COLLECT_AFTER)
    try:
        from hodge_pipeline.cli.main import main as command
        from hodge_pipeline.executors.memory import keep_freed_memory

        keep_freed_memory()
        command()
    except KeyboardInterrupt:
        sys.exit(130)
