"""``python -m dvo`` is the command ``dvo``."""

import sys

from dvo.cli import main

sys.exit(main())
