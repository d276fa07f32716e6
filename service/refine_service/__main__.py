"""`python -m refine_service`: the service without the command `refine`, for `refine serve`."""

import sys

from .commands.service import service_command

sys.exit(service_command(sys.argv[1:]))
