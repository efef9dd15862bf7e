"""`unitouch-gen app`: a page in the browser, with a tab for each pipeline.

What is made, named, refused and told is what the commands do: see `unitouch_gen.cli.pictures`. The page takes nothing
from the network and sends nothing there, and is served to this machine alone unless `--host` says otherwise.
"""

import os
import random
import socket
import tempfile
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from unitouch_gen.cli import options
from unitouch_gen.cli.loading import CLASSES, kind_of, load_pipeline
from unitouch_gen.cli.pictures import (
    check_inputs,
    endings,
    felt,
    items_of,
    make_pictures,
    materials_of,
    sureness,
    unfamiliar,
)
from unitouch_gen.errors import REFUSALS, ExchangedInputsWarning, InvalidInputError, check_integer, needed

HERE = "127.0.0.1"
"""This machine, and nobody else."""

PORTS = range(7860, 7960)
"""Where a free one is looked for."""

LARGEST = 20 * 2**20
"""Of an upload, bytes; see `check_inputs` for what it has to be."""

MOST_PICTURES = 8
"""Of a request."""

LONGEST_ANSWER = 300
"""Characters of what a value is refused by."""

KEPT = 3600
"""Seconds that uploads and pictures stay on the disk, at least."""


def app(
    *,
    host: Annotated[
        str, typer.Option(help="Address to serve at; 0.0.0.0 lets in everyone who reaches this machine.")
    ] = HERE,
    port: Annotated[
        int | None, typer.Option(help="Port to serve at; the first free one from 7860 on if left out.")
    ] = None,
    queue: Annotated[int, typer.Option(help="Requests that may wait for those before them; more are refused.")] = 16,
    model: Annotated[
        list[str] | None,
        typer.Option(help="Folder or repository id of a saved pipeline, a tab for each; built-in ones if left out."),
    ] = None,
    load_sensor: options.LoadSensor = None,
    dtype: options.Dtype = None,
    device: options.Device = "auto",
) -> None:
    """Serves a page: touch to picture, photos restyled by a touch, and anything to touch.

    Needs the extra `app`.

    Example: unitouch-gen app --port 7860
    """
    place = free_port(host, port)
    check_integer("--queue", queue, 1, options.MOST)
    kinds = [kind_of(name) for name in model] if model else list(CLASSES)
    if len(set(kinds)) < len(kinds):
        raise InvalidInputError(f"`--model` names two pipelines for {max(kinds, key=kinds.count)}; name one of each.")
    with tempfile.TemporaryDirectory(prefix="unitouch-") as folder:
        gradio_in(folder)
        loading: dict[str, Any] = {"dtype": dtype, "device": device, "sensors": load_sensor}
        models: list[str | None] = [*model] if model else [None] * len(kinds)
        pipes = {kind: load_pipeline(kind, name, True, **loading) for kind, name in zip(kinds, models, strict=True)}
        page = page_of(pipes)
        typer.echo(f"The page is at {serve(page, host, place, queue)} (Ctrl-C ends it)")
        if host not in (HERE, "localhost"):
            options.note(f"everyone who reaches {host} may use it; {HERE}, the default, is for this machine alone")
        try:
            while True:
                time.sleep(KEPT)
        except KeyboardInterrupt:
            page.close(verbose=False)


def free_port(host: str, port: int | None) -> int:
    """A port that a page may be served at."""
    if not host.strip():  # which sockets take for every address that this machine has
        raise InvalidInputError(f"`--host` is {host!r}; name an address, {HERE} for this machine alone.")
    if port is not None:
        check_integer("--port", port, 1, 65535)
    for number in PORTS if port is None else [port]:
        try:
            socket.create_server((host, number)).close()
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or error
        else:
            return number
    asked = f"{port}" if port else f"{PORTS[0]} to {PORTS[-1]}"
    raise InvalidInputError(f"`--host` is {host!r}, where port {asked} cannot be served ({reason}); name others.")


def gradio_in(folder: str) -> Any:
    """gradio, which keeps uploads and pictures in a folder and tells nobody that it runs."""
    telling_nobody = {"GRADIO_ANALYTICS_ENABLED": "False", "HF_HUB_DISABLE_TELEMETRY": "1"}
    os.environ.update(telling_nobody, GRADIO_TEMP_DIR=folder)
    return needed("gradio", "app")


def serve(page: Any, host: str, port: int, queue: int) -> str:
    """Begins to serve a page, and says where."""
    gradio = needed("gradio", "app")
    page.queue(max_size=queue, default_concurrency_limit=1, api_open=False)
    fonts = {"font": ["system-ui", "sans-serif"], "font_mono": ["ui-monospace", "monospace"]}  # none is fetched
    _, url, _ = page.launch(
        server_name=host,
        server_port=port,
        theme=gradio.themes.Default(**fonts),
        css=CSS,
        max_file_size=LARGEST,
        footer_links=[],
        run_history=False,
        share=False,
        ssr_mode=False,
        mcp_server=False,
        prevent_thread_lock=True,
        quiet=True,
    )
    return url


# The page -------------------------------------------------------------------------------------------------------------

CSS = """
@media (max-width: 480px) { .tab-container button { padding: 0 0.6rem; font-size: 0.9rem; } }  /* all three in a row */
.gradio-container { max-width: 72rem !important; margin: 0 auto !important; }
.image-frame img { width: 100%; height: 100%; object-fit: contain; }  /* touches are smaller than the box */
"""

ITS_LOOKS = ("found by its looks", "")
"""The choice of no sensor."""

WORDS, SOUND, PHOTO, TOUCH = "words", "a sound", "a photo", "another sensor's touch"
MADE_OF = {"text": WORDS, "audio": SOUND, "image": PHOTO, "touch": TOUCH}
"""What a touch is made of, by modality."""

STEPS, TOLERANCE = "steps", "tolerance"


def page_of(pipes: Mapping[str, Any]) -> Any:
    """The page, a `gradio.Blocks`.

    Args:
        pipes: Pipelines by the names of `CLASSES`; there is a tab for each.
    """
    gradio = needed("gradio", "app")
    tabs = {
        "touch-to-image": ("To picture", touch_to_image_tab),
        "stylization": ("Style a photo", stylize_tab),
        "x-to-touch": ("To touch", x_to_touch_tab),
    }
    for kind, pipe in pipes.items():
        if pipe.unitouch is None:
            raise InvalidInputError(f"`--model` names a {kind} pipeline without a joint space; name one that has it.")
    with gradio.Blocks(title="unitouch_gen", analytics_enabled=False, delete_cache=(KEPT, KEPT)) as page:
        gradio.Markdown("# unitouch_gen\nPictures of touches, and touches of pictures, words and sounds.")
        with gradio.Tabs():
            for kind, (title, fill) in tabs.items():
                if kind in pipes:
                    with gradio.Tab(title):
                        fill(pipes[kind])
    refuse_in_a_line(page)
    return page


def refuse_in_a_line(page: Any) -> None:
    """Makes a page say what is wrong with values that no tab of it sends, but a program may.

    gradio says nothing of those of another kind, and quotes others whole.
    """
    gradio, preprocess = needed("gradio", "app"), page.preprocess_data

    async def preprocessed(function: Any, values: list[Any], *rest: Any, **options: Any) -> Any:
        try:
            return await preprocess(function, values, *rest, **options)
        except gradio.Error as error:
            said = " ".join(str(error.message).split())
            short = said if len(said) <= LONGEST_ANSWER else f"{said[:LONGEST_ANSWER]} ..."
            raise gradio.Error(short, print_exception=False) from error
        except (TypeError, ValueError) as error:
            place = f"`/{function.api_name}` got a value of another kind than it takes"
            said = f"{place}; `view_api()` of gradio's client lists them."
            raise gradio.Error(said, print_exception=False) from error

    page.preprocess_data = preprocessed


def touch_to_image_tab(pipe: Any) -> None:
    """A picture of what a touch feels like."""
    gradio = needed("gradio", "app")
    progress = gradio.Progress()
    with gradio.Row():
        with gradio.Column():
            touch = sampled("touch", "Touch")
            prompt, sensor = prompt_of(), sensor_of("Sensor that took it", pipe.unitouch.sensors)
            settings = settings_of(pipe)
            button = gradio.Button("Make pictures", variant="primary")
        with gradio.Column():
            results = results_of("Pictures", pipe)

    def run(touch, prompt, sensor, by, steps, tolerance, guidance, pictures, seed, new_seed, progress=progress):
        call = call_of(by, steps, tolerance, guidance, pictures, seed, new_seed)
        given = {"prompt": prompt or None, "sensor": sensor or None}
        return answer(pipe, {"touch": touch}, given, call, progress)

    inputs = [touch, prompt, sensor, *settings]
    button.click(run, inputs, results, api_name="touch_to_image", concurrency_id="pipelines")


def stylize_tab(pipe: Any) -> None:
    """A photo restyled by a touch."""
    gradio = needed("gradio", "app")
    progress = gradio.Progress()
    with gradio.Row():
        with gradio.Column():
            photo = sampled("image", "Photo")
            touch = sampled("touch", "Touch")
            touch_weight = gradio.Slider(0, 1, 0.55, step=0.05, label="Share of the touch in the mix")
            mix = gradio.Radio(["linear", "slerp", "paper"], value="slerp", label="How touch and photo are mixed")
            init_strength = gradio.Slider(
                0,
                1,
                0.65,
                step=0.05,
                label="How much of the photo's layout goes",
                info="Near 0 it stays; at 1 it goes.",
            )
            prompt, sensor = prompt_of(), sensor_of("Sensor that took the touch", pipe.unitouch.sensors)
            settings = settings_of(pipe)
            button = gradio.Button("Restyle the photo", variant="primary")
        with gradio.Column():
            results = results_of("Pictures", pipe, names=False)

    def run(
        photo,
        touch,
        touch_weight,
        mix,
        init_strength,
        prompt,
        sensor,
        by,
        steps,
        tolerance,
        guidance,
        pictures,
        seed,
        new_seed,
        progress=progress,
    ):
        call = call_of(by, steps, tolerance, guidance, pictures, seed, new_seed)
        given = {
            "prompt": prompt or None,
            "sensor": sensor or None,
            "touch_weight": touch_weight,
            "mix": mix,
            "init_strength": init_strength,
        }
        return answer(pipe, {"image": photo, "touch": touch}, given, call, progress, names=False)

    inputs = [photo, touch, touch_weight, mix, init_strength, prompt, sensor, *settings]
    button.click(run, inputs, results, api_name="stylize", concurrency_id="pipelines")


def x_to_touch_tab(pipe: Any) -> None:
    """A touch image of what is read, heard, seen, or felt by another sensor."""
    gradio = needed("gradio", "app")
    progress = gradio.Progress()
    made_of = [words for modality, words in MADE_OF.items() if modality in pipe.unitouch.known_modalities]
    sensors, bridged = pipe.config.sensors, pipe.embedding_bank is not None
    with gradio.Row():
        with gradio.Column():
            of = gradio.Radio(made_of, value=made_of[0], label="Make a touch of")
            with gradio.Column(visible=made_of[0] == WORDS) as words:
                text = gradio.Textbox("", label="Words", placeholder="rough brick", max_lines=3, max_length=1000)
            with gradio.Column(visible=made_of[0] == SOUND) as sounds:
                audio = sampled("audio", "Sound of a hand or tool on it")
            with gradio.Column(visible=made_of[0] == PHOTO) as photos:
                image = sampled("image", "Photo")
            with gradio.Column(visible=made_of[0] == TOUCH) as touches:
                touch = sampled("touch", "Touch")
                source_sensor = sensor_of("Sensor that took it", pipe.unitouch.sensors)
            sensor = gradio.Dropdown(
                list(sensors) or [("the one that the model draws", "")],
                value=sensors[0] if sensors else "",
                label="Sensor to draw for",
                visible=len(sensors) > 1,
            )
            bridge = gradio.Checkbox(bridged, label="Move what is no photo towards photos", visible=bridged)
            candidates = gradio.Slider(1, 8, 1, step=1, label="Candidates", info="Made of each; the best is kept.")
            settings = settings_of(pipe)
            button = gradio.Button("Make touches", variant="primary")
        with gradio.Column():
            results = results_of("Touch images", pipe)
    columns = {WORDS: words, SOUND: sounds, PHOTO: photos, TOUCH: touches}
    of.change(
        lambda chosen: [gradio.Column(visible=chosen == name) for name in columns],
        of,
        list(columns.values()),
        api_visibility="private",
        show_progress="hidden",
    )

    def run(
        of,
        text,
        source_sensor,
        sensor,
        bridge,
        candidates,
        by,
        steps,
        tolerance,
        guidance,
        pictures,
        seed,
        new_seed,
        audio=None,
        image=None,
        touch=None,
        progress=progress,
    ):
        call = call_of(by, steps, tolerance, guidance, pictures, seed, new_seed)
        given = {"bridge": bridge, "num_candidates": candidates}
        if of == TOUCH:
            given["source_sensor"] = source_sensor or None
        inputs = {"text": text, "audio": audio, "image": image, "touch": touch}
        inputs = {name: value for name, value in inputs.items() if MADE_OF[name] == of}
        return answer(pipe, inputs, given, call, progress, drawn=sensor or None, candidates=candidates)

    inputs = [of, text, source_sensor, sensor, bridge, candidates, *settings, audio, image, touch]
    button.click(run, inputs, results, api_name="x_to_touch", concurrency_id="pipelines")


# Its parts ------------------------------------------------------------------------------------------------------------


def sampled(modality: str, label: str) -> Any:
    """An upload of a modality, with samples of it below."""
    from unitouch_gen.examples import examples

    gradio = needed("gradio", "app")
    if modality == "audio":
        upload = gradio.Audio(type="filepath", sources=["upload", "microphone"], label=label)
    else:
        sources = ["upload", "clipboard"]
        upload = gradio.Image(type="filepath", sources=sources, label=label, height=240, image_mode=None)
    only_uploaded(upload)
    names, files = zip(*examples(modality).items(), strict=True)
    labels = {"example_labels": [name.replace("_", " ") for name in names]} if modality == "audio" else {}
    gradio.Examples([[str(file)] for file in files], upload, label="Samples", api_visibility="private", **labels)
    return upload


def only_uploaded(upload: Any) -> None:
    """Makes a part of the page take nothing but files that were uploaded, as they are.

    gradio would fetch those of an address, and fail on one that is no picture before anyone could say what is wrong.
    """
    from unitouch_gen.files import check_no_address

    gradio, move = needed("gradio", "app"), upload.async_move_resource_to_block_cache

    async def moved(source: Any) -> Any:
        try:
            check_no_address(upload.label, source)
        except REFUSALS as error:
            raise gradio.Error(str(error), print_exception=False) from error
        return await move(source)

    upload.async_move_resource_to_block_cache = moved
    upload.preprocess = lambda payload: payload and payload.path


def prompt_of() -> Any:
    """What else a picture should be, in the words of the command line's help."""
    option: Any = options.Prompt
    said = option.__metadata__[0].help
    return needed("gradio", "app").Textbox("", label="Prompt", info=said, max_lines=3, max_length=1000)


def sensor_of(label: str, sensors: tuple[str, ...]) -> Any:
    """A choice of the sensors that a model knows; hidden where it knows none."""
    choices = [ITS_LOOKS, *((name, name) for name in sensors)]
    return needed("gradio", "app").Dropdown(choices, value="", label=label, visible=bool(sensors))


def settings_of(pipe: Any) -> list[Any]:
    """What all tabs ask, in the order of `call_of`."""
    gradio = needed("gradio", "app")
    steps, guidance = pipe.config.default_num_inference_steps, pipe.config.default_guidance_scale
    with gradio.Accordion("Error and time", open=True):
        by = gradio.Radio([STEPS, TOLERANCE], value=STEPS, label="The solver keeps to")
        number = gradio.Slider(
            1, max(2 * steps, 50), steps, step=1, label="Steps", info="More take longer and err less."
        )
        error = gradio.Slider(
            0.5, 30, 5, step=0.5, visible=False, label="Solver error, % of the latents", info="Less takes longer."
        )
    with gradio.Accordion("Seed, guidance, number of pictures", open=False):
        scale = gradio.Slider(1, max(2 * guidance, 15), guidance, step=0.5, label="Guidance", info="On above 1.")
        pictures = gradio.Slider(1, MOST_PICTURES, 1, step=1, label="Pictures")
        seed = gradio.Number(0, precision=0, label="Seed", info="The same one makes the same pictures.")
        new_seed = gradio.Checkbox(False, label="A new seed each time")
    by.change(
        lambda chosen: [gradio.Slider(visible=chosen == STEPS), gradio.Slider(visible=chosen == TOLERANCE)],
        by,
        [number, error],
        api_visibility="private",
        show_progress="hidden",
    )
    return [by, number, error, scale, pictures, seed, new_seed]


def results_of(label: str, pipe: Any, names: bool = True) -> list[Any]:
    """Where an answer goes, in its order; `names` says whether materials are named."""
    gradio = needed("gradio", "app")
    return [
        gradio.Gallery(label=label, format="png", columns=2, height="auto", object_fit="contain", interactive=False),
        gradio.Textbox(label="Feels like", info=sureness(pipe), visible=names, interactive=False),
        gradio.Textbox(label="Notes", visible=False, interactive=False),
        gradio.Textbox(label="Run report of the solver", lines=3, interactive=False),
        gradio.Textbox(label="Seed that was used", interactive=False),
    ]


# Answers --------------------------------------------------------------------------------------------------------------


def call_of(
    by: str, steps: int, tolerance: float, guidance: float, pictures: int, seed: int, new_seed: bool
) -> options.Call:
    """The settings of a tab as the options of a command, without bars in the terminal."""
    return options.Call(
        steps=steps if by == STEPS else None,
        tolerance=tolerance / 100 if by == TOLERANCE else None,
        guidance=guidance,
        images=pictures,
        seed=random.randrange(2**31) if new_seed else seed,
        as_json=True,
    )


def answer(
    pipe: Any,
    inputs: dict[str, Any],
    given: dict[str, Any],
    call: options.Call,
    progress: Any,
    *,
    names: bool = True,
    drawn: str | None = None,
    candidates: int | None = None,
) -> list[Any]:
    """What a tab shows: pictures, what they feel like, notes, the run report, and the seed.

    Args:
        pipe: That makes the pictures.
        inputs: Uploads or words, by modality.
        given: More arguments of its call.
        call: Settings.
        progress: Of gradio.
        names: Whether materials are named.
        drawn, candidates: Sensor that touch images are drawn for, and how many are made of each; `None` for pictures.
    """
    gradio = needed("gradio", "app")
    with told_in_the_page(inputs) as notes:
        call.check(**({} if candidates is None else {"candidates": candidates}))
        check_integer("images", call.images, 1, MOST_PICTURES)
        for name, value in inputs.items():
            if not value:
                raise InvalidInputError(f"`{name}` is missing; pass one.")
            check_inputs(name, [value])
        rows = {name: [value if name == "text" else Path(value)] for name, value in inputs.items()}
        items = items_of([f"seed-{call.seed}"], call.images, [drawn])
        folder = Path(tempfile.mkdtemp(dir=os.environ["GRADIO_TEMP_DIR"]))
        files = [folder / f"{item.stem}.png" for item in items]
        kept = {**given, **call.arguments, "callback_on_step_end": steps_to(progress)}
        made = make_pictures(pipe, kept, rows, items, files, call, candidates)
        notes += [*endings(made.report, files), *unfamiliar(made.report, rows.get("touch", []), items)]
        if not names:
            materials = []
        elif candidates is None:
            materials = felt(pipe, made)[:1]
        else:
            materials = materials_of(pipe, made.pictures, [item.sensor for item in items])
    return [
        list(map(str, files)),
        "\n".join(filter(None, map(str, materials))),
        gradio.Textbox("\n".join(notes), visible=bool(notes)),
        str(made.report),
        str(call.seed),
    ]


@contextmanager
def told_in_the_page(inputs: Mapping[str, Any]) -> Iterator[list[str]]:
    """Notes of a request; what the command would refuse or warn of is told in the page, in the same words.

    Args:
        inputs: Uploads by modality, whose names are told without the folders that they lie in here.
    """
    gradio, notes = needed("gradio", "app"), list[str]()
    try:
        with warnings.catch_warnings(record=True) as warned:  # requests take turns
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", ExchangedInputsWarning)
            yield notes
    except REFUSALS as error:
        said = options.as_options(str(error))
        for value in filter(None, inputs.values()):
            said = said.replace(str(value), Path(value).name)
        raise gradio.Error(" ".join(said.split()), duration=None, print_exception=False) from error
    notes += [str(one.message) for one in warned]


def steps_to(progress: Any) -> Any:
    """A callback that shows the steps of a run."""

    def show(view: Any, step: int, timestep: Any, tensors: Any) -> dict[str, Any]:
        known = view.num_timesteps if step < view.num_timesteps else None
        progress((step + 1, known), desc="Denoising", unit="steps")
        return {}

    return show
