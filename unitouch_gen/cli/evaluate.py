"""`unitouch-gen evaluate`: tables of the paper, on the world or on data sets, each figure beside its controls."""

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from unitouch_gen import __version__
from unitouch_gen.cli import options
from unitouch_gen.cli.data import BGR, Pattern, patterns_of
from unitouch_gen.cli.loading import load_joint_space
from unitouch_gen.errors import InvalidInputError, check_choice, check_integer

if TYPE_CHECKING:
    from unitouch_gen.evaluation.contacts import EvaluationSet
    from unitouch_gen.evaluation.tables import Table
    from unitouch_gen.models import UniTouchModel

OF_WORLD = ("material", "prompts", "retrieval", "grasp")
TABLES = (*OF_WORLD, "real")

ASKED_IN_WORDS = ("material", "prompts", "grasp")
"""Tables that have a row of zero-shot classification."""

NAMED = ("gelsight", "gelsight_objectfolder", "digit")
"""Sensors of the world that a model may have been trained on: those of the paper's training sets."""


def evaluate(
    table: Annotated[str, typer.Argument(help=f"{', '.join(TABLES)}; or all, those of the world.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for JSON, Markdown, charts and a page of them.")
    ] = None,
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
    cache: Annotated[
        Path | None, typer.Option(help="Folder of what is rendered and embedded; one in the output if left out.")
    ] = None,
    device: options.Device = "auto",
    overwrite: options.Overwrite = False,
) -> None:
    """Makes tables of the paper, each figure beside chance, majority, plain statistics and an untrained encoder.

    Example: unitouch-gen evaluate material -o tables/
    """
    from unitouch_gen.evaluation.tables import Table, page
    from unitouch_gen.files import check_writable, write_file
    from unitouch_gen.training.data import open_dataset
    from unitouch_gen.training.data.embedded import folder_set, listed_set

    check_choice("table", table, (*TABLES, "all"))
    check_integer("--seeds", seeds, 1, 100), check_integer("--objects", objects, 2, 100)
    if table == "real" and not data:
        raise InvalidInputError("`real` is of real touches, and none came; pass `--data FOLDER`, with labels.")
    names = OF_WORLD if table == "all" else (table,)
    layout: dict[str, Any] = {"kind": kind, "sensor": sensor, "patterns": patterns_of(pattern), "bgr": bgr}
    layout["materials"] = None if materials is None else [name.strip() for name in materials.split(",")]
    if output is not None:
        if not overwrite:
            options.check_new([output / f"{name}.json" for name in names])
        check_writable("--output", output / f"{table}.json")
    before = [] if output is None else [Table.read(output / f"{name}.json") for name in _others(output, names)]
    joint, processor = load_joint_space(model, device)
    check_modalities(joint, names)
    folders = [open_dataset(folder, **layout) for folder in data or ()]
    for name in names if folders else ():
        check_sets(name, [listed_set(joint, folder, whole=name == "real") for folder in folders])
    made: list[Table] = []
    with _cache(cache, output) as place:
        for name in names:
            started = time.perf_counter()
            sets = (
                [folder_set(joint, processor, folder, place, whole=name == "real") for folder in folders]
                if folders
                else _of_worlds(joint, processor, seeds, objects, textures, place, grasps=name == "grasp")
            )
            found = _table(name, sets, joint, processor)
            facts = {
                "unitouch_gen": __version__,
                "model": str(model or "built-in"),
                "seeds": list(dict.fromkeys(one.seed for one in sets)),
                "sets": {f"{one.name}, seed {one.seed}": one.fingerprint for one in sets},
                "seconds": round(time.perf_counter() - started, 1),
            }
            made.append(replace(found, facts=facts))
            show(made[-1])
            if output is not None:
                made[-1].write(output)
    if output is not None:
        tables = sorted([*before, *made], key=lambda one: TABLES.index(one.name))
        write_file("--output", output / "index.html", page(tables))
        typer.echo(f"The tables are in {output.resolve()}")


@contextmanager
def _cache(cache: Path | None, output: Path | None) -> Iterator[Path]:
    """The folder named, one in the output, or one that goes when the command ends."""
    if cache is not None or output is not None:
        place = cache or output / "cache"  # type: ignore[operator]
        os.makedirs(place, exist_ok=True)
        yield place
        return
    with TemporaryDirectory(prefix="unitouch-") as scratch:
        yield Path(scratch)


def _of_worlds(
    joint: Any, processor: Any, seeds: int, objects: int, textures: Path | None, cache: Path, grasps: bool
) -> "list[EvaluationSet]":
    """Contacts by sensors that the model knows, and by sensors drawn anew, of each seed."""
    from unitouch_gen.training.data.embedded import FIRST_SEED, world_set

    sensors = [*(name for name in NAMED if name in joint.sensors), None]
    settings: dict[str, Any] = {"objects": objects, "textures": textures and str(textures), "grasps": grasps}
    return [
        world_set(joint, processor, sensor, FIRST_SEED + number, cache, **settings)
        for number in range(seeds)
        for sensor in sensors
    ]


def _others(output: Path, names: Sequence[str]) -> list[str]:
    """Tables that are in a folder already, and are not to be made."""
    return [name for name in TABLES if name not in names and (output / f"{name}.json").is_file()]


def check_modalities(joint: "UniTouchModel", names: Sequence[str]) -> None:
    """Refuses a joint space that lacks what tables ask of it.

    Raises:
        InvalidInputError: If it does.
    """
    asked = {"touch": list(names), "text": [name for name in names if name in ASKED_IN_WORDS]}
    for modality, tables in asked.items():
        if tables and modality not in joint.known_modalities:
            raise InvalidInputError(
                f"`--model` has no {modality} encoder, which {tables[0]!r} asks; name a joint space that has one."
            )


def check_sets(name: str, sets: "Sequence[EvaluationSet]") -> None:
    """Refuses data sets that a table cannot be of, before their files are read.

    Raises:
        InvalidInputError: If one lacks a label, has a single class of it, or there are more than the table is of.
    """
    from unitouch_gen.evaluation import classification, cross_modal, real

    if name == "real":
        if len(sets) > 1:
            raise InvalidInputError("`--data` came several times, and `real` is of one data set; pass one.")
        real.labelled_alike(sets[0])
    elif name == "retrieval":
        cross_modal.check_modalities(sets)
    elif name == "grasp":
        classification.check_grasps(sets)
    else:
        classification.check_labels(sets, "material", ("test",) if name == "prompts" else classification.SPLITS)


def _table(name: str, sets: "list[EvaluationSet]", joint: Any, processor: Any) -> "Table":
    from functools import partial

    from unitouch_gen.evaluation import classification
    from unitouch_gen.evaluation.cross_modal import retrieval_table
    from unitouch_gen.evaluation.real import real_table
    from unitouch_gen.evaluation.zero_shot import text_embeddings

    if name == "retrieval":
        return retrieval_table(sets)
    if name == "real":
        return real_table(sets[0])
    make = {
        "material": classification.material_table,
        "prompts": classification.prompts_table,
        "grasp": classification.grasp_table,
    }[name]
    return make(sets, partial(text_embeddings, joint, processor))


def show(table: "Table") -> None:
    """Prints a table as wide as the terminal."""
    typer.echo(f"{table.title}: {table.metric}")
    options.print_table(*table.cells())
