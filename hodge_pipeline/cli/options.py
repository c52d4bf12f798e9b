"""Options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, NamedTuple

import typer


class Shown(NamedTuple):
    """How a command tells what it did: not at all, as JSON, or with every stage, table and note."""

    quiet: bool = False
    as_json: bool = False
    verbose: bool = False


Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Change an option, such as edges.max_edges_per_frame=6; may be repeated."
    ),
]
Reader = Annotated[str | None, typer.Option(help="The reader by name; none: the surest of the path.")]
ReaderSet = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="OPTION=VALUE", help="An option of the reader, such as tracks=false; may be repeated."
    ),
]
Out = Annotated[Path, typer.Option("--out", "-o", help="The run folder; the same command goes on where it stopped.")]
Overwrite = Annotated[bool, typer.Option(help="Replace the run of another recipe in --out.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]
Verbose = Annotated[bool, typer.Option("--verbose", help="Print every stage, table and note, not ten lines.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Force = Annotated[bool, typer.Option("--force", help="Write the result even where it is worse.")]
Truth = Annotated[
    str | None,
    typer.Option(
        "--truth", metavar="FILE", help="True poses to compare with: a file of poses; `frames`: the source's own."
    ),
]
Strict = Annotated[
    bool, typer.Option("--strict", help="Notice input that changes during the run by hashes of all its files.")
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
Trust = Annotated[
    str | None,
    typer.Option(
        "--trust",
        metavar="auto|sequential|none|SOURCE",
        help="Edges trusted as a backbone: as the graph shows (auto); consecutive ones; none; those of a source "
        "(proposed_by).",
    ),
]
