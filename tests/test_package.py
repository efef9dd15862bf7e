"""What an install can break: modules, data files, commands, and the built-in pipelines."""

import os
import pkgutil
import re
import runpy
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import distribution, metadata, packages_distributions
from importlib.resources import files
from pathlib import Path

import pytest
from markdown_it import MarkdownIt

import unitouch_gen.pipelines
import unitouch_gen.training
from unitouch_gen.examples import example, examples
from unitouch_gen.training.family import STAGES

CHECKOUT = Path(__file__).resolve().parents[1]
TRACKED = CHECKOUT / "tracked.txt"
pytestmark = pytest.mark.wheel


def run(words: Sequence[str], folder: Path) -> str:
    """What a Python of this environment prints, started in `folder`."""
    done = subprocess.run(
        [sys.executable, *words], cwd=folder, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_module_imports():
    packages = (unitouch_gen, unitouch_gen.pipelines, unitouch_gen.training)
    found = (pkgutil.walk_packages(package.__path__, f"{package.__name__}.") for package in packages)
    modules = {module.name for modules in found for module in modules}
    for module in modules:
        if not module.endswith("__main__"):  # runs a command
            import_module(module)
    assert {"unitouch_gen.pipelines.tiny", "unitouch_gen.training.touch", "unitouch_gen.world.scene"} <= modules


@pytest.mark.skipif(not TRACKED.is_file(), reason="`.ci/run` lists what git tracks for the wheel")
def test_the_wheel_holds_every_file_of_the_package():
    tracked = {re.sub("^(pipelines|training)/", r"unitouch_gen/\1/", line) for line in TRACKED.read_text().split()}
    links = {"unitouch_gen/pipelines", "unitouch_gen/training"}
    installed = {str(file) for file in distribution("unitouch_gen").files or () if file.parts[0] == "unitouch_gen"}
    assert {file for file in installed if "__pycache__" not in file} == tracked - links


@pytest.mark.skipif(not (CHECKOUT / "pipelines").is_dir(), reason="there is no checkout here")
def test_the_build_names_every_package():
    settings = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["tool"]["setuptools"]
    folders = {"unitouch_gen": "unitouch_gen", **{folder: name for name, folder in settings["package-dir"].items()}}
    found = set()
    for folder, package in folders.items():
        for file in (CHECKOUT / folder).rglob("__init__.py"):
            found.add(".".join([package, *file.parent.relative_to(CHECKOUT / folder).parts]))
    assert found == {*settings["packages"]}


def test_nothing_else_is_installed_at_the_top_level():
    ours = {top for top, owners in packages_distributions().items() if "unitouch_gen" in owners}
    assert {top for top in ours if not top.startswith("__editable__")} == {"unitouch_gen"}


def targets(text: str) -> list[str]:
    """Where the pictures and links of Markdown lead."""
    parts = [part for token in MarkdownIt().enable("table").parse(text) for part in token.children or ()]
    return [part.attrs.get("src") or part.attrs["href"] for part in parts if part.type in ("image", "link_open")]


@pytest.mark.skipif((CHECKOUT / "pipelines").is_dir(), reason="an editable install has the README of when it was made")
def test_nothing_is_relative_in_what_an_index_shows():
    about = metadata("unitouch_gen")
    text = about["Description"] or about.get_payload()
    assert "## Anything to touch" in text
    assert about["Description-Content-Type"] == "text/markdown"
    assert targets(text)
    assert all(re.match("https?://", target) for target in targets(text))


without_setup = pytest.mark.skipif(not (CHECKOUT / "setup.py").is_file(), reason="there is no checkout here")


@without_setup
def test_the_readme_becomes_one_without_files_beside_it():
    """All that it links to, at the repository's address, or what has an address anyway."""
    described = runpy.run_path(str(CHECKOUT / "setup.py"))["described"]
    text = (CHECKOUT / "README.md").read_text()
    url = "https://host.example/owner/unitouch_gen"
    absolute = [target for target in targets(text) if re.match("https?://", target)]
    expected = [
        target
        if target in absolute
        else f"{url}/{'raw' if target.endswith(('.png', '.jpg')) else 'blob'}/HEAD/{target}"
        for target in targets(text)
    ]
    assert targets(described(text, url)) == expected
    assert targets(described(text, "")) == absolute


@without_setup
def test_an_address_that_is_none_is_refused():
    done = subprocess.run(
        [sys.executable, CHECKOUT / "setup.py", "--version"],
        env={**os.environ, "UNITOUCH_GEN_URL": "host/owner"},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode
    assert "UNITOUCH_GEN_URL is 'host/owner'" in done.stderr


def test_data_files_are_installed():
    for name in (
        "py.typed",
        "examples/gelsight_brick.png",
        "examples/photos/wood.png",
        "examples/sounds/metal.wav",
        "examples/heights/coin.png",
        "weights/cards/stylization.jpg",
        "weights/family.json",
        "weights/joint/model.safetensors",
        "weights/joint/tokenizer.json",
        "weights/touch-classifier/model.safetensors",
        "world/calibrated_sensors.json",
        "world/collection/index.csv",
        "world/collection/sounds/wood__default_dig_choppy_1.flac",
        "world/collection/surfaces/wood__polyhaven_worn_planks.height.webp",
    ):
        assert files("unitouch_gen").joinpath(name).is_file(), name
    assert files("unitouch_gen.training").joinpath("recipes/touch.yaml").is_file()


def test_examples_go_by_what_they_are_of():
    """And no two touches are of one material, or one would hide the other."""
    for modality in ("touch", "image", "audio", "height"):
        known = examples(modality)
        assert known
        assert all(example(name, modality) == file for name, file in known.items())
    assert {example(name.rpartition("_")[2]) for name in examples()} == set(examples().values())


@pytest.mark.skipif(not (CHECKOUT / "unitouch_gen" / "pipelines").is_dir(), reason="there is no clone with links here")
def test_a_clone_imports_as_it_lies():
    """Even without site-packages, where an editable install would lend it what it lacks."""
    words = "import unitouch_gen, importlib.util as u; print(u.find_spec('unitouch_gen.pipelines').origin)"
    found = Path(run(["-I", "-S", "-c", f"import sys; sys.path.insert(0, ''); {words}"], CHECKOUT).strip())
    assert found == CHECKOUT / "unitouch_gen" / "pipelines" / "__init__.py"


TWICE = """
import pipelines.base, training.stages
from pipelines import TouchToImagePipeline
from pipelines.touch_to_image import TouchToImagePipeline as of_its_module
from training.data import Contacts
from unitouch_gen.pipelines.base import UniTouchPipeline
import unitouch_gen.training.data, unitouch_gen.training.stages

assert pipelines.base.UniTouchPipeline is UniTouchPipeline
assert TouchToImagePipeline is of_its_module and issubclass(of_its_module, UniTouchPipeline)
assert training.stages.Stage is unitouch_gen.training.stages.Stage
assert Contacts is unitouch_gen.training.data.Contacts
"""


@pytest.mark.slow
@pytest.mark.skipif(not (CHECKOUT / "pipelines").is_dir(), reason="there is no checkout here")
def test_folders_imported_by_their_own_names_make_no_class_twice():
    run(["-c", TWICE], CHECKOUT)


def test_the_command_line_answers(tmp_path):
    assert "touch-to-image" in run([str(Path(sys.executable).with_name("unitouch-gen")), "--help"], tmp_path)


def test_the_package_runs_as_a_module(tmp_path):
    assert run(["-m", "unitouch_gen", "--version"], tmp_path) == f"unitouch_gen {unitouch_gen.__version__}\n"


def test_training_runs_as_a_module(monkeypatch, capsys):
    """In this process, as a new one takes ten seconds to import it."""
    monkeypatch.setattr(sys, "argv", ["training", "--help"])
    with pytest.raises(SystemExit, match=r"^(0|None)$"):
        runpy.run_module("unitouch_gen.training", run_name="__main__", alter_sys=True)
    helped = capsys.readouterr().out
    assert all(f" {stage} " in helped for stage in STAGES)


WATCHED = """
import os, runpy, sys

class Watch:
    def find_spec(self, name, path=None, target=None):
        if name == "torch":
            print("torch is imported with", os.environ.get("OMP_WAIT_POLICY"), flush=True)
            os._exit(0)  # importing it takes seconds

sys.meta_path.insert(0, Watch())
sys.argv = ["training", "touch", "--help"]
runpy.run_module("unitouch_gen.training", run_name="__main__")
"""


@pytest.mark.parametrize(("own", "policy"), [(None, "PASSIVE"), ("ACTIVE", "ACTIVE")])
def test_threads_of_training_wait_passively_unless_the_user_said_otherwise(own, policy, tmp_path, monkeypatch):
    """OpenMP reads the variable when torch is imported."""
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    if own is not None:
        monkeypatch.setenv("OMP_WAIT_POLICY", own)
    assert run(["-c", WATCHED], tmp_path).splitlines()[0] == f"torch is imported with {policy}"


def test_built_in_pipelines_run():
    touch = unitouch_gen.example("brick")
    photo = unitouch_gen.example("wood", "image")
    for name, inputs in {
        "touch-to-image": {"touch": touch},
        "x-to-touch": {"text": "rough brick"},
        "stylization": {"image": photo, "touch": touch},
    }.items():
        pipe = unitouch_gen.tiny(name)
        pipe.set_progress_bar_config(disable=True)
        output = pipe(**inputs, num_inference_steps=2)
        assert output.images[0].size == (128, 128)
        assert output.report.success
