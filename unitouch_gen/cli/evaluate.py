"""`unitouch-gen evaluate`: tables of the paper, on the world or on data sets, with controls."""

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
from unitouch_gen.errors import InvalidInputError, check_choice, check_number, check_unused
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
"""Tables of outputs of pipelines, and the pipelines."""

NAMED = ("gelsight", "gelsight_objectfolder", "digit")
"""Sensors of the paper's training sets, which a model may have been trained on."""

Rows = dict[str, dict[str, list[float]]]
"""Figures by row and column, one for each world."""


def evaluate(
    table: Annotated[str, Argument(help=f"{', '.join(TABLES)}.")],
    output: Annotated[Path | None, Option("--output", "-o", help="Folder for TABLE.json.")] = None,
    model: Annotated[str | None, Option(help=f"{options.A_FOLDER} a joint space or pipeline; or built-in.")] = None,
    data: Annotated[list[Path] | None, Option(help="Folder of a data set, not the world; repeatable.")] = None,
    kind: Annotated[str, Option(help="Layout of the data sets, such as touch_and_go; auto recognises it.")] = "auto",
    sensor: Annotated[str | None, Option(help="Sensor of all touches of the data sets.")] = None,
    materials: options.Materials = None,
    seeds: Annotated[int, Option(min=1, max=10_000, help="Number of worlds to average over.")] = 3,
    objects: Annotated[int, Option(min=2, max=10_000, help="Objects of each material in a world.")] = 8,
    scanned: Annotated[float, Option(min=0, max=1, help="Share of the world's objects that are scanned.")] = 0.0,
    recordings: Annotated[float, Option(min=0, max=1, help="Share of its sounds that are recorded hits.")] = 0.0,
    each: Annotated[int, Option(min=2, max=10_000, help="Contacts of each material to generate images for.")] = 4,
    cache: Annotated[Path | None, Option(help="Folder for rendered and decoded data.")] = None,
    device: options.Device = "auto",
    overwrite: options.Overwrite = False,
) -> None:
    """Makes a table of the paper, each figure beside chance, majority, plain statistics and an untrained encoder.

    Example: unitouch-gen evaluate material -o tables/
    """
    check_choice("table", table, TABLES)
    shares = {"scanned": scanned, "recordings": recordings}
    for name, share in shares.items():
        check_number(f"--{name}", share, 0.0, 1.0)
        if data:
            check_unused("with `--data`", **{f"--{name}": share or None})
    if model is not None and table in PIPELINES:
        kind_of(model, [PIPELINES[table]])
    from unitouch_gen.training.data import open_dataset
    from unitouch_gen.training.data.heldout import of_datasets, of_world

    if output is not None:
        options.check_output([output / f"{table}.json"], overwrite)
    material_names = options.by_comma(materials)
    data_sets = [open_dataset(folder, kind, sensor=sensor, materials=material_names) for folder in data or ()]
    pipe = load_pipeline(PIPELINES[table], model=model, device=device) if table in PIPELINES else None
    joint, processor = load_joint_space(model, device)
    check_table(table, joint, pipe, data_sets, each)
    with TemporaryDirectory(prefix="unitouch-") as scratch:
        cache_folder = cache or Path(scratch)
        started = time.perf_counter()
        if data_sets:
            sets = of_datasets(cache_folder, processor, data_sets)
        else:
            sensors = [name for name in NAMED if name in joint.config.sensors]
            grasps = table == "grasp"
            sets = of_world(cache_folder, processor, sensors, range(seeds), objects, grasps=grasps, **shares)
        rows = figures_of(table, sets, joint=joint, processor=processor, pipe=pipe, each=each)
    if output is not None:
        content = {
            "table": table,
            "rows": rows,
            **({} if data_sets else shares),
            "version": __version__,
            "model": model or "built-in",
            "seconds": round(time.perf_counter() - started),
        }
        write_file("--output", output / f"{table}.json", json.dumps(content, indent=2) + "\n")
    show(table, rows)
    if output is not None:
        echo(f"The table is in {output.resolve()}")


LABELS = {"material": "material", "prompts": "material", "grasp": "grasp"}
"""Labels that tables need."""


def check_table(name: str, joint: Any, pipe: Any, data_sets: Sequence[Any], each: int) -> None:
    """Raises for models and data sets that lack what a table needs, before their files are read."""
    modalities = {"touch-to-image": {"image"}, "caption": {"text"}}
    needed = {"text"} if name in LABELS else modalities.get(name, {"image", "audio", "text"})
    usable = needed & {*joint.known_modalities}
    if "touch" not in joint.known_modalities or not usable:
        wanted = " or ".join(sorted(needed))
        raise InvalidInputError(f"`--model` has no encoders of touch and {wanted}, which {name!r} needs.")
    if name == "x-to-touch":
        check_sensors(pipe, data_sets)
    for data in data_sets:
        check_data_set(name, data, usable, each)


def check_sensors(pipe: Any, data_sets: Sequence[Any]) -> None:
    """Raises if there are touches by sensors that a pipeline does not draw for."""
    drawable = {*(pipe.config.sensors or ())}
    sensors = drawable & {*NAMED}
    if data_sets:
        sensors = {record.sensor for data in data_sets for record in data.records}
    if not sensors or sensors - drawable:
        words = ", ".join(sorted(drawable))
        raise InvalidInputError(f"The touches are by sensors other than {words}, which `--model` draws for.")


def check_data_set(name: str, data: Any, usable: set[str], each: int) -> None:
    """Raises if a data set lacks classes, modalities or contacts that a table needs."""
    from unitouch_gen.training.data.heldout import modalities_of, parts_of

    parts = parts_of(data)
    if name in LABELS:
        for split, part in parts.items():
            check_classes(data, split, part, LABELS[name])
    elif not usable & {*modalities_of(data)}:
        raise InvalidInputError(f"{data} has no {' or '.join(sorted(usable))} of every touch.")
    test = parts["test"]
    least = each * len({record.labels.get("material") for record in test.records}) + 2
    if name in GENERATED and len(test) < least:
        raise InvalidInputError(f"{data} has {len(test)} contacts to test on; {name!r} needs {least}.")


def check_classes(data: Any, split: str, part: Any, label: str) -> None:
    """Raises if a split of a data set has fewer than two classes of a label, or unknown ones of grasps."""
    from unitouch_gen.evaluation.tables import GRASP_PROMPTS

    classes = {data.classes[label][record.labels[label]] for record in part.records if label in record.labels}
    if len(classes) < 2 or (label == "grasp" and not classes <= {*GRASP_PROMPTS}):
        wanted = " and ".join(GRASP_PROMPTS) if label == "grasp" else "two or more"
        has = f"{', '.join(sorted(classes)) or 'none'} of {label} to {split} on"
        raise InvalidInputError(f"{data} has the classes {has}, not {wanted}.")


def figures_of(table: str, sets: Any, joint: Any, processor: Any, pipe: Any, each: int) -> Rows:
    """Figures of a table by row and column, one for each world."""
    import torch

    from unitouch_gen import weights
    from unitouch_gen.evaluation import generated, tables
    from unitouch_gen.evaluation.answers import caption_table
    from unitouch_gen.evaluation.features import embed_all
    from unitouch_gen.models.classifier import ContactClassifier
    from unitouch_gen.models.features import text_embeddings

    def embed(texts: Sequence[str]) -> torch.Tensor:
        return text_embeddings(joint, processor, texts).cpu()

    folders = {"image": weights.PICTURE_CLASSIFIER, "touch": weights.TOUCH_CLASSIFIER}
    classifiers = {
        name: ContactClassifier.from_pretrained(folder, dtype=torch.float32) for name, folder in folders.items()
    }
    by_label = {"material": tables.material_table, "grasp": tables.grasp_table, "prompts": tables.prompts_table}
    by_images = {"touch-to-image": generated.touch_to_image_table, "x-to-touch": generated.x_to_touch_table}
    rows: Rows = {}
    generated_for = set[tuple[str, int]]()
    for sensor, seed, splits in sets:
        embed_all(joint, processor, splits, classifiers["touch"])
        sensors = {name for contacts in splits.values() for name in contacts.sensors}
        domain = "in domain" if sensors <= {*joint.config.sensors} else "out of domain"
        if table in by_label:
            accuracies = by_label[table](splits, embed)
            figures = {row: {f"{sensor}, {domain}": accuracy} for row, accuracy in accuracies.items()}
        elif table == "retrieval":
            figures = tables.retrieval_table(splits)
        elif table == "caption":
            figures = caption_table(pipe, splits, embed, each)
        else:
            # Images take time, so they are generated for one sensor of each domain and world.
            is_drawable = table != "x-to-touch" or {*splits["test"].sensors} <= {*pipe.config.sensors}
            if (domain, seed) in generated_for or not is_drawable:
                continue
            generated_for.add((domain, seed))
            figures = by_images[table](pipe, splits, classifiers, each, seed)
        for row, values in figures.items():
            columns = rows.setdefault(row if table in by_label else f"{row}, {domain}", {})
            for column, value in values.items():
                columns.setdefault(column, []).append(value)
    return rows


def show(table: str, rows: Rows) -> None:
    """Prints a table of means over worlds, with their spread in brackets."""
    columns = list(dict.fromkeys(column for row in rows.values() for column in row))
    scale, digits = (1, 2) if table in GENERATED else (100, 1)

    def cell(values: Sequence[float]) -> str:
        if not values:
            return ""
        spread = f" ({scale * (max(values) - min(values)):.{digits}f})" if len(values) > 1 else ""
        return f"{scale * mean(values):.{digits}f}{spread}"

    echo(TABLES[table])
    lines = [[row, *(cell(values.get(column, ())) for column in columns)] for row, values in rows.items()]
    options.print_table(["", *columns], lines)
