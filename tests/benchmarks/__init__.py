"""Every figure the README quotes, measured on the held-out split: `python -m tests.benchmarks`."""

from typing import Any

Figures = dict[str, Any]
"""What was measured, by name: plain values, for JSON."""
