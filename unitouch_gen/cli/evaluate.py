"""`unitouch-gen evaluate`: tables of the paper, on the world or on data sets, each figure beside its controls."""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import mean
from tempfile import TemporaryDirectory
from typing import Annotated, Any

from typer import Argument, Option, echo

from unitouch_gen import __version__
from unitouch_gen.cli import options
from unitouch_gen.cli.loading import kind_of, load_joint_space, load_pipeline
from unitouch_gen.errors import InvalidInputError, check_choice
from unitouch_gen.files import write_file

TABLES = {
    "material": "Material of touches (Table 2): accuracy, %",
    "grasp": "Whether a grasp holds (Table 3): balanced accuracy, %",
    "retrieval": "Pictures, sounds and captions of an object, found by touch (Table 4): mean average precision, %",
    "prompts": "Six ways to ask for a material (Table 7): zero-shot accuracy, %",
    "touch-to-image": "Pictures of touches (Table 5)",
    "x-to-touch": "Touches of pictures, captions, sounds and other touches (Section 4.8)",
    "caption": "Answers about touches (Section 4.6): right, %",
}
GENERATED = ("touch-to-image", "x-to-touch")
PIPELINES = {**{name: name for name in GENERATED}, "caption": "touch-to-text"}
"""Tables of what pipelines make, and which ones."""

NAMED = ("gelsight", "gelsight_objectfolder", "digit")
"""Sensors of the world that a model may have been trained on: those of the paper's training sets."""

Rows = dict[str, dict[str, list[float]]]
"""Figures by row and column, one for each world."""


def evaluate(
    table: Annotated[str, Argument(help=f"{', '.join(TABLES)}.")],
    output: Annotated[Path | None, Option("--output", "-o", help="Folder for TABLE.json.")] = None,
    model: Annotated[str | None, Option(help=f"{options.A_FOLDER} a joint space or pipeline; or built-in.")] = None,
    data: Annotated[list[Path] | None, Option(help="Folder of a data set, not the world; repeatable.")] = None,
    kind: Annotated[str, Option(help="Layout of the data sets, such as touch_and_go; or auto, to see.")] = "auto",
    sensor: Annotated[str | None, Option(help="Sensor of all touches of the data sets.")] = None,
    materials: options.Materials = None,
    seeds: Annotated[int, Option(min=1, max=10_000, help="Worlds that figures are means over.")] = 3,
    objects: Annotated[int, Option(min=2, max=10_000, help="Objects of each material of a world.")] = 8,
    each: Annotated[int, Option(min=2, max=10_000, help="Contacts of each material that images are made of.")] = 4,
    cache: Annotated[Path | None, Option(help="Folder to keep what is rendered and decoded in.")] = None,
    device: options.Device = "auto",
    overwrite: options.Overwrite = False,
) -> None:
    """Makes a table of the paper, each figure beside chance, majority, plain statistics and an untrained encoder.

    Example: unitouch-gen evaluate material -o tables/
    """
    check_choice("table", table, TABLES)
    if model is not None and table in PIPELINES:
        kind_of(model, [PIPELINES[table]])
    from unitouch_gen.training.data import open_dataset
    from unitouch_gen.training.data.heldout import of_datasets, of_world

    if output is not None:
        options.check_output([output / f"{table}.json"], overwrite)
    given: Any = {"sensor": sensor, "materials": options.by_comma(materials)}
    folders = [open_dataset(folder, kind, **given) for folder in data or ()]
    pipe = load_pipeline(PIPELINES[table], model=model, device=device) if table in PIPELINES else None
    joint, processor = load_joint_space(model, device)
    check_table(table, joint, pipe, folders, each)
    with TemporaryDirectory(prefix="unitouch-") as scratch:
        place = cache or Path(scratch)
        started = time.perf_counter()
        if folders:
            sets = of_datasets(place, joint, processor, folders)
        else:
            known = [name for name in NAMED if name in joint.config.sensors]
            sets = of_world(place, joint, processor, known, range(seeds), objects, grasps=table == "grasp")
        rows = figures_of(table, sets, joint, processor, pipe, each)
    if output is not None:
        facts = {"version": __version__, "model": model or "built-in", "seconds": round(time.perf_counter() - started)}
        content = json.dumps({"table": table, "rows": rows, **facts}, indent=2)
        write_file("--output", output / f"{table}.json", content + "\n")
    show(table, rows)
    if output is not None:
        echo(f"The table is in {output.resolve()}")


def check_table(name: str, joint: Any, pipe: Any, folders: Sequence[Any], each: int) -> None:
    """Refuses models and data sets that lack what a table needs, before their files are read."""
    from unitouch_gen.evaluation.tables import GRASP_PROMPTS
    from unitouch_gen.training.data.heldout import modalities_of, parts_of

    label = {"material": "material", "prompts": "material", "grasp": "grasp"}.get(name, "")
    needed = {"touch-to-image": {"image"}, "caption": {"text"}}
    asked = {"text"} if label else needed.get(name, {"image", "audio", "text"})
    usable = asked & {*joint.known_modalities}
    if "touch" not in joint.known_modalities or not usable:
        wanted = " or ".join(sorted(asked))
        raise InvalidInputError(f"`--model` has no encoders of touch and {wanted}, which {name!r} needs.")
    if name == "x-to-touch":
        known = {*(pipe.config.sensors or ())}
        felt = {record.sensor for data in folders for record in data.records} if folders else known & {*NAMED}
        if not felt or felt - known:
            words = ", ".join(sorted(known))
            raise InvalidInputError(f"The touches are by sensors other than {words}, which `--model` draws for.")
    for data in folders:
        parts = parts_of(data)
        for split, part in parts.items() if label else ():
            found = {data.classes[label][r.labels[label]] for r in part.records if label in r.labels}
            if len(found) < 2 or (label == "grasp" and not found <= {*GRASP_PROMPTS}):
                wanted = " and ".join(GRASP_PROMPTS) if label == "grasp" else "two or more"
                has = f"{', '.join(sorted(found)) or 'none'} of {label} to {split} on"
                raise InvalidInputError(f"{data} has the classes {has}, not {wanted}.")
        if not label and not usable & {*modalities_of(data)}:
            raise InvalidInputError(f"{data} has no {' or '.join(sorted(usable))} of every touch.")
        least = each * len({record.labels.get("material") for record in parts["test"].records}) + 2
        if name in GENERATED and len(parts["test"]) < least:
            raise InvalidInputError(f"{data} has {len(parts['test'])} contacts to test on; {name!r} needs {least}.")


def figures_of(table: str, sets: Any, joint: Any, processor: Any, pipe: Any, each: int) -> Rows:
    """Figures of a table by row and column, one for each world."""
    import torch

    from unitouch_gen import weights
    from unitouch_gen.evaluation import generated, tables
    from unitouch_gen.evaluation.answers import caption_table
    from unitouch_gen.evaluation.zero_shot import text_embeddings
    from unitouch_gen.models.classifier import ContactClassifier

    def embed(texts: Sequence[str]) -> torch.Tensor:
        return text_embeddings(joint, processor, texts).cpu()

    folders = {"image": weights.PICTURE_CLASSIFIER, "touch": weights.TOUCH_CLASSIFIER}
    judges = {name: ContactClassifier.from_pretrained(place, dtype=torch.float32) for name, place in folders.items()}
    asking = {"material": tables.material_table, "grasp": tables.grasp_table, "prompts": tables.prompts_table}
    drawing = {"touch-to-image": generated.touch_to_image_table, "x-to-touch": generated.x_to_touch_table}
    rows: Rows = {}
    drawn = set[tuple[str, int]]()
    for sensor, known, seed, splits in sets:
        domain = "in domain" if known else "out of domain"
        if table in asking:
            found = {row: {f"{sensor}, {domain}": share} for row, share in asking[table](splits, embed).items()}
        elif table == "retrieval":
            found = tables.retrieval_table(splits)
        elif table == "caption":
            found = caption_table(pipe, splits, embed, each)
        else:
            felt = {*splits["test"].sensors}
            if (domain, seed) in drawn or (table == "x-to-touch" and not felt <= {*pipe.config.sensors}):
                continue
            drawn.add((domain, seed))  # images take time, so they are of one sensor of each domain
            found = drawing[table](pipe, splits, judges, each, seed)
        for row, values in found.items():
            columns = rows.setdefault(row if table in asking else f"{row}, {domain}", {})
            for column, value in values.items():
                columns.setdefault(column, []).append(value)
    return rows


def show(table: str, rows: Rows) -> None:
    """Prints a table: means over worlds, in brackets their spread."""
    columns = list(dict.fromkeys(column for row in rows.values() for column in row))
    scale, digits = (1, 2) if table in GENERATED else (100, 1)

    def cell(values: Sequence[float]) -> str:
        spread = f" ({scale * (max(values) - min(values)):.{digits}f})" if len(values) > 1 else ""
        return f"{scale * mean(values):.{digits}f}{spread}" if values else ""

    echo(TABLES[table])
    lines = [[row, *(cell(values.get(column, ())) for column in columns)] for row, values in rows.items()]
    options.print_table(["", *columns], lines)
