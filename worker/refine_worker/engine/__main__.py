"""`python -m refine_worker.engine SLOT_PID ...`: bound to its slot first, for loading torch takes seconds."""

import sys

from ..lifeline import die_with_parent

die_with_parent(int(sys.argv[1]))

from .main import main  # noqa: E402

main(sys.argv[1:])
