"""Training by its stages: `python -m unitouch_gen.training STAGE`."""

import sys

from unitouch_gen.commands import run_commands, wait_passively

if __name__ == "__main__":
    wait_passively()
    from unitouch_gen.training.commands import app  # imports torch

    sys.exit(run_commands(app, "unitouch_gen.training", prog_name="python -m unitouch_gen.training"))
