"""TODO cli.output."""

from __future__ import annotations

from typing import Any


def print_figures(metadata: dict[str, Any]) -> None:
    for group in ("counts", "splits", "kinds", "pieces", "seconds", "test"):
        if group in metadata:
            print(f"  {group}")
        for key, value in metadata.get(group, {}).items():
            print(f"    {key:<36}{value:>12.5g}" if isinstance(value, float) else f"    {key:<36}{value:>12}")
