"""Every figure the README quotes, measured on the held-out split: `python -m unitouch_gen.bench`."""
