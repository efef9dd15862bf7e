"""What calls of the built-in pipelines cost: seconds, and the time outside of their networks."""

import shutil
import time
from contextlib import ExitStack
from functools import partial, wraps
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any
from unittest.mock import patch

import torch

from tests.benchmarks.measuring import Figures, in_turns, quiet, ratio_of, seconds_of, spread_of
from unitouch_gen.examples import examples
from unitouch_gen.models.joint import MODALITIES, UniTouchModel
from unitouch_gen.pipelines.batch import run_batch
from unitouch_gen.pipelines.manifest import read_manifest
from unitouch_gen.world import FIRST_OBJECT, World

# Time -----------------------------------------------------------------------------------------------------------------

STEPS = 20


def _touch() -> torch.Tensor:
    """A held-out touch."""
    return World().render([5], [FIRST_OBJECT["test"]], [0], modalities=("touch",)).touch["gelsight"]


def speed_figures() -> Figures:
    """Seconds for one picture with default settings, after loading, and what batches save."""
    pipe, touch = quiet("touch-to-image"), _touch()
    calls = {"picture": lambda: seconds_of(pipe, touch, generator=torch.Generator().manual_seed(0))}
    return {"seconds_per_picture": min(in_turns(calls, 3)["picture"]), "batch": batch_figures(pipe)}


BATCH = 8


def batch_figures(pipe: Any, steps: int = STEPS, repeats: int = 5) -> Figures:
    """How many times as long eight pictures take one at a time as in a batch, files read and written in both."""
    with TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "touches").mkdir()
        for file in list(examples("touch").values())[:BATCH]:
            shutil.copy(file, folder / "touches")
        manifest = read_manifest(folder / "touches", defaults={"steps": steps})

        def one_at_a_time() -> None:
            for item in manifest.items:
                noise = torch.Generator().manual_seed(item.seed)
                output = pipe(manifest.folder / item.cells["touch"], num_inference_steps=steps, generator=noise)
                output.images[0].save(folder / f"{item.name}.png")

        def batch() -> None:
            run_batch({"touch-to-image": pipe}, manifest, mkdtemp(dir=folder), batch_size=BATCH)

        seen = in_turns({"apart": partial(seconds_of, one_at_a_time), "batch": partial(seconds_of, batch)}, repeats)
    return {"items": BATCH, "steps": steps, "repeats": repeats, **ratio_of(seen["apart"], seen["batch"])}


def overhead_figures(repeats: int = 9) -> Figures:
    """Share of a run of 20 steps, one picture or touch, that is spent outside of the networks, of each pipeline."""
    calls = {
        "touch_to_image": partial(share_outside, quiet("touch-to-image"), touch=_touch(), num_inference_steps=STEPS),
        "x_to_touch": partial(share_outside, quiet("x-to-touch"), text="rough brick", num_inference_steps=STEPS),
    }
    shares = {name: spread_of(seen) for name, seen in in_turns(calls, repeats).items()}
    return {"steps": STEPS, "repeats": repeats, **shares}


def share_outside(pipe: Any, **request: Any) -> float:
    """Share of one call's time in which no network of the pipeline runs: checks, solver, pictures from tensors.

    Methods are exchanged in the networks' classes, as a hook on a network would keep pipelines from leaving work out.
    """
    methods = [(UniTouchModel, f"get_{modality}_features") for modality in MODALITIES]
    for name, method in (("unet", "forward"), ("vae", "decode"), ("text_encoder", "forward")):
        if getattr(pipe, name, None) is not None:
            methods.append((type(getattr(pipe, name)), method))
    inside = Inside()
    with ExitStack() as stack:
        for kind, method in methods:
            stack.enter_context(patch.object(kind, method, inside.timed(getattr(kind, method))))
        total = seconds_of(pipe, **request, generator=torch.Generator().manual_seed(0))
    return 1.0 - inside.seconds / total


class Inside:
    """Seconds in the functions that it has timed; one that another one calls counts once."""

    def __init__(self) -> None:
        self.seconds, self.depth = 0.0, 0

    def timed(self, function: Any) -> Any:
        @wraps(function)
        def run(*args: Any, **kwargs: Any) -> Any:
            self.depth += 1
            started = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self.depth -= 1
                if self.depth == 0:
                    self.seconds += time.perf_counter() - started

        return run
