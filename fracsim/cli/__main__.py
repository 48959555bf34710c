"""Run the command line as ``python -m fracsim.cli``.

Nothing imports this module.
"""

import sys

from .main import main

if __name__ == "__main__":
    sys.exit(main())
