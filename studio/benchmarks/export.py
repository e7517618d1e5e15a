"""What it costs to export a take with three cameras, made of noise."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from studio.benchmarks.episodes import made_up_header, write_take
from studio.catalog import Catalog
from studio.export import FORMATS, Format, choose, export


def measure(seconds: float = 60.0) -> dict[str, float]:
    """CPU seconds of all threads, and size, of each format of a two-arm take."""
    results = {"seconds": seconds}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        header = made_up_header()
        write_take(folder / "episodes" / header.task / f"{header.episode_id}.mcap", header, seconds)
        with Catalog(folder) as catalog:
            catalog.refresh()
            for form in FORMATS:
                cpu, size = _export(catalog, header.episode_id, form, folder / form)
                key = form.replace("-", "_")
                results |= {f"{key}_cpu_s": cpu, f"{key}_MB": size / 1e6}
    return results


def _export(catalog: Catalog, episode_id: str, form: Format, out: Path) -> tuple[float, int]:
    """CPU seconds, bytes."""
    begin = time.process_time()
    done = export(choose(catalog, [episode_id]), form, out)
    return time.process_time() - begin, done.size
