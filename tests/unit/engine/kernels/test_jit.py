"""The compiler of the CPU kernels where nothing can be written."""

import os
import subprocess
import sys


def test_kernels_compile_where_no_folder_can_be_written() -> None:
    only_this_folder = "UserProvidedCacheLocator"  # not __pycache__ and not the user's cache
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": os.devnull,
        "NUMBA_CACHE_LOCATOR_CLASSES": only_this_folder,
    }
    program = "from refine_engine.kernels.cpu_numba import log1p_unit; print(log1p_unit(1.0))"
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert done.stderr == ""
    assert done.stdout.startswith("0.693147")
