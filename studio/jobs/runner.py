"""Where jobs run. A new place (Slurm, say) is one more file with these four verbs."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Protocol

from studio.jobs.job import Job, Standing

Found = Literal["waiting", "running", "ended", "dropped", "lost"]
"""What became of a job's processes. dropped: the place gave it up before it began, so it may be asked again.
lost: nobody answers who could tell."""


class JobRunner(Protocol):
    """Starts `studio.jobs.keeper` on a job's folder, somewhere that sees the data folder.

    Each raises RuntimeError with a sentence where the place does not do it.
    """

    def submit(self, job: Job, folder: Path, standing: Standing) -> None:
        """Start it, or have it started in its turn, under the name `standing.handle`."""

    def status(self, job: Job, folder: Path, standing: Standing) -> Found:
        """Of one that was submitted; "ended" is final. Raises nothing."""

    def cancel(self, job: Job, folder: Path, standing: Standing) -> None:
        """Have it end: politely, then by force. Returns at once."""

    def log(self, job: Job, folder: Path, standing: Standing) -> str:
        """What it said so far."""
