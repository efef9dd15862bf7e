"""Students of a pipeline: paths against a closed form, a student that begins as its teacher, and what it draws."""

import math

import pytest
import torch
from diffusers import DDPMScheduler, UNet2DConditionModel
from safetensors.torch import load_file

from tests.helpers.components import make_components
from tests.helpers.small_family import write_small_family
from unitouch_gen.errors import InvalidInputError, NonFiniteError
from unitouch_gen.models import UniTouchModel
from unitouch_gen.models.added_sensors import DOWN, UP
from unitouch_gen.models.distilled import CONDITION_WIDTH, PROJECTION, distilled_arguments, is_distilled, student_of
from unitouch_gen.numerics.fit import contact_targets, exact_path, fit_steps, noise_levels, with_fits
from unitouch_gen.numerics.problems import make_problem
from unitouch_gen.numerics.reference import relative_rms
from unitouch_gen.numerics.targets import PipelineTarget
from unitouch_gen.pipelines import TouchToImagePipeline
from unitouch_gen.pipelines.hub import Card
from unitouch_gen.pipelines.tiny import tiny
from unitouch_gen.schedulers.fitted import Fit, FittedScheduler
from unitouch_gen.training import distill as distilling
from unitouch_gen.training.distill import (
    ConsistencyObjective,
    DistillConfig,
    DistillObjective,
    card_of,
    distill,
    low_rank_of,
    low_rank_updates,
    path_of,
    pruned,
    teacher_paths,
)
from unitouch_gen.training.recipe import read_section
from unitouch_gen.weights import STUDENT

SMALL = DistillConfig(
    steps=[1, 2], guidance=(1.0, 3.0), teacher_steps=2, contacts=4, updates=2, batch_size=2, save_every=1
)  # fmt: skip


QUIET = {"told": lambda line: None, "quiet": True}


@pytest.fixture(autouse=True, scope="module")
def short():
    """Few contacts and short paths to fit to, as networks here are random."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(distilling, "FITTED_ON", 3)
        patch.setattr(distilling, "FIRST_EVALUATIONS", 6)
        yield


def make_teacher() -> TouchToImagePipeline:
    """With steps of order one that nobody fitted."""
    parts = make_components()
    steps = {"sigmas": (14.6, 0.8), "weights": ((), (0.0,))}
    fits = [Fit.of({"guidance_scale": scale, **steps}) for scale in (1.0, 3.0, 1000.0)]
    parts["scheduler"] = with_fits(parts["scheduler"], fits, "ddim")
    pipe = TouchToImagePipeline(**parts, default_guidance_scale=2.0, default_num_inference_steps=2)
    pipe.set_progress_bar_config(disable=True)
    return pipe


@pytest.fixture
def teacher() -> TouchToImagePipeline:
    return make_teacher()


@pytest.fixture(scope="module")
def student(short, tmp_path_factory) -> TouchToImagePipeline:
    folder = tmp_path_factory.mktemp("distilled") / "student"
    distill(make_teacher(), ("touch",), folder, SMALL, **QUIET)
    pipe = TouchToImagePipeline.from_pretrained(folder)
    pipe.set_progress_bar_config(disable=True)
    return pipe


def called(pipe, **settings):
    touch = torch.full((2, 3, 32, 32), 0.2)
    noise = torch.randn(2, 4, 8, 8, generator=torch.Generator().manual_seed(3))
    return pipe(touch, latents=noise, sensor="gelsight", output_type="latent", **settings)


def test_paths_are_the_closed_form():
    problem = make_problem("gaussian-guided")
    noise = problem.noise(4)
    fit, _ = fit_steps(problem.flow, exact_path(problem.flow, noise), 1.0, noise_levels(problem.flow, 24, 4.0))
    states = path_of(problem.flow, noise, fit, 4)
    for stop, sigma in enumerate([fit.sigmas[6], fit.sigmas[12], fit.sigmas[18]]):
        exact = problem.solution(noise, sigma) / math.hypot(1.0, sigma)
        assert relative_rms(states[:, stop].double(), exact).max() < 0.02
    assert relative_rms(states[:, -1].double(), problem.solution(noise)).max() < 0.02


def test_a_student_begins_as_its_teacher(teacher):
    made = student_of(teacher.unet)
    state, hidden, labels = torch.randn(2, 4, 8, 8), torch.randn(2, 3, 16), torch.randn(2, 32)
    given = {"timestep": 7.0, "encoder_hidden_states": hidden, "class_labels": labels}
    more = distilled_arguments(made, torch.tensor([1.0, 5.0]), 4, torch.zeros(2))
    assert more["timestep_cond"].shape == (2, CONDITION_WIDTH) and not distilled_arguments(
        teacher.unet, 3, 4, torch.zeros(1)
    )
    assert torch.equal(made(state, **given, **more).sample, teacher.unet(state, **given).sample)


def test_each_guidance_and_number_of_steps_is_told_apart(teacher):
    made = student_of(teacher.unet)
    told = [
        distilled_arguments(made, scale, steps, torch.zeros(1))["timestep_cond"]
        for scale in (1, 2.5, 9)
        for steps in (1, 2, 4)
    ]
    assert torch.cdist(*[torch.cat(told)] * 2).add(torch.eye(9)).min() > 0.5
    none = distilled_arguments(made, 0.5, 1, torch.zeros(1))["timestep_cond"]
    assert torch.equal(none, told[0])  # no guidance, as diffusers has it


def test_nothing_is_to_learn_where_the_teacher_makes_the_same_steps(teacher):
    """Without guidance, and as many steps as the paths were drawn in."""
    config = SMALL.model_copy(update={"guidance": (1.0, 1.0 + 1e-9), "steps": [2]})
    targets = contact_targets(teacher, ("touch",), 6, batch_size=2)
    scheduler, _ = distilling.fits_of(targets, config, lambda line: None)
    batch = teacher_paths(targets, scheduler, config, quiet=True)
    fit = scheduler.find(2, 1.0)
    same = DistillObjective(student_of(teacher.unet), scheduler, {2: fit})
    assert same.errors(batch, fit).max() < 2e-3  # of half precision
    assert same(batch)["loss"] < 2e-3 * batch["states"][:, -1].abs().mean()


class Scaling(ConsistencyObjective):
    """D = a x / (1 + sigma), with a note of what it was asked of."""

    def __init__(self, *given):
        super().__init__(*given)
        self.factor, self.asked = torch.tensor(0.7, requires_grad=True), []

    def denoise(self, state, sigma, conditions):
        self.asked.append((state, sigma))
        return self.factor * state / (1.0 + sigma)


def test_consistency_asks_that_near_and_far_noise_have_one_end(teacher):
    schedule, rows, gap = DDPMScheduler(), 64, 0.2
    clean = torch.randn(rows, 4, 8, 8)
    batch = {"noise": torch.zeros(rows, 4, 8, 8), "states": clean[:, None].repeat(1, 2, 1, 1, 1),
             "guidance": torch.full((rows,), 2.0)}  # fmt: skip
    objective = Scaling(student_of(teacher.unet), schedule, {1: Fit(2.0, (14.0,), ((),))}, gap)
    loss = objective(batch)["loss"]
    (far, sigma), (near, nearer) = objective.asked
    least = ((1 - schedule.alphas_cumprod[0]) / schedule.alphas_cumprod[0]).sqrt()
    expected = sigma * (1 - gap * (1 + 8 / (1 + sigma.exp())))  # Geng et al., 2024: k = 8, b = 1
    seen = expected >= least
    assert 0 < seen.sum() < rows and torch.allclose(nearer[seen], expected[seen])
    torch.testing.assert_close(((far - clean) / sigma)[seen[:, 0, 0, 0]], ((near - clean) / nearer)[seen[:, 0, 0, 0]],
                               atol=1e-4, rtol=1e-4)  # fmt: skip
    factor = torch.tensor(0.7, requires_grad=True)
    wanted = torch.where(seen, 0.7 * near / (1 + nearer), clean)  # without a gradient
    rms = (factor * far / (1 + sigma) - wanted).square().mean(dim=(1, 2, 3)).sqrt()
    by_hand = (rms / (sigma - nearer * seen)[:, 0, 0, 0]).mean()
    torch.testing.assert_close(loss, by_hand, rtol=0.02, atol=0.0)  # the small constant under the root
    (found,) = torch.autograd.grad(loss, objective.factor)
    torch.testing.assert_close(found, torch.autograd.grad(by_hand, factor)[0], rtol=0.02, atol=0.0)


def test_what_is_consistent_already_has_a_gradient_of_none(teacher):
    network = student_of(teacher.unet)
    network.conv_out.weight.data.zero_()
    network.conv_out.bias.data.fill_(0.5)
    batch = {"noise": torch.zeros(4, 4, 8, 8), "states": torch.full((4, 2, 4, 8, 8), 0.5),
             "guidance": torch.full((4,), 2.0), "encoder_hidden_states": torch.randn(4, 3, 16),
             "class_labels": torch.randn(4, 32)}  # fmt: skip
    fits = {1: Fit(2.0, (14.0,), ((),))}
    loss = ConsistencyObjective(network, DDPMScheduler(prediction_type="sample"), fits, 0.5)(batch)["loss"]
    loss.backward()
    assert loss == 0.0 and network.conv_out.bias.grad.abs().max() == 0.0


def test_a_student_is_a_pipeline_of_few_evaluations_of_one_row(student, teacher):
    assert is_distilled(student.unet) and student.scheduler.known == ["1, 2 steps at guidance 1 to 3"]
    for steps in (1, 2):
        report = called(student, num_inference_steps=steps, guidance_scale=2.5).report
        assert (report.evaluations, report.guided, report.solver) == (steps, 0, "distilled")
    assert called(student).report.evaluations == 2
    asked = [
        called(student, solver=solver, generator=torch.Generator().manual_seed(0)).images
        for solver in (None, report.solver)
    ]
    assert torch.equal(*asked)
    with pytest.raises(InvalidInputError, match="`solver` is 'distilled'"):
        called(teacher, solver=report.solver)
    pictures = [called(student, guidance_scale=scale).images for scale in (1.0, 3.0)]
    assert not torch.equal(*pictures)
    assert called(teacher).report.guided == 2  # which is as it was


def test_its_card_tells_what_it_is_and_not_what_its_teacher_is_worth(student, tmp_path):
    errors, config = {1: 0.5, 2: 0.25}, DistillConfig(steps=[1, 2], guidance=(1.0, 3.0))
    known = Card(figures={"material": "99 %"}, license="apache-2.0", limits="None of note.")
    student.save_pretrained(tmp_path / "of", card=card_of(known, errors, config))
    card = (tmp_path / "of" / "README.md").read_text()
    assert "distilled to draw in 1, 2 steps, at guidance 1 to 3" in card and "25.0%" in card
    assert "99 %" not in card and "apache-2.0" in card and "None of note." in card
    assert card_of(tmp_path, errors, config) is None  # a folder's, which is of its teacher


def test_a_prompt_to_lead_away_from_has_no_branch(student):
    with pytest.raises(InvalidInputError, match="`negative_prompt` came, but this network was distilled"):
        called(student, negative_prompt="red")


def test_its_steps_are_those_that_were_trained(teacher, student):
    """The pipeline's pictures are the objective's results."""
    touch = 0.2 + 0.05 * torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(1))
    target = PipelineTarget(teacher, {"touch": touch}, seeds=1, noise_seed=5)
    inputs = target.network_inputs(2.0, [0, 1])
    batch = {name: value[-2:].expand(2, *value.shape[1:]) for name, value in inputs.conditions.items()}
    batch |= {"noise": target.noise, "states": torch.zeros(2, 2, 4, 8, 8), "guidance": torch.full((2,), 2.0)}
    fit = student.scheduler.find(2, 2.0)
    objective = DistillObjective(student.unet, teacher.scheduler, {2: fit})
    with torch.no_grad():
        *_, (expected, _) = objective.steps(batch, fit)
    generator = [torch.Generator().manual_seed(0) for _ in range(2)]
    found = student(touch, latents=target.noise, guidance_scale=2.0, generator=generator, output_type="latent").images
    assert relative_rms(found.double(), expected.double()).max() < 1e-4


@pytest.mark.parametrize(("settings", "came"), [
    ({"num_inference_steps": 3}, "`num_inference_steps` is 3"), ({"guidance_scale": 4.0}, "`guidance_scale` is 4.0"),
    ({"solver": "unipc"}, "`solver` is 'unipc'"), ({"tolerance": 0.1}, "`tolerance`"),
    ({"timesteps": [999, 500]}, "`timesteps`"), ({"guidance_interval": (0.2, 0.8)}, "`guidance_interval`"),
])  # fmt: skip
def test_what_it_was_not_made_for_is_refused_with_what_came_and_what_it_takes(student, settings, came):
    with pytest.raises(InvalidInputError, match=f"{came}.*distilled to 1, 2 steps at guidance 1 to 3"):
        called(student, **settings)


@pytest.fixture(scope="module")
def adapted() -> UNet2DConditionModel:
    """A student with low-rank updates that were trained to something."""
    torch.manual_seed(0)
    made = student_of(make_components()["unet"])
    low_rank_updates(made, 3)
    for name, value in made.named_parameters():
        if "lora" in name or "cond_proj" in name:
            value.data.normal_(std=0.1)
    return made.eval()


def test_low_rank_updates_are_those_that_peft_adds(adapted):
    state, hidden, labels = torch.randn(2, 4, 8, 8), torch.randn(2, 3, 16), torch.randn(2, 32)
    given = {
        "timestep": 7.0,
        "encoder_hidden_states": hidden,
        "class_labels": labels,
        **distilled_arguments(adapted, 3.0, 2, torch.zeros(1)),
    }
    merged = student_of(make_components()["unet"], low_rank_of(adapted)).eval()
    assert torch.allclose(merged(state, **given).sample, adapted(state, **given).sample, atol=1e-4)
    again = student_of(make_components()["unet"])
    low_rank_updates(again, low_rank_of(adapted))
    assert torch.allclose(again.eval()(state, **given).sample, adapted(state, **given).sample, atol=1e-4)
    trained = {name for name, value in again.named_parameters() if value.requires_grad}
    assert trained == {name for name, _ in again.named_parameters() if "lora" in name} | {PROJECTION}


def test_pruned_updates_are_the_nearest_of_their_ranks(adapted):
    """Eckart & Young, 1936: singular values that are cut off are what is missing."""
    whole = low_rank_of(adapted)
    assert len(pruned(whole, 10**9)) == len(whole)
    kept = pruned(whole, 9000)
    assert 8500 < sum(2 * value.numel() for value in kept.values()) <= 9000
    ranks = set()
    for name in (name.removesuffix(UP) for name in kept if name.endswith(UP)):
        full, less = (each[name + UP].flatten(1) @ each[name + DOWN].flatten(1) for each in (whole, kept))
        rank = kept[name + DOWN].shape[0]
        ranks.add(rank)
        missing = torch.linalg.svdvals(full)[rank:].square().sum()
        assert (full - less).square().sum() == pytest.approx(missing.item(), rel=1e-3, abs=1e-6)
    assert len(ranks) > 1


@pytest.mark.parametrize(("name", "shown"), [("touch-to-image", "touch"), ("x-to-touch", "image")])
def test_a_family_gets_a_student_of_its_own(name, shown, tmp_path):
    write_small_family(tmp_path)
    joint = UniTouchModel.from_pretrained(tmp_path / "joint")
    joint.load("touch")
    for number, sensor in enumerate(joint.sensors):
        joint.sensor_bank.set_prototype(sensor, torch.full((3, 64, 64), 0.2 * number))
    joint.save_pretrained(tmp_path / "joint")
    config = SMALL.model_copy(update={"rank": 2, "size": 20_000, "teacher_steps": 6})
    pipe, student = tiny(name, family=tmp_path), name + STUDENT
    with pytest.raises(InvalidInputError, match=f"holds no '{student}'"):
        tiny(student, family=tmp_path)
    folder = tmp_path / student
    with pytest.raises(InvalidInputError, match="`rank` is 0"):
        distill(pipe, (shown,), folder, SMALL, apart=True)
    distill(pipe, (shown,), folder, config, apart=True, **QUIET)
    assert {file.name for file in folder.iterdir()} == {
        "student.safetensors",
        "scheduler",
        "defaults.json",
        "record.json",
    }
    assert sum(value.nbytes for value in load_file(folder / "student.safetensors").values()) <= 20_000
    for settings in ({}, {"low_memory": True}, {"dtype": torch.bfloat16}):
        made = tiny(student, family=tmp_path, **settings)
        report = made(**{shown: torch.full((1, 3, 64, 64), 0.2)}, output_type="latent").report
        assert (report.evaluations, report.guided) == (2, 0)


def test_a_student_is_no_teacher(student, tmp_path):
    with pytest.raises(InvalidInputError, match="`model` was distilled already"):
        distill(student, ("touch",), tmp_path / "other", SMALL)
    with pytest.raises(InvalidInputError, match="no flow of its own"):
        contact_targets(student, ("touch",), 2)


@pytest.mark.parametrize("objective", ["trajectory", "consistency"])
def test_a_killed_run_goes_on(objective, teacher, tmp_path):
    """After its last update, before anything was saved; the result is that of a run that was not killed."""

    small = SMALL.model_copy(update={"objective": objective})

    def killed(line: str) -> None:
        if "against the teacher" in line:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        distill(teacher, ("touch",), tmp_path / "killed", small, told=killed, quiet=True)
    with pytest.raises(InvalidInputError, match="`--resume`"):
        distill(teacher, ("touch",), tmp_path / "killed", small, **QUIET)
    other = small.model_copy(update={"guidance": (1.0, 2.0)})
    with pytest.raises(InvalidInputError, match="was made for"):
        distill(teacher, ("touch",), tmp_path / "killed", other, resume=True, **QUIET)
    distill(teacher, ("touch",), tmp_path / "killed", small, resume=True, **QUIET)
    distill(teacher, ("touch",), tmp_path / "whole", small, **QUIET)
    weights = [load_file(tmp_path / name / "unet/diffusion_pytorch_model.safetensors") for name in ("killed", "whole")]
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[1])
    assert not (tmp_path / "killed.training").exists()
    made = TouchToImagePipeline.from_pretrained(tmp_path / "whole")
    made.set_progress_bar_config(disable=True)
    assert called(made).report.evaluations == 2 and called(made, num_inference_steps=1).report.evaluations == 1


def test_a_teacher_without_a_flow_or_that_diverges_is_refused(teacher, tmp_path):
    config = SMALL.model_copy(update={"guidance": (900.0, 1000.0)})
    with pytest.raises(NonFiniteError, match="The teacher diverges at guidance"):
        distill(teacher, ("touch",), tmp_path / "student", config, **QUIET)
    teacher.register_modules(scheduler=DDPMScheduler())
    with pytest.raises(InvalidInputError, match="DDPMScheduler, which follows no exact flow"):
        distill(teacher, ("touch",), tmp_path / "student", SMALL)
    assert not (tmp_path / "student").exists()


@pytest.mark.parametrize(("settings", "named"), [
    ({"guidance": (3.0, 2.0)}, "3 to 2; the first has to be below the second"),
    ({"steps": [2, 3]}, "each number has to divide the largest"),
    ({"steps": [3], "teacher_steps": 16}, "each number has to divide the largest"),
    ({"size": 1000}, "`rank` 0"),
    ({"contacts": 8}, "a batch takes 32"),
])  # fmt: skip
def test_what_cannot_be_made_is_refused(settings, named):
    with pytest.raises(InvalidInputError, match=named):
        read_section({"distill": settings}, "distill", DistillConfig)


def test_a_distilled_scheduler_is_saved_and_read(tmp_path):
    fits = [{"guidance_scale": scale, "sigmas": (5.0, 1.0), "weights": ((), (0.2,))} for scale in (1.0, 9.0)]
    FittedScheduler(fits=fits, otherwise=None).save_pretrained(tmp_path)
    read = FittedScheduler.from_pretrained(tmp_path)
    assert read.config.otherwise is None and read.find(2, 4.0).sigmas == pytest.approx((5.0, 1.0))
