"""Folders in other hands: diffusers' own loader, transformers' Auto classes, model cards, uploads, what is printed."""

import inspect
import json
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import huggingface_hub
import numpy as np
import pytest
import torch
from diffusers import DiffusionPipeline
from diffusers.pipelines import pipeline_utils
from diffusers.utils import dynamic_modules_utils
from huggingface_hub import ModelCard
from PIL import Image
from transformers import AutoConfig, AutoModel, AutoProcessor

import unitouch_gen
from tests.helpers.components import D
from unitouch_gen import weights
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.models import UniTouchConfig, UniTouchModel, UniTouchProcessor
from unitouch_gen.pipelines import TactileStylizationPipeline, TouchToImagePipeline, XToTouchPipeline
from unitouch_gen.pipelines.hub import MODULE, PARTS, Card, name_classes
from unitouch_gen.pipelines.tiny import PIPELINES, _card

KINDS = (TouchToImagePipeline, TactileStylizationPipeline, XToTouchPipeline)


@pytest.fixture
def pipelines(pipe, stylize, x_to_touch) -> dict[type, DiffusionPipeline]:
    return {type(made): made for made in (pipe, stylize, x_to_touch)}


def picture(pipe, touch, photo) -> torch.Tensor:
    pipe.set_progress_bar_config(disable=True)
    inputs = {"touch": touch[:1]} if "touch" in inspect.signature(pipe.__call__).parameters else {}
    if isinstance(pipe, TactileStylizationPipeline):
        inputs["image"] = photo[:1]
    return pipe(**inputs, generator=torch.Generator().manual_seed(0), output_type="pt").images


# diffusers' own loader ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_diffusers_own_loader_reads_a_saved_folder(pipelines, kind, touch, photo, tmp_path):
    pipelines[kind].save_pretrained(tmp_path)
    loaded = DiffusionPipeline.from_pretrained(tmp_path, trust_remote_code=True)
    assert type(loaded) is kind
    assert torch.equal(picture(loaded, touch, photo), picture(pipelines[kind], touch, photo))


def test_diffusers_own_loader_asks_for_trust(family):
    with pytest.raises(ValueError, match="trust_remote_code=True"):
        DiffusionPipeline.from_pretrained(family)


def test_our_loader_runs_no_code_of_a_folder(family, tmp_path, monkeypatch):
    """Nor with a trust that was meant for something else."""
    for file in family.rglob("*"):
        if file.is_file():
            copy = tmp_path / file.relative_to(family)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(b"raise SystemExit" if file.suffix == ".py" else file.read_bytes())
    assert len(list(tmp_path.rglob("*.py"))) == 3
    TouchToImagePipeline.from_pretrained(tmp_path)
    TouchToImagePipeline.from_pretrained(tmp_path, trust_remote_code=True)


def test_folders_of_before_are_read_as_they_are(pipe, family, tmp_path):
    """Their index names classes by the modules that they are in, and no files."""
    pipe.save_pretrained(tmp_path)
    for file in tmp_path.rglob("*.py"):
        file.unlink()
    DiffusionPipeline.save_config(pipe, tmp_path)
    assert json.loads((tmp_path / "model_index.json").read_text())["_class_name"] == "TouchToImagePipeline"
    TouchToImagePipeline.from_pretrained(tmp_path)


REPOSITORY = "someone/touch"


@pytest.fixture
def cached(family, tmp_path, monkeypatch):
    """A cache of huggingface_hub that holds `family` as a repository, and no network."""
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    commit = "0" * 40
    place = tmp_path / f"models--{REPOSITORY.replace('/', '--')}"
    (place / "refs").mkdir(parents=True)
    (place / "refs" / "main").write_text(commit)
    (place / "snapshots").mkdir()
    (place / "snapshots" / commit).symlink_to(family)
    return tmp_path


def test_our_loader_reads_a_repository(cached, touch):
    pipe = TouchToImagePipeline.from_pretrained(REPOSITORY, cache_dir=cached, local_files_only=True)
    assert pipe.name_or_path == REPOSITORY
    assert pipe.encode_touch(touch).shape == (2, D)


@pytest.mark.parametrize("kind", KINDS)
def test_every_part_of_ours_is_found(kind):
    named = {part for types in kind._get_signature_types().values() for part in types}
    ours = {part.__name__ for part in named if getattr(part, "__module__", "").startswith("unitouch_gen.")}
    assert ours and ours <= set(PARTS)


@pytest.fixture
def hub(family, monkeypatch):
    """In place of the network, one repository that holds `family`."""
    info = SimpleNamespace(
        sha="0" * 40,
        siblings=[
            SimpleNamespace(rfilename=str(file.relative_to(family))) for file in family.rglob("*") if file.is_file()
        ],
    )
    for module in (pipeline_utils, dynamic_modules_utils):
        monkeypatch.setattr(module, "model_info", lambda *_, **__: info)
        monkeypatch.setattr(module, "hf_hub_download", lambda _, file, *__, **___: str(family / file))
    monkeypatch.setattr(pipeline_utils, "_resolve_revision", lambda *_, **__: "main")


def test_diffusers_own_loader_reads_a_repository(hub, family, touch):
    assert Path(DiffusionPipeline.download(REPOSITORY, trust_remote_code=True)) == family
    loaded = DiffusionPipeline.from_pretrained(REPOSITORY, trust_remote_code=True)
    assert loaded.encode_touch(touch).shape == (2, D)


# transformers' Auto classes -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("auto", "part", "kind"),
    [
        (AutoConfig, "unitouch", UniTouchConfig),
        (AutoModel, "unitouch", UniTouchModel),
        (AutoProcessor, "processor", UniTouchProcessor),
    ],
)
def test_auto_classes_of_transformers_know_the_joint_space(family, auto, part, kind):
    assert type(auto.from_pretrained(family / part)) is kind


UNKNOWN = """
from transformers import AutoModel, AutoProcessor
folder = {folder!r}
try:
    AutoModel.from_pretrained(folder + "/unitouch")
except ValueError as error:
    print("trust_remote_code=True" in str(error))
for auto, part in ((AutoModel, "unitouch"), (AutoProcessor, "processor")):
    print(type(auto.from_pretrained(f"{{folder}}/{{part}}", trust_remote_code=True)).__name__)
"""


def test_auto_classes_find_the_package_by_themselves_where_they_are_trusted(family):
    """In a process that has not imported it."""
    command = [sys.executable, "-c", UNKNOWN.format(folder=str(family))]
    said = subprocess.run(command, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
    assert said.stdout.split()[-3:] == ["True", "UniTouchModel", "UniTouchProcessor"], said.stderr


def test_a_processor_makes_the_arguments_of_its_model(family, touch, photo, sound):
    processor = AutoProcessor.from_pretrained(family / "processor")
    model = AutoModel.from_pretrained(family / "unitouch")
    inputs = processor(images=photo, text=["rough brick", "metal"], audio=[sound, sound], touch=touch)
    made = model(**inputs)
    assert torch.equal(made.touch_embeds, model.get_touch_features(processor.touch(touch)))
    assert torch.equal(made.image_embeds, model.get_image_features(processor.images(photo)))
    assert torch.equal(made.text_embeds, model.get_text_features(**processor.text(["rough brick", "metal"])))
    assert torch.equal(made.audio_embeds, model.get_audio_features(processor.sounds([sound, sound])))
    assert list(model(**processor(touch=touch))) == ["touch_embeds"]
    assert all(isinstance(value, np.ndarray) for value in processor(touch=touch, return_tensors="np").values())


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "pass `images`, `text`, `audio` or `touch`"),
        ({"text": "x", "sampling_rate": 16_000}, "`sampling_rate` came"),
        ({"text": "x", "return_tensors": "tf"}, "`return_tensors` is 'tf'"),
        ({"images": 3}, "`images` is"),
        ({"touch": "no/such.png"}, "`touch` "),
    ],
)
def test_what_a_processor_cannot_make_inputs_of_is_refused(components, given, words):
    with pytest.raises((InvalidInputError, InvalidTypeError), match=words):
        components["processor"](**given)


def test_a_model_of_nothing_is_refused(components):
    with pytest.raises(InvalidInputError, match="Nothing came"):
        components["unitouch"]()


# Model cards ----------------------------------------------------------------------------------------------------------


def test_a_card_is_one_that_huggingface_reads(pipe, tmp_path):
    Image.new("RGB", (8, 8)).save(tmp_path / "shown.png")
    card = Card(
        description="Touches of bricks.", figures={"bricks named right": 0.5, "chance": "1 in 16"}, data="Bricks.",
        license="apache-2.0", limits="No tiles.", pictures={"A brick": tmp_path / "shown.png"},
    )  # fmt: skip
    pipe.save_pretrained(tmp_path / "saved", card=card)
    read = ModelCard.load(tmp_path / "saved" / "README.md")
    assert (read.data.license, read.data.library_name) == ("apache-2.0", "diffusers")
    for said in ("Touches of bricks.", "| bricks named right | 0.5 |", "| chance | 1 in 16 |", "Bricks.", "No tiles."):
        assert said in read.text
    shown = re.search(r"!\[A brick\]\((.*)\)", read.text)[1]
    assert Image.open(tmp_path / "saved" / shown).size == (8, 8)


@pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarInputWarning")  # of networks that know nothing
@pytest.mark.parametrize("kind", KINDS)
def test_the_example_of_a_card_runs(pipelines, kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pipelines[kind].save_pretrained("saved")
    example = re.search(r"```python\n(.*?)```", Path("saved/README.md").read_text(), re.DOTALL)[1]
    exec(example, {})  # noqa: S102 - what people copy
    assert Image.open("output.png").size == (16, 16)


def test_a_card_that_somebody_wrote_stays_unless_one_is_passed(pipe, tmp_path):
    (tmp_path / "README.md").write_text("theirs")
    pipe.save_pretrained(tmp_path)
    assert (tmp_path / "README.md").read_text() == "theirs"
    pipe.save_pretrained(tmp_path, card=Card(description="ours"))
    assert "ours" in (tmp_path / "README.md").read_text()


def test_a_card_goes_where_its_pipeline_goes(pipe, tmp_path):
    Image.new("RGB", (8, 8)).save(tmp_path / "shown.png")
    pipe.save_pretrained(tmp_path / "one", card=Card(description="Bricks.", pictures={"x": tmp_path / "shown.png"}))
    TouchToImagePipeline.from_pretrained(tmp_path / "one").save_pretrained(tmp_path / "two")
    assert (tmp_path / "two" / "README.md").read_text() == (tmp_path / "one" / "README.md").read_text()
    assert (tmp_path / "two" / "pictures" / "0-shown.png").is_file()


@pytest.mark.parametrize(
    "wrong", [{"figures": []}, {"figures": {1: 2}}, {"license": None}, {"pictures": {"x": "no/such.png"}}]
)
def test_what_no_card_can_say_is_refused(wrong):
    with pytest.raises((InvalidInputError, InvalidTypeError), match=f"`{next(iter(wrong))}`"):
        Card(**wrong)


def test_what_is_no_card_is_refused(pipe, tmp_path):
    with pytest.raises(InvalidTypeError, match="`card` is 'bricks'"):
        pipe.save_pretrained(tmp_path / "saved", card="bricks")
    assert not (tmp_path / "saved").exists()


def test_the_built_in_family_brings_its_figures_licence_and_a_picture(tmp_path):
    pipe = unitouch_gen.tiny("touch-to-image")
    pipe._write_card(tmp_path, "bricks")
    read = ModelCard.load(tmp_path / "README.md")
    assert read.data.license == "apache-2.0"
    assert re.search(r"^\| touch to picture: material \| \d+\.\d% \(\d+\.\d% class mean", read.text, re.MULTILINE)
    (shown,) = re.findall(r"!\[Touches.*\]\((.*)\)", read.text)
    assert (tmp_path / shown).read_bytes() == (weights.CARDS / "touch-to-image.jpg").read_bytes()


@pytest.mark.parametrize("name", [name for name in PIPELINES if name != "stylization"])
def test_figures_of_built_in_pipelines_stand_beside_three_controls(name):
    figures = _card(weights.FAMILY, name).figures
    assert len(figures) == (9 if name == "x-to-touch" else 3)
    for shown in figures.values():
        assert re.fullmatch(
            r"\d+\.\d% \(\d+\.\d% class mean, \d+\.\d% another contact's, \d+\.\d% real images\)", shown
        )


@pytest.mark.parametrize("name", PIPELINES)
def test_every_built_in_pipeline_has_a_small_picture(name):
    """Of examples beside and above each other, 128 pixels a side."""
    (file,) = _card(weights.FAMILY, name).pictures.values()
    with Image.open(file) as picture:
        assert picture.width > 4 * 128 and picture.height > 2 * 128
    assert file.stem == name and file.stat().st_size < 60_000


# Uploads --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("by", ["push_to_hub", "save_pretrained"])
def test_an_upload_holds_the_card_and_all_that_loaders_need(pipe, tmp_path, monkeypatch, by):
    uploaded: dict[str, str] = {}

    def upload(self, folder, repo_id, *args):
        for file in Path(folder).rglob("*"):
            if file.is_file():
                uploaded[str(file.relative_to(folder))] = file.read_text() if file.suffix == ".md" else ""

    monkeypatch.setattr(
        "unitouch_gen.pipelines.base.create_repo",
        lambda repo_id, **_: huggingface_hub.RepoUrl(f"https://huggingface.co/{repo_id}"),
    )
    monkeypatch.setattr(TouchToImagePipeline, "_upload_folder", upload)
    if by == "push_to_hub":
        pipe.push_to_hub(REPOSITORY, variant="fp16")
    else:
        pipe.save_pretrained(tmp_path / "saved", push_to_hub=True, repo_id=REPOSITORY, variant="fp16")
    assert {"README.md", "model_index.json", "pipeline.py", "unitouch/pipeline.py", "processor/pipeline.py",
            "unitouch/model.fp16.safetensors"} <= set(uploaded)  # fmt: skip
    assert f'TouchToImagePipeline.from_pretrained("{REPOSITORY}")' in uploaded["README.md"]


def test_settings_may_be_empty_lists(tmp_path):
    index = {"_class_name": "XToTouchPipeline", "sensors": [], "vae": ["diffusers", "AutoencoderKL"]}
    (tmp_path / "model_index.json").write_text(json.dumps(index))
    name_classes(tmp_path)
    named = json.loads((tmp_path / "model_index.json").read_text())
    assert named["sensors"] == [] and named["_class_name"] == [MODULE, "XToTouchPipeline"]
