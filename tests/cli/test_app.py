"""The page of `unitouch-gen app`, asked as its own script in a browser asks it: bad input, stops, what it reaches."""

import json
import os
import signal
import socket
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
import torch

from tests.helpers import components
from tests.helpers.processes import Child, command_in
from unitouch_gen.cli.app import isolate_gradio
from unitouch_gen.pipelines import TouchToTextPipeline

gradio = pytest.importorskip("gradio", reason="the extra `app` is not installed")

STEPS = 1000  # of a job that has to be stopped: its UNet waits 10 ms in each


def free_port(host="127.0.0.1"):
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server((host, 0), family=family) as free:
        return free.getsockname()[1]


class Visitor:
    """A browser session."""

    def __init__(self, address, session):
        self.http = httpx.Client(base_url=address, timeout=60, trust_env=False)
        self.session = session
        config = self.http.get("/config").json()
        self.components = {part["id"]: part for part in config["components"]}
        clicks = [one for one in config["dependencies"] if one["targets"][0][1] == "click"]
        number = next(place for place, one in enumerate(clicks) if one["queue"])  # the first tab's job
        self.expect, self.job, self.stop = clicks[number - 1 : number + 2]

    def upload(self, file, name=None):
        return self.http.post("/gradio_api/upload", files={"files": (name or Path(file).name, Path(file).read_bytes())})

    def press(self, event, data=()):
        path = "queue/join" if event["queue"] else "run/predict"
        body = {"data": [*data], "fn_index": event["id"], "session_hash": self.session}
        return self.http.post(f"/gradio_api/{path}", json=body).raise_for_status().json()

    def make(self, touch, **fields):
        """Presses the first tab's button, with values of fields by their labels."""
        data = []
        for number in self.job["inputs"]:
            props = self.components[number]["props"]
            value = fields.get(props["label"], props.get("value"))
            if props["label"] == "Touch":
                value = {"path": touch, "meta": {"_type": "gradio.FileData"}}
            data.append(value)
        self.press(self.expect)
        self.press(self.job, data)

    def messages(self):
        """What the server says of the session's jobs until they end."""
        with self.http.stream("GET", "/gradio_api/queue/data", params={"session_hash": self.session}) as answer:
            for line in answer.iter_lines():
                if line.startswith("data:"):
                    yield json.loads(line.removeprefix("data:"))

    def ended(self):
        """The last message of a job."""
        return [message for message in self.messages() if message["msg"] == "process_completed"][-1]

    def refused(self):
        """The error of a job."""
        message = self.ended()
        assert not message["success"]
        return message["output"]["error"]

    @contextmanager
    def open_tab(self):
        """Keeps the page open, as a browser does by a request that goes on."""
        with self.http.stream("GET", f"/gradio_api/heartbeat/{self.session}") as beat:
            lines = beat.iter_lines()  # which closes the request when it goes
            next(lines)
            yield


@pytest.fixture(scope="module")
def uploads(tmp_path_factory):
    """The folder that the page has for uploads; the environment is put back afterwards."""
    before = dict(os.environ)
    folder = tmp_path_factory.mktemp("uploads")
    isolate_gradio(str(folder))
    yield folder
    os.environ.clear()
    os.environ.update(before)


@pytest.fixture(scope="module")
def evaluations():
    """One entry for each evaluation of the UNet."""
    return []


@pytest.fixture(scope="module")
def failures():
    """Errors that the UNet raises next."""
    return []


@pytest.fixture(scope="module")
def address(uploads, evaluations, failures):
    """A page whose UNet takes 10 ms at least."""
    from unitouch_gen.cli.page import serving

    pipe = components.make_pipelines()["touch-to-image"]
    pipe.register_to_config(default_num_inference_steps=STEPS // 2)  # the field goes up to twice as many
    pipe.set_progress_bar_config(disable=True)

    def wait(*_):
        evaluations.append(1)
        if failures:
            raise failures.pop()
        time.sleep(0.01)

    pipe.unet.register_forward_pre_hook(wait)
    port = free_port()
    with serving({"touch-to-image": pipe}, "127.0.0.1", port):
        yield f"http://127.0.0.1:{port}"


@pytest.fixture
def visitor(address, request):
    return Visitor(address, request.node.name)


@pytest.fixture
def touch(visitor, here):
    """The path at the server of an upload."""
    (path,) = visitor.upload("in/dark.png").json()
    return path


def plain(message, *words):
    """Whether a message is one line with some words, and without folders of the server or HTML."""
    return all(word in message for word in words) and not any(sign in message for sign in ("\n", "/", "<", "\\"))


# Bad input ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "kind"),
    [
        ("photo.heic", b"\0\0\0\x18ftypheic\0\0\0\0mif1heic", "a HEIC photo"),
        ("notes.png", b"This is no picture.\n", "text"),
        ("empty.png", b"", "an empty file"),
        ("it's <b>1</b> & 100%.png", b"This is no picture.\n", "text"),
    ],
)
def test_the_kind_of_an_upload_that_is_no_image_is_named(visitor, tmp_path, capfd, name, content, kind):
    (tmp_path / "file").write_bytes(content)
    (path,) = visitor.upload(tmp_path / "file", name).json()
    visitor.make(path, Steps=2)
    shown = visitor.refused()
    assert plain(shown, "`touch` names", "cannot be read as an image", f"({kind})"), shown
    assert Path(path).name.partition("&")[0] in shown
    assert capfd.readouterr().err == ""


def test_an_upload_that_is_deleted_has_to_be_uploaded_again(visitor, touch, capfd):
    os.remove(touch)
    visitor.make(touch, Steps=2)
    shown = visitor.refused()
    assert plain(shown, "`touch`", "upload it again"), shown
    assert capfd.readouterr().err == ""


def test_a_large_upload_is_refused_in_a_line_and_leaves_nothing(visitor, tmp_path, uploads, capfd):
    before = sorted(path for path in uploads.rglob("*") if path.is_file())
    (tmp_path / "large.png").write_bytes(bytes(20 * 2**20 + 1))
    answer = visitor.upload(tmp_path / "large.png")
    assert answer.status_code == 413
    assert plain(answer.text, "maximum allowed size")
    assert sorted(path for path in uploads.rglob("*") if path.is_file()) == before
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("label", "value", "name"),
    [
        ("Seed", 1e30, "seed"),
        ("Seed", 2**64, "seed"),
        ("Seed", 0.5, "seed"),
        ("Pictures", 100, "num_images_per_prompt"),
        ("Steps", 0, "num_inference_steps"),
        ("Guidance", "much", "guidance_scale"),
        ("Tolerance", 7, "tolerance"),
        ("Tolerance", -1, "tolerance"),
        ("Sensor", "no such sensor", "sensor"),
    ],
)
def test_values_that_a_field_does_not_have_are_refused_by_name(visitor, touch, capfd, label, value, name):
    labels = [part["props"].get("label") or "" for part in visitor.components.values()]
    (full,) = {one for one in labels if one.startswith(label) and one != "Seed that was used"}
    visitor.make(touch, **{"Steps": 2, full: value})
    shown = visitor.refused()
    assert plain(shown, f"`{name}` is"), shown
    assert capfd.readouterr().err == ""


def test_fields_that_are_emptied_have_their_defaults(visitor, touch):
    visitor.make(touch, Steps=2, Guidance=None, Pictures=None, **{"Seed; a new one each time if empty": None})
    pictures, felt, report, seed = visitor.ended()["output"]["data"]
    assert len(pictures) == 1
    assert "2 steps" in report
    assert 0 <= int(seed) < 2**31
    assert "%" in felt


def test_what_does_not_fit_into_memory_is_told_in_a_line(visitor, touch, failures, capfd):
    failures.append(torch.OutOfMemoryError("CUDA out of memory.\nTried to allocate 20.00 GiB."))
    visitor.make(touch, Steps=2)
    assert plain(visitor.refused(), "not enough memory", "fewer pictures")
    assert capfd.readouterr().err == ""


# Stops ----------------------------------------------------------------------------------------------------------------


def test_a_closed_tab_ends_its_job(address, visitor, touch, evaluations):
    evaluations.clear()
    with visitor.open_tab():
        visitor.make(touch, Steps=STEPS)
        for message in visitor.messages():
            if message["msg"] == "progress":
                break
    following = Visitor(address, "the next user")
    following.make(touch, Steps=2)
    assert following.ended()["success"]
    assert 2 < len(evaluations) < STEPS


def test_stop_ends_a_job_and_one_that_waits(address, visitor, touch, evaluations):
    evaluations.clear()
    waiting = Visitor(address, "one who waits")
    said = []
    visitor.make(touch, Steps=STEPS)
    for message in visitor.messages():
        if message["msg"] == "progress" and "progress" not in said:
            waiting.make(touch, Steps=STEPS)
            waiting.press(waiting.stop)
            visitor.press(visitor.stop)
        said.append(message.get("log") or message["msg"])
        if message["msg"] == "process_completed":
            assert message["success"]
            assert all(one == {"__type__": "update"} for one in message["output"]["data"])
    assert "Stopped." in said
    assert "Stopped." in [message.get("log") for message in waiting.messages()]
    assert 0 < len(evaluations) < STEPS


def test_stop_without_a_job_does_nothing_to_the_next_one(visitor, touch):
    visitor.press(visitor.stop)
    visitor.make(touch, Steps=2)
    assert visitor.ended()["success"]


def test_an_answer_ends_at_the_next_token(here):
    from unitouch_gen.cli.page import StoppedError, answer

    parts = components.make_components()
    joint = {name: parts[name] for name in ("unitouch", "processor")}
    pipe = TouchToTextPipeline(**components.make_language_parts(), **joint)
    steps = []

    def check():
        steps.append(1)
        if len(steps) == 3:
            raise StoppedError

    with pytest.raises(StoppedError):
        answer(pipe, "touch-to-text", {"touch": "in/dark.png", "question": "How?"}, gradio.Progress(), check)
    assert len(steps) == 3


# What the page reaches, and who reaches it ----------------------------------------------------------------------------

CONNECTED: list = []  # addresses, since a test asked for them
_LISTENING = threading.Event()


def _note(event, args):
    if event == "socket.connect" and _LISTENING.is_set():
        CONNECTED.append(args[1])


@pytest.fixture
def connected():
    """Addresses that the process connects to."""
    if not _LISTENING.is_set() and not CONNECTED:
        sys.addaudithook(_note)
    CONNECTED.clear()
    _LISTENING.set()
    yield CONNECTED
    _LISTENING.clear()


@pytest.mark.parametrize("url", ["http://192.88.99.1/picture.png", "https://huggingface.co/picture.png"])
def test_addresses_in_place_of_files_are_not_fetched(address, connected, capfd, url):
    visitor = Visitor(address, "a new one")
    assert visitor.http.get(f"/gradio_api/file={url}").status_code == 403
    visitor.make(url, Steps=2)
    assert "upload the file" in visitor.refused()
    assert capfd.readouterr().err == ""
    assert {host for host, *_ in connected} == {"127.0.0.1"}


@pytest.mark.slow
def test_the_page_is_for_this_machine_whatever_the_environment_says_and_tidies_up(here, models, tmp_path, files):
    try:
        host = "::1"
        port = free_port("::1")
    except OSError:  # a machine without IPv6
        host = "127.0.0.1"
        port = free_port()
    (tmp_path / "temporary").mkdir()
    dead = f"127.0.0.1:{free_port()}"
    environment = {
        "KAGGLE_KERNEL_RUN_TYPE": "Interactive",
        "GRADIO_SHARE": "True",
        "GRADIO_ALLOWED_PATHS": "/",
        "GRADIO_SERVER_NAME": "0.0.0.0",
        "GRADIO_MCP_SERVER": "True",
        "GRADIO_ANALYTICS_ENABLED": "True",
        "http_proxy": f"http://{dead}",
        "https_proxy": f"http://{dead}",
        "all_proxy": f"socks5://{dead}",
        "TMPDIR": str(tmp_path / "temporary"),
    }
    words = ["app", "--host", host, "--port", str(port), "--model", models["touch-to-image"]]
    before = files(here)
    child = Child(command_in, environment, *words, folder=here)
    while not (child.notes / "out").exists() or "The page is at" not in child.out:
        assert child.process.is_alive(), child.err
        time.sleep(0.1)
    address = child.out.split()[4]
    assert address == f"http://[{host}]:{port}/" or host == "127.0.0.1"
    visitor = Visitor(address, "one")
    (path,) = visitor.upload("in/dark.png").json()
    assert Path(path).is_relative_to(tmp_path / "temporary")
    assert visitor.http.get(f"/gradio_api/file={path}").status_code == 200
    assert visitor.http.get(f"/gradio_api/file={Path('in/dark.png').resolve()}").status_code == 403
    with visitor.open_tab():
        os.kill(child.process.pid, signal.SIGTERM)  # as `docker stop` does
        assert child.wait() == 0, child.err
    assert child.out.count("\n") == 1
    assert child.err == ""  # no tunnel, no server of tools
    assert list((tmp_path / "temporary").iterdir()) == []
    assert files(here) == before
