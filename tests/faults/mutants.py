"""Whether the faults find faults: each mutant undoes one precaution in a copy, and its case must fail there."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
MUTANTS = {
    "no hash": (
        "hodge_pipeline/store/store.py",
        "        if file_facts(path / name) != known:",
        "        if False:",
        "damage/zeroed/stages/solve_edges-1/value.npz",
    ),
    "an unquoted path": (
        "hodge_pipeline/types/text.py",
        "    return shlex.join(map(str, words))",
        '    return " ".join(map(str, words))',
        "strangers/command/0",
    ),
    "a formula": (
        "hodge_pipeline/types/text.py",
        """    return f"'{text}" if _FORMULA.match(text) else text""",
        "    return text",
        "strangers/name/2",
    ),
    "a second line in the log": (
        "hodge_pipeline/store/log.py",
        "        return visible(super().format(record))",
        "        return super().format(record)",
        "strangers/name/4",
    ),
    "drafts that stay": (
        "hodge_pipeline/store/workspace.py",
        "            _remove_drafts(folder)",
        "            pass",
        "crash/run/0026",
    ),
    "links followed": (
        "hodge_pipeline/store/workspace.py",
        "    for parent, folders, files in os.walk(folder):\n        for name in (*folders, *files):\n            mode",
        "    for parent, folders, files in ():\n        for name in (*folders, *files):\n            mode",
        "strangers/run/link at log.txt",
    ),
    "notes of computed steps alone": (
        "hodge_pipeline/store/store.py",
        "        self.note(*(Note(**note) for note in _unsealed",
        "            self.note(*(Note(**note) for note in _unsealed",
        "crash/run/0100",
    ),
    "lost lines without a note": (
        "adapters/hodge_adapters/trajectories/euroc.py",
        "                bad.append(row.line)",
        "                pass",
        "reading/euroc/0/0/400",
    ),
}
"""What is undone: file, text, what stands there instead, and the case that must see it."""


def main() -> int:
    survived = []
    with tempfile.TemporaryDirectory(prefix="hodge-mutants-") as scratch:
        copy = Path(scratch) / "copy"
        shutil.copytree(REPOSITORY, copy, ignore=shutil.ignore_patterns(".git", ".venv", "runs", "docs", "__pycache__"))
        for name, (file, text, other, case) in MUTANTS.items():
            path = copy / file
            contents = path.read_text("utf-8")
            assert contents.count(text) == 1, f"{name}: {file} no longer holds {text!r}"
            before = _fails(copy, case)
            path.write_text(contents.replace(text, other))
            found = _fails(copy, case)
            path.write_text(contents)
            print(f"{name:<28} {'found' if found and not before else 'NOT FOUND'} by {case}", flush=True)
            survived += [name] if before or not found else []
    return 1 if survived else 0


def _fails(copy: Path, case: str) -> bool:
    command = [sys.executable, "-W", "ignore", str(copy / "tests/faults/faults.py"), "--case", case]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(copy), str(copy / "adapters")])}
    return subprocess.run(command, env=environment, capture_output=True).returncode != 0


if __name__ == "__main__":
    sys.exit(main())
