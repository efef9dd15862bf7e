"""Folders in other hands: diffusers' own loader, transformers' Auto classes, model cards, uploads."""

import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import huggingface_hub
import pytest
from diffusers import DiffusionPipeline
from diffusers.pipelines import pipeline_utils
from diffusers.utils import dynamic_modules_utils
from huggingface_hub import ModelCard
from PIL import Image
from torch.testing import assert_close

from tests.helpers.calls import Call, quiet
from unitouch_gen.errors import InvalidInputError, InvalidTypeError
from unitouch_gen.pipelines import TouchToImagePipeline
from unitouch_gen.pipelines.hub import PARTS, Card

REPOSITORY = "someone/touch"


# diffusers' own loader, and ours --------------------------------------------------------------------------------------


def test_diffusers_own_loader_reads_a_saved_folder(call, tmp_path):
    call.pipe.save_pretrained(tmp_path)
    loaded = quiet(DiffusionPipeline.from_pretrained(tmp_path, trust_remote_code=True))
    assert type(loaded) is type(call.pipe)
    assert_close(Call(loaded, call.inputs).latents(), call.latents(), atol=1e-5, rtol=1e-5)
    with pytest.raises(ValueError, match="trust_remote_code=True"):
        DiffusionPipeline.from_pretrained(tmp_path)
    named = {part for kinds in type(call.pipe)._get_signature_types().values() for part in kinds}
    assert {part.__name__ for part in named if getattr(part, "__module__", "").startswith("unitouch_gen.")} <= set(
        PARTS
    )


@pytest.mark.parametrize("code", ["raise SystemExit", None])
def test_our_loader_runs_no_code_of_a_folder_and_needs_none(pipe, tmp_path, code):
    """Nor with a trust that was meant for something else."""
    pipe.save_pretrained(tmp_path)
    files = list(tmp_path.rglob("*.py"))
    for file in files:
        file.write_text(code) if code else file.unlink()
    if code is None:  # folders of before, whose index names classes by the modules that they are in
        DiffusionPipeline.save_config(pipe, tmp_path)
    assert len(files) == 3
    TouchToImagePipeline.from_pretrained(tmp_path)
    TouchToImagePipeline.from_pretrained(tmp_path, trust_remote_code=True)


def test_our_loader_reads_a_repository_of_the_cache(family, tmp_path, touch, monkeypatch):
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    place, commit = tmp_path / f"models--{REPOSITORY.replace('/', '--')}", "0" * 40
    (place / "refs").mkdir(parents=True)
    (place / "refs" / "main").write_text(commit)
    (place / "snapshots").mkdir()
    (place / "snapshots" / commit).symlink_to(family)
    pipe = TouchToImagePipeline.from_pretrained(REPOSITORY, cache_dir=tmp_path, local_files_only=True)
    assert pipe.name_or_path == REPOSITORY and pipe.encode_touch(touch).shape == (2, 16)


def test_diffusers_own_loader_reads_a_repository(family, touch, monkeypatch):
    """In place of the network, one repository that holds `family`."""
    files = [file for file in family.rglob("*") if file.is_file()]
    info = SimpleNamespace(
        sha="0" * 40, siblings=[SimpleNamespace(rfilename=str(f.relative_to(family))) for f in files]
    )
    for module in (pipeline_utils, dynamic_modules_utils):
        monkeypatch.setattr(module, "model_info", lambda *_, **__: info)
        monkeypatch.setattr(module, "hf_hub_download", lambda _, file, *__, **___: str(family / file))
    monkeypatch.setattr(pipeline_utils, "_resolve_revision", lambda *_, **__: "main")
    assert DiffusionPipeline.from_pretrained(REPOSITORY, trust_remote_code=True).encode_touch(touch).shape == (2, 16)


UNKNOWN = """
from transformers import AutoModel, AutoProcessor
try:
    AutoModel.from_pretrained({folder!r} + "/unitouch")
except ValueError as error:
    print("trust_remote_code=True" in str(error))
for auto, part in ((AutoModel, "unitouch"), (AutoProcessor, "processor")):
    print(type(auto.from_pretrained({folder!r} + "/" + part, trust_remote_code=True)).__name__)
"""


def test_auto_classes_find_the_package_by_themselves_where_they_are_trusted(family):
    """In a process that has not imported it."""
    command = [sys.executable, "-c", UNKNOWN.format(folder=str(family))]
    said = subprocess.run(command, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
    assert said.stdout.split()[-3:] == ["True", "UniTouchModel", "UniTouchProcessor"], said.stderr


# Model cards and uploads ----------------------------------------------------------------------------------------------


def test_a_card_is_one_that_huggingface_reads_and_goes_where_its_pipeline_goes(pipe, tmp_path):
    Image.new("RGB", (8, 8)).save(tmp_path / "shown.png")
    card = Card(
        description="Touches of bricks.", figures={"bricks named right": 0.5}, data="Bricks.", license="apache-2.0",
        limits="No tiles.", pictures={"A brick": tmp_path / "shown.png"},
    )  # fmt: skip
    pipe.save_pretrained(tmp_path / "one", card=card)
    TouchToImagePipeline.from_pretrained(tmp_path / "one").save_pretrained(tmp_path / "two")
    for folder in (tmp_path / "one", tmp_path / "two"):
        read = ModelCard.load(folder / "README.md")
        assert (read.data.license, read.data.library_name) == ("apache-2.0", "diffusers")
        said = ("Touches of bricks.", "| bricks named right | 0.5 |", "Bricks.", "No tiles.")
        assert [words for words in said if words not in read.text] == []
        assert Image.open(folder / re.search(r"!\[A brick\]\((.*)\)", read.text)[1]).size == (8, 8)
    (tmp_path / "two" / "README.md").write_text("theirs")
    pipe.save_pretrained(tmp_path / "two")
    assert (tmp_path / "two" / "README.md").read_text() == "theirs"
    pipe.save_pretrained(tmp_path / "two", card=Card(description="ours"))
    assert "ours" in (tmp_path / "two" / "README.md").read_text()
    with pytest.raises(InvalidInputError, match="`pictures`"):
        Card(pictures={"x": "no/such.png"})
    with pytest.raises(InvalidTypeError, match="`card`"):
        pipe.save_pretrained(tmp_path / "three", card="bricks")


@pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarInputWarning")  # of networks that know nothing
def test_the_example_of_a_card_runs(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call.pipe.save_pretrained("saved")
    example = re.search(r"```python\n(.*?)```", Path("saved/README.md").read_text(), re.DOTALL)[1]
    exec(example, {})  # noqa: S102 - what people copy
    assert Image.open("output.png").size == (16, 16)


@pytest.mark.parametrize("by", ["push_to_hub", "save_pretrained"])
def test_an_upload_holds_the_card_and_all_that_loaders_need(pipe, tmp_path, monkeypatch, by):
    uploaded: dict[str, str] = {}

    def upload(self, folder, repo_id, *args):
        files = [file for file in Path(folder).rglob("*") if file.is_file()]
        uploaded.update({str(f.relative_to(folder)): f.read_text() if f.suffix == ".md" else "" for f in files})

    repository = huggingface_hub.RepoUrl(f"https://huggingface.co/{REPOSITORY}")
    monkeypatch.setattr("unitouch_gen.pipelines.base.create_repo", lambda *_, **__: repository)
    monkeypatch.setattr(TouchToImagePipeline, "_upload_folder", upload)
    if by == "push_to_hub":
        pipe.push_to_hub(REPOSITORY, variant="fp16")
    else:
        pipe.save_pretrained(tmp_path / "saved", push_to_hub=True, repo_id=REPOSITORY, variant="fp16")
    assert {"README.md", "model_index.json", "pipeline.py", "unitouch/pipeline.py", "processor/pipeline.py",
            "unitouch/model.fp16.safetensors"} <= set(uploaded)  # fmt: skip
    assert f'TouchToImagePipeline.from_pretrained("{REPOSITORY}")' in uploaded["README.md"]
