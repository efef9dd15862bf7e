"""The commit that a record names: of the checkout that the code is from, if it is from one."""

import subprocess
from pathlib import Path

import pytest

from unitouch_gen.training.stages import commit


def git(folder: Path, *words: str) -> str:
    identity = ["-c", "user.name=A", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false"]
    command = ["git", "-C", str(folder), *identity, *words]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    git(tmp_path, "init", "--quiet")
    (tmp_path / "training").mkdir()
    (tmp_path / "training" / "stages.py").write_text("1\n")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "--message", "Begin")
    return tmp_path


def test_the_commit_is_the_checkouts(checkout: Path) -> None:
    (checkout / "untracked").touch()
    found = commit(checkout / "training" / "stages.py")
    assert found == git(checkout, "rev-parse", "HEAD")[:12]


def test_a_commit_from_which_tracked_files_differ_is_dirty(checkout: Path) -> None:
    clean = commit(checkout / "training" / "stages.py")
    (checkout / "training" / "stages.py").write_text("2\n")
    assert commit(checkout / "training" / "stages.py") == f"{clean}-dirty"


def test_a_tag_does_not_hide_the_commit(checkout: Path) -> None:
    git(checkout, "tag", "--annotate", "v1", "--message", "One")
    assert commit(checkout / "training" / "stages.py") == git(checkout, "rev-parse", "HEAD")[:12]


def test_what_is_installed_in_a_checkout_has_no_commit(checkout: Path) -> None:
    installed = checkout / ".venv" / "stages.py"
    installed.parent.mkdir()
    installed.touch()
    assert commit(installed) is None


def test_outside_of_a_checkout_there_is_no_commit(tmp_path: Path) -> None:
    (tmp_path / "stages.py").touch()
    assert commit(tmp_path / "stages.py") is None


def test_without_git_there_is_no_commit(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert commit(checkout / "training" / "stages.py") is None
