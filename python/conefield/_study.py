"""Studies: many scans, methods and seeds."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from typing import Any

from ._errors import Error, in_python


def study(
    study: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    resume: bool = False,
    force: bool = False,
    shard: str | None = None,
) -> dict[str, Any]:
    """Reconstructs many scans with several methods and seeds. As ``conefield study``, in a process of its own.

    Parameters
    ----------
    study
        A TOML file; ``docs/guide/many-scans.md`` describes it.
    output
        The folder for tables, pictures and runs; new or empty.
    resume, force
        Continue, or replace, an earlier study in the folder.
    shard
        ``"K/N"``: do one share of the runs.

    Returns the content of ``table.json``: scores with means and standard deviations. The log goes to standard error. Ctrl-C stops the
    current run after its step; ``resume=True`` continues. An error, also of a single run, raises :class:`Error`; the table is
    written nevertheless.
    """
    options = ["--resume"] * resume + ["--force"] * force + ([] if shard is None else [f"--shard={shard}"])
    words = [sys.executable, "-m", "conefield", "study", "--as-part", "--json", f"--output={os.fspath(output)}", *options]
    lines: list[str] = []
    interrupted = False
    with tempfile.TemporaryFile("w+") as printed:
        process = subprocess.Popen(
            [*words, "--", os.fspath(study)], stdin=subprocess.PIPE, stdout=printed, stderr=subprocess.PIPE, text=True
        )
        while True:
            # The study ends by itself after its step: a terminal sends Ctrl-C to it, too, and the end of its input stops it.
            try:
                for line in process.stderr:
                    lines.append(line)
                    sys.stderr.write(line)
                status = process.wait()
                break
            except KeyboardInterrupt:
                interrupted = True
                process.stdin.close()
        process.stdin.close()
        printed.seek(0)
        text = printed.read()
    if interrupted or status in (130, 143):
        raise KeyboardInterrupt
    if status != 0:
        errors = [line.removeprefix("error: ").strip() for line in lines if line.startswith("error: ")]
        raise Error(in_python(errors[-1]) if errors else f"the study ended with status {status}")
    return json.loads(text)
