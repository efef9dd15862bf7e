"""`python -m unitouch_gen.cli`, where `unitouch-gen` is not on the path."""

from unitouch_gen.cli import main

main()
