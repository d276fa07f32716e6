"""Whether a slot of this pod is warm: exit code 0 if one is. The worker's readiness probe."""

import os
import socket
import sys

from refine_jobs import keys
from refine_jobs.redis_server import connect
from refine_jobs.slots import SlotStatus

with connect(os.environ["REFINE_REDIS_URL"]) as server:
    names = [name for name in server.zrange(keys.SLOTS, 0, -1) if name.startswith(socket.gethostname() + "-")]
    found = [server.get(keys.SLOT + name) for name in names]
states = [SlotStatus.model_validate_json(text).state for text in found if text]
sys.exit(not any(state.can_work for state in states))
