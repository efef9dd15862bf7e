"""`python -m unitouch_gen`: what `unitouch-gen` does, also where its folder is not on the path."""

from unitouch_gen.cli import main

if __name__ == "__main__":
    main()
