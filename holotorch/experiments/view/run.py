"""Serving the page until the user ends it."""

import asyncio
from contextlib import suppress

from holotorch.experiments.config.errors import ConfigError
from holotorch.experiments.view.server import ViewServer
from holotorch.experiments.view.viewer import Viewer


def run_view(viewer: Viewer, port: int = 0) -> None:
    """Serve the page of a run until Ctrl-C. ConfigError if the port cannot be used."""

    async def serve() -> None:
        async with ViewServer(viewer, port) as server:
            print(f"Page       {server.address}\nCtrl-C ends it", flush=True)
            await asyncio.Event().wait()

    try:
        with suppress(KeyboardInterrupt):
            asyncio.run(serve())
    except OSError as error:
        raise ConfigError([f"{error.strerror or error}; choose another with --port, or leave it out"]) from None
