"""The eight commands: the only place that knows click, streams and exit codes."""

import _signal as signal  # type: ignore[import-not-found]  # what lies under signal, whose own import can be interrupted
import os
import sys

# Threads that wait in busy loops take the other filters' time in a pipe: BLAS has none, since our matrices are small,
# and those of OpenCV sleep.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_THREAD_POOL_ACTIVE_WAIT_WORKER", "0")

# Ctrl-C while a command is still loading its libraries ends it as it ends `cat`, without a traceback of the imports.
_module = os.path.basename(sys.argv[0]).replace("-", "_") + ".py"
if os.path.exists(os.path.join(__path__[0], _module)) and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
