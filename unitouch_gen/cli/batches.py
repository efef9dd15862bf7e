"""A picture for each touch, batch by batch, and what commands say of the warnings of a call."""

import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unitouch_gen.cli.files import save_picture
from unitouch_gen.cli.options import as_options, generators

if TYPE_CHECKING:
    from torch import Tensor

    from unitouch_gen.sampling import RunReport


def check_pictures(name: str, files: list[Path]) -> None:
    """Reads every picture before any work is done, or one that cannot be read would end the work of hours.

    Raises:
        InvalidInputError: Naming the first that cannot be read.
    """
    from unitouch_gen.models.images import load_images

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

    from unitouch_gen.sampling import RunReport

    reports, embeds = [], []
    for start in range(0, len(touch), batch_size):
        batch = slice(start, start + batch_size)
        pipe.set_progress_bar_config(disable=quiet, desc=f"{min(start + batch_size, len(touch))} of {len(touch)}")
        result = without_warning(call, touch[batch], generator=generators(seed, len(touch[batch])))
        for image, file in zip(result.images, files[batch], strict=True):
            save_picture(image, file)
        reports.append(result.report)
        embeds.append(result.embeds)
    return RunReport.joined(reports), torch.cat(embeds)


def without_warning(call: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """What a call returns. Exchanged inputs are a line on standard error; unfamiliar ones are for `note_unfamiliar`."""
    from unitouch_gen.errors import ExchangedInputsWarning, UnfamiliarTouchWarning

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore", UnfamiliarTouchWarning)
        warnings.simplefilter("always", ExchangedInputsWarning)
        output = call(*args, **kwargs)
    for item in caught:
        if issubclass(item.category, ExchangedInputsWarning):
            print(f"unitouch-gen: {item.message}", file=sys.stderr)
        else:
            warnings.warn_explicit(item.message, item.category, item.filename, item.lineno)
    return output


def note_endings(report: "RunReport", files: list[Path]) -> None:
    """One line on standard error for each picture that was made, but not as it should be: diverged, say.

    Args:
        report: Of the run.
        files: Of its pictures, in order.
    """
    from unitouch_gen.sampling import ReturnCode

    samples = report.chosen or range(len(files))
    for sample, file in zip(samples, files, strict=True):
        code = report.codes[sample]
        if code is not ReturnCode.SUCCESS:
            print(f"unitouch-gen: {file.name} is {code.value}: {as_options(code.message)}", file=sys.stderr)


def note_unfamiliar(pipe: Any, report: "RunReport", touch: list[Path]) -> None:
    """One line on standard error on those touches of a run that are unlike any the model knows."""
    from unitouch_gen.pipelines.common import unfamiliar_touches

    message = unfamiliar_touches(pipe.unitouch.sensor_bank, report.sensor_distances, [path.name for path in touch])
    if message:
        print(f"unitouch-gen: {message}", file=sys.stderr)
