"""Dask on two hosts: network namespaces of their own, joined by one cable, that share nothing but the files."""

import os
import shutil
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from synthetic import LIGHT, short_sequence  # noqa: F401

PATIENCE_S = 300
SILENCE = "12s"
"""After which a host that says nothing has left; half a minute where nothing is set."""
HOSTS = Path(__file__).with_name("two_hosts.py")


def refusal() -> str:
    """Why this machine can model no hosts; an empty word where it can."""
    missing = [tool for tool in ("unshare", "nsenter", "ip") if shutil.which(tool) is None]
    if missing:
        return f"needs {', '.join(missing)}"
    tried = subprocess.run(["unshare", "-Urn", "unshare", "-n", "true"], capture_output=True, text=True, check=False)
    return "" if tried.returncode == 0 else f"needs the right to make network namespaces: {tried.stderr.strip()}"


pytestmark = pytest.mark.skipif(bool(refusal()), reason=refusal())


def on_two_hosts(script: str, folder: Path) -> str:
    """What a script prints on the first host, where `hosts` are a `two_hosts.Hosts` with their workers."""
    file = folder / "script.py"
    file.write_text("from two_hosts import Hosts\n" + textwrap.dedent(script))
    paths = os.pathsep.join([str(HOSTS.parent), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": paths, "DASK_TEMPORARY_DIRECTORY": str(folder)}
    environment["DASK_DISTRIBUTED__COMM__TIMEOUTS__TCP"] = SILENCE
    child = subprocess.Popen(
        ["unshare", "-Urn", "--kill-child", sys.executable, str(file)], cwd=folder, env=environment,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    try:
        out, errors = child.communicate(timeout=PATIENCE_S)
    finally:
        if child.poll() is None:
            os.killpg(child.pid, signal.SIGKILL)
    assert child.returncode == 0, errors[-3000:]
    return out


def test_a_run_on_two_hosts_gives_the_same_bits_and_a_host_that_leaves_costs_a_retry(
    short_sequence: Path,  # noqa: F811
    tmp_path: Path,
) -> None:
    told = on_two_hosts(
        f"""
        import hodge_pipeline
        from hodge_pipeline.executors.dask import cluster_workers, describe
        from hodge_pipeline.recipe.schema import load_recipe
        from two_hosts import network

        sets = ["start.whole_up_to=5", "recording.level=off", "fusion=[]"]
        recipe = load_recipe("demo", [*sets, *{LIGHT!r}])
        hodge_pipeline.run(recipe, "local", source={str(short_sequence)!r})
        with Hosts() as hosts:
            hodge_pipeline.run(recipe, "cluster", source={str(short_sequence)!r}, dask=hosts.address)
            print(describe(hosts.address))
            with cluster_workers(hosts.address) as workers:
                both = {{seen for _, (_, seen) in workers.map(network, list(range(40)))}}
                assert len(both) == 2, both
                left = []
                for row, (number, seen) in workers.map(network, list(range(60))):
                    assert row == number
                    left.append(row)
                    if len(left) == 5:
                        hosts.second_leaves()
                assert sorted(left) == list(range(60))
                after = {{seen for _, (_, seen) in workers.map(network, list(range(10)))}}
                assert len(after) == 1 and after < both
        """,
        tmp_path,
    )
    for name in ("poses.tum", "edges.csv", "graph.g2o"):
        assert (tmp_path / "cluster" / name).read_bytes() == (tmp_path / "local" / name).read_bytes()
    assert "2 workers with 2 threads on 2 hosts" in told and "GB; dashboard: http" in told
