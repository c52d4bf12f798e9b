"""The option `--dask` of every command that runs stages."""

from __future__ import annotations

from typing import Annotated

import typer

Dask = Annotated[
    str | None,
    typer.Option(
        "--dask",
        metavar="ADDRESS",
        envvar="HODGE_DASK_ADDRESS",
        help="Register on the Dask cluster at tcp://HOST:8786, which is trusted to run code here.",
    ),
]
