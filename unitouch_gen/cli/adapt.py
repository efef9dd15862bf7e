"""`unitouch-gen adapt`: a sensor of one's own."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option, echo

from unitouch_gen.cli.options import Overwrite, check_output, note
from unitouch_gen.errors import InvalidInputError


def adapt(
    path: Annotated[Path, Argument(help="Folder of touches; with photos, folders touch and picture.", metavar="DIR")],
    sensor: Annotated[str, Option(help="Name for the sensor.")],
    output: Annotated[Path | None, Option("--output", "-o", help="SENSOR.safetensors if left out.")] = None,
    model: Annotated[Path | None, Option(help="Folder of a joint space; the built-in one if left out.")] = None,
    kind: Annotated[str, Option(help="Layout of the folder, such as touch_and_go; or auto, to see.")] = "auto",
    steps: Annotated[int, Option(min=1, max=10**6, help="Steps of learning.")] = 300,
    seed: Annotated[int, Option(min=0, max=2**32, help="Of the batches and the noise.")] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Learns a sensor from a folder of its touches, in minutes; writes a small file for --load-sensor.

    Example: unitouch-gen adapt touches/ --sensor mine
    """
    from unitouch_gen.training.adapt import AdaptConfig, learn

    file = output or Path(f"{sensor}.safetensors")
    if file.suffix != ".safetensors":
        raise InvalidInputError(f"`--output` is {str(file)!r}; name a .safetensors file.")
    check_output([file], overwrite)
    learn(path, sensor, model, AdaptConfig(steps=steps, seed=seed), note, kind).save(file)
    echo(f"The sensor {sensor!r} is in {file.resolve()}; use it by --load-sensor, or pipe.load_sensor(...)")
