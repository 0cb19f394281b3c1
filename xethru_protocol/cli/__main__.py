"""``python -m xethru_protocol.cli``."""

import sys

from xethru_protocol.cli import main

sys.exit(main())
