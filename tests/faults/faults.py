"""What goes wrong outside the code, tried: `make faults`; `python tests/faults/faults.py --case KIND/NAME` repeats one.

Each kind's cases run in a child process with a limit on time and on memory; a case that waits, crashes or grows past
it is named like one that fails, and the next child goes on behind it.
"""

from __future__ import annotations

import argparse
import faulthandler
import json
import os
import resource
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parents[1] / "adapters"), str(HERE.parents[1])]
KINDS = ("crash", "damage", "kills", "strangers", "repeated", "units", "reading")
MAX_CPU_S, MAX_RSS_MB, HANGS_S = 60, 2048, 300
"""Of one case; a batch of damaged inputs is limited for each input by `reading`."""
BATCH_HANGS_S = 1200
PAGE = HERE.parents[1] / "docs" / "security.md"
BEGIN, END = "<!-- faults: begin -->", "<!-- faults: end -->"


@dataclass
class Tally:
    """What became of the cases of one kind."""

    cases: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)
    slowest_s: float = 0.0
    peak_mb: float = 0.0


def run_child(names: Sequence[str], scratch: Path) -> None:
    """Run cases one after the other and print a line of JSON for each; a limit ends the process."""
    for name in names:
        kind, case = name.split("/", 1)
        print(json.dumps({"begins": name}), flush=True)
        faulthandler.dump_traceback_later(BATCH_HANGS_S if kind == "reading" else HANGS_S, exit=True)
        start, outcomes, failure = _cpu_s(), {}, ""
        try:
            outcomes = dict(import_module(kind).check(case, scratch))
        except BaseException as error:
            failure = " ".join(f"{type(error).__name__}: {error}".split())[:400] or type(error).__name__
        faulthandler.cancel_dump_traceback_later()
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        if peak > MAX_RSS_MB:
            failure = failure or f"{peak:.0f} MB"
        seconds = _cpu_s() - start
        if seconds > MAX_CPU_S and kind != "reading":
            failure = failure or f"{seconds:.0f} s"
        done = {"ends": name, "outcomes": outcomes, "failure": failure, "peak_mb": peak}
        print(json.dumps({**done, "cpu_s": seconds}), flush=True)


def _cpu_s() -> float:
    """CPU seconds of this process and of its children that have ended: other work on the machine does not count."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def run_all(names: Sequence[str], scratch: Path, tally: dict[str, Tally]) -> None:
    """Run cases in children; the one that a child died in fails, and another child goes on behind it."""
    left = list(names)
    while left:
        command = [sys.executable, "-W", "ignore", __file__, "--scratch", str(scratch), "--child"]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
            assert child.stdin and child.stdout
            child.stdin.write(json.dumps(left))
            child.stdin.close()
            begun = ""
            for line in child.stdout:
                if not line.startswith('{"'):
                    continue
                told = json.loads(line)
                if "begins" in told:
                    begun = told["begins"]
                    continue
                _count(tally, told)
                left.remove(begun)
                begun = ""
        if begun:
            _count(tally, {"ends": begun, "failure": f"the process ended ({child.returncode})", "outcomes": {}})
            left.remove(begun)
        elif child.returncode and left:
            raise SystemExit(f"no case could begin: {child.returncode}")


def _count(tally: dict[str, Tally], told: dict[str, object]) -> None:
    kind = str(told["ends"]).split("/", 1)[0]
    one = tally.setdefault(kind, Tally())
    outcomes = Counter({str(name): int(count) for name, count in dict(told["outcomes"]).items()})  # type: ignore[call-overload]
    one.outcomes += outcomes
    one.cases += max(1, sum(outcomes.values()))
    if kind != "reading":
        one.slowest_s = max(one.slowest_s, float(told.get("cpu_s", 0)))  # type: ignore[arg-type]
    one.peak_mb = max(one.peak_mb, float(told.get("peak_mb", 0)))  # type: ignore[arg-type]
    if told["failure"]:
        one.failures.append(f"{told['ends']}: {told['failure']}")
        print(
            f"FAILED {told['ends']}: {told['failure']}\n  again: python tests/faults/faults.py --case '{told['ends']}'"
        )


def table(tally: dict[str, Tally], command: str, seed: int) -> str:
    """The figures as Markdown."""
    rows = [
        f"Made by `{command}`, seed {seed}: each case is repeated by `python tests/faults/faults.py --case KIND/NAME`.",
        "",
        "| kind | cases | failed | how they ended | slowest | peak |",
        "|---|---|---|---|---|---|",
    ]
    for kind, one in tally.items():
        ended = "; ".join(f"{count} {name}" for name, count in one.outcomes.most_common())
        slowest = f"{one.slowest_s:.0f} s" if one.slowest_s else "< 5 s"
        rows.append(f"| {kind} | {one.cases} | {len(one.failures)} | {ended} | {slowest} | {one.peak_mb:.0f} MB |")
    return "\n".join(rows)


def write_page(shown: str) -> None:
    """Put the figures into the page; kinds that were not tried this time keep their rows."""
    text = PAGE.read_text("utf-8")
    before = text[text.index(BEGIN) : text.index(END)]
    rows = {row.split(" | ")[0][2:]: row for row in (before + shown).splitlines() if row.startswith("| ")}
    head = shown.split("\n| kind")[0]
    lines = [head, rows.pop("kind"), "|---|---|---|---|---|---|", *(rows[kind] for kind in KINDS if kind in rows)]
    PAGE.write_text(text.replace(before, "\n".join([BEGIN, *lines, ""])), "utf-8")


def cases_of(kind: str, scratch: Path, *, full: bool, seed: int) -> list[str]:
    """The names of the cases of a kind."""
    return [f"{kind}/{name}" for name in import_module(kind).cases(full, scratch, seed)]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kinds", nargs="*", help=f"of {', '.join(KINDS)}; none: all")
    parser.add_argument("--full", action="store_true", help="every case instead of a seeded part")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--case", help="one case, by the name that a failure has")
    parser.add_argument("--write", action="store_true", help="put the figures into docs/security.md")
    parser.add_argument("--scratch", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        run_child(json.load(sys.stdin), options.scratch)
        return 0
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    tally: dict[str, Tally] = {}
    with tempfile.TemporaryDirectory(prefix="hodge-faults-") as folder:
        scratch = options.scratch or Path(folder)
        if options.case:
            run_all([options.case], scratch, tally)
        else:
            for kind in options.kinds or KINDS:
                run_all(cases_of(kind, scratch, full=options.full, seed=options.seed), scratch, tally)
                print(table({kind: tally[kind]}, "", options.seed).splitlines()[-1], flush=True)
    command = "make faults-full" if options.full else "make faults"
    print(shown := table(tally, command, options.seed))
    if options.write:
        write_page(shown)
    return 1 if any(one.failures for one in tally.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
