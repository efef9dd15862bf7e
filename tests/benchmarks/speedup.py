"""How much sooner a pipeline gets as close to the exact latents as the usual way of running its network does.

The usual way is diffusers' DDIM, in the steps and at the guidance that the paper and diffusers take: for pictures from
touch in diffusers' own `StableUnCLIPImg2ImgPipeline`, and for touches, of which diffusers has no pipeline, in ours with
the network as it is. Errors are of latents from the same noise under the same conditions, relative to a close path; the
seconds are of one sample, of calls that take turns.
"""

import copy
import shutil
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, TypeVar

import numpy as np
import torch
from diffusers import StableUnCLIPImg2ImgPipeline
from torch import Tensor, nn

from tests.benchmarks import Figures
from tests.benchmarks.turns import in_turns, ratio_of
from unitouch_gen.conditioning import QUALITY_PROMPT
from unitouch_gen.errors import NotConvergedError
from unitouch_gen.numerics.checkpoint import close_reference, fitted_runs, fresh
from unitouch_gen.numerics.pipeline_subject import PipelineSubject, world_inputs
from unitouch_gen.numerics.reference import Reference
from unitouch_gen.numerics.subjects import Configuration, baseline, errors_of
from unitouch_gen.numerics.work_precision import configurations
from unitouch_gen.pipelines import TouchToImagePipeline, XToTouchPipeline
from unitouch_gen.schedulers.solvers import SOLVERS

DDIM = "diffusers:ddim"
CLOSE = 300
"""Evaluations of a path that errors are measured from; its own, against one of 1,000, is 7e-5 in the median and 4e-4 at
most on touches from photos."""

SEED = 1_000
"""Of the noises to start from, which nothing was fitted to."""

STEPS = (6, 8, 10, 12, 14, 16, 18, 20, 23, 26, 32, 40, 50)
"""That are tried beside those that were fitted."""

Made = TypeVar("Made")

Seconds = dict[str, float]
"""Of one call: "denoising" and "whole"."""


@dataclass(frozen=True)
class Usual:
    """The usual way of running a network.

    Attributes:
        name: In words.
        steps, guidance_scale: Of it.
        run: Makes some rows of a subject, by their numbers: latents or pictures, by output type, and the seconds.
    """

    name: str
    steps: int
    guidance_scale: float
    run: Callable[[Sequence[int], str], tuple[Tensor, Seconds]]


# Subjects -------------------------------------------------------------------------------------------------------------


def picture_subject(pipe: TouchToImagePipeline, conditions: int = 16) -> PipelineSubject:
    """Pictures from touches of objects that nothing was trained on, by their embeddings."""
    touches = world_inputs(("touch",), conditions)["touch"]
    return fresh(pipe, {"touch_embeds": pipe.encode_touch(touches)}, "", SEED)


def touch_subject(pipe: XToTouchPipeline, conditions: int = 16) -> PipelineSubject:
    """Touches from photos of objects that nothing was trained on."""
    return fresh(pipe, world_inputs(("image",), conditions), "", SEED)


# The usual way --------------------------------------------------------------------------------------------------------


class TimedUnclip(StableUnCLIPImg2ImgPipeline):
    """diffusers' pipeline; `denoising` holds the seconds of its last loop."""

    denoising = 0.0

    def progress_bar(self, iterable: Any = None, total: int | None = None) -> Iterator[Any]:
        started = time.perf_counter()
        yield from iterable
        self.denoising = time.perf_counter() - started


def diffusers_unclip(pipe: TouchToImagePipeline) -> TimedUnclip:
    """diffusers' own pipeline of the same parts, with its own DDIM."""
    unitouch = pipe.unitouch
    unitouch.load("image")
    parts = ("image_normalizer", "image_noising_scheduler", "tokenizer", "text_encoder", "unet")
    theirs = TimedUnclip(
        feature_extractor=None,
        image_encoder=unitouch.vision_model,  # neither runs, as embeddings are given
        scheduler=baseline(pipe.scheduler, DDIM),
        vae=None,  # whose size it would read under a name that autoencoders of other kinds do not have
        **{name: getattr(pipe, name) for name in parts},
    )
    theirs.register_modules(vae=pipe.vae)
    theirs.vae_scale_factor = pipe.vae_scale_factor
    return theirs


def usual_pictures(subject: PipelineSubject, steps: int = 50, guidance_scale: float = 9.0) -> Usual:
    """diffusers' pipeline of the same parts on the same embeddings, prompts and noise."""
    pipe = subject.pipe
    theirs = diffusers_unclip(pipe)

    def run(rows: Sequence[int], output_type: str) -> tuple[Tensor, Seconds]:
        started = time.perf_counter()
        images = theirs(
            prompt=[QUALITY_PROMPT] * len(rows),
            image_embeds=subject.inputs["touch_embeds"][list(rows)],
            latents=subject.noise[list(rows)],
            generator=_generators(rows),
            noise_level=pipe.config["default_noise_level"],
            num_inference_steps=steps,
            guidance_scale=guidance_scale,
            output_type=output_type,
        ).images
        return images, {"denoising": theirs.denoising, "whole": time.perf_counter() - started}

    return Usual("diffusers' StableUnCLIPImg2ImgPipeline", steps, guidance_scale, run)


class Plain(nn.Module):
    """A network of which pipelines know nothing, so that they leave nothing out of it."""

    def __init__(self, network: Any) -> None:
        super().__init__()
        self.network, self.config = network, network.config

    @property
    def dtype(self) -> torch.dtype:
        return self.network.dtype

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        return self.network(*args, **kwargs)


def usual_touches(subject: PipelineSubject, steps: int = 200, guidance_scale: float = 7.5) -> Usual:
    """Our pipeline with diffusers' scheduler, and nothing left out of the network."""
    pipe = subject.pipe
    own, others = (pipe.unet, pipe.scheduler), (Plain(pipe.unet), baseline(pipe.scheduler, DDIM))

    def run(rows: Sequence[int], output_type: str) -> tuple[Tensor, Seconds]:
        pipe.unet, pipe.scheduler = others
        try:
            return called(subject, rows, output_type, num_inference_steps=steps, guidance_scale=guidance_scale)
        finally:
            pipe.unet, pipe.scheduler = own

    return Usual("a plain network in a loop", steps, guidance_scale, run)


def called(subject: PipelineSubject, rows: Sequence[int], output_type: str, **settings: Any) -> tuple[Tensor, Seconds]:
    """Rows of a subject that has one noise for each condition, by one call of its pipeline."""
    inputs = {name: value[list(rows)] for name, value in subject.inputs.items()}
    started = time.perf_counter()
    output = subject.pipe(
        **inputs,
        latents=subject.noise[list(rows)],
        generator=_generators(rows),
        output_type=output_type,
        **settings,
    )
    whole = time.perf_counter() - started
    return output.images, {"denoising": output.report.seconds["denoising"], "whole": whole}


def compiled_calls(pipe: Any, run: Callable[[], Made]) -> Callable[[], Made]:
    """A call with a compiled copy of a pipeline's network, which takes its weights for constants.

    The first one compiles it, in a minute or two.
    """
    fast = copy.deepcopy(pipe.unet)
    fast.compile(options={"freezing": True})

    def call() -> Made:
        own, pipe.unet = pipe.unet, fast
        try:
            return run()
        finally:
            pipe.unet = own

    return call


def _generators(rows: Sequence[int]) -> list[torch.Generator]:
    """Of the noise on embeddings, as subjects of one seed have it."""
    return [torch.Generator().manual_seed(0) for _ in rows]


# Measuring ------------------------------------------------------------------------------------------------------------


def speedup_figures(
    subject: PipelineSubject,
    usual: Usual,
    repeats: int = 7,
    steps: Sequence[int] = STEPS,
    evaluations: int = CLOSE,
    compiling: bool = False,
) -> Figures:
    """Error and seconds of the usual way and of the cheapest configuration that comes as close.

    Args:
        subject: With one seed.
        usual: Of it.
        repeats: Pairs of timed calls, one sample each, after a first one.
        steps: That are tried, beside those that were fitted.
        evaluations: Of the close path.
        compiling: Measure ours with its network compiled, too, where there is a compiler.

    Returns:
        Of "usual" and "ours" the configuration, quartiles of the error, and median seconds; and the ratios of the
        seconds of "denoising" and of the "whole" call, with their spread, and of "evaluations". In "compiled" such
        ratios of the usual way as it is over ours compiled.

    Raises:
        NotConvergedError: If nothing within the usual way's evaluations comes as close.
    """
    scale, rows = usual.guidance_scale, range(subject.samples)
    truth = close_reference(subject, scale, evaluations)
    usual_errors = errors_of(usual.run(rows, "latent")[0], truth).numpy()
    known = [found for found in candidates(subject.pipe, scale, steps) if found.expected_evaluations <= usual.steps]
    chosen = cheapest_within(subject, known, truth, float(np.median(usual_errors)))
    settings = {
        "num_inference_steps": chosen.configuration.steps,
        "solver": chosen.configuration.solver,
        "guidance_scale": scale,
    }
    calls = {
        "usual": lambda: usual.run([0], "pt")[1],
        "ours": lambda: called(subject, [0], "pt", **settings)[1],
    }
    if compiling and shutil.which("g++"):
        calls["compiled"] = compiled_calls(subject.pipe, calls["ours"])
    seen = in_turns(calls, repeats)
    figures: Figures = {
        "guidance_scale": scale,
        "conditions": subject.samples,
        "repeats": repeats,
        "usual": {"name": usual.name, "solver": DDIM, "steps": usual.steps, "evaluations": usual.steps},
        "ours": {
            "solver": chosen.configuration.solver,
            "steps": chosen.configuration.steps,
            "evaluations": chosen.evaluations,
        },
        "evaluations": usual.steps / chosen.evaluations,
    }
    for who, found in (("usual", usual_errors), ("ours", chosen.errors)):
        low, middle, high = np.quantile(found, (0.25, 0.5, 0.75)).tolist()
        figures[who] |= {"error_low": low, "error": middle, "error_high": high}
        figures[who] |= {kind: statistics.median(each[kind] for each in seen[who]) for kind in ("denoising", "whole")}
    slow, fast, *faster = seen.values()
    figures |= _ratios(slow, fast)
    if faster:
        figures["compiled"] = _ratios(slow, faster[0])
    return figures


def _ratios(slow: Sequence[Seconds], fast: Sequence[Seconds]) -> Figures:
    """Of "denoising" and of the "whole" call."""
    kinds = ("denoising", "whole")
    return {kind: ratio_of([each[kind] for each in slow], [each[kind] for each in fast]) for kind in kinds}


def candidates(pipe: Any, guidance_scale: float, steps: Sequence[int] = STEPS) -> list[Configuration]:
    """What was fitted to the checkpoint at a guidance, and every named solver; the fewest evaluations first."""
    named = configurations(tuple(SOLVERS), steps, guidance_scales=[guidance_scale])
    found = [*fitted_runs(pipe.scheduler, guidance_scale), *named]
    return sorted(found, key=lambda configuration: configuration.expected_evaluations)


@dataclass(frozen=True, eq=False)
class Found:
    """A configuration that was run.

    Attributes:
        configuration: What was run.
        errors: Of each sample, relative RMS.
        evaluations: Of the network, for one batch.
    """

    configuration: Configuration
    errors: np.ndarray
    evaluations: int

    @property
    def error(self) -> float:
        """The median; infinite where half of the samples broke."""
        return float(np.median(self.errors))


def cheapest_within(subject: PipelineSubject, known: Sequence[Configuration], truth: Reference, wanted: float) -> Found:
    """Of the configurations with the fewest evaluations whose median error is within a bound, the best.

    Args:
        subject: They are of.
        known: The fewest evaluations first.
        truth: Of the subject.
        wanted: The bound.

    Raises:
        NotConvergedError: If there is none.
    """
    for _, alike in groupby(known, key=lambda configuration: configuration.expected_evaluations):
        runs = [(configuration, *subject.run(configuration)) for configuration in alike]
        best = min(
            (
                Found(configuration, errors_of(latents, truth).numpy(), report.evaluations // len(subject.parts))
                for configuration, latents, report in runs
            ),
            key=lambda found: found.error,
        )
        if best.error <= wanted:
            return best
    raise NotConvergedError(
        f"No solver comes within {wanted:.2g} of the exact latents in up to {known[-1].expected_evaluations} "
        "evaluations; fit steps to the checkpoint (`unitouch-gen fit`)."
    )
