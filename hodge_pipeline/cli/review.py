"""`hodge review`: a page to look at edges and to decide about them."""

from __future__ import annotations

from pathlib import Path


def review(path: Path, *, port: int, browser: bool) -> None:
    """Serve the page until Ctrl-C."""
    from hodge_pipeline.review.opening import open_review

    with open_review(path, port=port, browser=browser) as opened:
        print(f"{opened.address}\nwhoever has this address can decide; Ctrl-C ends it", flush=True)
        opened.wait()
