"""`unitouch-gen app`: a page in the browser, for this machine alone by default."""

import os
import socket
import tempfile
from typing import Annotated, Any

import typer

from unitouch_gen.cli import options
from unitouch_gen.cli.loading import kind_of, load_pipeline
from unitouch_gen.errors import InvalidInputError, needed


def app(
    host: Annotated[str, typer.Option(help="To serve at; 0.0.0.0 lets in everyone who reaches it.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port to serve at.")] = 7860,
    model: Annotated[list[str] | None, typer.Option(help=f"{options.A_FOLDER} a pipeline; repeatable.")] = None,
    dtype: options.Dtype = None,
    device: options.Device = "auto",
) -> None:
    """Serves a page: touch to picture, photos restyled by a touch, anything to touch, and answers.

    Needs the extra `app`.

    Example: unitouch-gen app --port 7860
    """
    try:
        socket.create_server((host, port)).close()
    except (OSError, UnicodeError) as error:
        raise InvalidInputError(f"`--port` {port} cannot be served at {host!r}: {error}; name another.") from error
    with tempfile.TemporaryDirectory(prefix="unitouch-") as folder:
        os.environ.update(GRADIO_ANALYTICS_ENABLED="False", HF_HUB_DISABLE_TELEMETRY="1", GRADIO_TEMP_DIR=folder)
        from unitouch_gen.pipelines.tiny import PIPELINES  # after that, as its libraries read it

        models = {kind_of(one, PIPELINES): one for one in model} if model else dict.fromkeys(PIPELINES)
        needed("gradio", "app")
        from unitouch_gen.cli.page import launch

        shared: Any = {"dtype": dtype, "device": device}
        page = launch({kind: load_pipeline(kind, model=one, **shared) for kind, one in models.items()}, host, port)
        typer.echo(f"The page is at http://{host}:{port} (Ctrl-C ends it)")
        page.block_thread()
