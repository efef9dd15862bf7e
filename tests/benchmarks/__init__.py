"""Every figure that README.md and docs/ quote, measured on the held-out split: `python -m tests.benchmarks`."""
