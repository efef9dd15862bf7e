"""How commands end on an error."""

import warnings

import pytest
import typer

from unitouch_gen.commands import run_commands
from unitouch_gen.errors import InvalidInputError, NonFiniteError, UnfamiliarInputWarning


@pytest.mark.parametrize("error", [InvalidInputError("a\nb"), NonFiniteError("a\nb"), typer.BadParameter("a\nb")])
def test_a_mistake_is_one_line_and_exit_code_2(error, capsys):
    app = typer.Typer()

    @app.command()
    def command() -> None:
        raise error

    with pytest.raises(SystemExit) as ended:
        run_commands(app, "unitouch-gen", [])
    assert ended.value.code == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.count("\n") == 1
    assert err.startswith("unitouch-gen: ")
    assert "a b" in err


def test_a_working_folder_that_was_deleted_is_one_line(tmp_path, monkeypatch, capsys):
    """torch would end the process as it is imported."""
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    with pytest.raises(SystemExit, match="2"):
        run_commands(typer.Typer(), "unitouch-gen", [])
    assert capsys.readouterr().err.startswith("unitouch-gen: The working folder has been deleted; ")


def test_warnings_of_ours_are_lines_and_others_are_left_out(capsys):
    app = typer.Typer()

    @app.command()
    def command() -> None:
        warnings.warn("a touch", UnfamiliarInputWarning, stacklevel=2)
        warnings.warn_explicit("theirs", UserWarning, "file", 1, module="diffusers.models")

    run_commands(app, "unitouch-gen", [])
    assert capsys.readouterr().err == "unitouch-gen: a touch\n"
