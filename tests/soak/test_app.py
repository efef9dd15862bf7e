"""Clients of the page of `unitouch-gen app`: every request has its own answer, and memory stays."""

import os
import re
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from PIL import Image

from tests.helpers import served
from tests.helpers.processes import Child, command
from unitouch_gen.cli.pictures import generators

pytest.importorskip("gradio", reason="the extra `app` is not installed")

from gradio_client import Client, handle_file
from gradio_client.exceptions import AppError

pytestmark = pytest.mark.slow

CLIENTS, ROUNDS, EVERY = 8, 25, 10
"""Requests are 200; of ten, one is bad."""

TIMES = 3
"""The first 200 fill what is kept: what a process reads when it first needs it, and what its threads allocate from."""

GROWN = 8 * 2**20
"""Bytes that the process of the page may have more after 200 requests than before them, the first ones left out."""


@pytest.fixture
def page(saved: dict[str, Path], tmp_path: Path) -> Iterator[tuple[str, psutil.Process]]:
    """Address and process of a page that the command serves; the clients' memory is not its own."""
    models = [word for name in ("touch-to-image", "stylize", "x-to-touch") for word in ("--model", str(saved[name]))]
    (tmp_path / "page").mkdir()
    child = Child(command, "app", *models, folder=tmp_path / "page")
    assert child.process.pid is not None
    while not (found := re.search(r"The page is at (\S+)", child.out if (child.notes / "out").exists() else "")):
        assert child.process.is_alive(), child.err
        time.sleep(0.1)
    yield found[1], psutil.Process(child.process.pid)
    os.kill(child.process.pid, signal.SIGINT)
    assert child.wait() == 0, child.err


def test_two_hundred_requests_of_eight_clients(
    page: tuple[str, psutil.Process],
    given: Path,
    pipes: dict[str, Any],
    tmp_path: Path,
    record_property: Callable[[str, object], None],
) -> None:
    (address, process), touches = page, sorted((given / "touches").iterdir())
    bad = tmp_path / "bad.png"
    bad.write_text("no picture")

    def alone(touch: Path, seed: int) -> Image.Image:
        return pipes["touch-to-image"](touch, generator=generators(seed, [0])).images[0]

    expected = [alone(touches[client], client) for client in range(CLIENTS)]
    asking = [
        served.asking(Client(address, verbose=False, download_files=str(tmp_path / str(client))))
        for client in range(CLIENTS)
    ]

    def work(client: int) -> list[str]:
        found = []
        for turn in range(ROUNDS):
            number = turn * CLIENTS + client
            file = bad if number % EVERY == 0 else touches[client]
            try:
                (picture,), *_ = asking[client]("touch_to_image", touch=handle_file(file), seed=client)
            except AppError as error:
                found.append("refused" if "`touch` names 'bad.png'" in str(error) else str(error))
            else:
                found.append("right" if np.array_equal(Image.open(picture), expected[client]) else "another's")
        return found

    wanted, sizes = CLIENTS * ROUNDS // EVERY, [process.memory_info().rss]
    with ThreadPoolExecutor(CLIENTS) as pool:
        for _ in range(TIMES):
            found = [answer for answers in pool.map(work, range(CLIENTS)) for answer in answers]
            counts = {answer: found.count(answer) for answer in set(found)}
            assert counts == {"refused": wanted, "right": len(found) - wanted}
            sizes.append(process.memory_info().rss)
    grown = np.diff(sizes)
    record_property("requests", TIMES * len(found))
    record_property("refused", TIMES * wanted)
    record_property("MB_grown by each 200", ", ".join(f"{size / 1e6:.1f}" for size in grown))
    assert max(grown[1:]) < GROWN
