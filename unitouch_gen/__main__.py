"""`python -m unitouch_gen`: the same as `unitouch-gen`, also if its folder is not on the path."""

from unitouch_gen.cli import main

if __name__ == "__main__":
    main()
