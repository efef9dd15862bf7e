"""`unitouch-gen app`: what its page answers, through gradio's own client and tiny random pipelines."""

import socket
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import soundfile
from PIL import Image

from tests.helpers import served
from tests.helpers.odd_values import SOUND
from unitouch_gen.cli.pictures import generators

pytest.importorskip("gradio", reason="the extra `app` is not installed")

from gradio_client import Client, handle_file
from gradio_client.exceptions import AppError


@pytest.fixture(scope="module")
def pipes(make_components, make_x_to_touch):
    return served.tiny_pipelines(make_components(), make_x_to_touch())


@pytest.fixture(scope="module")
def address(pipes, tmp_path_factory):
    with served.page(pipes, tmp_path_factory.mktemp("served")) as url:
        yield url


@pytest.fixture
def ask(address, tmp_path):
    """Asks one tab, and gives pictures, what they feel like, notes, the report and the seed."""
    return served.asking(Client(address, verbose=False, download_files=str(tmp_path / "downloads")))


def test_the_picture_is_the_one_that_the_pipeline_makes(here, ask, pipes):
    pictures, feels, _, report, seed = ask("touch_to_image", touch=handle_file("in/dark.png"), pictures=2, seed=3)
    alone = [pipes["touch-to-image"]("in/dark.png", generator=generators(3, [row])).images[0] for row in range(2)]
    assert [np.array_equal(Image.open(file), made) for file, made in zip(pictures, alone, strict=True)] == [True, True]
    assert [Path(file).name for file in pictures] == ["seed-3-1.png", "seed-3-2.png"] and seed == "3"
    assert "%" in feels
    assert "2 steps" in report and "%" not in report


def test_a_photo_is_restyled(here, ask):
    photo, touch = handle_file("in/dark.png"), handle_file("in/bright.png")
    pictures, feels, *_ = ask("stylize", photo=photo, touch=touch, init_strength=0.5, mix="linear")
    assert Image.open(pictures[0]).size == (16, 16) and feels == ""


@pytest.mark.parametrize(
    ("of", "given"),
    [
        ("words", {"text": "rough brick"}),
        ("a sound", {"audio": "in/knock.wav"}),
        ("a photo", {"image": "in/dark.png"}),
        ("another sensor's touch", {"touch": "in/bright.png", "source_sensor": "digit"}),
    ],
)
def test_a_touch_is_made_of_anything(here, ask, of, given):
    soundfile.write("in/knock.wav", *SOUND)
    sent = {name: handle_file(value) if value.startswith("in/") else value for name, value in given.items()}
    pictures, feels, *_ = ask("x_to_touch", of=of, sensor="digit", candidates=2, **sent)
    assert Path(pictures[0]).name == "seed-0-digit.png" and "%" in feels


def test_steps_follow_a_tolerance_or_a_number(here, ask):
    sent = {"touch": handle_file("in/dark.png")}
    assert "3 steps" in ask("touch_to_image", **sent, steps=3)[3]
    assert ask("touch_to_image", **sent, by="tolerance", tolerance=20)[3].startswith("adaptive: ")


def test_a_new_seed_each_time_is_told(here, ask):
    seeds = {ask("touch_to_image", touch=handle_file("in/dark.png"), new_seed=True)[4] for _ in range(2)}
    assert len(seeds) == 2


def write_inputs() -> None:
    """Files that cannot be used, beside dark.png and bright.png."""
    Path("in/words.png").write_text("no picture")
    Path("in/empty.png").touch()
    Path("in/cut.png").write_bytes(Path("in/dark.png").read_bytes()[:200])
    Path("in/large.png").write_bytes(bytes(21 * 2**20))
    soundfile.write("in/silence.wav", np.zeros(8000), 16000)


TOUCH_TO_IMAGE = {"api_name": "touch_to_image", "touch": "in/dark.png"}
X_TO_TOUCH = {"api_name": "x_to_touch"}


@pytest.mark.parametrize(
    ("sent", "said"),
    [
        (TOUCH_TO_IMAGE | {"touch": None}, "`touch` is missing"),
        (TOUCH_TO_IMAGE | {"touch": "in/words.png"}, "`touch` names 'words.png', which"),
        (TOUCH_TO_IMAGE | {"touch": "in/empty.png"}, "`touch` names 'empty.png', which"),
        (TOUCH_TO_IMAGE | {"touch": "in/cut.png"}, "`touch` names 'cut.png', which"),
        (TOUCH_TO_IMAGE | {"seed": -1}, "`seed` is -1"),
        (TOUCH_TO_IMAGE | {"pictures": 1000}, "1000"),
        (TOUCH_TO_IMAGE | {"steps": 0}, "0"),
        (X_TO_TOUCH | {"text": " "}, "`text`"),
        (X_TO_TOUCH | {"of": "a sound", "audio": "in/silence.wav"}, "`audio`"),
        (X_TO_TOUCH | {"of": "a sound", "audio": "in/dark.png"}, "`audio`"),
        (X_TO_TOUCH | {"of": "a photo"}, "`image` is missing"),
    ],
)  # fmt: skip
def test_mistakes_are_one_line_in_the_words_of_the_commands(here, ask, sent, said):
    write_inputs()
    sent = {name: handle_file(value) if str(value).startswith("in/") else value for name, value in sent.items()}
    with pytest.raises(AppError) as refused:
        ask(sent.pop("api_name"), **sent)
    line = str(refused.value)
    assert said in line and "\n" not in line and "/" not in line.replace("in/", "") and "Traceback" not in line


def test_nothing_is_fetched_from_an_address(here, ask):
    """Neither as a file, nor beside one."""
    for file in ({"path": "http://127.0.0.1:9/x.png"}, {"path": "https://example.org/x.png", "url": "x"}):
        with pytest.raises(AppError, match=r"address|fetch|URL"):
            ask("touch_to_image", touch=file | {"meta": {"_type": "gradio.FileData"}})


def test_uploads_are_bounded(here, ask):
    write_inputs()
    with pytest.raises(Exception, match=r"(?i)size|large|413"):
        ask("touch_to_image", touch=handle_file("in/large.png"))


def test_clients_side_by_side_get_their_own(here, address, pipes, tmp_path):
    def work(client: int) -> list[bool]:
        ask = served.asking(Client(address, verbose=False, download_files=str(tmp_path / str(client))))
        found = []
        for seed in (client, client + 10):
            made = Image.open(ask("touch_to_image", touch=handle_file("in/dark.png"), seed=seed)[0][0])
            found.append(np.array_equal(made, alone[seed]))
        return found

    seeds = [*range(3), *range(10, 13)]
    alone = {s: pipes["touch-to-image"]("in/dark.png", generator=generators(s, [0])).images[0] for s in seeds}
    with ThreadPoolExecutor(3) as pool:
        assert list(pool.map(work, range(3))) == [[True, True]] * 3


def test_the_page_names_no_other_host(address):
    import httpx

    html = httpx.get(address).text
    assert "fonts.googleapis" not in html and '"share_url":"http' not in html


# The command ----------------------------------------------------------------------------------------------------------


def test_without_gradio_it_says_what_to_install(command, refused, monkeypatch):
    monkeypatch.setitem(sys.modules, "gradio", None)
    refused(command("app"), "gradio", "pip install 'unitouch_gen[app]'")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--port", 0], "`--port` is 0"),
        (["--host", "no.such.host.invalid"], "`--host` is 'no.such.host.invalid'"),
        (["--host", ""], "`--host` is ''"),
        (["--queue", 0], "`--queue` is 0"),
        (["--model", "gone"], "`--model` is 'gone', which is no folder"),
        (["--device", "tpu"], "'tpu'"),
    ],
)
def test_mistakes_on_the_command_line(command, refused, here, words, said):
    refused(command("app", *words), said)


def test_a_port_that_is_taken_is_refused(command, refused, here):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        refused(command("app", "--port", port), f"port {port} cannot be served")


def test_two_pipelines_of_a_kind_have_no_tab_each(command, refused, models):
    refused(command("app", "--model", models["stylize"], "--model", models["stylize"]), "two pipelines for stylization")
