"""`python -m refine_worker`: the same as `refine worker`."""

import sys

from .command import worker_command

sys.exit(worker_command(sys.argv[1:]))
