"""Pages of our own beside viser's: files of web_assets that talk to the HTTP API and to nobody else."""

from __future__ import annotations

from collections.abc import Callable

from fastapi import FastAPI
from starlette.responses import FileResponse

from studio.server import WEB_ASSETS

# Scripts, images and requests of ours only; uPlot and our own drawing set styles.
POLICY = (
    "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "media-src 'self' blob:; object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)
HEADERS = {"Cache-Control": "no-cache", "Content-Security-Policy": POLICY}


def add_pages(app: FastAPI, prepare: Callable[[], None] = lambda: None) -> None:
    """Mount `/dataset`: the takes of the data folder. `prepare` is called when somebody opens it."""

    @app.get("/dataset", include_in_schema=False)
    def read_dataset_page() -> FileResponse:
        prepare()
        return FileResponse(WEB_ASSETS / "dataset.html", headers=HEADERS)

    @app.get("/train", include_in_schema=False)
    async def read_train_page() -> FileResponse:
        """What is learned from them, and what came of it."""
        return FileResponse(WEB_ASSETS / "train.html", headers=HEADERS)
