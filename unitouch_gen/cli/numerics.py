"""`unitouch-gen work-precision` and `stability`: error against run time, and extreme cases, on any checkpoint."""

import warnings
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

from typer import Exit, Option, echo

from unitouch_gen.cli.loading import DRAWING, kind_of, load_pipeline
from unitouch_gen.cli.options import Guidance, Model, by_comma, check_output, print_table, value_of
from unitouch_gen.errors import check_choice, check_integer, check_number, check_passed, check_unused
from unitouch_gen.files import reading
from unitouch_gen.weights import FAMILY


def work_precision(
    output: Annotated[Path, Option("--output", "-o", help="Folder for the chart and the results.")],
    problem: Annotated[str | None, Option(help="A problem with a known flow, such as mixture-7.5.")] = None,
    pipeline: Annotated[str | None, Option(help=f"{', '.join(DRAWING)}.")] = None,
    model: Model = None,
    lora: Annotated[
        Path | None, Option(exists=True, help="Folder of LoRA weights by distill, charted as turbo; or built-in.")
    ] = None,
    solvers: Annotated[str | None, Option(help="Names of solvers, by comma; all if left out.")] = None,
    steps: Annotated[str, Option(help="Numbers of steps, by comma.")] = "5,8,12,20,32,50",
    tolerances: Annotated[str, Option(help="Tolerances, by comma.")] = "0.1,0.03,0.01,0.003,0.001",
    guidance_scale: Guidance = None,
    seeds: Annotated[int, Option(min=1, max=1000, help="Number of noises for each contact.")] = 4,
) -> None:
    """Charts the error of solvers against their run time.

    Example: unitouch-gen work-precision --problem mixture-7.5 -o outputs/mixture
    """
    from tqdm import tqdm

    from unitouch_gen.numerics import work_precision as wp
    from unitouch_gen.numerics.problems import PROBLEMS
    from unitouch_gen.pipelines.tiny import distilled

    check_passed({"--problem": problem, "--pipeline": pipeline}, only_one=True)
    if problem is not None:
        check_unused("with `--problem`", **{"--model": model, "--lora": lora, "--guidance-scale": guidance_scale})
    check_output([output / "results.json"], overwrite=True)
    built_in = FAMILY / str(pipeline) / "turbo"
    if lora is None and model is None and built_in.is_dir() and find_spec("peft"):
        lora = built_in
    unavailable = {"turbo": lora is None, "default": pipeline is None}
    available = [name for name in wp.NAMES if not unavailable.get(name)]
    names = list(dict.fromkeys(by_comma(solvers) or available))
    counts = [check_integer("--steps", value_of(word), 1, 1000) for word in steps.split(",")]
    errors = [check_number("--tolerances", value_of(word), 1e-5, 1.0) for word in tolerances.split(",")]
    for name in names:
        check_choice("--solvers", name, available)
    points = points_of(names, counts, errors)

    if problem is not None:
        target = wp.problem_target(PROBLEMS[check_choice("--problem", problem, PROBLEMS)], seeds)
    else:
        name = check_choice("--pipeline", pipeline, DRAWING)
        pipe = load_pipeline(name, model=model)
        inputs = wp.world_inputs(DRAWING[name], 4)
        turbo = None
        if lora is not None and "turbo" in names:
            with reading("--lora", lora):
                turbo = distilled(pipe, lora)
        target = wp.pipeline_target(pipe, inputs, name=name, seeds=seeds, guidance_scale=guidance_scale, turbo=turbo)
        if "default" in names and target.default_steps not in counts:
            points.append({"solver": "default", "steps": target.default_steps})
    wp.measure(target, "ddim", 2, repeats=1)  # a warm-up
    rows = [wp.measure(target, **point) for point in tqdm(points, disable=None)]
    wp.save(output, target, rows)
    echo(f"{target.name}, guidance {target.guidance_scale:g}; the reference's own error is {target.own_error:.1e}")
    print_costs(target, names, rows)
    for row in rows:
        if row["failures"]:
            echo(f"\N{MULTIPLICATION X} {row['solver']}, {wp.amount(row)}: {row['reason']}")
    echo(f"Chart and results are in {output.resolve()}")


def points_of(names: Sequence[str], steps: Sequence[int], tolerances: Sequence[float]) -> list[dict[str, Any]]:
    """The solvers to measure, each with its numbers of steps or tolerances."""
    from unitouch_gen.numerics.work_precision import TURBO_STEPS

    points = list[dict[str, Any]]()
    for name in names:
        if name == "tolerance":
            points += [{"solver": name, "tolerance": value} for value in tolerances]
        else:
            points += [{"solver": name, "steps": value} for value in (TURBO_STEPS if name == "turbo" else steps)]
    return points


def print_costs(target: Any, names: Sequence[str], rows: Sequence[dict[str, Any]]) -> None:
    """Prints what each solver takes to reach some errors."""
    from unitouch_gen.numerics import work_precision as wp

    bounds = (0.2, 0.1, 0.05, 0.02, 0.01)
    table = list[list[str]]()
    for name in names:
        results = [row for row in wp.successful(rows) if row["solver"] == name]
        results.sort(key=lambda row: row["evaluations"])
        cells = list[str]()
        for bound in bounds:
            sufficient = [row for row in results if row["error"] <= bound]
            if name in target.noisy:
                cells.append("adds noise")
            elif sufficient:
                cells.append(f"{wp.amount(sufficient[0])}, {sufficient[0]['seconds']:.2g} s")
            else:
                cells.append("-")
        table.append([name, *cells])
    print_table(["for an error of", *(f"{bound:.0%}" for bound in bounds)], table)


def stability(
    model: Model = None,
    only: Annotated[str | None, Option(help="Name of a single case to run.")] = None,
) -> None:
    """Runs solvers and pipelines on stiff and extreme input; exits with 1 if a case fails.

    Example: unitouch-gen stability
    """
    import diffusers.utils.logging
    from tqdm import tqdm

    from unitouch_gen.numerics.stability import cases

    def load(kind: str, dtype: Any) -> Any:
        return load_pipeline(kind, model=model, dtype=str(dtype).removeprefix("torch."))

    kinds = list(DRAWING) if model is None else [kind_of(model)]
    case_by_name = {case.name: case for case in cases(load, kinds)}
    chosen = list(case_by_name.values())
    if only is not None:
        chosen = [case_by_name[check_choice("--only", only, case_by_name)]]
    diffusers.utils.logging.set_verbosity_error()
    rows = list[list[str]]()
    failed = 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # libraries warn of extreme input
        for case in tqdm(chosen, disable=None, leave=False):
            try:
                value, bound = case.run()
            except Exception as error:  # the other cases still run
                holds = False
                figures = ["-", f"{type(error).__name__}: {error}"]
            else:
                holds = value <= bound
                figures = [f"{bound:.2g}", f"{value:.2g}"]
            failed += not holds
            rows.append([case.name, case.reason, *figures, "ok" if holds else "FAILED"])
    print_table(["case", "reason of the bound", "bound", "result", ""], rows)
    echo(f"{len(rows) - failed} of {len(rows)} cases hold.")
    if failed:
        raise Exit(1)
