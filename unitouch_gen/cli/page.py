"""The page of `unitouch-gen app`: a tab for each pipeline, inputs on the left, results on the right."""

import random
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gradio
import torch

from unitouch_gen.cli.options import MAX_SEED
from unitouch_gen.errors import first_line
from unitouch_gen.evaluation.zero_shot import ZeroShotTouchClassifier
from unitouch_gen.examples import examples
from unitouch_gen.world.questions import TOPICS

Fields = dict[str, Any]  # components of a tab, by the arguments of its pipeline's call


def launch(pipes: Mapping[str, Any], host: str, port: int) -> gradio.Blocks:
    """Serves a page with a tab for each pipeline, by the names of `unitouch_gen.tiny`; it asks no other host."""
    titles = {"touch-to-image": "To picture", "stylization": "Style a photo", "x-to-touch": "To touch",
              "touch-to-text": "Ask"}  # fmt: skip
    # Uploads and pictures stay on the disk for an hour.
    with gradio.Blocks(title="unitouch_gen", analytics_enabled=False, delete_cache=(3600, 3600)) as page:
        gradio.Markdown("# unitouch_gen\nPictures of touches, touches of anything, and answers about touches.")
        with gradio.Tabs():
            for kind in [kind for kind in titles if kind in pipes]:
                with gradio.Tab(titles[kind]):
                    tab(pipes[kind], kind)
    system = gradio.themes.Default(font=["system-ui", "sans-serif"], font_mono=["ui-monospace", "monospace"])
    css = "@media (max-width: 480px) { .tab-container button { padding: 0 0.6rem; font-size: 0.9rem; } }"  # phones
    page.queue(max_size=16, default_concurrency_limit=1).launch(
        server_name=host, server_port=port, theme=system, css=css, max_file_size=20 * 2**20, footer_links=[],
        show_error=True, quiet=True, prevent_thread_lock=True,
    )  # fmt: skip
    return page


def tab(pipe: Any, kind: str) -> None:
    """The tab of a pipeline."""
    asking = kind == "touch-to-text"
    with gradio.Row():
        with gradio.Column():
            fields = FIELDS[kind](pipe) | ({} if asking else solver_fields(pipe))
            button = gradio.Button("Ask" if asking else "Make it", variant="primary")
        with gradio.Column():
            results: list[Any] = [
                gradio.Textbox(label="Answer")
                if asking
                else gradio.Gallery(label="Pictures", format="png", columns=2, height=600),
                gradio.Textbox(label="Feels like", visible=kind == "touch-to-image"),
                gradio.Textbox(label="Run report", lines=3),
                gradio.Textbox(label="Seed that was used", visible=not asking),
            ]
    bar = gradio.Progress()

    def run(given: dict[Any, Any], progress: gradio.Progress = bar) -> tuple[Any, ...]:
        values = {name: given[part] for name, part in fields.items() if given[part] not in (None, "")}
        try:
            return answer(pipe, kind, values, progress)
        except (ValueError, TypeError, ArithmeticError) as error:
            message = first_line(error)
            for value in values.values():  # uploads by their names
                message = message.replace(value, Path(value).name) if isinstance(value, str) else message
            raise gradio.Error(message, duration=None, print_exception=False) from error

    button.click(run, set(fields.values()), results, concurrency_id="pipelines", api_visibility="private")


def touch_fields(pipe: Any) -> Fields:
    sensors = [("found by its looks", ""), *((name, name) for name in pipe.unitouch.config.sensors)]
    return {
        "touch": upload("touch", "Touch"),
        "prompt": gradio.Textbox("", label="Prompt", info="What else the picture should be.", max_lines=3),
        "sensor": gradio.Dropdown(sensors, value="", label="Sensor that took the touch"),
    }


def style_fields(pipe: Any) -> Fields:
    return {
        "image": upload("image", "Photo"),
        **touch_fields(pipe),
        "touch_weight": gradio.Slider(0, 1, 0.7, step=0.05, label="Share of the touch in the mix"),
        "layout": gradio.Slider(2, 16, 14, step=1, label="How finely the photo's layout is held"),
        "keep_colours": gradio.Checkbox(False, label="Hold its mean colour, too"),
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
    asked = [topic.questions[0] for topic in TOPICS.values()]
    return {
        "touch": upload("touch", "Touch"),
        "question": gradio.Dropdown(asked, value="How does it feel?", label="Question", allow_custom_value=True),
    }


FIELDS = {"touch-to-image": touch_fields, "stylization": style_fields, "x-to-touch": any_fields,
          "touch-to-text": asking_fields}  # fmt: skip


def upload(modality: str, label: str) -> Any:
    """A file of a modality, with samples."""
    sources: Any = ["upload", "clipboard"]
    with gradio.Row():
        if modality == "audio":
            part: Any = gradio.Audio(type="filepath", label=label)
        else:
            part = gradio.Image(type="filepath", image_mode=None, sources=sources, label=label, height=240)
        files = [[str(file)] for file in examples(modality).values()]
        gradio.Examples(files, part, label="Samples", api_visibility="private")
    return part


def solver_fields(pipe: Any) -> Fields:
    """Fields of all tabs."""
    steps, guidance = pipe.config.default_num_inference_steps, pipe.config.default_guidance_scale
    with gradio.Accordion("Solver, seed, number of pictures", open=False):
        return {
            "num_inference_steps": gradio.Slider(1, max(2 * steps, 50), steps, step=1, label="Steps"),
            "tolerance": gradio.Number(None, label="Error of the latents, in place of steps", minimum=1e-3, maximum=1),
            "guidance_scale": gradio.Slider(1, max(2 * guidance, 15), guidance, step=0.5, label="Guidance"),
            "num_images_per_prompt": gradio.Slider(1, 8, 1, step=1, label="Pictures"),
            "seed": gradio.Number(
                0, precision=0, minimum=0, maximum=MAX_SEED, label="Seed; a new one each time if empty"
            ),
        }


def answer(pipe: Any, kind: str, given: dict[str, Any], progress: gradio.Progress) -> tuple[Any, ...]:
    """Pictures or the answer, what the touch feels like, the run report and the seed."""
    if kind == "touch-to-text":
        output = pipe(**given)
        return output.texts[0], "", str(output.report), ""
    seed = int(given.pop("seed", random.randrange(2**31)))
    if "tolerance" in given:
        del given["num_inference_steps"]

    def show(view: Any, step: int, timestep: Any, tensors: Any) -> dict[str, Any]:
        progress((step + 1, given.get("num_inference_steps")), desc="Denoising")
        return {}

    generator = [torch.Generator().manual_seed(seed + number) for number in range(given["num_images_per_prompt"])]
    output, felt = pipe(**given, generator=generator, callback_on_step_end=show), ""
    if kind == "touch-to-image" and "text" in pipe.unitouch.known_modalities and pipe.processor.tokenizer is not None:
        classifier = ZeroShotTouchClassifier(pipe.unitouch, pipe.processor)
        felt = str(classifier(given["touch"], sensor=given.get("sensor"), top=3)[0])
    return output.images, felt, str(output.report), str(seed)
