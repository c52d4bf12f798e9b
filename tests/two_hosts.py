"""Two hosts in network namespaces, for scripts that run in one: a scheduler and a worker here, a worker there."""

import os
import signal
import subprocess
import sys
import time
from types import TracebackType

HERE, THERE, PORT = "10.99.0.1", "10.99.0.2", 8786
SECONDS = 300


def network(number: int) -> tuple[int, str]:
    """The number, and the network of the host that was asked; it takes a while, so that every host is."""
    time.sleep(0.1)
    return number, os.readlink("/proc/self/ns/net")


class Hosts:
    """The first host is this process's network; the second has a network of its own, at the other end of a cable."""

    address = f"tcp://{HERE}:{PORT}"

    def __enter__(self) -> "Hosts":
        self._second = subprocess.Popen(["unshare", "-n", "sleep", str(SECONDS * 10)])
        self._wait_for_network()
        there = self._there = ["nsenter", "-t", str(self._second.pid), "-n"]
        cable = ["ip", "link", "add", "cable", "type", "veth", "peer", "name", "cable", "netns", str(self._second.pid)]
        subprocess.run(cable, check=True)
        for host, address in (([], HERE), (there, THERE)):
            for words in (f"addr add {address}/24 dev cable", "link set cable up", "link set lo up"):
                subprocess.run([*host, "ip", *words.split()], check=True)
        dask = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", HERE, "--port", str(PORT)]
        worker = [sys.executable, "-m", "distributed.cli.dask_worker", self.address, "--nthreads", "1", "--no-nanny"]
        started = [dask, [*worker, "--host", HERE], [*there, *worker, "--host", THERE]]
        self._processes = [subprocess.Popen(command, stderr=subprocess.DEVNULL) for command in started]
        self._wait_for_workers()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in (*self._processes, self._second):
            process.kill()
            process.wait()

    def second_leaves(self) -> None:
        """The cable is pulled at its far end, so that nobody hears a farewell, and the worker behind it killed."""
        subprocess.run([*self._there, "ip", "link", "set", "cable", "down"], check=True)
        self._processes[-1].send_signal(signal.SIGKILL)

    def _wait_for_network(self) -> None:
        mine, theirs = "/proc/self/ns/net", f"/proc/{self._second.pid}/ns/net"
        while os.readlink(mine) == os.readlink(theirs):
            time.sleep(0.01)

    def _wait_for_workers(self) -> None:
        import distributed

        with distributed.Client(self.address, timeout=SECONDS) as client:
            client.wait_for_workers(2, timeout=SECONDS)
