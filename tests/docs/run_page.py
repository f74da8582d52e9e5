"""Runs the code blocks of a page in order, in the current folder: python -m tests.docs.run_page PAGE [LANGUAGE ...].

All Python blocks share one namespace, as a reader's session does; shell blocks run in bash and end at the first error.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tests.docs.pages import blocks

LANGUAGES = ("python", "sh")


def run_page(page: Path, languages: tuple[str, ...] = LANGUAGES) -> int:
    """How many blocks ran; an error in one of them ends the run."""
    namespace: dict[str, object] = {"__name__": "__main__"}
    count = 0
    for block in blocks(page):
        if not block.run or block.language not in languages:
            continue
        print(f"--- {page.name}:{block.line}", flush=True)
        if block.language == "python":
            exec(compile("\n" * (block.line - 1) + block.text, str(page), "exec"), namespace)
        else:
            subprocess.run(["bash", "-euo", "pipefail", "-c", block.text], check=True)
        sys.stdout.flush()
        count += 1
    return count


if __name__ == "__main__":
    if run_page(Path(sys.argv[1]), tuple(sys.argv[2:]) or LANGUAGES) == 0:
        sys.exit(f"{sys.argv[1]}: no block to run")
