"""`unitouch-gen app`: a web page, by default for this machine only."""

import os
import socket
import tempfile
import time
from contextlib import suppress
from typing import Annotated

import typer

from unitouch_gen.cli import options
from unitouch_gen.cli.loading import folder_of, kind_of, load_pipeline
from unitouch_gen.errors import InvalidInputError, explain_errors, import_optional


def app(
    host: Annotated[
        str, typer.Option(help="Address to serve at; 0.0.0.0 serves every machine that can reach it.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port to serve at.")] = 7860,
    model: Annotated[list[str] | None, typer.Option(help=f"{options.A_FOLDER} a pipeline; repeatable.")] = None,
    dtype: options.Dtype = None,
    device: options.Device = "auto",
) -> None:
    """Serves a page: touch to picture, photos restyled by a touch, anything to touch, and answers.

    Needs the extra `app`.

    Example: unitouch-gen app --port 7860
    """
    host = host.strip("[]")  # as around an IPv6 address in a URL
    check_address(host, port)
    os.environ["HF_HUB_DISABLE_TELEMETRY"] = "1"
    from unitouch_gen.pipelines.tiny import PIPELINES  # huggingface_hub reads the variable at import

    folders: dict[str, str | None] = dict.fromkeys(PIPELINES)
    if model:
        kinds = [kind_of(name, PIPELINES) for name in model]
        for kind in kinds:
            if kinds.count(kind) > 1:
                raise InvalidInputError(f"`--model` names {kinds.count(kind)} pipelines for {kind}; name one of each.")
        folders = {kind: str(folder_of(name)) for kind, name in zip(kinds, model, strict=True)}
    with tempfile.TemporaryDirectory(prefix="unitouch-") as uploads:
        isolate_gradio(uploads)
        import_optional("gradio", "app")
        from unitouch_gen.cli.page import serving

        pipes = {}
        for kind, folder in folders.items():
            pipes[kind] = load_pipeline(kind, model=folder, dtype=dtype, device=device)
        with suppress(KeyboardInterrupt), serving(pipes, host, port) as page:
            typer.echo(f"The page is at {page.local_url} (Ctrl-C ends it)")
            while page.is_running:
                time.sleep(0.1)


def check_address(host: str, port: int) -> None:
    """Raises if the port is taken or the host is none of this machine's addresses, before anything is loaded."""
    for name in (host, "127.0.0.1"):  # gradio opens the port at the latter, too
        family = socket.AF_INET6 if ":" in name else socket.AF_INET
        problem = f"`--port` {port} cannot be served at {name!r}"
        with explain_errors(problem, "name another", OSError, UnicodeError):
            socket.create_server((name, port), family=family).close()


def isolate_gradio(uploads: str) -> None:
    """Sets gradio's environment: a folder for uploads, no statistics, no proxy and no other settings.

    GRADIO_SHARE, GRADIO_ALLOWED_PATHS and the like would admit others or show them files. Requests for the page itself
    would go to a proxy.
    """
    settings = [name for name in os.environ if name.startswith("GRADIO_") and name != "GRADIO_ROOT_PATH"]
    for name in settings:
        del os.environ[name]
    os.environ.update(GRADIO_ANALYTICS_ENABLED="False", GRADIO_TEMP_DIR=uploads, no_proxy="*")
