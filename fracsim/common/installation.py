"""Where this fracsim was installed from, and so the command that adds an extra to it.

Used when a message has to name that command. The name ``fracsim`` on PyPI belongs to another project, so no message
may print ``pip install fracsim``.
"""

from __future__ import annotations

import json
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

DISTRIBUTION = "fracsim-pybullet"  # as pip knows it; the import and the command are called fracsim
CONSTRAINTS = "constraints.txt"  # of a checkout


def install_command(extra: str) -> str:
    """Write the command that installs fracsim with an extra, from where this fracsim came from.

    Parameters
    ----------
    extra : str
        A name under ``project.optional-dependencies`` in pyproject.toml.

    Returns
    -------
    str
        A ``pip install`` command for a shell: of the checkout that this module lies in, of the file or repository that
        pip recorded when it installed fracsim, or, if neither is known, of the distribution by its name.
    """
    checkout = Path(__file__).resolve().parents[2]
    if _is_checkout(checkout):
        # The constraints pin PyTorch; an unpinned one may bring gigabytes of CUDA.
        pinned = f'-c "{checkout / CONSTRAINTS}" ' if (checkout / CONSTRAINTS).is_file() else ""
        return f'pip install {pinned}-e "{checkout}[{extra}]"'
    source = _recorded_source()
    if source is None:
        return f'pip install "{DISTRIBUTION}[{extra}]"'
    url = str(source["url"])
    if not url.startswith("file:"):
        version_control = source.get("vcs_info", {})
        prefix = f"{version_control['vcs']}+" if version_control else ""
        suffix = f"@{version_control['commit_id']}" if version_control else ""
        return f'pip install "{DISTRIBUTION}[{extra}] @ {prefix}{url}{suffix}"'
    path = Path(url2pathname(urlsplit(url).path))
    if not path.exists():  # deleted since
        return f'pip install "{DISTRIBUTION}[{extra}]"'
    editable = "-e " if source.get("dir_info", {}).get("editable") else ""
    return f'pip install {editable}"{path}[{extra}]"'


def _is_checkout(folder: Path) -> bool:
    """Tell whether a folder holds fracsim's own pyproject.toml."""
    try:
        return f'name = "{DISTRIBUTION}"' in (folder / "pyproject.toml").read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return False


def _recorded_source() -> dict[str, dict[str, object]] | None:
    """Read what pip wrote down when it installed fracsim (PEP 610), None where it came from an index."""
    from importlib.metadata import distributions  # takes a while to import, and only errors need it

    for distribution in distributions(name=DISTRIBUTION):
        text = distribution.read_text("direct_url.json")
        if text:
            return json.loads(text)
    return None
