"""`unitouch-gen convert unitouch`."""

from pathlib import Path

import pytest
import torch

from tests.helpers.published_files import published, small
from unitouch_gen.models import UniTouchModel


@pytest.fixture(scope="module")
def given(tmp_path_factory) -> Path:
    """A folder with UniTouch's and ImageBind's files, and the config.json of their size."""
    folder = tmp_path_factory.mktemp("published")
    published(folder, small())
    small().save_pretrained(folder)
    return folder


@pytest.fixture
def run(command, given, tmp_path, monkeypatch):
    """Runs the command in an empty folder, with the files of `given` in place of "TOUCH" and "IMAGEBIND"."""
    monkeypatch.chdir(tmp_path)
    files = {
        "TOUCH": given / "last_new.ckpt",
        "IMAGEBIND": given / "imagebind_huge.pth",
        "CONFIG": given / "config.json",
    }
    return lambda *args: command("convert", "unitouch", *(files.get(arg, arg) for arg in args))


def test_both_files_become_a_folder(run, tmp_path):
    code, out, err = run("--touch", "TOUCH", "--imagebind", "IMAGEBIND", "--config", "CONFIG", "-o", "model")
    assert (code, err) == (0, "")
    assert "Used of last_new.ckpt: modality_heads.touch (3)" in out and "Ignored of " in out and "CC-BY-NC-4.0" in out
    assert UniTouchModel.from_pretrained(tmp_path / "model").known_modalities == ("image", "text", "audio", "touch")


def test_the_dtype_is_a_name(run, tmp_path):
    code, *_ = run("--touch", "TOUCH", "--config", "CONFIG", "-o", "model", "--dtype", "bfloat16")
    assert code == 0
    model = UniTouchModel.from_pretrained(tmp_path / "model", modalities=("touch",), dtype=torch.bfloat16)
    assert model.touch_model.projection.weight.dtype == torch.bfloat16


@pytest.mark.parametrize(
    ("args", "words"),
    [
        ((), "Nothing to convert came; pass `--touch`, `--imagebind` or both"),
        (("--touch", "gone.ckpt"), "`touch` names 'gone.ckpt', which does not exist"),
        (("--touch", "TOUCH"), "not laid out as the published touch encoder"),
        (("--touch", "IMAGEBIND", "--config", "CONFIG"), "misses modality_preprocessors.touch.cls_token"),
        (("--touch", "IMAGEBIND"), "It may be the one to pass as `--imagebind`"),
        (("--touch", "CONFIG"), "cannot be read as a checkpoint"),
        (("--touch", "TOUCH", "--config", "CONFIG", "--dtype", "float64"), "`dtype` is torch.float64"),
        (("--touch", "TOUCH", "--config", "gone.json"), "`--config` names 'gone.json', which does not exist"),
        (("--touch", "TOUCH", "--config", "IMAGEBIND"), "which cannot be read as JSON"),
        (("--touch", "TOUCH", "--config", "CONFIG", "--tokenizer", "gone"), "`--tokenizer` names 'gone'"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(run, tmp_path, args, words):
    code, out, err = run(*args, "-o", "model")
    assert (code, out) == (2, "")
    assert err.count("\n") == 1 and words in err
    assert list(tmp_path.iterdir()) == []
