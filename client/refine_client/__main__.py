"""`python -m refine_client`: the command `refine`."""

import sys

from .cli import main

sys.exit(main())
