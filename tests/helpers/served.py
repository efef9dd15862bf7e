"""The page of `unitouch-gen app`, served in this process on pipelines of random weights."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from unitouch_gen.cli.app import HERE, free_port, gradio_in, page_of, serve
from unitouch_gen.pipelines import TactileStylizationPipeline, TouchToImagePipeline

FEW = {"default_num_inference_steps": 2, "default_guidance_scale": 2.0}


def tiny_pipelines(parts: dict[str, Any], x_to_touch: Any) -> dict[str, Any]:
    """A pipeline for each tab."""
    unclip = {"touch-to-image": TouchToImagePipeline, "stylization": TactileStylizationPipeline}
    pipes = {name: kind(**parts, **FEW) for name, kind in unclip.items()} | {"x-to-touch": x_to_touch}
    for pipe in pipes.values():
        pipe.set_progress_bar_config(disable=True)
    return pipes


@contextmanager
def page(pipes: Mapping[str, Any], folder: Path, queue: int = 16) -> Iterator[str]:
    """The address of a page, which keeps its files in a folder."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("GRADIO_ANALYTICS_ENABLED", "GRADIO_TEMP_DIR", "HF_HUB_DISABLE_TELEMETRY"):
            patch.setenv(name, "")  # as it was, afterwards
        gradio_in(str(folder))
        made = page_of(pipes)
        try:
            yield serve(made, HERE, free_port(HERE, None), queue)
        finally:
            made.close(verbose=False)


def asking(client: Any) -> Callable[..., tuple[list[str], str, str, str, str]]:
    """Asks a tab, and gives files of pictures, what they feel like, notes, the report and the seed."""

    def ask(tab: str, **sent: Any) -> tuple[list[str], str, str, str, str]:
        gallery, feels, notes, report, seed = client.predict(**sent, api_name=f"/{tab}")
        notes = notes.get("value", "") if isinstance(notes, dict) else notes
        return [one["image"] for one in gallery], feels, notes, report, seed

    return ask
