"""Where jobs run. A new place (Slurm, say) is one more file with these four verbs."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Protocol

from studio.jobs.job import Job, Standing

Found = Literal["waiting", "running", "ended", "lost"]
"""What became of a job's processes. lost: nobody answers who could tell."""


class JobRunner(Protocol):
    """Starts `studio.jobs.keeper` on a job's folder, somewhere that sees the data folder."""

    def submit(self, job: Job, folder: Path) -> str:
        """Start it, or have it started in its turn; the name under which the place knows it.

        Raises RuntimeError with a sentence.
        """

    def status(self, job: Job, folder: Path, standing: Standing) -> Found:
        """Of one that was submitted; "ended" is final."""

    def cancel(self, job: Job, folder: Path, standing: Standing) -> None:
        """Have it end: politely, then by force. Returns at once."""

    def log(self, job: Job, folder: Path, standing: Standing) -> str:
        """What it said so far."""
