"""Options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change an option, such as edges.max_edges_per_frame=6."),
]
Reader = Annotated[str | None, typer.Option(help="The reader by name; none: the surest of the path.")]
ReaderSet = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="OPTION=VALUE", help="An option of the reader, such as tracks=false."),
]
Out = Annotated[Path, typer.Option("--out", help="The run folder; the same command goes on where it stopped.")]
Overwrite = Annotated[bool, typer.Option(help="Replace the run of another recipe in --out.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Force = Annotated[bool, typer.Option("--force", help="Write the result even where it is worse.")]
Truth = Annotated[
    str | None,
    typer.Option(
        "--truth", metavar="FILE", help="True poses to compare with: a file of poses; `frames`: the source's own."
    ),
]
Dask = Annotated[
    str | None,
    typer.Option(
        "--dask",
        metavar="ADDRESS",
        envvar="HODGE_DASK_ADDRESS",
        help="Register on the Dask cluster at tcp://HOST:8786, which is trusted to run code here.",
    ),
]
