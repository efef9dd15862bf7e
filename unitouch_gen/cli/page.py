"""The page of `unitouch-gen app`: a tab for each pipeline, with inputs on the left and results on the right."""

import html
import math
import os
import random
import re
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import gradio
import safehttpx
import torch
from gradio import processing_utils
from gradio.utils import get_upload_folder
from transformers import StoppingCriteriaList

from unitouch_gen.arguments import bounds, description
from unitouch_gen.cli.options import MAX_SEED
from unitouch_gen.errors import InvalidInputError, check_integer, check_number, first_line
from unitouch_gen.evaluation.zero_shot import ZeroShotTouchClassifier
from unitouch_gen.examples import examples
from unitouch_gen.world.questions import TOPICS

TITLES = {
    "touch-to-image": "To picture",
    "stylization": "Style a photo",
    "x-to-touch": "To touch",
    "touch-to-text": "Ask",
}
"""Titles of the tabs, by the names of the built-in pipelines."""

# On phones, all tabs in one row.
CSS = "@media (max-width: 480px) { .tab-container button { padding: 0 0.6rem; font-size: 0.9rem; } }"

UPLOAD_BYTES = 20 * 2**20  # largest upload
UPLOAD_SECONDS = 3600  # after which uploads and pictures are deleted

Fields = dict[str, Any]  # components of a tab, by the arguments of its pipeline's call


class StoppedError(Exception):
    """Ends a job after its user pressed "Stop" or closed the page."""


class Jobs:
    """Events that stop the jobs of a page, by browser session and pipeline.

    gradio's `cancels` does not stop a running function, and its page then shows an error.
    """

    def __init__(self) -> None:
        self.stops: dict[tuple[str, str], threading.Event] = {}

    def expect(self, session: str, kind: str) -> None:
        """Registers a job, so that it can be stopped while it waits in the queue."""
        stop = self.stops.get((session, kind))
        if stop is None or stop.is_set():
            self.stops[session, kind] = threading.Event()

    @contextmanager
    def running(self, session: str, kind: str) -> Iterator[Callable[[], None]]:
        """Runs a job; yields a check that raises `StoppedError` once it is stopped."""
        stop = self.stops.setdefault((session, kind), threading.Event())

        def check() -> None:
            if stop.is_set():
                raise StoppedError

        try:
            check()
            yield check
        finally:
            if self.stops.get((session, kind)) is stop:
                del self.stops[session, kind]

    def stop(self, session: str, kind: str) -> None:
        """Stops the job that runs or waits, if there is one."""
        stop = self.stops.get((session, kind))
        if stop is not None:
            stop.set()

    def close(self, session: str) -> None:
        """Stops all jobs of a session that has ended."""
        for key in [key for key in self.stops if key[0] == session]:
            self.stops.pop(key).set()

    def close_all(self) -> None:
        for session, _ in list(self.stops):
            self.close(session)


@contextmanager
def serving(pipes: Mapping[str, Any], host: str, port: int) -> Iterator[gradio.Blocks]:
    """Serves a page with a tab for each pipeline, by the names of `unitouch_gen.tiny`; it contacts no other host."""
    fetch_nothing()
    jobs = Jobs()
    titles = {kind: title for kind, title in TITLES.items() if kind in pipes}
    with gradio.Blocks(title="unitouch_gen", analytics_enabled=False, delete_cache=(600, UPLOAD_SECONDS)) as page:
        gradio.Markdown("# unitouch_gen\nPictures of touches, touches of anything, and answers about touches.")
        with gradio.Tabs():
            for kind, title in titles.items():
                with gradio.Tab(title):
                    tab(pipes[kind], kind, jobs)

        def close(request: gradio.Request) -> None:
            jobs.close(str(request.session_hash))

        page.unload(close)
    page.queue(max_size=16, default_concurrency_limit=1)
    page.launch(
        server_name=f"[{host}]" if ":" in host else host,
        server_port=port,
        share=False,  # the default is True in hosted notebooks
        run_history=False,  # would offer to save runs at Hugging Face
        enable_monitoring=False,
        max_file_size=UPLOAD_BYTES,
        theme=gradio.themes.Default(font=["system-ui", "sans-serif"], font_mono=["ui-monospace", "monospace"]),
        css=CSS,
        footer_links=[],
        quiet=True,
        prevent_thread_lock=True,
    )
    try:
        yield page
    finally:
        jobs.close_all()
        page.close(verbose=False)


def fetch_nothing() -> None:
    """Makes gradio refuse addresses in place of files, which it would fetch for anyone."""

    async def refuse(hostname: str) -> str:
        raise page_error("An address was passed; upload the file, as this page fetches nothing.")

    safehttpx.async_validate_url = refuse  # called before each fetch, except from hosts of this list
    processing_utils.PUBLIC_HOSTNAME_WHITELIST.clear()


def tab(pipe: Any, kind: str, jobs: Jobs) -> None:
    """Builds the tab of a pipeline."""
    answers = kind == "touch-to-text"
    with gradio.Row():
        with gradio.Column():
            fields = FIELDS[kind](pipe)
            if not answers:
                fields |= solver_fields(pipe)
            with gradio.Row():
                button = gradio.Button("Ask" if answers else "Make it", variant="primary", scale=3)
                stop_button = gradio.Button("Stop", scale=1)
        with gradio.Column():
            results = result_fields(kind)
    bar = gradio.Progress()

    def expect(request: gradio.Request) -> None:
        jobs.expect(str(request.session_hash), kind)

    def run(inputs: dict[Any, Any], request: gradio.Request, progress: gradio.Progress = bar) -> Any:
        try:
            values = values_of(fields, inputs)
            with jobs.running(str(request.session_hash), kind) as check:
                return answer(pipe, kind, values, progress, check)
        except StoppedError:
            gradio.Info("Stopped.")
            return [gradio.skip()] * len(results)
        except (MemoryError, torch.OutOfMemoryError) as error:
            raise page_error("There is not enough memory; ask for fewer pictures.") from error
        except (ValueError, TypeError, ArithmeticError) as error:
            raise page_error(first_line(error)) from error

    def stop(request: gradio.Request) -> None:
        jobs.stop(str(request.session_hash), kind)

    button.click(expect, queue=False, api_visibility="private")
    button.click(
        run,
        set(fields.values()),
        results,
        preprocess=False,  # gradio's preprocessing opens pictures, and its errors quote the server's paths
        concurrency_id="pipelines",
        api_visibility="private",
    )
    stop_button.click(stop, queue=False, api_visibility="private")


def result_fields(kind: str) -> list[Any]:
    """The results of a tab: pictures or an answer, what the touch feels like, the run report and the seed."""
    answers = kind == "touch-to-text"
    first: Any
    if answers:
        first = gradio.Textbox(label="Answer")
    else:
        first = gradio.Gallery(label="Pictures", format="png", columns=2, height=600)
    return [
        first,
        gradio.Textbox(label="Feels like", visible=kind == "touch-to-image"),
        gradio.Textbox(label="Run report", lines=3),
        gradio.Textbox(label="Seed that was used", visible=not answers),
    ]


def page_error(message: str) -> gradio.Error:
    """An error that the page shows as one line, with uploads by their names; gradio renders messages as HTML."""
    folder = repr(get_upload_folder())[1:-1]  # as messages quote it
    message = re.sub(re.escape(folder) + r"[\\/]+[0-9a-f]{64}[\\/]+", "", message)
    return gradio.Error(html.escape(message, quote=False), duration=None, print_exception=False)


def values_of(fields: Fields, inputs: Mapping[Any, Any]) -> dict[str, Any]:
    """Arguments of a call from the browser's inputs: uploads as paths, numbers within their fields' bounds."""
    values = {}
    for name, component in fields.items():
        value = inputs[component]
        if value is None or value == "":
            continue
        if isinstance(component, gradio.Image | gradio.Audio):
            value = value["path"]
            if not os.path.isfile(value):
                raise InvalidInputError(f"`{name}` was uploaded more than an hour ago and is deleted; upload it again.")
        elif isinstance(component, gradio.Slider | gradio.Number):
            low = -math.inf if component.minimum is None else component.minimum
            high = math.inf if component.maximum is None else component.maximum
            check_number(name, value, low, high)
        values[name] = value
    return values


def touch_fields(pipe: Any) -> Fields:
    sensors = [("retrieved from the image", ""), *((name, name) for name in pipe.unitouch.config.sensors)]
    return {
        "touch": upload("touch", "Touch"),
        "prompt": gradio.Textbox("", label="Prompt", info="What else the picture should be.", max_lines=3),
        "sensor": gradio.Dropdown(sensors, value="", label="Sensor that took the touch"),
    }


def style_fields(pipe: Any) -> Fields:
    return {
        "image": upload("image", "Photo"),
        **touch_fields(pipe),
        "touch_weight": slider("touch_weight", "Touch weight", 0.7, most=1, step=0.05),
        "layout": slider("layout", "Layout", 14, most=16),
        "keep_colours": gradio.Checkbox(False, label="Keep colours", info=description("keep_colours")),
    }


def any_fields(pipe: Any) -> Fields:
    gradio.Markdown("Of words, a photo, a sound or another sensor's touch; several of them are mixed.")
    sensors = list(pipe.config.sensors)
    return {
        "text": gradio.Textbox("", label="Words", placeholder="rough brick", max_lines=3),
        "image": upload("image", "Photo"),
        "audio": upload("audio", "Sound"),
        "touch": upload("touch", "Touch"),
        "sensor": gradio.Dropdown(sensors, value=sensors[0] if sensors else None, label="Sensor to draw for"),
    }


def asking_fields(pipe: Any) -> Fields:
    questions = [topic.questions[0] for topic in TOPICS.values()]
    return {
        "touch": upload("touch", "Touch"),
        "question": gradio.Dropdown(questions, value="How does it feel?", label="Question", allow_custom_value=True),
    }


FIELDS = {
    "touch-to-image": touch_fields,
    "stylization": style_fields,
    "x-to-touch": any_fields,
    "touch-to-text": asking_fields,
}


def upload(modality: str, label: str) -> Any:
    """An upload of a modality, with samples."""
    sources: Any = ["upload", "clipboard"]
    with gradio.Row():
        if modality == "audio":
            component: Any = gradio.Audio(type="filepath", label=label)
        else:
            component = gradio.Image(type="filepath", image_mode=None, sources=sources, label=label, height=240)
        files = [[str(file)] for file in examples(modality).values()]
        gradio.Examples(files, component, label="Samples", api_visibility="private")
    return component


def solver_fields(pipe: Any) -> Fields:
    """Fields of all tabs with pictures."""
    steps = pipe.config.default_num_inference_steps
    guidance = pipe.config.default_guidance_scale
    with gradio.Accordion("Sampling", open=False):
        return {
            "num_inference_steps": slider("num_inference_steps", "Steps", steps, most=max(2 * steps, 50)),
            "tolerance": gradio.Number(
                0,  # gradio shows 0 even if there is no value
                label="Tolerance",
                info=f"{description('tolerance')} 0 for a number of steps.",
                minimum=0,
                maximum=bounds("tolerance")[1],
            ),
            "guidance_scale": slider("guidance_scale", "Guidance", guidance, most=max(2 * guidance, 15), step=0.5),
            "num_images_per_prompt": slider("num_images_per_prompt", "Pictures", 1, most=8),
            "seed": gradio.Number(
                0, precision=0, minimum=0, maximum=MAX_SEED, label="Seed; a new one each time if empty"
            ),
        }


def slider(name: str, label: str, value: float, *, most: float, step: float = 1) -> gradio.Slider:
    """A slider of a sampling argument, from its smallest value to the largest that the page offers."""
    return gradio.Slider(bounds(name)[0], most, value, step=step, label=label, info=description(name))


def answer(
    pipe: Any, kind: str, arguments: dict[str, Any], progress: gradio.Progress, check: Callable[[], None]
) -> tuple[Any, ...]:
    """Pictures or the answer, what the touch feels like, the run report and the seed.

    `check` is called after each step and token, and may raise.
    """
    if kind == "touch-to-text":

        def never_stop(tokens: torch.Tensor, scores: Any, **others: Any) -> torch.Tensor:
            check()
            return torch.zeros(len(tokens), dtype=torch.bool, device=tokens.device)

        output = pipe(**arguments, stopping_criteria=StoppingCriteriaList([never_stop]))
        return output.texts[0], "", str(output.report), ""
    seed = check_integer("seed", arguments.pop("seed", random.randrange(2**31)), 0)
    unused = "num_inference_steps" if arguments.get("tolerance") else "tolerance"
    arguments.pop(unused, None)

    def show(view: Any, step: int, timestep: Any, tensors: Any) -> dict[str, Any]:
        check()
        progress((step + 1, arguments.get("num_inference_steps")), desc="Denoising")
        return {}

    count = check_integer("num_images_per_prompt", arguments.get("num_images_per_prompt", 1), 1)
    generators = [torch.Generator().manual_seed(seed + number) for number in range(count)]
    output = pipe(**arguments, generator=generators, callback_on_step_end=show)
    feels_like = ""
    reads_text = "text" in pipe.unitouch.known_modalities and pipe.processor.tokenizer is not None
    if kind == "touch-to-image" and reads_text:
        classifier = ZeroShotTouchClassifier(pipe.unitouch, pipe.processor)
        named = classifier(arguments["touch"], sensor=arguments.get("sensor"), top=3)[0]
        feels_like = str(named)
    return output.images, feels_like, str(output.report), str(seed)
