"""A picture for each touch, batch by batch: what touch-to-image and stylize do alike."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unitouch_gen.cli.files import save_picture
from unitouch_gen.cli.options import generators

if TYPE_CHECKING:
    from torch import Tensor

    from unitouch_gen.diffusion import RunReport


def check_pictures(name: str, files: list[Path]) -> None:
    """Reads every picture before any work is done, or one that cannot be read would end the work of hours.

    Raises:
        InvalidInputError: Naming the first that cannot be read.
    """
    from unitouch_gen.encoders.pixels import load_images

    for index, path in enumerate(files):
        load_images(f"{name}[{index}]", path)


def make_pictures(
    pipe: Any,
    call: Callable[..., Any],
    touch: list[Path],
    files: list[Path],
    *,
    seed: int,
    batch_size: int,
    quiet: bool,
) -> "tuple[RunReport, Tensor]":
    """Saves each batch's pictures as soon as they are made.

    Args:
        pipe: For its progress bar.
        call: Runs it as `call(touches, generator=...)` and returns its output.
        touch, files: Inputs, and where their pictures go.

    Returns:
        The joined report, and the embeddings of all batches (N, D).
    """
    import torch

    from unitouch_gen.diffusion import RunReport

    reports, embeds = [], []
    for start in range(0, len(touch), batch_size):
        batch = slice(start, start + batch_size)
        pipe.set_progress_bar_config(disable=quiet, desc=f"{min(start + batch_size, len(touch))} of {len(touch)}")
        result = call(touch[batch], generator=generators(seed, len(touch[batch])))
        for image, file in zip(result.images, files[batch], strict=True):
            save_picture(image, file)
        reports.append(result.report)
        embeds.append(result.embeds)
    return RunReport.joined(reports), torch.cat(embeds)
