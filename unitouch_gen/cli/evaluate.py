"""`unitouch-gen evaluate`: tables of the paper, on the world or on data sets, each figure beside its controls."""

import json
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import mean
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from unitouch_gen import __version__
from unitouch_gen.cli import options
from unitouch_gen.cli.data import BGR, Pattern, patterns_of
from unitouch_gen.cli.loading import kind_of, load_joint_space, load_pipeline
from unitouch_gen.errors import InvalidInputError, check_choice, check_integer

if TYPE_CHECKING:
    from unitouch_gen.models import UniTouchModel
    from unitouch_gen.training.data import RecordSet
    from unitouch_gen.training.data.heldout import Sets

TABLES = {
    "material": "Material of touches (Table 2): accuracy, %",
    "grasp": "Whether a grasp holds (Table 3): balanced accuracy, %",
    "retrieval": "Pictures, sounds and captions of an object, found by touch (Table 4): mean average precision, %",
    "prompts": "Six ways to ask for a material (Table 7): zero-shot accuracy, %",
    "touch-to-image": "Pictures of touches (Table 5)",
    "x-to-touch": "Touches of pictures, captions, sounds and other touches (Section 4.8)",
}
GENERATED = ("touch-to-image", "x-to-touch")

NAMED = ("gelsight", "gelsight_objectfolder", "digit")
"""Sensors of the world that a model may have been trained on: those of the paper's training sets."""

Figures = dict[str, dict[str, list[float]]]
"""By row and column, one for each world."""


def evaluate(
    table: Annotated[str, typer.Argument(help=f"{', '.join(TABLES)}; or all that there can be.")],
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Folder for JSON and Markdown.")] = None,
    model: Annotated[
        str | None,
        typer.Option(help="Folder or repository id of a joint space or a saved pipeline; built-in if left out."),
    ] = None,
    data: Annotated[
        list[Path] | None, typer.Option(help="Folder of a data set, in place of the world; may be repeated.")
    ] = None,
    kind: Annotated[str, typer.Option(help="Layout of the data sets, such as touch_and_go; or auto, to see.")] = "auto",
    sensor: Annotated[str | None, typer.Option(help="Sensor of all touches of the data sets.")] = None,
    materials: Annotated[
        str | None, typer.Option(help="Names of their materials by comma, in the order of their numbers.")
    ] = None,
    pattern: Pattern = None,
    bgr: BGR = False,
    seeds: Annotated[int, typer.Option(help="Worlds that figures are means over.")] = 3,
    objects: Annotated[int, typer.Option(help="Objects of each material of a world that figures are of.")] = 8,
    textures: Annotated[Path | None, typer.Option(help="Folder of scanned materials among the world's.")] = None,
    each: Annotated[int, typer.Option(help="Contacts of each material that images are made of.")] = 4,
    cache: Annotated[Path | None, typer.Option(help="Folder to keep what is rendered and decoded in.")] = None,
    device: options.Device = "auto",
    overwrite: options.Overwrite = False,
) -> None:
    """Makes tables of the paper, each figure beside chance, majority, plain statistics and an untrained encoder.

    Example: unitouch-gen evaluate material -o tables/
    """
    check_choice("table", table, (*TABLES, "all"))
    for option, count, least in (("--seeds", seeds, 1), ("--objects", objects, 2), ("--each", each, 1)):
        check_integer(option, count, least, 10_000)
    names = asked_for(table, model)
    from unitouch_gen.files import check_writable
    from unitouch_gen.training.data import open_dataset

    if output is not None:
        files = [output / f"{name}.json" for name in names]
        check_writable("--output", files[0])
        if not overwrite:
            options.check_new(files)

    stuff = None if materials is None else [name.strip() for name in materials.split(",")]
    layout: dict[str, Any] = {"sensor": sensor, "materials": stuff, "patterns": patterns_of(pattern), "bgr": bgr}
    folders = [open_dataset(folder, kind, **layout) for folder in data or ()]
    pipes = {name: load_pipeline(name, model, quiet=True, device=device) for name in names if name in GENERATED}
    for pipe in pipes.values():
        pipe.set_progress_bar_config(disable=True)
    joint, processor = load_joint_space(model, device)
    for name in tuple(names):
        try:
            check_table(name, joint, pipes.get(name), folders, each)
        except InvalidInputError as error:
            if table != "all":
                raise
            names.remove(name)
            options.note(f"No table {name!r}: {error}")
    from unitouch_gen.training.data.heldout import of_datasets, of_world

    with TemporaryDirectory(prefix="unitouch-") as scratch:
        place, started = cache or Path(scratch), time.perf_counter()
        if folders:
            sets = of_datasets(place, joint, processor, folders)
        else:
            known = [name for name in NAMED if name in joint.sensors]
            scans = None if textures is None else str(textures)
            sets = of_world(place, joint, processor, known, range(seeds), objects, scans, grasps="grasp" in names)
        made, images = figures_of(names, sets, joint, processor, pipes, each)
    facts = {"version": __version__, "model": model or "built-in", "seconds": round(time.perf_counter() - started)}
    for name, rows in made.items():
        show(name, rows, facts, output, images.get(name))
    if output is not None:
        typer.echo(f"The tables are in {output.resolve()}")


def asked_for(table: str, model: str | None) -> list[str]:
    """The tables to make: the one, or all that there can be of a model."""
    saved = model is not None and (table in GENERATED or (Path(model) / "model_index.json").is_file())
    drawn = {kind_of(model)} if saved else {*GENERATED} if model is None else set()  # type: ignore[arg-type]
    if table in GENERATED and table not in drawn:
        raise InvalidInputError(f"`--model` is {model!r}, a pipeline for {', '.join(drawn)}; name one of {table}.")
    return [name for name in TABLES if name == table or (table == "all" and name not in {*GENERATED} - drawn)]


def check_table(name: str, joint: "UniTouchModel", pipe: Any, folders: "Sequence[RecordSet]", each: int) -> None:
    """Refuses models and data sets that a table cannot be of, before their files are read.

    Raises:
        InvalidInputError: If a modality, sensor or label is missing, or there is too little to fit to or to measure on.
    """
    from unitouch_gen.evaluation.tables import GRASP_PROMPTS
    from unitouch_gen.training.data.heldout import modalities_of, parts_of

    label = {"material": "material", "prompts": "material", "grasp": "grasp"}.get(name, "")
    asked = ("image",) if name == "touch-to-image" else ("image", "audio", "text")
    if not {"touch", *(["text"] if label else [])} <= {*joint.known_modalities}:
        raise InvalidInputError(f"`--model` has no encoder of touch{' and text' * bool(label)}, which {name!r} asks.")
    if not folders and not any(drawable(name, pipe, [sensor]) for sensor in {*NAMED} & {*joint.sensors}):
        raise InvalidInputError(f"`--model` knows none of the world's sensors {', '.join(NAMED)}; pass `--data`.")
    for folder in folders:
        parts = parts_of(folder)
        for split, part in parts.items() if label else ():
            classes = {folder.classes[label][r.labels[label]] for r in part.records if label in r.labels}
            if len(classes) < 2 or (label == "grasp" and not classes <= {*GRASP_PROMPTS}):
                wanted = " and ".join(GRASP_PROMPTS) if label == "grasp" else "two or more"
                found = ", ".join(sorted(classes)) or "none"
                raise InvalidInputError(f"{folder} has the classes {found} of {label} to {split} on, not {wanted}.")
        if not label and not {*asked} & {*modalities_of(folder)} & {*joint.known_modalities}:
            raise InvalidInputError(f"{folder} has no {' or '.join(asked)} of every touch that the model knows.")
        if not drawable(name, pipe, [record.sensor for record in folder.records]):
            raise InvalidInputError(
                f"{folder} was felt by sensors other than {', '.join(pipe.config.sensors or ())}, which are those that "
                "the model draws touches by; pass its name as `--sensor` if it was one."
            )
        count = each * len({record.labels.get("material") for record in parts["test"].records})
        if name in GENERATED and (len(parts["train"]) < 6 or len(parts["test"]) < count + 2):
            raise InvalidInputError(
                f"{folder} has {len(parts['train'])} contacts to fit to and {len(parts['test'])} to draw of; {name!r} "
                f"needs 6, and 2 more than the {count} of `--each`."
            )


def drawable(name: str, pipe: Any, sensors: Iterable[str | None]) -> bool:
    """Whether a pipeline draws touches by these sensors, if that is what a table is of."""
    return name != "x-to-touch" or {*sensors} <= {*(pipe.config.sensors or ())}


def figures_of(
    names: Sequence[str], sets: "Sets", joint: "UniTouchModel", processor: Any, pipes: Mapping[str, Any], each: int
) -> tuple[dict[str, Figures], dict[str, Any]]:
    """Figures of each table, and images that were made for it."""
    import torch

    from unitouch_gen import weights
    from unitouch_gen.evaluation import generated, tables
    from unitouch_gen.evaluation.zero_shot import text_embeddings
    from unitouch_gen.models.classifier import ContactClassifier

    folders = {"image": weights.PICTURE_CLASSIFIER, "touch": weights.TOUCH_CLASSIFIER}
    read_by = {name: ContactClassifier.from_pretrained(place, dtype=torch.float32) for name, place in folders.items()}
    asking = {"material": tables.material_table, "grasp": tables.grasp_table, "prompts": tables.prompts_table}
    drawing = {"touch-to-image": generated.touch_to_image_table, "x-to-touch": generated.x_to_touch_table}
    made: dict[str, Figures] = {name: {} for name in names}
    images, drawn = dict[str, Any](), set[tuple[str, str, int]]()
    for sensor, known, seed, splits in sets:
        domain = "in domain" if known else "out of domain"
        for name in names:
            rows: dict[str, dict[str, float]]
            if name in asking:
                shares = asking[name](splits, lambda texts: text_embeddings(joint, processor, texts).cpu())
                rows = {row: {f"{sensor}, {domain}": share} for row, share in shares.items()}
            elif name == "retrieval":
                rows = {f"{row}, {domain}": values for row, values in tables.retrieval_table(splits).items()}
            elif (name, domain, seed) in drawn or not drawable(name, pipes[name], splits["test"].sensors):
                continue  # images take time, so they are of one sensor of each domain
            else:
                figures, shown = drawing[name](pipes[name], splits, read_by, each, seed)
                rows = {f"{row}, {domain}": values for row, values in figures.items()}
                drawn.add((name, domain, seed))
                images.setdefault(name, shown)
            for row, values in rows.items():
                for column, value in values.items():
                    made[name].setdefault(row, {}).setdefault(column, []).append(value)
    return made, images


def show(name: str, rows: Figures, facts: Mapping[str, Any], output: Path | None, images: Any) -> None:
    """Prints a table, and writes NAME.json, NAME.md and a grid NAME.png of images."""
    from diffusers.utils import make_image_grid, numpy_to_pil
    from torch import stack
    from torch.nn.functional import interpolate

    from unitouch_gen.files import write_file

    columns = list(dict.fromkeys(column for row in rows.values() for column in row))
    scale, digits = (1, 2) if name in GENERATED else (100, 1)

    def cell(values: Sequence[float]) -> str:
        spread = f" ({scale * (max(values) - min(values)):.{digits}f})" if len(values) > 1 else ""
        return f"{scale * mean(values):.{digits}f}{spread}" if values else ""

    lines = [[row, *(cell(values.get(column, ())) for column in columns)] for row, values in rows.items()]
    typer.echo(TABLES[name])
    options.print_table(["", *columns], lines)
    if output is None:
        return
    write_file("--output", output / f"{name}.json", json.dumps({"table": name, "rows": rows, **facts}, indent=2) + "\n")
    page = [f"| {' | '.join(line)} |" for line in (["", *columns], ["---"] * (len(columns) + 1), *lines)]
    page = [f"## {TABLES[name]}", "", *page, "", f"Means over worlds, in brackets their spread. {facts}"]
    if images:
        tiles = stack([interpolate(part[:12].float(), (128, 128)) for part in images.values()], dim=1)
        grid = make_image_grid(numpy_to_pil(tiles.flatten(0, 1).movedim(1, -1).numpy()), *tiles.shape[:2])
        grid.save(output / f"{name}.png")
        page += ["", f"From left to right: {', '.join(images)}.", "", f"![examples]({name}.png)"]
    write_file("--output", output / f"{name}.md", "\n".join(page) + "\n")
