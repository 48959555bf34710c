"""Copy the tables of benchmarks/results into the pages that name them: ``python benchmarks/tables.py``.

A block of a page begins with ``<!-- results/NAME.md -->`` and ends with ``<!-- end -->``; the text between is replaced.
"""

from __future__ import annotations

import re
from pathlib import Path

HERE = Path(__file__).parent
DOCS = HERE.parent / "docs"
PAGES = (HERE.parent / "README.md", DOCS / "simulators.md", DOCS / "results.md", DOCS / "runtime.md")
BLOCK = re.compile(r"(<!-- results/(\w+)\.md -->\n).*?(<!-- end -->)", re.DOTALL)


def filled(page: str) -> str:
    """Replace the blocks of a page by what their results files hold now.

    Parameters
    ----------
    page : str
        The text of a page.

    Returns
    -------
    str
        The same text with the blocks replaced.
    """

    def block_of(match: re.Match[str]) -> str:
        text = (HERE / "results" / f"{match[2]}.md").read_text(encoding="utf-8").strip()
        return f"{match[1]}\n{text}\n\n{match[3]}"

    return BLOCK.sub(block_of, page)


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(filled(page.read_text(encoding="utf-8")), encoding="utf-8")
