"""`unitouch-gen evaluate`: tables of the paper, on the world or on data sets, each figure beside its controls."""

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from unitouch_gen import __version__
from unitouch_gen.cli import options
from unitouch_gen.cli.data import BGR, Pattern, patterns_of
from unitouch_gen.cli.loading import kind_of, load_joint_space, load_pipeline
from unitouch_gen.errors import InvalidInputError, check_choice, check_integer

if TYPE_CHECKING:
    from unitouch_gen.cli.generated import Generation
    from unitouch_gen.evaluation.contacts import EvaluationSet
    from unitouch_gen.evaluation.tables import Table
    from unitouch_gen.models import UniTouchModel, UniTouchProcessor
    from unitouch_gen.training.data import RecordSet
    from unitouch_gen.training.data.held import Held

OF_TOUCHES = ("material", "grasp", "retrieval", "prompts")
"""Tables of what encoders make of touches: of the world, or of data sets."""

GENERATED = ("touch-to-image", "x-to-touch")
"""Tables of what pipelines make of contacts: of the world, or of a data set."""

OF_WORLD = (*OF_TOUCHES, *GENERATED)
TABLES = (*OF_WORLD, "real")

ASKED_IN_WORDS = ("material", "prompts", "grasp")
"""Tables that have a row of zero-shot classification."""

NAMED = ("gelsight", "gelsight_objectfolder", "digit")
"""Sensors of the world that a model may have been trained on: those of the paper's training sets."""


def evaluate(
    table: Annotated[str, typer.Argument(help=f"{', '.join(TABLES)}; or all, those of the world.")],
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
    each: Annotated[
        int,
        typer.Option(help="Contacts of each material, or of all if unlabelled, that images are made of."),
    ] = 4,
    inception: Annotated[
        Path | None, typer.Option(help="TorchScript of the Inception network, inception-2015-12-05.pt, for FIDs.")
    ] = None,
    beside: Annotated[
        list[str] | None,
        typer.Option(help="Another joint space, such as a converted one, whose touches `real` reads, too; repeatable."),
    ] = None,
    cache: Annotated[
        Path | None, typer.Option(help="Folder of what is rendered and embedded; one in the output if left out.")
    ] = None,
    device: options.Device = "auto",
    overwrite: options.Overwrite = False,
) -> None:
    """Makes tables of the paper, each figure beside chance, majority, plain statistics and an untrained encoder.

    Example: unitouch-gen evaluate material -o tables/
    """
    from unitouch_gen.evaluation.tables import Table, draw_examples, summary
    from unitouch_gen.files import check_writable, write_file
    from unitouch_gen.training.data import open_dataset
    from unitouch_gen.training.data.embedded import folder_set

    check_choice("table", table, (*TABLES, "all"))
    check_integer("--seeds", seeds, 1, 100), check_integer("--objects", objects, 2, 100)
    check_integer("--each", each, 1, 10_000)
    if table == "real" and not data:
        raise InvalidInputError("`real` is of real touches, and none came; pass `--data FOLDER`, with labels.")
    if beside and table != "real":
        raise InvalidInputError(
            f"`--beside` came, and {table!r} has no row of it; pass it with `real`, or leave it out."
        )
    if inception is not None and not inception.is_file():
        raise InvalidInputError(f"`--inception` is {str(inception)!r}, which is no file; name inception-2015-12-05.pt.")
    layout: dict[str, Any] = {"kind": kind, "sensor": sensor, "patterns": patterns_of(pattern), "bgr": bgr}
    layout["materials"] = None if materials is None else [name.strip() for name in materials.split(",")]
    names = asked_for(table, model, bool(data))
    if output is not None:
        if not overwrite:
            options.check_new([output / f"{name}.json" for name in names])
        check_writable("--output", output / f"{table}.json")
    others = [] if output is None else [output / f"{name}.json" for name in TABLES if name not in names]
    before = [Table.read(file) for file in others if file.is_file()]
    pipes = {name: _pipeline(name, model, device) for name in names if name in GENERATED}
    joint, processor = load_joint_space(model, device)
    check_modalities(joint, names)
    compared = {name: load_joint_space(name, device, "--beside") for name in beside or ()}
    for other, _ in compared.values():
        check_modalities(other, names, "--beside")
    if not data and any(name in GENERATED for name in names):
        check_sensors(joint, pipes)
    folders = [open_dataset(folder, **layout) for folder in data or ()]
    check = partial(check_folders, joint=joint, folders=folders, pipes=pipes, each=each)
    if folders and table == "all":
        names = [name for name in names if _allowed(name, check)]
    for name in names if folders else ():
        check(name)
    made: list[Table] = []
    with _cache(cache, output) as place:
        scans = None if textures is None else str(textures)
        worlds = Worlds(joint, processor, place, seeds, objects, scans, each, inception)
        for name in names:
            started = time.perf_counter()
            if folders:
                sets = [folder_set(joint, processor, folder, place, _splits(name)) for folder in folders]
                if name == "real":
                    found = _real(sets[0], folders[0], compared, place)
                elif name in GENERATED:
                    found = worlds.of_folder(name, pipes[name], folders[0], sets[0])
                else:
                    found = worlds.of_touches(name, sets)
            else:
                sets = worlds.sets
                found = worlds.table(name, sets, pipes.get(name))
            facts = {
                "version": __version__,
                "model": str(model or "built-in"),
                "seeds": list(dict.fromkeys(one.seed for one in sets)),
                "sets": {f"{one.name}, seed {one.seed}": one.fingerprint for one in sets},
                "seconds": round(time.perf_counter() - started, 1),
            }
            grid = worlds.examples.get(name) if output is not None else None
            made.append(replace(found, facts={**found.facts, **facts}, examples=grid is not None))
            show(made[-1])
            if output is not None:
                if grid is not None:
                    draw_examples(output / f"{name}.examples.png", grid)
                made[-1].write(output)
    if output is not None:
        tables = sorted([*before, *made], key=lambda one: TABLES.index(one.name))
        write_file("--output", output / "summary.md", summary(tables))
        typer.echo(f"The tables are in {output.resolve()}")


def asked_for(table: str, model: str | None, of_data: bool) -> list[str]:
    """The tables to make: the one, or all that there can be of a model.

    Raises:
        InvalidInputError: If the one is of pipelines, and the model is none of its kind.
    """
    if table in GENERATED and model is not None and kind_of(model) != table:
        raise InvalidInputError(
            f"`--model` is {model!r}, which is a pipeline for {kind_of(model)}; name one of {table}."
        )
    if table != "all":
        return [table]
    kinds = GENERATED if model is None else (kind_of(model),) if (Path(model) / "model_index.json").is_file() else ()
    if of_data:
        return [name for name in TABLES if name in (*OF_TOUCHES, *kinds, "real")]
    return [name for name in OF_WORLD if name not in GENERATED or name in kinds]


def _placed(row: str, where: str) -> str:
    """A row with the sensors that it is of before what is made, as a control's name begins with what it is beside."""
    what, *control = row.split(": ")
    return ": ".join([f"{what}, {where}", *control])


def _pipeline(name: str, model: str | None, device: str) -> Any:
    pipe = load_pipeline(name, model, quiet=True, device=device)
    pipe.set_progress_bar_config(disable=True)
    return pipe


@dataclass
class Worlds:
    """Contacts of several worlds, and what a call's tables make of them.

    Attributes:
        joint, processor: What is held against them.
        cache: Folder of all that is computed once.
        seeds, objects, textures, each, inception: Options of the command.
        examples: Images of the first seed by name, of tables that were made and have some.
    """

    joint: "UniTouchModel"
    processor: "UniTouchProcessor"
    cache: Path
    seeds: int
    objects: int
    textures: str | None
    each: int
    inception: Path | None
    examples: "dict[str, Mapping[str, Any]]" = field(default_factory=dict)

    @property
    def sensors(self) -> list[str]:
        """Those by name that the joint space knows."""
        return [name for name in NAMED if name in self.joint.sensors]

    @cached_property
    def splits(self) -> "list[dict[str, Held]]":
        """Contacts by each sensor that the joint space knows, and by sensors drawn anew, of each seed."""
        from unitouch_gen.training.data.embedded import FIRST_SEED, world_source, world_splits

        sources = [
            world_source(sensor, FIRST_SEED + number, self.objects, self.textures)
            for number in range(self.seeds)
            for sensor in (*self.sensors, None)
        ]
        return [world_splits(self.cache, self.processor, source) for source in sources]

    @cached_property
    def sets(self) -> "list[EvaluationSet]":
        """The same embedded, with the features of a classifier that was trained with labels."""
        from unitouch_gen.training.data.embedded import with_classifier, world_set

        sets = [world_set(self.joint, self.processor, splits, self.cache, grasps=True) for splits in self.splits]
        return [with_classifier(one, splits, self.cache) for one, splits in zip(sets, self.splits, strict=True)]

    def embed(self, texts: Sequence[str]) -> Any:
        """Unit embeddings (N, D) of texts."""
        from unitouch_gen.evaluation.zero_shot import text_embeddings

        return text_embeddings(self.joint, self.processor, texts).cpu()  # as all features are

    def table(self, name: str, sets: "Sequence[EvaluationSet]", pipe: Any) -> "Table":
        """One of `OF_WORLD`; `pipe` is the pipeline that a table of generated images is of."""
        if name in GENERATED:
            return self._of_generated(name, [self._generated(name, pipe, number) for number in range(self.seeds)])
        return self.of_touches(name, sets)

    def of_touches(self, name: str, sets: "Sequence[EvaluationSet]") -> "Table":
        """One of `OF_TOUCHES`, made once for each state of the features that it is of, and of what makes it."""
        from unitouch_gen import evaluation
        from unitouch_gen.evaluation import classification
        from unitouch_gen.evaluation.cross_modal import retrieval_table
        from unitouch_gen.evaluation.tables import Table
        from unitouch_gen.files import write_file
        from unitouch_gen.training.data.embedded import encoder_hash

        settings = [name, *((one.name, one.known, one.classes, one.seed) for one in sets)]
        digest = hashlib.sha256(repr(settings).encode())
        for one in sets:
            for split, part in one.splits.items():
                for what, values in {**part.features, **part.labels, "objects": part.objects}.items():
                    digest.update(f"{split} {what} {tuple(values.shape)}".encode())
                    digest.update(values.contiguous().numpy().tobytes())
        if "text" in self.joint.known_modalities:
            digest.update(encoder_hash(self.joint, "text").encode())
            digest.update(self.embed(classification.TEMPLATES).numpy().tobytes())  # by its tokenizer
        for code in sorted(Path(evaluation.__path__[0]).glob("*.py")):
            digest.update(code.read_bytes())
        state = digest.hexdigest()[:16]
        file = self.cache / f"table-{name}-{state}.json"
        if not file.is_file():
            make = {
                "material": classification.material_table,
                "prompts": classification.prompts_table,
                "grasp": classification.grasp_table,
            }
            table = retrieval_table(sets) if name == "retrieval" else make[name](sets, self.embed)
            write_file("--cache", file, json.dumps(asdict(table)))
        return Table.read(file)

    def of_folder(self, name: str, pipe: Any, folder: "RecordSet", one: "EvaluationSet") -> "Table":
        """One of `GENERATED`, of the test split of a data set; what is fitted is of its training split."""
        from unitouch_gen.cli.generated import picture_figures, touch_figures
        from unitouch_gen.training.data.embedded import record_splits, with_classifier

        setting, splits = self._setting(pipe), record_splits(self.cache, self.processor, folder, tuple(one.splits))
        if name == "x-to-touch":
            figures, self.examples[name] = touch_figures(setting, splits)
        else:
            one = with_classifier(one, splits, self.cache)
            figures, self.examples[name] = picture_figures(setting, splits, one, [one])
        return self._of_generated(name, [figures], folder.name)

    def _of_generated(self, name: str, figures: Sequence[Any], data: str | None = None) -> "Table":
        from unitouch_gen.evaluation.generated import touch_to_image_table, x_to_touch_table

        if name == "x-to-touch":
            return x_to_touch_table(figures, data)
        return touch_to_image_table(figures, self.inception is not None, data)

    def _setting(self, pipe: Any) -> "Generation":
        from unitouch_gen.cli.generated import Generation

        return Generation(pipe, self.processor, self.cache, self.each, self.inception)

    def _generated(self, name: str, pipe: Any, number: int) -> Any:
        """Measures of one seed: of a sensor that the joint space knows, and of sensors drawn anew."""
        from unitouch_gen.cli.generated import picture_figures, touch_figures

        setting = self._setting(pipe)
        of_seed = range(number * (len(self.sensors) + 1), (number + 1) * (len(self.sensors) + 1))
        if name == "x-to-touch":
            known = next(place for place in of_seed if self.splits[place]["test"].source.sensor in pipe.config.sensors)
            figures, images = touch_figures(setting, self.splits[known])
            self.examples.setdefault(name, images)
            return figures
        pairs = [self.sets[place] for place in of_seed[:-1] if "image" in self.joint.known_modalities]
        found: dict[str, Any] = {}
        for where, place in {"in domain": of_seed[0], "out of domain": of_seed[-1]}.items():
            figures, images = picture_figures(setting, self.splits[place], self.sets[place], pairs)
            self.examples.setdefault(name, images)
            found |= {_placed(row, where): measures for row, measures in figures.items()}
        return found


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


def check_sensors(joint: "UniTouchModel", pipes: Mapping[str, Any]) -> None:
    """Refuses models that know none of the world's sensors, for tables that are of known ones.

    Raises:
        InvalidInputError: If they do not.
    """
    known = [name for name in NAMED if name in joint.sensors]
    if not known:
        raise InvalidInputError(
            f"`--model` knows none of the world's sensors {', '.join(NAMED)}; pass `--data` with touches of its own."
        )
    if (pipe := pipes.get("x-to-touch")) is not None and not set(known) & set(pipe.config.sensors or ()):
        raise InvalidInputError(f"`--model` draws touches by none of {', '.join(known)}, which the world feels by.")


def check_modalities(joint: "UniTouchModel", names: Sequence[str], option: str = "--model") -> None:
    """Refuses a joint space that lacks what tables ask of it.

    Raises:
        InvalidInputError: If it does.
    """
    asked = {"touch": list(names), "text": [name for name in names if name in ASKED_IN_WORDS]}
    for modality, tables in asked.items():
        if tables and modality not in joint.known_modalities:
            raise InvalidInputError(
                f"`{option}` has no {modality} encoder, which {tables[0]!r} asks; name a joint space that has one."
            )


def check_sets(name: str, sets: "Sequence[EvaluationSet]") -> None:
    """Refuses data sets that a table cannot be of, before their files are read.

    Raises:
        InvalidInputError: If one lacks a label, has a single class of it, or there are more than the table is of.
    """
    from unitouch_gen.evaluation import classification, cross_modal, real

    if name in (*GENERATED, "real") and len(sets) > 1:
        raise InvalidInputError(f"`--data` came several times, and {name!r} is of one data set; pass one.")
    if name == "real":
        real.labelled_alike(sets[0])
    elif name == "retrieval":
        cross_modal.check_modalities(sets)
    elif name == "grasp":
        classification.check_grasps(sets)
    elif name in OF_TOUCHES:
        classification.check_labels(sets, "material", ("test",) if name == "prompts" else classification.SPLITS)


def check_folders(
    name: str, joint: "UniTouchModel", folders: "Sequence[RecordSet]", pipes: Mapping[str, Any], each: int
) -> None:
    """Refuses data sets that a table cannot be of, before their files are read.

    Raises:
        InvalidInputError: If they cannot be split, or see `check_sets` and `check_held`.
    """
    from unitouch_gen.cli.generated import check_held
    from unitouch_gen.training.data.embedded import listed_set

    sets = [listed_set(joint, folder, _splits(name)) for folder in folders]
    check_sets(name, sets)
    if name in GENERATED:
        check_held(name, folders[0], sets[0], pipes[name], each)


def _splits(name: str) -> Sequence[str]:
    """Splits of data sets that a table is of; none if it is of the whole."""
    from unitouch_gen.evaluation.contacts import SPLITS

    return () if name == "real" else ("train", "test") if name in GENERATED else SPLITS


def _allowed(name: str, check: Callable[[str], None]) -> bool:
    """Whether a table can be of data sets; where not, why goes to standard error."""
    try:
        check(name)
    except InvalidInputError as error:
        options.note(f"No table {name!r}: {error}")
        return False
    return True


def _real(
    one: "EvaluationSet",
    folder: "RecordSet",
    compared: "Mapping[str, tuple[UniTouchModel, UniTouchProcessor]]",
    cache: Path,
) -> "Table":
    """The table "real", with rows of other joint spaces by what they were named by."""
    from unitouch_gen.evaluation.real import real_table
    from unitouch_gen.training.data.embedded import with_joint_space

    for name, space in compared.items():
        one = with_joint_space(one, folder, f"beside {name}", *space, cache)
    return real_table(one, {f"beside {name}": f"touch encoder of {_short(name)}, probe" for name in compared})


def _short(name: str) -> str:
    """The last two parts of a place."""
    return "/".join(Path(name).resolve().parts[-2:]) if Path(name).exists() else name


def show(table: "Table") -> None:
    """Prints a table as wide as the terminal."""
    typer.echo(f"{table.title}: {table.metric}")
    options.print_table(*table.cells())
