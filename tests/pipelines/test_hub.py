"""Folders in other hands: diffusers' own loader, transformers' Auto classes, model cards, uploads."""

import re
from pathlib import Path

import huggingface_hub
import pytest
from diffusers import DiffusionPipeline
from huggingface_hub import ModelCard
from PIL import Image
from torch.testing import assert_close

from tests.helpers.calls import Call, quiet
from unitouch_gen.pipelines import TouchToImagePipeline
from unitouch_gen.pipelines.hub import Card

REPOSITORY = "someone/touch"


def test_diffusers_own_loader_reads_a_saved_folder(call, tmp_path):
    call.pipe.save_pretrained(tmp_path)
    loaded = quiet(DiffusionPipeline.from_pretrained(tmp_path, trust_remote_code=True))
    assert type(loaded) is type(call.pipe)
    assert_close(Call(loaded, call.inputs).latents(), call.latents(), atol=1e-5, rtol=1e-5)
    with pytest.raises(ValueError, match="trust_remote_code=True"):
        DiffusionPipeline.from_pretrained(tmp_path)


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


def test_our_loader_reads_a_repository(family, touch, monkeypatch):
    monkeypatch.setattr(huggingface_hub, "snapshot_download", lambda repo_id, **options: str(family))
    pipe = TouchToImagePipeline.from_pretrained(REPOSITORY)
    assert pipe.name_or_path == REPOSITORY
    assert pipe.encode_touch(touch).shape == (2, 16)


def test_a_card_is_one_that_huggingface_reads(pipe, tmp_path):
    Image.new("RGB", (8, 8)).save(tmp_path / "shown.png")
    card = Card(
        description="Touches of bricks.",
        figures={"bricks named right": 0.5},
        data="Bricks.",
        license="apache-2.0",
        limits="No tiles.",
        pictures={"A brick": tmp_path / "shown.png"},
    )
    pipe.save_pretrained(tmp_path / "one", card=card)
    read = ModelCard.load(tmp_path / "one" / "README.md")
    assert (read.data.license, read.data.library_name) == ("apache-2.0", "diffusers")
    for said in ("Touches of bricks.", "| bricks named right | 0.5 |", "Bricks.", "No tiles."):
        assert said in read.text
    assert Image.open(tmp_path / "one" / re.search(r"!\[A brick\]\((.*)\)", read.text)[1]).size == (8, 8)
    pipe.save_pretrained(tmp_path / "one", card=Card(description="ours"))  # which one that is there gives way to
    assert "ours" in (tmp_path / "one" / "README.md").read_text()


@pytest.mark.filterwarnings("ignore::unitouch_gen.errors.UnfamiliarInputWarning")  # of networks that know nothing
def test_the_example_of_a_card_runs(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call.pipe.save_pretrained("saved")
    exec(re.search(r"```python\n(.*?)```", Path("saved/README.md").read_text(), re.DOTALL)[1], {})  # noqa: S102
    assert Image.open("output.png").size == (16, 16)


def test_an_upload_holds_the_card_and_all_that_loaders_need(pipe, tmp_path, monkeypatch):
    uploaded = {}
    repository = huggingface_hub.RepoUrl(f"https://huggingface.co/{REPOSITORY}")

    def upload(self, folder, repo_id, **options):
        files = [file for file in Path(folder).rglob("*") if file.is_file()]
        uploaded.update({str(f.relative_to(folder)): f.read_text() if f.suffix == ".md" else "" for f in files})

    monkeypatch.setattr("unitouch_gen.pipelines.base.create_repo", lambda *_, **__: repository)
    monkeypatch.setattr(TouchToImagePipeline, "_upload_folder", upload)
    pipe.save_pretrained(tmp_path / "saved", push_to_hub=True, repo_id=REPOSITORY, variant="fp16")
    needed = {"model_index.json", "pipeline.py", "unitouch/pipeline.py", "unitouch/model.fp16.safetensors"}
    assert needed <= set(uploaded)
    assert f'TouchToImagePipeline.from_pretrained("{REPOSITORY}")' in uploaded["README.md"]
